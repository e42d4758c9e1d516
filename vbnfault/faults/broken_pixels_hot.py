"""Broken pixels by physics: the camera's own device, older and more irradiated than its file says.

A device's defects come from its seed and only ever grow (`detector.individual`), so that samples of one individual
share them; the fault draws an age, a dose and the time since, and adds what the device has by then and did not
have before: bulk damage of displaced atoms (Srour & Lo 2000; Belloir 2016; Le Roch 2019), hot pixels with an offset
(Chapman et al.: I = m (R T + b)), dead and stuck pixels, and random telegraph signals in the state that they are
in. They spread over neighbours because the demosaic does. In a CCD charge is clocked past its defects: behind a hot
pixel, away from the register, it draws a line (`detector.chain.passing_dark_e`).

Each defect acts where the device's own of its kind does (`detector.chain`): dead pixels keep less of the light, and
all their dark current; dark current and telegraph signals are charge, with shot noise; offsets are added after it,
without noise; a stuck pixel shows its level, whatever it holds.

Pixels are as warm as the sensor: at short exposures and in the cold most damage does not show, as on real ones.
The growth laws are of cameras on the ground; `growth_factor` says how much faster it goes in space (assumed).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.quantities import DEAD, HOT, RTS, RTS_HIGH, STUCK
from ..detector.chain import Device, passing_dark_e, show_stuck, upper_share
from ..detector.individual import Individual, IndividualSpec, RtsPixels, StuckPixels, aged, dark_rate_e_s, offset_e
from .base import Fault, FaultContext, Interval, Params, bounds, number

F32 = NDArray[np.float32]

_MOST_LISTED = 256
_OLDEST_YR = 100.0  # that a device's kind may be: what is older grows as many defects in that time
_MOST_A_YEAR = 0.1  # share of pixels that die or stick in a year, at most


@dataclass(frozen=True, kw_only=True)
class HotPixels(Fault):
    """Hot and dead pixels of the camera's device at a later age and dose."""

    fault = "broken_pixels"
    model = "hot_pixels"
    step = "light"
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
    clustered_share: float = number(0.1, limits=(0, 1), doc="share of hot pixels born beside another")
    dead_per_year: float = number(
        5e-8, limits=(0, 1e-3), unit="1/yr", doc="share of pixels that die in a year on the ground; assumed"
    )
    stuck_per_year: float = number(
        2e-8, limits=(0, 1e-3), unit="1/yr", doc="share of pixels that stick in a year on the ground; assumed"
    )
    least_dn: float = number(
        0.5, limits=(0.001, 255), unit="DN of 255", doc="defects that add less at this exposure are left out"
    )

    def draw(self, context: FaultContext, rng: np.random.Generator) -> Params:
        """Return age and dose, how many pixels they change, and the strongest: x, y, electrons at this exposure,
        offset included, the offset alone and the share of light kept; `stuck`: x, y and level, the share of the top
        code; `rts`: the strongest telegraph signals, with their amplitude and the share of the exposure that they
        are high."""
        params: Params = {
            "years": self.years.uniform(rng),
            "growth_factor": self.growth_factor.uniform(rng),
            "dose_TeV_g": self.dose_TeV_g.uniform(rng),
            "anneal_days": self.anneal_days.uniform(rng),
            "clustered_share": float(self.clustered_share),
            "dead_per_year": float(self.dead_per_year),
            "stuck_per_year": float(self.stuck_per_year),
            "least_dn": float(self.least_dn),
            "telegraph_seed": int(rng.integers(2**63)),
        }
        damage = _damage(params, context)
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
        """Return the light to which pixels respond without what dead ones lose of it."""
        return quantity.with_array(quantity.array * _damage_once(params, context).kept)

    def apply_at(self, step: str, quantity: Any, params: Params, context: FaultContext) -> Any:
        """Return the quantity of a step with the defects that act there: dead, hot and telegraph, offset, stuck."""
        damage = _damage_once(params, context)
        if step == "pixels":
            return quantity.with_array(quantity.array + damage.charge_e)
        if step == "offsets":
            return quantity.with_array(quantity.array + damage.offset_e)
        if step == "raw":
            detector: Any = context.camera.detector
            raw = quantity.array.copy()
            show_stuck(raw, damage.stuck, detector.sensor.readout.top_dn)
            return quantity.with_array(raw)
        return self.apply(quantity, params, context)

    def footprint(self, params: Params, context: FaultContext) -> NDArray[np.bool_]:
        """bool[y, x]: pixels of the picture that a defect can reach."""
        detector: Any = context.camera.detector
        reached: NDArray[np.bool_] = detector.footprint(_damage_once(params, context).changed)
        return reached

    def defects(self, params: Params, context: FaultContext) -> NDArray[np.uint8]:
        """Kinds of the mosaic's defects that show, uint8[y, x]: bits of `quantities.DEFECTS`."""
        return _damage_once(params, context).kinds


@dataclass(frozen=True, kw_only=True, eq=False)
class _Damage:
    """What defects add at this exposure, `charge_e` with shot noise and `offset_e` without, and `kept`: the share
    of their light that pixels keep, float32[y, x]; `kinds` uint8[y, x]; stuck pixels; the telegraph signals and the
    share of the exposure that each is high."""

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
        out = (self.charge_e > 0) | (self.offset_e > 0) | (self.kept < 1)
        out[self.stuck.row, self.stuck.column] = True
        return out

    def listed_stuck(self) -> list[dict[str, Any]]:
        stuck = self.stuck
        strongest = np.argsort(-stuck.level, kind="stable")[:_MOST_LISTED]
        return [
            {"x": int(stuck.column[k]), "y": int(stuck.row[k]), "level": round(float(stuck.level[k]), 6)}
            for k in strongest
        ]

    def listed(self) -> list[dict[str, Any]]:
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
    return context.once("broken_pixels.damage", params, lambda: _damage(params, context))


def _damage(params: Params, context: FaultContext) -> _Damage:
    detector: Any = context.camera.detector
    device: Device = detector.device
    own = device.individual
    old = _older(own, _ageing(own.spec, params))
    exposure_s = context.camera.exposure_s

    # defects are born in order: the device's own come first
    columns = {k: v for k, v in vars(old.rts).items() if k != "reference_K"}
    new = {name: column[len(own.rts) :] for name, column in columns.items()}
    rts = RtsPixels(**new, reference_K=old.rts.reference_K)
    signals = rts.at(device.temperature_K)
    high = upper_share(signals, exposure_s, params["telegraph_seed"]) if len(rts) else np.zeros(0)
    more = dark_rate_e_s(old, device.temperature_K) - device.dark_rate_e_s
    np.maximum(more, 0, out=more)  # a dose that anneals takes none of the device's own away
    jumps = np.zeros(device.shape, dtype=np.float32)
    np.add.at(jumps, (rts.row, rts.column), signals.amplitude_e_s * high)
    charge = np.asarray((more + jumps) * np.float32(exposure_s), dtype=np.float32)
    offset = np.asarray(offset_e(old) - device.offset_e, dtype=np.float32)

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


@lru_cache(maxsize=4)
def _older(own: Individual, changes: tuple[tuple[str, Any], ...]) -> Individual:
    return aged(own, **dict(changes))


def _ageing(own: IndividualSpec, params: Params) -> tuple[tuple[str, Any], ...]:
    """What changes of the device with its later age and dose. Only the years that are added grow by the factor."""
    growth, factor, years = own.hot_growth, params["growth_factor"], params["years"]
    total = min(own.years + years, _OLDEST_YR)
    more = (own.years + factor * years) / total if total > 0 else 1.0
    # of a year on the ground by what the fault adds, in shares of all the years
    added = factor * years / total if total > 0 else 0.0
    if growth is not None:
        growth = replace(growth, log10_scale=growth.log10_scale + float(np.log10(more)))
    return (
        ("years", total),
        ("dose_TeV_g", own.dose_TeV_g + params["dose_TeV_g"]),
        ("anneal_s", params["anneal_days"] * 86400.0),
        ("hot_growth", growth),
        ("hot_clustered_share", params["clustered_share"]),
        ("dead_share_yr", min(own.dead_share_yr + params["dead_per_year"] * added, _MOST_A_YEAR)),
        ("stuck_share_yr", min(own.stuck_share_yr + params["stuck_per_year"] * added, _MOST_A_YEAR)),
    )
