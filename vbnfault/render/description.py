"""One planned sample as plain data: what the renderer needs to know, and nothing of how it renders."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..core.photometry import Photometry

F64 = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True, eq=False)
class View:
    """A pinhole or thin-lens view of a patch, in the site's L axes (origin at the site, metres).

    `intrinsics` fx, fy, cx, cy in pixels; `aperture_radius_m` 0 for a pinhole; `focus_distance_m` may be inf.
    """

    position_L_m: F64
    L_from_C: F64
    intrinsics: F64
    width_px: int
    height_px: int
    aperture_radius_m: float = 0.0
    focus_distance_m: float = float("inf")


@dataclass(frozen=True, kw_only=True, eq=False)
class Sunlight:
    """The Sun as a disc: unit `direction_L`, `angular_radius_rad`, irradiance W m⁻² nm⁻¹ per band.

    `limb_darkening` float64[band, 6]: see `spectra.limb_darkening`; None for a uniform disc.
    """

    direction_L: F64
    angular_radius_rad: float
    irradiance_W_m2_nm: F64
    limb_darkening: F64 | None = None

    @property
    def radiance_W_m2_sr_nm(self) -> F64:
        """Mean radiance of the disc, E / (π sin² α), per band."""
        return self.irradiance_W_m2_nm / (np.pi * np.sin(self.angular_radius_rad) ** 2)


@dataclass(frozen=True, kw_only=True, eq=False)
class RenderInput:
    """A view of a sunlit surface: `wavelength_nm` float64[band] and how the surface reflects there.

    `dust_contrast` float64[band]: reflectance of dust-covered ground over that of bare ground, minus 1.
    `samples_per_pixel` is a power of four; `bounces` counts the reflections between sunlit ground and the ground
    that is seen; `key` (uint32) selects the sample's own sub-pixel jitter.
    """

    view: View
    sun: Sunlight
    wavelength_nm: F64
    photometry: Photometry
    samples_per_pixel: int
    key: int
    bounces: int = 0
    dust_contrast: F64 | None = None
