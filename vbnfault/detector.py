"""A simple, honest detector in named steps.

    irradiance → photo-electrons expected → electrons → raw DN → RGBI

Every pixel senses the three colours (no mosaic), as the image model of Gallon et al. does. Noise is drawn
from a fixed number of variates per pixel that do not depend on the signal, so that two exposures of twins
differ only where their signals differ.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from . import spectra
from .quantities import LUMINANCE, RGBI, Electrons, Irradiance, RawDN

F32 = NDArray[np.float32]

# Below this mean the Poisson quantile is summed exactly; above, its Cornish-Fisher expansion errs by less
# than 0.04 electrons in mean and 0.5 % in variance (tests/test_detector.py).
EXACT_POISSON_BELOW_E = 12.0

_ROWS_PER_BLOCK = 64


@dataclass(frozen=True, kw_only=True)
class Noise:
    """Variates of one exposure, float32[y, x, 3] standard normal each: shot noise and read noise."""

    shot: F32
    read: F32

    @classmethod
    def draw(cls, shape: tuple[int, int], shot: np.random.Generator, read: np.random.Generator) -> Noise:
        """Two fields of normal variates for a (height, width) sensor, drawn in two threads."""
        size = (*shape, 3)
        with ThreadPoolExecutor(2) as pool:
            fields = pool.map(lambda g: g.standard_normal(size, dtype=np.float32), (shot, read))
            return cls(shot=next(fields), read=next(fields))


@dataclass(frozen=True, kw_only=True)
class Detector:
    """A three-colour sensor. Lengths in µm, signals in electrons (e), digital numbers in DN.

    `response` names relative colour curves of `spectra.RESPONSES`; `quantum_efficiency_peak` in (0, 1] scales
    them. The full well clips before bias and read noise are added; the converter spans bias … full well.
    """

    name: str = "generic"
    width_px: int = 1024
    height_px: int = 1024
    pixel_pitch_um: float = 5.5
    full_well_e: float = 13_500.0
    read_noise_e_rms: float = 13.0
    dark_current_e_s: float = 125.0
    adc_bits: int = 12
    bias_dn: int = 64
    response: str = "nikon_5100"
    quantum_efficiency_peak: float = 0.5

    @property
    def adc_max_dn(self) -> int:
        return 2**self.adc_bits - 1

    @property
    def gain_dn_per_e(self) -> float:
        """System gain K: the full well reaches the top code."""
        return (self.adc_max_dn - self.bias_dn) / self.full_well_e

    @property
    def white_balance(self) -> F32:
        """Gain of R, G, B, float32[3], at least 1, that makes a grey surface in sunlight grey."""
        return _white_balance(self.response, self.quantum_efficiency_peak)

    @property
    def white_e(self) -> F32:
        """Signal of R, G, B, in electrons, that the 8 bit image shows as 255."""
        return np.asarray(self.full_well_e / self.white_balance, dtype=np.float32)

    def electron_rate_weights(self, wavelength_nm: NDArray[np.float64]) -> F32:
        """float32[3, band]: electrons per second and pixel for 1 W m⁻² nm⁻¹ in a band."""
        area_m2 = (self.pixel_pitch_um * 1e-6) ** 2
        weights = spectra.band_weights(self.response, self.quantum_efficiency_peak, wavelength_nm)
        return np.asarray(weights * area_m2, dtype=np.float32)

    def electrons_expected(self, irradiance: Irradiance, exposure_s: float) -> Electrons:
        """Expected photo-electrons per pixel and colour, noise-free, not clipped."""
        weights = self.electron_rate_weights(irradiance.wavelength_nm) * np.float32(exposure_s)
        bands, height, width = irradiance.array.shape
        flat = irradiance.array.reshape(bands, -1)
        return Electrons(array=(flat.T @ weights.T).reshape(height, width, 3), white_e=self.white_e)

    def electrons(self, expected: Electrons, exposure_s: float, noise: Noise | None) -> Electrons:
        """Collected electrons: dark current added, shot noise, clipped at the full well."""
        dark = np.float32(self.dark_current_e_s * exposure_s)

        def step(signal: F32, shot: F32 | None) -> F32:
            mean = signal + dark
            out = mean if shot is None else poisson_quantile(mean, shot)
            return np.minimum(out, np.float32(self.full_well_e), out=out)

        return expected.with_array(_blockwise(step, expected.array, noise.shot if noise else None))

    def raw_dn(self, electrons: Electrons, noise: Noise | None) -> RawDN:
        """Digital numbers: gain, bias, read noise, quantisation, clipped to the converter's range."""
        gain = np.float32(self.gain_dn_per_e)
        read_noise = np.float32(self.read_noise_e_rms)

        def step(signal: F32, read: F32 | None) -> NDArray[np.uint16]:
            dn = signal * gain if read is None else (signal + read * read_noise) * gain
            dn += np.float32(self.bias_dn)
            np.rint(dn, out=dn)
            return np.clip(dn, 0, self.adc_max_dn, out=dn).astype(np.uint16)

        return RawDN(array=_blockwise(step, electrons.array, noise.read if noise else None))

    def rgbi(self, raw: RawDN, exposure_s: float) -> RGBI:
        """8 bit R, G, B, I: black level (bias and mean dark) subtracted, white balance; I is the luminance."""
        table = self._rgb_tables(exposure_s)
        weights = LUMINANCE.astype(np.float32)

        def step(dn: NDArray[np.uint16], _: None) -> NDArray[np.uint8]:
            out = np.empty((*dn.shape[:2], 4), dtype=np.uint8)
            for c in range(3):
                out[..., c] = table[c][dn[..., c]]
            out[..., 3] = np.rint(out[..., :3] @ weights)
            return out

        return RGBI(array=_blockwise(step, raw.array, None))

    def _rgb_tables(self, exposure_s: float) -> list[NDArray[np.uint8]]:
        black = self.bias_dn + self.dark_current_e_s * exposure_s * self.gain_dn_per_e
        full = np.arange(self.adc_max_dn + 1, dtype=np.float64) - black
        scale = 255.0 / (self.adc_max_dn - self.bias_dn)
        return [
            np.clip(np.rint(full * scale * float(g)), 0, 255).astype(np.uint8) for g in self.white_balance
        ]

    def develop(self, expected: Electrons, exposure_s: float, noise: Noise | None) -> tuple[RGBI, RawDN]:
        """Expected electrons through all later steps; without `noise` the noise-free image."""
        raw = self.raw_dn(self.electrons(expected, exposure_s, noise), noise)
        return self.rgbi(raw, exposure_s), raw


@lru_cache(maxsize=8)
def _white_balance(response: str, quantum_efficiency_peak: float) -> F32:
    nodes = spectra.band_nodes_nm(400.0, 700.0, 31)
    sun = spectra.solar_band_irradiance_W_m2_nm(nodes, 1.0)
    grey = spectra.band_weights(response, quantum_efficiency_peak, nodes) @ sun
    return np.asarray(grey.max() / grey, dtype=np.float32)


def poisson_quantile(mean: F32, normal: F32) -> F32:
    """The Poisson count, float32, at the quantile Φ(normal): one variate per value, whatever the mean.

    Exact (by summing the distribution) where the mean is below `EXACT_POISSON_BELOW_E`, else by the
    Cornish-Fisher expansion to third order, rounded: skewness 1/√m, excess kurtosis 1/m.
    """
    z = normal
    root = np.sqrt(mean)
    out = z * z
    out -= 1.0
    out *= np.float32(1 / 6)
    with np.errstate(divide="ignore", invalid="ignore"):
        out += (z - z * z * z) / (np.float32(72) * root)
    out += mean
    out += root * z
    np.rint(out, out=out)
    np.maximum(out, 0, out=out)
    low = mean < EXACT_POISSON_BELOW_E
    if low.any():
        out[low] = _poisson_exact(mean[low], ndtr(z[low].astype(np.float64)))
    return out


def _poisson_exact(mean: F32, u: NDArray[np.float64]) -> F32:
    out = np.zeros(len(mean), dtype=np.float32)
    left = np.flatnonzero(u > np.exp(-mean.astype(np.float64)))
    m, u = mean[left].astype(np.float64), u[left]
    term = np.exp(-m)
    total = term.copy()
    count = 0
    while len(left):
        count += 1
        term = term * m / count
        total += term
        # past 1 - 1e-15 the sum no longer moves in float64: stop there
        more = (u > total) & (total < 1 - 1e-15)
        out[left[~more]] = count
        left, m, u, term, total = left[more], m[more], u[more], term[more], total[more]
    return out


def _blockwise(step: Callable[..., NDArray[np.generic]], array: NDArray, extra: NDArray | None) -> NDArray:  # type: ignore[type-arg]
    """`step` over blocks of rows in two threads: blocks fit the cache, numpy releases the interpreter lock."""
    starts = range(0, len(array), _ROWS_PER_BLOCK)

    def one(start: int) -> NDArray[np.generic]:
        rows = slice(start, start + _ROWS_PER_BLOCK)
        return step(array[rows], None if extra is None else extra[rows])

    with ThreadPoolExecutor(2) as pool:
        return np.concatenate(list(pool.map(one, starts)))
