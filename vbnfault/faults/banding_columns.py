"""Simulate coherent offsets of columns: a fixed pattern of the readout chains that the columns share.

Where several converters or amplifiers read the columns of a sensor in turn, each adds an offset of its own to every
second, fourth, … column. Spitzer's IRAC reads each fourth column through the same of four channels and shows such
"jailbars" (its documentation at IRSA); New Horizons' LORRI, a CCD with one output, has offsets between even and odd
columns (Weaver et al. 2020, PASP 132, 035003; recalled). Sensors that are read through two amplifiers also have a
step between their halves.

The pattern belongs to the device: all its frames have it at the same columns. A small part of it differs from
frame to frame, as the chains' temperatures drift. The offsets have no noise and do not depend on the signal, so the
pattern shows in the dark parts of a frame first.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ..detector.individual import stream
from .context import FaultContext, Params
from .contract import Fault
from .fields import Interval, bounds, number

PERIODS_PX = (2, 4, 8, 16, 32)


@dataclass(frozen=True, kw_only=True)
class ColumnBanding(Fault):
    """Add offsets that columns share with those one period further, and a step between the halves of the frame."""

    fault = "banding"
    model = "columns"
    step = "offsets"
    needs_mosaic = True
    localised = False
    effect_mask = True

    offset_dn: Interval = bounds(
        0.5,
        3.0,
        limits=(0, 64),
        unit="DN of 255",
        doc="standard deviation of the offsets of the columns of a period; assumed",
    )
    half_dn: Interval = bounds(
        0.0, 2.0, limits=(0, 64), unit="DN of 255", doc="step between left and right half; assumed"
    )
    period_px: int | None = number(
        None,
        limits=(2, 1024),
        integer=True,
        unit="px",
        doc="columns after which the pattern repeats; default: 2, 4, 8, 16 or 32, by the device",
    )
    drift_fraction: float = number(
        0.1, limits=(0, 1), doc="spread of the offsets from frame to frame over that of the pattern; assumed"
    )

    def draw(self, context: FaultContext, rng: np.random.Generator) -> Params:
        """Return the offsets of one period of columns, and the step between the halves, in electrons."""
        detector = context.camera.mosaic
        device = stream(detector.device.seed, "column groups")
        period = int(device.choice(PERIODS_PX))
        sign = 1.0 if device.random() < 0.5 else -1.0
        period = period if self.period_px is None else int(self.period_px)
        fixed, drift = device.standard_normal(period), rng.standard_normal(period)
        offsets = fixed / max(float(fixed.std()), 1e-3) + self.drift_fraction * drift
        offset_e, half_e = (bound.uniform(rng) * detector.step_e for bound in (self.offset_dn, self.half_dn))
        return {
            "offsets_e": np.round(offset_e * (offsets - offsets.mean()), 2).tolist(),
            "half_e": float(sign * half_e),
        }

    def apply(self, quantity: Any, params: Params, context: FaultContext) -> Any:
        """Return the offsets of the pixels with those of their columns."""
        width = context.shape[1]
        columns = np.resize(np.asarray(params["offsets_e"], dtype=np.float32), width)
        columns += np.where(np.arange(width) < (width + 1) // 2, -0.5, 0.5).astype(np.float32) * params["half_e"]
        return quantity.with_array(quantity.array + columns)
