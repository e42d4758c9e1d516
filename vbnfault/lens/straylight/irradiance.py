"""Render the ghosts of the Sun as irradiance on the sensor, by exact or paraxial rays, per band.

Rays are traced at few wavelengths, the nodes, and each adds its light to all bands with the weights of
`ghosts.GhostSpectra`: so the spectra of coatings, glasses and bands count at every nanometre.

A ghost is an image of the openings that its light passes. The Sun's disc and diffraction soften the edges of that
image by widths that are known for each rim. The Sun's width is the shift, to first order, when the Sun moves by the
radius of its disc. The width of diffraction is Fresnel's for a straight edge. Where the Sun itself is nearly in
focus, its disc is sampled instead.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...core.process.llvm import backend
from ...core.spectra import Bands
from ..glass import D_NM
from ..paraxial import along
from ..prescription import Prescription
from .bundles import Rays, Spots, Tracer, name_of
from .ghosts import (
    FINE,
    FINE_OF_FOUR,
    PEAK,
    Arrivals,
    Ghost,
    GhostSpectra,
    boxes,
    fluxes_mm2,
    mean_ghost,
    named,
    traced,
)
from .pyramid import LEVELS, Canvas
from .raster import PARTS, BundleDrawing, Sums, edge_kind
from .settings import TRACED, GhostSettings, SensorGrid
from .steps import FRINGES_END, stretched

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]

AT_D_LINE = Bands.lines(D_NM)
# Twice as many rays are traced across a ghost whose uneven fraction is larger, and across one that aberrations
# spread (`_Detail.spread_out`).
_UNEVEN = 0.3
_RAYS_AT_ONCE = 1 << 18  # of the wavelengths that are always traced, to bound memory
_ACROSS_FOCUSED = 25  # rays across a ghost for each sample of the Sun's disc
_SUBDIVISIONS = 8  # of the interval between two nodes, where colours separate
_APART_PX = 2.0  # pixels of a ghost's level: colours farther apart than this need more wavelengths
_FOCUSED = 0.35  # width of an edge in radii of its rim above which the disc is sampled
# Aberrations may spread a ghost that is in focus to first order over a hundred times its paraxial size. Where the
# Sun's width is less than this fraction of the true radius, it only softens the edge, and the disc is not sampled.
_FOCUSED_TRULY = 0.1
_DISC_RINGS = 3
_LARGE_PX = 150.0  # radius of a rim's image from which on the image is large
_PLAIN = 0.03  # edges below this fraction of the summed irradiance are drawn one level coarser
# distance from an edge, in its widths and at least in pixels, that is drawn finely
_RAMP, _RAMP_PX = FRINGES_END, 24.0
_FRAME_PIXELS = 16  # smallest number of pixels of a level across the frame
_SPREAD = 0.25, 256.0  # bounds of the size of rims' images relative to the paraxial size
_SPREAD_SHARP = 4.0  # upper bound of the same in estimates of sharpness
# Upper bound of the width of an edge on the sensor, in widths of the edge that limits the ghost. With a larger one,
# a ramp would lie within a cell, and the lattice of rays would show.
_WIDEST = 3.0
_ACROSS = 48  # rays along each side of a ghost whose figures are computed
_LEAST = 1e-10  # irradiance over the Sun's below which a ghost is omitted


class ParaxialTracer(Tracer):
    """Trace rays by matrices instead of surfaces (Lee & Eisemann's model), with the tables of `Tracer`.

    A ray is lost (clipped) outside the rims of `Tracer.rims_mm`, or outside the blades of the stop (`StopBlades`).
    `steps.meet` does the same for exact rays; its module lists all code that applies rims.
    """

    def __init__(self, lens: Prescription, wavelength_nm: F64, **options: Any) -> None:
        super().__init__(lens, wavelength_nm, **options)
        be = backend()
        factors = [along(lens, path, self.wavelength_nm) for path in self._paths]
        whole = np.stack([m for m, _ in factors])  # route, wavelength
        met = np.concatenate([m for _, m in factors])  # step, wavelength
        self._paraxial = {
            "whole": be.Float(whole[:, :, 0, :].transpose(1, 0, 2).astype(np.float32).ravel()),
            "met": be.Float(met[:, :, 0, :].transpose(1, 0, 2).astype(np.float32).ravel()),
        }

    def _fraction_tables(self, fraction: F64) -> dict[str, Any]:
        """Return the tables of `Tracer`, and the transmitted fraction of every route at normal incidence."""
        normal = fraction[:, :, :, -1].reshape(len(fraction), -1)[:, self._look_up]
        routes_ = np.multiply.reduceat(normal, self.first_step[:-1], axis=1) if len(self.routes) else normal
        return super()._fraction_tables(fraction) | {
            "fractions": backend().Float(routes_.astype(np.float32).ravel())
        }

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
        """Trace paraxial rays as `Tracer.trace` traces exact ones; the slope of a ray is the tangent of its angle.

        Here `beyond` and `radius` are relative radii, not squares as in `steps.meet`.
        """
        be, t, f = backend(), self._tables, self._paraxial
        dr = be.dr
        side = np.broadcast_to(np.asarray(across, dtype=np.int64), len(rays))
        start = self._start(rays, side, centred, False)
        per_width = be.Float((np.zeros(len(self.rows)) if width is None else 1 / width).astype(np.float32))
        beyond_edge = be.Float(self._stretched(stretch))
        blades = self._blades
        x, y = start.x, start.y
        sx, sy = start.dx / start.dz, start.dy / start.dz
        of = start.wavelength * dr.opaque(be.UInt32, len(self.routes)) + start.route
        light = start.light * dr.opaque(be.UInt32, len(self.routes)) + start.route
        m00, m01 = (dr.gather(be.Float, f["whole"], 2 * of + k) for k in (0, 1))
        steps = start.wavelength * dr.opaque(be.UInt32, len(self.rows))
        end = dr.gather(be.UInt32, t["end"], start.route)

        def on(step: Any, *_: Any) -> Any:
            return step < end

        def body(step: Any, radius: Any, margin: Any) -> Any:
            a, b = (dr.gather(be.Float, f["met"], 2 * (steps + step) + k) for k in (0, 1))
            hx, hy = dr.fma(a, x, b * sx), dr.fma(a, y, b * sy)
            beyond = dr.sqrt(hx * hx + hy * hy) * dr.gather(be.Float, t["per_rim"], step)
            if blades is not None:
                blade = blades.relative_radius(hx, hy)
                beyond = dr.select(dr.gather(be.UInt32, t["stop"], step) == 1, blade, beyond)
            inside = (1 - beyond) * dr.gather(be.Float, per_width, step)
            margin = dr.minimum(margin, stretched(inside, dr.gather(be.Float, beyond_edge, step)))
            return step + 1, dr.maximum(radius, beyond), margin

        first = (dr.gather(be.UInt32, t["start"], start.route), *self._hood_rim(start))
        _, radius, margin = dr.while_loop(first, on, body, mode="symbolic")
        spots = Spots(
            rays=rays,
            across=side,
            x_mm=dr.fma(m00, x, m01 * sx),
            y_mm=dr.fma(m00, y, m01 * sy),
            fraction=dr.select(radius >= 0, dr.gather(be.Float, t["fractions"], light), 0),  # one value per ray
            radius=radius,
            margin=margin,
        )
        dr.eval(spots.x_mm, spots.y_mm, spots.fraction, spots.radius, spots.margin)
        return spots


TRACERS: Mapping[str, type[Tracer]] = {"traced": Tracer, "paraxial": ParaxialTracer}


# --- the table of ghosts ----------------------------------------------------------------------------------------


@lru_cache(maxsize=8)
def _tracer(lens: Prescription, bands: Bands, model: str, reflections: int) -> Tracer:
    """Return the tracer of a lens at the nodes of bands; it is cached."""
    return TRACERS[model](lens, bands.nodes_nm, reflections=reflections, bands=bands)


def traced_ghosts(
    lens: Prescription,
    sun_deg: float,
    *,
    azimuth_deg: float = 0.0,
    bands: Bands = AT_D_LINE,
    model: str = "traced",
    reflections: int = 2,
    across: int | None = None,
    progress: Callable[[int], None] | None = None,
) -> tuple[Ghost, ...]:
    """Return the ghosts of a far point source at an angle from the axis, towards an azimuth (0: +x).

    The peak is the largest irradiance of a cell of a coarser grid. Ghosts without rays are left out.

    Parameters
    ----------
    bands
        One band, whose mean is returned.
    model
        As `GhostSettings.model`.
    reflections
        2, or 4 to include ghosts of four reflections.
    across
        Number of rays along either side of each ghost's box. Default: `FINE`, and `FINE_OF_FOUR` for the many faint
        ghosts of four reflections.
    progress
        Called with 1 after each wavelength.
    """
    turn = float(np.radians(azimuth_deg))
    made = _tracer(lens, bands, model, reflections).turned(turn)
    rays, _ = boxes(made, sun_deg)
    if not len(rays):
        return ()
    four = np.array([len(made.routes[r]) > 2 for r in rays.route])
    parts = [(rays.take(~four), FINE, PEAK), (rays.take(four), FINE_OF_FOUR, PEAK)]
    if across is not None:
        parts = [(rays, across, PEAK)]
    nodes, weights = range(len(made.wavelength_nm)), GhostSpectra.of(made, rays).weights(1)[..., 0]
    by_name = _at_nodes(made, parts, nodes, _by_name(made, rays, weights), (sun_deg, turn), progress)
    return tuple(mean_ghost(of) for _, of in sorted(by_name.items()))


def _by_name(made: Tracer, rays: Rays, values: F64) -> dict[tuple[int, ...], F64]:
    """Return the values of each bundle by the name of its ghost."""
    return {name_of(made.routes[route]): own for route, own in zip(rays.route, values, strict=True)}


def _at_nodes(
    made: Tracer,
    parts: Sequence[tuple[Rays, int, int]],
    nodes: Iterable[int],
    weights: Mapping[tuple[int, ...], F64],
    sun: tuple[float, float],
    progress: Callable[[int], None] | None = None,
) -> dict[tuple[int, ...], list[tuple[float, Ghost]]]:
    """Return each ghost at all nodes, by its name, with its weight at that node.

    Parameters
    ----------
    parts
        Bundles, and how many rays across give flux and peak (`ghosts.traced`).
    nodes
        Wavelengths of the tracer, by their indices.
    weights
        float64[node] of each ghost.
    sun
        The Sun's angle in degrees and its azimuth in radians.
    """
    by_name: dict[tuple[int, ...], list[tuple[float, Ghost]]] = {}
    for k, node in enumerate(nodes):
        for rays, across, peak_across in parts:
            at_node = replace(rays, wavelength=np.full(len(rays), node))
            for ghost in traced(made, at_node, *sun, across, peak_across):
                by_name.setdefault(ghost.pair, []).append((float(weights[ghost.pair][k]), ghost))
        if progress is not None:
            progress(1)
    return by_name


# --- images -----------------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True, eq=False)
class _Detail:
    """Hold how each route is drawn: from samples of the Sun's disc or not, how finely, and edge widths by step.

    `spread_out` marks routes in focus to first order whose ghosts aberrations spread. All fields but `width` and
    `stretch` are by route.
    """

    sampled: NDArray[np.bool_]
    spread_out: NDArray[np.bool_]
    level: NDArray[np.int64]
    inner_level: NDArray[np.int64]
    rough_level: NDArray[np.int64]
    ramp: F64
    kind: NDArray[np.int64]
    width: F64
    stretch: F64
    magnification: F64


@dataclass(frozen=True, eq=False)
class _Drawn:
    """Hold what is drawn: bundle, its weight in every band, whether it is rough, and part of the light."""

    source: NDArray[np.int64]
    weight: F64
    rough: NDArray[np.bool_]
    part: NDArray[np.int64]

    def of(self, each: NDArray[np.int64]) -> _Drawn:
        """Return the same for bundles that replace the original ones.

        `each` is the original of every new bundle, in rising order.
        """
        count = np.bincount(each)
        first = np.cumsum(count) - count
        many = count[self.source]
        rows = np.repeat(np.arange(len(many)), many)
        within = np.arange(len(rows)) - np.repeat(np.cumsum(many) - many, many)
        source = first[self.source][rows] + within
        return _Drawn(source, self.weight[rows], self.rough[rows], self.part[rows])


class FlareModel:
    """Render the ghosts of one lens on one sensor; `image` serves every position of the Sun.

    Parameters
    ----------
    lens
        At its final size.
    bands
        Bands of the images.
    sensor
        Pixels whose middle lies on the axis.
    sun_radius_rad
        Angular radius of the Sun's disc; 0 is a point.
    settings
        How ghosts are computed.
    """

    def __init__(
        self,
        lens: Prescription,
        bands: Bands,
        sensor: SensorGrid,
        *,
        sun_radius_rad: float,
        settings: GhostSettings = TRACED,
    ) -> None:
        model, shape, pitch_mm = settings.model, sensor.shape, sensor.pitch_mm
        self.lens = lens
        self.bands, self.nodes_nm = bands, bands.nodes_nm
        self.canvas = Canvas(shape=shape, pitch_mm=pitch_mm, bands=len(bands))
        self.sun_radius_rad = sun_radius_rad
        at = np.arange((len(self.nodes_nm) - 1) * _SUBDIVISIONS + 1) / _SUBDIVISIONS
        self._fine = np.interp(at, np.arange(len(self.nodes_nm)), self.nodes_nm)
        self._tracer = TRACERS[model](lens, self._fine, reflections=settings.reflections, bands=bands)
        if lens.hood is not None:
            shift = sun_radius_rad * lens.hood.length_mm / lens.hood.radius_mm  # of the edge's shadow
            self._tracer.hood_width = max(shift, self._tracer.hood_width)
        self._diffraction, self._across = settings.diffraction, settings.across
        self._reach_mm = float(np.hypot(*shape) / 2 * pitch_mm)
        self._whole = self  # the model with whole coatings, if they are worn here
        self._soften()

    def _soften(self) -> None:
        """Set the widths of the rims' soft edges for every step, and level and kind of edge for every route."""
        t = self._tracer
        counts = np.diff(t.first_step)
        route = np.repeat(np.arange(len(t.routes)), counts)
        whole, met = t.matrix[route], t.met
        a, b = met[:, 0, 0], met[:, 0, 1]
        a = np.where(np.abs(a) < 1e-9, 1e-9, a)
        m00 = np.where(np.abs(whole[:, 0, 0]) < 1e-9, 1e-9, whole[:, 0, 0])
        rim = t.rims_mm[t.rows]
        # for a fixed position on the sensor, how far its ray moves at this rim when the Sun moves by its radius
        self._sun = self.sun_radius_rad * np.abs(b - a * whole[:, 0, 1] / m00) / rim
        # phase over the rim's plane: π (Δy)² m / (λ B), Fresnel's variable is Δy √(2 m / (λ B))
        onwards = np.einsum("kij,kjl->kil", whole, np.linalg.inv(met))
        in_air = onwards[:, 0, 1] / t.medium_index
        nm = float(np.median(self.nodes_nm))
        fresnel = np.sqrt(nm * 1e-6 * np.abs(in_air * a / m00) / 2) / rim
        self._fresnel = fresnel if self._diffraction else 0 * fresnel
        self._px = rim * np.abs(m00 / a) / self.canvas.pitch_mm  # radius of the rim's image in pixels
        disc = np.abs(rim / a)
        bounds = zip(t.first_step[:-1], t.first_step[1:], strict=True)
        self._least = np.array([first + int(np.argmin(disc[first:last])) for first, last in bounds], dtype=np.int64)
        self._focused = np.hypot(self._sun, self._fresnel)[self._least] > _FOCUSED
        self._detail = self._details(np.zeros(len(t.routes), dtype=np.int64), np.ones(len(t.routes)))

    def _details(self, coarser: NDArray[np.int64], spread: F64) -> _Detail:
        """Return levels and edges of every route.

        `coarser` adds levels to those that the edges need. `spread` is the size of a rim's image relative to first
        order.
        """
        t, least = self._tracer, self._least
        route = np.repeat(np.arange(len(t.routes)), np.diff(t.first_step))
        px = self._px * spread[route]
        # parts of an image are spread less than most of it; the sharpest part decides
        sharp = np.minimum(spread, _SPREAD_SHARP)
        spread_out = self._focused & (spread > np.maximum(self._sun[least] / _FOCUSED_TRULY, _SPREAD_SHARP))
        sampled = (self._sun[least] > _FOCUSED) & ~spread_out
        larger = np.where(spread_out, spread, 1.0)[route]
        sun = np.where(sampled[route], 0.0, self._sun / larger)
        fresnel = self._fresnel / np.sqrt(larger)  # the phase over the rim's plane curves in proportion
        blur_px = np.hypot(sun[least], fresnel[least]) * self._px[least] * sharp
        # The disc's samples lie about a third of its radius apart. Of a ghost that is spread, the disc blurs every
        # part over its diameter.
        sun_px = self.sun_radius_rad * np.abs(t.matrix[:, 0, 1]) / self.canvas.pitch_mm
        blur_px = np.where(spread_out, np.maximum(2.0 * sun_px, blur_px), blur_px)
        blur_px = np.where(sampled, 0.3 * sun_px, blur_px)

        def level(px_: F64) -> NDArray[np.int64]:
            """Return the coarsest level whose pixels are no larger than `px_` pixels."""
            return np.floor(np.log2(np.maximum(px_, 1.0))).astype(np.int64)

        # a ghost may change over a fraction of the frame, and coarser pixels would flatten it
        most = min(max(min(self.canvas.shape) // _FRAME_PIXELS, 1).bit_length() - 1, LEVELS - 1)
        edge = np.minimum(level(blur_px / 1.5) + coarser, most)
        steady = np.hypot(sun, 0.5 * 2.0 ** edge[route] / px)
        width = np.clip(np.hypot(steady, fresnel), 1e-4, 0.5)
        own_px = width[least] * self._px[least]
        one_px = own_px * sharp
        ramp = np.maximum(_RAMP, _RAMP_PX * 2.0**coarser / one_px)
        return _Detail(
            sampled=sampled,
            spread_out=spread_out,
            level=edge,
            # the inner part may have pixels as wide as a quarter of the ramp
            inner_level=np.clip(level(ramp * one_px / sharp / 4), edge, most),
            # the Sun's disc, of twice its radius, limits the sharpness of a fold; in a large ghost two pixels do
            rough_level=np.minimum(
                np.minimum(np.maximum(level(1.3 * sun_px), px[least] > _LARGE_PX), edge) + coarser, most
            ),
            ramp=ramp,
            kind=edge_kind(steady[least], fresnel[least]),
            width=width,
            # beyond the fringes, margins of all rims count the same distances on the sensor
            stretch=np.clip(width * self._px / own_px[route], 1, _WIDEST) - 1,
            magnification=np.abs(t.matrix[:, 0, 0]) * sharp,
        )

    def _spread(self, arrivals: Arrivals, route: NDArray[np.int64]) -> F64:
        """Return the size of each route's image relative to its paraxial size, float64[route], within bounds.

        It is that of the parts which are spread least; of a ghost in focus to first order, that of the whole image,
        whose parts may be spread by factors that differ a hundredfold.
        """
        out = np.ones(len(self._tracer.routes))
        first = np.abs(self._tracer.matrix[route, 0, 0])
        whole = (arrivals.most_mm - arrivals.least_mm).max(axis=1) / 2 / self.canvas.pitch_mm
        relative = np.where(
            self._focused[route],
            whole / np.maximum(self._px[self._least][route], 1e-9),
            arrivals.magnification / np.maximum(first, 1e-9),
        )
        out[route] = np.clip(relative, *_SPREAD)
        return out

    def worn(self, coating_loss: float) -> FlareModel:
        """Return the model with a fraction of the coatings' area gone, as `Tracer.worn` does; the last are kept."""
        return _worn(self, coating_loss) if coating_loss else self

    def image(self, sun_deg: float, azimuth_deg: float = 0.0, *, only: tuple[int, int] | None = None) -> F32:
        """Return the irradiance of all ghosts over the Sun's at the entrance, float32[band, y, x].

        Parameters
        ----------
        sun_deg, azimuth_deg
            Angle of the Sun from the axis, from 0 to below 90, and its azimuth (0: +x, right; 90°: +y, down): the
            direct image lies at +f tan θ in that direction.
        only
            Pair of reflecting rows of the only ghost to draw; default: all.
        """
        return self._drawn(sun_deg, float(np.radians(azimuth_deg)), only).irradiance()

    def _drawn(self, sun_deg: float, turn: float, only: tuple[int, int] | None) -> Sums:
        """Return the sums into which all ghosts are drawn; rays and cells are freed before the levels are added."""
        made, rays, arrivals = self._boxes(sun_deg, turn)
        shown = self._in_frame(arrivals)
        if only is not None:
            shown &= named(made, rays, [only])
        rays, arrivals, spectra = self._bright(made, rays.take(shown), arrivals.take(shown), self._reach_mm)
        detail = self._details(self._fainter(rays, arrivals), self._spread(arrivals, rays.route))
        sums = Sums(self.canvas)
        cosine = float(np.cos(np.radians(sun_deg)))
        sampled = detail.sampled[rays.route]
        finely = (arrivals.uneven > _UNEVEN) | detail.spread_out[rays.route]
        across = np.where(finely, 2 * self._across - 1, self._across)
        over_disc = len(disc_samples(_DISC_RINGS)) * _ACROSS_FOCUSED**2
        number = len(self.nodes_nm) * np.where(sampled, over_disc, across**2)
        for of_disc in (False, True):
            group = np.flatnonzero(sampled == of_disc)
            # one half of the lattices mirrors the other only if it does for all of them, in whatever part
            halved = not (rays.direction[group, 1].any() or rays.box_mm[group, 1].any())
            for part in _parts(group, across[group], number[group]):
                each, bundles, drawn = self._coloured(
                    rays.take(part), arrivals.take(part), detail, spectra.take(part)
                )
                strength, side = np.full(len(bundles), cosine), across[part][each]
                if of_disc:
                    each, bundles, strength = self._over_disc(bundles, sun_deg)
                    drawn, side = drawn.of(each), np.full(len(bundles), _ACROSS_FOCUSED)
                spots = made.trace(bundles, side, detail.width, halved=halved, stretch=detail.stretch)
                sums.draw(spots, self._place(detail, bundles, drawn, strength), turn)
        return sums

    def _boxes(self, sun_deg: float, turn: float) -> tuple[Tracer, Rays, Arrivals]:
        """Return the tracer for an azimuth, the boxes of all ghosts, and where they arrive; the last are kept."""
        # worn coatings change how bright ghosts are, but not where they are
        return self._tracer.turned(turn), *_boxes_of_whole(self._whole, sun_deg, turn)

    def flux_mm2(
        self, sun_deg: float, azimuth_deg: float, only: Collection[tuple[int, ...]], *, across: int = 48
    ) -> dict[tuple[int, ...], F64]:
        """Return the flux of named ghosts of a point Sun on the unbounded sensor plane, float64[band] in mm² each.

        It is divided by the Sun's irradiance at the entrance, and 0 for a ghost whose light the rims block.
        """
        turn = float(np.radians(azimuth_deg))
        made, rays, _ = self._boxes(sun_deg, turn)
        rays = rays.take(named(made, rays, only))
        nodes = np.arange(0, len(self._fine), _SUBDIVISIONS)
        flux = {name: np.zeros(len(self.bands)) for name in only}
        if len(rays):
            each = np.repeat(np.arange(len(rays)), len(nodes))
            at_nodes = replace(rays.take(each), wavelength=np.tile(nodes, len(rays)))
            traced_mm2 = fluxes_mm2(made, at_nodes, sun_deg, across).reshape(len(rays), len(nodes))
            spectra = GhostSpectra.of(made, rays, step=_SUBDIVISIONS)
            by_band = np.einsum("gk,gkb->gb", traced_mm2, spectra.weights(_SUBDIVISIONS))
            flux |= _by_name(made, rays, by_band)
        return flux

    def ghosts(self, sun_deg: float, azimuth_deg: float = 0.0, *, most: int | None = None) -> tuple[Ghost, ...]:
        """Return the ghosts of a point Sun that reach the frame, each the mean of all bands.

        The peak is the largest of the cells between 48 rays along each side. With `most`, only so many ghosts
        with the highest peaks are returned.
        """
        turn = float(np.radians(azimuth_deg))
        made, rays, arrivals = self._boxes(sun_deg, turn)
        shown = self._in_frame(arrivals)
        rays, _, spectra = self._bright(made, rays.take(shown), arrivals.take(shown), np.inf)
        if not len(rays):
            return ()
        weights = _by_name(made, rays, spectra.weights(_SUBDIVISIONS).mean(axis=2))
        nodes = range(0, len(self._fine), _SUBDIVISIONS)
        by_name = _at_nodes(made, [(rays, _ACROSS, _ACROSS)], nodes, weights, (sun_deg, turn))
        peak = {name: sum(part * g.peak_irradiance_fraction for part, g in of) for name, of in by_name.items()}
        highest = sorted(sorted(by_name), key=lambda name: -peak[name])[:most]
        return tuple(mean_ghost(by_name[name]) for name in sorted(highest))

    def _bright(
        self, made: Tracer, rays: Rays, arrivals: Arrivals, reach_mm: float
    ) -> tuple[Rays, Arrivals, GhostSpectra]:
        """Return the ghosts that are bright enough to show, and their spectra.

        The peaks of the arrivals become those in the band in which each ghost is brightest. They were traced at the
        first wavelength, where coatings may reflect much more or less, and with whole coatings.
        """
        spectra = GhostSpectra.of(made, rays, reach_mm, _SUBDIVISIONS)
        arrivals = replace(arrivals, peak=arrivals.peak * spectra.of_bands(0).max(axis=1))
        bright = arrivals.peak > (_LEAST if self._whole is self else 0)
        return rays.take(bright), arrivals.take(bright), spectra.take(bright)

    def _fainter(self, rays: Rays, arrivals: Arrivals) -> NDArray[np.int64]:
        """Return the levels to add where edges are too faint to show in the sum of all ghosts, by route."""
        height, width = (n / 2 * self.canvas.pitch_mm for n in self.canvas.shape)
        frame = np.hypot(height, width)
        across = np.clip(np.minimum(arrivals.most_mm, frame) - np.maximum(arrivals.least_mm, -frame), 0, None)
        total = (arrivals.peak * np.minimum(across.prod(axis=1) / (4 * height * width), 1)).sum()
        out = np.zeros(len(self._tracer.routes), dtype=np.int64)
        faint = np.log(_PLAIN * total / np.maximum(arrivals.peak, 1e-300)) / np.log(4)
        out[rays.route] = np.clip(np.ceil(faint), 0, 1)
        return out

    def _in_frame(self, arrivals: Arrivals) -> NDArray[np.bool_]:
        """Return which ghosts may reach the frame, soft edges included, bool[bundle]."""
        beyond = np.maximum(np.maximum(arrivals.least_mm, -arrivals.most_mm), 0)
        soft = 8 * 2.0**LEVELS * self.canvas.pitch_mm
        return np.asarray(np.hypot(beyond[:, 0], beyond[:, 1]) < self._reach_mm + soft)

    def _coloured(
        self, rays: Rays, arrivals: Arrivals, detail: _Detail, spectra: GhostSpectra
    ) -> tuple[NDArray[np.int64], Rays, _Drawn]:
        """Return the bundles of all wavelengths, the ghost of each, and what is drawn of them.

        The nodes are always traced. Further wavelengths are added where the colours of a ghost lie far
        apart (`_APART_PX`). The inner part of the light is smooth and is drawn from the nodes alone.
        """
        apart = arrivals.move_mm / max(len(self.nodes_nm) - 1, 1) / self.canvas.pitch_mm

        def divided(level: NDArray[np.int64]) -> NDArray[np.int64]:
            """Return into how many steps the interval between two nodes is divided at a level: 1, 2, 4 or 8."""
            wanted = apart / 2.0 ** level[rays.route] / _APART_PX
            return 2 ** np.clip(np.ceil(np.log2(np.maximum(wanted, 1))), 0, 3).astype(np.int64)

        divisions = {"inner": np.ones(len(rays), dtype=np.int64), "edge": divided(detail.level)}
        rough = arrivals.folded | (arrivals.uneven > 0)
        divisions["rough"] = np.where(rough, divided(detail.rough_level), 0)
        most = np.maximum.reduce(list(divisions.values()))
        at = np.arange(len(self._fine))
        taken = at[None, :] % (_SUBDIVISIONS // most)[:, None] == 0
        which, wavelength = np.nonzero(taken)
        bundles = replace(rays.take(which), wavelength=wavelength)
        weights = {n: spectra.weights(_SUBDIVISIONS // n) for n in np.unique(list(divisions.values())) if n}
        parts = []
        for part, name in enumerate(PARTS):
            divided_ = divisions[name]
            step = _SUBDIVISIONS // np.maximum(divided_, 1)
            source = np.flatnonzero((divided_ > 0)[which] & (wavelength % step[which] == 0))
            weight = np.empty((len(source), len(self.bands)))
            ghost, node = which[source], wavelength[source] // step[which[source]]
            for number, own in weights.items():
                chosen = divided_[ghost] == number
                weight[chosen] = own[ghost[chosen], node[chosen]]
            lit = weight.any(axis=1)
            of = np.full(len(source), part)
            parts.append(tuple(column[lit] for column in (source, weight, rough[ghost], of)))
        return which, bundles, _Drawn(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))

    def _over_disc(self, rays: Rays, sun_deg: float) -> tuple[NDArray[np.int64], Rays, F64]:
        """Return bundles from samples of the Sun's disc: the original of each, the bundles, and their strength."""
        samples = disc_samples(_DISC_RINGS) * self.sun_radius_rad
        count = len(samples)
        theta = np.radians(sun_deg) + samples[:, 0]
        direction = np.column_stack([np.sin(theta), np.sin(samples[:, 1]), np.cos(theta)])
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        each = np.repeat(np.arange(len(rays)), count)
        which = np.tile(np.arange(count), len(rays))
        return each, replace(rays.take(each), direction=direction[which]), direction[which, 2] / count

    def _place(self, detail: _Detail, bundles: Rays, drawn: _Drawn, strength: F64) -> BundleDrawing:
        """Return how the bundles are drawn."""
        route = bundles.route[drawn.source]
        levels = np.stack([detail.inner_level, detail.level, detail.rough_level])
        return BundleDrawing(
            source=drawn.source,
            level=levels[drawn.part, route],
            weight=drawn.weight,
            strength=strength[drawn.source],
            kind=detail.kind[route],
            ramp=detail.ramp[route],
            rough=drawn.rough,
            magnification=detail.magnification[route],
            inner_level=detail.inner_level[route],
            part=drawn.part,
        )


def _parts(
    ghosts: NDArray[np.int64], across: NDArray[np.int64], rays: NDArray[np.int64]
) -> list[NDArray[np.int64]]:
    """Return ghosts in parts of about `_RAYS_AT_ONCE` rays.

    `across` and `rays` are the numbers of each ghost's rays, along a side of its lattice and in total.

    Each part has lattices of all sizes: those of one size are drawn by another kernel, which rounds differently. So
    the sum of the parts is that of all ghosts at once, bit for bit.
    """
    if not len(ghosts):
        return []
    _, number = np.unique(across, return_counts=True)
    count = min(-(-int(rays.sum()) // _RAYS_AT_ONCE), int(number.min()))
    by_size = ghosts[np.argsort(across, kind="stable")]
    return [by_size[k::count] for k in range(count)]


def disc_samples(rings: int) -> F64:
    """Return points of the unit disc, float64[n, 2], that stand for equal areas: one, and 6 k on ring k."""
    points = [np.zeros((1, 2))]
    total = 1 + 3 * rings * (rings + 1)
    inner = 1
    for k in range(1, rings + 1):
        n = 6 * k
        radius = np.sqrt((inner + n / 2) / total)
        angle = 2 * np.pi * (np.arange(n) + 0.5 * (k % 2)) / n
        points.append(radius * np.column_stack([np.cos(angle), np.sin(angle)]))
        inner += n
    return np.concatenate(points)


@lru_cache(maxsize=2)
def _worn(model: FlareModel, coating_loss: float) -> FlareModel:
    """Return `FlareModel.worn`."""
    other = copy.copy(model)
    other._tracer = model._tracer.worn(coating_loss)
    return other


@lru_cache(maxsize=4)
def _boxes_of_whole(model: FlareModel, sun_deg: float, turn: float) -> tuple[Rays, Arrivals]:
    """Return the boxes of all ghosts and their arrivals with whole coatings."""
    return boxes(model._tracer.turned(turn), sun_deg, model._detail.width, model._reach_mm)


@lru_cache(maxsize=4)
def flare_model(
    lens: Prescription,
    bands: Bands,
    sensor: SensorGrid,
    sun_radius_rad: float,
    settings: GhostSettings = TRACED,
) -> FlareModel:
    """Return the model of a lens and a sensor; it is cached."""
    return FlareModel(lens, bands, sensor, sun_radius_rad=sun_radius_rad, settings=settings)
