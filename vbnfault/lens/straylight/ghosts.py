"""Trace ghosts with exact rays: the rays of each ghost that pass the lens, and their light on the sensor.

The method is that of Hullin et al. 2011. A route is the sequence of surfaces that reflect the light of one ghost.
Two passes of few rays locate the box, in the plane of the first vertex, of all rays that pass the rims of a route.
Flux, position and size of the ghost are then sums over a fine grid of rays in its box.
"""

from __future__ import annotations

import warnings
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from ...core.process.llvm import backend
from ...core.spectra import Bands, hat_weights
from ..paraxial import paraxial_properties
from .bundles import Rays, Spots, Tracer, name_of

F64 = NDArray[np.float64]

_COARSE = 25  # rays across a box, to locate boxes
FINE = 768  # rays across a box, to compute flux and position
FINE_OF_FOUR = 192
_STEEP = 0.3  # rise of the relative radius over a cell, above which neighbouring rays ended at different rims
PEAK = 64  # rays across a box, to locate the peak
_TOGETHER = 1 << 22  # rays traced at a time, to limit memory
_SHARP = 1e-3  # default width of soft edges while boxes are located
_LEAST_SPREAD = 0.25  # fraction of a ghost's image that is magnified less than `Arrivals.magnification`
# Rays across a ghost whose spectrum is computed; more if coatings have an optical thickness above `_FILMS_NM`,
# because their reflectances vary faster with the angle.
_SPECTRUM, _SPECTRUM_OF_FILMS, _FILMS_NM = 13, 16, 800.0
_SPECTRUM_AT_ONCE = 1 << 20
# of the most light at any wavelength: with less, behind a filter, rays cannot stand for those beside it
_DARK = 1e-6
_LEAST_SHARE = 1e-2  # of a ghost's light in a band that a wavelength must have to be drawn in it
_UNEVEN = 2.0  # ratio of the areas of neighbouring cells above which the image is uneven


@dataclass(frozen=True, kw_only=True)
class Ghost:
    """Describe one ghost of a far point source.

    Attributes
    ----------
    pair
        The reflecting rows, the one nearer the front first.
    flux_fraction
        Flux on the unbounded sensor plane over (source irradiance × cos(angle) × area of the paraxial entrance
        pupil at the d line).
    centroid_mm, rms_radius_mm
        Position of the centroid on the sensor, from the axis, and flux-weighted rms radius about it.
    peak_irradiance_fraction
        Peak irradiance over the source's irradiance at the entrance.
    """

    pair: tuple[int, int]
    flux_fraction: float
    centroid_mm: tuple[float, float]
    rms_radius_mm: float
    peak_irradiance_fraction: float


def mean_ghost(rows: Sequence[tuple[float, Ghost]]) -> Ghost:
    """Return the mean over wavelengths of one ghost, from (fraction of the entering light, ghost) for each."""
    fraction = np.array([weight for weight, _ in rows])
    flux = fraction * [ghost.flux_fraction for _, ghost in rows]
    centroids = np.array([ghost.centroid_mm for _, ghost in rows])
    centre = flux @ centroids / flux.sum()
    square = [
        g.rms_radius_mm**2 + float(((p - centre) ** 2).sum()) for (_, g), p in zip(rows, centroids, strict=True)
    ]
    return replace(
        rows[0][1],
        flux_fraction=float(flux.sum()),
        centroid_mm=(float(centre[0]), float(centre[1])),
        rms_radius_mm=float(np.sqrt(flux @ square / flux.sum())),
        peak_irradiance_fraction=float(fraction @ [ghost.peak_irradiance_fraction for _, ghost in rows]),
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class Arrivals:
    """Describe where the coarse rays of each route arrive on the sensor. Near means within reach of the frame.

    Attributes
    ----------
    least_mm, most_mm
        float64[route, 2]: bounds of the ghost.
    peak
        Largest irradiance over that in the plane of the rays' box: transmitted fraction over magnification of area.
    move_mm
        Distance between the arrivals at the first and the last wavelength; 80 % of the near rays move less.
    magnification
        Magnification of lengths that is exceeded over three quarters of the near image.
    folded
        Whether the orientation of parts of the image is reversed.
    uneven
        Fraction of the near image where the magnification changes steeply.
    """

    least_mm: F64
    most_mm: F64
    peak: F64
    move_mm: F64
    magnification: F64
    folded: NDArray[np.bool_]
    uneven: F64

    def take(self, chosen: NDArray[Any]) -> Arrivals:
        """Return the arrivals of some of the routes."""
        return Arrivals(**{name: values[chosen] for name, values in vars(self).items()})

    @classmethod
    def none(cls, count: int) -> Arrivals:
        """Return the arrivals of routes from which no light reaches the sensor."""
        return cls(
            least_mm=np.full((count, 2), np.inf),
            most_mm=np.full((count, 2), -np.inf),
            peak=np.zeros(count),
            move_mm=np.zeros(count),
            magnification=np.zeros(count),
            folded=np.zeros(count, dtype=bool),
            uneven=np.zeros(count),
        )


def boxes(
    made: Tracer, sun_deg: float, width: F64 | None = None, reach_mm: float = np.inf, *, arrive: bool = True
) -> tuple[Rays, Arrivals]:
    """Return the rays' box of every route that passes light, and its arrivals, for a Sun at azimuth 0.

    There is one bundle per route, at the first wavelength. Boxes are symmetric about the plane of axis and Sun;
    `Rays.disc` is the ellipse around all rays that pass. `width` is that of the rims' soft edges; rays that arrive
    within `reach_mm` of the axis count as near. Without `arrive` the arrivals are not computed.
    """
    tangent = np.tan(np.radians(sun_deg))
    direction = np.array([np.sin(np.radians(sun_deg)), 0.0, np.cos(np.radians(sun_deg))])
    reach = float(made.lens.surfaces[0].reach_mm(tangent))
    count = len(made.routes)
    everywhere = np.tile([0.0, 0.0, reach, reach], (count, 1))
    box = np.concatenate([everywhere, _paraxial_boxes(made, tangent, reach)])
    route, disc = np.tile(np.arange(count), 2), np.zeros(count)
    arrivals = Arrivals.none(count)
    edges = np.full(len(made.rows), _SHARP) if width is None else width
    last = len(made.wavelength_nm) - 1
    for ends, counts in (((last // 2,), False), ((0, last), arrive)):  # only the last arrivals count
        box, disc, arrivals = _narrowed(made, route, ends, box, direction, edges, reach_mm if counts else None)
        route = np.flatnonzero(np.isfinite(box[:, 0]))
        box, disc = box[route], disc[route]
        if not len(route):
            break
    rays = Rays(
        route=route,
        wavelength=np.zeros(len(route), dtype=np.int64),
        box_mm=box,
        direction=np.tile(direction, (len(route), 1)),
        disc=disc,
    )
    return rays, arrivals.take(route)


def _paraxial_boxes(made: Tracer, tangent: float, reach: float) -> F64:
    """Return boxes, with room, where all rims pass paraxial rays; where none pass, that of the narrowest rim."""
    a, b = made.met[:, 0, 0], made.met[:, 0, 1]
    rim = made.rims_mm[made.rows]
    with np.errstate(divide="ignore", invalid="ignore"):
        middle, half = -b * tangent / a, np.abs(rim / a)
    middle, half = np.where(np.isfinite(middle), middle, 0.0), np.where(np.isfinite(half), half, reach)
    out = np.empty((len(made.routes), 4))
    for k, (first, last) in enumerate(zip(made.first_step[:-1], made.first_step[1:], strict=True)):
        m, h = middle[first:last], half[first:last]
        low, high = (m - h).max(), (m + h).min()
        if low >= high:
            least = int(np.argmin(h))
            low, high = m[least] - h[least], m[least] + h[least]
        out[k] = (low + high) / 2, 0.0, 0.8 * (high - low), 1.6 * h.min()
    return out


def _narrowed(
    made: Tracer,
    route: NDArray[np.int64],
    wavelength: tuple[int, ...],
    box: F64,
    direction: F64,
    width: F64,
    reach_mm: float | None,
) -> tuple[F64, F64, Arrivals]:
    """Return the boxes of the rays that pass, their ellipses, and the arrivals, each by route.

    Boxes are nan where no ray passes. Arrivals are those of the first wavelength given; `move_mm` compares them
    with the last one. If `reach_mm` is None, they are not computed.
    """
    count = len(wavelength)
    rays = Rays(
        route=np.tile(route, count),
        wavelength=np.repeat(np.array(wavelength), len(route)),
        box_mm=np.tile(box, (count, 1)),
        direction=np.tile(direction, (count * len(route), 1)),
    )
    spots = made.trace(rays, _COARSE, width)
    shape = count, len(route), _COARSE, _COARSE
    margin = spots.margin.numpy().reshape(shape)
    passes = (margin > -1).any(axis=0)
    boxes_, disc, kept = _around_passing(box, passes, route, len(made.routes))
    arrivals = Arrivals.none(len(made.routes))
    if reach_mm is None:
        return boxes_, disc, arrivals
    x, y, fraction = (v.numpy().reshape(shape) for v in (spots.x_mm, spots.y_mm, spots.fraction))
    near = (margin > -1).all(axis=0) & (np.hypot(x[0], y[0]) < reach_mm)
    apart = np.where(near, np.hypot(x[-1] - x[0], y[-1] - y[0]), np.nan).reshape(len(route), -1)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # of bundles without a near ray
        move = np.nan_to_num(np.nanpercentile(apart, 80, axis=1))
    inside = margin[0] > -1
    far = np.float32(3e38)
    least = np.stack([np.where(inside, v[0], far).min(axis=(1, 2)) for v in (x, y)], axis=-1)
    most = np.stack([np.where(inside, v[0], -far).max(axis=(1, 2)) for v in (x, y)], axis=-1)
    at_entrance = 4 * box[:, 2] * box[:, 3] / (_COARSE - 1) ** 2
    peak, magnification, folded, uneven = _spread(x[0], y[0], fraction[0], inside, near, at_entrance)
    for k in kept:
        r = route[k]
        if inside[k].any():
            arrivals.least_mm[r] = np.minimum(arrivals.least_mm[r], least[k])
            arrivals.most_mm[r] = np.maximum(arrivals.most_mm[r], most[k])
            arrivals.peak[r] = max(arrivals.peak[r], peak[k], 1e-30)
        arrivals.move_mm[r] = max(arrivals.move_mm[r], move[k])
        arrivals.folded[r] |= folded[k]
        arrivals.magnification[r], arrivals.uneven[r] = magnification[k], uneven[k]
    return boxes_, disc, arrivals


def _around_passing(
    box: F64, passes: NDArray[np.bool_], route: NDArray[np.int64], count: int
) -> tuple[F64, F64, list[int]]:
    """Return boxes, float64[route, 4], around rays that pass, their ellipses, float64[route], and the kept bundles.

    Parameters
    ----------
    box, passes
        float64[bundle, 4] and bool[bundle, y, x]: boxes of coarse lattices, and their rays that pass.
    route, count
        Route of each bundle, and number of routes. The box of a route without a ray that passes is nan.
    """
    nodes = np.linspace(-1, 1, _COARSE)
    low, high = np.full((count, 2), np.inf), np.full((count, 2), -np.inf)
    spacing, kept = np.zeros((count, 2)), []
    for k in np.flatnonzero(passes.any(axis=(1, 2))).tolist():
        r, own = route[k], box[k]
        columns, rows = np.flatnonzero(passes[k].any(axis=0)), np.flatnonzero(passes[k].any(axis=1))
        here_low = own[:2] + own[2:] * nodes[[columns[0], rows[0]]]
        here_high = own[:2] + own[2:] * nodes[[columns[-1], rows[-1]]]
        step = 2 * own[2:] / (_COARSE - 1)
        # of two boxes of one route, keep the finer one
        if np.isfinite(low[r, 0]) and (spacing[r] < step).all() and (here_high - here_low < 3 * step).any():
            continue
        low[r], high[r] = np.minimum(low[r], here_low - step), np.maximum(high[r], here_high + step)
        spacing[r] = step
        kept.append(k)
    out, good = np.full((count, 4), np.nan), np.isfinite(low[:, 0])
    out[good, 0] = (low[good, 0] + high[good, 0]) / 2
    out[good, 2] = np.maximum((high[good, 0] - low[good, 0]) / 2, 1e-6)
    # symmetric about the plane of axis and Sun, so that one side can be mirrored
    out[good, 1], out[good, 3] = 0.0, np.maximum(np.maximum(high[good, 1], -low[good, 1]), 1e-6)
    disc = np.zeros(count)
    for k in kept:  # the last bundle of a route decides
        r, (ys, xs) = route[k], np.nonzero(passes[k])
        u, v = ((box[k, i] + box[k, 2 + i] * nodes[n] - out[r, i]) / out[r, 2 + i] for i, n in ((0, xs), (1, ys)))
        # the ellipse includes one cell beyond those that pass
        disc[r] = np.hypot(u, v).max() + 0.5 * (spacing[r] / out[r, 2:]).sum()
    return out, np.clip(disc, 1, np.sqrt(2)), kept


def _spread(
    x: F64, y: F64, fraction: F64, inside: NDArray[np.bool_], near: NDArray[np.bool_], at_entrance: F64
) -> tuple[F64, F64, NDArray[np.bool_], F64]:
    """Return peak, magnification, whether folded, and how uneven each ghost is, as in `Arrivals`.

    `x`, `y` and `fraction` [route, y, x] are lattices of rays on the sensor; `at_entrance` is the area of a cell at
    the entrance.
    """
    ax, ay = (v[:, 1:, 1:] - v[:, :-1, :-1] for v in (x, y))
    bx, by = (v[:, 1:, :-1] - v[:, :-1, 1:] for v in (x, y))
    signed = (ax * by - ay * bx) / 2
    area = np.abs(signed)
    whole = inside[:, 1:, 1:] & inside[:, :-1, :-1] & inside[:, 1:, :-1] & inside[:, :-1, 1:]
    density = fraction[:, 1:, 1:] * at_entrance[:, None, None] / np.maximum(area, 1e-9)
    peak = np.where(whole, density, 0).max(axis=(1, 2))
    seen = (whole & near[:, 1:, 1:]).reshape(len(x), -1)
    lit = np.where(seen, area.reshape(len(x), -1), 0)
    order = np.argsort(lit, axis=1)
    sorted_ = np.take_along_axis(lit, order, axis=1)
    below = np.cumsum(sorted_, axis=1)
    total = np.maximum(below[:, -1], 1e-30)
    first = (below >= _LEAST_SPREAD * total[:, None]).argmax(axis=1)
    magnification = np.sqrt(sorted_[np.arange(len(x)), first] / at_entrance)
    folded = np.where(whole, signed, 0).min(axis=(1, 2)) * np.where(whole, signed, 0).max(axis=(1, 2)) < 0
    steep = np.zeros(area.shape, dtype=bool)
    for axis in (1, 2):
        before, behind = (np.take(area, np.arange(n, area.shape[axis] - 1 + n), axis=axis) for n in (0, 1))
        jump = np.maximum(before, behind) > _UNEVEN * np.minimum(before, behind)
        both = np.take(whole, np.arange(area.shape[axis] - 1), axis=axis) & np.take(
            whole, np.arange(1, area.shape[axis]), axis=axis
        )
        jump &= both
        pad = [(0, 0), (0, 0), (0, 0)]
        for shift in (0, 1):
            pad[axis] = (shift, 1 - shift)
            steep |= np.pad(jump, pad)
    uneven = np.where(steep.reshape(len(x), -1), lit, 0).sum(axis=1) / total
    return peak, magnification, folded, uneven


def named(made: Tracer, rays: Rays, names: Collection[tuple[int, ...]]) -> NDArray[np.bool_]:
    """Return which bundles belong to the ghosts of these names, bool[bundle]."""
    wanted = set(names)
    return np.array([name_of(made.routes[r]) in wanted for r in rays.route], dtype=bool)


def traced(
    made: Tracer, rays: Rays, sun_deg: float, turn_rad: float, across: int, peak_across: int = PEAK
) -> tuple[Ghost, ...]:
    """Return flux, centroid and spread on the sensor plane of each ghost's ray bundle, `across` rays wide.

    The peak is that of `peaks` with `peak_across` rays; the rays are traced once if both numbers are the same.
    """
    pupil = np.pi / 4 * paraxial_properties(made.lens).entrance_pupil_diameter_mm ** 2
    out = []
    together = max(1, _TOGETHER // across**2)
    for first in range(0, len(rays), together):
        part = rays.take(np.arange(first, min(first + together, len(rays))))
        spots = made.trace(part, across, centred=True)
        coarse = spots if peak_across == across else made.trace(part, peak_across, centred=True)
        out += _described(made, spots, across, turn_rad, pupil, peaks(coarse, peak_across, sun_deg))
    return tuple(sorted(out, key=lambda g: g.pair))


@dataclass(frozen=True, kw_only=True, eq=False)
class GhostSpectra:
    """Hold the light of bundles, and compute with which weights their rays add to the bands.

    The light of every wavelength is that of the rays traced at the node before it and of those at the node behind
    it. The weights compare it with the light of the same rays at the node, so errors of the lattice cancel, and few
    rays are enough.

    Attributes
    ----------
    bands
        The bands; None for a tracer without.
    traced_nm
        float64[wavelength]: wavelengths of the tracer.
    nodes_nm
        float64[node]: those among them at which rays were traced here.
    light_nm
        float64[n]: wavelengths of the true light.
    true
        float64[2, bundle, n]: light of each bundle, of the rays at the nodes before and behind.
    traced
        float64[bundle, wavelength]: light that the rays carry if they are traced at the wavelengths of the tracer.
    """

    bands: Bands | None
    traced_nm: F64
    nodes_nm: F64
    light_nm: F64
    true: F64
    traced: F64

    @classmethod
    def of(cls, made: Tracer, rays: Rays, reach_mm: float = np.inf, step: int = 1) -> GhostSpectra:
        """Return the spectra of bundles; rays that arrive farther than `reach_mm` from the axis count less.

        Every `step`-th wavelength of the tracer is a node; the light of the rays is linear between the nodes.
        """
        nm, count = made.wavelength_nm, len(rays)
        if made.bands is None:
            none = np.ones((count, len(nm)))
            return cls(bands=None, traced_nm=nm, nodes_nm=nm, light_nm=nm, true=np.stack([none, none]), traced=none)
        lit, nodes = made.light_nm, np.arange(0, len(nm), step)
        across = _SPECTRUM_OF_FILMS if made.lens.film_nm > _FILMS_NM else _SPECTRUM
        before = _interval(nm[nodes], lit)
        wavelength = np.concatenate([nodes[before], nodes[before + 1], nodes])
        # the mean light around the tracer's wavelengths is before that of the bands
        light = np.concatenate([np.arange(len(lit)), np.arange(len(lit)), nodes - len(nm)])
        parts = []
        together = max(1, _SPECTRUM_AT_ONCE // (len(light) * across**2))
        for first in range(0, count, together):
            part = rays.take(np.arange(first, min(first + together, count)))
            each = replace(
                part.take(np.repeat(np.arange(len(part)), len(light))),
                wavelength=np.tile(wavelength, len(part)),
                light=np.tile(light, len(part)),
            )
            parts.append(_arriving(made.trace(each, across, centred=True), across, reach_mm).reshape(len(part), -1))
        spectra = np.concatenate(parts) if parts else np.zeros((0, len(light)))
        *true, traced = np.split(spectra, [len(lit), 2 * len(lit)], axis=1)
        traced = np.einsum("gk,kn->gn", traced, hat_weights(nm[nodes], nm))
        return cls(
            bands=made.bands, traced_nm=nm, nodes_nm=nm[nodes], light_nm=lit, true=np.stack(true), traced=traced
        )

    def take(self, chosen: NDArray[Any]) -> GhostSpectra:
        """Return the spectra of some of the bundles."""
        return replace(self, true=self.true[:, chosen], traced=self.traced[chosen])

    def of_bands(self, wavelength: int) -> F64:
        """Return the mean true light in each band over that traced at one wavelength, float64[bundle, band]."""
        traced = self.traced[:, wavelength, None]
        if self.bands is None:
            return np.ones((len(traced), 1))
        lit = self.light_nm
        shares = _sampled(self.bands, lit, self.bands.weights)
        mean = np.einsum("sgn,sbn->gb", self.true, _of_both(self.nodes_nm, lit, lit)[:, None] * shares)
        return np.asarray(np.where(traced > 0, mean / np.where(traced > 0, traced, 1), 1.0))

    def weights(self, step: int) -> F64:
        """Return the weights of rays at every `step`-th wavelength, float64[bundle, wavelength, band].

        The light of a ghost in a band is the sum of the light of its rays times these weights: each is the mean
        over the band of true light times the hat function of the wavelength, over the light of the rays.
        """
        if self.bands is None:
            return np.ones((*self.traced.shape, 1)) / self.traced.shape[1]
        # einsum, because the bits of BLAS may depend on the number of threads
        grids = (tuple(nm.tolist()) for nm in (self.nodes_nm, self.traced_nm[::step], self.light_nm))
        shares = _shares(self.bands, *grids)
        mean = np.einsum("sgn,skbn->gkb", self.true, shares)
        total = np.maximum(mean.sum(axis=1, keepdims=True), 0)  # splines may swing below 0 beside steep edges
        traced = self.traced[:, ::step, None]
        dark = traced < _DARK * traced.max(axis=1, keepdims=True, initial=0)
        mean[(mean < _LEAST_SHARE * total) | dark] = 0  # not worth the drawing
        mean *= total / np.maximum(mean.sum(axis=1, keepdims=True), 1e-300)
        return np.asarray(np.where(traced > 0, mean / np.where(traced > 0, traced, 1), 0))


def _interval(nodes_nm: F64, nm: F64) -> NDArray[np.int64]:
    """Return the index of the node before each wavelength, int64[n]."""
    return np.clip(np.searchsorted(nodes_nm, nm, side="right") - 1, 0, len(nodes_nm) - 2)


def _of_both(nodes_nm: F64, lit_nm: F64, at_nm: F64) -> F64:
    """Return the weights float64[2, ...] of rays of the nodes before and behind `lit_nm` for rays at `at_nm`."""
    before = _interval(nodes_nm, lit_nm)
    behind = np.clip((at_nm - nodes_nm[before]) / np.diff(nodes_nm)[before], 0, 1)
    return np.stack([1 - behind, behind])


@lru_cache(maxsize=16)
def _shares(
    bands: Bands, nodes_nm: tuple[float, ...], traced_nm: tuple[float, ...], light_nm: tuple[float, ...]
) -> F64:
    """Return the weights of the wavelengths of the light in the hat function of each traced wavelength.

    They are float64[2, wavelength, band, n], for the rays of the nodes before and behind each.
    """
    traced, light = np.array(traced_nm), np.array(light_nm)
    hats = _sampled(bands, light, bands.weights * hat_weights(traced, bands.wavelength_nm)[:, None])
    return _of_both(np.array(nodes_nm), light, traced[:, None])[:, :, None] * hats


def _sampled(bands: Bands, light_nm: F64, weights: F64) -> F64:
    """Return weights of the wavelengths of bands, float64[..., n], as those of values that a spline joins."""
    if len(light_nm) == len(bands.nm):
        return weights
    return np.asarray(weights @ CubicSpline(light_nm, np.eye(len(light_nm)))(bands.wavelength_nm))


def _arriving(spots: Spots, across: int, reach_mm: float) -> F64:
    """Return the mean light of the rays of each bundle that arrive near the axis, float64[bundle]."""
    be = backend()
    dr = be.dr
    away = (spots.x_mm * spots.x_mm + spots.y_mm * spots.y_mm) * dr.opaque(be.Float, reach_mm**-2)
    # where no ray passes the rims, those that nearly pass decide
    nearly = 1e-6 / (1 + spots.radius**4)
    weight = dr.maximum((_inside(spots.radius, across) + nearly) / (1 + away * away), 1e-30)
    total = dr.block_sum(be.Float64(spots.fraction * weight), across**2)
    return np.asarray(total.numpy() / dr.block_sum(be.Float64(weight), across**2).numpy())


def fluxes_mm2(made: Tracer, rays: Rays, sun_deg: float, across: int) -> F64:
    """Return the flux of each bundle on the unbounded sensor plane over the Sun's irradiance, float64[bundle].

    The bundles are traced at once, `across` rays wide.
    """
    be = backend()
    spots = made.trace(rays, across, centred=True)
    weight = be.Float64(lit_cells(spots, across))
    cell = 4 * rays.box_mm[:, 2] * rays.box_mm[:, 3] / across**2
    total = be.dr.block_sum(weight, across * across).numpy()
    return np.asarray(total * cell * np.cos(np.radians(sun_deg)))


def lit_cells(spots: Spots, across: int) -> Any:
    """Return the fraction of the light through each cell of a grid of rays that arrives, a device array."""
    return spots.fraction * _inside(spots.radius, across)


def _described(made: Tracer, spots: Spots, across: int, turn: float, pupil_mm2: float, peak: F64) -> list[Ghost]:
    """Return the ghosts of bundles that were traced together."""
    be, rays = backend(), spots.rays
    dr, Float64 = be.dr, be.Float64
    weight = Float64(lit_cells(spots, across))
    x, y = Float64(spots.x_mm), Float64(spots.y_mm)
    parts = (weight, weight * x, weight * y, weight * (x * x + y * y))
    dr.eval(*parts)
    total, mx, my, square = (dr.block_sum(v, across * across).numpy() for v in parts)
    cell = 4 * rays.box_mm[:, 2] * rays.box_mm[:, 3] / across**2
    out = []
    for k in np.flatnonzero(total > 0):
        cx, cy = mx[k] / total[k], my[k] / total[k]
        centroid = (cx * np.cos(turn) - cy * np.sin(turn), cx * np.sin(turn) + cy * np.cos(turn))
        out.append(
            Ghost(
                pair=name_of(made.routes[rays.route[k]]),  # type: ignore[arg-type]
                flux_fraction=float(total[k] * cell[k] / pupil_mm2),
                centroid_mm=(float(centroid[0]), float(centroid[1])),
                rms_radius_mm=float(np.sqrt(max(square[k] / total[k] - cx * cx - cy * cy, 0.0))),
                peak_irradiance_fraction=float(peak[k]),
            )
        )
    return out


def _inside(radius: Any, across: int) -> Any:
    """Return the fraction of each cell of a grid that lies inside the rims; 0 or 1 unless a rim crosses it."""
    be = backend()
    dr = be.dr
    each = dr.arange(be.UInt32, dr.width(radius))
    row = each // across
    ix, iy = each - row * across, row % across
    rise: Any = 0.0
    for node, step in ((ix, 1), (iy, across)):
        before = dr.gather(be.Float, radius, dr.select(node > 0, each - step, each))
        behind = dr.gather(be.Float, radius, dr.select(node < across - 1, each + step, each))
        rise = rise + dr.abs(behind - before) * 0.5
    part = dr.clip(0.5 + (1 - radius) / dr.maximum(rise, 1e-9), 0, 1)
    # where the radius jumps, a ray was lost at another rim, and the rise does not locate the edge
    return dr.select(rise < _STEEP, part, dr.select(radius <= 1, 1.0, 0.0))


def peaks(spots: Spots, across: int, sun_deg: float) -> F64:
    """Return each ghost's largest irradiance over that of the Sun, float64[bundle].

    It is taken over the cells of centred lattices, `across` rays wide. A ghost of only a few rays has no whole
    cell, and its peak is 0.
    """
    be, rays = backend(), spots.rays
    dr = be.dr
    here = dr.arange(be.UInt32, len(rays) * across**2)
    column, row = here % across, here // across % across
    inner = (column > 0) & (row > 0)
    left, below = (dr.select(inner, here - step, here) for step in (1, across))

    def at(values: Any, index: Any) -> Any:
        return dr.gather(be.Float, values, index)

    x, y, whole = spots.x_mm, spots.y_mm, inner & (spots.radius <= 1)
    for index in (left, below):
        whole &= at(spots.radius, index) <= 1
    ux, uy, vx, vy = (v - at(v, index) for index in (left, below) for v in (x, y))
    area = dr.abs(ux * vy - uy * vx)
    density = dr.select(whole & (area > 0), spots.fraction / area, 0)
    highest = dr.block_reduce(dr.ReduceOp.Max, density, across**2).numpy()
    cell = 4 * rays.box_mm[:, 2] * rays.box_mm[:, 3] / across**2
    return np.asarray(highest * cell * np.cos(np.radians(sun_deg)), dtype=np.float64)
