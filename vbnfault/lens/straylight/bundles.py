"""Trace rays along many reflection paths at once, for all ghosts and all wavelengths in one kernel.

Each path is a table of steps, so that the rays of all ghosts run side by side through one loop (Hullin et al.
2011). Rays start on a grid in the plane of the first vertex. The computation is in single precision; the position
of a ray is relative to the vertex of the surface that the ray has just met. If the boxes of the bundles are
symmetric about the plane of axis and Sun, the code traces only one side of this plane.

Coatings vary faster with wavelength than directions of rays: a tracer of bands has the fractions of light at
many wavelengths and means around the wavelengths that it traces. `ghosts.GhostSpectra` compares both with few rays.
A route is the sequence of reflecting surfaces, which are numbered by their row in the prescription. The path of a
route is the sequence of all surfaces that a ray meets; each of them is one step.

A ray is lost (clipped) outside the rim of any surface. `Tracer.rims_mm` holds the radii of round rims;
`steps.meet` clips; its module lists the other code that applies rims.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import combinations
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...core.process.llvm import backend
from ...core.spectra import Bands
from ..coating import Layer, reflect_transmit
from ..paraxial import along, mirrors, paraxial_properties
from ..prescription import Prescription
from ..rays import path_of
from .steps import Step, StopBlades, arrived, meet

F64 = NDArray[np.float64]

_COSINES, _COSINES_OF_BANDS = 256, 64  # nodes of the reflectance tables, of single wavelengths and of bands


@dataclass(frozen=True, kw_only=True, eq=False)
class Rays:
    """Describe the bundles to trace.

    Attributes
    ----------
    route, wavelength
        int[bundle]: indices into the routes and wavelengths of the tracer.
    box_mm
        float64[bundle, 4]: box in the plane of the first vertex, as centre x, y and half width x, y.
    direction
        float64[bundle, 3]: unit vectors, with the Sun's azimuth at 0.
    disc
        float64[bundle]: semi-axis, in half widths of the box, of the ellipse to which a lattice is rounded. The
        outer rays of this lattice then follow a rim. With 0, the lattice stays rectangular.
    light
        int[bundle]: index into `Tracer.light_nm` of its light. Default: the mean around `wavelength`.
    """

    route: NDArray[np.int64]
    wavelength: NDArray[np.int64]
    box_mm: F64
    direction: F64
    disc: F64 | None = None
    light: NDArray[np.int64] | None = None

    def __len__(self) -> int:
        return len(self.route)

    def take(self, chosen: NDArray[Any]) -> Rays:
        """Return some of the bundles."""
        parts: dict[str, Any] = {name: None if of is None else of[chosen] for name, of in vars(self).items()}
        return Rays(**parts)


@dataclass(frozen=True, eq=False)
class Spots:
    """Hold the arrival of every ray on the sensor.

    The values are device arrays, in the order of the bundles; the rays of a bundle are in the order of the rows of
    its lattice. A ray is lost (clipped) if `radius` is above 1 or, with soft edges, if `margin` is below -1.

    Attributes
    ----------
    across
        int64[bundle]: rays along each side of each lattice.
    x_mm, y_mm
        Positions on the sensor.
    fraction
        Fraction of the light that the path transmits.
    radius
        Largest relative radius along the path: distance from the axis over the radius of the rim in this direction.
        The value is 1000 or more if the ray has missed a surface or is totally reflected.
    margin
        Smallest value along the path of (1 - relative radius) over the width of the rim's soft edge. The margin
        is negative outside a rim. It is computed only if soft edges have widths, and margins that exceed
        `steps.FRINGES_END` may be stretched.
    """

    rays: Rays
    across: NDArray[np.int64]
    x_mm: Any
    y_mm: Any
    fraction: Any
    radius: Any
    margin: Any = None


def _paired(first: NDArray[Any], second: NDArray[Any]) -> NDArray[np.uint64]:
    """Pack two arrays of single-precision numbers into one array of 64-bit words."""
    pair = np.stack([np.asarray(first, dtype=np.float32), np.asarray(second, dtype=np.float32)], axis=-1)
    return np.ascontiguousarray(pair).view(np.uint64).ravel()


def _unpaired(words: Any, index: Any) -> tuple[Any, Any]:
    """Return the two numbers that `_paired` packed into the words at an index."""
    be = backend()
    word = be.dr.gather(be.UInt64, words, index)
    halves = be.UInt32(word), be.UInt32(word >> 32)
    return tuple(be.dr.reinterpret_array(be.Float, half) for half in halves)  # type: ignore[return-value]


def routes(lens: Prescription, reflections: int = 2) -> tuple[tuple[int, ...], ...]:
    """Return all routes of 2 reflections (backwards, then forwards), and for `reflections` = 4 also those of 4."""
    rows = (*mirrors(lens), *((len(lens.surfaces),) if lens.sensor_reflectance else ()))
    two = [(b, a) for a, b in combinations(rows, 2)]
    if reflections == 2:
        return tuple(two)
    return (*two, *(first + second for first in two for second in two if second[0] > first[1]))


def name_of(route: Sequence[int]) -> tuple[int, ...]:
    """Return the name of a ghost: its reflecting rows in pairs; the first row of a pair is nearer the front.

    Each pair is a reflection backwards and the next one forwards; the row that reflects forwards is first.
    """
    return tuple(row for back, forth in zip(route[::2], route[1::2], strict=True) for row in (forth, back))


def lattice_places(across: NDArray[np.int64], rows: NDArray[np.int64]) -> tuple[Any, Any, Any, Any]:
    """Return bundle, column, row and `across` of each lane; the lanes are the first `rows` rows of all lattices."""
    be = backend()
    dr = be.dr
    sizes = across * rows
    each = dr.arange(be.UInt32, int(sizes.sum()))
    if (across == across[0]).all() and (rows == rows[0]).all():
        # division of integers by a constant is cheap; division by a variable takes longer than a surface
        side, size = int(across[0]), int(sizes[0])
        bundle = each // size
        cell = each - bundle * size
        iy = cell // side
        return bundle, cell - iy * side, iy, be.UInt32(side)
    bundle = be.UInt32(np.repeat(np.arange(len(across), dtype=np.uint32), sizes))
    side = dr.gather(be.UInt32, be.UInt32(across.astype(np.uint32)), bundle)
    cell = each - dr.gather(be.UInt32, be.UInt32((np.cumsum(sizes) - sizes).astype(np.uint32)), bundle)
    # exact: the 0.5 keeps the quotient farther from whole numbers than rounding errors reach
    iy = be.UInt32((be.Float(cell) + 0.5) / be.Float(side))
    return bundle, cell - iy * side, iy, side


def rounded(u: Any, v: Any, disc: Any) -> tuple[Any, Any]:
    """Map the square from -1 to 1 smoothly to an ellipse of `disc` half widths; if `disc` is 0, change nothing."""
    dr = backend().dr
    wide = dr.select(disc > 0, disc * dr.sqrt(1 - 0.5 * v * v), 1)
    high = dr.select(disc > 0, disc * dr.sqrt(1 - 0.5 * u * u), 1)
    return u * wide, v * high


_STEP = np.dtype(
    [("row", np.int64), ("mirror", bool), ("medium", np.int64), ("other", np.int64), ("gap_mm", float)]
)


def _steps_of(paths: Sequence[Sequence[tuple[int, bool]]], vertex_mm: F64) -> tuple[NDArray[Any], F64]:
    """Return the steps of all paths, path after path, and how far the last vertex of each lies behind the sensor.

    The last of `vertex_mm` is the vertex of the sensor. A step has the row of its surface (the row behind the last
    surface is the sensor), whether the surface reflects, the media before and behind it, counted from 0 in front of
    the lens, and the distance of the last step's vertex behind its own.
    """
    steps, last = [], []
    for path in paths:
        onward, before = True, 0
        for k, reflects in path:
            media = (k, k + 1) if onward else (k + 1, k)
            steps.append((k, reflects, *media, vertex_mm[before] - vertex_mm[k]))
            before, onward = k, onward ^ reflects
        last.append(vertex_mm[before] - vertex_mm[-1])
    return np.array(steps, dtype=_STEP), np.array(last, dtype=np.float64)


@lru_cache(maxsize=96)
def _surface_fractions(
    films: tuple[Layer, ...],
    front: tuple[float, ...],
    back: tuple[float, ...],
    wavelength_nm: tuple[float, ...],
    cosines: int,
) -> F64:
    """Return the fractions of `Tracer._fractions` for one surface, float64[wavelength, 3, cosine], read-only.

    `front` and `back` are the indices on both sides at each wavelength. Lenses that differ in their geometry alone
    share these tables, which take most of the time to prepare a lens.
    """
    out = np.empty((len(wavelength_nm), 3, cosines))
    cosine = np.maximum(np.linspace(0, 1, cosines), 1e-6)[None, :]
    n_front, n_back, wavelength = (np.array(v)[:, None] for v in (front, back, wavelength_nm))
    # cosines on both sides, from the cosine in the medium of lower index by Snell's law
    thin = np.minimum(n_front, n_back)
    at_front, at_back = (np.sqrt(1 - (thin / n) ** 2 * (1 - cosine**2)) for n in (n_front, n_back))
    rs, rp, ts, tp = reflect_transmit(films, n_front, n_back, at_front, wavelength)
    out[:, 0], out[:, 2] = (rs + rp) / 2, (ts + tp) / 2
    rs, rp, _, _ = reflect_transmit(films[::-1], n_back, n_front, at_back, wavelength)
    out[:, 1] = (rs + rp) / 2
    out.setflags(write=False)
    return out


def _aspheric_terms(lens: Prescription) -> F64:
    """Return the aspheric coefficients, float64[term, row], of all surfaces and of the plane sensor."""
    most = max((len(s.aspheric_mm) for s in lens.surfaces), default=0)
    out = np.zeros((most, len(lens.surfaces) + 1))
    for k, surface in enumerate(lens.surfaces):
        out[: len(surface.aspheric_mm), k] = surface.aspheric_mm
    return out


class Tracer:
    """Trace rays through a lens; the constructor computes tables of paths, indices and reflectances once.

    `reflections` is 2, or 4 to include the paths of four reflections. `bands` are those whose light rays may carry.

    A ray is lost (clipped) outside `rims_mm`, float64[row]: the semi-diameter of each round rim; the sensor's is
    infinite. `steps.meet` clips at these rims. `irradiance.ParaxialTracer` clips paraxial rays at the same rims.
    A stop with blades does not use `rims_mm` but `steps.StopBlades`.
    From `rims_mm`, `ghosts` also computes first boxes and `irradiance` the widths of soft edges.
    """

    def __init__(
        self,
        lens: Prescription,
        wavelength_nm: F64,
        *,
        reflections: int = 2,
        routes_: Any = None,
        bands: Bands | None = None,
    ) -> None:
        self.lens = lens
        self.wavelength_nm = np.atleast_1d(np.asarray(wavelength_nm, dtype=np.float64))
        self.bands = bands if bands is not None and len(bands.nm) > 1 else None
        self.light_nm = self.wavelength_nm if self.bands is None else self.bands.sampled_nm(lens.spectral_step_nm)
        self._cosines = _COSINES if self.bands is None else _COSINES_OF_BANDS
        self.routes = routes(lens, reflections) if routes_ is None else tuple(routes_)
        self.sensor_mm = paraxial_properties(lens).bfd_mm
        self._paths = [path_of(lens, route) for route in self.routes]
        self.first_step = np.concatenate([[0], np.cumsum([len(path) for path in self._paths])])
        middle = float(np.median(self.wavelength_nm))
        pairs_of = [along(lens, path, middle) for path in self._paths]
        self.matrix = np.stack([m for m, _ in pairs_of]) if pairs_of else np.zeros((0, 2, 2))
        self.met = np.concatenate([met for _, met in pairs_of]) if pairs_of else np.zeros((0, 2, 2))
        self._tables = self._upload()
        # width of the soft edge of the hood, in its radii; whoever knows the Sun's disc sets it
        self.hood_width = 1e-3

    def _upload(self) -> dict[str, Any]:
        """Compute the tables of all steps, and return the tables that are stored on the device."""
        be, lens = backend(), self.lens
        vertex_mm = np.append(lens.vertices_mm, lens.vertices_mm[-1] + self.sensor_mm)
        steps, last_gap_mm = _steps_of(self._paths, vertex_mm)
        rows, mirror = steps["row"].astype(np.uint32), steps["mirror"]
        medium, other, gap_mm = (np.array(steps[name]) for name in ("medium", "other", "gap_mm"))
        index = np.stack([np.append(lens.indices(w), 1.0) for w in self.wavelength_nm])
        absorption = np.zeros((len(self.light_nm), index.shape[1]))
        for k, surface in enumerate(lens.surfaces):
            absorption[:, k + 1] = surface.absorption_per_mm(self.light_nm)
        self._absorbs = bool(absorption.any())
        # index into the fractions of `_fractions`: 0 reflected from the front, 1 from behind, 2 transmitted
        use = np.where(mirror, medium != rows, 2)
        self.rows = rows
        self._look_up = rows.astype(np.int64) * 3 + use
        middle = lens.indices(float(np.median(self.wavelength_nm)))
        self.medium_index = np.append(middle, 1.0)[medium]
        self.rims_mm = np.array([s.semi_diameter_mm for s in lens.surfaces] + [np.inf])
        aspheric = _aspheric_terms(lens)
        flat = [s.curvature_per_mm for s in lens.surfaces] + [0.0]
        conic = [1 + s.conic for s in lens.surfaces] + [1.0]
        ratio = index[:, medium] / index[:, other]
        curvature, per_rim = np.array(flat)[rows], (1 / self.rims_mm)[rows]
        # each step fetches few but wide records, because fetches take most of the time
        self._look_up_word = ((rows * 3 + use) * self._cosines * 2 + mirror.astype(np.int64)).astype(np.uint32)
        tables = {
            "row": be.UInt32(rows),
            "stop": be.UInt32((rows == lens.stop).astype(np.uint32)),
            "place": be.UInt64(_paired(gap_mm, curvature)),
            "bend": be.UInt64(_paired(ratio, np.broadcast_to(per_rim, (len(index), len(rows))))),
            "end": be.UInt32(self.first_step[1:].astype(np.uint32)),
            "start": be.UInt32(self.first_step[:-1].astype(np.uint32)),
            "last": be.Float(last_gap_mm.astype(np.float32)),
            "conic": be.Float(np.array(conic, dtype=np.float32)),
            "per_rim": be.Float(per_rim.astype(np.float32)),
            "absorption": be.Float(self._around(absorption).astype(np.float32).ravel()),
            "medium": be.UInt32(medium.astype(np.uint32)),
            "aspheric": [be.Float(c.astype(np.float32)) for c in aspheric],
        }
        self._special = bool(len(aspheric)) or any(c != 1 for c in conic)
        self._bladed = bool(lens.surfaces[lens.stop].blades)
        tables |= self._fraction_tables(self._coated)
        be.dr.eval(tables)
        return tables

    def _fraction_tables(self, fraction: F64) -> dict[str, Any]:
        """Return the tables of reflected and transmitted fractions, on the device."""
        rise = np.diff(fraction, axis=-1, append=fraction[..., -1:])
        return {"fraction": backend().UInt64(_paired(fraction, rise))}

    def worn(self, coating_loss: float) -> Tracer:
        """Return a tracer for a lens that has lost a fraction of its coatings' area.

        The reflectance of a surface becomes the mean of coated and bare glass, weighted by area. Transmittances do
        not change.
        """
        fraction = self._coated.copy()
        fraction[:, :, :2] += coating_loss * (self._bare - self._coated)[:, :, :2]
        other = copy.copy(self)
        other._tables = self._tables | other._fraction_tables(fraction)
        return other

    @cached_property
    def _coated(self) -> F64:
        """Return the fractions of the coated surfaces."""
        return self._around(self._fractions())

    @cached_property
    def _bare(self) -> F64:
        """Return the fractions of the surfaces without coatings."""
        return self._around(self._fractions(bare=True))

    def _fractions(self, bare: bool = False) -> F64:
        """Return the fractions reflected from the front, reflected from behind, and transmitted, of each surface.

        The result is float64[light, row, 3, cosine], the mean of both polarisations; cosines in the thinner medium.
        """
        lens = self.lens
        out = np.zeros((len(self.light_nm), len(lens.surfaces) + 1, 3, self._cosines))
        wavelengths = tuple(self.light_nm.tolist())
        media = [np.ones(len(wavelengths)), *(s.medium.index(self.light_nm) for s in lens.surfaces)]
        index = [tuple(np.broadcast_to(medium, len(wavelengths)).tolist()) for medium in media]
        for k, surface in enumerate(lens.surfaces):
            films = () if bare else surface.coating
            out[:, k] = _surface_fractions(films, index[k], index[k + 1], wavelengths, self._cosines)
        out[:, -1, :2] = lens.sensor_reflectance
        return out

    def _around(self, values: F64) -> F64:
        """Return means around every wavelength of the tracer, and behind them the values at all of the bands."""
        if self.bands is None:
            return values
        away = np.abs(self.light_nm - self.wavelength_nm[:, None])
        hats = np.maximum(1 - away / (self.bands.nodes_nm[1] - self.bands.nodes_nm[0]), 0)
        return np.concatenate([np.tensordot(hats / hats.sum(axis=1, keepdims=True), values, 1), values])

    def trace(
        self,
        rays: Rays,
        across: int | NDArray[np.int64],
        width: F64 | None = None,
        *,
        centred: bool = False,
        halved: bool = True,
        stretch: F64 | None = None,
    ) -> Spots:
        """Trace a lattice of rays of every bundle.

        Parameters
        ----------
        across
            Rays along each side of the lattice: one number for all bundles, or int64[bundle].
        width
            float64[step]: width of the rim's soft edge at each step of each route, in radii of the rim. Without
            widths, margins are not computed, and rays that miss a surface or are totally reflected become nan.
        centred
            Whether rays start in the middles of the cells of the box. Otherwise rays start on the lattice of the
            box, which includes the edges of the box and is rounded if `Rays.disc` is not 0.
        halved
            Whether to trace only one side of the plane of axis and Sun if all boxes are symmetric about this plane.
        stretch
            float64[step], at least 0: fraction by which the part of the margin beyond `steps.FRINGES_END` is
            lengthened at each step; default: 0.
        """
        side = np.broadcast_to(np.asarray(across, dtype=np.int64), len(rays))
        even = halved and not rays.direction[:, 1].any() and not rays.box_mm[:, 1].any()
        be = backend()
        dr = be.dr
        start = self._start(rays, side, centred, even)
        count, soft = dr.width(start.x), width is not None
        per_width = (np.zeros(len(self.rows)) if width is None else 1 / width).astype(np.float32)
        sides = 2 if even and self._bladed else 1
        none, unit = dr.zeros(be.Float, count), dr.full(be.Float, 1, count)
        outside, margin = self._hood_rim(start)
        rim = (outside * outside, margin) if soft else (outside * outside,)
        ray = (start.x, start.y, none, start.dx, start.dy, start.dz, unit, *(rim * sides))
        ray, last = self._followed(ray, start, per_width, self._stretched(stretch), soft)
        both = arrived(ray, last, soft)
        dr.eval(both)
        if not even:
            return Spots(rays, side, *(own for own, _ in both))
        whole = [dr.empty(be.Float, int((side**2).sum())) for _ in both]
        for out, (own, mirrored) in zip(whole, both, strict=True):
            dr.scatter(out, own, start.ray)
            dr.scatter(out, mirrored, start.mirrored)
        dr.eval(whole)
        return Spots(rays, side, *whole)

    def _stretched(self, stretch: F64 | None) -> NDArray[np.float32]:
        """Return the option `stretch` of `trace`, float32[step]."""
        return (np.zeros(len(self.rows)) if stretch is None else stretch).astype(np.float32)

    def _hood_rim(self, start: Any) -> tuple[Any, Any]:
        """Return the relative radius of each ray at the hood, and its margin there, as in `Spots`."""
        be, hood = backend(), self.lens.hood
        dr, count = be.dr, be.dr.width(start.x)
        if hood is None:
            return dr.zeros(be.Float, count), dr.full(be.Float, 1e6, count)
        length, per_radius = (dr.opaque(be.Float, v) for v in (hood.length_mm, 1 / hood.radius_mm))
        before = length / start.dz
        x, y = dr.fma(-before, start.dx, start.x), dr.fma(-before, start.dy, start.y)
        outside = dr.sqrt(x * x + y * y) * per_radius
        return outside, (1 - outside) * dr.opaque(be.Float, 1 / self.hood_width)

    def _followed(
        self,
        ray: tuple[Any, ...],
        start: Any,
        per_width: NDArray[np.float32],
        stretch: NDArray[np.float32],
        soft: bool,
    ) -> tuple[tuple[Any, ...], Any]:
        """Return the rays at the last surface of their paths, and the distance of this vertex behind the sensor."""
        be, t = backend(), self._tables
        dr = be.dr
        edge = be.UInt64(_paired(per_width, self._look_up_word.view(np.float32)))
        beyond = be.Float(stretch) if soft else None
        wavelength = start.wavelength * dr.opaque(be.UInt32, len(self.rows))
        fractions = start.light * dr.opaque(be.UInt32, 3 * self._cosines * (len(self.lens.surfaces) + 1))
        media = start.light * dr.opaque(be.UInt32, len(self.lens.surfaces) + 2)
        end = dr.gather(be.UInt32, t["end"], start.route)

        def on(step: Any, *_: Any) -> Any:
            return step < end

        def body(step: Any, *ray: Any) -> Any:
            at = self._fetched(step, edge, beyond, wavelength, fractions, media)
            return step + 1, *meet(at, ray, soft=soft, special=self._special, blades=self._blades)

        first = dr.gather(be.UInt32, t["start"], start.route)
        _, *after = dr.while_loop((first, *ray), on, body, mode="symbolic")
        return tuple(after), dr.gather(be.Float, t["last"], start.route)

    def _fetched(self, step: Any, edge: Any, beyond: Any, wavelength: Any, fractions: Any, media: Any) -> Step:
        """Return the data of one step of each lane's path, fetched from the tables."""
        be, t = backend(), self._tables
        dr = be.dr
        gap, curvature = _unpaired(t["place"], step)
        eta, per_rim = _unpaired(t["bend"], wavelength + step)
        sharpness, word = _unpaired(edge, step)
        word = dr.reinterpret_array(be.UInt32, word)
        row = dr.gather(be.UInt32, t["row"], step) if self._special else None
        absorption = None
        if self._absorbs:
            absorption = dr.gather(be.Float, t["absorption"], media + dr.gather(be.UInt32, t["medium"], step))

        def passed(cosine: Any) -> Any:
            at = cosine * (self._cosines - 1)
            node = dr.minimum(be.UInt32(at), self._cosines - 2)
            low, rise = _unpaired(t["fraction"], (word >> 1) + fractions + node)
            return dr.fma(at - be.Float(node), rise, low)

        return Step(
            gap=gap,
            curvature=curvature,
            eta=eta,
            per_rim=per_rim,
            sharpness=sharpness,
            stretch=0.0 if beyond is None else dr.gather(be.Float, beyond, step),
            mirror=(word & 1) == 1,
            stop=dr.gather(be.UInt32, t["stop"], step) == 1 if self._bladed else False,
            conic=dr.gather(be.Float, t["conic"], row) if self._special else 1.0,
            aspheric=[dr.gather(be.Float, a, row) for a in t["aspheric"]],
            absorption=absorption,
            passed=passed,
        )

    def _start(self, rays: Rays, across: NDArray[np.int64], centred: bool, even: bool) -> Any:
        """Return the start, route, wavelength and number of every ray, and the number of its mirror image.

        The start is a position in the plane of the first vertex and a direction.

        If `even`, only the rays on one side of the plane of axis and Sun are returned.
        """
        be = backend()
        dr = be.dr
        alone = len(rays) == 1
        bundle, ix, iy, side = lattice_places(across, -(-across // 2) if even else across)
        offset = dr.opaque(be.Float, 0.5 if centred else 0.0)
        spacing = 2 / be.Float(side if centred else side - 1)

        def given(values: F64) -> Any:
            if alone:
                return dr.opaque(be.Float, float(values[0]))
            return dr.gather(be.Float, be.Float(np.ascontiguousarray(values, dtype=np.float32)), bundle)

        def whole(values: NDArray[Any]) -> Any:
            if alone:
                return dr.opaque(be.UInt32, int(values[0]))
            return dr.gather(be.UInt32, be.UInt32(np.ascontiguousarray(values, dtype=np.uint32)), bundle)

        first = whole(np.cumsum(across**2) - across**2)
        x, y, half_x, half_y = (given(c) for c in rays.box_mm.T)
        dx, dy, dz = (given(c) for c in rays.direction.T)
        u, v = (be.Float(ix) + offset) * spacing - 1, (be.Float(iy) + offset) * spacing - 1
        if rays.disc is not None and not centred:
            u, v = rounded(u, v, given(rays.disc))
        return SimpleNamespace(
            x=dr.fma(half_x, u, x),
            y=dr.fma(half_y, v, y),
            dx=dx,
            dy=dy,
            dz=dz,
            route=whole(rays.route),
            wavelength=whole(rays.wavelength),
            light=whole(rays.wavelength if rays.light is None else rays.light + len(self.wavelength_nm)),
            ray=first + iy * side + ix,
            mirrored=first + (side - 1 - iy) * side + ix,
        )

    _stop_turn_rad = 0.0

    @property
    def _blades(self) -> StopBlades | None:
        """Return the blades of the stop, turned for the Sun's azimuth; None if the stop is round."""
        rim = self.lens.surfaces[self.lens.stop]
        return StopBlades(rim, self._stop_turn_rad) if rim.blades else None

    def turned(self, azimuth_rad: float) -> Tracer:
        """Return the tracer for a Sun at an azimuth.

        The tracer always traces rays with the Sun at azimuth 0, and turns the blades of the stop back instead.
        """
        other = copy.copy(self)
        rim = self.lens.surfaces[self.lens.stop]
        other._stop_turn_rad = float(np.radians(rim.rotation_deg) - azimuth_rad)
        return other
