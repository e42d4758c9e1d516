"""Compute what each pixel centre sees, without noise: depth, normals, semantic classes and angles."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.quantities import BODY, SKY, SPACECRAFT, SUN, SunInView, Truth
from ..core.sundisc import Projection, bounds_px, pixel_sums
from .albedo import GroundPoints
from .description import Sunlight, View
from .light import sun_in_view
from .runtime import dr, mi
from .sampling import Optics, SunDisc
from .surface import TerrainMesh, facing


def truth(
    surface: TerrainMesh,
    view: View,
    sun: Sunlight,
    *,
    angles: bool = False,
    directions: NDArray[np.float64] | None = None,
    projection: Projection | None = None,
) -> Truth:
    """Return depth, normal and semantic class at every pixel centre, from one ray each.

    A pixel whose centre sees the sky has the class of the Sun if any of the visible Sun lies in it. If the Sun is
    smaller than a pixel, the pixel in which its centre is visible also has this class, whatever its own centre
    sees.

    Parameters
    ----------
    angles
        Return also the angles of incidence, emission and phase, the dust and the spacecraft's materials.
    directions
        float64[y, x, 3]: vectors along the rays in C. None: those of the view.
    projection
        The same map for all positions in these pixels. None: that of the view; with directions, no pixel has the
        Sun.
    """
    optics = Optics(view)
    shape = (view.height_px, view.width_px) if directions is None else directions.shape[:2]
    rays = optics.centre_rays() if directions is None else optics.rays_of(directions)
    hit = surface.seen_from(view).intersect(rays)
    hit.start_m = optics.start_m
    axes = optics.axes_of(shape[1], shape[0])
    depth = dr.select(hit.valid, hit.range_m * dr.dot(rays.d, axes[2]), dr.inf)
    normal = facing(hit.normal, -rays.d)
    in_camera = [dr.select(hit.valid, dr.dot(normal, axis), 0) for axis in axes]
    centre = SunDisc(sun).direction
    semantic = dr.select(hit.valid, mi.UInt32(BODY), mi.UInt32(SKY))
    if hit.material is not None:
        semantic = dr.select(hit.on_vehicle, mi.UInt32(SPACECRAFT), semantic)
    layers = {"depth_m": depth}
    if angles:
        pairs = {
            "incidence_deg": (normal, centre),
            "emission_deg": (normal, -rays.d),
            "phase_deg": (centre, -rays.d),
        }
        layers |= {name: dr.select(hit.valid, _angle_deg(*pair), dr.nan) for name, pair in pairs.items()}
        layers["dust"] = dr.select(hit.valid, hit.dust, dr.nan)
        if surface.albedo is not None:
            spacing_m = hit.range_m / float(view.intrinsics[0])
            ground = GroundPoints(
                point_L_m=hit.point, footprint_m=spacing_m, valid=hit.valid, view_L=-rays.d, sun_L=centre
            )
            layers["albedo_factor"] = dr.select(hit.valid, surface.albedo.at_reference(ground), dr.nan)
        if hit.material is not None:
            layers["material"] = dr.select(hit.on_vehicle, mi.Int32(hit.material), mi.Int32(-1))
    dr.eval(*in_camera, semantic, *layers.values())
    classes = semantic.numpy().astype(np.uint8).reshape(shape)
    disc = sun_in_view(surface, view, sun) if directions is None or projection is not None else None
    if disc is not None:
        _mark_sun(classes, disc, view.pixel_map if projection is None else projection)
    return Truth(
        normal=np.stack([c.numpy() for c in in_camera], axis=-1).astype(np.float16).reshape(*shape, 3),
        semantic=classes,
        **{name: layer.numpy().reshape(shape) for name, layer in layers.items()},
    )


def _mark_sun(classes: NDArray[np.uint8], disc: SunInView, projection: Projection) -> None:
    """Set the class of the pixels that hold any of the disc, uint8[y, x], in place."""
    sums, bounds = pixel_sums(disc, projection, (classes.shape[0], classes.shape[1])), bounds_px(disc, projection)
    if sums is None or bounds is None:
        return
    holds = sums.values[0] > 0
    part = classes[sums.rows, sums.columns]
    part[holds & (part == SKY)] = SUN
    column, row = np.floor(projection.pixel_of(disc.direction_C)).astype(int)
    middle = disc.visible.shape[0] // 2
    small = bool((bounds[1] - bounds[0] < 1).all())
    inside = 0 <= row < classes.shape[0] and 0 <= column < classes.shape[1]
    if small and inside and disc.visible[middle, middle] > 0:
        classes[row, column] = SUN


def _angle_deg(a: Any, b: Any) -> Any:
    """Return the angle between unit vectors; it is exact near 0 and 180°, where an arccosine is not."""
    # a plain float is needed: a numpy scalar would turn the result into a float64 numpy array
    return float(np.degrees(2.0)) * dr.atan2(dr.norm(a - b), dr.norm(a + b))
