"""Direct and indirect light: primary ray, one sample of the Sun's disc, photometry, every band on the same ray.

All bands of a sample share its geometry, so spectral sampling adds no noise at all; the bands are the fixed
quadrature that `spectra` defines. There is no film: the samples of a pixel are summed as a block.

Light that the ground throws on itself is a few hundredths of the direct light: it is traced with a quarter of the
samples, in strata of their own, and added.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..quantities import Radiance, Truth
from ..scene import Scene, Sunlight, View
from .bsdf import Reflection
from .emitter import Limb, SunDisc, mu, polynomial
from .runtime import dr, mi
from .sampling import Optics, Strata
from .surface import Hit, Surface

SKY, BODY, SUN, SPACECRAFT = 0, 1, 2, 3

# Values kept at once, samples × terms; larger images are cut into rows of pixels, so that memory stays bounded
# and what is summed is still near the processor.
_WAVEFRONT = 1 << 23

# Indirect light takes one sample where direct light takes four.
_INDIRECT_SHARE = 4
# Dimensions of a sample's random numbers: the Sun's disc, the lens, then three a bounce.
_SUN, _LENS, _FIRST_BOUNCE = 0, 1, 2


def radiance(surface: Surface, scene: Scene) -> Radiance:
    """Radiance per band at the camera, box-filtered over each pixel."""
    out = _Direct(surface, scene).image()
    if scene.bounces:
        out += _Indirect(surface, scene).image()
    shape = (len(scene.wavelength_nm), scene.view.height_px, scene.view.width_px)
    return Radiance(array=out.reshape(shape), wavelength_nm=scene.wavelength_nm)


class _Pass:
    """Samples of every pixel, and the sum of their terms."""

    weights: NDArray[np.float64]  # [term, band]: radiance of a unit of each term

    def __init__(self, surface: Surface, scene: Scene, samples_per_pixel: int, key: int) -> None:
        self.surface, self.scene = surface, scene
        self.samples_per_pixel, self.key = samples_per_pixel, key
        self.optics, self.sun = Optics(scene.view), SunDisc(scene.sun)

    def terms(self, strata: Strata) -> list[Any]:
        """What each sample adds to each term."""
        raise NotImplementedError

    def image(self) -> NDArray[np.float32]:
        """float32[band, pixel]."""
        view, spp = self.scene.view, self.samples_per_pixel
        weights = (self.weights / spp).astype(np.float32)
        out = np.zeros((weights.shape[1], view.width_px * view.height_px), dtype=np.float32)
        for start, stop in _slabs(view, spp * len(weights)):
            terms = self.terms(Strata(view.width_px, stop - start, spp, self.key, first_row=start))
            dr.eval(*terms)  # unevaluated, every block sum would trace the rays again
            sums = [dr.block_sum(term, spp) for term in terms]
            dr.eval(*sums)
            span = slice(start * view.width_px, stop * view.width_px)
            for row, total in zip(weights, sums, strict=True):
                values = total.numpy()
                if not values.any():
                    continue
                for band in np.flatnonzero(row):
                    out[band, span] += values * row[band]
        return out

    def lit(self, hit: Hit, point_of_sun: Any) -> tuple[Any, Any]:
        """Direction towards a point of the Sun's disc, and whether its light arrives."""
        towards = self.sun.towards(point_of_sun)
        lit = hit.valid & (dr.dot(hit.normal, towards) > 0)
        lit &= ~self.surface.occluded(hit.shadow_rays(towards), lit)
        return towards, lit

    def banded(self, terms: list[Any], hit: Hit) -> list[Any]:
        """The model's terms as one a band, coloured by what covers the ground at the hit."""
        model, contrast = self.scene.photometry, self.scene.dust_contrast
        if model.terms == 1:
            terms = [terms[0] * dr.opaque(mi.Float, float(w)) for w in model.weights[0]]
        if contrast is not None:
            dust = hit.dust
            terms = [
                t * dr.fma(dust, dr.opaque(mi.Float, float(c)), 1) for t, c in zip(terms, contrast, strict=True)
            ]
        return terms


class _Direct(_Pass):
    """Sunlight reflected once, and the Sun's disc itself."""

    def __init__(self, surface: Surface, scene: Scene) -> None:
        super().__init__(surface, scene, scene.samples_per_pixel, scene.key)
        sun, model = scene.sun, scene.photometry
        self.limb = Limb(sun)
        self.per_band = model.terms > 1 or scene.dust_contrast is not None
        if self.per_band:
            self.weights = np.diag(sun.irradiance_W_m2_nm)
        else:
            self.weights = self.limb.weights * (model.weights[0] * sun.irradiance_W_m2_nm)
        self.sun_in_view = _may_see(scene.view, sun)
        if self.sun_in_view:
            self.weights = np.vstack([self.weights, self.limb.weights * sun.radiance_W_m2_sr_nm])

    def terms(self, strata: Strata) -> list[Any]:
        rays = self.optics.camera_rays(strata)
        hit = self.surface.intersect(rays)
        point = strata.disc(_SUN)
        towards, lit = self.lit(hit, point)
        terms = Reflection(self.scene.photometry, hit.normal, -rays.d).terms(towards)
        if self.per_band:
            terms = self.banded(terms, hit)
            if self.limb.profiles is not None:
                terms = [t * polynomial(c, mu(point)) for t, c in zip(terms, self.limb.profiles, strict=True)]
        else:
            terms = [terms[0] * profile for profile in self.limb.terms(mu(point))]
        terms = [dr.select(lit, term, 0) for term in terms]
        if self.sun_in_view:
            inside, mu_seen = self.sun.seen(rays.d)
            terms += [dr.select(~hit.valid & inside, t, mi.Float(0)) for t in self.limb.terms(mu_seen)]
        return terms


class _Indirect(_Pass):
    """Sunlight reflected twice or more, by ground within sight of the ground that is seen."""

    def __init__(self, surface: Surface, scene: Scene) -> None:
        spp = max(1, scene.samples_per_pixel // _INDIRECT_SHARE)
        super().__init__(surface, scene, spp, scene.key ^ 0x5BD1E995)
        sun, model = scene.sun, scene.photometry
        self.per_band = scene.bounces > 1 or model.terms > 1 or scene.dust_contrast is not None
        if self.per_band:
            self.weights = np.diag(sun.irradiance_W_m2_nm)
        else:
            self.weights = (model.weights[0] ** 2 * sun.irradiance_W_m2_nm)[None, :]

    def terms(self, strata: Strata) -> list[Any]:
        rays = self.optics.camera_rays(strata)
        hit = self.surface.intersect(rays)
        total, carried = None, None
        for bounce in range(self.scene.bounces):
            dimension = _FIRST_BOUNCE + 3 * bounce
            direction, factor = self._reflection(hit, rays).scattered(*strata.square(dimension))
            factor = self.banded(factor, hit) if self.per_band else factor
            carried = factor if carried is None else _product(carried, factor)
            rays = hit.shadow_rays(direction)
            # the ground's own back is no ground that sends light
            hit = self.surface.intersect(rays, hit.valid, coherent=False)
            hit.valid &= dr.dot(hit.normal, rays.d) < 0
            towards, lit = self.lit(hit, strata.disc(dimension + 2))
            sent = self._reflection(hit, rays).terms(towards)
            sent = self.banded(sent, hit) if self.per_band else sent
            added = [dr.select(lit, t, 0) for t in _product(carried, sent)]
            total = added if total is None else [a + b for a, b in zip(total, added, strict=True)]
        assert total is not None
        return total

    def _reflection(self, hit: Hit, rays: Any) -> Reflection:
        return Reflection(self.scene.photometry, hit.normal, -rays.d)


def _product(a: list[Any], b: list[Any]) -> list[Any]:
    return [x * y for x, y in zip(a, b, strict=True)]


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


def _slabs(view: View, values_per_pixel: int) -> list[tuple[int, int]]:
    rows = max(1, min(view.height_px, _WAVEFRONT // (view.width_px * values_per_pixel)))
    return [(r, min(r + rows, view.height_px)) for r in range(0, view.height_px, rows)]


def truth(surface: Surface, view: View, sun: Sunlight) -> Truth:
    """Depth, normal and semantic class of every pixel centre, from one pinhole ray each."""
    optics, shape = Optics(view), (view.height_px, view.width_px)
    rays = optics.centre_rays()
    hit = surface.intersect(rays)
    boresight = optics.axes[2]
    depth = dr.select(hit.valid, hit.distance_m * dr.dot(rays.d, boresight), dr.inf)
    normal = hit.normal
    in_camera = [dr.select(hit.valid, dr.dot(normal, axis), 0) for axis in optics.axes]
    # a pixel shows the Sun if its centre lies within half a pixel of the disc
    half_pixel = 0.5 / float(view.intrinsics[0])
    chord = dr.opaque(mi.Float, 2 * np.sin((sun.angular_radius_rad + half_pixel) / 2))
    centre = SunDisc(sun).direction
    in_disc = ~hit.valid & (dr.norm(rays.d - centre) < chord)
    semantic = dr.select(hit.valid, mi.UInt32(BODY), dr.select(in_disc, mi.UInt32(SUN), mi.UInt32(SKY)))
    dr.eval(depth, *in_camera, semantic)
    return Truth(
        depth_m=depth.numpy().reshape(shape),
        normal=np.stack([c.numpy() for c in in_camera], axis=-1).astype(np.float16).reshape(*shape, 3),
        semantic=semantic.numpy().astype(np.uint8).reshape(shape),
    )
