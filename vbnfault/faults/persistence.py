"""Simulate persistence: charge of an exposure before this one that stays in the pixels and appears in it.

Pinned photodiodes that are not emptied at once leave a fraction to the next exposure, however long after (image
lag; Fossum & Hondongwa 2014, doi 10.1109/JEDS.2014.2306412). Traps in the depleted volume empty slowly. Releases of
many time constants add to a power law of the time since, near 1/t: measured on infrared arrays (Smith et al. 2008,
Proc. SPIE 7021, 70210J; Long et al. 2012, Proc. SPIE 8442, 84421W; Leisenring et al. 2016, Proc. SPIE 9915,
99152N), and known as residual bulk image on CCDs (Rest et al. 2002, Rev. Sci. Instrum. 73, 2028). With N the
electrons that a pixel held, at most the full well, an exposure T that begins w after it gains

    N · (lag_fraction + trap_fraction · ∫ t^-power dt)   from w to w + T, t in s,

and never more than N. A trap_fraction of 0.003 is of the order of Hubble's WFC3/IR: 0.3 e/s after 1000 s, behind
1e5 e. Exposures of some ms show the lag only.

A still has no exposure before. The light of `source = "frame"` is that of this frame as the camera saw it before it
turned: displaced, with what lies beyond the edges mirrored, and brighter or fainter by a factor. That of "sun" is
the Sun's disc, full wells at a drawn place. In a sequence, both "drawn" and "frame" are the charge that the frame
before left in the pixels, and w is the time since then.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..core import spectra
from .context import FaultContext, Params
from .contract import Fault
from .fields import Interval, Severity, bounds, choice, number
from .planes import F32, displaced, draw_shift

_SHORTEST_WAIT_S = 1e-3


@dataclass(frozen=True, kw_only=True)
class Persistence(Fault):
    """Add electrons that traps release, of the same scene before the camera turned or of the Sun."""

    fault = "persistence"
    model = "power_law"
    default = True
    after = "broken_pixels"
    step = "pixels"
    severity = Severity(key="lag_fraction", low=1e-4, high=0.5)
    needs_mosaic = True
    per_exposure = True
    uses_before = True
    localised = False
    effect_mask = True

    source: str = choice(
        "drawn", ("drawn", "frame", "sun"), doc="what was seen before; drawn: either with equal chance"
    )
    lag_fraction: Interval = bounds(
        0.002, 0.03, limits=(0, 1), doc="fraction of the charge that stays until this exposure; assumed"
    )
    trap_fraction: Interval = bounds(
        0.0, 0.003, limits=(0, 0.1), doc="electrons released in 1 s, 1 s later, over those that were held"
    )
    power: float = number(1.0, limits=(0.1, 3), doc="power of the time by which the release falls")
    wait_s: Interval = bounds(
        0.1,
        10.0,
        limits=(_SHORTEST_WAIT_S, 1e6),
        unit="s",
        doc="from the end of that exposure to the start of this; assumed",
    )
    exposure_factor: Interval = bounds(
        1.0, 30.0, limits=(0, 1e6), doc="light of that exposure over that of this, for frame; assumed"
    )
    shift_px: Interval = bounds(
        20.0, 200.0, limits=(0, 1024), unit="px", doc="displacement of that frame, for frame; assumed"
    )

    def draw(self, context: FaultContext, rng: np.random.Generator) -> Params:
        """Return what was seen and where, and the fraction of the electrons held then that appears now."""
        source = ("frame", "sun")[int(rng.integers(2))]
        height, width = context.shape
        place = rng.uniform(0, (width, height))
        shift = draw_shift(self.shift_px, context, rng)
        keys = (self.lag_fraction, self.trap_fraction, self.wait_s, self.exposure_factor)
        lag, trapped, wait_s, factor = (bound.uniform(rng) for bound in keys)
        params: Params = {"source": source if self.source == "drawn" else self.source, "wait_s": wait_s}
        if context.before is not None and context.time_s is not None and self.source != "sun":
            wait_s = max(context.time_s - context.before().end_s, _SHORTEST_WAIT_S)
            params = {"source": "before", "wait_s": wait_s}
        later = trapped * power_integral(self.power, wait_s, wait_s + context.camera.exposure_s)
        params["released"] = min(lag + later, 1.0)
        if params["source"] == "before":
            return params
        if params["source"] == "sun":
            return params | {"sun_xy_px": [round(float(k), 2) for k in place]}
        return params | {"shift_px": shift, "exposure_factor": factor}

    def apply(self, quantity: Any, params: Params, context: FaultContext) -> Any:
        """Return the expected electrons with those that are released."""
        full_e = np.float32(context.camera.mosaic.sensor.readout.full_well_e)
        if params["source"] == "before":
            assert context.before is not None
            held = np.asarray(context.before().held_e)
        elif params["source"] == "sun":
            held = full_e * _sun(params["sun_xy_px"], context)
        else:
            light = displaced(quantity.array, *params["shift_px"]) * np.float32(params["exposure_factor"])
            held = np.minimum(light, full_e)
        return quantity.with_array(quantity.array + held * np.float32(params["released"]))


def power_integral(power: float, first_s: float, last_s: float) -> float:
    """Return the integral of t^-power over the time t in s."""
    if power == 1:
        return math.log(last_s / first_s)
    return (last_s ** (1 - power) - first_s ** (1 - power)) / (1 - power)


def _sun(centre_px: list[float], context: FaultContext) -> F32:
    """Return the fraction of each pixel that the Sun's disc at a place covers, float32[y, x]."""
    radius_rad = context.sun_angular_radius_rad or spectra.sun_angular_radius_rad(1.0)
    radius_px = max(radius_rad * context.camera.intrinsics[0], 0.5)
    y, x = (np.arange(n) + 0.5 for n in context.shape)
    distance = np.hypot(x - centre_px[0], y[:, None] - centre_px[1])
    return np.clip(radius_px - distance + 0.5, 0, 1).astype(np.float32)
