"""Collect layers and scalars of a frame under the names of the dataset's arrays."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core import frames
from ..core.quantities import Sample
from ..scene import plan
from ..scene.config import Scene
from ..scene.trajectory import FlownPose
from ..world import assemble, ephemeris
from . import masks
from .flow import flow_px
from .spec import Frame, SampleSpec, stored_layers

F64 = NDArray[np.float64]

_TRUTH_LAYERS = ("depth_m", "normal", "semantic", "incidence_deg", "emission_deg", "phase_deg")


def to_sample(frame: Frame) -> Sample:
    """Return the layers and scalars of the dataset, by the names of its arrays."""
    scalars = {**_geometry(frame), **_instrument(frame), **_provenance(frame)}
    return Sample(index=frame.spec.index, layers=_layers(frame), scalars=scalars)


def _layers(frame: Frame) -> dict[str, NDArray[Any]]:
    """Return the layers that every dataset has, and the optional ones that the scene stores."""
    spec, images, labels = frame.spec, frame.images, frame.labels
    layers: dict[str, Any] = {
        "image": images.image.array,
        "clean": images.clean.array,
        "mask": labels.masks,
        "mask_any": labels.mask_any,
    }
    for name in stored_layers(spec.scene, spec.faults):
        if name.startswith("without_"):
            layers[name] = images.without[name.removeprefix("without_")].array
        elif name == "mask_effect":
            layers[name] = _effects(frame)
        elif name in labels.strengths:
            layers[name] = labels.strengths[name]
        elif name in ("raw", "defects"):
            layers[name] = getattr(images, name)
        elif name == "radiance":
            layers[name] = _as_stored(frame.exposure.light.on_image.array, spec.scene)
        elif name == "scene_radiance":
            assert frame.starless is not None
            layers[name] = _as_stored(frame.starless.array, spec.scene)
        elif name == "albedo":
            layers[name] = assemble.normal_albedo(spec.scene, frame.rendering.truth, spec.terrain.vehicle)
        elif name == "point_T_m":
            layers[name] = points_T_m(frame)
        elif name == "flow":
            layers[name] = flow_px(frame, points_T_m(frame))
        elif name in _TRUTH_LAYERS:
            layers[name] = getattr(frame.rendering.truth, name)
    return layers


def _effects(frame: Frame) -> NDArray[np.bool_]:
    """Return the effects of the classes of the scene, bool[fault, y, x], empty where a class is not injected."""
    effects, shape = frame.labels.effects, frame.labels.masks.shape
    if not effects:
        return masks.no_masks(shape)
    out = np.zeros(shape, bool)
    for k, fault in enumerate(frame.spec.faults):
        if fault in effects:
            out[k] = effects[fault]
    return out


def _as_stored(radiance: NDArray[np.float32], scene: Scene) -> NDArray[Any]:
    """Return a radiance in the data type in which the scene stores it."""
    dtype = np.dtype(scene.dataset.radiance_dtype)
    if dtype == radiance.dtype:
        return radiance
    # the Sun's disc has up to half of the greatest float16
    return np.minimum(radiance, np.finfo(dtype).max).astype(dtype)


def _geometry(frame: Frame) -> dict[str, Any]:
    """Return the position and attitude of camera, site and Sun."""
    spec, pose = frame.spec, frame.pose
    site = spec.terrain.site
    T_from_L = site.T_from_L
    sun_T = T_from_L @ pose.sun_L
    sun_xy = frame.context.sun_xy_px
    if spec.scene.is_flown or spec.scene.is_aimed:
        roll, pitch, yaw = frames.roll_pitch_yaw_deg(pose.sun_L, pose.L_from_C)
    else:
        roll, pitch, yaw = (pose.variables[name] for name in ("roll_deg", "pitch_deg", "yaw_deg"))
    return {
        "camera_position_T_m": site.position_T_m + T_from_L @ pose.position_L_m,
        "position_L_m": pose.position_L_m,
        "camera_from_T": frames.quaternion((T_from_L @ pose.L_from_C).T),
        "T_from_L": T_from_L,
        "T_from_J": ephemeris.target_attitude(spec.scene, sun_T),
        "site_T_m": site.position_T_m,
        "sun_direction_T": sun_T,
        "sun_distance_au": ephemeris.sun_distance_au(spec.scene),
        "julian_date": spec.scene.sun.julian_date,
        "sun_azimuth_deg": pose.sun_azimuth_deg,
        "sun_elevation_deg": pose.sun_elevation_deg,
        "roll_deg": roll,
        "pitch_deg": pitch,
        "yaw_deg": yaw,
        "sun_xy_px": np.full(2, np.nan) if sun_xy is None else sun_xy,
        "sun_visible_fraction": pose.sun_visible_fraction,
    }


def _instrument(frame: Frame) -> dict[str, Any]:
    """Return the parameters of camera, exposure and render."""
    return {
        "intrinsics": frame.camera.intrinsics,
        "distortion": frame.camera.lens.distortion,
        "lens": 0,
        "detector_individual": int(frame.spec.plan.individual[frame.spec.index]),
        "exposure_s": frame.camera.exposure_s,
        "samples_per_pixel": frame.rendering.samples_per_pixel,
        "noise_fraction_p99": frame.rendering.noise_fraction_p99,
    }


def _provenance(frame: Frame) -> dict[str, Any]:
    """Return what the plan says about the sample, and what became of it."""
    spec, pose, i = frame.spec, frame.pose, frame.spec.index
    return {
        "injected": np.array([name in frame.drawn for name in spec.faults]),
        "tries": pose.tries,
        "views": frame.views,
        "resolved": pose.resolved,
        "stratum": int(spec.plan.stratum[i]),
        "site": int(spec.plan.site[i]),
        "split": plan.SPLITS[spec.plan.split[i]],
        "parameters": {
            name: {"model": spec.faults[name].model, **params, **_of_event(spec, name)}
            for name, params in sorted(frame.drawn.items())
        },
        "proposal": proposal(spec.scene, spec.plan, i, pose.variables),
        **(of_sequence(spec.flown) if spec.shares_state and spec.flown else {}),
    }


def _of_event(spec: SampleSpec, fault: str) -> dict[str, Any]:
    """Return what brings a fault of a sequence, when, and how much of it is there; {} for what no event brings."""
    event = spec.event_of(fault)
    if event is None:
        return {}
    return {
        "event": {
            "cause": event.cause,
            "onset_s": event.onset_s,
            "end_s": event.end_s if np.isfinite(event.end_s) else None,
            "fraction": spec.fraction(fault),
        }
    }


def of_sequence(flown: FlownPose) -> dict[str, Any]:
    """Return the place of a pose in its sequence, and how the camera moves there."""
    names = ("sequence", "frame", "time_s", "velocity_T_m_s", "rate_C_rad_s")
    return {name: getattr(flown, name) for name in names}


def points_T_m(frame: Frame) -> F64:
    """Return the surface points seen at the pixel centres in T, float64[y, x, 3] in m; NaN on the sky."""
    depth = np.where(
        np.isfinite(frame.rendering.truth.depth_m), frame.rendering.truth.depth_m.astype(np.float64), np.nan
    )
    directions = frame.camera.seen_directions
    seen_C = directions * (depth / directions[..., 2])[..., None]
    site, pose = frame.spec.terrain.site, frame.pose
    T_from_C = site.T_from_L @ pose.L_from_C
    camera_T_m = site.position_T_m + site.T_from_L @ pose.position_L_m
    return np.asarray(seen_C @ T_from_C.T + camera_T_m)


def proposal(scene: Scene, table: plan.Plan, index: int, variables: Mapping[str, float]) -> dict[str, Any]:
    """Return the plan's values for a sample and for the view that was kept, whose `variables` are given."""
    camera = scene.camera
    return {
        **({} if scene.trajectory else variables),  # poses of a table are not drawn
        **({"aim": table.aim_of(index)} if scene.is_aimed else {}),
        "injected": list(table.commanded(index)),
        # a named detector has its own architecture
        **({} if camera.detector else {"architecture": camera.architectures[int(table.architecture[index])]}),
        "readout_direction": camera.readout_directions[int(table.readout_direction[index])],
    }
