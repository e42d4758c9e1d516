"""Resolve a sample's camera pose and Sun: try the views of the plan against the terrain until one is usable."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from ..body import Site
from ..core import frames
from ..core.errors import InputError, VbnfaultError, shown
from ..render.description import Sunlight
from ..scene import aims, exchange, names, plan, redraw
from ..scene.instrument import CameraTable
from ..scene.trajectory import FlownPose
from ..world import ephemeris
from ..world.aiming import AimedView, aimed_view
from ..world.ground import below_ground, encloses, in_frame, nearest_ground, rays_C
from ..world.spacecraft import SpacecraftMesh
from .spec import Pose, SampleSpec, Terrain

F64 = NDArray[np.float64]
Mask = NDArray[np.bool_]

# The site is in sight if the first ground on the line to it is at its distance. The shape model is exact but for
# the rounding of float32.
_SAME_DISTANCE = 1e-3
# A vertex is in the frame up to this fraction of the way to its border, so that the body shows in more than the
# border.
_IN_FRAME = 0.95
# Number of views tried at once. Batches of one size share one compiled kernel.
_BATCH = 8
# Rays per direction that sample the frame for sunlit ground: 576 in total, so a fraction of 5 % has an error of
# 0.9 %.
_LIT_GRID = 24


def resolve(spec: SampleSpec, first_try: int = 0) -> Pose:
    """Return the pose of the first of the sample's views, in the plan's order, that meets every condition.

    The search begins at the view with index `first_try`. The conditions (`geometry`) are:

    - no surface lies within the clearance
    - camera and spacecraft are above the ground
    - a Sun-averted camera does not look at the Sun
    - if `sun_visibility` is "required", a sample whose faults need the Sun sees the whole Sun
    - enough of the frame is sunlit ground; some of it, or the Sun's disc, if samples that share the view have
      faults that need light

    A pose of a trajectory, from SPICE or from a table, is kept. Where the camera aims, `resolve_aimed` says which
    conditions hold.

    Raises
    ------
    VbnfaultError
        No view meets the conditions; the message names the sample and the unmet conditions.
    """
    if spec.scene.is_flown:
        return _on_the_trajectory(spec, spec.flown or ephemeris.flown_pose(spec.scene))
    if spec.scene.is_aimed:
        return resolve_aimed(spec, first_try)
    required = spec.scene.geometry.sun_visibility == "required"
    unmet: dict[str, int] = {}
    tries = range(first_try, first_try + spec.scene.geometry.max_tries)
    if spec.plan.group is not None:
        members = len(spec.plan.members(spec.index))
        exchanged = _exchanged(spec) if first_try == 0 else max(first_try, members)
        if not required:  # the Sun is sought, but may be missed
            sought = range(exchanged, max(exchanged, members) + exchange.KEPT_TRIES)
            pose = _first_usable(spec, sought, {}, sun_required=True)
            if pose is not None:
                return pose
            exchanged = first_try
        tries = range(exchanged, exchanged + len(tries))
    pose = _first_usable(spec, tries, unmet, sun_required=required)
    if pose is None:
        raise _no_view(spec, names.STRATA[spec.plan.stratum[spec.index]], unmet)
    return pose


def _exchanged(spec: SampleSpec) -> int:
    """Return the try with which a sample's search begins if the samples of its shard exchange positions or views.

    Each of `plan.members` takes another's position or view, so that as many of them as possible meet every
    condition, and as few as possible exchange something. A sample that is left over begins behind all of them.
    """

    def chosen() -> list[int]:
        from scipy.optimize import linear_sum_assignment

        count = len(members)
        usable = np.zeros((count, count), dtype=bool)  # of each member, by try
        for row, index in enumerate(members):
            of_member = replace(spec, index=index)
            for start in range(0, count, _BATCH):
                views = _Views.of(of_member, start)
                some = _usable(of_member, views, {}, sun_required=True)
                usable[row, start : start + _BATCH] = some[: count - start]
        rows = np.arange(count)
        attempt = (rows - rows[:, None]) % count  # [member, whose view it takes]
        takes = np.take_along_axis(usable, attempt, axis=1)
        cost = np.where(takes, np.minimum(attempt, 1), 2 * count)
        _, whose = linear_sum_assignment(cost)
        return [int(attempt[k, j]) if takes[k, j] else count for k, j in zip(rows, whose, strict=True)]

    members = spec.plan.members(spec.index)
    starts = spec.terrain.of_shard.once("exchanged", (spec.plan, members[0]), chosen)
    return starts[members.index(spec.plan.first_of_view(spec.index))]


def _first_usable(spec: SampleSpec, tries: range, unmet: dict[str, int], *, sun_required: bool) -> Pose | None:
    """Return the pose of the first of some tries that meets every condition, or None.

    The failures of each condition are counted in `unmet`.
    """
    for start in tries[::_BATCH]:
        views = _Views.of(spec, start)
        count = min(_BATCH, tries.stop - start)
        usable = _usable(spec, views, unmet, count, sun_required=sun_required)
        if usable.any():
            return views.pose(int(np.argmax(usable)), start)
    return None


@dataclass(frozen=True, kw_only=True, eq=False)
class _Views:
    """Hold a batch of views: the plan's `variables` and the values that follow from them, float64[view, ...]."""

    variables: list[dict[str, float]]
    ground_m: F64
    height_m: F64
    position_L_m: F64
    L_from_C: F64
    suns: list[Sunlight]
    sun_visible: F64 = field(default_factory=lambda: np.ones(_BATCH))

    @staticmethod
    def of(spec: SampleSpec, start: int) -> _Views:
        """Return the views of the tries from `start` on."""
        from .. import render

        scene = spec.scene
        drawn = [spec.plan.view(scene, spec.index, start + k) for k in range(_BATCH)]
        x, y, height = (np.array([d[name] for d in drawn]) for name in ("x_m", "y_m", "height_m"))
        above = max(300.0, 2 * float(np.hypot(x, y).max()))
        ground = render.ground_height_m(spec.terrain.surface, x, y, above)
        if scene.geometry.height_reference == "local_ground":
            height = ground + height
        directions = [frames.direction_L(d["sun_azimuth_deg"], d["sun_elevation_deg"]) for d in drawn]
        light = ephemeris.sunlight(scene, directions[0])
        suns = [replace(light, direction_L=direction) for direction in directions]
        position = np.column_stack([x, y, -height])
        reference = redraw.strata(scene)[spec.plan.stratum[spec.index]].reference
        towards_L = references_L(reference, spec.terrain, position, directions)
        axes = [
            frames.L_from_C(towards, d["roll_deg"], d["pitch_deg"], d["yaw_deg"], north_up=reference == "centre")
            for towards, d in zip(towards_L, drawn, strict=True)
        ]
        visible = render.sun_visible_fraction(spec.terrain.surface, position, suns, np.stack(axes))
        return _Views(
            variables=drawn,
            ground_m=ground,
            height_m=height,
            position_L_m=position,
            L_from_C=np.stack(axes),
            suns=suns,
            sun_visible=visible,
        )

    def sun_angle_deg(self) -> F64:
        """Return the angle between the boresight and the Sun, float64[view]."""
        cosine = [axes[:, 2] @ sun.direction_L for axes, sun in zip(self.L_from_C, self.suns, strict=True)]
        return np.asarray(np.degrees(np.arccos(np.clip(cosine, -1, 1))))

    def pose(self, k: int, start: int) -> Pose:
        """Return one of the views as the pose of its sample."""
        return Pose(
            position_L_m=self.position_L_m[k],
            L_from_C=self.L_from_C[k],
            sun_L=self.suns[k].direction_L,
            sun_azimuth_deg=self.variables[k]["sun_azimuth_deg"],
            sun_elevation_deg=self.variables[k]["sun_elevation_deg"],
            sun_visible_fraction=float(self.sun_visible[k]),
            tries=start + k + 1,
            variables=self.variables[k],
            resolved=True,
        )


def references_L(reference: str, terrain: Terrain, position_L_m: F64, sun_directions_L: Sequence[F64]) -> list[F64]:
    """Return the direction in L from which the attitude of each view counts; `reference` names it in the scene."""
    if reference == "sun":
        return list(sun_directions_L)
    if reference == "nadir":
        return [np.array([0.0, 0.0, 1.0])] * len(position_L_m)
    site = terrain.site
    centre_L_m = site.T_from_L.T @ (terrain.body.centre_of_mass_T_m - site.position_T_m)
    return [frames.unit(centre_L_m - camera_L_m) for camera_L_m in position_L_m]


def _usable(
    spec: SampleSpec, views: _Views, unmet: dict[str, int], count: int = _BATCH, *, sun_required: bool
) -> Mask:
    """Return which views meet every condition, bool[view], False behind the first `count`.

    If there is none, the failures of each condition are counted in `unmet`.
    """
    from .. import render

    scene, surface, vehicle = spec.scene, spec.terrain.surface, spec.terrain.vehicle
    geometry, stratum = scene.geometry, int(spec.plan.stratum[spec.index])
    clearance = f"geometry.clearance_m = {geometry.clearance_m:g} m to any surface"
    met: dict[str, Mask] = {
        "the camera above the ground": views.height_m >= views.ground_m,
        clearance: render.is_clear(surface, views.position_L_m, geometry.clearance_m),
    }
    if stratum == plan.SUN_AVERTED:
        least = redraw.least_sun_angle_deg(scene)
        met[f"the Sun at least {least:.1f} deg from the boresight"] = views.sun_angle_deg() >= least
    needing_sun = [name for name in spec.commanded_in_view if spec.faults[name].needs_sun]
    if sun_required and needing_sun:
        # with the Sun behind the camera these faults cannot show, so such a view is rejected before it is rendered
        seen = (views.sun_visible == 1.0) & (views.sun_angle_deg() < 90)
        past = "" if vehicle is None else ", past the spacecraft"
        met[f"the whole Sun visible before the camera{past}, for {', '.join(needing_sun)}"] = seen
    good = np.logical_and.reduce(list(met.values()))
    lit_fraction = redraw.strata(scene)[stratum].min_lit_fraction
    needing_light = _faults_needing_light(spec) if vehicle is None else []  # a spacecraft in view may be sunlit
    if (lit_fraction or needing_light) and good[:count].any():
        sun_L = np.stack([sun.direction_L for sun in views.suns])
        fraction = _lit_fraction(scene.camera, spec.terrain, views.position_L_m, views.L_from_C, sun_L)
        enough = fraction >= lit_fraction if lit_fraction else (fraction > 0) | _may_have_light(spec, views)
        of_the_frame = f"geometry.min_lit_fraction = {lit_fraction:g} of the frame sunlit ground"
        met[of_the_frame if lit_fraction else f"sunlit ground, for {', '.join(needing_light)}"] = enough | ~good
        good = good & enough
    good[count:] = False
    if vehicle is not None:
        above = np.ones(len(good), dtype=bool)
        for k in np.flatnonzero(good):
            parts = views.position_L_m[k] + vehicle.outline_B_m @ views.L_from_C[k].T
            above[k] = not render.is_between(surface, views.position_L_m[k], parts)
        met["the spacecraft above the ground"] = above
        good = good & above
    if good.any():
        return good
    for text, is_met in met.items():
        failed = int(np.count_nonzero(~is_met[:count]))
        if failed:
            unmet[text] = unmet.get(text, 0) + failed
    return good


def _may_have_light(spec: SampleSpec, views: _Views) -> Mask:
    """Return which views may have light although no ray of a grid meets sunlit ground, bool[view].

    The Sun's disc lies within the circle that fits into the frame, or the body is so small in the frame that it
    may lie between the rays.
    """
    camera, terrain = spec.scene.camera, spec.terrain
    half_deg = 0.5 * camera.fov_deg * min(1.0, camera.height_px / camera.width_px)
    sees_disc = (views.sun_visible > 0) & (views.sun_angle_deg() < half_deg)
    centre_L_m = terrain.site.T_from_L.T @ (terrain.body.centre_of_mass_T_m - terrain.site.position_T_m)
    diameter_m = (6 * terrain.body.volume_m3 / np.pi) ** (1 / 3)
    size_rad = diameter_m / np.linalg.norm(centre_L_m - views.position_L_m, axis=1)
    return np.asarray(sees_disc | (size_rad < 2 * np.radians(camera.fov_deg) / _LIT_GRID))


def _on_the_trajectory(spec: SampleSpec, flown: FlownPose) -> Pose:
    """Return the pose of a trajectory, from SPICE or from a table, in L.

    This pose was flown, so no other view is tried. A camera within the clearance of the ground shows that poses
    and shape do not belong together; this raises VbnfaultError, or InputError for a row inside the shape. If a
    fault needs the Sun, but the Sun is hidden or behind the camera, the pose is marked as not resolved and the
    fault is not injected.
    """
    from .. import render

    scene, surface = spec.scene, spec.terrain.surface
    pose = _placed(spec, spec.terrain, flown)
    clearance = scene.geometry.clearance_m
    body, place = spec.terrain.body, flown.camera_position_T_m
    is_inside = encloses(body, place)
    if is_inside and scene.trajectory is not None:
        raise InputError(f"sample {spec.index}: {below_ground(flown, nearest_ground(body, place)[0])}")
    up_L = spec.terrain.site.T_from_L.T @ frames.unit(place - body.centre_of_mass_T_m)
    # relief rises above the shape
    is_inside |= not render.first_ground(surface, pose.position_L_m, up_L)[1]
    if is_inside or not render.is_clear(surface, pose.position_L_m[None], clearance)[0]:
        change = "poses" if scene.trajectory else "dates"
        made_for = "poses" if scene.trajectory else "kernels"
        camera = f"the camera of row {shown(flown.name)}" if scene.trajectory else flown.name
        raise VbnfaultError(
            f"sample {spec.index}: at Julian date {flown.julian_date:.6f} {camera} is within "
            f"geometry.clearance_m = {clearance:g} m of the ground, or below it; choose other {change}, a smaller "
            f"clearance, or the body.shape that the {made_for} were made for"
        )
    needs_sun = any(spec.faults[name].needs_sun for name in spec.commanded_in_view)
    return replace(pose, resolved=pose.sees_sun or not needs_sun)


# --- a camera that aims: on the shape model first, then on the terrain that is made for the pose ------------


def resolve_aimed(spec: SampleSpec, first_try: int) -> Pose:
    """Return the pose of the first of the sample's views that meets every condition, with its terrain.

    Terrain follows from the pose, as for a table of poses: near the ground a patch, from afar the whole body. It
    takes seconds, so a view that the shape model itself rules out is given up before. The conditions are:

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
    raise _no_view(spec, f"aim {aim!r}", unmet)


def _unmet_by_the_view(spec: SampleSpec, view: AimedView) -> str:
    """Return the condition on the aim that a view does not meet on the shape model, or ""."""
    from .. import render

    aim, terrain = spec.plan.aim_of(spec.index), spec.terrain
    flown, L_from_T = view.pose, terrain.site.T_from_L.T
    if aim != "sun":
        low, high = aims.sun_elongation_deg(spec.scene)
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
    pose = _placed(spec, terrain, view.pose)
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
        lit = _lit_fraction(scene.camera, terrain, position[None], pose.L_from_C[None], pose.sun_L[None])[0]
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
    away = terrain.body.vertices_m - flown.camera_position_T_m
    if in_frame(camera, away @ flown.T_from_C, _IN_FRAME).any():
        return True
    position = _camera_L_m(terrain, view)
    rays_L = _grid_rays_C(camera) @ flown.T_from_C.T @ terrain.site.T_from_L
    beyond_m = 2 * float(np.linalg.norm(away, axis=1).max())
    return render.is_between(terrain.surface, position, position + beyond_m * rays_L)


def _camera_L_m(terrain: Terrain, view: AimedView) -> F64:
    """Return the camera's position in the terrain's L, float64[3]."""
    site = terrain.site
    return np.asarray(site.T_from_L.T @ (view.pose.camera_position_T_m - site.position_T_m))


# --- what a camera sees of ground and Sun at a pose ----------------------------------------------------------


def _placed(spec: SampleSpec, terrain: Terrain, flown: FlownPose) -> Pose:
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
        time_s=flown.time_s if flown.sequence >= 0 else None,
    )


def _no_view(spec: SampleSpec, kind: str, unmet: Mapping[str, int]) -> VbnfaultError:
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


def _faults_needing_light(spec: SampleSpec) -> list[str]:
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


def _lit_fraction(camera: CameraTable, terrain: Terrain, position_L_m: F64, L_from_C: F64, sun_L: F64) -> F64:
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
    grid_C = _grid_rays_C(camera)
    rays_L = np.einsum("vij,nj->vni", L_from_C, grid_C)
    lit = render.sunlit_ground(terrain.surface, position_L_m, rays_L, sun_L)
    if vehicle is not None:
        lit &= ~_hidden_by(vehicle, grid_C.tobytes())
    return np.asarray(lit.mean(axis=1))


def _grid_rays_C(camera: CameraTable) -> F64:
    """Return unit directions through the centres of a grid of cells over the frame, float64[ray, 3]."""
    return rays_C(camera, (np.arange(_LIT_GRID) + 0.5) / _LIT_GRID)


@lru_cache(maxsize=4)
def _hidden_by(vehicle: SpacecraftMesh, directions_C: bytes) -> Mask:
    """Return which rays of the grid meet the spacecraft, bool[ray]. They are the same in every view."""
    return vehicle.blocked(np.frombuffer(directions_C).reshape(-1, 3))
