"""Simulate broken pixels by physics: the camera's own device, older and more irradiated than its file says.

The seed of a device fixes its defects, and defects only grow in number (`detector.individual`). Samples of one
individual therefore share them. The fault draws an age, a dose and the time since that dose. It adds the defects
that the device has by then and did not have before:

- bulk damage of displaced atoms (Srour & Lo 2000; Belloir 2016; Le Roch 2019),
- hot pixels with an offset (Chapman et al.: I = m (R T + b)),
- dead and stuck pixels,
- random telegraph signals, each in its state at the exposure; in a sequence they blink from frame to frame.

Defects spread to neighbouring pixels by demosaicing. In a CCD, charge is clocked past the defects. A hot pixel
therefore draws a line on the side away from the register (`detector.charge.passing_dark_e`).

Each defect acts at the same step as the device's own defects of its kind (`detector.effects`). Dead pixels keep
less of the light, but all their dark current. Dark current and telegraph signals are charge with shot noise.
Offsets are added after the charge, without noise. A stuck pixel shows its level, whatever charge it holds.

Pixels have the sensor's temperature: at short exposures and at low temperature most damage does not show, as on
real sensors. The growth laws are measured on cameras on the ground. `growth_factor` is the assumed ratio of the
growth in space to the growth on the ground.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.quantities import DEAD, HOT, RTS, RTS_HIGH, STUCK
from ..detector.charge import passing_dark_e
from ..detector.effects.electrons import upper_fraction
from ..detector.effects.output import show_stuck
from ..detector.individual import IndividualSpec, RtsPixels, StuckPixels, aged, dark_rate_e_s, offset_e
from .context import FaultContext, Params
from .contract import Fault
from .fields import Interval, Severity, bounds, number

F32 = NDArray[np.float32]

_MOST_LISTED = 256
_OLDEST_YR = 100.0  # limit of a device's age; a higher age becomes faster growth within that time
_MOST_A_YEAR = 0.1  # fraction of the pixels that may die or stick in a year, at most


@dataclass(frozen=True, kw_only=True)
class HotPixels(Fault):
    """Add the hot, dead, stuck and telegraph pixels that the camera's device has at a later age and dose."""

    fault = "broken_pixels"
    model = "hot_pixels"
    step = "light"
    severity = Severity(key="growth_factor", low=1.0, high=1e5)
    later_steps = ("pixels", "offsets", "raw")
    needs_mosaic = True

    years: Interval = bounds(2.0, 10.0, limits=(0, 100), unit="yr", doc="of age more than the device's own")
    growth_factor: Interval = bounds(
        20.0, 200.0, limits=(1e-3, 1e5), doc="growth of hot and dead pixels over that on the ground; assumed"
    )
    dose_TeV_g: Interval = bounds(
        0.0,
        1.0,
        limits=(0, 100),
        unit="TeV/g",
        doc="displacement damage dose more than the device's own; 1e9 protons of 50 MeV per cm² are 4 (assumed)",
    )
    anneal_days: Interval = bounds(
        7.0, 58.0, limits=(0, 1e4), unit="d", doc="since that dose; beyond 58 days damage stays as it is"
    )
    clustered_fraction: float = number(0.1, limits=(0, 1), doc="fraction of hot pixels born beside another")
    dead_per_year: float = number(
        5e-8, limits=(0, 1e-3), unit="1/yr", doc="fraction of pixels that die in a year on the ground; assumed"
    )
    stuck_per_year: float = number(
        2e-8, limits=(0, 1e-3), unit="1/yr", doc="fraction of pixels that stick in a year on the ground; assumed"
    )
    least_dn: float = number(
        0.5, limits=(0.001, 255), unit="DN of 255", doc="defects that add less at this exposure are left out"
    )

    def draw(self, context: FaultContext, rng: np.random.Generator) -> Params:
        """Return age and dose, the number of changed pixels, and lists of the strongest defects.

        - `x`, `y`, `electrons` (at this exposure, offset included), `offset_e` and `response` (the fraction of
          light kept) describe the changed pixels that gain the most electrons.
        - `stuck`: x, y and level (fraction of the top code).
        - `rts`: the strongest telegraph signals, with amplitude and the fraction of the exposure that each is high.
        """
        params: Params = {
            "years": self.years.uniform(rng),
            "growth_factor": self.growth_factor.uniform(rng),
            "dose_TeV_g": self.dose_TeV_g.uniform(rng),
            "anneal_days": self.anneal_days.uniform(rng),
            "clustered_share": float(self.clustered_fraction),
            "dead_per_year": float(self.dead_per_year),
            "stuck_per_year": float(self.stuck_per_year),
            "least_dn": float(self.least_dn),
            "telegraph_seed": int(rng.integers(2**63)),
        }
        damage = _damage_once(params, context)
        offset, kept = damage.offset_e.ravel(), damage.kept.ravel()
        extra = damage.charge_e.ravel() + offset
        changed = np.flatnonzero(damage.changed.ravel())
        order = changed[np.argsort(-extra[changed], kind="stable")][:_MOST_LISTED]
        width = context.shape[1]
        params["count"] = len(changed)
        params["x"], params["y"] = (order % width).tolist(), (order // width).tolist()
        params["electrons"] = [round(float(v), 1) for v in extra[order]]
        params["offset_e"] = [round(float(v), 1) for v in offset[order]]
        params["response"] = [round(float(v), 4) for v in kept[order]]
        params["stuck"] = damage.listed_stuck()
        params["rts"] = damage.listed()
        return params

    def apply(self, quantity: Any, params: Params, context: FaultContext) -> Any:
        """Return the light to which the pixels respond, reduced in dead pixels."""
        return quantity.with_array(quantity.array * _damage_once(params, context).kept)

    def apply_at(self, step: str, quantity: Any, params: Params, context: FaultContext) -> Any:
        """Return the quantity of one step with the defects that act there.

        light: dead pixels; pixels: hot and telegraph pixels; offsets: offsets; raw: stuck pixels.
        """
        damage = _damage_once(params, context)
        if step == "pixels":
            return quantity.with_array(quantity.array + damage.charge_e)
        if step == "offsets":
            return quantity.with_array(quantity.array + damage.offset_e)
        if step == "raw":
            raw = quantity.array.copy()
            show_stuck(raw, damage.stuck, context.camera.mosaic.sensor.readout.top_dn)
            return quantity.with_array(raw)
        return self.apply(quantity, params, context)

    def footprint(self, params: Params, context: FaultContext) -> NDArray[np.bool_]:
        """Return the pixels of the image that a defect can change, bool[y, x]."""
        return context.camera.mosaic.footprint(_damage_once(params, context).changed)

    def defects(self, params: Params, context: FaultContext) -> NDArray[np.uint8]:
        """Return the kinds of the mosaic's defects that show, uint8[y, x]: bits of `quantities.DEFECTS`."""
        return _damage_once(params, context).kinds


@dataclass(frozen=True, kw_only=True, eq=False)
class _Damage:
    """Hold what the defects add at this exposure.

    Attributes
    ----------
    charge_e, offset_e
        float32[y, x]: added electrons, with shot noise and without noise.
    kept
        float32[y, x]: fraction of the light that a pixel keeps.
    kinds
        uint8[y, x]: bits of `quantities.DEFECTS`.
    stuck
        The new stuck pixels.
    rts, amplitude_e_s, high
        The new telegraph signals, their amplitudes, and the fraction of the exposure that each is high.
    """

    charge_e: F32
    offset_e: F32
    kept: F32
    kinds: NDArray[np.uint8]
    stuck: StuckPixels
    rts: RtsPixels
    amplitude_e_s: NDArray[np.float64]
    high: NDArray[np.float64]

    @property
    def changed(self) -> NDArray[np.bool_]:
        """Return the pixels that a defect changes, bool[y, x]."""
        out = (self.charge_e > 0) | (self.offset_e > 0) | (self.kept < 1)
        out[self.stuck.row, self.stuck.column] = True
        return out

    def listed_stuck(self) -> list[dict[str, Any]]:
        """Return the stuck pixels with the highest levels as plain data, at most `_MOST_LISTED`."""
        stuck = self.stuck
        strongest = np.argsort(-stuck.level, kind="stable")[:_MOST_LISTED]
        return [
            {"x": int(stuck.column[k]), "y": int(stuck.row[k]), "level": round(float(stuck.level[k]), 6)}
            for k in strongest
        ]

    def listed(self) -> list[dict[str, Any]]:
        """Return the strongest telegraph signals as plain data, at most `_MOST_LISTED`."""
        strongest = np.argsort(-self.amplitude_e_s, kind="stable")[:_MOST_LISTED]
        return [
            {
                "x": int(self.rts.column[k]),
                "y": int(self.rts.row[k]),
                "amplitude_e_s": round(float(self.amplitude_e_s[k]), 3),
                "high_share": round(float(self.high[k]), 4),
            }
            for k in strongest
        ]


def _damage_once(params: Params, context: FaultContext) -> _Damage:
    """Return the damage, computed once for each sample."""
    # without the lists and their length, which `draw` adds from the result
    cause = {name: value for name, value in params.items() if not isinstance(value, list) and name != "count"}
    return context.once(_damage, cause)


def _damage(params: Params, context: FaultContext) -> _Damage:
    """Return the damage that the older device has and the device of today lacks."""
    detector = context.camera.mosaic
    device = detector.device
    own = device.drawn  # what was measured does not age
    old = _older(own, **_ageing(own.spec, params))
    # the fault's dose is fresh, which does not undo the annealing of the device's own
    today = _older(own, anneal_s=old.spec.anneal_s)
    exposure_s = context.camera.exposure_s

    # defects are listed in order of birth, so the device's own come first
    columns = {k: v for k, v in vars(old.rts).items() if k != "reference_K"}
    new = {name: column[len(own.rts) :] for name, column in columns.items()}
    rts = RtsPixels(**new, reference_K=old.rts.reference_K)
    signals = rts.at(device.temperature_K)
    high = upper_fraction(signals, exposure_s, params["telegraph_seed"], context.time_s)
    more = dark_rate_e_s(old, device.temperature_K) - dark_rate_e_s(today, device.temperature_K)
    jumps = np.zeros(device.shape, dtype=np.float32)
    np.add.at(jumps, (rts.row, rts.column), signals.amplitude_e_s * high)
    charge = np.asarray((more + jumps) * np.float32(exposure_s), dtype=np.float32)
    offset = np.asarray(offset_e(old) - offset_e(own), dtype=np.float32)

    least_e = np.float32(detector.step_e * params["least_dn"])
    kinds = np.where(charge + offset >= least_e, HOT, np.uint8(0))
    charge += passing_dark_e(device.sensor, more + jumps, device.direction)
    faint = charge + offset < least_e
    charge[faint], offset[faint] = 0, 0
    kept = np.ones(device.shape, dtype=np.float32)
    dead = slice(len(own.dead), None)
    np.multiply.at(kept, (old.dead.row[dead], old.dead.column[dead]), old.dead.response[dead])
    stuck = slice(len(own.stuck), None)
    for kind, some in ((DEAD, old.dead), (STUCK, old.stuck), (RTS, rts)):
        kinds[some.row, some.column] |= kind
    kinds[rts.row[high > 0.5], rts.column[high > 0.5]] |= RTS_HIGH
    return _Damage(
        charge_e=charge,
        offset_e=offset,
        kept=kept,
        kinds=kinds,
        stuck=StuckPixels(row=old.stuck.row[stuck], column=old.stuck.column[stuck], level=old.stuck.level[stuck]),
        rts=rts,
        amplitude_e_s=signals.amplitude_e_s,
        high=high,
    )


_older = lru_cache(maxsize=4)(aged)


def _ageing(own: IndividualSpec, params: Params) -> dict[str, Any]:
    """Return the changed specification of the device. Only the added years grow by `growth_factor`."""
    growth, factor, years = own.hot_growth, params["growth_factor"], params["years"]
    total = min(own.years + years, _OLDEST_YR)
    more = (own.years + factor * years) / total if total > 0 else 1.0
    # added years on the ground, as a fraction of all years
    added = factor * years / total if total > 0 else 0.0
    if growth is not None:
        growth = replace(growth, log10_scale=growth.log10_scale + float(np.log10(more)))
    return {
        "years": total,
        "dose_TeV_g": own.dose_TeV_g + params["dose_TeV_g"],
        "anneal_s": params["anneal_days"] * 86400.0,
        "hot_growth": growth,
        "hot_clustered_fraction": params["clustered_share"],
        "dead_fraction_yr": min(own.dead_fraction_yr + params["dead_per_year"] * added, _MOST_A_YEAR),
        "stuck_fraction_yr": min(own.stuck_fraction_yr + params["stuck_per_year"] * added, _MOST_A_YEAR),
    }
