"""Direct light: primary ray, one sample of the Sun's disc, photometry, every band on the same ray.

All bands of a sample share its geometry, so spectral sampling adds no noise at all; the bands are the fixed
quadrature that `spectra` defines. There is no film: the samples of a pixel are summed as a block.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..quantities import Radiance
from ..scene import Scene, Sunlight, View
from .bsdf import Reflection, has_bands
from .detail import Detail
from .emitter import Limb, SunDisc, mu, polynomial
from .runtime import dr, mi
from .sampling import Optics, Pixels, Strata
from .surface import Surface

# Values kept at once, samples × terms; larger images are cut into parts, so that memory stays bounded and what is
# summed is still near the processor.
WAVEFRONT = 1 << 23

# Dimensions of a sample's random numbers: the Sun's disc; the lens takes 1, bounces the later ones.
SUN_DIMENSION = 0


def direct(
    surface: Surface,
    scene: Scene,
    weights: NDArray[np.float64] | None = None,
    pixels: NDArray[np.uint32] | None = None,
) -> tuple[Radiance, NDArray[np.float32]]:
    """Radiance of sunlight reflected once and of the Sun's disc, and how far chance may have moved it.

    The second array holds for every pixel half the difference between two halves of its samples, as a signal: the
    bands' sum with `weights` float64[band], signed; zeros without weights. Its variance is that of the pixel's own
    error, or a little more, since half as many strata each leave more to chance. `pixels`: numbers of the pixels
    wanted, row after row; the arrays are then [band, 1, pixel] and [1, pixel].
    """
    view = scene.view
    wanted = Pixels(view.width_px * view.height_px) if pixels is None else Pixels(len(pixels), listed=pixels)
    out, sun, halves = _Direct(surface, scene).image(wanted, weights)
    shape = (view.height_px, view.width_px) if pixels is None else (1, len(pixels))
    array, disc = (None if a is None else a.reshape(len(scene.wavelength_nm), *shape) for a in (out, sun))
    assert array is not None
    return Radiance(array=array, wavelength_nm=scene.wavelength_nm, sun=disc), halves.reshape(shape)


class Light:
    """Rays of a view over terrain, and sunlight that reaches where they end."""

    def __init__(self, surface: Surface, scene: Scene, *, banded: bool) -> None:
        self.surface, self.scene, self.banded = surface, scene, banded
        self.world = surface.seen_from(scene.view)
        self.optics, self.sun = Optics(scene.view), SunDisc(scene.sun)
        self.detail = None
        if surface.fine is not None and surface.fine.slope:
            self.detail = Detail(surface.fine, 1 / float(scene.view.intrinsics[0]))

    def lit(self, hit: Any, point_of_sun: Any, *, coherent: bool = True) -> tuple[Any, Any]:
        """Direction towards a point of the Sun's disc, and whether its light arrives; `coherent` where neighbours
        run alike."""
        towards = self.sun.towards(point_of_sun)
        lit = hit.valid & (dr.dot(hit.normal, towards) > 0)
        lit &= ~self.world.occluded(hit.shadow_rays(towards), lit, coherent=coherent)
        return towards, lit

    def reflection(self, hit: Any, rays: Any, strata: Strata | None = None) -> Reflection:
        """How the ground at `hit` reflects towards where the rays come from; with its finest relief where `strata`
        of the pixel's samples are given."""
        normal = hit.normal
        if strata is not None:
            normal = hit.shading_normal(self.detail, strata.dither())
        return Reflection(self.surface, self.scene, hit, normal, -rays.d, banded=self.banded)


class _Direct(Light):
    """Samples of pixels, and the sum of their terms; `weights` [term, band]: radiance of a unit of each term."""

    def __init__(self, surface: Surface, scene: Scene) -> None:
        super().__init__(surface, scene, banded=has_bands(surface, scene))
        sun, model = scene.sun, scene.photometry
        self.limb = Limb(sun)
        if self.banded:
            self.weights = np.diag(sun.irradiance_W_m2_nm)
        else:
            self.weights = self.limb.weights * (model.weights[0] * sun.irradiance_W_m2_nm)
        self.sun_in_view = _may_see(scene.view, sun)
        self.first_of_sun = len(self.weights)  # of the terms
        if self.sun_in_view:
            self.weights = np.vstack([self.weights, self.limb.weights * sun.radiance_W_m2_sr_nm])

    def image(
        self, pixels: Pixels, signal: NDArray[np.float64] | None
    ) -> tuple[NDArray[np.float32], NDArray[np.float32] | None, NDArray[np.float32]]:
        """float32[band, pixel]; of it the Sun's disc, float32[band, pixel], None where no sample sees it; and
        float32[pixel]: half the difference of the samples' halves, as a signal."""
        spp = self.scene.samples_per_pixel
        weights = (self.weights / spp).astype(np.float32)
        out = np.zeros((weights.shape[1], pixels.count), dtype=np.float32)
        sun: NDArray[np.float32] | None = None
        halves = np.zeros(pixels.count, dtype=np.float32)
        done = 0
        for part in pixels.parts(max(1, WAVEFRONT // (spp * len(weights)))):
            strata = Strata(part, spp, self.scene.key)
            terms = self.terms(strata)
            if signal is not None:
                shares = weights.astype(np.float64) @ signal
                seen = sum(
                    (t * dr.opaque(mi.Float, float(s)) for t, s in zip(terms, shares, strict=True)), mi.Float(0)
                )
                terms = [*terms, seen * strata.checkered()]
            dr.eval(*terms)  # unevaluated, every block sum would trace the rays again
            sums = [dr.block_sum(term, spp) for term in terms]
            dr.eval(*sums)
            span = slice(done, done + part.count)
            done += part.count
            for k, (row, total) in enumerate(zip(weights, sums, strict=False)):
                values = total.numpy()
                if not values.any():
                    continue
                if k >= self.first_of_sun and sun is None:
                    sun = np.zeros_like(out)
                for band in np.flatnonzero(row):
                    light = values * row[band]
                    out[band, span] += light
                    if sun is not None and k >= self.first_of_sun:
                        sun[band, span] += light
            if signal is not None:
                halves[span] = sums[-1].numpy()
        return out, sun, halves

    def terms(self, strata: Strata) -> list[Any]:
        rays = self.optics.camera_rays(strata)
        hit = self.world.intersect(rays)
        point = strata.disc(SUN_DIMENSION)
        towards, lit = self.lit(hit, point)
        terms = self.reflection(hit, rays, strata).terms(towards)
        if not self.banded:
            terms = [terms[0] * profile for profile in self.limb.terms(mu(point))]
        elif self.limb.profiles is not None:
            terms = [t * polynomial(c, mu(point)) for t, c in zip(terms, self.limb.profiles, strict=True)]
        terms = [dr.select(lit, term, 0) for term in terms]
        if self.sun_in_view:
            inside, mu_seen = self.sun.seen(rays.d)
            terms += [dr.select(~hit.valid & inside, t, mi.Float(0)) for t in self.limb.terms(mu_seen)]
        return terms


def _may_see(view: View, sun: Sunlight) -> bool:
    """Whether the Sun's disc may lie in the frame; the lens's finite aperture is far smaller than the margin."""
    x, y, z = view.L_from_C.T @ sun.direction_L
    fx, fy, cx, cy = view.intrinsics
    if z <= 0:
        return False
    # a tangent of the angle grows faster at the edge of a wide field
    margin = 0.02 + np.tan(2 * sun.angular_radius_rad) * (1 + (x * x + y * y) / z**2)
    across = (-cx / fx - margin, (view.width_px - cx) / fx + margin)
    along = (-cy / fy - margin, (view.height_px - cy) / fy + margin)
    return bool(across[0] <= x / z <= across[1] and along[0] <= y / z <= along[1])
