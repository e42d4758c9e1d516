"""Cameras, contexts and images for the tests of faults; no tests of its own."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from vbnfault.core.quantities import RGBI, Electrons
from vbnfault.faults import Fault, FaultContext, from_dict
from vbnfault.testing import make_context as make_context
from vbnfault.testing import random_quantity as noisy
from vbnfault.testing import with_mosaic as with_mosaic


def mosaic_context(
    size: int, architecture: str = "cmos", *, camera: Mapping[str, Any] | None = None, **parts: Mapping[str, Any]
) -> FaultContext:
    """A camera whose sensor has a mosaic; values replace those of parts of the sensor, as readout={"nodes": 2}."""
    context = make_context(size, architecture=architecture, **camera or {})
    sensor = with_mosaic(context).camera.mosaic.sensor
    return with_mosaic(context, **{name: replace(getattr(sensor, name), **part) for name, part in parts.items()})


def inside(fault: Fault, params: dict[str, Any], context: FaultContext) -> dict[str, Any]:
    """What a fault does inside a detector with a mosaic, at all its steps."""
    return {step: [fault.act_at(step, params, context)] for step in fault.steps}


def flat_electrons(context: FaultContext, share: float = 0.5) -> Electrons:
    """Every pixel at `share` of white."""
    white = context.camera.detector.white_e
    return Electrons(array=np.full((*context.shape, len(white)), share, np.float32) * white, white_e=white)


def noisy_electrons(context: FaultContext, seed: int = 0) -> Electrons:
    """Random signal from 0 to twice white."""
    light = noisy("electrons", context, seed)
    assert isinstance(light, Electrons)
    return light


def noisy_rgbi(context: FaultContext, seed: int = 0) -> RGBI:
    """Random bytes, with zeros and full pixels among them."""
    image = noisy("rgbi", context, seed)
    assert isinstance(image, RGBI)
    return image


def flat_rgbi(context: FaultContext, value: int) -> RGBI:
    """Every channel of every pixel at `value`."""
    return RGBI(array=np.full((*context.shape, 4), value, np.uint8))


def make(fault_class: str, **table: Any) -> Fault:
    """A fault as a scene file would make it."""
    return from_dict(fault_class, table, source="test.toml")


def rng(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)
