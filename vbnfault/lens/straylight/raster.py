"""Draw bundles of rays on the sensor as irradiance: each cell of a lattice becomes a quadrilateral.

The cells of a bundle's lattice tile the image of the bundle. If the image folds, cells overlap and their light
adds. Each cell is two triangles. Irradiance and rim margin are interpolated between their corners, so that edges
stay crisp between rays. Two kinds of cells are drawn differently: cells smaller than half a pixel are added to the
nearest pixels, and cells where light folds are drawn as points on a cubic surface.

Images with soft edges are drawn on coarser levels of an image pyramid. Sums are of integers, so the bits do not
depend on the order in which threads add.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...core.process.llvm import backend
from .bundles import Spots, lattice_places, rounded
from .pyramid import LEVELS, MARGIN, Canvas, summed

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]

PARTS = ("inner", "edge", "rough")
# (a, b, c) of each part: light with an edge's profile is a + b × calm, light without it c × calm × rise
_SHARES = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, -1.0], [1.0, -1.0, 0.0]])
_UNITS = 2.0**36  # units of the integer sums per unit of irradiance
_MOST = 1e5  # largest irradiance that one ghost adds to a pixel, far beyond white
_SMALL = 0.5  # cells below this many pixels are added to the nearest pixels
EDGE_LOW, EDGE_HIGH = -1.0, 5.0  # range of the profile of a soft edge, in widths of the edge
_EDGE_NODES = 2049
_UNLIKE = 0.05  # ratio of neighbouring areas below which a fold is near
_SMOOTH = 0.5  # change of irradiance over a pixel that still looks smooth
_NARROW_PX = 1.5  # cells narrower than this are drawn by points
_POINTS = 64  # largest number of points along each side of a cell
_WANDER = 1.0  # largest distance of a cell's points beyond its corners, in sizes of the cell
_EDGE_KINDS = 9


@dataclass(frozen=True, kw_only=True, eq=False)
class BundleDrawing:
    """Describe the bundles to draw; every array has one value or row for each drawn bundle.

    The light of a ghost is the sum of three parts (`PARTS`), and each part has a separate level. `inner`
    rises smoothly from the rims over the ramp. `edge` is the remaining light. Near folds and steep changes of
    magnification, `rough` replaces both.

    Attributes
    ----------
    source
        Index into the traced bundles.
    level
        Level of the pyramid.
    weight
        float64[bundle, band]: weights in all bands.
    strength
        Irradiance for a `fraction` of 1 without magnification.
    kind
        Kind of the edges' profile, see `edge_profiles`.
    ramp
        Length of the ramp, in widths of the edge.
    rough
        Whether the image is folded or unevenly magnified.
    magnification
        Magnification of lengths that was used to choose the levels.
    inner_level
        Level of the part `inner` of the same ghost.
    part
        Index into `PARTS`.
    """

    source: NDArray[np.int64]
    level: NDArray[np.int64]
    weight: F64
    strength: F64
    kind: NDArray[np.int64]
    ramp: F64
    rough: NDArray[np.bool_]
    magnification: F64
    inner_level: NDArray[np.int64]
    part: NDArray[np.int64]


@lru_cache(maxsize=1)
def edge_profiles() -> F32:
    """Return the relative irradiance across a soft edge, float32[kind, node].

    Nodes run from `EDGE_LOW` to `EDGE_HIGH` widths into the light. The width is the root of the sum of squares of
    two widths: the Sun's (the radius of its disc) and Fresnel's. For kind k, the arc tangent of Fresnel's width
    over the Sun's width is k / 8 of 90°. Kind 0 is the visible fraction of a uniform disc; kind 8 is the
    diffraction pattern of a straight edge, I = ((C + ½)² + (S + ½)²) / 2.
    """
    from scipy.special import fresnel

    s = np.linspace(EDGE_LOW, EDGE_HIGH, _EDGE_NODES)
    fade = np.clip((EDGE_HIGH - s) / (EDGE_HIGH - 3), 0, 1)
    out = np.empty((_EDGE_KINDS, len(s)))
    inside = np.clip(s, -1, 1)
    out[0] = 0.5 + (inside * np.sqrt(1 - inside**2) + np.arcsin(inside)) / np.pi
    for k in range(1, _EDGE_KINDS):
        angle = k / (_EDGE_KINDS - 1) * np.pi / 2
        # Sample the disc by parallel chords; the weight of a chord is the area that it represents. With a narrower
        # disc fewer are enough: 512 change no value by more than its last digit.
        chords = max(512 >> k, 16)
        ring = np.cos(np.pi * (np.arange(chords) + 0.5) / chords)
        weight = (1 - ring**2) / (1 - ring**2).sum()
        v = (s[:, None] - np.cos(angle) * ring) / np.sin(angle)
        sine, cosine = fresnel(v)
        # fade the outermost fringes, because the width of a band makes them invisible
        out[k] = 1 + ((((cosine + 0.5) ** 2 + (sine + 0.5) ** 2) / 2) @ weight - 1) * fade
    out[:, 0], out[:, -1] = 0, 1  # values beyond the ends of the table
    return out.astype(np.float32)


def edge_kind(sun: F64, fresnel_: F64) -> NDArray[np.int64]:
    """Return the kind of profile nearest to a ratio of widths."""
    return np.rint(np.arctan2(fresnel_, sun) / (np.pi / 2) * (_EDGE_KINDS - 1)).astype(np.int64)


class Sums:
    """Add up irradiance as integers, in all levels and bands."""

    def __init__(self, canvas: Canvas) -> None:
        self.canvas = canvas
        be = backend()
        self._total = be.dr.zeros(be.UInt64, int(canvas.starts[-1]))

    def draw(self, spots: Spots, placement: BundleDrawing, azimuth_rad: float) -> None:
        """Add bundles of rays on lattices, turned to the Sun's azimuth."""
        lattice = _Lattice(self.canvas, _Traced(spots), placement, azimuth_rad)
        filled, folded = (np.flatnonzero(v.numpy()) for v in lattice.cells().drawn())
        if len(filled):
            self._fill(lattice.cells(filled))
        if len(folded):
            self._splat(lattice.cells(folded))

    def _fill(self, cells: _Cells) -> None:
        """Draw cells as pairs of triangles; add small cells to the pixels nearest to their middle."""
        be = backend()
        dr, Float, Int32, UInt32 = be.dr, be.Float, be.Int32, be.UInt32
        ends = cells.ends()
        densities, factors, offsets, _ = ends
        first, last = cells.pixel_rows(ends)
        a, b, c, d = (
            (x, y, density, margin, factor, offset)
            for (x, y, _, margin), density, factor, offset in zip(
                cells.corners, densities, factors, offsets, strict=True
            )
        )
        triangles = (_Triangle(a, b, c), _Triangle(a, c, d))
        profile = cells.profile()

        def shade(margin: Any, factor: Any, offset: Any) -> Any:
            """Return the factor that edge and part apply to the irradiance."""
            return dr.fma(profile(margin), factor, offset)

        margins = [corner[3] for corner in cells.corners]
        splat = sum(corner[2] for corner in cells.corners) * 0.25 * cells.light
        splat = splat * shade(*(sum(four) * 0.25 for four in (margins, factors, offsets)))
        add, width, small = self._adder(cells), UInt32(cells.width), cells.small

        def more(_x: Any, y: Any, _end: Any) -> Any:
            """Return whether rows of the cell remain."""
            return y <= last

        def pixel(x: Any, y: Any, end: Any) -> Any:
            """Add one pixel, and return the next one of the cell."""
            here = x <= end
            values_there = [Float(0), Float(EDGE_LOW), Float(0), Float(0)]
            for triangle in triangles:
                inside, *values = triangle.values_at(x + 0.5, y + 0.5)
                values_there = [dr.select(inside, new, old) for new, old in zip(values, values_there, strict=True)]
            tent = dr.maximum(1 - dr.abs(x + 0.5 - cells.middle[0]), 0)
            tent = tent * dr.maximum(1 - dr.abs(y + 0.5 - cells.middle[1]), 0)
            value = dr.select(small, tent * splat, values_there[0] * shade(*values_there[1:]))
            index, shown = UInt32(Int32(y)) * width + UInt32(Int32(x)), here & (value != 0)
            add(value, index, shown)
            down = x >= end
            y = dr.select(down, y + 1, y)
            low, high = cells.columns(y)
            return dr.select(down, low, x + 1), y, dr.select(down, high, end)

        low, high = cells.columns(first)
        dr.while_loop((low, first, high), more, pixel, mode="symbolic")
        dr.eval(self._total)

    def _splat(self, cells: _Cells) -> None:
        """Draw cells as points that are closer together than pixels.

        This is for cells in which light folds, because their corners do not describe their surface.
        """
        be = backend()
        dr, Float, Int32, UInt32 = be.dr, be.Float, be.Int32, be.UInt32
        across, down = cells.points_along()
        number, columns = UInt32(across * down), UInt32(across)
        profile, add, width = cells.profile(), self._adder(cells), UInt32(cells.width)
        _, factors, _, _ = cells.ends()
        light = cells.light / (across * down)
        (xa, ya, sa, ma), (xb, yb, sb, mb), (xc, yc, sc, mc), (xd, yd, sd, md) = cells.corners
        fa, fb, fc, fd = factors
        bends = cells.bends()

        def on(point: Any) -> Any:
            return point < number

        def add_point(point: Any) -> Any:
            """Add one point of the cell."""
            row = UInt32((Float(point) + 0.5) / across)
            u, v = (Float(point - row * columns) + 0.5) / across, (Float(row) + 0.5) / down

            def between(a: Any, b: Any, c: Any, d: Any) -> Any:
                """Interpolate bilinearly between the corners."""
                return dr.lerp(dr.lerp(a, b, u), dr.lerp(d, c, u), v)

            # Lagrange's cubic along each side
            along = [u * (1 - u) * (-1 / 6) * k for k in (2 - u, 1 + u)]
            aside = [v * (1 - v) * (-1 / 6) * k for k in (2 - v, 1 + v)]
            position = []
            for corners, (bent_u, bent_v) in zip(((xa, xb, xc, xd), (ya, yb, yc, yd)), bends, strict=True):
                a, b, c, d = bent_u
                bow = dr.fma(along[0], dr.lerp(a, d, v), along[1] * dr.lerp(b, c, v))
                a, b, c, d = bent_v
                bow = bow + dr.fma(aside[0], dr.lerp(a, b, u), aside[1] * dr.lerp(d, c, u))
                position.append(between(*corners) + bow - 0.5)
            value = light * between(sa, sb, sc, sd) * between(fa, fb, fc, fd) * profile(between(ma, mb, mc, md))
            x, y = (dr.clip(p, -10, 1e5) for p in position)
            left, top = dr.floor(x), dr.floor(y)
            right_part, low_part = x - left, y - top
            for dx, dy in _CORNERS:
                fraction = (right_part if dx else 1 - right_part) * (low_part if dy else 1 - low_part)
                px, py = left + dx, top + dy
                inside = (px >= 0) & (py >= 0) & (px < cells.width) & (py < cells.height) & (value != 0)
                add(value * fraction, UInt32(Int32(py)) * width + UInt32(Int32(px)), inside)
            return (point + 1,)

        dr.while_loop((dr.zeros(UInt32, dr.width(number)),), on, add_point, mode="symbolic")
        dr.eval(self._total)

    def _adder(self, cells: _Cells) -> Any:
        """Return a function that adds irradiance to a pixel, in the level and bands of the cell's bundle."""
        be = backend()
        dr, lattice, placement, total = be.dr, cells.lattice, cells.lattice.placement, self._total
        number = lattice.bands
        start = cells.given(lattice.start, be.UInt32)
        weights = [cells.given(column * _UNITS) for column in placement.weight.T]

        def add(value: Any, pixel: Any, shown: Any) -> None:
            value, first = dr.clip(value, -_MOST, _MOST), start + pixel * number
            for band, weight in enumerate(weights):
                # negative numbers wrap around, and wrap back when they are read as signed
                units = be.UInt64(be.Int64(dr.round(value * weight)))
                # the lanes of a vector rarely add to the same pixel, so they are not summed beforehand
                dr.scatter_add(total, units, first + band, shown & (weight > 0), mode=dr.ReduceMode.Direct)

        return add

    def irradiance(self) -> F32:
        """Return the sum of all levels, float32[band, y, x]."""
        # the bands of a pixel are neighbours
        canvas, total = self.canvas, self._total.numpy().view(np.int64)
        levels = [
            total[canvas.starts[level] : canvas.starts[level + 1]]
            .reshape(*canvas.sizes[level], canvas.bands)
            .transpose(2, 0, 1)
            for level in range(LEVELS)
        ]
        return summed(canvas, levels, 1 / _UNITS)


class _Triangle:
    """Interpolate values in a triangle; each corner is (x, y, *values)."""

    def __init__(self, *corners: tuple[Any, ...]) -> None:
        dr = backend().dr
        self._corners = corners
        a, b, c = corners
        twice = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
        self._sign = dr.select(twice >= 0, 1.0, -1.0)
        self._per_area = dr.rcp(dr.maximum(dr.abs(twice), 1e-12))
        self._edges = tuple(_edge(p, q) for p, q in ((b, c), (c, a), (a, b)))

    def values_at(self, x: Any, y: Any) -> tuple[Any, ...]:
        """Return whether a point lies inside, and the values there."""
        dr = backend().dr
        inside, values = None, [0.0] * (len(self._corners[0]) - 2)
        for (ox, oy, ux, uy, flip), corner in zip(self._edges, self._corners, strict=True):
            fraction = (ux * (y - oy) - uy * (x - ox)) * (flip * self._sign)
            # a point on an edge belongs to the triangle to the left of the edge, as `_edge` reads it
            here = (fraction > 0) | ((fraction == 0) & (flip * self._sign > 0))
            inside = here if inside is None else inside & here
            # the area of a sliver may be all rounding error
            weight = dr.clip(fraction * self._per_area, 0, 1)
            values = [dr.fma(weight, more, value) for value, more in zip(values, corner[2:], strict=True)]
        return inside, *values


def _edge(p: tuple[Any, ...], q: tuple[Any, ...]) -> tuple[Any, ...]:
    """Return an edge that starts at its smaller end, and the sign that applies to the direction p → q.

    Two triangles with this edge in common then test a point with the same numbers.
    """
    dr = backend().dr
    ordered = (p[0] < q[0]) | ((p[0] == q[0]) & (p[1] < q[1]))
    ox, oy = dr.select(ordered, p[0], q[0]), dr.select(ordered, p[1], q[1])
    ex, ey = dr.select(ordered, q[0], p[0]), dr.select(ordered, q[1], p[1])
    return ox, oy, ex - ox, ey - oy, dr.select(ordered, 1.0, -1.0)


_CORNERS = ((0, 0), (1, 0), (1, 1), (0, 1))
_NO_AREA = 3e38
_WHOLE = -1e5  # only rays that do not reach the sensor have a margin below this
_OUTWARDS = ((-1, -1), (1, -1), (1, 1), (-1, 1))


class _Traced:
    """Compute how the cells of traced lattices are magnified, and how they bend."""

    def __init__(self, spots: Spots) -> None:
        be = backend()
        self.spots, self.across = spots, spots.across
        rays, cells = self.across**2, (self.across - 1) ** 2
        self.first_ray, self.first_cell = np.cumsum(rays) - rays, np.cumsum(cells) - cells
        self._first_ray = be.UInt32(self.first_ray.astype(np.uint32))
        # mean area of a cell at the entrance
        self.entrance_mm2 = 4 * spots.rays.box_mm[:, 2:].prod(axis=1) / (self.across - 1) ** 2
        self.magnified = self._magnified()

    def entrance(self, bundle: Any, ix: Any, iy: Any, side: Any) -> Any:
        """Return the area of cells at the entrance over the area of a cell in a rectangular lattice."""
        be = backend()
        dr, disc = be.dr, self.spots.rays.disc
        if disc is None:
            return dr.full(be.Float, 1, dr.width(ix))
        of = dr.gather(be.Float, be.Float(disc.astype(np.float32)), bundle)
        step = 2 / be.Float(side)
        corners = [
            rounded((be.Float(ix) + dx) * step - 1, (be.Float(iy) + dy) * step - 1, of) for dx, dy in _CORNERS
        ]
        return _area(*corners) / (step * step)

    def _magnified(self) -> Any:
        """Return the signed magnification of area of every cell, `_NO_AREA` beside a lost ray."""
        be = backend()
        dr, spots = be.dr, self.spots
        bundle, ix, iy, side = lattice_places(self.across - 1, self.across - 1)
        first = dr.gather(be.UInt32, self._first_ray, bundle) + iy * (side + 1) + ix
        corners = [first + dx + dy * (side + 1) for dx, dy in _CORNERS]
        x, y, margins = (
            [dr.gather(be.Float, v, k) for k in corners] for v in (spots.x_mm, spots.y_mm, spots.margin)
        )
        mean = dr.gather(be.Float, be.Float(self.entrance_mm2.astype(np.float32)), bundle)
        area = _area(*zip(x, y, strict=True)) / (mean * dr.maximum(self.entrance(bundle, ix, iy, side), 1e-6))
        out = dr.select(_least(*margins) > _WHOLE, area, _NO_AREA)
        dr.eval(out)
        return out

    @cached_property
    def bends_mm(self) -> tuple[tuple[Any, Any], tuple[Any, Any]]:
        """Return second differences at every ray, of x and of y, along rows and along columns.

        They are 0 at the ends of a lattice and beside a lost ray.
        """
        be = backend()
        dr, spots = be.dr, self.spots
        _, ix, iy, side = lattice_places(self.across, self.across)
        here = dr.arange(be.UInt32, int((self.across**2).sum()))
        bends: list[list[Any]] = [[], []]
        for position, step in ((ix, be.UInt32(1)), (iy, side)):
            inside = (position > 0) & (position < side - 1)
            before, behind = (dr.select(inside, k, here) for k in (here - step, here + step))
            kept = [dr.gather(be.Float, spots.margin, k) > _WHOLE for k in (before, here, behind)]
            for of, values in zip(bends, (spots.x_mm, spots.y_mm), strict=True):
                first, second, third = (dr.gather(be.Float, values, k) for k in (before, here, behind))
                of.append(dr.select(inside & kept[0] & kept[1] & kept[2], first - 2 * second + third, 0))
        dr.eval(bends)
        return (bends[0][0], bends[0][1]), (bends[1][0], bends[1][1])


class _Lattice:
    """Hold the cells of the bundles that are drawn, in pixels of their level."""

    def __init__(self, canvas: Canvas, traced: _Traced, placement: BundleDrawing, azimuth_rad: float) -> None:
        self.traced, self.spots, self.placement = traced, traced.spots, placement
        self.turn = np.cos(azimuth_rad), np.sin(azimuth_rad)
        step = 2.0**placement.level
        self.per_mm = 1 / (canvas.pitch_mm * step)
        self.middle = [n / 2 / step + MARGIN for n in canvas.shape[::-1]]
        self.sides = canvas.sizes[placement.level]
        self.size = self.sides.prod(axis=1)
        self.start = canvas.starts[placement.level]
        self.across, self.first_ray, self.first_cell = (
            v[placement.source] for v in (traced.across, traced.first_ray, traced.first_cell)
        )
        # light of a mean cell for a `fraction` of 1, in irradiance × pixels of the level
        self.entrance_mm2 = traced.entrance_mm2[placement.source]
        self.light = self.entrance_mm2 * placement.strength * self.per_mm**2
        self.numbers = lattice_places(self.across - 1, self.across - 1)
        self.bands = canvas.bands

    def cells(self, index: NDArray[np.intp] | None = None) -> _Cells:
        """Return all cells, or those at an index."""
        return _Cells(self, None if index is None else backend().UInt32(index.astype(np.uint32)))


class _Cells:
    """Hold some cells, one in each lane: corners (x, y, fraction, margin), area, and values of their bundle."""

    def __init__(self, lattice: _Lattice, index: Any) -> None:
        be = backend()
        dr, Float, UInt32 = be.dr, be.Float, be.UInt32
        self.lattice = lattice
        numbers = lattice.numbers
        if index is not None:
            dr.eval(*numbers)
            numbers = tuple(dr.gather(UInt32, v, index) if dr.width(v) > 1 else v for v in numbers)
        self.bundle, self.ix, self.iy, self.side = numbers
        across = self.side + 1
        first = self.given(lattice.first_ray, UInt32) + self.iy * across + self.ix
        self.rays = [first + dx + (across if dy else 0) for dx, dy in _CORNERS]
        self.first_cell = self.given(lattice.first_cell, UInt32)
        cos, sin = (dr.opaque(Float, v) for v in lattice.turn)
        scale = self.scale = self.given(lattice.per_mm)
        middle_x, middle_y = (self.given(v) for v in lattice.middle)
        source = self.given(lattice.placement.source, UInt32)
        self.light = self.given(lattice.light) * lattice.traced.entrance(source, self.ix, self.iy, self.side)
        self.height, self.width = (self.given(lattice.sides[:, k]) for k in (0, 1))
        spots = lattice.spots
        x, y, fraction, margin = (
            [dr.gather(Float, v, ray) for ray in self.rays]
            for v in (spots.x_mm, spots.y_mm, spots.fraction, spots.margin)
        )
        self.valid = _least(*margin) > _WHOLE
        x, y = (
            [dr.fma(a * cos - b * sin, scale, middle_x) for a, b in zip(x, y, strict=True)],
            [dr.fma(a * sin + b * cos, scale, middle_y) for a, b in zip(x, y, strict=True)],
        )
        self.corners = list(zip(x, y, fraction, margin, strict=True))
        (xa, xb, xc, xd), (ya, yb, yc, yd) = x, y
        self.area = dr.abs(_area(*zip(x, y, strict=True)))
        self.own = dr.gather(Float, lattice.traced.magnified, self.first_cell + self.iy * self.side + self.ix)
        self.low = _least(xa, xb, xc, xd), _least(ya, yb, yc, yd)
        self.high = _most(xa, xb, xc, xd), _most(ya, yb, yc, yd)
        self.small = dr.maximum(self.high[0] - self.low[0], self.high[1] - self.low[1]) < _SMALL
        self.middle = (xa + xb + xc + xd) * 0.25, (ya + yb + yc + yd) * 0.25

    def given(self, values: Any, kind: Any = None) -> Any:
        """Return each cell's value from values by bundle."""
        be = backend()
        kind = be.Float if kind is None else kind
        dtype = np.float32 if kind is be.Float else np.uint32
        return be.dr.gather(kind, kind(np.ascontiguousarray(values, dtype=dtype)), self.bundle)

    def drawn(self) -> tuple[Any, Any]:
        """Return which cells are drawn as triangles, and which by points.

        Cells without light in the part that is drawn are neither. Only cells whose light may reach the frame are
        drawn by points.
        """
        ends = self.ends()
        filled, folds = self.pixel_rows(ends)[1] >= 0, ends[3] & self._near_and_lit(ends[1])
        backend().dr.eval(filled, folds)
        return filled, folds

    def _near_and_lit(self, factors: list[Any]) -> Any:
        """Return which cells have light in the drawn part that may reach the frame if it is drawn by points."""
        far = _WANDER * (self.high[0] - self.low[0] + self.high[1] - self.low[1]) + 2
        near = (self.high[0] > -far) & (self.low[0] < self.width + far)
        near &= (self.high[1] > -far) & (self.low[1] < self.height + far)
        return near & self.valid & (_most(*factors) > 0) & (_most(*(c[3] for c in self.corners)) > EDGE_LOW)

    def points_along(self) -> tuple[Any, Any]:
        """Return the numbers of points along both sides, at which points are no farther apart than pixels."""
        dr = backend().dr
        a, b, c, d = self.corners
        (xu, xv), (yu, yv) = self.bends()
        out = []
        for sides, bends in ((((a, b), (d, c)), (xu, yu)), (((a, d), (b, c)), (xv, yv))):
            longest = _most(*(dr.abs(q[k] - p[k]) for p, q in sides for k in (0, 1)))
            # a side with the second difference s has end steps that are longer by s / 2
            bow = dr.maximum(*(_most(*(dr.abs(s) for s in bent)) for bent in bends))
            out.append(dr.clip(dr.ceil(longest + 0.5 * bow), 1, _POINTS))
        return out[0], out[1]

    def bends(self) -> tuple[tuple[list[Any], list[Any]], tuple[list[Any], list[Any]]]:
        """Return second differences of x and of y along rows and along columns at the corners, in pixels."""
        be = backend()
        dr = be.dr
        (xu, xv), (yu, yv) = (
            [[dr.gather(be.Float, v, ray) for ray in self.rays] for v in pair]
            for pair in self.lattice.traced.bends_mm
        )
        cos, sin = (dr.opaque(be.Float, v) * self.scale for v in self.lattice.turn)
        x_bends = tuple([x * cos - y * sin for x, y in zip(*of, strict=True)] for of in ((xu, yu), (xv, yv)))
        y_bends = tuple([x * sin + y * cos for x, y in zip(*of, strict=True)] for of in ((xu, yu), (xv, yv)))
        return x_bends, y_bends  # type: ignore[return-value]

    def profile(self) -> Any:
        """Return a function of the margin: the light across a soft edge of the cell's bundle."""
        be = backend()
        dr = be.dr
        table = be.Float(edge_profiles().ravel())
        edge = self.given(self.lattice.placement.kind * _EDGE_NODES, be.UInt32)
        nodes = (_EDGE_NODES - 1) / (EDGE_HIGH - EDGE_LOW)

        def light_at(margin: Any) -> Any:
            node = be.UInt32(dr.clip(dr.fma(margin, nodes, 0.5 - EDGE_LOW * nodes), 0, _EDGE_NODES - 1))
            return dr.gather(be.Float, table, edge + node)

        return light_at

    def pixel_rows(self, ends: tuple[Any, ...]) -> tuple[Any, Any]:
        """Return the first and last row of pixels whose centres may lie in a cell.

        The last row is -1 for cells without light in the part that is drawn, and for those that fold.
        """
        _, factors, offsets, folds = ends
        dr = backend().dr
        margins = [corner[3] for corner in self.corners]
        # beyond the fringes of an edge its profile is 1, so that only the sum of factor and offset counts
        plain = _least(*margins) > EDGE_HIGH
        drawn = [
            dr.select(plain, dr.abs(factor + offset), dr.maximum(dr.abs(factor), dr.abs(offset)))
            for factor, offset in zip(factors, offsets, strict=True)
        ]
        lit = self.valid & ~folds & (_most(*drawn) > 0) & (_most(*margins) > EDGE_LOW)
        lit &= (self.high[0] > 0) & (self.low[0] < self.width)
        start = dr.select(self.small, dr.floor(self.middle[1] - 0.5), dr.ceil(self.low[1] - 0.5))
        last = dr.select(self.small, start + 1, dr.floor(self.high[1] - 0.5))
        start, last = dr.maximum(start, 0), dr.minimum(last, self.height - 1)
        lit &= last >= start
        return start, dr.select(lit, last, -1)

    def columns(self, row: Any) -> tuple[Any, Any]:
        """Return the first and last column whose pixel centres may lie in a cell, in a row of pixels."""
        dr = backend().dr
        y = row + 0.5
        low, high = 1e9, -1e9
        for (px, py, *_), (qx, qy, *_) in itertools.pairwise((*self.corners, self.corners[0])):
            crossed = (dr.minimum(py, qy) <= y) & (dr.maximum(py, qy) >= y)
            x = dr.fma(y - py, (qx - px) / dr.select(py == qy, 1, qy - py), px)
            low, high = dr.minimum(low, dr.select(crossed, x, 1e9)), dr.maximum(high, dr.select(crossed, x, -1e9))
        start = dr.select(self.small, dr.floor(self.middle[0] - 0.5), dr.ceil(low - 0.501))
        last = dr.select(self.small, start + 1, dr.floor(high - 0.499))
        return dr.maximum(start, 0), dr.minimum(last, self.width - 1)

    def ends(self) -> tuple[list[Any], list[Any], list[Any], Any]:
        """Return the values of the drawn part at the four corners, and whether a cell is drawn by points.

        The values are the irradiance without edges, the fraction of light with an edge's profile (factor), and the
        fraction without (offset). Rough cells that fold or are narrow are drawn by points.
        """
        dr, placement = backend().dr, self.lattice.placement
        per_ramp, even = self.given(1 / placement.ramp), self.given(~placement.rough)
        # largest difference of neighbours, times their width, that looks smooth in pixels of the part `inner`
        inner_mm = 2.0 ** (placement.inner_level - placement.level) / self.lattice.per_mm
        usual = np.maximum(placement.magnification, 1e-6)
        coarse = self.given(inner_mm * usual / np.sqrt(self.lattice.entrance_mm2) / _SMOOTH)
        per_usual, strength = self.given(1 / usual**2), self.given(placement.strength)
        rest, with_calm, with_rise = (self.given(column) for column in _SHARES[placement.part].T)
        densities, factors, offsets, leasts = [], [], [], []
        for corner, (sx, sy) in zip(self.corners, _OUTWARDS, strict=True):
            mean, least, most = self._around(sx, sy)
            densities.append(corner[2] * strength / dr.maximum(mean, 1e-9))
            # calm: areas have the same sign, differ little over a pixel, and have at least half the usual
            # magnification
            ratio = least / dr.maximum(most, 1e-18)
            calm = dr.minimum(2 - (1 - ratio) * coarse / dr.maximum(least, 1e-18), ratio / _UNLIKE)
            calm = dr.clip(dr.minimum(calm, 4 * dr.sqrt(mean * per_usual) - 1), even, 1)
            rise = dr.clip(corner[3] * per_ramp, 0, 1)
            rise = rise * rise * (3 - 2 * rise)
            factors.append(dr.fma(with_calm, calm, rest))
            offsets.append(with_rise * calm * rise)
            leasts.append(least)
        size = dr.maximum(self.high[0] - self.low[0], self.high[1] - self.low[1])
        # narrow cells are drawn by points too, because they can lie between pixel centres
        narrow = self.area < _NARROW_PX * size
        folds = (rest > 0) & (size < _POINTS) & ((_least(*leasts) < 0) | narrow)
        return densities, factors, offsets, folds

    def _around(self, sx: int, sy: int) -> tuple[Any, Any, Any]:
        """Return mean, smallest and largest magnification of area of the cells that meet in a corner.

        The mean is that of absolute values. The smallest is positive only if all cells have the sign of this cell.
        """
        be = backend()
        dr, Int32, UInt32 = be.dr, be.Int32, be.UInt32
        own = dr.select(self.valid, self.own, 0)
        sign = dr.select(own < 0, -1.0, 1.0)
        total, number, side = dr.abs(own), be.Float(1), Int32(self.side)
        least, most = dr.abs(own), dr.abs(own)
        for dx, dy in ((sx, 0), (0, sy), (sx, sy)):
            jx, jy = Int32(self.ix) + dx, Int32(self.iy) + dy
            inside = (jx >= 0) & (jy >= 0) & (jx < side) & (jy < side)
            near = dr.gather(
                be.Float, self.lattice.traced.magnified, self.first_cell + UInt32(jy * side + jx), inside
            )
            inside &= near != _NO_AREA
            total, number = total + dr.select(inside, dr.abs(near), 0), number + dr.select(inside, 1, 0)
            least = dr.select(inside, dr.minimum(least, near * sign), least)
            most = dr.select(inside, dr.maximum(most, dr.abs(near)), most)
        return total / number, least, most


def _area(*corners: tuple[Any, Any]) -> Any:
    """Return the signed area of quadrilaterals."""
    (xa, ya), (xb, yb), (xc, yc), (xd, yd) = corners
    return ((xc - xa) * (yd - yb) - (yc - ya) * (xd - xb)) * 0.5


def _least(*values: Any) -> Any:
    """Return the smallest of four values."""
    dr = backend().dr
    return dr.minimum(dr.minimum(values[0], values[1]), dr.minimum(values[2], values[3]))


def _most(*values: Any) -> Any:
    """Return the largest of four values."""
    dr = backend().dr
    return dr.maximum(dr.maximum(values[0], values[1]), dr.maximum(values[2], values[3]))
