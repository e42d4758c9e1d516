"""Compute what a camera sees of ground and Sun at a pose, before anything is rendered."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from ..body import Site
from ..core import frames
from ..core.errors import VbnfaultError
from ..scene.instrument import CameraTable
from ..scene.trajectory import FlownPose
from ..world import ephemeris
from ..world.spacecraft import SpacecraftMesh
from .spec import Pose, SampleSpec, Terrain

F64 = NDArray[np.float64]
Mask = NDArray[np.bool_]

# Rays per direction that sample the frame for sunlit ground: 576 in total, so a fraction of 5 % has an error of
# 0.9 %.
LIT_GRID = 24


def placed(spec: SampleSpec, terrain: Terrain, flown: FlownPose) -> Pose:
    """Return a pose in T as the pose of a sample over a terrain, in whose L it is. No condition is checked."""
    from .. import render

    pose = in_local_frame(terrain.site, flown)
    light = ephemeris.sunlight(spec.scene, pose.sun_L)
    position, axes = pose.position_L_m[None], pose.L_from_C[None]
    visible = float(render.sun_visible_fraction(terrain.surface, position, [light], axes)[0])
    variables = spec.plan.view(spec.scene, spec.index, 0)
    return replace(pose, sun_visible_fraction=visible, variables=variables)


def in_local_frame(site: Site, flown: FlownPose) -> Pose:
    """Return a pose in T as a pose in the L of a site, without variables and as if the whole Sun were visible."""
    L_from_T = site.T_from_L.T
    sun_L = L_from_T @ flown.sun_direction_T
    azimuth, elevation = frames.azimuth_elevation_deg(sun_L)
    return Pose(
        position_L_m=L_from_T @ (flown.camera_position_T_m - site.position_T_m),
        L_from_C=L_from_T @ flown.T_from_C,
        sun_L=sun_L,
        sun_azimuth_deg=azimuth,
        sun_elevation_deg=elevation,
        sun_visible_fraction=1.0,
        tries=1,
        variables={},
        resolved=True,
    )


def no_view(spec: SampleSpec, kind: str, unmet: Mapping[str, int]) -> VbnfaultError:
    """Return the error for a sample, of a `kind` of view, none of whose views met every condition.

    `unmet` counts the views that did not meet each condition.
    """
    tries = spec.scene.geometry.max_tries
    conditions = "; ".join(f"{text} ({n} of {tries} tries did not)" for text, n in unmet.items())
    return VbnfaultError(
        f"sample {spec.index} ({kind}, site {spec.plan.site[spec.index]}): no view met every condition in "
        f"geometry.max_tries = {tries} tries: {conditions}; widen the bounds of [geometry], relax the "
        f"condition, or raise max_tries"
    )


def faults_needing_light(spec: SampleSpec) -> list[str]:
    """Return the commanded faults in whose samples a dark view is replaced before its render.

    A single sample finds out by its render. Of samples that share a view, each would have a second view rendered
    for it, so the darkness is looked for before the render, on a grid of rays; so it is for samples that exchange
    views, of which those with the Sun have its light.
    """
    exchanges = spec.plan.group is not None
    if (spec.plan.variants == 1 and not exchanges) or spec.scene.plan.on_invisible == "drop":
        return []
    if exchanges and any(spec.faults[name].needs_sun for name in spec.commanded_in_view):
        return []
    return [name for name in spec.commanded_in_view if spec.faults[name].needs_light]


def lit_fraction(camera: CameraTable, terrain: Terrain, position_L_m: F64, L_from_C: F64, sun_L: F64) -> F64:
    """Return the fraction of each view's frame that shows sunlit ground, float64[view].

    It is counted with a grid of pinhole camera rays.

    Parameters
    ----------
    camera, terrain
        The camera, and the ground with the spacecraft that may hide it.
    position_L_m, L_from_C, sun_L
        float64[view, 3], float64[view, 3, 3], float64[view, 3].
    """
    from .. import render

    vehicle = terrain.vehicle
    rays_C = grid_rays_C(camera.fov_deg, camera.height_px / camera.width_px)
    rays_L = np.einsum("vij,nj->vni", L_from_C, rays_C)
    lit = render.sunlit_ground(terrain.surface, position_L_m, rays_L, sun_L)
    if vehicle is not None:
        lit &= ~_hidden_by(vehicle, camera.fov_deg, camera.height_px / camera.width_px)
    return np.asarray(lit.mean(axis=1))


def grid_rays_C(fov_deg: float, height_over_width: float) -> F64:
    """Return unit directions through the centres of a grid of cells over the frame, float64[ray, 3]."""
    centres = (np.arange(LIT_GRID) + 0.5) / LIT_GRID * 2 - 1
    slope = np.tan(np.radians(fov_deg) / 2)
    x, y = np.meshgrid(slope * centres, slope * height_over_width * centres)
    rays = np.stack([x, y, np.ones_like(x)], axis=-1).reshape(-1, 3)
    return np.asarray(rays / np.linalg.norm(rays, axis=1, keepdims=True))


@lru_cache(maxsize=4)
def _hidden_by(vehicle: SpacecraftMesh, fov_deg: float, height_over_width: float) -> Mask:
    """Return which rays of the grid meet the spacecraft, bool[ray]. They are the same in every view."""
    return vehicle.blocked(grid_rays_C(fov_deg, height_over_width))
