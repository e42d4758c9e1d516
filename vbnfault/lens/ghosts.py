"""Ghosts by exact rays: every path of two or four reflections, all wavelengths, one kernel (Hullin et al. 2011).

A path is a table of steps, so that rays of all ghosts run side by side through one loop. Rays start on a grid in
the plane of the first vertex, within the box that a path's rims leave open; the box is found by two coarse passes.
Single precision: a ray's place is kept relative to the vertex it has just met.
"""

from __future__ import annotations

import warnings
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from itertools import combinations
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from .coating import reflect_transmit
from .first_order import first_order
from .glass import D_NM
from .paraxial import Ghost, along, mirrors
from .prescription import Prescription
from .trace import ghost

F64 = NDArray[np.float64]
Steps = tuple[tuple[int, bool], ...]

_COSINES = 256  # nodes of the reflectance tables
_COARSE = 25  # rays across a box while boxes are sought
FINE = 560  # rays across a box where flux and place are told
_STEEP = 0.3  # rise of the radius over a cell
_PEAK = 64  # and where the peak is sought
_TOGETHER = 1 << 22  # rays at a time there, for the memory's sake
_LOST, _FAR = -1e6, -1e4
_LIMIT_SHARPNESS = 100.0  # of the edge where a limit other than a rim ends the light
_LEAST_SLOPE = 1e-3  # of a ray against the sensor's plane, once it is lost


@lru_cache(maxsize=1)
def backend() -> Any:
    """drjit with its array types, on a usable LLVM."""
    from .. import llvm

    llvm.prepare()
    import drjit
    import drjit.llvm as types

    return SimpleNamespace(
        dr=drjit,
        Float=types.Float,
        UInt32=types.UInt,
        Int32=types.Int,
        UInt64=types.UInt64,
        Int64=types.Int64,
        Double=types.Float64,
        Bool=types.Bool,
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class Rays:
    """Which rays to trace: for each bundle its path, wavelength, box in the plane of the first vertex, direction.

    `route` and `wavelength` index those of the tracer, int[bundle]; `box_mm` float64[bundle, 4] is centre x, y and
    half width x, y; `direction` float64[bundle, 3] unit vectors, with the Sun's azimuth at 0.
    """

    route: NDArray[np.int64]
    wavelength: NDArray[np.int64]
    box_mm: F64
    direction: F64

    def __len__(self) -> int:
        return len(self.route)

    def take(self, chosen: NDArray[Any]) -> Rays:
        """Some of the bundles."""
        return Rays(
            route=self.route[chosen],
            wavelength=self.wavelength[chosen],
            box_mm=self.box_mm[chosen],
            direction=self.direction[chosen],
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class Spots:
    """Where rays arrive: device arrays, bundle after bundle, rows of the grid along x within one.

    `x_mm`, `y_mm` on the sensor, `share` of the light, `radius`: the largest distance from the axis over the rim's
    on the way, and `margin`: the least of (1 - radius) over the width of the rim's soft edge; a ray that misses a
    surface has a radius of 1e6.
    """

    x_mm: Any
    y_mm: Any
    share: Any
    radius: Any
    margin: Any


def _paired(first: NDArray[Any], second: NDArray[Any]) -> NDArray[np.uint64]:
    """Two arrays of numbers in single precision as one of words."""
    pair = np.stack([np.asarray(first, dtype=np.float32), np.asarray(second, dtype=np.float32)], axis=-1)
    return np.ascontiguousarray(pair).view(np.uint64).ravel()


def _unpaired(words: Any, index: Any) -> tuple[Any, Any]:
    """What `_paired` put together."""
    be = backend()
    word = be.dr.gather(be.UInt64, words, index)
    halves = be.UInt32(word), be.UInt32(word >> 32)
    return tuple(be.dr.reinterpret_array(be.Float, half) for half in halves)  # type: ignore[return-value]


def routes(lens: Prescription, reflections: int = 2) -> tuple[tuple[int, ...], ...]:
    """Sequences of reflecting rows in the order met: back, forward, and with four reflections back, forward."""
    rows = (*mirrors(lens), *((len(lens.surfaces),) if lens.sensor_reflectance else ()))
    two = [(b, a) for a, b in combinations(rows, 2)]
    if reflections == 2:
        return tuple(two)
    if reflections != 4:
        raise InputError(f"reflections = {reflections}: must be 2 or 4")
    return (*two, *(first + second for first in two for second in two if second[0] > first[1]))


def steps(lens: Prescription, route: Sequence[int]) -> Steps:
    """(row, whether it reflects) of a route; the sensor is the row behind the last."""
    if len(route) == 2:
        path = ghost(lens, route[1], route[0]) if route[0] < len(lens.surfaces) else ()
        if path:
            return path
    out: list[tuple[int, bool]] = []
    at, onward = -1, True
    for row in route:
        between = range(at + 1, row) if onward else range(at - 1, row, -1)
        out += [(k, False) for k in between]
        out.append((row, True))
        at, onward = row, not onward
    return (*out, *((k, False) for k in range(at + 1, len(lens.surfaces))))


class Tracer:
    """A lens made ready for tracing: tables of its paths, indices and reflectances at wavelengths, made once.

    `reflections`: 2, or 4 for the paths of four reflections too.
    """

    def __init__(
        self, lens: Prescription, wavelength_nm: F64, *, reflections: int = 2, routes_: Any = None
    ) -> None:
        self.lens = lens
        self.wavelength_nm = np.atleast_1d(np.asarray(wavelength_nm, dtype=np.float64))
        self.routes = routes(lens, reflections) if routes_ is None else tuple(routes_)
        self.sensor_mm = first_order(lens).bfd_mm
        self._paths = [steps(lens, route) for route in self.routes]
        self.first_step = np.concatenate([[0], np.cumsum([len(path) for path in self._paths])])
        middle = float(np.median(self.wavelength_nm))
        pairs_of = [along(lens, path, middle) for path in self._paths]
        self.matrix = np.stack([m for m, _ in pairs_of]) if pairs_of else np.zeros((0, 2, 2))
        self.met = np.concatenate([met for _, met in pairs_of]) if pairs_of else np.zeros((0, 2, 2))
        self._tables = self._upload()

    def _upload(self) -> dict[str, Any]:
        be, lens = backend(), self.lens
        vertex = np.append(lens.vertices_mm, lens.vertices_mm[-1] + self.sensor_mm)
        sensor = len(lens.surfaces)
        row, mirror, medium, other, gap = [], [], [], [], []
        last = []
        for path in self._paths:
            onward, before = True, 0
            for k, reflects in path:
                row.append(k)
                mirror.append(reflects)
                medium.append(k if onward else k + 1)
                other.append(k + 1 if onward else k)
                gap.append(vertex[before] - vertex[k])
                before, onward = k, onward ^ reflects
            last.append(vertex[before] - vertex[sensor])
        index = np.stack([np.append(lens.indices(w), 1.0) for w in self.wavelength_nm])
        absorption = np.zeros_like(index)
        for k, surface in enumerate(lens.surfaces):
            absorption[:, k + 1] = [surface.absorption_per_mm(w) for w in self.wavelength_nm]
        self._absorbs = bool(absorption.any())
        rows = np.array(row, dtype=np.uint32)
        # by what the reflectance is looked up: 0 from the front, 1 from behind, 2 what passes
        use = np.where(mirror, np.array(medium, dtype=np.int64) != rows, 2)
        self.rows = rows
        self._look_up = rows.astype(np.int64) * 3 + use
        middle = lens.indices(float(np.median(self.wavelength_nm)))
        self.medium_index = np.append(middle, 1.0)[medium]
        self.rims_mm = np.array([s.semi_diameter_mm for s in lens.surfaces] + [np.inf])
        most = max((len(s.aspheric_mm) for s in lens.surfaces), default=0)
        aspheric = np.zeros((most, sensor + 1))
        for k, s in enumerate(lens.surfaces):
            aspheric[: len(s.aspheric_mm), k] = s.aspheric_mm
        flat = [s.curvature_per_mm for s in lens.surfaces] + [0.0]
        conic = [1 + s.conic for s in lens.surfaces] + [1.0]
        count = len(rows)
        ratio = index[:, medium] / index[:, other]
        # a ray's step asks for few but wide records: fetching is what takes the time
        curvature, per_rim = (np.array(flat)[rows], (1 / self.rims_mm)[rows])
        share = self._shares(index)
        rise = np.diff(share, axis=-1, append=share[..., -1:])
        self._look_up_word = ((rows * 3 + use) * _COSINES * 2 + np.array(mirror, dtype=np.int64)).astype(np.uint32)
        tables = {
            "row": be.UInt32(rows),
            "stop": be.UInt32((rows == lens.stop).astype(np.uint32)),
            "place": be.UInt64(_paired(np.array(gap), curvature)),
            "bend": be.UInt64(_paired(ratio, np.broadcast_to(per_rim, (len(index), count)))),
            "share": be.UInt64(_paired(share, rise)),
            "end": be.UInt32(self.first_step[1:].astype(np.uint32)),
            "start": be.UInt32(self.first_step[:-1].astype(np.uint32)),
            "last": be.Float(np.array(last, dtype=np.float32)),
            "conic": be.Float(np.array(conic, dtype=np.float32)),
            "per_rim": be.Float(per_rim.astype(np.float32)),
            "absorption": be.Float(absorption[:, medium].astype(np.float32).ravel()),
            "aspheric": [be.Float(c.astype(np.float32)) for c in aspheric],
        }
        self._special = bool(most) or any(c != 1 for c in conic)
        self._bladed = bool(lens.surfaces[lens.stop].blades)
        self._numbers = {
            "gap": np.array(gap),
            "curvature": curvature,
            "eta": ratio,
            "per_rim": per_rim,
            "conic": conic,
            "aspheric": aspheric,
            "absorption": absorption[:, medium],
        }
        be.dr.eval(tables)
        return tables

    def _shares(self, index: F64) -> F64:
        """What each surface reflects from the front, from behind, and passes, float64[wavelength, row, 3, cosine]:
        over the cosine in the thinner of its two media, mean of both polarisations."""
        lens = self.lens
        cosine = np.maximum(np.linspace(0, 1, _COSINES), 1e-6)[None, :]
        out = np.zeros((len(index), len(lens.surfaces) + 1, 3, _COSINES))
        wavelength = self.wavelength_nm[:, None]
        for k, surface in enumerate(lens.surfaces):
            front, back = index[:, k, None], index[:, k + 1, None]
            # the cosine on either side; the square root is of what the denser side has left
            thin = np.minimum(front, back)
            at_front, at_back = (np.sqrt(1 - (thin / n) ** 2 * (1 - cosine**2)) for n in (front, back))
            films = surface.coating
            rs, rp, ts, tp = reflect_transmit(films, front, back, at_front, wavelength)
            out[:, k, 0], out[:, k, 2] = (rs + rp) / 2, (ts + tp) / 2
            rs, rp, _, _ = reflect_transmit(films[::-1], back, front, at_back, wavelength)
            out[:, k, 1] = (rs + rp) / 2
        out[:, -1, :2] = lens.sensor_reflectance
        return out

    @cached_property
    def _no_width(self) -> F64:
        return np.full(len(self.met), 1e-3)

    def trace(
        self, rays: Rays, across: int, width: F64 | None = None, *, centred: bool = False, light: bool = True
    ) -> Spots:
        """Trace `across` × `across` rays of every bundle.

        Parameters
        ----------
        width
            float64[step]: of the soft edge of the rim at each step of each route, in radii of the rim.
        centred
            Rays in the middles of the box's cells, else on its lattice, edges included.
        light
            Without it, a tracer of one path and wavelength leaves `share` at 1.
        """
        be, t = backend(), self._tables
        dr = be.dr
        per_width = (1 / (self._no_width if width is None else width)).astype(np.float32)
        start = self._start(rays, across, centred)
        count, route = dr.width(start.x), start.route
        none, one = dr.zeros(be.Float, count), dr.full(be.Float, 1, count)
        ray = (start.x, start.y, none, start.dx, start.dy, start.dz, one, none, dr.full(be.Float, 1e6, count))
        if len(self.routes) == len(self.wavelength_nm) == 1:
            # one path, one wavelength: every number is known, and nothing need be fetched
            for step in range(len(self.rows)):
                ray = self._meet(self._known(step, per_width, light), *ray)
            last: Any = float(t["last"].numpy()[0])
        else:
            edge = be.UInt64(_paired(per_width, self._look_up_word.view(np.float32)))
            wavelength = start.wavelength * dr.opaque(be.UInt32, len(self.rows))
            shares = start.wavelength * dr.opaque(be.UInt32, 3 * _COSINES * (len(self.lens.surfaces) + 1))
            end = dr.gather(be.UInt32, t["end"], route)

            def on(step: Any, *_: Any) -> Any:
                return step < end

            def body(step: Any, *ray: Any) -> Any:
                return step + 1, *self._meet(self._fetched(step, edge, wavelength, shares), *ray)

            first = dr.gather(be.UInt32, t["start"], route)
            _, *ray = dr.while_loop((first, *ray), on, body, mode="symbolic")
            last = dr.gather(be.Float, t["last"], route)
        x, y, z, dx, dy, dz, share, radius, margin = ray
        away = -(z + last) / dz
        x, y = dr.fma(away, dx, x), dr.fma(away, dy, y)
        found = dr.isfinite(x + y + radius) & (dr.abs(x) + dr.abs(y) < 1e9)
        spots = Spots(
            x_mm=dr.select(found, x, 0),
            y_mm=dr.select(found, y, 0),
            share=dr.select(found, share, 0),
            radius=dr.select(found, dr.sqrt(radius), -_LOST),
            margin=dr.select(found, dr.maximum(margin, _FAR), _LOST),
        )
        dr.eval(spots.x_mm, spots.y_mm, spots.share, spots.radius, spots.margin)
        return spots

    def _fetched(self, step: Any, edge: Any, wavelength: Any, shares: Any) -> Any:
        """What a step of every lane's own path is made of, from the tables."""
        be, t = backend(), self._tables
        dr = be.dr
        gap, curvature = _unpaired(t["place"], step)
        eta, per_rim = _unpaired(t["bend"], wavelength + step)
        sharpness, word = _unpaired(edge, step)
        word = dr.reinterpret_array(be.UInt32, word)
        row = dr.gather(be.UInt32, t["row"], step) if self._special else None

        def passed(cosine: Any) -> Any:
            at = cosine * (_COSINES - 1)
            node = dr.minimum(be.UInt32(at), _COSINES - 2)
            low, rise = _unpaired(t["share"], (word >> 1) + shares + node)
            return dr.fma(at - be.Float(node), rise, low)

        return SimpleNamespace(
            gap=gap,
            curvature=curvature,
            eta=eta,
            per_rim=per_rim,
            sharpness=sharpness,
            mirror=(word & 1) == 1,
            stop=dr.gather(be.UInt32, t["stop"], step) == 1 if self._bladed else False,
            conic=dr.gather(be.Float, t["conic"], row) if self._special else 1.0,
            aspheric=[dr.gather(be.Float, a, row) for a in t["aspheric"]],
            absorption=dr.gather(be.Float, t["absorption"], wavelength + step) if self._absorbs else None,
            passed=passed,
        )

    def _known(self, step: int, per_width: NDArray[np.float32], light: bool) -> Any:
        """What a step of the only path is made of, as numbers."""
        be, n = backend(), self._numbers
        dr = be.dr
        word, row = int(self._look_up_word[step]), int(self.rows[step])

        def passed(cosine: Any) -> Any:
            at = cosine * (_COSINES - 1)
            node = dr.minimum(be.UInt32(at), _COSINES - 2)
            low, rise = _unpaired(self._tables["share"], (word >> 1) + node)
            return dr.fma(at - be.Float(node), rise, low)

        return SimpleNamespace(
            gap=float(n["gap"][step]),
            curvature=float(n["curvature"][step]),
            eta=float(n["eta"][0, step]),
            per_rim=float(n["per_rim"][step]),
            sharpness=float(per_width[step]),
            mirror=bool(word & 1),
            stop=row == self.lens.stop,
            conic=float(n["conic"][row]),
            aspheric=[float(a[row]) for a in n["aspheric"]],
            absorption=float(n["absorption"][0, step]) if self._absorbs else None,
            passed=passed if light else None,
        )

    def _meet(
        self, at: Any, x: Any, y: Any, z: Any, dx: Any, dy: Any, dz: Any, share: Any, radius: Any, margin: Any
    ) -> tuple[Any, ...]:
        """On to the next surface of the path, and off it: refracted or reflected."""
        dr = backend().dr
        c, eta, mirror = at.curvature, at.eta, at.mirror
        z = z + at.gap
        if self._special:
            # to the plane of the vertex, then to the surface
            to_plane = -z / dz
            x, y = dr.fma(to_plane, dx, x), dr.fma(to_plane, dy, y)
            a = c * (dx * dx + dy * dy + at.conic * dz * dz)
            b = c * (x * dx + y * dy) - dz
            e = c * (x * x + y * y)
            under = b * b - a * e
            t_hit = e / (-b + dr.copysign(dr.sqrt(dr.maximum(under, 0)), dz))
            x, y, z = dr.fma(t_hit, dx, x), dr.fma(t_hit, dy, y), t_hit * dz
            length = t_hit + to_plane
            nx, ny, nz = c * x, c * y, c * at.conic * z - 1
            if at.aspheric:
                x, y, z, nx, ny, nz, more = self._to_asphere(at, x, y, z, dx, dy, dz)
                length = length + more
            norm = dr.rsqrt(nx * nx + ny * ny + nz * nz)
            along_normal = (nx * dx + ny * dy + nz * dz) * norm
            # the normal towards where the ray comes from
            norm = dr.select(along_normal > 0, -norm, norm)
            cosine = dr.minimum(dr.abs(along_normal), 1)
        else:
            # a sphere: its normal has length 1, and the root is the angle's cosine
            b = dz - c * dr.fma(x, dx, dr.fma(y, dy, z * dz))
            e = dr.fma(c, dr.fma(x, x, dr.fma(y, y, z * z)), -2 * z)
            under = dr.fma(b, b, -c * e)
            root = dr.sqrt(dr.maximum(under, 0))
            length = e / (b + dr.copysign(root, dz))
            x, y, z = dr.fma(length, dx, x), dr.fma(length, dy, y), dr.fma(length, dz, z)
            nx, ny, nz = c * x, c * y, dr.fma(c, z, -1)
            norm = dr.copysign(1, dz)
            cosine = dr.minimum(root, 1)
        nx, ny, nz = nx * norm, ny * norm, nz * norm
        if at.absorption is not None:
            share = share * dr.exp(-at.absorption * dr.abs(length))
        # the square of what lies beyond a rim grows by twice as much
        beyond = dr.fma(x, x, y * y) * (at.per_rim * at.per_rim)
        if self._bladed and at.stop is not False:
            blade = self._within_blades(x, y)
            beyond = dr.select(at.stop, blade * blade, beyond)
        left = 1 - eta * eta * (1 - cosine * cosine)
        out_cosine = dr.sqrt(dr.maximum(left, 0))
        if at.passed is not None:
            passed = at.passed(dr.minimum(dr.select(eta > 1, out_cosine, cosine), 1))
            share = share * dr.select((left < 0) & mirror, 1, passed)
        turn = dr.select(mirror, 2 * cosine, eta * cosine - out_cosine)
        keep = dr.select(mirror, 1, eta)
        onward = dr.copysign(dr.select(mirror, -1.0, 1.0), dr.select(mirror, -dz, dz))
        dx, dy, dz = dr.fma(turn, nx, keep * dx), dr.fma(turn, ny, keep * dy), dr.fma(turn, nz, keep * dz)
        # lost too: a surface missed, light all reflected, a ray turned back; on it goes, along the limit, so that
        # between rays it is known where that began
        left = dr.select(mirror, 1, left)
        room = dr.minimum(dr.minimum(under, left), 4 * dz * onward)
        dz = onward * dr.maximum(dz * onward, _LEAST_SLOPE)
        radius = dr.maximum(radius, dr.select(room < 0, 1e6, beyond))
        margin = dr.minimum(margin, dr.minimum((1 - beyond) * (0.5 * at.sharpness), room * _LIMIT_SHARPNESS))
        return x, y, z, dx, dy, dz, share, radius, margin

    def _start(self, rays: Rays, across: int, centred: bool) -> Any:
        """Place, direction, route and wavelength of every ray, on the device."""
        be = backend()
        dr = be.dr
        # whole divisions by a number that the kernel knows are cheap, by others they take longer than a surface
        each = dr.arange(be.UInt32, len(rays) * across * across)
        bundle = each // (across * across)
        cell = each - bundle * (across * across)
        alone = len(rays) == 1
        iy = cell // across
        ix = cell - iy * across
        offset, spacing = (0.5, 2 / across) if centred else (0.0, 2 / (across - 1))
        offset, spacing = dr.opaque(be.Float, offset), dr.opaque(be.Float, spacing)

        def given(values: F64) -> Any:
            if alone:
                return dr.opaque(be.Float, float(values[0]))
            return dr.gather(be.Float, be.Float(np.ascontiguousarray(values, dtype=np.float32)), bundle)

        def whole(values: NDArray[Any]) -> Any:
            if alone:
                return dr.opaque(be.UInt32, int(values[0]))
            return dr.gather(be.UInt32, be.UInt32(np.ascontiguousarray(values, dtype=np.uint32)), bundle)

        x, y, half_x, half_y = (given(c) for c in rays.box_mm.T)
        dx, dy, dz = (given(c) for c in rays.direction.T)
        return SimpleNamespace(
            x=dr.fma(half_x, (be.Float(ix) + offset) * spacing - 1, x),
            y=dr.fma(half_y, (be.Float(iy) + offset) * spacing - 1, y),
            dx=dx,
            dy=dy,
            dz=dz,
            route=whole(rays.route),
            wavelength=whole(rays.wavelength),
        )

    def _within_blades(self, x: Any, y: Any) -> Any:
        """Distance from the axis over that of the stop's rim in the same direction (`Surface.rim_mm`)."""
        be, rim = backend(), self.lens.surfaces[self.lens.stop]
        dr = be.dr
        half = float(np.pi / rim.blades)
        angle = (dr.atan2(y, x) - dr.opaque(be.Float, self._stop_turn_rad)) * (0.5 / half)
        beside = (angle - dr.floor(angle)) * (2 * half) - half
        edge = float(np.cos(half)) / dr.cos(beside)
        return dr.sqrt(x * x + y * y) / (rim.semi_diameter_mm * (edge + (1 - edge) * rim.blade_rounding))

    _stop_turn_rad = 0.0

    def turned(self, azimuth_rad: float) -> Tracer:
        """The same tracer for a Sun at an azimuth: rays are traced with the Sun at azimuth 0, and the stop's blades
        turned back instead."""
        other = type(self).__new__(type(self))
        other.__dict__.update(self.__dict__)
        rim = self.lens.surfaces[self.lens.stop]
        other._stop_turn_rad = float(np.radians(rim.rotation_deg) - azimuth_rad)
        return other

    def _to_asphere(self, at: Any, x: Any, y: Any, z: Any, dx: Any, dy: Any, dz: Any) -> tuple[Any, ...]:
        """From a conic to the asphere beside it, by Newton's method: place, normal, and how far it was."""
        be = backend()
        dr = be.dr
        c, conic, terms = at.curvature, at.conic, at.aspheric
        way = 0 * x
        for k in range(5):
            r2 = x * x + y * y
            root = dr.sqrt(dr.maximum(1 - conic * c * c * r2, 1e-6))
            sag, slope, power = c * r2 / (1 + root), c / root, r2
            for n, term in enumerate(terms):
                slope = slope + (2 * n + 4) * term * power
                sag = sag + term * power * r2
                power = power * r2
            nx, ny = slope * x, slope * y
            if k == 4:
                return x, y, z, nx, ny, 0 * x - 1, way
            step = (z - sag) / (nx * dx + ny * dy - dz)
            x, y, z = dr.fma(step, dx, x), dr.fma(step, dy, y), dr.fma(step, dz, z)
            way = way + step
        raise AssertionError("unreachable")

    # --- where rays get through ---------------------------------------------------------------------------------

    def boxes(self, sun_deg: float, width: F64 | None = None, reach_mm: float = np.inf) -> tuple[Rays, F64]:
        """The box of every route that lets light through from a Sun at azimuth 0, and where it arrives.

        Returns rays of one bundle a route, at the first wavelength, and float64[route, 6] of the sensor: least x,
        y, largest x, y, the largest share over area magnification, and how far rays that arrive within `reach_mm`
        of the axis move from the first wavelength to the last, mm (80 % of them move less).
        """
        tangent = np.tan(np.radians(sun_deg))
        direction = np.array([np.sin(np.radians(sun_deg)), 0.0, np.cos(np.radians(sun_deg))])
        front = self.lens.surfaces[0]
        reach = front.semi_diameter_mm + abs(float(front.sag_mm(front.semi_diameter_mm))) * tangent
        count = len(self.routes)
        everywhere = np.tile([0.0, 0.0, reach, reach], (count, 1))
        box = np.concatenate([everywhere, self._paraxial_boxes(tangent, reach)])
        route = np.tile(np.arange(count), 2)
        where = np.zeros((count, 6))
        for _ in range(2):
            box, where = self._narrowed(route, box, direction, count, width, reach_mm)
            route = np.flatnonzero(np.isfinite(box[:, 0]))
            box = box[route]
            if not len(route):
                break
        rays = Rays(
            route=route,
            wavelength=np.zeros(len(route), dtype=np.int64),
            box_mm=box,
            direction=np.tile(direction, (len(route), 1)),
        )
        return rays, where[route]

    def _paraxial_boxes(self, tangent: float, reach: float) -> F64:
        """Where all rims let first-order rays through, with room; around the narrowest rim's disc where nowhere."""
        a, b = self.met[:, 0, 0], self.met[:, 0, 1]
        rim = self.rims_mm[self.rows]
        with np.errstate(divide="ignore", invalid="ignore"):
            middle, half = -b * tangent / a, np.abs(rim / a)
        middle, half = np.where(np.isfinite(middle), middle, 0.0), np.where(np.isfinite(half), half, reach)
        out = np.empty((len(self.routes), 4))
        for k, (first, last) in enumerate(zip(self.first_step[:-1], self.first_step[1:], strict=True)):
            m, h = middle[first:last], half[first:last]
            low, high = (m - h).max(), (m + h).min()
            if low >= high:
                least = int(np.argmin(h))
                low, high = m[least] - h[least], m[least] + h[least]
            out[k] = (low + high) / 2, 0.0, 0.8 * (high - low), 1.6 * h.min()
        return out

    def _narrowed(
        self,
        route: NDArray[np.int64],
        box: F64,
        direction: F64,
        count: int,
        width: F64 | None,
        reach_mm: float,
    ) -> tuple[F64, F64]:
        """The boxes of what gets through the given ones, nan where nothing does, by route."""
        ends = np.array([0, len(self.wavelength_nm) - 1])
        rays = Rays(
            route=np.tile(route, 2),
            wavelength=np.repeat(ends, len(route)),
            box_mm=np.tile(box, (2, 1)),
            direction=np.tile(direction, (2 * len(route), 1)),
        )
        spots = self.trace(rays, _COARSE, width)
        margin, x, y, share = (
            v.numpy().reshape(2, len(route), _COARSE, _COARSE)
            for v in (spots.margin, spots.x_mm, spots.y_mm, spots.share)
        )
        passes = (margin > -1).any(axis=0)
        near = (margin > -1).all(axis=0) & (np.hypot(x[0], y[0]) < reach_mm)
        apart = np.where(near, np.hypot(x[1] - x[0], y[1] - y[0]), np.nan).reshape(len(route), -1)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)  # a bundle of which nothing arrives near
            move = np.nan_to_num(np.nanpercentile(apart, 80, axis=1))
        inside = margin[0] > -1
        far = np.float32(3e38)
        least_x, least_y = (np.where(inside, v[0], far).min(axis=(1, 2)) for v in (x, y))
        most_x, most_y = (np.where(inside, v[0], -far).max(axis=(1, 2)) for v in (x, y))
        # area of the cells of the lattice on the sensor
        ax, ay = (v[0][:, 1:, 1:] - v[0][:, :-1, :-1] for v in (x, y))
        bx, by = (v[0][:, 1:, :-1] - v[0][:, :-1, 1:] for v in (x, y))
        on_sensor = np.abs(ax * by - ay * bx) / 2
        at_entrance = 4 * box[:, 2] * box[:, 3] / (_COARSE - 1) ** 2
        whole = inside[:, 1:, 1:] & inside[:, :-1, :-1] & inside[:, 1:, :-1] & inside[:, :-1, 1:]
        density = share[0][:, 1:, 1:] * at_entrance[:, None, None] / np.maximum(on_sensor, 1e-9)
        peak = np.where(whole, density, 0).max(axis=(1, 2))
        lattice = np.linspace(-1, 1, _COARSE)
        out = np.full((count, 4), np.nan)
        told = np.zeros((count, 6))
        low = np.full((count, 2), np.inf)
        high = np.full((count, 2), -np.inf)
        spacing = np.zeros((count, 2))
        for k in np.flatnonzero(passes.any(axis=(1, 2))):
            r = route[k]
            columns, rows = np.flatnonzero(passes[k].any(axis=0)), np.flatnonzero(passes[k].any(axis=1))
            here_low = box[k, :2] + box[k, 2:] * lattice[[columns[0], rows[0]]]
            here_high = box[k, :2] + box[k, 2:] * lattice[[columns[-1], rows[-1]]]
            step = 2 * box[k, 2:] / (_COARSE - 1)
            # of two boxes of one route the finer one knows better
            if np.isfinite(low[r, 0]) and (spacing[r] < step).all() and (here_high - here_low < 3 * step).any():
                continue
            low[r], high[r] = np.minimum(low[r], here_low - step), np.maximum(high[r], here_high + step)
            spacing[r] = step
            bounds = np.array([least_x[k], least_y[k], most_x[k], most_y[k]], dtype=np.float64)
            if inside[k].any():
                if told[r, 4]:
                    bounds = np.concatenate(
                        [np.minimum(told[r, :2], bounds[:2]), np.maximum(told[r, 2:4], bounds[2:])]
                    )
                told[r, :4] = bounds
                told[r, 4] = max(told[r, 4], peak[k], 1e-30)
            told[r, 5] = max(told[r, 5], move[k])
        good = np.isfinite(low[:, 0])
        out[good, :2] = (low[good] + high[good]) / 2
        out[good, 2:] = np.maximum((high[good] - low[good]) / 2, 1e-6)
        return out, told


def tracer(lens: Prescription, wavelength_nm: tuple[float, ...], reflections: int = 2) -> Tracer:
    """A tracer, made once for a lens and its wavelengths."""
    return _tracer(lens, wavelength_nm, reflections)


@lru_cache(maxsize=8)
def _tracer(lens: Prescription, wavelength_nm: tuple[float, ...], reflections: int) -> Tracer:
    return Tracer(lens, np.array(wavelength_nm), reflections=reflections)


def traced_ghosts(
    lens: Prescription,
    sun_deg: float,
    *,
    azimuth_deg: float = 0.0,
    wavelength_nm: float = D_NM,
    reflections: int = 2,
    across: int = FINE,
    only: Collection[tuple[int, ...]] | None = None,
) -> tuple[Ghost, ...]:
    """Ghosts of a far point source by exact rays, as `paraxial.paraxial_ghosts` tells them.

    `across` rays span each ghost's box either way; `only` these pairs of rows. The peak is the largest irradiance
    of a cell of a coarser grid.
    """
    turn = np.radians(azimuth_deg)
    made = tracer(lens, (float(wavelength_nm),), reflections).turned(turn)
    rays, _ = made.boxes(sun_deg)
    if only is not None:
        chosen = {tuple(sorted(pair)) for pair in only}
        rays = rays.take(np.array([tuple(sorted(made.routes[r])) in chosen for r in rays.route], dtype=bool))
    if not len(rays):
        return ()
    return told(made, rays, sun_deg, turn, across)


def told(made: Tracer, rays: Rays, sun_deg: float, turn_rad: float, across: int) -> tuple[Ghost, ...]:
    """What bundles of the Sun's light, one a ghost, do on the sensor's plane."""
    pupil = np.pi / 4 * first_order(made.lens).entrance_pupil_diameter_mm ** 2
    out = []
    together = max(1, _TOGETHER // across**2)
    for first in range(0, len(rays), together):
        part = rays.take(np.arange(first, min(first + together, len(rays))))
        out += _told(made, part, across, turn_rad, pupil, float(np.cos(np.radians(sun_deg))))
    return tuple(sorted(out, key=lambda g: g.pair))


def _told(made: Tracer, rays: Rays, across: int, turn: float, pupil_mm2: float, cosine: float) -> list[Ghost]:
    be = backend()
    dr, Double = be.dr, be.Double
    whole, mirrored = rays, not made.lens.surfaces[made.lens.stop].blades
    if mirrored:
        # with a round stop both sides of the plane of axis and Sun are alike: one side, twice as finely
        half = (np.abs(rays.box_mm[:, 1]) + rays.box_mm[:, 3]) / 2
        rays = replace(rays, box_mm=np.column_stack([rays.box_mm[:, 0], half, rays.box_mm[:, 2], half]))
    spots = made.trace(rays, across, centred=True)
    weight = Double(spots.share * _inside(spots.radius, across))
    x, y = Double(spots.x_mm), Double(spots.y_mm)
    parts = (weight, weight * x, weight * y, weight * (x * x + y * y))
    dr.eval(*parts)
    total, mx, my, square = (dr.block_sum(v, across * across).numpy() for v in parts)
    cell = (1 + mirrored) * 4 * rays.box_mm[:, 2] * rays.box_mm[:, 3] / across**2
    peak = _peaks(made, whole) * cosine
    out = []
    for k in np.flatnonzero(total > 0):
        cx, cy = mx[k] / total[k], 0.0 if mirrored else my[k] / total[k]
        place = (cx * np.cos(turn) - cy * np.sin(turn), cx * np.sin(turn) + cy * np.cos(turn))
        out.append(
            Ghost(
                pair=tuple(sorted(made.routes[rays.route[k]])),  # type: ignore[arg-type]
                flux_fraction=float(total[k] * cell[k] / pupil_mm2),
                centroid_mm=(float(place[0]), float(place[1])),
                rms_radius_mm=float(np.sqrt(max(square[k] / total[k] - cx * cx - cy * cy, 0.0))),
                peak_irradiance_fraction=float(peak[k]),
            )
        )
    return out


def _inside(radius: Any, across: int) -> Any:
    """How much of each cell of a grid lies within the rims: all or nothing but for cells that a rim crosses."""
    be = backend()
    dr = be.dr
    each = dr.arange(be.UInt32, dr.width(radius))
    row = each // across
    ix, iy = each - row * across, row % across
    rise: Any = 0.0
    for at, step in ((ix, 1), (iy, across)):
        before = dr.gather(be.Float, radius, dr.select(at > 0, each - step, each))
        behind = dr.gather(be.Float, radius, dr.select(at < across - 1, each + step, each))
        rise = rise + dr.abs(behind - before) * 0.5
    part = dr.clip(0.5 + (1 - radius) / dr.maximum(rise, 1e-9), 0, 1)
    # where the radius jumps a ray was lost elsewhere, and its slope means nothing
    return dr.select(rise < _STEEP, part, dr.select(radius <= 1, 1.0, 0.0))


def _peaks(made: Tracer, rays: Rays) -> F64:
    """The largest share over magnification of area among the cells of a lattice, float64[bundle]."""
    spots = made.trace(rays, _PEAK, centred=True)
    x, y, share, radius = (
        v.numpy().reshape(len(rays), _PEAK, _PEAK) for v in (spots.x_mm, spots.y_mm, spots.share, spots.radius)
    )
    ux, uy = (np.diff(v, axis=2)[:, 1:] for v in (x, y))
    vx, vy = (np.diff(v, axis=1)[:, :, 1:] for v in (x, y))
    passes = radius <= 1
    whole = passes[:, 1:, 1:] & passes[:, 1:, :-1] & passes[:, :-1, 1:]
    cell = 4 * rays.box_mm[:, 2] * rays.box_mm[:, 3] / _PEAK**2
    with np.errstate(divide="ignore", invalid="ignore"):
        density = np.where(whole, share[:, 1:, 1:] * cell[:, None, None] / np.abs(ux * vy - uy * vx), 0)
    # a ghost that only a few rays take has no whole cell: its light over its extent
    found = np.nan_to_num(density, posinf=0.0).max(axis=(1, 2))
    return np.asarray(found, dtype=np.float64)


def surface_interactions_per_second(
    lens: Prescription, rays: int = 1_000_000, rounds: int = 5, *, light: bool = False
) -> float:
    """Surfaces met per second by rays sent straight through the lens, in whole calls, median of rounds; with
    `light` what each surface passes is told too."""
    import time

    made = Tracer(lens, np.array([D_NM]), routes_=[()])
    across = int(np.ceil(np.sqrt(rays)))
    radius = first_order(lens).entrance_pupil_diameter_mm / 2 / np.sqrt(2)
    bundle = Rays(
        route=np.zeros(1, dtype=np.int64),
        wavelength=np.zeros(1, dtype=np.int64),
        box_mm=np.array([[0.0, 0.0, radius, radius]]),
        direction=np.array([[0.0, 0.0, 1.0]]),
    )
    be, seconds = backend(), []
    for _ in range(rounds + 1):
        start = time.perf_counter()
        made.trace(bundle, across, light=light)
        be.dr.sync_thread()
        seconds.append(time.perf_counter() - start)
    return across * across * len(lens.surfaces) / float(np.median(seconds[1:]))
