"""Compute optical flow: how far what each pixel sees has moved in the next frame of its sequence."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ..core.quantities import SPACECRAFT
from ..world import ephemeris
from .resolve import in_local_frame
from .spec import Frame

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]


def flow_px(frame: Frame, points_T_m: F64) -> F32:
    """Return how far what the pixel centres see moves to the next frame, float32[y, x, 2] columns and rows in px.

    The ground is fixed in T, and the sky, with the Sun, in J. The result is NaN for the spacecraft, for what lies
    outside the next frame or its image circle, for what is hidden there, and for all of a last frame. The ground is
    hidden if a ray from the next camera towards it ends nearer by more than the width of a pixel on the ground: the
    ray meets the ground itself with the error of float32, which is far below that.

    `points_T_m` float64[y, x, 3] are the points of the ground, NaN on the sky.
    """
    spec, camera, truth = frame.spec, frame.camera, frame.rendering.truth
    if spec.after is None:
        return np.full((*truth.semantic.shape, 2), np.nan, np.float32)
    seen, is_sky = camera.seen_directions, ~np.isfinite(truth.depth_m)
    towards_T = points_T_m - spec.after.camera_position_T_m
    towards_T[is_sky] = (seen @ _after_from_now(frame).T)[is_sky]
    towards = towards_T @ spec.after.T_from_C
    unit = towards / np.linalg.norm(towards, axis=-1, keepdims=True)
    visible = (truth.semantic != SPACECRAFT) & (unit[..., 2] > camera.projection.least_z)
    if camera.lens.calibration is not None:
        visible &= camera.lens.calibration.is_lit(unit) & camera.lens.calibration.is_lit(seen)
    with np.errstate(divide="ignore", invalid="ignore"):  # beside the camera
        after_px = camera.projection.pixel_of(unit)
        first_hit = _depth_m(frame, unit) / towards[..., 2]
    visible &= ((after_px >= 0) & (after_px < (camera.width_px, camera.height_px))).all(axis=-1)
    visible &= np.isinf(first_hit) | (~is_sky & (first_hit >= 1 - 1 / camera.intrinsics[0]))
    row, column = np.mgrid[0 : camera.height_px, 0 : camera.width_px] + 0.5
    moved_px = after_px - np.stack([column, row], axis=-1)
    return np.where(visible[..., None], moved_px, np.nan).astype(np.float32)


def _after_from_now(frame: Frame) -> F64:
    """Return the rotation of the sky, float64[3, 3]: from the camera now to T at the time of the next frame."""
    spec, after = frame.spec, frame.spec.after
    assert after is not None
    values = {"julian_date": after.julian_date, "distance_au": after.sun_distance_au}
    later = spec.scene.model_copy(update={"sun": spec.scene.sun.model_copy(update=values)})
    T_from_C = spec.terrain.site.T_from_L @ frame.pose.L_from_C
    T_from_J = ephemeris.target_attitude(spec.scene, spec.terrain.site.T_from_L @ frame.pose.sun_L)
    return np.asarray(ephemeris.target_attitude(later, after.sun_direction_T) @ T_from_J.T @ T_from_C)


def _depth_m(frame: Frame, directions: F64) -> F32:
    """Return the depth that the next frame's camera sees along directions in C, float32[y, x]; inf on the sky."""
    from .. import render

    spec, scene = frame.spec, frame.rendering.scene
    assert spec.after is not None
    pose = in_local_frame(spec.terrain.site, spec.after)
    view = replace(scene.view, position_L_m=pose.position_L_m, L_from_C=pose.L_from_C)
    return render.truth(spec.terrain.surface, view, scene.sun, directions=directions).depth_m
