"""Broken pixels by physics: the camera's own device, older and more irradiated than its file says.

A device's defects come from its seed and only ever grow (`detector.individual`), so that samples of one individual
share them; the fault draws an age and a dose and adds what the device has by then and did not have before: bulk
damage of displaced atoms (Srour & Lo 2000; Belloir 2016; Le Roch 2019), hot pixels with an offset (Chapman et al.:
I = m (R T + b)) and dead pixels. All of it is in electrons of the mosaic, before shot noise, and spreads over
neighbours because the demosaic does.

Pixels are as warm as the sensor: at short exposures and in the cold most damage does not show, as on real ones.
The growth laws are of cameras on the ground; `growth_factor` says how much faster it goes in space (assumed).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..detector.chain import Device, individual
from ..detector.demosaic import footprint
from ..detector.individual import dark_rate_e_s, offset_e
from .base import Fault, FaultContext, Interval, Params, bounds, number

F32 = NDArray[np.float32]

_MOST_LISTED = 256
_MOST_DEAD = 0.1  # share of pixels that die in a year, at most


@dataclass(frozen=True, kw_only=True)
class HotPixels(Fault):
    """Hot and dead pixels of the camera's device at a later age and dose."""

    fault = "broken_pixels"
    model = "hot_pixels"
    step = "pixels"
    needs_mosaic = True

    years: Interval = bounds(2.0, 10.0, limits=(0, 100), unit="yr", doc="of age more than the device's own")
    growth_factor: Interval = bounds(
        20.0, 200.0, limits=(1e-3, 1e5), doc="growth of hot and dead pixels over that on the ground; assumed"
    )
    dose_TeV_g: Interval = bounds(
        0.0, 0.02, limits=(0, 100), unit="TeV/g", doc="displacement damage dose more than the device's own"
    )
    clustered_share: float = number(0.1, limits=(0, 1), doc="share of hot pixels born beside another")
    dead_per_year: float = number(
        2e-7, limits=(0, 1e-3), unit="1/yr", doc="share of pixels that die in a year on the ground; assumed"
    )
    least_dn: float = number(
        0.5, limits=(0.001, 255), unit="DN of 255", doc="defects that add less at this exposure are left out"
    )

    def draw(self, context: FaultContext, rng: np.random.Generator) -> Params:
        """Age and dose, how many defects they bring, and the strongest: x, y and electrons at this exposure."""
        params: Params = {
            "years": self.years.uniform(rng),
            "growth_factor": self.growth_factor.uniform(rng),
            "dose_TeV_g": self.dose_TeV_g.uniform(rng),
            "clustered_share": float(self.clustered_share),
            "dead_per_year": float(self.dead_per_year),
            "least_dn": float(self.least_dn),
        }
        extra, kept = _damage(params, context)
        changed = np.flatnonzero((extra.ravel() > 0) | (kept.ravel() < 1))
        order = changed[np.argsort(-extra.ravel()[changed], kind="stable")][:_MOST_LISTED]
        width = context.shape[1]
        params["count"] = len(changed)
        params["x"], params["y"] = (order % width).tolist(), (order // width).tolist()
        params["electrons"] = [round(float(v), 1) for v in extra.ravel()[order]]
        params["response"] = [round(float(v), 4) for v in kept.ravel()[order]]
        return params

    def apply(self, quantity: Any, params: Params, context: FaultContext) -> Any:
        """Expected electrons with what the defects add, and dead pixels' light left out."""
        extra, kept = _damage_once(params, context)
        return quantity.with_array(quantity.array * kept + extra)

    def footprint(self, params: Params, context: FaultContext) -> NDArray[np.bool_]:
        """bool[y, x]: pixels of the picture that a defect can reach."""
        extra, kept = _damage_once(params, context)
        detector: Any = context.camera.detector
        return footprint((extra > 0) | (kept < 1), detector.sensor.pattern, detector.sensor.method)


def _damage_once(params: Params, context: FaultContext) -> tuple[F32, F32]:
    return context.once("broken_pixels.damage", params, lambda: _damage(params, context))


def _damage(params: Params, context: FaultContext) -> tuple[F32, F32]:
    """Electrons that defects add at this exposure, and the share of their light that pixels keep, float32[y, x]."""
    detector: Any = context.camera.detector
    device: Device = detector.device
    own = device.individual
    growth = own.spec.hot_growth
    factor = params["growth_factor"]
    spec = replace(
        own.spec,
        years=own.spec.years + params["years"],
        dose_TeV_g=own.spec.dose_TeV_g + params["dose_TeV_g"],
        hot_growth=None
        if growth is None
        else replace(growth, log10_scale=growth.log10_scale + float(np.log10(factor))),
        hot_clustered_share=params["clustered_share"],
        dead_share_yr=min(params["dead_per_year"] * factor, _MOST_DEAD),
    )
    old = individual(spec, device.shape, own.pixel_pitch_um, own.seed)
    exposure_s = context.camera.exposure_s
    rate = dark_rate_e_s(old, device.temperature_K) - device.dark_rate_e_s
    extra = rate * np.float32(exposure_s) + (offset_e(old) - device.offset_e)
    extra[extra < detector.full_well_e / 255 * params["least_dn"]] = 0
    kept = np.ones(device.shape, dtype=np.float32)
    np.multiply.at(kept, (old.dead.row, old.dead.column), old.dead.response)
    was = own.dead
    kept[was.row, was.column] = 1
    return extra.astype(np.float32), kept
