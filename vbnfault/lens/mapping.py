"""Map field angles to image heights with chief rays, and fit the camera's distortion model to the map.

A chief ray passes through the middle of the stop. Chief rays end where one misses a surface or is totally
reflected. Near that end their heights may rise without limit or turn back, unlike the heights of the light that
passes the rims. A camera's geometry at the d line is therefore the model of `distortion`, fitted to the chief rays
and continued smoothly beyond them to the corners of the frame. Light, truth and stored coefficients then agree at
every pixel. Outside the frame, and for the shift of one colour against another, the chief rays themselves are used.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..core.errors import InputError
from .distortion import RadialModel, fitted
from .glass import D_NM
from .prescription import Prescription
from .rays import Path, trace

if TYPE_CHECKING:
    from scipy.interpolate import CubicSpline

F64 = NDArray[np.float64]

_STEEPNESS = 0.3  # dh/dt in focal lengths; below it chief rays are taken to turn back
_ONWARD = (0.3, 1.5)  # limits of dh/dt beyond the last chief ray
_HEIGHTS = 129  # rays of a meridional fan
_SECANT_STEPS = 7
_KNOWN, _CONTINUED = 192, 64  # field angles of the fit with and without a chief ray
_PAST_CORNER = 1.02  # the model is fitted up to this multiple of the corner's distance from the axis


def inclined_rays(
    lens: Prescription, slope: F64, x: F64, y: F64, wavelength_nm: float, sensor_mm: float
) -> tuple[Path, tuple[int, ...]]:
    """Trace rays through (x, y) mm of the first vertex's plane with the slope dx/dz.

    Returns their path and the common shape of the arguments.
    """
    slope, x, y = np.broadcast_arrays(slope, x, y)
    nothing = np.zeros(x.size)
    path = trace(
        lens,
        np.column_stack([x.ravel(), y.ravel(), nothing]),
        np.column_stack([slope.ravel(), nothing, nothing + 1]),
        wavelength_nm=wavelength_nm,
        sensor_mm=sensor_mm,
    )
    return path, x.shape


def relative_radii(lens: Prescription, slope: F64, x: F64, y: F64, sensor_mm: float) -> F64:
    """Return each ray's `Path.relative_radius` at the d line; inf for a ray that does not reach the sensor plane.

    The rays are those of `inclined_rays`, and the result has the common shape of the arguments. A value above 1
    means that a rim clips the ray.
    """
    path, shape = inclined_rays(lens, slope, x, y, D_NM, sensor_mm)
    lost = ~np.isfinite(path.points_mm[-1, :, 0])
    return np.where(lost, np.inf, path.relative_radius).reshape(shape)


def fan_heights_mm(lens: Prescription, slope: F64) -> F64:
    """Return heights in the first vertex's plane, float64[angle, height] mm, that cover the whole first surface."""
    return np.asarray(lens.surfaces[0].reach_mm(slope)[:, None] * np.linspace(-1, 1, _HEIGHTS))


def chief_heights_mm(lens: Prescription, slope: F64, *, wavelength_nm: float, sensor_mm: float) -> F64:
    """Return where chief rays meet the sensor, float64[n] mm from the axis; nan where there is none.

    `slope` float64[n]: tangents of the field angles. A chief ray passes through the middle of the stop. It is
    located in a fan of exact rays, then by the secant method. It may itself lie beyond a rim.
    """
    heights = fan_heights_mm(lens, slope)
    row = 1 + lens.stop
    path, shape = inclined_rays(lens, slope[:, None], heights, np.zeros(1), wavelength_nm, sensor_mm)
    off = np.where(np.isfinite(path.points_mm[-1, :, 0]), path.points_mm[row, :, 0], np.nan).reshape(shape)
    outside = path.relative_radius.reshape(shape)
    with np.errstate(invalid="ignore"):
        through = off[:, :-1] * off[:, 1:] <= 0
    k = np.argmin(np.where(through, outside[:, :-1], np.inf), axis=1)
    each = np.arange(len(slope))
    a, b, off_a, off_b = heights[each, k], heights[each, k + 1], off[each, k], off[each, k + 1]
    for _ in range(_SECANT_STEPS):
        with np.errstate(invalid="ignore", divide="ignore"):
            next_ = np.where(off_b == off_a, b, b - off_b * (b - a) / (off_b - off_a))
        path, _ = inclined_rays(lens, slope, next_, np.zeros(1), wavelength_nm, sensor_mm)
        a, off_a, b, off_b = b, off_b, next_, path.points_mm[row, :, 0]
    # where the secant method did not converge, no ray passes the middle of the stop
    settled = through.any(axis=1) & (np.abs(off_b) < 1e-6 * lens.surfaces[lens.stop].semi_diameter_mm)
    return np.where(settled, path.points_mm[-1, :, 0], np.nan)


@dataclass(frozen=True, kw_only=True, eq=False)
class ChiefHeights:
    """Interpolate the image heights of the chief rays of one wavelength.

    They hold up to the slope `end` of the last chief ray; beyond it the height continues linearly with the
    derivative `onward_mm`. `ratio` is height over slope, in mm.
    """

    ratio: CubicSpline
    end: float
    onward_mm: float

    def height_mm(self, slope: F64) -> F64:
        """Return image heights, float64 like `slope`."""
        known = np.minimum(slope, self.end)
        return np.asarray(known * self.ratio(known) + (slope - known) * self.onward_mm)

    def rise_mm(self, slope: F64) -> F64:
        """Return the derivative of the height by the slope, float64 like `slope`."""
        known = np.minimum(slope, self.end)
        return np.where(slope > self.end, self.onward_mm, self.ratio(known) + known * self.ratio(known, 1))


def chief_heights(
    lens: Prescription,
    slope: F64,
    *,
    wavelength_nm: float,
    sensor_mm: float,
    efl_mm: float,
    within: float = np.inf,
) -> ChiefHeights:
    """Trace the chief rays of a lens at the slopes given, and return their heights as a function.

    The function ends at the last slope before which no chief ray is missing or turns back, and at `within` at most.

    Raises
    ------
    InputError
        Only rays next to the axis pass the middle of the stop.
    """
    from scipy.interpolate import CubicSpline  # takes half a second to import: for lenses of surfaces only

    height = chief_heights_mm(lens, slope, wavelength_nm=wavelength_nm, sensor_mm=sensor_mm)
    with np.errstate(invalid="ignore"):
        good = np.diff(height) > _STEEPNESS * efl_mm * np.diff(slope)
    last = len(slope) - 1 if good.all() else int(np.argmin(good))
    end = min(float(slope[last]), within)
    last = int(np.searchsorted(slope, end))
    if last < 3:
        angle = np.degrees(np.arctan(end))
        raise InputError(
            f"{lens.name}: no ray through the middle of the stop comes from beyond {angle:.2g} degrees"
        )
    # h / t is even in t, so its derivative is 0 on the axis
    ratio = CubicSpline(slope[: last + 1], height[: last + 1] / slope[: last + 1], bc_type=((1, 0.0), "not-a-knot"))
    onward = np.clip(ratio(end) + end * ratio(end, 1), _ONWARD[0] * efl_mm, _ONWARD[1] * efl_mm)
    return ChiefHeights(ratio=ratio, end=end, onward_mm=float(onward))


def camera_model(
    chief: ChiefHeights, focal_length_mm: float, corner: float, pixels: float, name: str
) -> RadialModel:
    """Return the distortion model of a frame, fitted to the chief rays and beyond them to a smooth continuation.

    Parameters
    ----------
    corner
        Distance of the frame's corner from the axis, in focal lengths.
    pixels
        Focal length in pixels.
    name
        Name of the lens, for the error.

    Raises
    ------
    InputError
        No model reaches the corner without folding.
    """
    reach = _PAST_CORNER * corner * focal_length_mm
    missing = reach - float(chief.height_mm(np.array(chief.end)))
    if missing <= 0:
        slope = np.linspace(0, chief.end, 16 * _KNOWN + 1)
        most = float(np.interp(reach, chief.height_mm(slope), slope))
        slope, known = np.linspace(0, most, _KNOWN + _CONTINUED + 1)[1:], _KNOWN + _CONTINUED
    else:
        most, known = chief.end + missing / chief.onward_mm, _KNOWN
        slope = np.concatenate(
            [np.linspace(0, chief.end, _KNOWN + 1)[1:], np.linspace(chief.end, most, _CONTINUED + 1)[1:]]
        )
    model = fitted(slope, chief.height_mm(slope) / focal_length_mm, pixels, known=known, reach=corner)
    if model is None:
        angle = np.degrees(np.arctan(chief.end))
        raise InputError(
            f"{name}: camera.fov_deg: the lens images {angle:.3g} degrees from its axis, and no model of "
            "distortion goes on from there to the corners of the frame without folding; it must be smaller"
        )
    return model


@dataclass(frozen=True, kw_only=True, eq=False)
class FieldMap:
    """Tabulate image height over the tangent of the field angle at one wavelength; linear beyond the table."""

    slope: F64
    height_mm: F64
    rise_mm: F64  # dh/dt

    def height(self, slope: F64) -> F64:
        """Return image heights in mm, float64 like `slope`."""
        beyond = np.maximum(slope - self.slope[-1], 0)
        return np.asarray(np.interp(slope, self.slope, self.height_mm) + beyond * self.rise_mm[-1])

    def slope_at(self, height_mm: F64) -> F64:
        """Return the tangents of the field angles at image heights, float64 like `height_mm`."""
        beyond = np.maximum(height_mm - self.height_mm[-1], 0)
        return np.asarray(np.interp(height_mm, self.height_mm, self.slope) + beyond / self.rise_mm[-1])

    def shifted(self, chief: ChiefHeights, main: ChiefHeights) -> FieldMap:
        """Return the map of another wavelength, whose chief rays are `chief`; those of this map are `main`.

        The difference of both sets of chief rays shifts this map. Beyond the last ray of `chief` the difference
        stays constant.
        """
        known = np.minimum(self.slope, chief.end)
        apart = chief.height_mm(known) - main.height_mm(known)
        steeper = np.where(self.slope > chief.end, 0, chief.rise_mm(known) - main.rise_mm(known))
        return replace(self, height_mm=self.height_mm + apart, rise_mm=self.rise_mm + steeper)


def field_map(slope: F64, chief: ChiefHeights, model: RadialModel, focal_length_mm: float) -> FieldMap:
    """Return the map of the d line at the slopes given.

    It follows the model within its fitted range, and beyond that range the chief rays.
    """
    within = np.minimum(slope, model.end)
    height = focal_length_mm * model.distance(within) + chief.height_mm(slope) - chief.height_mm(within)
    rise = np.where(slope > model.end, chief.rise_mm(slope), focal_length_mm * model.rise(within))
    return FieldMap(slope=slope, height_mm=height, rise_mm=rise)
