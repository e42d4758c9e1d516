"""Compute the ghosts of an extended scene from a stored response to each field angle of a lens.

A lens with rotational symmetry has the same ghosts for all sources at one field angle, turned with the azimuth of
the source. So the ghosts of a scene are, for each field angle, a convolution over azimuth. With sources in polar
cells (ring k at the slope t_k, azimuth φ) and the sensor in polar coordinates (r, φ), this is a product for each
azimuthal harmonic n:

    E_n(r_m) = Σ_k T_n(r_m, t_k) S_n(t_k).

`ghost_response` traces T once for a lens, from rays through the boxes of all ghosts (`ghosts.boxes`), and keeps it
on disk. `GhostResponse` applies it. A source counts in the two rings and the two azimuths next to it, with linear
weights. The light of each ray is spread over the sensor by a Gaussian that is as wide as the distance of its
neighbours, at least half a ring. Ghosts that are sharper than a ring are therefore smooth on this scale.

A stop with blades is replaced by a round one of the same area, as in the image of the scene.
"""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ...core.files.array_files import ArrayFiles, code_hash
from ...core.process import activity
from ...core.process.llvm import backend
from ...core.spectra import Bands
from ..prescription import Prescription
from .bundles import Rays, Spots
from .ghosts import GhostSpectra, boxes, lit_cells
from .irradiance import TRACERS
from .settings import GhostSettings, SensorGrid

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]

RESPONSES = ArrayFiles(kind="ghosts", content="response of ghosts")
_SOURCES = ("bundles", "ghost_response", "ghosts", "irradiance", "settings", "steps")
_OF_LENSES = ("coating", "glass", "paraxial", "prescription", "rays")

_NARROWINGS = 3  # times that the box of a ghost's rays is narrowed to those that arrive near the sensor
_THIN = 3.0  # distance of rays over the ghost's median, from which on light is thin
_COARSE = 12  # rays along each side of the lattice by which colours and boxes are known
_ACROSS = (8, 16, 24, 32, 48, 64)  # rays along each side of the lattice over one half of a ghost
_ENOUGH = 32  # rays across a ghost whose edges need not be sharper
_CLOSE = 0.03  # wanted distance of rays of larger ghosts on the sensor, over the number of rings
_WITHIN = 2  # field angles traced for each ring of sources
_BOXES = 2  # boxes are computed for every second ring of sources, and united with those of the neighbours
_LEVELS = 5  # widths of the Gaussian, each twice the one before
_SIGMA = 0.5  # the least width, in rings
_SIGMAS = 3.5  # distance at which the Gaussian is cut off, in its widths
_LEAST = 1e-7  # coefficients of Gaussians below this part of the first one are left out
_BEYOND = 34  # rings beyond the frame's corner, from which the widest Gaussian spreads light into the frame


@dataclass(frozen=True, kw_only=True)
class PolarCells:
    """Describe the polar cells of sources and of the sensor.

    Attributes
    ----------
    slopes
        Tangents of the field angles of the rings of sources, rising from 0.
    reach_mm
        Distance of the frame's corner from the axis.
    rings, azimuths
        Rings of the sensor, and azimuths of both sources and sensor (a power of two).
    """

    slopes: tuple[float, ...]
    reach_mm: float
    rings: int
    azimuths: int

    @property
    def ring_mm(self) -> float:
        """Return the distance of neighbouring rings on the sensor; the first lies at half of it."""
        return self.reach_mm / (self.rings - 1)

    def source_weights(self, slope_x: F64, slope_y: F64) -> Any:
        """Return a sparse matrix, float32[ring × azimuth, source], that puts sources into the cells."""
        from scipy.sparse import csr_matrix

        count, turns = len(self.slopes), self.azimuths
        ring = np.interp(np.hypot(slope_x, slope_y), self.slopes, np.arange(count))
        azimuth = np.arctan2(slope_y, slope_x) / (2 * np.pi) * turns
        inner = np.minimum(ring.astype(np.int64), count - 2)
        before = np.floor(azimuth).astype(np.int64)
        part, turn = ring - inner, azimuth - before
        source = np.arange(len(ring))
        weights, cells = [], []
        for k, across in ((0, 1 - part), (1, part)):
            for j, along in ((0, 1 - turn), (1, turn)):
                weights.append((across * along).astype(np.float32))
                cells.append((inner + k) * turns + (before + j) % turns)
        shape = count * turns, len(ring)
        return csr_matrix((np.concatenate(weights), (np.concatenate(cells), np.tile(source, 4))), shape=shape)


@dataclass(frozen=True, kw_only=True, eq=False)
class GhostResponse:
    """Hold the ghosts of sources at every ring of `cells`, for irradiance 1 across each source's direction.

    Attributes
    ----------
    table
        float32[band, harmonic, ring, source ring].
    """

    cells: PolarCells
    table: F32

    def harmonics(self, sources: F32, weights: F64) -> NDArray[np.complex64]:
        """Return the azimuthal harmonics of the ghosts on the sensor's rings, complex64[channel, harmonic, ring].

        Parameters
        ----------
        sources
            float32[ring, azimuth, band]: irradiance of the sources in each cell.
        weights
            float64[channel, band], with which the bands are added.
        """
        from scipy.fft import rfft

        turned = rfft(sources, axis=1)
        mixed = []
        # sums by einsum, because the bits of BLAS may depend on the number of threads
        for part in (turned.real, turned.imag):
            rings = np.ascontiguousarray(part.transpose(2, 1, 0))
            light = np.einsum("bnmk,bnk->bnm", self.table, rings)
            mixed.append(np.einsum("cb,bnm->cnm", weights.astype(np.float32), light))
        return np.asarray(mixed[0] + 1j * mixed[1], dtype=np.complex64)

    def image(self, sources: F32, weights: F64, sensor: SensorGrid) -> F32:
        """Return the irradiance of the ghosts on the sensor, float32[channel, y, x]; arguments as `harmonics`."""
        from scipy.fft import irfft

        turns = self.cells.azimuths
        polar = irfft(self.harmonics(sources, weights), n=turns, axis=1)  # channel, azimuth, ring
        column, row = _polar_positions(self.cells, sensor)
        out = np.empty((len(polar), *sensor.shape), dtype=np.float32)
        for light, image in zip(polar, out, strict=True):
            rings = np.asarray(light.T, dtype=np.float32)
            # across the axis a ring continues on the other side
            opposite = np.roll(rings[:1], turns // 2, axis=1)
            padded = np.concatenate([opposite, rings])
            padded = np.concatenate([padded, padded[:, :1]], axis=1)
            cv2.remap(padded, column, row, cv2.INTER_LINEAR, dst=image, borderMode=cv2.BORDER_REPLICATE)
        # harmonics are cut off, so their sum may be slightly negative where there is no light
        return np.maximum(out, 0, out=out)


@lru_cache(maxsize=2)
def _polar_positions(cells: PolarCells, sensor: SensorGrid) -> tuple[F32, F32]:
    """Return azimuth and ring of every pixel as columns and rows of `GhostResponse.image`, float32[y, x] each."""
    height, width = sensor.shape
    x = (np.arange(width) + 0.5 - width / 2) * sensor.pitch_mm
    y = ((np.arange(height) + 0.5 - height / 2) * sensor.pitch_mm)[:, None]
    azimuth = np.arctan2(y, x + 0 * y) / (2 * np.pi) * cells.azimuths
    ring = np.hypot(x, y) / cells.ring_mm + 0.5
    return np.mod(azimuth, cells.azimuths).astype(np.float32), ring.astype(np.float32)


@dataclass(frozen=True, eq=False)
class _Smoothing:
    """Hold a Gaussian on the sensor in polar harmonics.

    A point of flux 1 at the radius r₀ and azimuth 0 has the n-th coefficient

        c_n(r) = exp(-(r - r₀)² / 2σ²) e^(-z) I_n(z) / (2π σ²), with z = r r₀ / σ².

    `weights[d + half]` float32[harmonic, ring] is this coefficient times the number of azimuths, for
    r₀ = r_(m + d). Harmonics at which it is below 1e-7 on all rings are left out; they follow from
    e^(-z) I_n(z) ≈ exp(-n² / 2z) / √(2π z).
    """

    half: int
    weights: F32

    @classmethod
    def of(cls, cells: PolarCells, level: int) -> _Smoothing:
        """Return the Gaussian of a level."""
        from scipy.special import ive

        sigma = _SIGMA * 2**level  # in rings
        half = int(np.ceil(_SIGMAS * sigma))
        radius = np.arange(cells.rings) + 0.5
        most = np.ceil(np.sqrt(-2 * np.log(_LEAST) * radius[-1] * (radius[-1] + half)) / sigma)
        harmonic = np.arange(min(int(most), cells.azimuths // 2) + 1)[:, None]
        weights = np.zeros((2 * half + 1, len(harmonic), cells.rings), dtype=np.float32)
        for d in range(-half, half + 1):
            from_ = radius + d
            z = radius * np.maximum(from_, 0) / sigma**2
            factor = cells.azimuths / (2 * np.pi * (sigma * cells.ring_mm) ** 2)
            weights[d + half] = np.where(from_ > 0, factor * np.exp(-(d**2) / (2 * sigma**2)) * ive(harmonic, z), 0)
        return cls(half, weights)

    def add(self, flux: F32, out: F32) -> None:
        """Add the light of rings of flux, float32[band, harmonic, all rings], to `out` [band, harmonic, ring]."""
        rings, every, nodes = out.shape[-1], flux.shape[-1], self.weights.shape[1]
        flux, out = flux[:, :nodes], out[:, :nodes]
        for d in range(-self.half, self.half + 1):
            first, last = max(0, -d), min(rings, every - d)
            if first < last:
                out[..., first:last] += self.weights[d + self.half][:, first:last] * flux[..., first + d : last + d]


class _Tracing:
    """Trace the response of a lens, ring by ring of the sources.

    Positions of rays on the sensor are traced at the middle node only. The light of each band is in proportion to
    `GhostSpectra`. The colours of a ghost are apart by some parts in a hundred of its size, less than
    the width of its Gaussian.
    """

    def __init__(
        self, lens: Prescription, bands: Bands, cells: PolarCells, settings: GhostSettings, loss: float
    ) -> None:
        self.cells, self.bands = cells, len(bands)
        whole = TRACERS[settings.model](
            lens.with_round_stop(), bands.nodes_nm, reflections=settings.reflections, bands=bands
        )
        self.middle = len(bands.nodes_nm) // 2
        self.routes = len(whole.routes)
        self.tracer = whole.worn(loss) if loss and self.routes else whole
        self.rings = cells.rings + _BEYOND
        self.nodes = cells.azimuths // 2 + 1

    @cached_property
    def smoothing(self) -> list[_Smoothing]:
        """Return the Gaussians of all levels."""
        return [_Smoothing.of(self.cells, level) for level in range(_LEVELS)]

    @cached_property
    def boxes(self) -> list[F64]:
        """Return the boxes of all routes for every second ring, float64[route, 4]; nan where no light passes."""
        out = []
        for slope in self.cells.slopes[::_BOXES] + self.cells.slopes[-1:]:
            box = np.full((self.routes, 4), np.nan)
            rays, _ = boxes(self.tracer, float(np.degrees(np.arctan(slope))), arrive=False)
            box[rays.route] = rays.box_mm
            out.append(box)
        return out

    def table(self) -> F32:
        """Return `GhostResponse.table`."""
        count = len(self.cells.slopes)
        table = np.zeros((self.bands, self.nodes, self.cells.rings, count), dtype=np.float32)
        if self.routes:
            for ring in range(count):
                table[..., ring] = self.ring(ring)
        return table

    def ring(self, ring: int) -> F32:
        """Return one ring's part of the table, float32[band, harmonic, ring].

        The field angles traced lie between the neighbouring rings, as densely as a source counts in this ring.
        """
        slopes = np.array(self.cells.slopes)
        out = np.zeros((self.bands, self.nodes, self.cells.rings), dtype=np.float32)
        ghosts = self._near(*self._united(ring), float(slopes[ring]))
        if not len(ghosts):
            return out
        ends = slopes[max(ring - 1, 0)], slopes[min(ring + 1, len(slopes) - 1)]
        colours = self._colours(ghosts, float(slopes[ring]))
        arrived = []
        # where neighbouring rings of sources have ghosts as close together as the rays, one field angle is enough
        step = float(ends[1] - ends[0]) / 2
        close = np.abs(self.tracer.matrix[ghosts.route, 0, 1]) * step < ghosts.spacing_mm
        for angles, apart in ((1, close), (_WITHIN, ~close)):
            position = ring + _within(angles)
            sources = _Sources(
                slope=np.interp(np.abs(position), np.arange(len(slopes)), slopes),
                # the source on the other side of the axis has its ghosts on the other side too
                mirrored=position < 0,
                spacing=step / angles,
            )
            for across in np.unique(ghosts.across[apart]):
                chosen = apart & (ghosts.across == across)
                part = colours[chosen] / np.float32(angles)
                arrived.append(self._traced(ghosts.take(chosen), int(across), sources, part))
        flux = self._in_cells(arrived)
        levels = flux.reshape(_LEVELS, self.rings, self.nodes, self.bands)
        for level in np.flatnonzero(levels.any(axis=(1, 2, 3))):
            self.smoothing[level].add(_cosines(levels[level].transpose(2, 1, 0)), out)
        return out

    def _united(self, ring: int) -> tuple[NDArray[np.int64], F64]:
        """Return the routes that pass light at a ring or its neighbours, and half the boxes around their rays.

        The half boxes have y > 0; the other halves are their mirror images.
        """
        near = np.stack(self.boxes[max((ring - 1) // _BOXES, 0) : (ring + 1) // _BOXES + 2])
        seen = np.isfinite(near[..., 0])
        route = np.flatnonzero(seen.any(axis=0))
        low = np.where(seen, near[..., 0] - near[..., 2], np.inf).min(axis=0)[route]
        high = np.where(seen, near[..., 0] + near[..., 2], -np.inf).max(axis=0)[route]
        wide = np.where(seen, near[..., 3], 0).max(axis=0)[route]
        return route, np.column_stack([(low + high) / 2, wide / 2, (high - low) / 2, wide / 2])

    def _bundles(self, route: NDArray[np.int64], box: F64, *slopes: float) -> Rays:
        """Return the bundles of routes at the middle node, for one field angle after the other."""
        turns, slope = len(slopes), np.repeat(slopes, len(route))
        cosine = 1 / np.hypot(1, slope)
        return Rays(
            route=np.tile(route, turns),
            wavelength=np.full(len(slope), self.middle),
            box_mm=np.tile(box, (turns, 1)),
            direction=np.column_stack([slope * cosine, np.zeros(len(slope)), cosine]),
        )

    def _near(self, route: NDArray[np.int64], box: F64, slope: float) -> _Ghosts:
        """Return the routes with rays that arrive within the rings, and how they are traced.

        The boxes are narrowed to these rays, again as long as a ghost is much larger than the sensor.
        """
        ghosts = _Ghosts(route, box, np.zeros(len(route), dtype=np.int64), np.zeros(len(route)))
        for _ in range(_NARROWINGS):
            if not len(ghosts):
                break
            ghosts, fraction = self._narrowed(ghosts.route, ghosts.box_mm, slope)
            if (fraction > 0.5).all():
                break
        return ghosts

    def _narrowed(self, route: NDArray[np.int64], box: F64, slope: float) -> tuple[_Ghosts, F64]:
        """Return the ghosts in boxes, and how much each box became smaller."""
        shape = len(route), _COARSE, _COARSE
        rays = self._bundles(route, box, slope)
        spots = self.tracer.trace(rays, _COARSE, centred=True, halved=False)
        # a rim may lie between two rays, and so may the whole sensor, but not where the light is very thin
        passes = spots.radius < 2
        arrays = spots.x_mm, spots.y_mm, passes, _spacing(spots, passes, _COARSE)
        x, y, passes, spacing = (v.numpy().reshape(shape) for v in arrays)
        margin = np.minimum(spacing, _THIN * _median(spacing, passes)[:, None, None])
        near = passes & (np.hypot(x, y) - margin < self.rings * self.cells.ring_mm)
        seen = near.any(axis=(1, 2))
        near, box = near[seen], box[seen]
        out, fraction, most = np.empty_like(box), np.ones(len(box)), np.zeros(len(box), dtype=np.int64)
        for lit, k in ((near.any(axis=1), 0), (near.any(axis=2), 1)):
            first = np.maximum(np.argmax(lit, axis=1) - 1, 0)
            last = np.minimum(_COARSE - np.argmax(lit[:, ::-1], axis=1) + 1, _COARSE)
            width = 2 * box[:, 2 + k] / _COARSE
            out[:, k] = box[:, k] - box[:, 2 + k] + (first + last) / 2 * width
            out[:, 2 + k] = (last - first) / 2 * width
            most = np.maximum(most, last - first)
            fraction = np.minimum(fraction, (last - first) / _COARSE)
        rings = _median(spacing[seen], near) / self.cells.ring_mm * most
        wanted = np.maximum(np.minimum(rings, _ENOUGH), rings / (_CLOSE * self.cells.rings))
        across = np.array(_ACROSS)[np.minimum(np.searchsorted(_ACROSS, wanted), len(_ACROSS) - 1)]
        return _Ghosts(route[seen], out, across, rings * self.cells.ring_mm / across), fraction

    def _colours(self, ghosts: _Ghosts, slope: float) -> F32:
        """Return the flux of each ghost in every band over that of its rays, float32[ghost, band]."""
        rays = self._bundles(ghosts.route, ghosts.box_mm, slope)
        reach_mm = self.rings * self.cells.ring_mm
        spectra = GhostSpectra.of(self.tracer, rays, reach_mm)
        return spectra.of_bands(self.middle).astype(np.float32)

    def _traced(self, ghosts: _Ghosts, across: int, sources: _Sources, colours: F32) -> tuple[NDArray[Any], ...]:
        """Return the rays of all sources that arrive within the rings, for the half of each box with y > 0.

        They are given by the first of the four cells around each, int[ray], its position between them across and
        along the ring, float32[ray] each, and its light, float32[ray, band].
        """
        be = backend()
        dr, Float, UInt32 = be.dr, be.Float, be.UInt32
        count = len(ghosts)
        rays = self._bundles(ghosts.route, ghosts.box_mm, *sources.slope)
        spots = self.tracer.trace(rays, across, centred=True, halved=False)
        light = lit_cells(spots, across)
        # the Sun's beam is inclined, and both halves of the box count
        area = 2 * 4 * rays.box_mm[:, 2] * rays.box_mm[:, 3] / across**2 * rays.direction[:, 2]
        move = np.abs(self.tracer.matrix[rays.route, 0, 1]) * sources.spacing
        bundle = dr.arange(UInt32, dr.width(light)) // (across * across)

        def of_bundle(values: NDArray[Any]) -> Any:
            return dr.gather(Float, Float(np.ascontiguousarray(values, dtype=np.float32)), bundle)

        per_ring = dr.opaque(Float, 1 / self.cells.ring_mm)
        apart = dr.maximum(_spacing(spots, light > 0, across), of_bundle(move)) * per_ring
        level = dr.clip(dr.ceil(dr.log2(dr.maximum(apart, 1e-9))), 0, _LEVELS - 1)
        radius = dr.sqrt(spots.x_mm * spots.x_mm + spots.y_mm * spots.y_mm) * per_ring - 0.5
        chosen = (light > 0) & (radius < self.rings - 1)
        radius = dr.maximum(radius, 0)
        x = spots.x_mm * of_bundle(np.repeat(np.where(sources.mirrored, -1.0, 1.0), count))
        turn = dr.atan2(dr.abs(spots.y_mm), x) * ((self.nodes - 1) / np.pi)
        ring, node = UInt32(radius), dr.minimum(UInt32(turn), self.nodes - 2)
        cell = (UInt32(level) * self.rings + ring) * self.nodes + node
        across_ring, along_ring = radius - Float(ring), turn - Float(node)
        flux = light * of_bundle(area)
        dr.eval(chosen, cell, across_ring, along_ring, flux, bundle)
        kept = dr.compress(chosen)
        cell, across_ring, along_ring, flux, bundle = (
            dr.gather(type(v), v, kept).numpy() for v in (cell, across_ring, along_ring, flux, bundle)
        )
        return cell, across_ring, along_ring, flux[:, None] * colours[bundle % count]

    def _in_cells(self, arrived: Sequence[tuple[NDArray[Any], ...]]) -> F32:
        """Return the light in the cells of the half turn, both sides together, float32[cell, band]."""
        from scipy.sparse import csc_matrix

        rings, nodes = self.rings, self.nodes
        first, across, along, light = (np.concatenate(column) for column in zip(*arrived, strict=True))
        cells, weights = np.empty((len(first), 4), dtype=np.int32), np.empty((len(first), 4), dtype=np.float32)
        for k, (step, weight) in enumerate(
            (
                (0, (1 - across) * (1 - along)),
                (1, (1 - across) * along),
                (nodes, across * (1 - along)),
                (nodes + 1, across * along),
            )
        ):
            cells[:, k], weights[:, k] = first.astype(np.int32) + step, weight
        indptr = np.arange(0, 4 * len(first) + 1, 4, dtype=np.int32)
        shape = _LEVELS * rings * nodes, len(first)
        spread = csc_matrix((weights.ravel(), cells.ravel(), indptr), shape=shape)
        return np.asarray(spread @ light)


@dataclass(frozen=True, eq=False)
class _Ghosts:
    """Hold the routes to trace, half the boxes of their rays, float64[ghost, 4], and the rays along their sides.

    `spacing_mm` float64[ghost] is the median distance of neighbouring rays on the sensor.
    """

    route: NDArray[np.int64]
    box_mm: F64
    across: NDArray[np.int64]
    spacing_mm: F64

    def __len__(self) -> int:
        return len(self.route)

    def take(self, chosen: NDArray[np.bool_]) -> _Ghosts:
        """Return some of the ghosts."""
        return _Ghosts(self.route[chosen], self.box_mm[chosen], self.across[chosen], self.spacing_mm[chosen])


@dataclass(frozen=True, kw_only=True, eq=False)
class _Sources:
    """Hold the field angles traced for a ring.

    They are given by their slopes, float64[source], whether they lie on the other side of the axis, bool[source],
    and their distance in slope.
    """

    slope: F64
    mirrored: NDArray[np.bool_]
    spacing: float


def _spacing(spots: Spots, lit: Any, across: int) -> Any:
    """Return the distance of each ray from its lit neighbours, a device array; 0 where there are none.

    It is the mean over both neighbours in the row or in the column, the larger of both. In a caustic the rays of a
    ghost are much closer than elsewhere.
    """
    be = backend()
    dr = be.dr
    each = dr.arange(be.UInt32, dr.width(spots.x_mm))
    row = each // across
    ix, iy = each - row * across, row % across
    apart: Any = 0.0
    for node, step in ((ix, 1), (iy, across)):
        total: Any = 0.0
        count: Any = 0.0
        for has, neighbour in ((node > 0, each - step), (node < across - 1, each + step)):
            both = has & lit & dr.gather(type(lit), lit, neighbour, has)
            dx, dy = (v - dr.gather(be.Float, v, neighbour, has) for v in (spots.x_mm, spots.y_mm))
            total = total + dr.select(both, dr.sqrt(dx * dx + dy * dy), 0)
            count = count + dr.select(both, 1.0, 0.0)
        apart = dr.maximum(apart, total / dr.maximum(count, 1))
    return apart


def _median(values: F64, lit: NDArray[np.bool_]) -> F64:
    """Return the median over the lit rays of each ghost, float64[ghost]; 0 where none is lit."""
    rays = values.shape[1] * values.shape[2]
    ordered = np.sort(np.where(lit, values, np.inf).reshape(len(values), rays), axis=1)
    count = lit.sum(axis=(1, 2))
    middle = np.take_along_axis(ordered, np.minimum(count // 2, rays - 1)[:, None], axis=1)[:, 0]
    return np.where(count > 0, middle, 0.0)


def _within(count: int) -> F64:
    """Return offsets between neighbouring rings, as densely as the linear weight of a source falls off."""
    if count == 1:
        return np.zeros(1)
    part = (np.arange(count) + 0.5) / count
    return np.where(part < 0.5, np.sqrt(2 * part) - 1, 1 - np.sqrt(2 * (1 - part)))


def _cosines(lit: F32) -> F32:
    """Return the harmonics of light that is symmetric about azimuth 0, float32[band, harmonic, ring].

    `lit` [band, node, ring] is the light at the nodes of the half turn, both sides together.
    """
    from scipy.fft import dct

    # DCT-I counts the inner nodes twice
    lit = lit.copy()
    lit[:, 1:-1] /= 2
    return np.asarray(dct(lit, type=1, axis=1), dtype=np.float32)


def ghost_response(
    lens: Prescription,
    bands: Bands,
    cells: PolarCells,
    settings: GhostSettings,
    coating_loss: float = 0.0,
) -> GhostResponse:
    """Return the ghosts of a lens for sources at every field angle.

    With worn coatings, each reflectance is linear in the loss, so that ghosts of two reflections are a polynomial
    of degree two in it. The response is therefore traced at three losses (five for ghosts of four reflections) at
    most, whatever loss is asked for.
    """
    if not coating_loss:
        return _response(lens, bands, cells, settings, 0.0)
    losses = np.linspace(0, 1, settings.reflections + 1)
    parts = [_response(lens, bands, cells, settings, loss) for loss in losses.tolist()]
    others = losses[None, :] + np.where(np.eye(len(losses)) > 0, np.nan, 0)
    weights = np.nanprod((coating_loss - others) / (losses[:, None] - others), axis=1)
    table = sum(np.float32(w) * part.table for w, part in zip(weights, parts, strict=True))
    return GhostResponse(cells=cells, table=np.asarray(table))


@lru_cache(maxsize=5)
def _response(
    lens: Prescription,
    bands: Bands,
    cells: PolarCells,
    settings: GhostSettings,
    coating_loss: float,
) -> GhostResponse:
    """Return the response at one coating loss, from memory or from disk if it was traced before."""

    def traced() -> dict[str, F32]:
        activity.begin(f"ghosts of {lens.name} at every field angle (new response)")
        return {"table": _Tracing(lens, bands, cells, settings, coating_loss).table()}

    key = response_key(lens, bands, cells, settings, coating_loss)
    table = RESPONSES.kept(key, traced)["table"]
    table.setflags(write=False)
    return GhostResponse(cells=cells, table=table)


def response_key(
    lens: Prescription,
    bands: Bands,
    cells: PolarCells,
    settings: GhostSettings,
    coating_loss: float,
) -> str:
    """Return the sha256 (hex) of all that determines a response; the name of the lens does not."""
    of_lens = dataclasses.replace(lens.with_round_stop(), name="", source="")
    content = _code_hash(), of_lens, bands, cells, settings.model, settings.reflections, coating_loss
    return hashlib.sha256(repr(content).encode()).hexdigest()


@lru_cache(maxsize=1)
def _code_hash() -> str:
    """Return the sha256 (hex) of the sources that trace a response, the library versions and the platform."""
    here = Path(__file__).parent
    return code_hash([*(here / f"{name}.py" for name in _SOURCES), *(here.parent / f"{n}.py" for n in _OF_LENSES)])
