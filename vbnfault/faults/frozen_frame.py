"""Simulate a frame buffer that was not renewed: rows of the image show an earlier exposure.

Where a driver, a link or a memory controller misses a frame, the old one is sent again, whole or in part (a torn
frame). Between the two exposures the camera has turned, so the stale rows show the same scene displaced. They have
noise of their own, and the same dust, defects and straylight. What lies beyond the edges is mirrored. The pose of
the sample is that of the new exposure, which a frame that is stale as a whole contradicts. Rows that are repeated
one by one are those of the fault `transmission` with `fill = "previous"`.

A still has no exposure before, so nothing changes but the displacement. In a sequence, the stale rows show the
light of the frame before. The model `repeated` shows its finished image bit for bit, noise included; only other
faults of the finished image act on it once more.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.quantities import Quantity
from .context import FaultContext, FrameBefore, Params
from .contract import Fault
from .fields import Interval, Severity, bounds
from .planes import displaced, draw_shift


@dataclass(frozen=True, kw_only=True)
class FrozenFrame(Fault):
    """Show an earlier exposure, displaced, in some or all rows."""

    fault = "frozen_frame"
    model = "displaced"
    default = True
    after = ""
    step = "electrons"
    severity = Severity(key="shift_px", low=1.0, high=500.0)
    needs_light = True
    per_exposure = True
    uses_before = True
    localised = False
    effect_mask = True

    rows_fraction: Interval = bounds(0.1, 1.0, limits=(0, 1), doc="part of the rows that are stale; assumed")
    shift_px: Interval = bounds(
        3.0, 30.0, limits=(0, 1024), unit="px", doc="displacement between the two exposures; assumed"
    )

    def draw(self, context: FaultContext, rng: np.random.Generator) -> Params:
        """Return the first stale row, the row behind the last one, and the displacement in x and y."""
        height = context.shape[0]
        rows = round(self.rows_fraction.uniform(rng) * height)
        # the new frame overwrites the old one from the top, or is overwritten by it: both ends of the image occur
        first = (height - rows) * int(rng.integers(2))
        params: Params = {"rows": [first, first + rows]}
        return params | ({"shift_px": draw_shift(self.shift_px, context, rng)} if context.before is None else {})

    def apply(self, quantity: Any, params: Params, context: FaultContext) -> Any:
        """Return the light of both exposures."""
        stale, out = slice(*params["rows"]), quantity.array.copy()
        if "shift_px" in params:
            earlier = displaced(quantity.array, *params["shift_px"])
        else:
            assert context.before is not None
            earlier = self.earlier(context.before()).array
        out[stale] = earlier[stale]
        return quantity.with_array(out)

    def earlier(self, before: FrameBefore) -> Quantity:
        """Return what the stale rows show of the frame before."""
        return before.light


@dataclass(frozen=True, kw_only=True)
class RepeatedFrame(FrozenFrame):
    """Show the finished image of an earlier exposure, noise and all, in some or all rows."""

    model = "repeated"
    step = "rgbi"
    needs_light = False
    effect_mask = False

    def footprint(self, params: Params, context: FaultContext) -> NDArray[np.bool_]:
        """Return the stale rows, bool[y, x]."""
        out = np.zeros(context.shape, bool)
        out[slice(*params["rows"])] = True
        return out

    def earlier(self, before: FrameBefore) -> Quantity:
        """Return what the stale rows show of the frame before."""
        return before.image
