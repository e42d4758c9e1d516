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
from .bsdf import Reflection, has_bands
from .emitter import Limb, SunDisc, mu, polynomial
from .runtime import dr, mi
from .sampling import Optics, Pixels, Strata
from .surface import Surface

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
    return estimate(surface, scene, None)[0]


def estimate(
    surface: Surface, scene: Scene, weights: NDArray[np.float64] | None, pixels: NDArray[np.uint32] | None = None
) -> tuple[Radiance, NDArray[np.float32]]:
    """Radiance, and how far chance may have moved it.

    The second array holds for every pixel half the difference between two halves of its samples, as a signal: the
    bands' sum with `weights` float64[band], signed. Its variance is that of the pixel's own error, or a little
    more, since half as many strata each leave more to chance. `pixels`: numbers of the pixels wanted, row after
    row; the arrays are then [band, 1, pixel] and [1, pixel].
    """
    view = scene.view
    wanted = Pixels(view.width_px * view.height_px) if pixels is None else Pixels(len(pixels), listed=pixels)
    out, halves = _Direct(surface, scene, weights).image(wanted)
    if scene.bounces:
        more, apart = _Indirect(surface, scene, weights).image(wanted)
        # two independent differences, as one of their joint size
        out, halves = out + more, np.copysign(np.hypot(halves, apart), halves)
    shape = (view.height_px, view.width_px) if pixels is None else (1, len(pixels))
    array = out.reshape(len(scene.wavelength_nm), *shape)
    return Radiance(array=array, wavelength_nm=scene.wavelength_nm), halves.reshape(shape)


class _Pass:
    """Samples of pixels, and the sum of their terms."""

    weights: NDArray[np.float64]  # [term, band]: radiance of a unit of each term
    banded: bool

    def __init__(
        self, surface: Surface, scene: Scene, signal: NDArray[np.float64] | None, samples_per_pixel: int, key: int
    ) -> None:
        self.surface, self.scene, self.signal = surface, scene, signal
        self.world = surface.seen_from(scene.view)
        self.samples_per_pixel, self.key = samples_per_pixel, key
        self.optics, self.sun = Optics(scene.view), SunDisc(scene.sun)

    def terms(self, strata: Strata) -> list[Any]:
        """What each sample adds to each term."""
        raise NotImplementedError

    def image(self, pixels: Pixels) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """float32[band, pixel], and float32[pixel]: half the difference of the samples' halves, as a signal."""
        spp = self.samples_per_pixel
        weights = (self.weights / spp).astype(np.float32)
        out = np.zeros((weights.shape[1], pixels.count), dtype=np.float32)
        halves = np.zeros(pixels.count, dtype=np.float32)
        done = 0
        for part in pixels.parts(max(1, _WAVEFRONT // (spp * len(weights)))):
            strata = Strata(part, spp, self.key)
            terms = self.terms(strata)
            if self.signal is not None:
                shares = weights.astype(np.float64) @ self.signal
                seen = sum(
                    (t * dr.opaque(mi.Float, float(s)) for t, s in zip(terms, shares, strict=True)), mi.Float(0)
                )
                terms = [*terms, seen * strata.checkered()]
            dr.eval(*terms)  # unevaluated, every block sum would trace the rays again
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
            if self.signal is not None:
                halves[span] = sums[-1].numpy()
        return out, halves

    def lit(self, hit: Any, point_of_sun: Any) -> tuple[Any, Any]:
        """Direction towards a point of the Sun's disc, and whether its light arrives."""
        towards = self.sun.towards(point_of_sun)
        lit = hit.valid & (dr.dot(hit.normal, towards) > 0)
        lit &= ~self.world.occluded(hit.shadow_rays(towards), lit)
        return towards, lit

    def reflection(self, hit: Any, rays: Any) -> Reflection:
        """How the ground at `hit` reflects towards where the rays come from."""
        return Reflection(self.surface, self.scene, hit, -rays.d, banded=self.banded)


class _Direct(_Pass):
    """Sunlight reflected once, and the Sun's disc itself."""

    def __init__(self, surface: Surface, scene: Scene, signal: NDArray[np.float64] | None) -> None:
        super().__init__(surface, scene, signal, scene.samples_per_pixel, scene.key)
        sun, model = scene.sun, scene.photometry
        self.limb = Limb(sun)
        self.banded = has_bands(surface, scene)
        if self.banded:
            self.weights = np.diag(sun.irradiance_W_m2_nm)
        else:
            self.weights = self.limb.weights * (model.weights[0] * sun.irradiance_W_m2_nm)
        self.sun_in_view = _may_see(scene.view, sun)
        if self.sun_in_view:
            self.weights = np.vstack([self.weights, self.limb.weights * sun.radiance_W_m2_sr_nm])

    def terms(self, strata: Strata) -> list[Any]:
        rays = self.optics.camera_rays(strata)
        hit = self.world.intersect(rays)
        point = strata.disc(_SUN)
        towards, lit = self.lit(hit, point)
        terms = self.reflection(hit, rays).terms(towards)
        if not self.banded:
            terms = [terms[0] * profile for profile in self.limb.terms(mu(point))]
        elif self.limb.profiles is not None:
            terms = [t * polynomial(c, mu(point)) for t, c in zip(terms, self.limb.profiles, strict=True)]
        terms = [dr.select(lit, term, 0) for term in terms]
        if self.sun_in_view:
            inside, mu_seen = self.sun.seen(rays.d)
            terms += [dr.select(~hit.valid & inside, t, mi.Float(0)) for t in self.limb.terms(mu_seen)]
        return terms


class _Indirect(_Pass):
    """Sunlight reflected twice or more, by ground within sight of the ground that is seen."""

    def __init__(self, surface: Surface, scene: Scene, signal: NDArray[np.float64] | None) -> None:
        spp = max(1, scene.samples_per_pixel // _INDIRECT_SHARE)
        super().__init__(surface, scene, signal, spp, scene.key ^ 0x5BD1E995)
        sun, model = scene.sun, scene.photometry
        self.banded = scene.bounces > 1 or has_bands(surface, scene)
        if self.banded:
            self.weights = np.diag(sun.irradiance_W_m2_nm)
        else:
            self.weights = (model.weights[0] ** 2 * sun.irradiance_W_m2_nm)[None, :]

    def terms(self, strata: Strata) -> list[Any]:
        rays = self.optics.camera_rays(strata)
        hit = self.world.intersect(rays)
        total, carried = None, None
        for bounce in range(self.scene.bounces):
            dimension = _FIRST_BOUNCE + 3 * bounce
            direction, factor = self.reflection(hit, rays).scattered(*strata.square(dimension))
            carried = factor if carried is None else _product(carried, factor)
            rays = hit.shadow_rays(direction)
            hit = self.world.intersect(rays, hit.valid, coherent=False)
            # the ground's own back is no ground that sends light
            hit.valid &= dr.dot(hit.normal, rays.d) < 0
            towards, lit = self.lit(hit, strata.disc(dimension + 2))
            sent = _product(carried, self.reflection(hit, rays).terms(towards))
            added = [dr.select(lit, t, 0) for t in sent]
            total = added if total is None else [a + b for a, b in zip(total, added, strict=True)]
        assert total is not None
        return total


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


def truth(surface: Surface, view: View, sun: Sunlight, *, angles: bool = False) -> Truth:
    """Depth, normal and semantic class of every pixel centre, from one pinhole ray each; with `angles` also those
    of incidence, emission and phase, and the dust."""
    optics, shape = Optics(view), (view.height_px, view.width_px)
    rays = optics.centre_rays()
    hit = surface.seen_from(view).intersect(rays)
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
    if hit.material is not None:
        semantic = dr.select(hit.on_vehicle, mi.UInt32(SPACECRAFT), semantic)
    found = {"semantic": semantic, "depth": depth}
    if angles:
        pairs = {"incidence": (normal, centre), "emission": (normal, -rays.d), "phase": (centre, -rays.d)}
        found |= {name: dr.select(hit.valid, _angle_deg(*pair), dr.nan) for name, pair in pairs.items()}
        found["dust"] = dr.select(hit.valid, hit.dust, dr.nan)
    dr.eval(*in_camera, *found.values())
    more = {"incidence": "incidence_deg", "emission": "emission_deg", "phase": "phase_deg", "dust": "dust"}
    return Truth(
        depth_m=depth.numpy().reshape(shape),
        normal=np.stack([c.numpy() for c in in_camera], axis=-1).astype(np.float16).reshape(*shape, 3),
        semantic=semantic.numpy().astype(np.uint8).reshape(shape),
        **{to: found[name].numpy().reshape(shape) for name, to in more.items() if name in found},
    )


def _angle_deg(a: Any, b: Any) -> Any:
    """Angle between unit vectors, exact near 0 and 180°, where an arccosine is not."""
    return np.degrees(2.0) * dr.atan2(dr.norm(a - b), dr.norm(a + b))
