"""Collect masks, layers and scalars of a frame by the names of the dataset's arrays."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core import frames
from ..core.quantities import Sample
from ..scene import plan
from ..scene.config import Scene
from ..world import assemble
from . import labels
from .photograph import effect_of, mask_effect_of, soft_layer
from .spec import Frame, mask_any_faults, stored_layers

F64 = NDArray[np.float64]


def label(frame: Frame) -> None:
    """Compute the masks of every class, by footprint or by effect."""
    spec = frame.spec
    wanted = stored_layers(spec.scene, spec.faults)
    for name in frame.drawn:
        fault = spec.faults[name]
        needed = "mask_effect" in wanted or fault.effect_mask or labels.spreads(fault, frame.context)
        if needed and name not in frame.effects:
            frame.effects[name] = effect_of(frame, name)
    shown = frame.effects | {name: mask_effect_of(frame, name) for name in frame.effects}
    frame.mask = labels.mask_layers(spec.faults, frame.drawn, frame.context, shown)


def to_sample(frame: Frame) -> Sample:
    """Return the layers and scalars of the dataset, by the names of its arrays."""
    spec, pose, i = frame.spec, frame.pose, frame.spec.index
    site = spec.terrain.site
    names = list(spec.faults)
    available: dict[str, Any] = {
        "depth_m": frame.truth.depth_m,
        "normal": frame.truth.normal,
        "semantic": frame.truth.semantic,
        "incidence_deg": frame.truth.incidence_deg,
        "emission_deg": frame.truth.emission_deg,
        "phase_deg": frame.truth.phase_deg,
    }
    soft = {fault.soft_layer: name for name, fault in spec.faults.items() if fault.soft_layer}
    layers: dict[str, Any] = {
        "image": frame.images["image"].array,
        "clean": frame.images["clean"].array,
        "mask": frame.mask,
        "mask_any": labels.union(frame.mask, names, mask_any_faults(spec.scene, spec.faults)),
    }
    for name in stored_layers(spec.scene, spec.faults):
        if name.startswith("without_"):
            layers[name] = frame.images[name].array
        elif name == "mask_effect":
            empty = np.zeros(frame.context.shape, dtype=bool)
            layers[name] = np.stack([frame.effects.get(f, empty) for f in names])
        elif name in soft:
            layers[name] = soft_layer(frame, soft[name])
        elif name in ("raw", "defects"):
            layers[name] = getattr(frame, name)
        elif name == "radiance":
            layers[name] = frame.radiance.array
        elif name == "albedo" and frame.truth.dust is not None:
            dust, material = frame.truth.dust, frame.truth.material
            layers[name] = assemble.normal_albedo(spec.scene, dust, material, spec.terrain.vehicle)
        elif name == "point_T_m":
            layers[name] = _points_T_m(frame)
        elif name in available:
            layers[name] = available[name]
    T_from_L = site.T_from_L
    T_from_C = T_from_L @ pose.L_from_C
    sun_T = T_from_L @ pose.sun_L
    sun_xy = frame.context.sun_xy_px
    angles = tuple(pose.variables[name] for name in ("roll_deg", "pitch_deg", "yaw_deg"))
    if spec.scene.spice.spacecraft:
        angles = frames.roll_pitch_yaw_deg(pose.sun_L, pose.L_from_C)
    scalars: dict[str, Any] = {
        "injected": np.array([name in frame.drawn for name in names]),
        "camera_position_T_m": site.position_T_m + T_from_L @ pose.position_L_m,
        "position_L_m": pose.position_L_m,
        "camera_from_T": frames.quaternion(T_from_C.T),
        "T_from_L": T_from_L,
        "T_from_J": assemble.target_attitude(spec.scene, sun_T),
        "site_T_m": site.position_T_m,
        "sun_direction_T": sun_T,
        "sun_distance_au": assemble.sun_distance_au(spec.scene),
        "julian_date": spec.scene.sun.julian_date,
        "intrinsics": frame.camera.intrinsics,
        "distortion": frame.camera.lens.distortion,
        "sun_azimuth_deg": pose.sun_azimuth_deg,
        "sun_elevation_deg": pose.sun_elevation_deg,
        "roll_deg": angles[0],
        "pitch_deg": angles[1],
        "yaw_deg": angles[2],
        "sun_xy_px": np.full(2, np.nan) if sun_xy is None else sun_xy,
        "sun_visible_fraction": pose.sun_visible_fraction,
        "exposure_s": frame.camera.exposure_s,
        "samples_per_pixel": frame.samples_per_pixel,
        "noise_fraction_p99": frame.noise_fraction_p99,
        "tries": pose.tries,
        "views": frame.views,
        "resolved": pose.resolved,
        "stratum": int(spec.plan.stratum[i]),
        "site": int(spec.plan.site[i]),
        "lens": 0,
        "detector_individual": int(spec.plan.individual[i]),
        "split": plan.SPLITS[spec.plan.split[i]],
        "parameters": {
            name: {"model": spec.faults[name].model, **params} for name, params in sorted(frame.drawn.items())
        },
        "proposal": proposal(spec.scene, spec.plan, i, pose.variables),
    }
    return Sample(index=i, layers=layers, scalars=scalars)


def _points_T_m(frame: Frame) -> F64:
    """Return the surface points seen at the pixel centres in T, float64[y, x, 3] in m; NaN on the sky."""
    depth = np.where(np.isfinite(frame.truth.depth_m), frame.truth.depth_m.astype(np.float64), np.nan)
    slopes = frame.camera.seen_slopes
    seen_C = np.stack([slopes[..., 0] * depth, slopes[..., 1] * depth, depth], axis=-1)
    site, pose = frame.spec.terrain.site, frame.pose
    T_from_C = site.T_from_L @ pose.L_from_C
    camera_T_m = site.position_T_m + site.T_from_L @ pose.position_L_m
    return np.asarray(seen_C @ T_from_C.T + camera_T_m)


def proposal(scene: Scene, table: plan.Plan, index: int, variables: Mapping[str, float]) -> dict[str, Any]:
    """Return the plan's values for a sample and for the view that was kept, whose `variables` are given."""
    camera = scene.camera
    return {
        **variables,
        "injected": list(table.commanded(index)),
        # a named detector has its own architecture
        **({} if camera.detector else {"architecture": camera.architectures[int(table.architecture[index])]}),
        "readout_direction": camera.readout_directions[int(table.readout_direction[index])],
    }
