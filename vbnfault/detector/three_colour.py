"""Simulate a simple detector in named steps.

    irradiance → photo-electrons expected → electrons → raw DN → RGBI

Every pixel senses three colours (no mosaic), as in the image model of Gallon et al., or all light as one. Noise
comes from a fixed number of variates per pixel that do not depend on the signal. Two exposures of twins therefore
differ only where their signals differ.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Any, ClassVar

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.errors import InputError
from ..core.process.llvm import backend, evaluated, flat
from ..core.quantities import RGBI, Electrons
from .efficiency import QuantumEfficiency
from .interface import LUMINANCE_WEIGHTS, U8, Detector, with_luminance
from .noise import (
    NormalField,
    counts_of_one_mean,
    device_tables,
    draw_normals,
    poisson_of_codes,
    poisson_on_dark,
    variates_by_code,
)

F32 = NDArray[np.float32]


@dataclass(frozen=True, kw_only=True, eq=False)
class Noise:
    """Hold the variates of one exposure, standard normal.

    Attributes
    ----------
    codes
        Codes of the variates of shot noise and of read noise beside each other, uint16[y, x, channel, 2].
    shot, read
        The two fields, [y, x, channel] each; their codes are views of `codes`.
    """

    codes: NDArray[np.uint16]
    shot: NormalField
    read: NormalField

    @classmethod
    def draw(cls, shape: tuple[int, int], rng: np.random.Generator, channels: int = 3) -> Noise:
        """Draw two fields of normal variates for a (height, width) sensor."""
        both = draw_normals((*shape, channels, 2), rng)
        place, which = np.divmod(both.tail, 2)
        fields = [
            NormalField(codes=both.codes[..., k], tail=place[which == k], tail_values=both.tail_values[which == k])
            for k in (0, 1)
        ]
        return cls(codes=both.codes, shot=fields[0], read=fields[1])

    @cached_property
    def outermost_pixels(self) -> NDArray[np.intp]:
        """Return the flat indices of the pixels with an outermost code, whose variates no table holds, intp[n]."""
        return np.unique(np.concatenate([self.shot.tail, self.read.tail]) // self.codes.shape[2])


@dataclass(frozen=True, kw_only=True)
class ThreeColourDetector(Detector):
    """Describe a sensor whose pixels sense R, G and B. Lengths are in µm, signals in electrons (e) or DN.

    `response` names the relative colour curves in `spectra.RESPONSES`; `quantum_efficiency_peak` in (0, 1] scales
    them. The full well clips before bias and read noise are added. The converter spans bias … full well / gain.
    """

    name: str = "generic"
    width_px: int = 1024
    height_px: int = 1024
    pixel_pitch_um: float = 5.5
    full_well_e: float = 13_500.0
    read_noise_e_rms: float = 13.0
    dark_current_e_s: float = 15.0
    adc_bits: int = 12
    bias_dn: int = 64
    gain: float = 1.0
    response: str = "nikon_5100"
    quantum_efficiency_peak: float = 0.5

    channels: ClassVar[tuple[str, ...]] = ("R", "G", "B")

    def __post_init__(self) -> None:
        """Raise InputError unless the bias leaves codes for the signal, as a scene file must."""
        if not 0 <= self.bias_dn < self.adc_max_dn:
            raise InputError(
                f"bias_dn = {self.bias_dn}: must be from 0 to {self.adc_max_dn - 1} with adc_bits = {self.adc_bits}"
            )

    def draw_noise(self, shape: tuple[int, int], rng: Callable[[str], np.random.Generator]) -> Noise:
        """Draw the variates of one exposure. `rng` returns the random generator for a name."""
        return Noise.draw(shape, rng("noise"), len(self.channels))

    @property
    def adc_max_dn(self) -> int:
        """Return the highest code of the converter."""
        return 2**self.adc_bits - 1

    @property
    def gain_dn_per_e(self) -> float:
        """Return the system gain K in DN/e: `gain` times that with which the full well reaches the top code."""
        return self.gain * (self.adc_max_dn - self.bias_dn) / self.full_well_e

    @property
    def efficiency(self) -> QuantumEfficiency:
        """Return the QE (electrons per photon) of the channels."""
        return QuantumEfficiency(channels=self.channels, response=self.response, peak=self.quantum_efficiency_peak)

    @property
    def white_e(self) -> F32:
        """Return the signal in electrons that the 8 bit image shows as 255, float32[channel]."""
        return np.asarray(self.full_well_e / self.gain / self.white_balance, dtype=np.float32)

    @property
    def optics_key(self) -> Any:
        """Return a key of everything on which the expected electrons depend."""
        return replace(self, read_noise_e_rms=0.0, dark_current_e_s=0.0)

    @property
    def mosaic(self) -> None:
        """Return None: every pixel senses all colours."""

    @property
    def description(self) -> dict[str, Any]:
        """Return what a user of the noise needs to know, as plain JSON data."""
        return {
            "name": self.name,
            "pixel_pitch_um": self.pixel_pitch_um,
            "full_well_e": self.full_well_e,
            "read_noise_e_rms": self.read_noise_e_rms,
            "bits": self.adc_bits,
            "bias_dn": self.bias_dn,
            "gain_dn_per_e": self.gain_dn_per_e,
        }

    def develop(self, expected: Electrons, exposure_s: float, noise: Any, acts: Any = None) -> RGBI:
        """Return the 8 bit image of the expected photo-electrons, with the bits of the single steps.

        `noise` comes from `draw_noise`; None gives a noise-free image. Raises ValueError if the shapes of signal
        and noise differ.
        """
        shape = expected.array.shape
        if not expected.array.size:
            return RGBI(array=np.zeros((*shape[:2], 4), dtype=np.uint8))
        if noise is not None and noise.codes.shape[:-1] != shape:
            raise ValueError(
                f"noise has the shape {noise.codes.shape[:-1]}, and the signal {shape}: they must be the same"
            )
        image = _curve(self, float(exposure_s)).image(expected.array, noise and noise.codes)
        if noise is not None and len(noise.outermost_pixels):
            beyond = noise.outermost_pixels[None]
            shot, read = (field.of_pixels(beyond).values() for field in (noise.shot, noise.read))
            electrons = self.collected_e(expected.array.reshape(-1, shape[2])[beyond], exposure_s, shot)
            image.reshape(-1, 4)[beyond] = self.shown(self.converted_dn(electrons, read), exposure_s)
        return RGBI(array=image)

    def collected_e(self, signal: F32, exposure_s: float, shot: F32 | None) -> F32:
        """Return the collected electrons: add dark current, draw shot noise, clip at the full well."""
        dark = np.float32(self.dark_current_e_s * exposure_s)
        mean = signal + dark if shot is None else poisson_on_dark(signal, dark, shot)
        return np.clip(mean, 0, np.float32(self.full_well_e))

    def converted_dn(self, electrons: F32, read: F32 | None) -> F32:
        """Return codes, as float32: apply the gain, add read noise and bias, round, clip to the range."""
        gain = np.float32(self.gain_dn_per_e)
        dn = electrons * gain
        if read is not None:
            dn += read * (np.float32(self.read_noise_e_rms) * gain)
        return np.clip(np.rint(dn + np.float32(self.bias_dn)), 0, self.adc_max_dn)

    def shown(self, dn: F32, exposure_s: float) -> U8:
        """Return 8 bit R, G, B, I: subtract bias and mean dark signal, balance white, add the luminance as I."""
        black, scale = self.black_and_scale(exposure_s)
        # OpenCV multiplies with 64 bits, rounds to even and saturates at 0 and 255 as it converts
        levels = np.asarray(cv2.multiply(dn - black, (*scale.tolist(), 0.0), dtype=cv2.CV_8U))
        return with_luminance(levels) if len(scale) == 3 else cv2.merge([levels] * 4)

    def black_and_scale(self, exposure_s: float) -> tuple[np.float32, F32]:
        """Return the code that is shown as 0, and the levels per code of the channels, float32[channel]."""
        # white is the range above the black level, so a saturated pixel stays white after a long exposure. Where
        # the dark signal alone saturates the pixels, 1 % of the range is left
        dark_dn = self.bias_dn + self.dark_current_e_s * exposure_s * self.gain_dn_per_e
        black = np.float32(min(dark_dn, self.adc_max_dn - 0.01 * (self.adc_max_dn - self.bias_dn)))
        return black, (255.0 / (self.adc_max_dn - float(black)) * self.white_balance).astype(np.float32)


@dataclass(frozen=True, kw_only=True)
class GreyDetector(ThreeColourDetector):
    """Describe a sensor without colour filters, whose quantum efficiency is the same at all wavelengths."""

    channels: ClassVar[tuple[str, ...]] = ("W",)


# --- compiled ---------------------------------------------------------------------------------------------------


class _Curve:
    """Turn the signals of one exposure into 8 bit levels, with intermediate results in registers.

    Every value takes the steps of `ThreeColourDetector` in the same order and precision, so that it has the bits
    that these steps give one after the other (tests/test_detector_compiled.py). Only the exponential function of
    the Poisson sums may differ in its last bit. A count would differ for it only where a sum lies within 1e-16 of
    one of the 65,536 quantiles of the variates.

    All numbers of the sensor are device arrays: as literals they would give each exposure a kernel of its own.
    """

    def __init__(self, detector: ThreeColourDetector, exposure_s: float) -> None:
        be = backend()
        dark, gain = np.float32(detector.dark_current_e_s * exposure_s), np.float32(detector.gain_dn_per_e)
        black, scale = detector.black_and_scale(exposure_s)
        read_noise_dn = np.float32(detector.read_noise_e_rms) * gain
        limits = np.float32(detector.full_well_e), np.float32(detector.adc_max_dn)
        self._dark, self._gain, self._read_noise, self._bias, self._black, self._full_well, self._top = (
            be.dr.opaque(be.Float, float(v))
            for v in (dark, gain, read_noise_dn, np.float32(detector.bias_dn), black, *limits)
        )
        self._scale = [be.dr.opaque(be.Float64, float(value)) for value in scale]
        # electrons of an unlit value by the code of its shot noise
        self._dark_counts = be.Float(flat(counts_of_one_mean(float(dark), variates_by_code())))

    def image(self, signal: F32, codes: NDArray[np.uint16] | None) -> U8:
        """Return the 8 bit levels of R, G and B, and the luminance as I, uint8[y, x, 4].

        Parameters
        ----------
        signal
            Expected photo-electrons, float32[y, x, channel], of at least one pixel, with one channel or three.
        codes
            Codes of the variates of shot noise and of read noise, uint16[y, x, channel, 2]; None for no noise. The
            two outermost codes stand for variates that no table holds; here they are the medians of their bins.
        """
        be = backend()
        dr, level = be.dr, self._noise_free_level if codes is None else self._level
        words = be.UInt32(0) if codes is None else be.UInt32(flat(codes).view(np.uint32))
        found = level(be.Float(flat(signal)), dr.arange(be.UInt32, signal.size), words)
        if signal.shape[2] == 1:
            return evaluated(found * 0x01010101).view(np.uint8).reshape(*signal.shape[:2], 4)
        return compiled_with_luminance(evaluated(be.UInt8(found)).reshape(signal.shape))

    def _noise_free_level(self, signal: Any, place: Any, codes: Any) -> Any:
        return self._shown(self._charge_dn(signal + self._dark), place)

    def _level(self, signal: Any, place: Any, codes: Any) -> Any:
        """Return the 8 bit levels of signals; the low half of a word of codes is that of the shot noise."""
        be = backend()
        dr, lit = be.dr, signal > 0
        electrons = dr.if_stmt(
            (signal + self._dark, codes & 0xFFFF, lit),
            lit,
            poisson_of_codes,
            lambda mean, shot, lit: dr.gather(be.Float, self._dark_counts, shot, ~lit),
        )
        read = dr.gather(be.Float, device_tables()[0], codes >> 16) * self._read_noise
        return self._shown(self._charge_dn(electrons) + read, place)

    def _charge_dn(self, electrons: Any) -> Any:
        return backend().dr.clip(electrons, 0, self._full_well) * self._gain

    def _shown(self, dn: Any, place: Any) -> Any:
        be = backend()
        dr = be.dr
        dn = dr.clip(dr.round(dn + self._bias), 0, self._top)
        scale, colour = self._scale[0], place % len(self._scale)
        for k, other in enumerate(self._scale[1:], start=1):
            scale = dr.select(colour == k, other, scale)
        return be.UInt32(be.Int32(dr.clip(dr.round(be.Float64(dn - self._black) * scale), 0, 255)))


_curve = lru_cache(maxsize=8)(_Curve)


def compiled_with_luminance(rgb: U8) -> U8:
    """Return `with_luminance` of R, G and B, uint8[y, x, 3], in a seventh of its time."""
    height, width, _ = rgb.shape
    pixels = height * width
    if pixels % 4:
        return with_luminance(rgb)
    be = backend()
    dr = be.dr
    group = dr.arange(be.UInt32, pixels // 4)
    words = be.UInt32(flat(rgb).view(np.uint32))
    a, b, c = (dr.gather(be.UInt32, words, 3 * group + k) for k in range(3))  # three words hold four pixels
    four = a & 0xFFFFFF, a >> 24 | (b & 0xFFFF) << 8, b >> 16 | (c & 0xFF) << 16, c >> 8
    out = dr.empty(be.UInt32, pixels)
    dr.scatter(out, be.Array4u(*(pixel | _luminance_of(pixel) << 24 for pixel in four)), group)
    return evaluated(out).view(np.uint8).reshape(height, width, 4)


def _luminance_of(pixel: Any) -> Any:
    """Return the luminance, as UInt32, of pixels that hold R, G and B in the three lowest bytes of a word."""
    be = backend()
    light = be.Float(0.0)
    for k, weight in enumerate(LUMINANCE_WEIGHTS):
        light = be.dr.fma(be.Float(be.Int32(pixel >> (8 * k) & 0xFF)), float(weight), light)
    return be.UInt32(be.Int32(be.dr.round(light)))
