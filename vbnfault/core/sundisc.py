"""Compute the Sun's direct image: how much of its disc each pixel of a frame sees, for any size of the pixels.

Rays through the pixels would miss a disc that is smaller than a pixel. The disc is therefore divided into cells, at
least 128 across the disc. No cell crosses a pixel's border. The projected solid angle of each cell is added to its
pixel. No random numbers are used. The cells are normalised so that the sum over all pixels is that of the whole
disc,

    Σ S_b = ∫ p_b(μ) cos θ dω = π sin²α cos θ,

where α is the angular radius, p_b the radiance of band b over the mean of the disc, and θ the angle of the disc's
centre from the boresight. A cell that the disc's rim cuts counts by the part of its area on the inner side of the
rim's tangent.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Protocol

import numpy as np
from numpy.typing import NDArray

from .quantities import SunInView

F64 = NDArray[np.float64]
Floats = NDArray[np.floating[Any]]
Frame = tuple[int, int]

# The least number of cells across the disc: the error of the cells at the rim is then below 1e-3 of the light of a
# limb-darkened disc.
_ACROSS = 128
_RIM = 64  # points of the rim that bound its image; between two points it extends 1 - cos(π / 64) = 0.12 % further
_MOST_CELLS = 1 << 20  # processed at once, to bound the memory
_STEEPEST = 10.0  # the largest tangent that `slopes_of` returns, of 84°
_SHARP_PX = 0.05  # a smaller blur circle of defocus is ignored
LEAST_Z = 1e-3  # below this z of a unit direction in C, a plane cannot hold its image


class Projection(Protocol):
    """Map between directions and the plane of the pixels, at one wavelength.

    Directions are vectors in C of any length, float64[..., 3]. Those of a plane have z = 1.
    """

    @property
    def least_z(self) -> float:
        """Return the least z of unit directions of which the map can hold an image."""

    @property
    def foreshortens(self) -> bool:
        """Return whether the pupil is a flat hole, through which light at the angle θ passes as cos θ."""

    def pixel_of(self, directions: F64) -> F64:
        """Return pixel positions x and y of directions, float64[..., 2]."""

    def directions_at(self, x_px: Floats, y_px: Floats) -> F64:
        """Return the directions that the positions of a grid see, float64[y, x, 3]."""

    def solid_angle_sr(self, directions: F64) -> F64:
        """Return the solid angle per pixel at directions in sr, float64[...].

        Where the pupil foreshortens, it is the projected one, cos θ dω / (dx dy).
        """


def forward(slopes: F64) -> F64:
    """Return the directions of tangents x/z and y/z in C, float64[..., 3], with z = 1."""
    return np.concatenate([slopes, np.ones_like(slopes[..., :1])], axis=-1)


def slopes_of(directions: F64) -> F64:
    """Return the tangents x/z and y/z of directions, float64[..., 2], limited to those of 84°.

    So a fisheye is a wide camera to what asks for tangents.
    """
    across = np.hypot(directions[..., 0], directions[..., 1])
    return np.asarray(directions[..., :2] / np.maximum(directions[..., 2], across / _STEEPEST)[..., None])


@dataclass(frozen=True)
class Pinhole:
    """Map directions as a rectilinear camera does; `intrinsics` are fx, fy, cx, cy in pixels."""

    intrinsics: F64

    least_z: ClassVar[float] = LEAST_Z
    foreshortens: ClassVar[bool] = True

    def pixel_of(self, directions: F64) -> F64:
        """Return pixel positions as `Projection` defines."""
        slopes = directions[..., :2] / directions[..., 2:]
        return np.asarray(slopes * self.intrinsics[:2] + self.intrinsics[2:])

    def directions_at(self, x_px: Floats, y_px: Floats) -> F64:
        """Return directions as `Projection` defines."""
        fx, fy, cx, cy = self.intrinsics
        return forward(np.stack(np.meshgrid((x_px - cx) / fx, (y_px - cy) / fy), axis=-1))

    def directions_of(self, xy_px: F64) -> F64:
        """Return the directions that positions float64[..., 2] see, float64[..., 3]."""
        return forward((xy_px - self.intrinsics[2:]) / self.intrinsics[:2])

    def solid_angle_sr(self, directions: F64) -> F64:
        """Return cos⁴θ / (fx fy), as `Projection` defines."""
        fx, fy = self.intrinsics[:2]
        slopes = directions[..., :2] / directions[..., 2:]
        return np.asarray(1 / (fx * fy * (1 + (slopes**2).sum(axis=-1)) ** 2))


@dataclass(frozen=True)
class PixelSums:
    """Hold what the pixels in a window of the frame see of the disc.

    `rows` and `columns` bound the window. `values` float64[profile, y, x] are in sr, or in sr times the unit of the
    gain.
    """

    rows: slice
    columns: slice
    values: F64

    def on(self, shape: Frame) -> F64:
        """Return the values in a whole frame, float64[profile, y, x]."""
        out = np.zeros((len(self.values), *shape))
        out[:, self.rows, self.columns] = self.values
        return out


def axes(direction: F64) -> F64:
    """Return the disc's axes as rows, float64[3, 3]: two in the plane of the disc, then its unit direction."""
    z = direction / np.linalg.norm(direction)
    x = np.cross(z, np.eye(3)[np.argmin(np.abs(z))])
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z])


def bounds_px(disc: SunInView, projection: Projection) -> F64 | None:
    """Return the least and the greatest pixel position of the disc's image, float64[2, 2].

    The result is None where a part of the disc is beside or behind the camera.
    """
    turn = np.arange(_RIM) * 2 * np.pi / _RIM
    s, c = np.sin(disc.angular_radius_rad), np.cos(disc.angular_radius_rad)
    rim = np.column_stack([s * np.cos(turn), s * np.sin(turn), np.full(_RIM, c)]) @ axes(disc.direction_C)
    if (rim[:, 2] < projection.least_z).any():
        return None
    rim_px = projection.pixel_of(rim)
    low, high = rim_px.min(axis=0), rim_px.max(axis=0)
    more = 0.01 * (high - low)
    return np.stack([low - more, high + more])


def pixel_sums(
    disc: SunInView,
    projection: Projection,
    shape: Frame,
    profiles: F64 | None = None,
    gain: Callable[[F64], F64] | None = None,
) -> PixelSums | None:
    """Return what each pixel of a frame sees of the disc, or None where no pixel sees it.

    Parameters
    ----------
    disc
        The disc and its visible fraction.
    projection
        The directions that the pixels see.
    shape
        Height and width of the frame in pixels.
    profiles
        Coefficients c_k, float64[profile, k], of Σ c_k μᵏ, the radiance over the disc's mean. Default: one uniform
        profile.
    gain
        Function that returns a factor on the light for directions float64[y, x, 3].

    Returns
    -------
    PixelSums
        Projected solid angle times profile, gain and visible fraction.
    """
    bounds = bounds_px(disc, projection)
    if bounds is None or not disc.visible.any():
        return None
    profiles = np.ones((1, 1)) if profiles is None else profiles
    radius_px = (bounds[1] - bounds[0]).max() / 2
    blur_px = disc.blur_slope * radius_px / np.tan(disc.angular_radius_rad)
    shifts = np.zeros((1, 2))
    if blur_px > _SHARP_PX:  # defocus spreads each point of the Sun over a circle: fill it with points
        count = int(np.clip(16 * (1 + blur_px / max(radius_px, 0.5)) ** 2, 16, 1024))
        shifts = blur_px * sunflower(count)
    frame = np.array(shape[::-1])
    low = np.clip(np.floor(bounds[0] + shifts.min(axis=0)), 0, frame).astype(int)
    high = np.clip(np.ceil(bounds[1] + shifts.max(axis=0)), 0, frame).astype(int)
    if (high <= low).any():
        return None
    total = np.asarray(sum(_sums(disc, projection, bounds, shift, (low, high), profiles, gain) for shift in shifts))
    if not total.any():
        return None
    return PixelSums(slice(low[1], high[1]), slice(low[0], high[0]), total / len(shifts))


def add_mean(
    radiance: NDArray[np.float32], disc: SunInView, projection: Projection, bands: Sequence[int]
) -> tuple[slice, slice] | None:
    """Add the disc to a frame's radiance, float32[band, y, x], in place. Return its rows and columns, or None.

    The mean radiance of a pixel is its power over the projected solid angle of a pixel at its centre.
    """
    shape = (int(radiance.shape[1]), int(radiance.shape[2]))
    sums = pixel_sums(disc, projection, shape, disc.profiles(bands))
    if sums is None:
        return None
    y, x = (np.arange(s.start, s.stop) + 0.5 for s in (sums.rows, sums.columns))
    solid = projection.solid_angle_sr(projection.directions_at(x, y))
    light = sums.values * (disc.radiance_W_m2_sr_nm[list(bands)][:, None, None] / solid)
    radiance[:, sums.rows, sums.columns] += light.astype(np.float32)
    return sums.rows, sums.columns


def sunflower(count: int) -> F64:
    """Return points that represent equal areas of the unit disc, float64[point, 2]."""
    k = np.arange(count) + 0.5
    radius, turn = np.sqrt(k / count), k * np.pi * (3 - np.sqrt(5))
    return np.column_stack([radius * np.cos(turn), radius * np.sin(turn)])


def _cells(low: float, high: float, first: int, last: int) -> tuple[F64, F64, NDArray[np.int64]]:
    """Return the centre, the width and the pixel of each cell from `low` to `high`, along one axis.

    No cell crosses a pixel's border. Pixels count from `first`; -1 marks a cell outside the pixels from `first` to
    below `last`.
    """
    inner = np.arange(max(first, np.floor(low) + 1), min(last, np.ceil(high) - 1) + 1)
    knots = np.unique(np.concatenate([[low], inner, [high]]))
    length = np.diff(knots)
    count = np.maximum(np.ceil(length * (_ACROSS / (high - low))), 1).astype(int)
    width = np.repeat(length / count, count)
    step = np.arange(len(width)) - np.repeat(np.cumsum(count) - count, count)
    centre = np.repeat(knots[:-1], count) + (step + 0.5) * width
    pixel = np.floor(centre).astype(int) - first
    pixel[(pixel < 0) | (pixel >= last - first)] = -1
    return centre, width, pixel


def _sums(
    disc: SunInView,
    projection: Projection,
    bounds: F64,
    shift: F64,
    window: tuple[NDArray[np.int64], NDArray[np.int64]],
    profiles: F64,
    gain: Callable[[F64], F64] | None,
) -> F64:
    """Return the sums of a window's pixels, float64[profile, y, x], for a disc moved by `shift` (defocus)."""
    (left, top), (right, bottom) = window
    # the cells stay around the unmoved disc: the shift moves the pixels instead
    x, dx, column = _cells(bounds[0, 0] + shift[0], bounds[1, 0] + shift[0], left, right)
    y, dy, row = _cells(bounds[0, 1] + shift[1], bounds[1, 1] + shift[1], top, bottom)
    x, y = x - shift[0], y - shift[1]
    on_disc = _DiscPosition(axes(disc.direction_C), float(np.sin(disc.angular_radius_rad)))
    per_px = on_disc.change_per_px(projection, bounds)
    out = np.zeros((len(profiles), bottom - top, right - left))
    total = np.zeros(len(profiles))
    starts = np.flatnonzero(np.diff(column, prepend=-2))
    of_frame = column[starts] >= 0
    strips = max(1, _MOST_CELLS // len(x))
    for first in range(0, len(y), strips):
        strip = slice(first, first + strips)
        seen = projection.directions_at(x, y[strip])
        position = on_disc(seen)
        covered, mu = _cells_on_disc(position, per_px, dx, dy[strip, None])
        weight = covered * projection.solid_angle_sr(seen) * dx * dy[strip, None]
        shown = weight * _visible(disc.visible, position)
        if gain is not None:
            shown = shown * gain(seen)
        inside = row[strip] >= 0
        for k, coefficients in enumerate(profiles):
            profile = np.polynomial.polynomial.polyval(mu, coefficients)
            total[k] += (weight * profile).sum()
            of_columns = np.add.reduceat((shown * profile)[inside], starts, axis=1)[:, of_frame]
            for_rows = np.zeros((bottom - top, int(of_frame.sum())))
            np.add.at(for_rows, row[strip][inside], of_columns)
            out[k][:, column[starts][of_frame]] += for_rows
    mean = profiles @ (2 / (np.arange(profiles.shape[1]) + 2))  # of each profile over the disc
    facing = on_disc.axes[2, 2] if projection.foreshortens else 1.0
    return np.asarray(out * (np.pi * on_disc.sine**2 * facing * mean / total)[:, None, None])


@dataclass(frozen=True, eq=False)
class _DiscPosition:
    """Map directions to positions on the unit disc, which is the disc seen along its own direction.

    `axes` are those of the disc, float64[3, 3]; `sine` is that of its angular radius.
    """

    axes: F64
    sine: float

    def __call__(self, directions: F64) -> F64:
        """Return the positions, float64[y, x, 2]."""
        x, y, z = np.moveaxis(directions, -1, 0)
        length = np.sqrt(z * z + (x * x + y * y))
        coordinates = [(x * a[0] + y * a[1] + z * a[2]) / (self.sine * length) for a in self.axes[:2]]
        return np.stack(coordinates, axis=-1)

    def change_per_px(self, projection: Projection, bounds: F64) -> tuple[F64, F64]:
        """Return the change of the position per pixel along x and along y, both float64[2]."""
        middle, quarter = bounds.mean(axis=0), (bounds[1] - bounds[0]) / 4
        near = self(
            projection.directions_at(*(m + q * np.array([-1.0, 1.0]) for m, q in zip(middle, quarter, strict=True)))
        )
        return (
            (near[:, 1] - near[:, 0]).mean(axis=0) / (2 * quarter[0]),
            (near[1] - near[0]).mean(axis=0) / (2 * quarter[1]),
        )


def _cells_on_disc(position: F64, per_px: tuple[F64, F64], dx: F64, dy: F64) -> tuple[F64, F64]:
    """Return the fraction of each cell that lies on the disc, and the mean μ of that part, both float64[y, x].

    `position` is that of the cells' centres on the unit disc, `per_px` its change per pixel. `dx` and `dy` are the
    sizes of the cells in pixels.
    """
    r = np.maximum(np.hypot(position[..., 0], position[..., 1]), 1e-12)
    a = np.abs(position @ per_px[0]) / r * dx
    b = np.abs(position @ per_px[1]) / r * dy
    covered = _covered(1 - r, a, b)
    # mean distance from the rim of the cell's part inside the disc
    depth = np.where(covered < 1, covered * (a + b) / 2, 1 - r)
    return covered, np.sqrt(np.clip(1 - (1 - depth) ** 2, 0, 1))


def _covered(depth: F64, a: F64, b: F64) -> F64:
    """Return the fraction of a rectangle on the inner side of a line, float64[...] in [0, 1].

    `depth` is the distance of the rectangle's centre from the line, positive on the inner side. `a` and `b` are the
    extents of its sides across the line.
    """
    least = 1e-4 * (a + b) + 1e-300
    a, b = np.maximum(a, least), np.maximum(b, least)

    def square(v: F64) -> F64:
        return np.asarray(np.maximum(v, 0) ** 2)

    s, d = (a + b) / 2, (a - b) / 2
    area = square(depth + s) - square(depth + d) - square(depth - d) + square(depth - s)
    return np.where(depth >= s, 1.0, np.clip(area / (2 * a * b), 0, 1))


def _visible(table: NDArray[np.float32], position: F64) -> F64 | float:
    """Return the visible fraction at positions on the unit disc, float64[...], linear between the cells' centres.

    The nearest cell's value would shift a straight edge along the grid by up to half a cell.
    """
    if table.min() == table.max():
        return float(table[0, 0])
    n = len(table)
    values = np.zeros(position.shape[:-1])
    cells = [np.clip((position[..., k] + 1) * (n / 2) - 0.5, 0, n - 1) for k in (0, 1)]
    first = [np.minimum(v.astype(int), n - 2) for v in cells]
    fraction = [v - k for v, k in zip(cells, first, strict=True)]
    for down in (0, 1):
        for right in (0, 1):
            weight = np.abs(1 - right - fraction[0]) * np.abs(1 - down - fraction[1])
            values += weight * table[first[1] + down, first[0] + right]
    return values
