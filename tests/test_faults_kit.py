"""Cameras, contexts and images for the tests of faults; no tests of its own."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from vbnfault.camera import Camera, focal_length_mm
from vbnfault.core.quantities import RGBI, Charge, Electrons, Offset, Quantity, RawMosaic
from vbnfault.detector import MosaicDetector, ThreeColourDetector, load_sensor
from vbnfault.faults import Fault, FaultContext, from_dict
from vbnfault.lens import ThinLens

FOV_DEG = 40.0


def make_context(
    width: int = 1024,
    height: int | None = None,
    sun: tuple[float, float] | None = None,
    visible: float = 1.0,
    fov_deg: float = FOV_DEG,
    **camera: Any,
) -> FaultContext:
    """A context with a thin lens of `fov_deg` across the width; height as width unless given."""
    detector = ThreeColourDetector(width_px=width, height_px=height or width)
    focal = focal_length_mm(fov_deg, width, detector.pixel_pitch_um)
    return FaultContext(
        camera=Camera(lens=ThinLens(focal_length_mm=focal, f_number=4.0), detector=detector, **camera),
        sun_xy_px=None if sun is None else np.array(sun),
        sun_visible_fraction=None if sun is None else visible,
    )


def with_mosaic(context: FaultContext, **sensor: Any) -> FaultContext:
    """The same with a mosaic detector, a CCD where the camera's architecture is one; `sensor` changes its keys."""
    camera = context.camera
    made = load_sensor("generic_ccd" if camera.is_ccd else "generic_cmos")
    if camera.architecture == "frame_transfer_ccd":
        made = replace(made, transfer=replace(made.transfer, row_transfer_s=1e-6))
    made = replace(made, architecture=camera.architecture, **sensor)
    height, width = context.shape
    direction = camera.readout_direction if camera.readout_direction in ("up", "down") else "up"
    detector = MosaicDetector(sensor=made, seed=3, width_px=width, height_px=height, direction=direction)
    return replace(context, camera=replace(camera, detector=detector))


def noisy(step: str, context: FaultContext, seed: int = 0) -> Quantity:
    """A quantity of a fault's step, random over all that it may be."""
    if step == "electrons":
        return noisy_electrons(context, seed)
    if step == "rgbi":
        return noisy_rgbi(context, seed)
    detector = context.camera.detector
    assert isinstance(detector, MosaicDetector)
    generator, readout = np.random.default_rng(seed), detector.sensor.readout
    if step == "raw":
        return RawMosaic(array=generator.integers(0, readout.top_dn + 1, context.shape, dtype=np.uint16))
    if step == "offsets":
        return Offset(array=generator.normal(0, 100, context.shape).astype(np.float32))
    return Charge(array=generator.uniform(0, 2 * readout.full_well_e, context.shape).astype(np.float32))


def inside(fault: Fault, params: dict[str, Any], context: FaultContext) -> dict[str, Any]:
    """What a fault does inside a detector with a mosaic, at all its steps."""
    return {step: [fault.act_at(step, params, context)] for step in fault.steps}


def flat_electrons(context: FaultContext, share: float = 0.5) -> Electrons:
    """Every pixel at `share` of white."""
    white = context.camera.detector.white_e
    return Electrons(array=np.full((*context.shape, len(white)), share, np.float32) * white, white_e=white)


def noisy_electrons(context: FaultContext, seed: int = 0) -> Electrons:
    """Random signal from 0 to twice white."""
    white = context.camera.detector.white_e
    share = np.random.default_rng(seed).uniform(0, 2, (*context.shape, len(white))).astype(np.float32)
    return Electrons(array=share * white, white_e=white)


def noisy_rgbi(context: FaultContext, seed: int = 0) -> RGBI:
    """Random bytes, with zeros and full pixels among them."""
    array = np.random.default_rng(seed).integers(0, 256, (*context.shape, 4), dtype=np.uint8)
    array[::7, ::5] = 0
    array[::5, ::7] = 255
    return RGBI(array=array)


def flat_rgbi(context: FaultContext, value: int) -> RGBI:
    """Every channel of every pixel at `value`."""
    return RGBI(array=np.full((*context.shape, 4), value, np.uint8))


def make(fault_class: str, **table: Any) -> Fault:
    """A fault as a scene file would make it."""
    return from_dict(fault_class, table, source="test.toml")


def rng(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)
