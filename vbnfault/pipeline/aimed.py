"""Resolve the pose of a camera that aims: on the shape model first, then on the terrain that is made for the pose.

Terrain follows from the pose, as for a table of poses: near the ground a patch, from afar the whole body. It takes
seconds, so a view that the shape model itself rules out is given up before.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ..scene import plan
from ..world.aiming import AimedView, aimed_view
from .sight import grid_rays_C, lit_fraction, no_view, placed
from .spec import Pose, SampleSpec, Terrain

F64 = NDArray[np.float64]

# The site is in sight if the first ground on the line to it is at its distance. The shape model is exact but for
# the rounding of float32.
_SAME_DISTANCE = 1e-3
# A vertex is in the frame up to this fraction of the way to its border, so that the body shows in more than the
# border.
_IN_FRAME = 0.95


def resolve_aimed(spec: SampleSpec, first_try: int) -> Pose:
    """Return the pose of the first of the sample's views that meets every condition, with its terrain.

    The conditions are:

    - the camera is above the ground, and no surface lies within the clearance
    - with the aim "site", the site is in sight
    - with the aims "nadir", "limb" and "site", the ground there is in sunlight, on the shape model
    - with the aims "sun" and "random", some of the body is in the frame
    - the Sun is at an allowed angle from the boresight, unless it is the aim
    - if `sun_visibility` is "required", the whole Sun is visible where it is the aim, or a fault needs it
    - enough of the frame is sunlit ground, unless the Sun is the aim
    - the spacecraft is above the ground

    Raises
    ------
    VbnfaultError
        No view meets the conditions; the message names the sample and the unmet conditions.
    """
    assert spec.terrain_of is not None
    aim, body, site = spec.plan.aim_of(spec.index), spec.terrain.body, spec.terrain.site
    unmet: dict[str, int] = {}
    for attempt in range(first_try, first_try + spec.scene.geometry.max_tries):
        values = spec.plan.view(spec.scene, spec.index, attempt)
        view = aimed_view(spec.scene, body, site, aim, values)
        failed = _unmet_by_the_view(spec, view) or _unmet(spec, spec.terrain, view)[0]
        if not failed:
            terrain = spec.terrain_of(view.pose)
            failed, pose = _unmet(spec, terrain, view)
            if not failed:
                return replace(pose, terrain=terrain, tries=attempt + 1, variables=values)
            del terrain, pose  # release the memory before the next terrain is made
        unmet[failed] = unmet.get(failed, 0) + 1
    raise no_view(spec, f"aim {aim!r}", unmet)


def _unmet_by_the_view(spec: SampleSpec, view: AimedView) -> str:
    """Return the condition on the aim that a view does not meet on the shape model, or ""."""
    from .. import render

    aim, terrain = spec.plan.aim_of(spec.index), spec.terrain
    flown, L_from_T = view.pose, terrain.site.T_from_L.T
    if aim != "sun":
        low, high = plan.sun_elongation_deg(spec.scene)
        angle = np.degrees(np.arccos(np.clip(flown.T_from_C[:, 2] @ flown.sun_direction_T, -1, 1)))
        if not low <= angle <= high:
            return f"the Sun {low:.4g} to {high:.4g} deg from the boresight"
    if view.towards_ground_T is None:
        return "" if _body_in_frame(spec, view) else "some of the body in the frame"
    position, towards = _camera_L_m(terrain, view), L_from_T @ view.towards_ground_T
    if aim == "site":
        distance, _ = render.first_ground(terrain.surface, position, towards)
        if distance < (1 - _SAME_DISTANCE) * np.linalg.norm(position):
            return "the site in sight"
    sun_L = L_from_T @ flown.sun_direction_T
    if not render.sunlit_ground(terrain.surface, position[None], towards[None, None], sun_L[None]).all():
        return "sunlit ground where the camera aims"
    return ""


def _unmet(spec: SampleSpec, terrain: Terrain, view: AimedView) -> tuple[str, Pose]:
    """Return a condition that a view over a terrain does not meet, or "", and its pose there."""
    from .. import render

    scene, geometry, surface = spec.scene, spec.scene.geometry, terrain.surface
    aim = spec.plan.aim_of(spec.index)
    pose = placed(spec, terrain, view.pose)
    position = pose.position_L_m
    towards_site = terrain.site.T_from_L.T @ view.towards_site_T
    if not render.first_ground(surface, position, towards_site)[1]:
        return "the camera above the ground", pose
    if not render.is_clear(surface, position[None], geometry.clearance_m)[0]:
        return f"geometry.clearance_m = {geometry.clearance_m:g} m to any surface", pose
    needing = [name for name in spec.commanded_in_view if spec.faults[name].needs_sun]
    if geometry.sun_visibility == "required" and (needing or aim == "sun") and pose.sun_visible_fraction < 1:
        return "the whole Sun visible" + ("" if terrain.vehicle is None else ", past the spacecraft"), pose
    least = geometry.min_lit_fraction if aim != "sun" else 0.0
    if least:
        lit = lit_fraction(scene.camera, terrain, position[None], pose.L_from_C[None], pose.sun_L[None])[0]
        if lit < least:
            return f"geometry.min_lit_fraction = {least:g} of the frame sunlit ground", pose
    if terrain.vehicle is not None:
        parts = position + terrain.vehicle.outline_B_m @ pose.L_from_C.T
        if render.is_between(surface, position, parts):
            return "the spacecraft above the ground", pose
    return "", pose


def _body_in_frame(spec: SampleSpec, view: AimedView) -> bool:
    """Return whether a vertex of the shape model is in the frame, or one of a grid of rays meets the model.

    A body that is smaller than the grid's cells is found by its vertices, a facet that fills the frame by the rays.
    """
    from .. import render

    camera, terrain, flown = spec.scene.camera, spec.terrain, view.pose
    height_over_width = camera.height_px / camera.width_px
    slope = _IN_FRAME * np.tan(np.radians(camera.fov_deg) / 2)
    x, y, z = ((terrain.body.vertices_m - flown.camera_position_T_m) @ flown.T_from_C).T
    if ((z > 0) & (np.abs(x) < slope * z) & (np.abs(y) < slope * height_over_width * z)).any():
        return True
    position = _camera_L_m(terrain, view)
    rays_L = grid_rays_C(camera.fov_deg, height_over_width) @ flown.T_from_C.T @ terrain.site.T_from_L
    beyond_m = 2 * float(np.hypot(x, np.hypot(y, z)).max())
    return render.is_between(terrain.surface, position, position + beyond_m * rays_L)


def _camera_L_m(terrain: Terrain, view: AimedView) -> F64:
    """Return the camera's position in the terrain's L, float64[3]."""
    site = terrain.site
    return np.asarray(site.T_from_L.T @ (view.pose.camera_position_T_m - site.position_T_m))
