"""Charge transfer inefficiency: traps that radiation has made in the columns and the register of a CCD.

A packet fills the traps within its cloud and they let go later, into the packets behind: trails away from the
register, and less charge where it has far to go (`detector.charge.cti`, after ArCTIC: Massey et al. 2010, MNRAS
401, 371). Displaced atoms make traps in proportion to the dose; the densities in columns and register are drawn.
Three species release in half a transfer, in two and in eight (assumed: slower ones stay full, faster ones give back
to their own packet), in shares drawn uniformly over all that sum to 1.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ..camera import Camera
from ..detector.charge import TrapSpecies
from .base import Fault, FaultContext, Interval, Params, bounds, with_sensor

RELEASE_TRANSFERS = (0.5, 2.0, 8.0)


@dataclass(frozen=True, kw_only=True)
class RadiationTraps(Fault):
    """Traps besides the sensor's own; nothing on CMOS, or where a sensor's file has no time of a transfer."""

    fault = "cti"
    model = "radiation"
    step = "charge"
    needs_mosaic = True
    needs_ccd = True
    localised = False
    effect_mask = True

    parallel_per_px: Interval = bounds(
        1.0, 8.0, limits=(0, 100), doc="traps per pixel of a column more than the sensor's own; assumed"
    )
    serial_per_px: Interval = bounds(
        0.5, 4.0, limits=(0, 100), doc="traps per pixel of the register more than the sensor's own; assumed"
    )

    def draw(self, context: FaultContext, rng: np.random.Generator) -> Params:
        """Species of `parallel` and `serial` traps: density_per_px and release_time_s of each."""
        detector: Any = context.camera.detector
        move = detector.sensor.transfer
        params: Params = {}
        for name, density, transfer_s in (
            ("parallel", self.parallel_per_px, move.row_readout_s),
            ("serial", self.serial_per_px, move.pixel_transfer_s),
        ):
            total, shares = density.uniform(rng), rng.dirichlet(np.ones(len(RELEASE_TRANSFERS)))
            if detector.sensor.architecture != "cmos" and transfer_s > 0 and total > 0:
                params[name] = [
                    {"density_per_px": float(total * share), "release_time_s": float(transfers * transfer_s)}
                    for share, transfers in zip(shares, RELEASE_TRANSFERS, strict=True)
                ]
        return params

    def alter(self, camera: Camera, params: Params) -> Camera:
        """The camera with those traps."""
        if not params:
            return camera
        detector: Any = camera.detector
        move = detector.sensor.transfer
        more = {
            f"{name}_traps": getattr(move, f"{name}_traps") + tuple(TrapSpecies(**row) for row in species)
            for name, species in params.items()
        }
        return with_sensor(camera, transfer=replace(move, **more))
