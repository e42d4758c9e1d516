"""Describe the input of a render as plain data, independently of how it is rendered."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ..core.calibration import Calibration
from ..core.sundisc import Pinhole
from ..reflectance import BandReflectance

F64 = NDArray[np.float64]

_BORDER = 65  # positions along a side of the frame of a camera with distortion
_ROUNDS = 3  # each reduces the error of a line's time by the motion in px a line, which is far below 1


@dataclass(frozen=True, kw_only=True, eq=False)
class CameraMotion:
    """Describe how a camera moves and turns over the ground while it takes an image.

    Attributes
    ----------
    velocity_L_m_s, rate_C_rad_s
        float64[3] in L, and float64[3] angular velocity in C.
    line_s
        float64[2]: by how much later a pixel is exposed than its left neighbour, and than the one above it. The
        middle of the frame has the pose of the view at the middle of its exposure.
    """

    velocity_L_m_s: F64
    rate_C_rad_s: F64
    line_s: F64 = field(default_factory=lambda: np.zeros(2))


@dataclass(frozen=True, kw_only=True, eq=False)
class View:
    """Describe the view of a pinhole or a thin lens of a patch, in the site's L axes (origin at the site, metres).

    Attributes
    ----------
    position_L_m, L_from_C
        float64[3] and float64[3, 3] rotation.
    intrinsics
        float64[4]: fx, fy, cx, cy in pixels.
    width_px, height_px
        Size of the image.
    aperture_radius_m, focus_distance_m
        An aperture of 0 is a pinhole; the focus distance may be inf.
    start_m
        Distance from the camera at which its rays start. Before a far body, they keep the precision of float32.
    projection
        Calibration of a camera with distortion. None: the pinhole of the intrinsics.
    motion
        How the camera moves; None: it stands still.
    """

    position_L_m: F64
    L_from_C: F64
    intrinsics: F64
    width_px: int
    height_px: int
    aperture_radius_m: float = 0.0
    focus_distance_m: float = float("inf")
    start_m: float = 0.0
    projection: Calibration | None = None
    motion: CameraMotion | None = None

    @property
    def pixel_map(self) -> Pinhole | Calibration:
        """Return the map between directions and pixels."""
        return Pinhole(self.intrinsics) if self.projection is None else self.projection

    @property
    def corner_rad(self) -> float:
        """Return the angle of a corner from the boresight, with distortion the largest angle along the border."""
        if self.projection is None:
            fx, fy = self.intrinsics[:2]
            return math.atan(math.hypot(self.width_px / fx, self.height_px / fy) / 2)
        x, y = (np.linspace(0, size, _BORDER) for size in (self.width_px, self.height_px))
        grids = (self.projection.directions_at(x, y[[0, -1]]), self.projection.directions_at(x[[0, -1]], y))
        return float(np.arccos(np.clip(min(grid[..., 2].min() for grid in grids), -1, 1)))

    def rays_C(self, x_px: F64, y_px: F64) -> tuple[F64, F64, F64 | float]:
        """Return x, y and z in C of the directions at pixel positions, which fit together; z = 1 of a pinhole."""
        if self.projection is None:
            fx, fy, cx, cy = self.intrinsics
            return (x_px - cx) / fx, (y_px - cy) / fy, 1.0
        x, y, z = np.moveaxis(
            self.projection.directions_of(np.stack(np.broadcast_arrays(x_px, y_px), axis=-1)), -1, 0
        )
        return x, y, z

    def seen_later(self, slopes: F64, depth_m: F64, time_s: F64) -> F64:
        """Return the tangents in C at which the camera sees points of the ground after a time, float64[point, 2].

        Parameters
        ----------
        slopes
            float64[point, 2]: their tangents before.
        depth_m, time_s
            float64[point]: depths before, and times. Where the depth is NaN, a point moves with the camera.
        """
        if self.motion is None:
            return slopes
        velocity_C_m_s = self.L_from_C.T @ self.motion.velocity_L_m_s
        before = np.column_stack([slopes, np.ones(len(slopes))]) * depth_m[:, None]
        turn = Rotation.from_rotvec(-np.outer(time_s, self.motion.rate_C_rad_s))
        x, y, z = turn.apply(before - np.outer(time_s, velocity_C_m_s)).T
        return np.where(np.isnan(depth_m)[:, None], slopes, np.stack([x / z, y / z], axis=1))

    def seen_by_lines(self, slopes: F64, depth_m: F64) -> F64:
        """Return the tangents at which the lines of a rolling shutter see points of the ground, float64[point, 2].

        `slopes` are the tangents from the camera's pose, `depth_m` are as in `seen_later`.
        """
        seen = slopes
        for _ in range(_ROUNDS if self._rolls else 0):
            seen = self.seen_later(slopes, depth_m, self._line_time_s(seen))
        return seen

    def stretch(self, slopes: F64, depth_m: F64) -> F64:
        """Return by how much longer than a line points of the ground are exposed, float64[point].

        It is above 1 where they move with the lines of a rolling shutter, which stretches their image as much.
        `slopes` are the tangents at which the lines see them, `depth_m` are as in `seen_later`.
        """
        if not self._rolls or self.motion is None:
            return np.ones(len(slopes))
        step_s = np.full(len(slopes), np.abs(self.motion.line_s).sum())
        moved_s = self._line_time_s(self.seen_later(slopes, depth_m, step_s)) - self._line_time_s(slopes)
        return np.asarray(1 / (1 - moved_s / step_s))

    @property
    def _rolls(self) -> bool:
        """Return whether the camera moves and exposes line after line."""
        return self.motion is not None and bool(self.motion.line_s.any())

    def _line_time_s(self, slopes: F64) -> F64:
        """Return the times at which pixels of a moving camera are exposed, float64[point], by tangents in C."""
        position = self.pixel_map.pixel_of(np.column_stack([slopes, np.ones(len(slopes))]))
        assert self.motion is not None
        return np.asarray((position - np.array([self.width_px, self.height_px]) / 2) @ self.motion.line_s)


@dataclass(frozen=True, kw_only=True, eq=False)
class Sunlight:
    """Describe the Sun as a disc.

    Attributes
    ----------
    direction_L
        float64[3], unit vector towards the centre of the disc.
    angular_radius_rad
        Angular radius of the disc.
    irradiance_W_m2_nm
        float64[band], W m⁻² nm⁻¹.
    limb_darkening
        float64[band, 6], see `spectra.limb_darkening`; None for a uniform disc.
    """

    direction_L: F64
    angular_radius_rad: float
    irradiance_W_m2_nm: F64
    limb_darkening: F64 | None = None

    @property
    def radiance_W_m2_sr_nm(self) -> F64:
        """Return the mean radiance of the disc, E / (π sin² α), per band."""
        return self.irradiance_W_m2_nm / (np.pi * np.sin(self.angular_radius_rad) ** 2)


@dataclass(frozen=True, kw_only=True, eq=False)
class RenderInput:
    """Describe a view of a sunlit surface.

    Attributes
    ----------
    wavelength_nm
        float64[band].
    reflectance
        How the surface reflects at these wavelengths.
    samples_per_pixel
        A power of four.
    key
        uint32 that selects the sample's own sub-pixel jitter.
    bounces
        Number of reflections between sunlit ground and the ground in view.
    dust_contrast
        float64[band]: reflectance of dust-covered ground divided by that of bare ground, minus 1. None: dust
        reflects like bare ground.
    shows_ground
        Whether the ground is in the image. Otherwise only the spacecraft is, in the light and shadow of the ground.
    """

    view: View
    sun: Sunlight
    wavelength_nm: F64
    reflectance: BandReflectance
    samples_per_pixel: int
    key: int
    bounces: int = 0
    dust_contrast: F64 | None = None
    shows_ground: bool = True


def may_see_sun(view: View, sun: Sunlight) -> bool:
    """Return whether the Sun's disc may lie in the frame.

    The margin is far larger than the lens's finite aperture.
    """
    x, y, z = view.L_from_C.T @ sun.direction_L
    if view.projection is not None:
        return bool(np.arccos(np.clip(z, -1, 1)) < view.corner_rad + 2 * sun.angular_radius_rad + 0.02)
    fx, fy, cx, cy = view.intrinsics
    if z <= 0:
        return False
    # the tangent of the angle grows faster at the edge of a wide field
    margin = 0.02 + np.tan(2 * sun.angular_radius_rad) * (1 + (x * x + y * y) / z**2)
    across = (-cx / fx - margin, (view.width_px - cx) / fx + margin)
    along = (-cy / fy - margin, (view.height_px - cy) / fy + margin)
    return bool(across[0] <= x / z <= across[1] and along[0] <= y / z <= along[1])
