"""Add the light of the dust around the body to a rendered radiance, and take away what the dust hides."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import cv2
import numpy as np

from ..core.quantities import Radiance, Truth
from ..render.description import RenderInput
from ..world import assemble
from ..world.coma import SHADOW_CELLS, Shadow, make_coma, sun_axes
from ..world.coma_ground import on_ground
from ..world.haze import haze
from .spec import Pose, SampleSpec


def add_coma(spec: SampleSpec, pose: Pose, scene: RenderInput, truth: Truth, radiance: Radiance) -> Radiance:
    """Return the radiance before and within the scene's coma; without a coma it is returned as it is.

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
    with ThreadPoolExecutor(2) as aside:  # numpy leaves the interpreter to others in the meantime
        below = None
        if table.affects_ground:
            below = aside.submit(on_ground, coma, scene.view, truth, scene.reflectance)
        light, depth = haze(coma, shadow, scene.view, truth.depth_m, truth.semantic)
        bands = (scene.sun.irradiance_W_m2_nm * coma.colour(scene.wavelength_nm)).tolist()
        array = np.empty_like(radiance.array)
        if below is None:
            for band, factor in enumerate(bands):
                cv2.scaleAdd(light, factor, radiance.array[band], array[band])
            return replace(radiance, array=array)
        ground = below.result()
        left = np.exp(-(depth + ground.depth_to_sun))

        def fill(band: int) -> None:
            factor = bands[band]
            np.multiply(radiance.array[band], left, out=array[band])
            cv2.scaleAdd(light, factor, array[band], array[band])
            cv2.scaleAdd(ground.sky, factor * float(ground.band_factor[band]), array[band], array[band])

        list(aside.map(fill, range(len(bands))))
    return replace(radiance, array=array)
