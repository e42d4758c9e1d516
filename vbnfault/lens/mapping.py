"""Map field angles to image heights with chief rays, and fit the camera's distortion model to the map.

A chief ray passes through the middle of the stop. Chief rays end where one misses a surface or is totally
reflected. Near that end their heights may rise without limit or turn back, unlike the heights of the light that
passes the rims. A camera's geometry at the d line is therefore the distortion model, fitted to the chief rays
and continued smoothly beyond them to the corners of the frame. Light, truth and stored coefficients then agree at
every pixel. Outside the frame, and for the shift of one colour against another, the chief rays themselves are used.

The model is OpenCV's. With t the tangent of the field angle, the distance from the axis in focal lengths is

    d(t) = t (1 + k1 t² + k2 t⁴ + k3 t⁶) / (1 + k4 t² + k5 t⁴ + k6 t⁶),

the rational model of `cv2.projectPoints` (Claus and Fitzgibbon 2005, CVPR, 213). OpenCV orders the coefficients k1,
k2, p1, p2, k3, k4, k5, k6. Lenses here have rotational symmetry: p1 = p2 = 0.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..core.errors import InputError
from .glass import D_NM
from .prescription import Prescription
from .rays import Path, trace

if TYPE_CHECKING:
    from scipy.interpolate import CubicSpline

F64 = NDArray[np.float64]

_STEEPNESS = 0.3  # dh/dθ in focal lengths; below it chief rays are taken to turn back
_ONWARD = (0.3, 1.5)  # limits of the height's rise beyond the last chief ray: dh/dθ there, and dh/dt
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
        good = np.diff(height) > _STEEPNESS * efl_mm * np.diff(np.arctan(slope))
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
    least_mm, most_mm = _ONWARD[0] * efl_mm / (1 + end * end), _ONWARD[1] * efl_mm
    onward = np.clip(ratio(end) + end * ratio(end, 1), least_mm, most_mm)
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


# --- the model --------------------------------------------------------------------------------------------------


# Residuals below this count as equal. The lowest degree then wins: its coefficients are better determined.
_ENOUGH_PX = 0.001
# A model that follows all heights of the lens may fold. Then the outermost heights get less weight, until a model
# that does not fold follows the others to this distance.
_FOLLOWED_PX = 0.01
_FOLLOWED = tuple(k / 16 for k in range(16, 7, -1))  # fractions of the angle of the last height
_WEIGHTS = (1.0, 0.1, 0.01, 1e-3, 1e-4, 1e-5)  # of the outermost heights
# Up to _BEYOND times the widest slope the denominator stays above this and distances rise, so that points just
# outside the frame are not projected into it.
_LEAST_DENOMINATOR = 0.1
_BEYOND = 1.1
# Allowed d ln d / d ln t. Below 0 the image folds; from 2 on the iteration t ← d0 / (d(t) / t), by which
# `cv2.undistortPoints` inverts the model, does not converge: its error grows by the factor 1 - d ln d / d ln t.
_EXPONENTS = (0.1, 1.9)
_CHECKED = 513
_STEPS = 12


@dataclass(frozen=True, kw_only=True, eq=False)
class RadialModel:
    """Hold a distortion model that is valid from the axis to the slope `end`.

    `coefficients` is float64[8] in OpenCV's order.
    """

    coefficients: F64
    end: float

    @property
    def valid_to_deg(self) -> float:
        """Return the field angle up to which distances are known to rise; farther light may land in the frame."""
        return float(np.degrees(np.arctan(_BEYOND * self.end)))

    def distance(self, slope: F64) -> F64:
        """Return distances from the axis in focal lengths for tangents of field angles, float64 like `slope`."""
        above, below = self._parts
        square = slope * slope
        return np.asarray(slope * _polynomial(above, square) / _polynomial(below, square))

    def rise(self, slope: F64) -> F64:
        """Return the derivative of `distance`, float64 like `slope`."""
        square = slope * slope
        (n, dn), (d, dd) = ((_polynomial(c, square), _derivative(c, square)) for c in self._parts)
        return np.asarray(n / d + 2 * square * (dn * d - n * dd) / (d * d))

    def reaches(self, distance: float) -> bool:
        """Return whether the model reaches a distance from the axis, in focal lengths, without a pole or a fold.

        It must also be invertible by iteration up to there.
        """
        slope = np.linspace(0, _BEYOND * self.end, _CHECKED)[1:]
        if not _polynomial(self._parts[1], slope * slope).min() >= _LEAST_DENOMINATOR:
            return False
        distances, rise, inside = self.distance(slope), self.rise(slope), slope <= self.end
        exponent = slope[inside] * rise[inside] / distances[inside]
        return bool(
            distances.min() > 0
            and rise.min() > 0
            and _EXPONENTS[0] <= exponent.min() <= exponent.max() <= _EXPONENTS[1]
            and self.distance(np.array(self.end)) >= distance
        )

    @property
    def _parts(self) -> tuple[F64, F64]:
        """Return the coefficients of numerator and denominator."""
        k = self.coefficients
        return k[[0, 1, 4]], k[5:]


def fitted(slope: F64, distance: F64, focal_length_px: float, *, known: int, reach: float) -> RadialModel | None:
    """Return the invertible model that comes nearest to the given distances; None where there is none.

    Parameters
    ----------
    slope, distance
        float64[n], rising, above 0: tangents of field angles, and distances from the axis in focal lengths.
    known
        Number of points, at least 8, that rays through the lens give. The points behind them only suggest how the
        model may continue.
    reach
        Distance that the model must reach, in focal lengths; at most the last of `distance`.
    """
    angle, order = np.arctan(slope), np.arange(len(slope))
    spare = None
    for followed in _FOLLOWED:
        inner = (order < known) & (angle <= followed * angle[known - 1])
        entries = []
        for degree in range(4):
            for weight in _WEIGHTS[: 1 if inner.all() else None]:
                coefficients = _of_degree(slope, distance, degree, np.where(inner, 1.0, weight))
                if coefficients is None:
                    continue
                model = RadialModel(coefficients=coefficients, end=float(slope[-1]))
                if not model.reaches(reach):
                    continue
                off_px = np.abs(model.distance(slope) - distance)[:known] * focal_length_px
                entry = max(float(off_px.max()), _ENOUGH_PX), degree, -weight, model
                if off_px[inner[:known]].max() <= _FOLLOWED_PX:
                    entries.append(entry)
                spare = entry if spare is None else min(spare, entry, key=lambda e: e[:3])
        if entries:
            return min(entries, key=lambda e: e[:3])[3]
    return spare[3] if spare else None


def _polynomial(coefficients: F64, square: F64) -> F64:
    """Return 1 + Σ c_k squareᵏ."""
    total = np.zeros_like(square)
    for c in coefficients[::-1]:
        total = (total + c) * square
    return np.asarray(1 + total)


def _derivative(coefficients: F64, square: F64) -> F64:
    """Return Σ k c_k squareᵏ⁻¹."""
    total = np.zeros_like(square)
    for k, c in reversed(list(enumerate(coefficients, 1))):
        total = total * square + k * c
    return np.asarray(total)


def _of_degree(slope: F64, distance: F64, degree: int, weight: F64) -> F64 | None:
    """Return weighted least-squares coefficients with a denominator of this degree in t²; None if undetermined.

    Multiplied by its denominator, the model is linear in the coefficients. Each iteration divides the weights by
    the last denominator, which undoes the multiplication (Sanathanan and Koerner 1963, IEEE Trans. Automatic
    Control 8, 56).
    """
    most = slope[-1]
    powers = (slope[:, None] / most) ** [2, 4, 6]
    columns = np.concatenate([slope[:, None] * powers, -distance[:, None] * powers[:, :degree]], axis=1)
    below = np.ones_like(slope)
    solution = np.zeros(3 + degree)
    for _ in range(_STEPS if degree else 1):
        coefficients = _least_squares(columns * (weight / below)[:, None], (distance - slope) * weight / below)
        if coefficients is None:
            return None
        solution = coefficients
        below = 1 + (powers[:, :degree] * solution[3:]).sum(axis=1)
        if not np.abs(below).min() > 0:
            return None
    k = np.zeros(6)
    k[: 3 + degree] = solution
    k /= most ** np.array([2, 4, 6, 2, 4, 6])
    return np.array([k[0], k[1], 0.0, 0.0, k[2], *k[3:]])


def _least_squares(columns: F64, right: F64) -> F64 | None:
    """Solve a least-squares problem by Gram-Schmidt factorisation; None where columns depend on one another.

    Sums run in one fixed order, because stores keep the result, and a threaded library would not give the same bits
    on every machine.
    """
    count = columns.shape[1]
    scale = np.sqrt((columns**2).sum(axis=0))
    basis, upper = columns / scale, np.eye(count)
    for k in range(count):
        for j in [*range(k)] * 2:  # twice: nearly parallel columns lose orthogonality in one pass
            along = (basis[:, j] * basis[:, k]).sum()
            upper[j, k] += along
            basis[:, k] -= along * basis[:, j]
        upper[k, k] = np.sqrt((basis[:, k] ** 2).sum())
        if not upper[k, k] > 1e-12:
            return None
        basis[:, k] /= upper[k, k]
    solution = np.zeros(count)
    for k in reversed(range(count)):
        rest = (upper[k, k + 1 :] * solution[k + 1 :]).sum()
        solution[k] = ((basis[:, k] * right).sum() - rest) / upper[k, k]
    return np.asarray(solution / scale)
