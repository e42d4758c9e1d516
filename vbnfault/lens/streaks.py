"""Draw points that are out of focus and move during the exposure: discs, streaks, and streaks of discs.

A point at a distance d from a lens focused at a distance g is imaged as the outline of the lens's pupil, scaled by
f (1/d - 1/g) (f: focal length), so that it is turned by half a turn beyond the focus. A point that moves uniformly
draws this figure along a line. The light at a pixel is the length of the line on which the figure covers the pixel,
over the length of the line and the figure's area:

    E(p) = |{τ in [-L/2, L/2]: p - τ u in the figure}| / (L A),

in closed form for a disc and for a convex polygon. It is averaged over a grid of points within each pixel, and then
scaled, so that each point keeps its light exactly. All points are drawn at once.

The outlines of a lens with surfaces are those of the beams that pass all rims: cut like a cat's eye far off the
axis, and polygons where the stop has blades.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from .beams import Beams
from .image_frame import ImageFrame

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

# The least blur, in pixels. Narrower figures are drawn with this radius, which the grid of points within a pixel
# still resolves.
LEAST_RADIUS_PX = 0.3

_LEAST_LENGTH_PX = 0.02  # of a streak: that of a point at rest
_FINEST, _COARSEST = 10, 2  # points within a pixel, along each axis
_POINTS_ACROSS = 24  # points across the diameter of a figure, up to the finest grid
_DIRECTIONS = 48  # normals of the polygons
_ROUND_BELOW_PX = 1.5  # figures of a smaller radius are drawn round
_MOST_AT_ONCE = 1 << 19  # pixels drawn at once, to bound the memory


@dataclass(frozen=True, kw_only=True, eq=False)
class Streaks:
    """Hold moving points; each field is float64[n].

    Attributes
    ----------
    x_px, y_px
        Middles of the streaks.
    dx_px, dy_px
        Their extents, from the first to the last position.
    radius_px
        Radius of the disc that each point is imaged as.
    depth_m
        Depth of the points along the boresight.
    support
        float64[n, direction]: distance of the figure's edge from its middle over `radius_px`, in equally spaced
        directions from +x towards +y; None: all are discs.
    """

    x_px: F64
    y_px: F64
    dx_px: F64
    dy_px: F64
    radius_px: F64
    depth_m: F64
    support: F64 | None = None

    def __len__(self) -> int:
        return len(self.x_px)

    def select(self, keep: I64 | NDArray[np.bool_]) -> Streaks:
        """Return the points that a mask or indices select."""
        return replace(self, **{k: v[keep] for k, v in vars(self).items() if v is not None})

    def moved(self, x_px: float, y_px: float) -> Streaks:
        """Return the points in a frame whose origin lies (x_px, y_px) before this one's."""
        return replace(self, x_px=self.x_px + x_px, y_px=self.y_px + y_px)

    @property
    def widest(self) -> F64:
        """Return the largest distance of each figure's edge from its middle, over `radius_px`, at least 1."""
        if self.support is None:
            return np.ones(len(self))
        return np.maximum(self.support.max(axis=1, initial=1), 1)

    @property
    def length_px(self) -> F64:
        """Return the lengths of the streaks without their discs."""
        return np.hypot(self.dx_px, self.dy_px)


def inside(streaks: Streaks, shape: tuple[int, int]) -> tuple[F64, F64]:
    """Return where each streak with its disc enters and leaves a frame, as fractions of its extent from the middle.

    Both are float64[n] in [-1/2, 1/2]. The first is not below the second where the streak misses the frame.
    """
    first, last = np.full(len(streaks), -0.5), np.full(len(streaks), 0.5)
    around = np.maximum(streaks.radius_px, LEAST_RADIUS_PX) * streaks.widest + 1
    axes = ((streaks.x_px, streaks.dx_px, shape[1]), (streaks.y_px, streaks.dy_px, shape[0]))
    for middle, extent, size in axes:
        rises = np.where(extent < 0, -1.0, 1.0)
        steep = rises * np.maximum(np.abs(extent), 1e-9)
        ends = (-around - middle) / steep, (size + around - middle) / steep
        first = np.maximum(first, np.minimum(*ends))
        last = np.minimum(last, np.maximum(*ends))
    return first, last


def drawn(
    streaks: Streaks, weights: F64, shape: tuple[int, int], scene_depth_m: NDArray[np.floating] | None = None
) -> F64:
    """Return the sum of all streaks, each times its weight, float64[layer, y, x].

    Parameters
    ----------
    streaks
        The points.
    weights
        float64[layer, n]: the sum of each point over an unbounded frame, in each layer.
    shape
        Height and width of the frame.
    scene_depth_m
        float[y, x]: pixels whose depth is smaller than that of a point hide it; None: nothing hides it.
    """
    out = np.zeros((len(weights), shape[0] * shape[1]))
    first, last = inside(streaks, shape)
    seen = np.flatnonzero(last > first)
    part, middle = (last - first)[seen], ((last + first) / 2)[seen]
    near = streaks.select(seen)
    near = replace(
        near,
        x_px=near.x_px + middle * near.dx_px,
        y_px=near.y_px + middle * near.dy_px,
        dx_px=near.dx_px * part,
        dy_px=near.dy_px * part,
        radius_px=np.maximum(near.radius_px, LEAST_RADIUS_PX),
    )
    fine = np.clip(np.ceil(_POINTS_ACROSS / (2 * near.radius_px)), _COARSEST, _FINEST).astype(np.int64)
    round_ = (near.radius_px < _ROUND_BELOW_PX) if near.support is not None else np.ones(len(near), dtype=bool)
    for steps in np.unique(fine):
        for is_round in (True, False):
            chosen = np.flatnonzero((fine == steps) & (round_ == is_round))
            group = near.select(chosen)
            if is_round:
                group = replace(group, support=None)
            _draw(group, weights[:, seen[chosen]] * part[chosen], shape, int(steps), scene_depth_m, out)
    return out.reshape(len(weights), *shape)


def _draw(
    streaks: Streaks,
    weights: F64,
    shape: tuple[int, int],
    steps: int,
    scene_depth_m: NDArray[np.floating] | None,
    out: F64,
) -> None:
    """Add streaks to `out`, float64[layer, pixel], with `steps` points along each axis of a pixel."""
    if not len(streaks):
        return
    windows = _Windows.of(streaks)
    edges = np.searchsorted(np.cumsum(windows.pixels), np.arange(0, windows.pixels.sum(), _MOST_AT_ONCE))
    bounds = np.unique([0, *edges.tolist(), len(streaks)])
    for start, stop in pairwise(bounds.tolist()):
        point, x, y = windows.listed(np.arange(start, stop))
        light = _lit(streaks, point, x, y, steps)
        total = np.bincount(point - start, light, minlength=stop - start)
        light /= total[point - start]
        keep = (x >= 0) & (x < shape[1]) & (y >= 0) & (y < shape[0]) & (light > 0)
        if scene_depth_m is not None:
            keep[keep] = scene_depth_m[y[keep], x[keep]] > streaks.depth_m[point[keep]]
        point, pixel, light = point[keep], y[keep] * shape[1] + x[keep], light[keep]
        for layer, weight in zip(out, weights, strict=True):
            layer += np.bincount(pixel, light * weight[point], minlength=len(layer))


@dataclass(frozen=True, kw_only=True, eq=False)
class _Windows:
    """Hold the pixels that each streak may touch: a band of rows in each column, or of columns in each row.

    `steep` says for which streaks the axes are swapped; `along` is the first pixel along the longer axis, `count`
    their number, `reach` the pixels on both sides of the streak, `middle` and `across` the streak's middle along
    both axes, and `slope` its slope.
    """

    steep: NDArray[np.bool_]
    along: I64
    count: I64
    reach: I64
    middle: F64
    across: F64
    slope: F64

    @classmethod
    def of(cls, streaks: Streaks) -> _Windows:
        """Return the windows of streaks."""
        steep = np.abs(streaks.dy_px) > np.abs(streaks.dx_px)
        middle, across = _swapped(streaks.x_px, streaks.y_px, steep)
        long, short = _swapped(streaks.dx_px, streaks.dy_px, steep)
        radius = streaks.radius_px * streaks.widest
        half = np.abs(long) / 2 + radius
        slope = short / np.where(long == 0, 1, long)
        along = np.floor(middle - half).astype(np.int64)
        return cls(
            steep=steep,
            along=along,
            count=np.ceil(middle + half).astype(np.int64) - along,
            reach=np.ceil(radius * np.sqrt(1 + slope**2) + np.abs(slope) / 2 + 0.5).astype(np.int64),
            middle=middle,
            across=across,
            slope=slope,
        )

    @property
    def pixels(self) -> I64:
        """Return the number of pixels of each window."""
        return self.count * (2 * self.reach + 1)

    def listed(self, points: I64) -> tuple[I64, I64, I64]:
        """Return the point, the column and the row of each pixel in the windows of some points."""
        number = self.pixels[points]
        point = np.repeat(points, number)
        place = np.arange(len(point)) - np.repeat(np.cumsum(number) - number, number)
        rows = 2 * self.reach[point] + 1
        along = self.along[point] + place // rows
        line = self.across[point] + self.slope[point] * (along + 0.5 - self.middle[point])
        across = np.floor(line).astype(np.int64) + place % rows - self.reach[point]
        return (point, *_swapped(along, across, self.steep[point]))


def _swapped(a: NDArray, b: NDArray, swap: NDArray[np.bool_]) -> tuple[NDArray, NDArray]:
    """Return both arrays, with their elements exchanged where `swap` is true."""
    return np.where(swap, b, a), np.where(swap, a, b)


def _lit(streaks: Streaks, point: I64, x: I64, y: I64, steps: int) -> F64:
    """Return the light of a streak in a pixel, not normalised, float64 for each pair of `point` and pixel."""
    length = np.hypot(streaks.dx_px, streaks.dy_px)
    ux = np.where(length > 0, streaks.dx_px / np.maximum(length, 1e-12), 1.0)
    uy = np.where(length > 0, streaks.dy_px / np.maximum(length, 1e-12), 0.0)
    half = np.maximum(length, _LEAST_LENGTH_PX) / 2
    from_x, from_y = x - streaks.x_px[point], y - streaks.y_px[point]
    ux, uy, half, radius = ux[point], uy[point], half[point], streaks.radius_px[point]
    light = np.zeros(len(point))
    offsets = (np.arange(steps) + 0.5) / steps
    if streaks.support is None:
        square = radius * radius
        for oy in offsets:
            for ox in offsets:
                px, py = from_x + ox, from_y + oy
                along, across = px * ux + py * uy, py * ux - px * uy
                chord = np.sqrt(np.maximum(square - across * across, 0))
                light += np.maximum(np.minimum(along + chord, half) - np.maximum(along - chord, -half), 0)
        return light
    grid = np.stack(np.meshgrid(offsets, offsets), axis=-1).reshape(-1, 2, 1)
    px, py = from_x + grid[:, 0], from_y + grid[:, 1]
    low, high = np.broadcast_to(-half, px.shape), np.broadcast_to(half, px.shape)
    for k, edge in enumerate(streaks.support.T):
        # a point of the pixel is covered while n·(p - τ u) <= h
        turn = 2 * np.pi * k / streaks.support.shape[1]
        nx, ny = np.cos(turn), np.sin(turn)
        rate = nx * ux + ny * uy
        rate = np.where(np.abs(rate) < 1e-9, 1e-9, rate)
        limit = (nx * px + ny * py - edge[point] * radius) / rate
        low = np.where(rate > 0, np.maximum(low, limit), low)
        high = np.where(rate < 0, np.minimum(high, limit), high)
    return np.asarray(np.maximum(high - low, 0).sum(axis=0))


# --- outlines of pupils ----------------------------------------------------------------------------------------


def pupil_support(frame: ImageFrame, slopes: F64, depth_m: F64) -> F64 | None:
    """Return `Streaks.support` for points at the tangents x/z and y/z, float64[n, 2]; None for an ideal lens.

    The outline is that of the beam of a far point; its middle is its centroid. A stop with blades cuts the beam of
    the round stop of the same area, in every direction by the ratio of its rim to that stop's. The light of points
    beyond the focus crosses before the sensor, which turns the outline by half a turn.
    """
    if frame.lens.real is None:
        return None
    beams = frame.beams("")
    angle, turn = np.hypot(slopes[:, 0], slopes[:, 1]), np.arctan2(slopes[:, 1], slopes[:, 0])
    lit = np.flatnonzero(beams.rim_mm.min(axis=1) > 0)
    nearest = lit[np.abs(beams.slope[lit] - angle[:, None]).argmin(axis=1)]
    radius_mm = frame.lens.aperture_radius_m * 1e3
    rim, azimuth = _outlines(beams)
    stop = frame.lens.real.prescription.surfaces[frame.lens.real.prescription.stop]
    spread = np.sqrt(np.mean(stop.rim_mm(np.linspace(0, 2 * np.pi, 3600, endpoint=False)) ** 2))
    around = azimuth + turn[:, None]
    crossed = np.where(depth_m > frame.lens.focus_distance_m, -1.0, 1.0)[:, None]
    distance = crossed * rim[nearest] * stop.rim_mm(around) / (spread * radius_mm)
    x, y = distance * np.cos(around), distance * np.sin(around)
    normal = 2 * np.pi * np.arange(_DIRECTIONS) / _DIRECTIONS
    support = [(x * np.cos(a) + y * np.sin(a)).max(axis=1) for a in normal]
    return np.stack(support, axis=1)


@lru_cache(maxsize=4)
def _outlines(beams: Beams) -> tuple[F64, F64]:
    """Return the rims of the beams about their centroids, float64[angle, azimuth], and the azimuths, all round."""
    half = np.linspace(0, np.pi, beams.rim_mm.shape[1])
    turn = np.linspace(0, 2 * np.pi, 2 * _DIRECTIONS, endpoint=False)
    rims = np.stack([np.interp(np.minimum(turn, 2 * np.pi - turn), half, rim) for rim in beams.rim_mm])
    x, y = rims * np.cos(turn), rims * np.sin(turn)
    # the centroid of a figure with the rim r(φ) is ∫ r³ cos φ / 3 over ∫ r² / 2
    middle = 2 * (rims**3 * np.cos(turn)).sum(axis=1) / np.maximum(3 * (rims**2).sum(axis=1), 1e-300)
    x = x - middle[:, None]
    radius, angle = np.hypot(x, y), np.mod(np.arctan2(y, x), 2 * np.pi)
    # `np.interp` sorts the angles of a periodic function
    return np.stack([np.interp(turn, a, r, period=2 * np.pi) for a, r in zip(angle, radius, strict=True)]), turn
