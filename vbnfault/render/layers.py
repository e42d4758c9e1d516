"""What every pixel centre sees, without noise: depth, normals, classes, angles."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..quantities import BODY, SKY, SPACECRAFT, SUN, Truth
from ..scene import Sunlight, View
from .emitter import SunDisc
from .runtime import dr, mi
from .sampling import Optics
from .surface import Surface, facing


def truth(
    surface: Surface, view: View, sun: Sunlight, *, angles: bool = False, slopes: NDArray[np.float64] | None = None
) -> Truth:
    """Depth, normal and semantic class of every pixel centre, from one ray each; with `angles` also those of
    incidence, emission and phase, and the dust.

    `slopes`: tangents x/z and y/z of the rays in C, float64[y, x, 2]; default: those of the view's pinhole.
    """
    optics = Optics(view)
    shape = (view.height_px, view.width_px) if slopes is None else slopes.shape[:2]
    rays = optics.centre_rays() if slopes is None else optics.rays_of(slopes)
    hit = surface.seen_from(view).intersect(rays)
    boresight = optics.axes[2]
    depth = dr.select(hit.valid, hit.distance_m * dr.dot(rays.d, boresight), dr.inf)
    normal = facing(hit.normal, -rays.d)
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
    # a plain float: a numpy scalar would make a float64 numpy array of it
    return float(np.degrees(2.0)) * dr.atan2(dr.norm(a - b), dr.norm(a + b))
