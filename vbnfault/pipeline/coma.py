"""Add the light of the dust around the body to a rendered radiance, and take away what the dust hides."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import TYPE_CHECKING

import cv2
import numpy as np

from ..core.quantities import BODY, SKY, SUN, Radiance, Truth
from ..render.description import RenderInput
from ..world import ephemeris
from ..world.coma import SHADOW_CELLS, Shadow, make_coma, sun_axes
from ..world.coma_ground import on_ground
from ..world.haze import Edges, edge_positions_px, haze, sky_around
from .spec import Pose, SampleSpec

if TYPE_CHECKING:
    from ..render import CloseUp, TerrainMesh

_EDGE_LINES = 6  # lines of sight along each side of a pixel that shows the limb
_KERNEL = np.ones((3, 3), np.uint8)


def add_coma(
    spec: SampleSpec,
    pose: Pose,
    scene: RenderInput,
    surface: TerrainMesh,
    truth: Truth,
    radiance: Radiance,
    near: CloseUp | None = None,
) -> Radiance:
    """Return the radiance before and within the scene's coma; without a coma it is returned as it is.

    `surface` is what the scene shows, `truth` is on the grid of the radiance. `near` is the close-up of a body of
    few pixels, which has its own dust.
    """
    table, terrain = spec.scene.coma, spec.terrain
    if table is None:
        return radiance
    from .. import render

    if near is not None:
        ground = truth.semantic == BODY
        truth = replace(
            truth,
            semantic=np.where(ground, np.uint8(SKY), truth.semantic),
            depth_m=np.where(ground, np.float32(np.inf), truth.depth_m),
        )
    distance_au = ephemeris.sun_distance_au(spec.scene)
    coma = make_coma(table, terrain.body, terrain.site, pose.sun_L, distance_au, spec.seed)
    axes = sun_axes(coma.outflow.sun)
    heights = render.heights_towards_sun(surface, coma.centre_L_m, axes, coma.reach_m, SHADOW_CELLS)
    shadow = Shadow.of(heights, axes, coma.reach_m)
    edges = _edges(surface, scene, truth)
    with ThreadPoolExecutor(2) as aside:  # numpy leaves the interpreter to others in the meantime
        below = None
        if table.affects_ground:
            below = aside.submit(on_ground, coma, scene.view, truth, scene.reflectance)
        light, depth = haze(coma, shadow, scene.view, truth.depth_m, truth.semantic, edges)
        if near is not None:
            rows, columns, around = sky_around(coma, shadow, scene.view, *near.corners_px, 1 / near.per_px)
            open_sky = truth.semantic[rows, columns] == SKY
            light[rows, columns] = np.where(open_sky, around, light[rows, columns])
        bands = (scene.sun.irradiance_W_m2_nm * coma.colour(scene.wavelength_nm)).tolist()
        array = np.empty_like(radiance.array)
        if below is None:
            for band, factor in enumerate(bands):
                cv2.scaleAdd(light, factor, radiance.array[band], array[band])
            return replace(radiance, array=array)
        ground = below.result()
        # of a pixel whose centre misses the ground in it, the neighbours know this ground
        here = edges.row, edges.column
        cover = (edges.semantic == BODY).mean(axis=1)
        sky, to_sun = (
            np.where(truth.semantic[here] == BODY, of[here], cv2.dilate(of, _KERNEL)[here])
            for of in (ground.sky, ground.depth_to_sun)
        )
        ground.sky[here], ground.depth_to_sun[here] = sky * cover, to_sun * (cover > 0)
        left = np.exp(-(depth + ground.depth_to_sun))

        def fill(band: int) -> None:
            factor = bands[band]
            np.multiply(radiance.array[band], left, out=array[band])
            cv2.scaleAdd(light, factor, array[band], array[band])
            cv2.scaleAdd(ground.sky, factor * float(ground.band_factor[band]), array[band], array[band])

        list(aside.map(fill, range(len(bands))))
    return replace(radiance, array=array)


def _edges(surface: TerrainMesh, scene: RenderInput, truth: Truth) -> Edges:
    """Return what lines of sight within pixels meet where neighbouring pixels show different things."""
    from .. import render

    classes = np.where(truth.semantic == SUN, np.uint8(SKY), truth.semantic)
    row, column = np.nonzero(cv2.dilate(classes, _KERNEL) != cv2.erode(classes, _KERNEL))
    if not len(row):
        nothing = np.zeros((0, _EDGE_LINES**2))
        return Edges(row=row, column=column, depth_m=nothing.astype(np.float32), semantic=nothing.astype(np.uint8))
    x, y = edge_positions_px(row, column, _EDGE_LINES)
    directions = scene.view.pixel_map.directions_of(np.stack([x, y], axis=-1))
    seen = render.truth(surface, scene.view, scene.sun, directions=directions)
    return Edges(row=row, column=column, depth_m=seen.depth_m, semantic=seen.semantic)
