"""Bundles of rays on the sensor, as irradiance: grid cells drawn as quadrilaterals, at the resolution they need.

The cells of a bundle's lattice tile its picture; folds overlap and add. Each cell is two triangles whose
irradiance and rim margin are interpolated between corners, so that edges stay crisp between rays; cells smaller
than half a pixel are splatted. Pictures with soft edges go to coarser levels of a pyramid. Sums are of integers:
the bits do not depend on the order in which threads add.
"""

from __future__ import annotations

import itertools
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from .tracer import Spots, backend, lattice_places

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]

LEVELS = 6
PARTS = ("inner", "edge", "rough")
# of each part: the share of light with an edge's profile is a + b × calm, that without c × calm × rise
_SHARES = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, -1.0], [1.0, -1.0, 0.0]])
_MARGIN = 4  # pixels around each level, for what lies half outside
_UNITS = 2.0**36  # of the integer sums, per unit of irradiance
_MOST = 1e5  # irradiance that one ghost may add to a pixel: far beyond white
_CALM_SIGMA = 0.8  # pixels of a coarser level by which it is smoothed
_SMALL = 0.5  # cells below this many pixels are splatted
EDGE_LOW, EDGE_HIGH = -1.0, 5.0  # of the soft edge's profile
_EDGE_NODES = 2049
_UNLIKE, _ALIKE = 0.05, 0.3  # ratio of neighbouring areas from which, and above which, no fold is near
_COARSE_PX = 6.0  # cells of so many pixels of what lies within show it smooth, however unlike they are
_EDGE_KINDS = 9


@dataclass(frozen=True, kw_only=True, eq=False)
class Canvas:
    """A sensor of `shape` (height, width) pixels of `pitch_mm`, its middle on the axis, in `bands` bands."""

    shape: tuple[int, int]
    pitch_mm: float
    bands: int

    @property
    def sizes(self) -> NDArray[np.int64]:
        """Height and width of each level with its margins, int64[level, 2]."""
        return np.array([[-(-n // 2**k) + 2 * _MARGIN for n in self.shape] for k in range(LEVELS)])

    @property
    def starts(self) -> NDArray[np.int64]:
        """Where each level's bands begin, and the end."""
        return np.concatenate([[0], np.cumsum(self.sizes.prod(axis=1) * self.bands)])


@dataclass(frozen=True, kw_only=True, eq=False)
class Placement:
    """Which bundles are drawn, and how.

    `source`: which of the traced bundles. Of each its `level`; two bands with their weights, int64 and
    float64[bundle, 2]; `strength`, irradiance for a share of 1 where nothing is magnified; the `kind` of its edges;
    `box_mm` of its rays; `ramp`, in widths of its edge; whether it is `rough`, folded or unevenly magnified; the
    `magnification` of lengths that its levels are made for; and `inner_level`, that of the first of three parts of
    the light that add up. `part`, an index of `PARTS`, says which: `inner` rises smoothly over the ramp from the
    rims, `edge` is the rest, but near folds and where light is crowded all is `rough`.
    """

    source: NDArray[np.int64]
    level: NDArray[np.int64]
    band: NDArray[np.int64]
    weight: F64
    strength: F64
    kind: NDArray[np.int64]
    box_mm: F64
    ramp: F64
    rough: NDArray[np.bool_]
    magnification: F64
    inner_level: NDArray[np.int64]
    part: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.level)


@lru_cache(maxsize=1)
def edge_profiles() -> F32:
    """Light across a soft edge, float32[kind, node]: node from `EDGE_LOW` to `EDGE_HIGH` widths into the light.

    The width is the root of the squares of the Sun's (its disc's radius) and of Fresnel's; kind k of 8 has their
    ratio's arc tangent at k / 8 of 90°: 0 is the share of a uniform disc, 8 the pattern of a straight edge,
    I = ((C + ½)² + (S + ½)²) / 2.
    """
    from scipy.special import fresnel

    s = np.linspace(EDGE_LOW, EDGE_HIGH, _EDGE_NODES)
    # points of the disc, by chords of equal weight
    ring = np.cos(np.pi * (np.arange(512) + 0.5) / 512)
    chord = np.sqrt(1 - ring**2)
    weight = chord * np.sqrt(1 - ring**2)
    weight /= weight.sum()
    fade = np.clip((EDGE_HIGH - s) / (EDGE_HIGH - 3), 0, 1)
    out = np.empty((_EDGE_KINDS, len(s)))
    inside = np.clip(s, -1, 1)
    out[0] = 0.5 + (inside * np.sqrt(1 - inside**2) + np.arcsin(inside)) / np.pi
    for k in range(1, _EDGE_KINDS):
        angle = k / (_EDGE_KINDS - 1) * np.pi / 2
        v = (s[:, None] - np.cos(angle) * ring) / np.sin(angle)
        sine, cosine = fresnel(v)
        # the last rings fade: they are those that a band's width washes out
        out[k] = 1 + ((((cosine + 0.5) ** 2 + (sine + 0.5) ** 2) / 2) @ weight - 1) * fade
    out[:, 0], out[:, -1] = 0, 1  # beyond the table's ends
    return out.astype(np.float32)


def edge_kind(sun: F64, fresnel_: F64) -> NDArray[np.int64]:
    """The profile for a ratio of widths."""
    return np.rint(np.arctan2(fresnel_, sun) / (np.pi / 2) * (_EDGE_KINDS - 1)).astype(np.int64)


class Sums:
    """Integer sums of all levels and bands."""

    def __init__(self, canvas: Canvas) -> None:
        self.canvas = canvas
        be = backend()
        self._total = be.dr.zeros(be.UInt64, int(canvas.starts[-1]))

    def draw(self, spots: Spots, placement: Placement, azimuth_rad: float) -> None:
        """Add bundles of rays on lattices, turned by the Sun's azimuth."""
        be = backend()
        lattice = _Lattice(self.canvas, spots, placement, azimuth_rad)
        cells = lattice.cells()
        number = cells.pixels(*cells.ends()[1:])[2]
        # neighbours in the vector unit wait for one another: cells of one size go together
        size = np.minimum(number.numpy(), 65535).astype(np.uint16)
        order = np.argsort(size, kind="stable")[np.count_nonzero(size == 0) :]
        if len(order):
            self._fill(lattice.cells(be.UInt32(order.astype(np.uint32))))

    def _fill(self, cells: _Cells) -> None:
        be = backend()
        dr, Float, Int32, UInt32 = be.dr, be.Float, be.Int32, be.UInt32
        lattice, placement = cells.lattice, cells.lattice.placement
        densities, factors, offsets = cells.ends()
        first, last, _ = cells.pixels(factors, offsets)
        a, b, c, d = (
            (x, y, density, margin, factor, offset)
            for (x, y, _, margin), density, factor, offset in zip(
                cells.corners, densities, factors, offsets, strict=True
            )
        )
        triangles = (_Triangle(a, b, c), _Triangle(a, c, d))
        profile = Float(edge_profiles().ravel())
        edge = cells.given(placement.kind * _EDGE_NODES, UInt32)
        nodes = (_EDGE_NODES - 1) / (EDGE_HIGH - EDGE_LOW)

        def shade(margin: Any, factor: Any, offset: Any) -> Any:
            node = UInt32(dr.clip(dr.fma(margin, nodes, 0.5 - EDGE_LOW * nodes), 0, _EDGE_NODES - 1))
            return dr.fma(dr.gather(Float, profile, edge + node), factor, offset)

        margins = [corner[3] for corner in cells.corners]
        splat = sum(corner[2] for corner in cells.corners) * 0.25 * cells.energy
        splat = splat * shade(*(sum(four) * 0.25 for four in (margins, factors, offsets)))
        base, second = (cells.given(lattice.start + placement.band[:, k] * lattice.size, UInt32) for k in (0, 1))
        weight, other = (cells.given(placement.weight[:, k] * _UNITS) for k in (0, 1))
        width, small, total = UInt32(cells.width), cells.small, self._total
        twice = bool((placement.weight[:, 1] > 0).any())

        def more(_x: Any, y: Any, _end: Any) -> Any:
            return y <= last

        def pixel(x: Any, y: Any, end: Any) -> Any:
            here = x <= end
            found = [Float(0), Float(EDGE_LOW), Float(0), Float(0)]
            for triangle in triangles:
                inside, *values = triangle.at(x + 0.5, y + 0.5)
                found = [dr.select(inside, new, old) for new, old in zip(values, found, strict=True)]
            tent = dr.maximum(1 - dr.abs(x + 0.5 - cells.middle[0]), 0)
            tent = tent * dr.maximum(1 - dr.abs(y + 0.5 - cells.middle[1]), 0)
            value = dr.select(small, tent * splat, found[0] * shade(*found[1:]))
            at, shown = UInt32(Int32(y)) * width + UInt32(Int32(x)), here & (value != 0)
            for start, share in ((base, weight), (second, other))[: 1 + twice]:
                # negative numbers wrap around, and back when read
                units = be.UInt64(be.Int64(dr.round(dr.clip(value, -_MOST, _MOST) * share)))
                dr.scatter_add(total, units, start + at, shown & (share > 0), mode=dr.ReduceMode.Auto)
            down = x >= end
            y = dr.select(down, y + 1, y)
            low, high = cells.columns(y)
            return dr.select(down, low, x + 1), y, dr.select(down, high, end)

        low, high = cells.columns(first)
        dr.while_loop((low, first, high), more, pixel, mode="symbolic")
        dr.eval(total)

    def irradiance(self) -> F32:
        """float32[band, y, x]: the levels laid over one another."""
        canvas, total = self.canvas, self._total.numpy().view(np.int64)
        out = np.empty((canvas.bands, *canvas.shape), dtype=np.float32)

        def one(band: int) -> None:
            below: F32 | None = None
            for level in range(LEVELS - 1, -1, -1):
                height, width = (int(v) for v in canvas.sizes[level])
                first = canvas.starts[level] + band * height * width
                part = total[first : first + height * width].reshape(height, width)
                here = np.multiply(part, 1 / _UNITS, dtype=np.float32)
                if below is not None:
                    # folds end in steps, which a lattice of pixel centres samples unevenly
                    calm = cv2.GaussianBlur(below, (3, 3), _CALM_SIGMA)
                    bigger = cv2.resize(calm, None, fx=2, fy=2, interpolation=cv2.INTER_LINEAR)
                    # a level's pixel 0 covers the pixels -M·2 + M and the next one of the finer level
                    here += bigger[_MARGIN : _MARGIN + height, _MARGIN : _MARGIN + width]
                below = here
            assert below is not None
            rows, columns = (slice(_MARGIN, _MARGIN + n) for n in canvas.shape)
            # the parts that add up meet on lattices of their own: where little is left of much it may be below
            # nothing
            np.maximum(below[rows, columns], 0, out=out[band])

        # numpy and OpenCV let go of the interpreter
        with ThreadPoolExecutor(backend().dr.thread_count()) as pool:
            list(pool.map(one, range(canvas.bands)))
        return out


class _Triangle:
    """A triangle with values at its corners, each of which is (x, y, *values)."""

    def __init__(self, *corners: tuple[Any, ...]) -> None:
        dr = backend().dr
        self._corners = corners
        a, b, c = corners
        twice = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
        self._sign = dr.select(twice >= 0, 1.0, -1.0)
        self._per_area = dr.rcp(dr.maximum(dr.abs(twice), 1e-12))
        self._edges = tuple(_edge(p, q) for p, q in ((b, c), (c, a), (a, b)))

    def at(self, x: Any, y: Any) -> tuple[Any, ...]:
        """Whether a point lies inside, and the values there."""
        dr = backend().dr
        inside, values = None, [0.0] * (len(self._corners[0]) - 2)
        for (ox, oy, ux, uy, flip), corner in zip(self._edges, self._corners, strict=True):
            share = (ux * (y - oy) - uy * (x - ox)) * (flip * self._sign)
            # a point on an edge belongs to the side that the edge, always read the same way, has on its left
            here = (share > 0) | ((share == 0) & (flip * self._sign > 0))
            inside = here if inside is None else inside & here
            # of a sliver's area little but rounding may be left
            weight = dr.clip(share * self._per_area, 0, 1)
            values = [dr.fma(weight, more, value) for value, more in zip(values, corner[2:], strict=True)]
        return inside, *values


def _edge(p: tuple[Any, ...], q: tuple[Any, ...]) -> tuple[Any, ...]:
    """An edge read from its lesser end, so that two triangles judge it by the same numbers; the sign for p → q."""
    dr = backend().dr
    ordered = (p[0] < q[0]) | ((p[0] == q[0]) & (p[1] < q[1]))
    ox, oy = dr.select(ordered, p[0], q[0]), dr.select(ordered, p[1], q[1])
    ex, ey = dr.select(ordered, q[0], p[0]), dr.select(ordered, q[1], p[1])
    return ox, oy, ex - ox, ey - oy, dr.select(ordered, 1.0, -1.0)


_CORNERS = ((0, 0), (1, 0), (1, 1), (0, 1))
_NO_AREA = 3e38
_WHOLE = -1e5  # margins below are those of lost rays
_OUTWARDS = ((-1, -1), (1, -1), (1, 1), (-1, 1))


class _Lattice:
    """The cells of bundles on the sensor, in pixels of their level."""

    def __init__(self, canvas: Canvas, spots: Spots, placement: Placement, azimuth_rad: float) -> None:
        self.spots, self.placement = spots, placement
        self.turn = np.cos(azimuth_rad), np.sin(azimuth_rad)
        step = 2.0**placement.level
        self.per_mm = 1 / (canvas.pitch_mm * step)
        self.middle = [n / 2 / step + _MARGIN for n in canvas.shape[::-1]]
        self.sides = canvas.sizes[placement.level]
        self.size = self.sides.prod(axis=1)
        self.start = canvas.starts[placement.level]
        rays, cells = spots.across**2, (spots.across - 1) ** 2
        self.across = spots.across[placement.source]
        self.first_ray = (np.cumsum(rays) - rays)[placement.source]
        self.first_cell = (np.cumsum(cells) - cells)[placement.source]
        # light of a cell for a share of 1, in irradiance times pixels of the level
        at_entrance = placement.box_mm[:, 2] * placement.box_mm[:, 3] * 4 / (self.across - 1) ** 2
        self.energy = at_entrance * placement.strength * self.per_mm**2
        # area of a cell as the levels are made for, mm²
        self.usual_mm2 = np.maximum(at_entrance * placement.magnification**2, 1e-12)
        self.area_mm2 = self._areas()
        self.places = lattice_places(self.across - 1, self.across - 1)

    def _areas(self) -> Any:
        """Signed area of every cell of every bundle that was traced, `_NO_AREA` where a ray was lost."""
        be = backend()
        dr, across = be.dr, self.spots.across
        bundle, ix, iy, side = lattice_places(across - 1, across - 1)
        rays = be.UInt32((np.cumsum(across**2) - across**2).astype(np.uint32))
        first = dr.gather(be.UInt32, rays, bundle) + iy * (side + 1) + ix
        at = [first + dx + dy * (side + 1) for dx, dy in _CORNERS]
        (xa, xb, xc, xd), (ya, yb, yc, yd), margins = (
            [dr.gather(be.Float, v, k) for k in at] for v in (self.spots.x_mm, self.spots.y_mm, self.spots.margin)
        )
        area = ((xc - xa) * (yd - yb) - (yc - ya) * (xd - xb)) * 0.5
        out = dr.select(_least(*margins) > _WHOLE, area, _NO_AREA)
        dr.eval(out)
        return out

    def cells(self, index: Any = None) -> _Cells:
        """All cells, or some."""
        return _Cells(self, index)


class _Cells:
    """Some cells, one a lane: corners (x, y, share, margin), area, and what their bundle says of them."""

    def __init__(self, lattice: _Lattice, index: Any) -> None:
        be = backend()
        dr, Float, UInt32 = be.dr, be.Float, be.UInt32
        self.lattice = lattice
        places = lattice.places
        if index is not None:
            dr.eval(*places)
            places = tuple(dr.gather(UInt32, v, index) if dr.width(v) > 1 else v for v in places)
        self.bundle, self.ix, self.iy, self.side = places
        across = self.side + 1
        first = self.given(lattice.first_ray, UInt32) + self.iy * across + self.ix
        self.first_cell = self.given(lattice.first_cell, UInt32)
        cos, sin = (dr.opaque(Float, v) for v in lattice.turn)
        scale = self.scale = self.given(lattice.per_mm)
        middle_x, middle_y = (self.given(v) for v in lattice.middle)
        self.energy = self.given(lattice.energy)
        self.height, self.width = (self.given(lattice.sides[:, k]) for k in (0, 1))
        self.corners = []
        for dx, dy in _CORNERS:
            at = first + dx + (across if dy else 0)
            x, y, share, margin = (
                dr.gather(Float, v, at)
                for v in (lattice.spots.x_mm, lattice.spots.y_mm, lattice.spots.share, lattice.spots.margin)
            )
            self.corners.append(
                (
                    dr.fma(x * cos - y * sin, scale, middle_x),
                    dr.fma(x * sin + y * cos, scale, middle_y),
                    share,
                    margin,
                )
            )
        (xa, ya, _, ma), (xb, yb, _, mb), (xc, yc, _, mc), (xd, yd, _, md) = self.corners
        self.valid = _least(ma, mb, mc, md) > _WHOLE
        self.own_mm2 = dr.gather(Float, lattice.area_mm2, self.first_cell + self.iy * self.side + self.ix)
        self.low = _least(xa, xb, xc, xd), _least(ya, yb, yc, yd)
        self.high = _most(xa, xb, xc, xd), _most(ya, yb, yc, yd)
        self.small = dr.maximum(self.high[0] - self.low[0], self.high[1] - self.low[1]) < _SMALL
        self.middle = (xa + xb + xc + xd) * 0.25, (ya + yb + yc + yd) * 0.25

    def given(self, values: Any, kind: Any = None) -> Any:
        """What each cell's bundle has."""
        be = backend()
        kind = be.Float if kind is None else kind
        dtype = np.float32 if kind is be.Float else np.uint32
        return be.dr.gather(kind, kind(np.ascontiguousarray(values, dtype=dtype)), self.bundle)

    def pixels(self, factors: list[Any], offsets: list[Any]) -> tuple[Any, Any, Any]:
        """First and last row of pixels whose centres may lie in a cell, and about how many pixels; no row where a
        cell has no part in the light that is drawn."""
        be = backend()
        dr = be.dr
        margins = [corner[3] for corner in self.corners]
        # beyond an edge's ringing its profile is 1, and what factor and offset add to is all there is
        plain = _least(*margins) > EDGE_HIGH
        drawn = [
            dr.select(plain, dr.abs(factor + offset), dr.maximum(dr.abs(factor), dr.abs(offset)))
            for factor, offset in zip(factors, offsets, strict=True)
        ]
        lit = self.valid & (_most(*drawn) > 0) & (_most(*margins) > EDGE_LOW)
        lit &= (self.high[0] > 0) & (self.low[0] < self.width)
        start = dr.select(self.small, dr.floor(self.middle[1] - 0.5), dr.ceil(self.low[1] - 0.5))
        last = dr.select(self.small, start + 1, dr.floor(self.high[1] - 0.5))
        start, last = dr.maximum(start, 0), dr.minimum(last, self.height - 1)
        lit &= last >= start
        wide = dr.minimum(self.high[0], self.width) - dr.maximum(self.low[0], 0)
        about = (last - start + 1) * (
            1 + dr.minimum(wide, dr.abs(self.own_mm2) * self.scale**2 / (self.high[1] - self.low[1] + 1))
        )
        return start, dr.select(lit, last, -1), be.UInt32(dr.select(lit, dr.minimum(about, 60000), 0))

    def columns(self, row: Any) -> tuple[Any, Any]:
        """First and last column whose pixel centres may lie in a cell, in a row of pixels."""
        dr = backend().dr
        y = row + 0.5
        low, high = 1e9, -1e9
        for (px, py, *_), (qx, qy, *_) in itertools.pairwise((*self.corners, self.corners[0])):
            crossed = (dr.minimum(py, qy) <= y) & (dr.maximum(py, qy) >= y)
            x = dr.fma((y - py) / dr.select(py == qy, 1, qy - py), qx - px, px)
            low, high = dr.minimum(low, dr.select(crossed, x, 1e9)), dr.maximum(high, dr.select(crossed, x, -1e9))
        start = dr.select(self.small, dr.floor(self.middle[0] - 0.5), dr.ceil(low - 0.501))
        last = dr.select(self.small, start + 1, dr.floor(high - 0.499))
        return dr.maximum(start, 0), dr.minimum(last, self.width - 1)

    def ends(self) -> tuple[list[Any], list[Any], list[Any]]:
        """At the four corners irradiance without edges, and how much of the part drawn is light with an edge's
        profile (factor) and without (offset)."""
        dr, placement = backend().dr, self.lattice.placement
        per_ramp, even = self.given(1 / placement.ramp), self.given(2.0 * ~placement.rough)
        inner = (self.lattice.per_mm * 2.0 ** (placement.level - placement.inner_level)) ** 2
        per_inner, per_usual = self.given(inner / _COARSE_PX), self.given(1 / self.lattice.usual_mm2)
        energy = self.energy / (self.scale * self.scale)
        rest, with_calm, with_rise = (self.given(column) for column in _SHARES[placement.part].T)
        densities, factors, offsets = [], [], []
        for corner, (sx, sy) in zip(self.corners, _OUTWARDS, strict=True):
            mean, least, most = self._around(sx, sy)
            densities.append(corner[2] * energy / dr.maximum(mean, 1e-12))
            # areas of one sign and of like size, or large: no fold near
            ratio = least / dr.maximum(most, 1e-18)
            large = dr.minimum(least * per_inner - 1, ratio / _UNLIKE)
            calm = dr.maximum((ratio - _UNLIKE) / (_ALIKE - _UNLIKE), large)
            # magnified half as much as is usual, or more: not crowded
            calm = dr.clip(dr.minimum(calm, 4 * dr.sqrt(mean * per_usual) - 1) + even, 0, 1)
            rise = dr.clip(corner[3] * per_ramp, 0, 1)
            rise = rise * rise * (3 - 2 * rise)
            factors.append(dr.fma(with_calm, calm, rest))
            offsets.append(with_rise * calm * rise)
        return densities, factors, offsets

    def _around(self, sx: int, sy: int) -> tuple[Any, Any, Any]:
        """Mean size of the cells that meet in a corner, and the least and the largest of their areas, counted
        positive where they have this cell's sign, mm²."""
        be = backend()
        dr, Int32, UInt32 = be.dr, be.Int32, be.UInt32
        own = dr.select(self.valid, self.own_mm2, 0)
        sign = dr.select(own < 0, -1.0, 1.0)
        total, number, side = dr.abs(own), be.Float(1), Int32(self.side)
        least, most = dr.abs(own), dr.abs(own)
        for dx, dy in ((sx, 0), (0, sy), (sx, sy)):
            jx, jy = Int32(self.ix) + dx, Int32(self.iy) + dy
            inside = (jx >= 0) & (jy >= 0) & (jx < side) & (jy < side)
            near = dr.gather(be.Float, self.lattice.area_mm2, self.first_cell + UInt32(jy * side + jx), inside)
            inside &= near != _NO_AREA
            total, number = total + dr.select(inside, dr.abs(near), 0), number + dr.select(inside, 1, 0)
            least = dr.select(inside, dr.minimum(least, near * sign), least)
            most = dr.select(inside, dr.maximum(most, dr.abs(near)), most)
        return total / number, least, most


def _least(*values: Any) -> Any:
    dr = backend().dr
    return dr.minimum(dr.minimum(values[0], values[1]), dr.minimum(values[2], values[3]))


def _most(*values: Any) -> Any:
    dr = backend().dr
    return dr.maximum(dr.maximum(values[0], values[1]), dr.maximum(values[2], values[3]))
