"""Where a sample's camera and Sun are: what the plan proposes, settled against the terrain."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from . import frames, plan, world
from .config import SceneConfig
from .sample import Frame, Pose, SampleSpec

F64 = NDArray[np.float64]

_RESOLVE_BATCH = 8


def resolve(frame: Frame) -> None:
    """Settle height and Sun elevation against the terrain, by keyed tries of the proposal.

    A try is accepted when nothing lies within the clearance, when the spacecraft does not reach into the ground,
    when a Sun-averted camera does not look at the Sun and when a straylight sample sees the whole of it. If none
    is, the last clear one is taken. A spacecraft that SPICE places stays where it is.
    """
    from . import render

    spec = frame.spec
    if spec.scene.spice.spacecraft:
        frame.pose = _on_the_way(spec)
        return
    scene, i = spec.scene, spec.index
    samples, stratum = np.full(1, i), spec.plan.stratum[i : i + 1]
    fixed = {name: float(values[i]) for name, values in spec.plan.variables.items()}
    geometry = scene.geometry
    start = max(300.0, 2 * float(np.hypot(fixed["x_m"], fixed["y_m"])))
    surface = spec.terrain.surface
    ground = float(render.ground_height_m(surface, np.array([fixed["x_m"]]), np.array([fixed["y_m"]]), start)[0])
    needs_sun = bool(spec.plan.injects(plan.STRAYLIGHT)[i])
    least = plan.least_sun_angle_deg(scene)
    fallback: Pose | None = None
    for first in range(0, geometry.max_tries, _RESOLVE_BATCH):
        attempts = range(first, min(first + _RESOLVE_BATCH, geometry.max_tries))
        tries = [
            plan.propose(scene, samples, stratum, ("sun_elevation_deg", "height_m"), attempt)
            for attempt in attempts
        ]
        # the first try is the proposal itself, and a batch has a fixed size: one kernel for all
        elevation = np.array([float(t["sun_elevation_deg"][0]) for t in tries])
        height = np.array([float(t["height_m"][0]) for t in tries])
        position = np.column_stack(
            [np.full(len(tries), fixed["x_m"]), np.full(len(tries), fixed["y_m"]), -(ground + height)]
        )
        suns = [world.sunlight(scene, frames.direction_L(fixed["sun_azimuth_deg"], e)) for e in elevation]
        clear = render.is_clear(surface, position, geometry.clearance_m)
        visible = render.sun_visible_fraction(surface, position, suns)
        for k, attempt in enumerate(attempts):
            axes = _attitude(scene, int(stratum[0]), suns[k].direction_L, fixed)
            angle = np.degrees(np.arccos(np.clip(axes[:, 2] @ suns[k].direction_L, -1, 1)))
            averted_ok = stratum[0] != plan.SUN_AVERTED or angle >= least
            vehicle = spec.terrain.vehicle
            if vehicle is not None:
                if vehicle.blocked((axes.T @ suns[k].direction_L)[None])[0]:
                    visible[k] = 0.0
                if clear[k]:
                    parts = position[k] + vehicle.outline_B_m @ axes.T
                    clear[k] = not render.is_between(surface, position[k], parts)
            good = bool(clear[k] and averted_ok and (not needs_sun or visible[k] == 1.0))
            pose = Pose(
                position_L_m=position[k],
                L_from_C=axes,
                sun_L=suns[k].direction_L,
                sun_azimuth_deg=fixed["sun_azimuth_deg"],
                sun_elevation_deg=float(elevation[k]),
                sun_visible_fraction=float(visible[k]),
                tries=attempt + 1,
                resolved=good,
            )
            if good:
                frame.pose = pose
                return
            if fallback is None or clear[k]:
                fallback = pose
    assert fallback is not None
    frame.pose = replace(fallback, tries=geometry.max_tries)


def _on_the_way(spec: SampleSpec) -> Pose:
    """Camera and Sun where SPICE has them at the sample's epoch, which is its scene's."""
    from . import render

    scene, site, surface = spec.scene, spec.terrain.site, spec.terrain.surface
    placed = world.spacecraft_pose(scene, scene.sun.julian_date)
    sun_J_au, T_from_J = world.ephemeris(scene)
    L_from_T = site.T_from_L.T
    position = L_from_T @ (placed.camera_position_T_m - site.position_T_m)
    axes, sun_L = L_from_T @ placed.T_from_C, L_from_T @ T_from_J @ frames.unit(sun_J_au)
    visible = float(render.sun_visible_fraction(surface, position[None], [world.sunlight(scene, sun_L)])[0])
    if spec.terrain.vehicle is not None and spec.terrain.vehicle.blocked((axes.T @ sun_L)[None])[0]:
        visible = 0.0
    azimuth, elevation = frames.azimuth_elevation_deg(sun_L)
    clear = bool(render.is_clear(surface, position[None], scene.geometry.clearance_m)[0])
    return Pose(
        position_L_m=position,
        L_from_C=axes,
        sun_L=sun_L,
        sun_azimuth_deg=azimuth,
        sun_elevation_deg=elevation,
        sun_visible_fraction=visible,
        tries=1,
        resolved=clear and (visible == 1.0 or not spec.plan.injects(plan.STRAYLIGHT)[spec.index]),
    )


def _attitude(scene: SceneConfig, stratum: int, sun_L: F64, fixed: Mapping[str, float]) -> F64:
    down = np.array([0.0, 0.0, 1.0])
    reference = sun_L if plan.strata(scene)[stratum].reference == "sun" else down
    return frames.L_from_C(reference, fixed["roll_deg"], fixed["pitch_deg"], fixed["yaw_deg"])
