"""Simulate blooming: a CCD whose wells hold less charge and whose drain no longer removes the excess.

Charge above the full well flows along its column, half of it to either side (`detector.charge.bloom`). Ionising
dose shifts the voltages in the silicon that the clocks set: the barrier of a well sinks, and a drain stays closed.
The fractions are assumed. The gain of the raw numbers does not change, so a full well no longer reaches white.
Bright areas get a flat top that extends along the columns.

The fault acts on the collected charge, before the sensor's own overflow. The sensor then finds no charge above its
own full well.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ..detector.charge import bloom
from .context import FaultContext, Params
from .contract import Fault
from .fields import Interval, Severity, bounds


@dataclass(frozen=True, kw_only=True)
class Overflow(Fault):
    """Lower the full well of all pixels and the antiblooming. CMOS sensors are unchanged."""

    fault = "blooming"
    model = "overflow"
    default = True
    after = "cosmic_rays"
    step = "charge"
    severity = Severity(key="full_well_fraction", low=1.0, high=0.01)
    needs_mosaic = True
    needs_ccd = True
    effect_mask = True

    full_well_fraction: Interval = bounds(
        0.7, 0.95, limits=(0.01, 1), doc="full well over the sensor's own; 1: only the drain is lost; assumed"
    )
    antiblooming: Interval = bounds(
        0.0, 0.0, limits=(0, 1), doc="fraction of the excess that a drain still takes, at most the sensor's own"
    )

    def draw(self, context: FaultContext, rng: np.random.Generator) -> Params:
        """Return full well in electrons, drained fraction and direction of the charge; {} on CMOS."""
        detector = context.camera.mosaic
        fraction, drained = self.full_well_fraction.uniform(rng), self.antiblooming.uniform(rng)
        if detector.sensor.architecture == "cmos":
            return {}
        return {
            "full_well_e": float(fraction * detector.full_well_e),
            "antiblooming": float(min(drained, detector.sensor.transfer.antiblooming)),
            "direction": str(detector.direction),
        }

    def apply(self, quantity: Any, params: Params, context: FaultContext) -> Any:
        """Return the collected electrons after the overflow."""
        if not params:
            return quantity
        charge = bloom(np.ascontiguousarray(quantity.array), **params)
        return quantity.with_array(np.maximum(charge, np.float32(0)))
