"""Add the light that the air around a body scatters to a rendered radiance."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..core.quantities import BODY, Radiance, Truth
from ..render.description import RenderInput
from .spec import SampleSpec


def add_atmosphere(spec: SampleSpec, scene: RenderInput, truth: Truth, radiance: Radiance) -> Radiance:
    """Return the radiance behind and within the scene's atmosphere; without one it is returned as it is.

    `truth` is on the grid of the radiance.
    """
    body, site = spec.scene.body, spec.terrain.site
    if body.atmosphere is None:
        return radiance
    from .. import render
    from ..render.atmosphere import rayleigh_depth

    air = render.Air(
        semi_axes_m=np.array(body.semi_axes_m),
        centre_L_m=-site.T_from_L.T @ site.position_T_m,
        T_from_L=site.T_from_L,
        optical_depth=rayleigh_depth(scene.wavelength_nm, body.atmosphere.optical_depth),
        scale_height_m=body.atmosphere.scale_height_m,
    )
    is_ground = truth.semantic == BODY
    added, left = render.air_light(air, scene.view, scene.sun.direction_L, truth.depth_m, is_ground)
    sunlight = scene.sun.irradiance_W_m2_nm.astype(np.float32)[:, None, None]
    return replace(radiance, array=radiance.array * left + sunlight * added)
