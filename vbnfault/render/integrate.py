"""Direct light: primary ray, one sample of the Sun's disc, BSDF, every band carried by the same ray.

All bands of a sample share its geometry, so spectral sampling adds no noise at all; the bands are the fixed
quadrature that `spectra` defines. There is no film: the samples of a pixel are summed as a block.
"""

from __future__ import annotations

import numpy as np

from ..quantities import Radiance, Truth
from ..scene import Scene, Sunlight, View
from .bsdf import Lambert
from .emitter import SunDisc
from .runtime import dr, mi
from .sampling import Optics, Strata
from .surface import Surface

SKY, BODY, SUN, SPACECRAFT = 0, 1, 2, 3

# Samples traced at once; larger images are cut into rows of pixels, so that memory stays bounded.
_WAVEFRONT = 1 << 24


def radiance(surface: Surface, scene: Scene) -> Radiance:
    """Radiance per band at the camera, box-filtered over each pixel."""
    view, spp = scene.view, scene.samples_per_pixel
    optics, sun, bsdf = Optics(view), SunDisc(scene.sun), Lambert(scene.reflectance)
    bands = len(scene.wavelength_nm)
    # what a unit of each summed term adds to each band: reflected light, and the Sun seen directly
    weights = np.vstack([bsdf.weights * scene.sun.irradiance_W_m2_nm, scene.sun.radiance_W_m2_sr_nm]) / spp
    out = np.empty((bands, view.width_px * view.height_px), dtype=np.float32)
    for start, stop in _slabs(view, spp):
        strata = Strata(view.width_px, stop - start, spp, scene.key, first_row=start)
        rays = optics.camera_rays(strata)
        hit = surface.intersect(rays)
        towards = sun.towards(strata.disc(0))
        cosine = dr.dot(hit.normal, towards)
        lit = hit.valid & (cosine > 0)
        lit &= ~surface.occluded(hit.shadow_rays(towards), lit)
        terms = [dr.select(lit, term, 0) for term in bsdf.terms(cosine)]
        terms.append(dr.select(~hit.valid & sun.contains(rays.d), mi.Float(1), 0))
        dr.eval(*terms)  # unevaluated, every block sum would trace the rays again
        sums = [dr.block_sum(term, spp) for term in terms]
        dr.eval(*sums)
        span = slice(start * view.width_px, stop * view.width_px)
        for k, total in enumerate(sums):
            values = total.numpy()
            for band in range(bands):
                weight = np.float32(weights[k, band])
                if k == 0:
                    np.multiply(values, weight, out=out[band, span])
                elif values.any():
                    out[band, span] += values * weight
    return Radiance(array=out.reshape(bands, view.height_px, view.width_px), wavelength_nm=scene.wavelength_nm)


def _slabs(view: View, spp: int) -> list[tuple[int, int]]:
    rows = max(1, min(view.height_px, _WAVEFRONT // (view.width_px * spp)))
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
