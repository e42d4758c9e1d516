"""Simulate a simple detector in named steps.

    irradiance → photo-electrons expected → electrons → raw DN → RGBI

Every pixel senses three colours (no mosaic), as in the image model of Gallon et al. Noise comes from a fixed number
of variates per pixel that do not depend on the signal. Two exposures of twins therefore differ only where their
signals differ.
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
from ..core.quantities import RGBI, Electrons, RawDN
from . import compiled
from .compiled import with_luminance
from .efficiency import QuantumEfficiency
from .interface import Detector, blockwise
from .noise import NormalField, counts_of_one_mean, draw_normals, poisson_on_dark, variates_by_code

F32 = NDArray[np.float32]


@dataclass(frozen=True, kw_only=True, eq=False)
class Noise:
    """Hold the variates of one exposure, standard normal.

    Attributes
    ----------
    codes
        Codes of the variates of shot noise and of read noise beside each other, uint16[y, x, 3, 2].
    shot, read
        The two fields, [y, x, 3] each; their codes are views of `codes`.
    """

    codes: NDArray[np.uint16]
    shot: NormalField
    read: NormalField

    @classmethod
    def draw(cls, shape: tuple[int, int], rng: np.random.Generator) -> Noise:
        """Draw two fields of normal variates for a (height, width) sensor."""
        both = draw_normals((*shape, 3, 2), rng)
        place, which = np.divmod(both.tail, 2)
        fields = [
            NormalField(codes=both.codes[..., k], tail=place[which == k], tail_values=both.tail_values[which == k])
            for k in (0, 1)
        ]
        return cls(codes=both.codes, shot=fields[0], read=fields[1])

    @cached_property
    def outermost_pixels(self) -> NDArray[np.intp]:
        """Return the flat indices of the pixels with an outermost code, whose variates no table holds, intp[n]."""
        return np.unique(np.concatenate([self.shot.tail, self.read.tail]) // 3)


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

    # each pixel of the image is independent of the others
    local: ClassVar[bool] = True
    channels: ClassVar[tuple[str, ...]] = ("R", "G", "B")

    def __post_init__(self) -> None:
        """Raise InputError unless the bias leaves codes for the signal, as a scene file must."""
        if not 0 <= self.bias_dn < self.adc_max_dn:
            raise InputError(
                f"bias_dn = {self.bias_dn}: must be from 0 to {self.adc_max_dn - 1} with adc_bits = {self.adc_bits}"
            )

    def draw_noise(self, shape: tuple[int, int], rng: Callable[[str], np.random.Generator]) -> Noise:
        """Draw the variates of one exposure. `rng` returns the random generator for a name."""
        return Noise.draw(shape, rng("noise"))

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
        """Return the QE (electrons per photon) in R, G, B."""
        return QuantumEfficiency(response=self.response, peak=self.quantum_efficiency_peak)

    @property
    def white_e(self) -> F32:
        """Return the signal of R, G, B in electrons that the 8 bit image shows as 255, float32[3]."""
        return np.asarray(self.full_well_e / self.gain / self.white_balance, dtype=np.float32)

    def electrons(self, expected: Electrons, exposure_s: float, noise: Noise | None) -> Electrons:
        """Return the collected electrons: add dark current, draw shot noise, clip at the full well."""
        shot = None if noise is None else noise.shot.values()
        return expected.with_array(blockwise(self._collector(exposure_s), expected.array, shot))

    def raw_dn(self, electrons: Electrons, noise: Noise | None) -> RawDN:
        """Return digital numbers: apply the gain, add read noise and bias, round, clip to the converter's range."""
        read = None if noise is None else noise.read.values()
        return RawDN(array=blockwise(self._convert, electrons.array, read).astype(np.uint16))

    def rgbi(self, raw: RawDN, exposure_s: float) -> RGBI:
        """Return 8 bit R, G, B, I: subtract bias and mean dark signal, balance white, add the luminance as I."""
        show = self._shower(exposure_s)
        return RGBI(array=blockwise(lambda dn: show(dn.astype(np.float32)), raw.array))

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

    def develop(
        self,
        expected: Electrons,
        exposure_s: float,
        noise: Any,
        acts: Any = None,
        base: tuple[Electrons, RGBI] | None = None,
    ) -> RGBI:
        """Return the 8 bit image of the expected photo-electrons, with the bits of the single steps.

        `noise` comes from `draw_noise`; None gives a noise-free image. `base` is another signal with its image for
        the same exposure and noise: pixels with this signal are taken from it, which saves time. Raises ValueError
        if the shapes of signal, noise and base differ.
        """
        shape = expected.array.shape
        if not expected.array.size:
            return RGBI(array=np.zeros((*shape[:2], 4), dtype=np.uint8))
        for name, other in (("noise", noise and noise.codes[..., 0]), ("base", base and base[0].array)):
            if other is not None and other.shape != shape:
                raise ValueError(
                    f"{name} has the shape {other.shape}, and the signal {shape}: they must be the same"
                )
        codes = None if noise is None else noise.codes
        known = None if base is None else (base[0].array, base[1].array)
        image = compiled.image(curve_of(self, float(exposure_s)), expected.array, codes, known)
        if noise is not None and len(noise.outermost_pixels):
            beyond = noise.outermost_pixels[None]
            light = expected.array.reshape(-1, 3)[beyond]
            electrons = self._collector(exposure_s)(light, noise.shot.of_pixels(beyond).values())
            dn = self._convert(electrons, noise.read.of_pixels(beyond).values())
            image.reshape(-1, 4)[beyond] = self._shower(exposure_s)(dn)
        return RGBI(array=image)

    def _collector(self, exposure_s: float) -> Callable[[F32, F32 | None], F32]:
        """Return the function that computes the collected electrons of a block."""
        dark = np.float32(self.dark_current_e_s * exposure_s)
        full_well = np.float32(self.full_well_e)

        def collect(signal: F32, shot: F32 | None) -> F32:
            mean = signal + dark if shot is None else poisson_on_dark(signal, dark, shot)
            return np.clip(mean, 0, full_well, out=mean)  # half the time of `minimum`

        return collect

    def _convert(self, electrons: F32, read: F32 | None) -> F32:
        """Return the digital numbers of electrons, as float32."""
        gain = np.float32(self.gain_dn_per_e)
        dn = electrons * gain
        if read is not None:
            dn += read * (np.float32(self.read_noise_e_rms) * gain)
        dn += np.float32(self.bias_dn)
        np.rint(dn, out=dn)
        return np.clip(dn, 0, self.adc_max_dn, out=dn)

    def _shower(self, exposure_s: float) -> Callable[[F32], NDArray[np.uint8]]:
        """Return the function that computes the 8 bit image of a block."""
        black, scale = self._black_and_scale(exposure_s)

        def show(dn: F32) -> NDArray[np.uint8]:
            # OpenCV multiplies with 64 bits, rounds to even and saturates at 0 and 255 as it converts
            rgb = cv2.multiply(dn - black, (*scale.tolist(), 0.0), dtype=cv2.CV_8U)
            return with_luminance(np.asarray(rgb))

        return show

    def _black_and_scale(self, exposure_s: float) -> tuple[np.float32, F32]:
        """Return the code that is shown as 0, and the levels per code of R, G and B, float32[3]."""
        # white is the range above the black level, so a saturated pixel stays white after a long exposure. Where
        # the dark signal alone saturates the pixels, 1 % of the range is left
        dark_dn = self.bias_dn + self.dark_current_e_s * exposure_s * self.gain_dn_per_e
        black = np.float32(min(dark_dn, self.adc_max_dn - 0.01 * (self.adc_max_dn - self.bias_dn)))
        return black, (255.0 / (self.adc_max_dn - float(black)) * self.white_balance).astype(np.float32)


@lru_cache(maxsize=8)
def curve_of(detector: ThreeColourDetector, exposure_s: float) -> compiled.Curve:
    """Return the numbers and tables with which a detector develops all images of an exposure."""
    gain = np.float32(detector.gain_dn_per_e)
    dark = np.float32(detector.dark_current_e_s * exposure_s)
    black, scale = detector._black_and_scale(exposure_s)
    return compiled.Curve(
        dark_e=dark,
        full_well_e=np.float32(detector.full_well_e),
        gain_dn_per_e=gain,
        read_noise_dn=np.float32(detector.read_noise_e_rms) * gain,
        bias_dn=np.float32(detector.bias_dn),
        adc_max_dn=np.float32(detector.adc_max_dn),
        black_dn=black,
        scale=scale,
        dark_counts_e=counts_of_one_mean(float(dark), variates_by_code()),
    )
