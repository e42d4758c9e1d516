"""Compute direct light: a camera ray, a point of the Sun's disc, and reflectance in all bands on the same ray.

The rays of the pixels would miss a disc smaller than a pixel. The Sun's direct image is therefore computed by
`sundisc`, and rays from the pupil to all parts of the disc show which of them are hidden.

All bands of a sample share its geometry, so spectral sampling adds no noise. The bands are the fixed quadrature
that `spectra` defines. There is no film: the samples of a pixel are summed as a block.

More rays go only where the light of a pixel varies: a pixel is divided into square cells. Along an edge, of a
shadow or of a stone, only the cells that the edge crosses need many samples: their number grows as the side of the
grid, not as its square.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.quantities import Radiance, SunInView
from ..core.sundisc import add_mean, axes, bounds_px
from .bsdf import Reflection, has_bands
from .description import RenderInput, Sunlight, View, may_see_sun
from .detail import Detail
from .runtime import columns, dr, mi
from .sampling import SUN_DIMENSION, TIME_DIMENSION, Limb, Optics, Pixels, Strata, SunDisc, mu, polynomial
from .surface import TerrainMesh

# Number of values (samples × terms) kept at once. Larger images are divided into parts, so that memory is bounded
# and the values are summed while they are still near the processor.
WAVEFRONT = 1 << 23

# Least and greatest number of cells along each side of the grid over the Sun's disc; rays to each cell show whether
# it is hidden.
_CELLS = (128, 1024)
# Points of the pupil per cell, if the grid has the least number of cells. Several are needed because parts of a
# spacecraft a metre away are out of focus.
_PUPIL_POINTS = 4
_LIMB_DIGITS = 12
# Steps of a sequence that is even in four dimensions: powers of 1/x, where x is the root of x⁵ = x + 1.
_KRONECKER = 1.1673039782614187 ** -np.arange(1.0, 5.0)


def direct(surface: TerrainMesh, scene: RenderInput) -> Radiance:
    """Return the radiance of the Sun's disc and of sunlight reflected once, [band, y, x]."""
    array, _ = Direct(surface, scene).image()
    return _with_sun(surface, scene, array)


@dataclass(frozen=True, kw_only=True, eq=False)
class Sampled:
    """Hold the radiance of `direct` with its samples.

    Attributes
    ----------
    error
        float32[y, x]: half the signed difference between the mean signals of two halves of the pixel's samples. Its
        variance is that of the pixel's own error or slightly larger, because half as many strata leave more to
        chance. The Sun's disc is exact.
    samples
        float16[pixel, sample]: the signal of each sample over that of a white Lambert surface that faces the Sun.
        The samples of a pixel are those of its strata, row by row.
    """

    radiance: Radiance
    error: NDArray[np.float32]
    samples: NDArray[np.float16]


def direct_by_sample(surface: TerrainMesh, scene: RenderInput, weights: NDArray[np.float64]) -> Sampled:
    """Return the radiance of `direct` with an estimate of its random error and the signal of each sample.

    `weights`, float64[band], are those of the bands in the signal. Points of the Sun's disc are chosen by its limb
    darkening, so that the signals of two samples differ only by what they see.
    """
    array, signals = Direct(surface, scene).image(weights)
    assert signals is not None
    halves, samples = signals
    view = scene.view
    return Sampled(
        radiance=_with_sun(surface, scene, array),
        error=halves.reshape(view.height_px, view.width_px),
        samples=samples,
    )


def _with_sun(surface: TerrainMesh, scene: RenderInput, array: NDArray[np.float32]) -> Radiance:
    """Return the radiance float32[band, pixel] with the Sun's disc added, which depends on no samples."""
    view, bands = scene.view, len(scene.wavelength_nm)
    array = array.reshape(bands, view.height_px, view.width_px)
    sun: NDArray[np.float32] | None = None
    if (disc := sun_in_view(surface, view, scene.sun)) is not None:
        sun = np.zeros(array.shape, np.float32)  # pages that stay empty take no memory
        window = add_mean(sun, disc, view.pixel_map, range(bands))
        if window is None:
            sun = None
        else:
            array[:, *window] += sun[:, *window]
    return Radiance(array=array, wavelength_nm=scene.wavelength_nm, sun=sun, disc=None if sun is None else disc)


def sun_in_view(surface: TerrainMesh, view: View, sun: Sunlight) -> SunInView | None:
    """Return the Sun's disc as the camera sees it and which parts are hidden; None if it is not in the frame.

    Rays go from the pupil to points of the disc, one or more in each cell of a grid. The position of an edge across
    the disc is then known to a cell's width, and the area on one side of it to 1e-3 of the disc. Radiance and truth
    of a view share the result.
    """
    if not may_see_sun(view, sun):
        return None
    if (kept := surface.kept_sun) is not None and kept[0] is view and kept[1] is sun:
        return kept[2]
    disc = _traced_disc(surface, view, sun)
    surface.kept_sun = view, sun, disc
    return disc


def _traced_disc(surface: TerrainMesh, view: View, sun: Sunlight) -> SunInView | None:
    """Return `sun_in_view` of a disc that may lie in the frame."""
    disc = SunInView(
        direction_C=view.L_from_C.T @ sun.direction_L,
        angular_radius_rad=sun.angular_radius_rad,
        radiance_W_m2_sr_nm=sun.radiance_W_m2_sr_nm,
        limb_darkening=sun.limb_darkening,
        blur_slope=view.aperture_radius_m / view.focus_distance_m,
    )
    bounds = bounds_px(disc, view.pixel_map)
    if bounds is None:
        return None
    # two cells per pixel if the frame resolves the disc
    wanted = 2 * float((bounds[1] - bounds[0]).max())
    side = int(np.clip(2.0 ** np.ceil(np.log2(max(wanted, 1.0))), _CELLS[0], _CELLS[1]))
    several = _PUPIL_POINTS if view.aperture_radius_m > 0 and side == _CELLS[0] else 1
    count = side * side * several
    index = np.arange(count)
    # A sequence that is even in four dimensions (Roberts 2018, after Kronecker): two for the position in the cell,
    # two for the pupil.
    u = (0.5 + index[None, :] * _KRONECKER[:, None]) % 1
    cell = index // several
    position = 2 * (np.stack([cell % side, cell // side]) + u[:2]) / side - 1
    position /= np.maximum(np.hypot(*position), 1.0)  # cells beyond the rim move onto it
    sine = np.sin(sun.angular_radius_rad)
    across = sine * position
    along = np.sqrt(1 - (across**2).sum(axis=0))
    towards_L = np.stack([*across, along], axis=1) @ axes(disc.direction_C) @ view.L_from_C.T
    radius, turn = view.aperture_radius_m * np.sqrt(u[2]), 2 * np.pi * u[3]
    start_L = (
        view.position_L_m + np.column_stack([radius * np.cos(turn), radius * np.sin(turn)]) @ view.L_from_C.T[:2]
    )
    rays = mi.Ray3f(mi.Point3f(*columns(start_L)), mi.Vector3f(*columns(towards_L)))
    hidden = surface.seen_from(view).occluded(rays, mi.Bool(True)).numpy().astype(bool)
    visible = 1 - hidden.reshape(side, side, several).mean(axis=2)
    return replace(disc, visible=visible.astype(np.float32))


class Light:
    """Trace the rays of a view over terrain, and test whether sunlight reaches their hits."""

    def __init__(self, surface: TerrainMesh, scene: RenderInput, *, banded: bool) -> None:
        self.surface, self.scene, self.banded = surface, scene, banded
        self.world = surface.seen_from(scene.view)
        self.is_empty = not scene.shows_ground and surface.vehicle is None
        self.optics, self.sun = Optics(scene.view), SunDisc(scene.sun)
        self.detail = None
        if surface.fine is not None and surface.fine.slope:
            self.detail = Detail(surface.fine, 1 / float(scene.view.intrinsics[0]))

    def lit(self, hit: Any, point_of_sun: Any, *, coherent: bool = True) -> tuple[Any, Any]:
        """Return the direction towards a point of the Sun's disc, and whether its light arrives.

        Set `coherent` where neighbouring rays are alike.
        """
        towards = self.sun.towards(point_of_sun)
        lit = hit.valid & (dr.dot(hit.normal, towards) > 0)
        lit &= ~self.world.occluded(hit.shadow_rays(towards), lit, coherent=coherent)
        return towards, lit

    def seen(self, hit: Any) -> Any:
        """Return the hits of camera rays without those on ground that the image does not show."""
        hit.start_m = self.optics.start_m
        if not self.scene.shows_ground:
            hit.valid &= hit.on_vehicle
        return hit

    def reflection(self, hit: Any, rays: Any, strata: Strata | None = None) -> Reflection:
        """Return the reflection at `hit` towards the origin of the rays.

        If `strata` of the pixel's samples are given, the finest relief turns the normals.
        """
        normal = hit.normal
        if strata is not None:
            normal = hit.shading_normal(self.detail)
        return Reflection(self.surface, self.scene, hit, normal, -rays.d, banded=self.banded)


class Direct(Light):
    """Compute samples of pixels and sum their terms.

    `weights` [term, band] is the radiance per unit of each term.
    """

    def __init__(self, surface: TerrainMesh, scene: RenderInput) -> None:
        super().__init__(surface, scene, banded=has_bands(surface, scene))
        sun, model = scene.sun, scene.reflectance
        self.limb = Limb(sun)
        thin = None if surface.vehicle is None else surface.vehicle.thin_in(scene.view)
        self._thin = None if thin is None or not thin.any() else mi.Bool(thin)
        if self.banded:
            self.weights = np.diag(sun.irradiance_W_m2_nm)
        else:
            self.weights = self.limb.weights * (model.weights[0] * sun.irradiance_W_m2_nm)

    def image(
        self, signal: NDArray[np.float64] | None = None
    ) -> tuple[NDArray[np.float32], tuple[NDArray[np.float32], NDArray[np.float16]] | None]:
        """Return the radiance of all pixels float32[band, pixel], and the signals of their samples.

        With weights `signal` of the bands, float64[band], the signals are `Sampled.error`, float32[pixel], and
        `Sampled.samples`; otherwise None.
        """
        spp, view = self.scene.samples_per_pixel, self.scene.view
        pixels = Pixels(view.width_px * view.height_px)
        weights = (self.weights / spp).astype(np.float32)
        out = np.zeros((weights.shape[1], pixels.count), dtype=np.float32)
        signals, factors, limb = None, None, None
        if signal is not None:
            signals = np.zeros(pixels.count, np.float32), np.empty((pixels.count, spp), np.float16)
            factors, limb = weights.astype(np.float64) @ signal, self.mean_limb(signal)
            white = float(signal @ self.scene.sun.irradiance_W_m2_nm) / np.pi
        if self.is_empty:
            if signals is not None:
                signals[1].fill(0)
            return out, signals

        def started(part: Pixels) -> tuple[slice, list[Any], Any]:
            """Let the kernels of a part run; return its pixels, the sums of its terms, and the samples' signals."""
            strata = Strata(part, spp, self.scene.key, limb)
            terms, samples = self.terms(strata), None
            if factors is not None:
                seen = self.signal(terms, factors)
                samples = dr.float16_array_t(mi.Float)(seen * dr.opaque(mi.Float, spp / white))
                terms.append(seen * strata.checkered())
            dr.eval(*terms, samples)  # without this, every block sum would trace the rays again
            sums = [dr.block_sum(term, spp) for term in terms]
            dr.eval(*sums)
            return slice(part.first, part.first + part.count), sums, samples

        def take(span: slice, queued_sums: list[Any], samples: Any) -> None:
            """Wait for the kernels of a part of the pixels, and add the sums of its terms to their bands."""
            sums = [total.numpy() for total in queued_sums]
            for k, (row, values) in enumerate(zip(weights, sums, strict=False)):
                if self.banded:  # the only term of its band, which is quicker than a sum
                    np.multiply(values, row[k], out=out[k, span])
                    continue
                if not values.any():
                    continue
                for band in np.flatnonzero(row):
                    out[band, span] += values * row[band]
            if signals is not None and samples is not None:
                signals[0][span] = sums[-1]
                signals[1][span] = samples.numpy().reshape(-1, spp)

        queued: tuple[slice, list[Any], Any] | None = None
        for part in pixels.parts(max(1, WAVEFRONT // (spp * len(weights)))):
            following = started(part)
            if queued is not None:  # the kernels of the next part run while numpy takes those of the last
                take(*queued)
            queued = following
        if queued is not None:
            take(*queued)
        return out, signals

    def mean_limb(self, signal: NDArray[np.float64]) -> tuple[float, ...] | None:
        """Return the limb darkening of a signal float64[band], as coefficients of powers of μ; None for none.

        Samples whose points of the Sun are chosen by it have no noise of limb darkening in this signal.
        """
        if self.limb.profiles is None:
            return None
        light = signal * self.scene.sun.irradiance_W_m2_nm
        # without the digits that rounding leaves, so that all exposures share the tables of points
        return tuple(np.round(light @ self.limb.profiles / light.sum(), _LIMB_DIGITS).tolist())

    @staticmethod
    def signal(terms: list[Any], factors: NDArray[np.float64]) -> Any:
        """Return the signal of each sample: the sum of its terms with factors float64[term]."""
        return sum((t * dr.opaque(mi.Float, float(s)) for t, s in zip(terms, factors, strict=True)), mi.Float(0))

    def terms(self, strata: Strata, rays: Any = None, facet: Any = None) -> list[Any]:
        """Return what each sample adds to each term.

        These are samples of the pixels, without facets of the spacecraft that are narrower than a pixel. With
        `rays`, they are samples of its facets `facet`.
        """
        if rays is None:
            rays = self.optics.camera_rays(strata)
            hit = self.seen(self.world.intersect(rays))
            if self._thin is not None:
                hit.valid &= ~(hit.on_vehicle & dr.gather(mi.Bool, self._thin, hit.facet, hit.on_vehicle))
        else:
            hit = self.world.intersect(rays, coherent=False)
            hit.valid &= hit.on_vehicle & (hit.facet == facet)
        point = strata.disc(SUN_DIMENSION)
        towards, lit = self.lit(hit, point)

        def sunlit() -> tuple[Any, ...]:
            """Return the terms of samples that sunlight reaches."""
            terms = self.reflection(hit, rays, strata).terms(towards)
            if not self.banded:
                terms = [terms[0] * profile for profile in self.limb.terms(mu(point))]
            elif self.limb.profiles is not None:
                terms = [t * polynomial(c, mu(point)) for t, c in zip(terms, self.limb.profiles, strict=True)]
            if strata.limb is not None:
                inverse = dr.rcp(polynomial(np.array(strata.limb), mu(point)))
                terms = [term * inverse for term in terms]
            return tuple(terms)

        # packets of samples without sunlight skip the branch
        none = tuple(mi.Float(0) for _ in range(len(self.weights)))
        return list(dr.if_stmt((), lit, sunlit, lambda: none, mode="symbolic"))


F32 = NDArray[np.float32]


# --- cells of pixels --------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True, eq=False)
class Cells:
    """Select cells of a frame's pixels.

    Attributes
    ----------
    pixel
        uint32[n]: row-major numbers of pixels.
    cell
        uint32[n]: row-major numbers of the cells within their pixels.
    side
        Number of cells along each side of a pixel, a power of two.
    """

    pixel: NDArray[np.uint32]
    cell: NDArray[np.uint32]
    side: int

    def parts(self, most: int) -> Iterator[Cells]:
        """Yield the same cells in parts of at most `most`."""
        for start in range(0, len(self.pixel), most):
            part = slice(start, start + most)
            yield Cells(pixel=self.pixel[part], cell=self.cell[part], side=self.side)


def direct_in_cells(
    surface: TerrainMesh,
    scene: RenderInput,
    weights: NDArray[np.float64],
    cells: Cells,
    samples: int,
    exposure_s: float = 0.0,
    quarters: bool = False,
) -> tuple[F32, F32, F32]:
    """Return the mean radiance of sunlight reflected once in each cell, its signal, and an estimate of its error.

    Parameters
    ----------
    weights
        float64[band]: weights of the bands in the signal.
    samples
        Number of samples of each cell, a power of two.
    exposure_s
        Time over which the samples are spread, while the camera moves; 0: at the middle of the exposure.
    quarters
        Whether the signal is that of the quarters of each cell, as far as its samples tell them apart.

    Returns
    -------
    radiance
        float32[band, cell], without the Sun's disc itself.
    signal
        float32[cell]; of quarters float32[cell, 4]: the upper left one, the upper right one, and the lower two.
    error
        float32[cell]: half the signed difference between the mean signals of two halves of the cell's samples; 0 if
        there is one sample.
    """
    tracer = Direct(surface, scene)
    per_term = (tracer.weights / samples).astype(np.float32)
    limb = tracer.mean_limb(weights)
    count = len(cells.pixel)
    out = np.zeros((per_term.shape[1], count), dtype=np.float32)
    seen, halves = np.zeros(count, dtype=np.float32), np.zeros(count, dtype=np.float32)
    sides = np.zeros((3 if quarters else 0, count), dtype=np.float32)
    factors = per_term.astype(np.float64) @ weights
    done = 0
    for part in cells.parts(max(1, WAVEFRONT // (samples * len(per_term)))):
        strata = CellStrata(part, samples, scene.key, limb, exposure_s)
        terms = tracer.terms(strata)
        total = tracer.signal(terms, factors)
        of_sides = [total * sign for sign in strata.sides()] if quarters else []
        terms = [*terms, *of_sides, total, total * strata.checkered()]
        dr.eval(*terms)
        if samples > 1:
            terms = [dr.block_sum(term, samples) for term in terms]
            dr.eval(*terms)
        span = slice(done, done + len(part.pixel))
        done += len(part.pixel)
        for row, term in zip(per_term, terms, strict=False):
            values = term.numpy()
            for band in np.flatnonzero(row):
                out[band, span] += values * row[band]
        seen[span] = terms[-2].numpy()
        for side, term in zip(sides, terms[-2 - len(sides) : -2], strict=True):
            side[span] = term.numpy()
        if samples > 1:
            halves[span] = terms[-1].numpy()
    if quarters:
        signs = np.array([(1, x, y, x * y) for y in (-1, 1) for x in (-1, 1)], np.float32)
        return out, np.concatenate([seen[None], sides]).T @ signs.T, halves
    return out, seen, halves


# These are the steps in time from one sample to the next, by the number of samples. Each was chosen among 25 random
# ones for its small error at edges that move by 1 to 20 px.
_TIME_STEPS = {4: 3, 8: 5, 16: 7, 32: 21, 64: 41, 128: 87, 256: 77, 512: 139, 1024: 657, 2048: 233, 4096: 2371}


class CellStrata(Strata):
    """Provide jittered strata of cells, each divided into `samples` of them."""

    def __init__(
        self, cells: Cells, samples: int, key: int, limb: tuple[float, ...] | None, exposure_s: float = 0.0
    ) -> None:
        bits = samples.bit_length() - 1
        # all numbers are opaque, so that one kernel serves any number of samples
        shift, last = dr.opaque(mi.UInt32, bits), dr.opaque(mi.UInt32, samples - 1)
        wavefront = dr.arange(mi.UInt32, len(cells.pixel) * samples)
        of = wavefront >> shift
        self.samples, self.limb = samples, limb
        self.pixel = dr.gather(mi.UInt32, mi.UInt32(cells.pixel), of)
        self._cell = dr.gather(mi.UInt32, mi.UInt32(cells.cell), of)
        self._number = self.pixel * (cells.side**2) + self._cell
        self.index = self._stratum = wavefront & last
        self._shift = shift
        self._key = dr.opaque(mi.UInt32, key & 0xFFFFFFFF)
        self._cells_side = cells.side
        across, down = (bits + 1) // 2, bits // 2
        self._across = dr.opaque(mi.UInt32, across)
        self._scale = [dr.opaque(mi.Float, 2.0**-n) for n in (across, down)]
        self._last_across = dr.opaque(mi.UInt32, (1 << across) - 1)
        self._last = last
        if exposure_s:
            # A lattice makes times and places of the samples even together. The inverse of its step in time gives
            # the place of each time, so that rays of one packet have like times.
            inverse = dr.opaque(mi.UInt32, pow(_TIME_STEPS[samples], -1, samples))
            self.index = (self._stratum - (self._number ^ self._key) * 0x9E3779B1) * inverse & last
        self._exposure = dr.opaque(mi.Float, exposure_s / samples) if exposure_s else None
        self._half = dr.opaque(mi.Float, exposure_s / 2)

    def square(self, dimension: int = 0) -> tuple[Any, Any]:
        """Return a uniform point of each stratum of its cell in the unit square, x and y in [0, 1]."""
        u, v = self.jitter(dimension)
        x = (mi.Float(self.index & self._last_across) + u) * self._scale[0]
        y = (mi.Float(self.index >> self._across) + v) * self._scale[1]
        side = self._cells_side
        return (mi.Float(self._cell & (side - 1)) + x) / side, (
            mi.Float(self._cell >> (side.bit_length() - 1)) + y
        ) / side

    def time_s(self) -> Any:
        """Return the time of each sample after the middle of its pixel's exposure; None: at that time."""
        if self._exposure is None:
            return None
        return (mi.Float(self._stratum) + self.jitter(TIME_DIMENSION)[0]) * self._exposure - self._half

    def jitter(self, dimension: int) -> tuple[Any, Any]:
        """Return two uniform numbers in [0, 1] per sample."""
        # a product with an odd number maps different indices to different numbers
        key = self._key ^ (0x9E3779B9 * dimension & 0xFFFFFFFF) ^ (self.index * 0x85EBCA77)
        u, v = mi.sample_tea_32(self._number, key, 4)
        return mi.Float(u) * 2.0**-32, mi.Float(v) * 2.0**-32

    def sides(self) -> tuple[Any, Any, Any]:
        """Return -1 left and +1 right in the cell, -1 above and +1 below, and their product; 0 for one stratum."""
        x = self._sign(self.index & self._last_across, self._last_across)
        y = self._sign(self.index >> self._across, self._last >> self._across)
        return x, y, x * y

    @staticmethod
    def _sign(stratum: Any, last: Any) -> Any:
        """Return -1 in the first half of strata, +1 in the second, and 0 if there is only one."""
        return dr.select(last > 0, mi.Float(dr.select(2 * stratum > last, 1, -1)), 0)

    def checkered(self) -> Any:
        """Return +1 and -1 as on a chessboard: two halves of the samples that each cover the cell."""
        parity = (self.index ^ (self.index >> self._across)) & 1
        return 1 - 2 * mi.Float(parity)
