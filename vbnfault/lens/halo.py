"""Blur an image by a core and by the light that optics and sensor scatter, in a halo and in wide wings.

Measured point spreads of cameras consist of a narrow core and of light that falls as a power of the angle. Here

    PSF(θ) = (1 - Σ hᵢ) · exp(-θ² / 2σ²) / (2π σ²) + Σ hᵢ · (pᵢ - 2) / (2π θᵢ²) · (1 + θ² / θᵢ²)^(-pᵢ/2),

a Gaussian and two profiles of Moffat (1969, A&A 3, 455). It is the same over the frame and in all bands, and
conserves the light of the frame.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import scipy.fft
from numpy.typing import NDArray
from scipy.special import ndtr

F64 = NDArray[np.float64]

_FINE_PX = 8  # up to this distance from the centre, the halo is averaged over pixels
_FINE = 9  # points along each side of a pixel for that


@dataclass(frozen=True, kw_only=True)
class Halo:
    """Describe a point spread with a halo.

    `core_rad` is σ. `halo_fraction`, `halo_rad` and `halo_index` are h, θ and p of the halo, the fields `wing_…`
    those of the wings; p is above 2. Angles are in radians.
    """

    core_rad: float
    halo_fraction: float
    halo_rad: float
    halo_index: float
    wing_fraction: float = 0.0
    wing_rad: float = 1.0
    wing_index: float = 3.0

    def applied(self, light: NDArray[np.floating], pixel_rad: float) -> NDArray[np.floating]:
        """Return light, float[..., y, x], after the point spread, at least 0.

        Beyond its edges the frame continues as its mirror image. So the sum is kept, and a body that fills the
        frame is not darker at its edges.

        Parameters
        ----------
        light
            Light on the pixels of the frame. float64 keeps the rounding errors of the Sun's disc small.
        pixel_rad
            Angle that a pixel subtends.
        """
        response = _response(self, pixel_rad, (int(light.shape[-2]), int(light.shape[-1])))
        out = np.empty_like(light)
        for index in np.ndindex(light.shape[:-2]):
            waves = scipy.fft.dctn(light[index], type=2)
            waves *= response.astype(light.dtype)
            out[index] = scipy.fft.idctn(waves, type=2, overwrite_x=True)
        return np.maximum(out, 0, out=out)

    def on_pixels(self, pixel_rad: float, shape: tuple[int, int]) -> F64:
        """Return the fractions of a pixel's light at offsets (y, x) of 0 to `shape` pixels, float64[y + 1, x + 1].

        The sum over offsets of either sign is 1; at the largest offsets, both signs are the same pixel.
        """
        core = [_gaussian(self.core_rad / pixel_rad, size) for size in shape]
        out = (1 - self.halo_fraction - self.wing_fraction) * core[0][:, None] * core[1]
        out += self.halo_fraction * _moffat(self.halo_rad / pixel_rad, self.halo_index, shape)
        if self.wing_fraction:
            out += self.wing_fraction * _moffat(self.wing_rad / pixel_rad, self.wing_index, shape)
        return np.asarray(out)


def _moffat(scale_px: float, index: float, shape: tuple[int, int]) -> F64:
    """Return a profile of Moffat averaged over pixels, on the offsets of `Halo.on_pixels`; its sum is 1."""

    def profile(down: F64, across: F64) -> F64:
        return np.asarray((1 + (down[:, None] ** 2 + across**2) / scale_px**2) ** (-index / 2))

    y, x = (np.arange(size + 1, dtype=np.float64) for size in shape)
    out = profile(y, x)
    near = tuple(min(_FINE_PX, size) for size in shape)
    inside = (np.arange(_FINE) + 0.5) / _FINE - 0.5
    fine = profile(*((np.arange(size)[:, None] + inside).ravel() for size in near))
    out[: near[0], : near[1]] = fine.reshape(near[0], _FINE, near[1], _FINE).mean(axis=(1, 3))
    return out / _both_signs(out).sum()


def _both_signs(quadrant: F64) -> F64:
    """Return a quadrant of a point spread weighted by how many pixels have each of its offsets."""
    weights = [np.where((np.arange(n) == 0) | (np.arange(n) == n - 1), 1.0, 2.0) for n in quadrant.shape]
    return np.asarray(quadrant * weights[0][:, None] * weights[1])


def _gaussian(sigma_px: float, size: int) -> F64:
    """Return a Gaussian averaged over pixels at offsets of 0 to `size`, whose sum over both signs is 1."""
    edges = np.arange(size + 2) - 0.5
    values = np.diff(ndtr(edges / max(sigma_px, 1e-6)))
    return np.asarray(values / (values[0] + values[-1] + 2 * values[1:-1].sum()))


@lru_cache(maxsize=2)
def _response(halo: Halo, pixel_rad: float, shape: tuple[int, int]) -> F64:
    """Return by how much each cosine wave of a frame is damped, float64[y, x], read-only."""
    waves = scipy.fft.dctn(halo.on_pixels(pixel_rad, shape), type=1)[: shape[0], : shape[1]]
    waves.flags.writeable = False
    return np.asarray(waves)
