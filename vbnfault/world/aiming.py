"""Compute the pose of a view that aims: where the camera is, where the Sun is, and where the boresight points.

The camera is at `distance_m` from the site: straight above it or, with the aim "site", at `zenith_deg` and
`azimuth_deg` as seen from it. Angles about the line from the camera to the site count from north towards east.
The target of the boresight is

- nadir, site: the site
- limb: the outline of the shape model at `limb_turn_deg` about the line to the site
- sun: the Sun, which stands `beyond_limb_deg` outside the outline at `limb_turn_deg`
- random: a direction at `limb_turn_deg`, from the site to beyond the outline, uniform in solid angle

The target appears at `target_x_deg` and `target_y_deg` from the boresight: these are the pointing error or, for the
Sun, its position in the frame. `camera_turn_deg` turns the camera about the target. With every aim but "sun" the
Sun is at the phase angle `phase_deg` from the camera, as seen from the site, and at `sun_turn_deg` about that line.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..body import Body, Site
from ..core import frames
from ..scene.config import Scene
from ..scene.trajectory import FlownPose
from . import ephemeris

F64 = NDArray[np.float64]

# The aim "random" leaves at least this fraction of half the frame to the body.
_BODY_IN_FRAME = 0.2
# Ground near the outline is looked for this fraction of the angle inside it, where a ray does not only graze it.
_INSIDE_LIMB = 0.02


@dataclass(frozen=True, kw_only=True, eq=False)
class AimedView:
    """Hold the pose of a view that aims.

    `towards_site_T` float64[3] is the direction from the camera to the site. `towards_ground_T` float64[3] is the
    direction to the ground that the view is about; None if it is about no ground (the aims "sun" and "random").
    """

    pose: FlownPose
    towards_site_T: F64
    towards_ground_T: F64 | None


def aimed_view(scene: Scene, body: Body, site: Site, aim: str, values: Mapping[str, float]) -> AimedView:
    """Return the pose of a view.

    Parameters
    ----------
    scene
        The scene: its camera and its date.
    body, site
        The shape model, and the site in it.
    aim
        One of `aims.AIMS`.
    values
        What `aims.draw` drew for this aim.
    """
    up_L = frames.direction_L(values.get("azimuth_deg", 0.0), 90 - values.get("zenith_deg", 0.0))
    towards_site = site.T_from_L @ -up_L
    camera_T_m = site.position_T_m - values["distance_m"] * towards_site
    around = site.T_from_L @ frames.L_from_C0(-up_L, north_up=True)  # columns: image right, south, to the site
    half_deg = _half_frame_deg(scene)
    turn_deg = values.get("limb_turn_deg", 0.0)
    ground: F64 | None = towards_site
    if aim in ("nadir", "site"):
        target = towards_site
    else:
        limb_deg = limb_angle_deg(body, camera_T_m, around, turn_deg)
        if aim == "limb":
            target = _turned(around, limb_deg, turn_deg)
            ground = _turned(around, (1 - _INSIDE_LIMB) * limb_deg, turn_deg)
        elif aim == "sun":
            target, ground = _turned(around, min(limb_deg + values["beyond_limb_deg"], 180.0), turn_deg), None
        else:
            cap = np.radians(min(limb_deg + (1 - _BODY_IN_FRAME) * half_deg, 180.0))
            angle = np.arccos(1 - values["cap_fraction"] * (1 - np.cos(cap)))
            target, ground = _turned(around, float(np.degrees(angle)), turn_deg), None
    sun_T = target if aim == "sun" else _turned(around, 180 - values["phase_deg"], values["sun_turn_deg"])
    return AimedView(
        pose=FlownPose(
            name=f"a view of the aim {aim!r}",
            julian_date=scene.sun.julian_date,
            camera_position_T_m=camera_T_m,
            T_from_C=_pointed(site, target, values),
            sun_direction_T=frames.unit(sun_T),
            sun_distance_au=ephemeris.sun_distance_au(scene),
        ),
        towards_site_T=towards_site,
        towards_ground_T=ground,
    )


def limb_angle_deg(body: Body, camera_T_m: F64, around: F64, turn_deg: float) -> float:
    """Return the angle between the line to the site and the body's outline, seen from the camera.

    The half-plane at `turn_deg` about that line cuts the facets in segments. An angle from the line is monotonic
    along a segment, so the largest one is at a point where the half-plane cuts an edge.

    Parameters
    ----------
    body
        The body; the line meets it.
    camera_T_m
        float64[3].
    around
        float64[3, 3]: axes in T as columns, of which the third points at the site and the second to the south.
    turn_deg
        Angle about the line, from north towards east.
    """
    right, down, ahead = ((body.vertices_m - camera_T_m) @ around).T
    turn = np.radians(turn_deg)
    outward = np.sin(turn) * right - np.cos(turn) * down
    across = np.cos(turn) * right + np.sin(turn) * down
    first, second = (body.faces[:, columns].ravel() for columns in ([0, 1, 2], [1, 2, 0]))
    cut = (across[first] < 0) != (across[second] < 0)
    first, second = first[cut], second[cut]
    part = across[first] / (across[first] - across[second])
    out_m = outward[first] + part * (outward[second] - outward[first])
    ahead_m = ahead[first] + part * (ahead[second] - ahead[first])
    angle = np.degrees(np.arctan2(out_m, ahead_m))[out_m > 0]
    return float(angle.max()) if len(angle) else 0.0


def _half_frame_deg(scene: Scene) -> float:
    """Return half the angle across the shorter side of the frame."""
    camera = scene.camera
    slope = np.tan(np.radians(camera.fov_deg) / 2) * min(1.0, camera.height_px / camera.width_px)
    return float(np.degrees(np.arctan(slope)))


def _turned(around: F64, angle_deg: float, turn_deg: float) -> F64:
    """Return the direction in T at an angle from the line to the site, and at a turn about it."""
    angle, turn = np.radians([angle_deg, turn_deg])
    in_axes = [np.sin(angle) * np.sin(turn), -np.sin(angle) * np.cos(turn), np.cos(angle)]
    return np.asarray(around @ in_axes)


def _pointed(site: Site, target_T: F64, values: Mapping[str, float]) -> F64:
    """Return T_from_C, float64[3, 3], that shows the target at its angles from the boresight.

    Without a turn, and with the target on the boresight, north is at the top of the image.
    """
    x, y = np.tan(np.radians([values["target_x_deg"], values["target_y_deg"]]))
    to_target = frames.minimal_rotation(frames.unit(np.array([x, y, 1.0])), np.array([0.0, 0.0, 1.0]))
    L_from_C = frames.L_from_C(site.T_from_L.T @ target_T, 0.0, 0.0, values["camera_turn_deg"], north_up=True)
    return np.asarray(site.T_from_L @ L_from_C @ to_target)
