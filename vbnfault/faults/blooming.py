"""Blooming: wells of a CCD that hold less, and a drain that no longer takes what they spill.

Charge above the full well runs along its column, half either way (`detector.charge.bloom`). Ionising dose shifts
the voltages that the clocks set in the silicon: a well's barrier sinks, and a drain stays shut (the shares are
assumed). Raw numbers keep their gain: a full well is no longer white, so bright areas get a flat top that runs out
along the columns.

It acts on collected charge before the sensor's own overflow, which then finds nothing above its full well.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ..detector.charge import bloom
from .base import Fault, FaultContext, Interval, Params, bounds


@dataclass(frozen=True, kw_only=True)
class Overflow(Fault):
    """A lower full well of all pixels, and antiblooming lost; nothing on CMOS."""

    fault = "blooming"
    model = "overflow"
    step = "charge"
    needs_mosaic = True
    needs_ccd = True
    effect_mask = True

    full_well_share: Interval = bounds(
        0.7, 0.95, limits=(0.01, 1), doc="full well over the sensor's own; 1: only the drain is lost; assumed"
    )
    antiblooming: Interval = bounds(
        0.0, 0.0, limits=(0, 1), doc="share of the excess that a drain still takes, at most the sensor's own"
    )

    def draw(self, context: FaultContext, rng: np.random.Generator) -> Params:
        """Full well in electrons, what the drain takes, and the way of the charge; empty on CMOS."""
        detector: Any = context.camera.detector
        share, drained = self.full_well_share.uniform(rng), self.antiblooming.uniform(rng)
        if detector.sensor.architecture == "cmos":
            return {}
        return {
            "full_well_e": float(share * detector.full_well_e),
            "antiblooming": float(min(drained, detector.sensor.transfer.antiblooming)),
            "direction": str(detector.direction),
        }

    def apply(self, quantity: Any, params: Params, context: FaultContext) -> Any:
        """Collected electrons after the overflow."""
        if not params:
            return quantity
        charge = bloom(np.ascontiguousarray(quantity.array), **params)
        return quantity.with_array(np.maximum(charge, np.float32(0)))
