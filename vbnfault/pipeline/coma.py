"""Add the light of the dust around the body to a rendered radiance."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from ..core.quantities import Radiance, Truth
from ..render.description import RenderInput
from ..world import assemble
from ..world.coma import SHADOW_CELLS, Shadow, make_coma, sun_axes
from ..world.haze import haze
from .spec import Pose, SampleSpec


def add_coma(spec: SampleSpec, pose: Pose, scene: RenderInput, truth: Truth, radiance: Radiance) -> Radiance:
    """Return the radiance with the light of the scene's coma; without a coma it is returned as it is.

    `truth` is on the grid of the radiance.
    """
    table, terrain = spec.scene.coma, spec.terrain
    if table is None:
        return radiance
    from .. import render

    distance_au = assemble.sun_distance_au(spec.scene)
    coma = make_coma(table, terrain.body, terrain.site, pose.sun_L, distance_au, spec.seed)
    axes = sun_axes(coma.outflow.sun)
    heights = render.heights_towards_sun(terrain.surface, coma.centre_L_m, axes, coma.reach_m, SHADOW_CELLS)
    shadow = Shadow.of(heights, axes, coma.reach_m)
    light = haze(coma, shadow, scene.view, truth.depth_m, truth.semantic)
    bands = scene.sun.irradiance_W_m2_nm * coma.colour(scene.wavelength_nm)
    array = np.empty_like(radiance.array)
    for band, factor in enumerate(bands):
        cv2.scaleAdd(light, float(factor), radiance.array[band], array[band])
    return replace(radiance, array=array)
