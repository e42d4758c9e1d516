"""Compute direct light: a camera ray, a point of the Sun's disc, and reflectance in all bands on the same ray.

The rays of the pixels would miss a disc smaller than a pixel. The Sun's direct image is therefore computed by
`sundisc`, and rays from the pupil to all parts of the disc show which of them are hidden.

All bands of a sample share its geometry, so spectral sampling adds no noise. The bands are the fixed quadrature
that `spectra` defines. There is no film: the samples of a pixel are summed as a block.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.quantities import Radiance, SunInView
from ..core.sundisc import Pinhole, add_mean, axes, bounds_px
from .bsdf import Reflection, has_bands
from .description import RenderInput, Sunlight, View
from .detail import Detail
from .emitter import Limb, SunDisc, mu, polynomial
from .runtime import dr, mi
from .sampling import Optics, Pixels, Strata
from .surface import TerrainMesh

# Number of values (samples × terms) kept at once. Larger images are divided into parts, so that memory is bounded
# and the values are summed while they are still near the processor.
WAVEFRONT = 1 << 23

# Dimension of a sample's random numbers for the Sun's disc. The lens uses dimension 1, bounces use the later ones.
SUN_DIMENSION = 0

# Least and greatest number of cells along each side of the grid over the Sun's disc; rays to each cell show whether
# it is hidden.
_CELLS = (128, 1024)
# Points of the pupil per cell, if the grid has the least number of cells. Several are needed because parts of a
# spacecraft a metre away are out of focus.
_PUPIL_POINTS = 4
# Steps of a sequence that is even in four dimensions: powers of 1/x, where x is the root of x⁵ = x + 1.
_KRONECKER = 1.1673039782614187 ** -np.arange(1.0, 5.0)


def direct(
    surface: TerrainMesh,
    scene: RenderInput,
    weights: NDArray[np.float64] | None = None,
    pixels: NDArray[np.uint32] | None = None,
    first: Radiance | None = None,
) -> tuple[Radiance, NDArray[np.float32]]:
    """Return the radiance of the Sun's disc and of sunlight reflected once, and an estimate of its random error.

    Parameters
    ----------
    weights
        float64[band]: weights of the bands in the signal whose error is estimated. None: the error is 0.
    pixels
        uint32[pixel]: row-major numbers of the wanted pixels. None: all pixels.
    first
        Earlier output for all pixels of the same view and Sun. Its part of the Sun, which depends on no samples, is
        used again. None: that part is computed.

    Returns
    -------
    Radiance
        Array [band, y, x], or [band, 1, pixel] for listed pixels.
    error
        float32[y, x] or [1, pixel]: half the signed difference between the mean signals of two halves of the
        pixel's samples. Its variance is that of the pixel's own error or slightly larger, because half as many
        strata leave more to chance. The Sun's disc is exact.
    """
    view = scene.view
    wanted = Pixels(view.width_px * view.height_px) if pixels is None else Pixels(len(pixels), listed=pixels)
    out, halves = _Direct(surface, scene).image(wanted, weights)
    bands, frame = len(scene.wavelength_nm), (view.height_px, view.width_px)
    sun: NDArray[np.float32] | None = None
    if first is not None:
        disc, sun = first.disc, first.sun
    elif (disc := sun_in_view(surface, view, scene.sun)) is not None:
        sun = np.zeros((bands, *frame), dtype=np.float32)
        if add_mean(sun, disc, Pinhole(view.intrinsics), range(bands)) is None:
            sun = None
    if sun is not None:
        out += sun.reshape(bands, -1) if pixels is None else sun.reshape(bands, -1)[:, pixels]
    shape = frame if pixels is None else (1, len(pixels))
    if sun is not None and pixels is not None:
        sun = sun.reshape(bands, 1, -1)[:, :, pixels]
    radiance = Radiance(
        array=out.reshape(bands, *shape),
        wavelength_nm=scene.wavelength_nm,
        sun=sun,
        disc=None if sun is None else disc,
    )
    return radiance, halves.reshape(shape)


def sun_in_view(surface: TerrainMesh, view: View, sun: Sunlight) -> SunInView | None:
    """Return the Sun's disc as the camera sees it and which parts are hidden; None if it is not in the frame.

    Rays go from the pupil to points of the disc, one or more in each cell of a grid. The position of an edge across
    the disc is then known to a cell's width, and the area on one side of it to 1e-3 of the disc.
    """
    if not _may_see(view, sun):
        return None
    disc = SunInView(
        direction_C=view.L_from_C.T @ sun.direction_L,
        angular_radius_rad=sun.angular_radius_rad,
        radiance_W_m2_sr_nm=sun.radiance_W_m2_sr_nm,
        limb_darkening=sun.limb_darkening,
        blur_slope=view.aperture_radius_m / view.focus_distance_m,
    )
    bounds = bounds_px(disc, Pinhole(view.intrinsics))
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
    rays = mi.Ray3f(mi.Point3f(*_columns(start_L)), mi.Vector3f(*_columns(towards_L)))
    hidden = surface.seen_from(view).occluded(rays, mi.Bool(True)).numpy().astype(bool)
    visible = 1 - hidden.reshape(side, side, several).mean(axis=2)
    return replace(disc, visible=visible.astype(np.float32))


def _columns(vectors: NDArray[np.float64]) -> list[Any]:
    """Return the columns of an array as drjit floats."""
    return [mi.Float(np.ascontiguousarray(column, np.float32)) for column in vectors.T]


class Light:
    """Trace the rays of a view over terrain, and test whether sunlight reaches their hits."""

    def __init__(self, surface: TerrainMesh, scene: RenderInput, *, banded: bool) -> None:
        self.surface, self.scene, self.banded = surface, scene, banded
        self.world = surface.seen_from(scene.view)
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

    def reflection(self, hit: Any, rays: Any, strata: Strata | None = None) -> Reflection:
        """Return the reflection at `hit` towards the origin of the rays.

        If `strata` of the pixel's samples are given, the finest relief turns the normals.
        """
        normal = hit.normal
        if strata is not None:
            normal = hit.shading_normal(self.detail, strata.dither())
        return Reflection(self.surface, self.scene, hit, normal, -rays.d, banded=self.banded)


class _Direct(Light):
    """Compute samples of pixels and sum their terms.

    `weights` [term, band] is the radiance per unit of each term.
    """

    def __init__(self, surface: TerrainMesh, scene: RenderInput) -> None:
        super().__init__(surface, scene, banded=has_bands(surface, scene))
        sun, model = scene.sun, scene.reflectance
        self.limb = Limb(sun)
        if self.banded:
            self.weights = np.diag(sun.irradiance_W_m2_nm)
        else:
            self.weights = self.limb.weights * (model.weights[0] * sun.irradiance_W_m2_nm)

    def image(
        self, pixels: Pixels, signal: NDArray[np.float64] | None
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Return the radiance float32[band, pixel], and float32[pixel] half the difference of the sample halves."""
        spp = self.scene.samples_per_pixel
        weights = (self.weights / spp).astype(np.float32)
        out = np.zeros((weights.shape[1], pixels.count), dtype=np.float32)
        halves = np.zeros(pixels.count, dtype=np.float32)
        done = 0
        for part in pixels.parts(max(1, WAVEFRONT // (spp * len(weights)))):
            strata = Strata(part, spp, self.scene.key)
            terms = self.terms(strata)
            if signal is not None:
                factors = weights.astype(np.float64) @ signal
                seen = sum(
                    (t * dr.opaque(mi.Float, float(s)) for t, s in zip(terms, factors, strict=True)), mi.Float(0)
                )
                terms = [*terms, seen * strata.checkered()]
            dr.eval(*terms)  # without this, every block sum would trace the rays again
            sums = [dr.block_sum(term, spp) for term in terms]
            dr.eval(*sums)
            span = slice(done, done + part.count)
            done += part.count
            for row, total in zip(weights, sums, strict=False):
                values = total.numpy()
                if not values.any():
                    continue
                for band in np.flatnonzero(row):
                    out[band, span] += values * row[band]
            if signal is not None:
                halves[span] = sums[-1].numpy()
        return out, halves

    def terms(self, strata: Strata) -> list[Any]:
        """Return what each sample adds to each term."""
        rays = self.optics.camera_rays(strata)
        hit = self.world.intersect(rays)
        point = strata.disc(SUN_DIMENSION)
        towards, lit = self.lit(hit, point)
        terms = self.reflection(hit, rays, strata).terms(towards)
        if not self.banded:
            terms = [terms[0] * profile for profile in self.limb.terms(mu(point))]
        elif self.limb.profiles is not None:
            terms = [t * polynomial(c, mu(point)) for t, c in zip(terms, self.limb.profiles, strict=True)]
        return [dr.select(lit, term, 0) for term in terms]


def _may_see(view: View, sun: Sunlight) -> bool:
    """Return whether the Sun's disc may lie in the frame.

    The margin is far larger than the lens's finite aperture.
    """
    x, y, z = view.L_from_C.T @ sun.direction_L
    fx, fy, cx, cy = view.intrinsics
    if z <= 0:
        return False
    # the tangent of the angle grows faster at the edge of a wide field
    margin = 0.02 + np.tan(2 * sun.angular_radius_rad) * (1 + (x * x + y * y) / z**2)
    across = (-cx / fx - margin, (view.width_px - cx) / fx + margin)
    along = (-cy / fy - margin, (view.height_px - cy) / fy + margin)
    return bool(across[0] <= x / z <= across[1] and along[0] <= y / z <= along[1])
