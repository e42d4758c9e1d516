"""Simulate charge transfer inefficiency: traps that radiation has made in the columns and register of a CCD.

A packet of charge fills the traps within its cloud. The traps release the charge later, into the packets behind.
This makes trails away from the register, and packets that are transferred far lose more charge
(`detector.charge.cti`, after ArCTIC: Massey et al. 2010, MNRAS 401, 371). Displaced atoms make traps in proportion
to the dose. The fault draws the densities of traps in the columns and in the register.

There are three species. Release times in transfers and mean fractions are those of the columns of Hubble's ACS at
-81 °C, as fitted to the trails behind its warm pixels (Massey et al. 2010, MNRAS 409, L109; 2014, MNRAS 439, 887).
It had 1.8 traps per pixel after ten years, of 2048 rows. The fractions vary about these means, because they depend
on temperature and clocks. The register is assumed to have the same species.

Everything that is in the pixels before the readout has a trail: hot pixels (the device's own and those of
`broken_pixels`), tracks of cosmic rays, edges of bright ground. The masks of these faults hold the trails too
(`pipeline.masks`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ..camera import Camera
from ..detector.charge import TrapSpecies
from .context import FaultContext, Params
from .contract import Fault, with_sensor
from .fields import Interval, Severity, bounds

RELEASE_TRANSFERS = (0.74, 7.7, 37.0)
FRACTIONS = (0.17, 0.45, 0.38)
_FRACTIONS_FIRM = (
    10.0  # sum of the parameters of Dirichlet's distribution: a fraction of 0.45 spreads by 0.15; assumed
)


@dataclass(frozen=True, kw_only=True)
class RadiationTraps(Fault):
    """Add traps to those of the sensor.

    CMOS sensors are unchanged, and so are sensors whose file has no transfer time.
    """

    fault = "cti"
    model = "radiation"
    default = True
    after = "blooming"
    step = "charge"
    severity = Severity(
        key="parallel_per_px",
        low=0.01,
        high=100.0,
        width_power=-1,
        drawn=lambda params, *_: sum(trap["density_per_px"] for trap in params["parallel"]),
    )
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
        """Return the species of `parallel` and `serial` traps, with density_per_px and release_time_s of each."""
        sensor = context.camera.mosaic.sensor
        move = sensor.transfer
        params: Params = {}
        for name, density, transfer_s in (
            ("parallel", self.parallel_per_px, move.row_readout_s),
            ("serial", self.serial_per_px, move.pixel_transfer_s),
        ):
            total, fractions = density.uniform(rng), rng.dirichlet(_FRACTIONS_FIRM * np.array(FRACTIONS))
            if sensor.architecture != "cmos" and transfer_s > 0 and total > 0:
                params[name] = [
                    {"density_per_px": float(total * fraction), "release_time_s": float(transfers * transfer_s)}
                    for fraction, transfers in zip(fractions, RELEASE_TRANSFERS, strict=True)
                ]
        return params

    def alter(self, camera: Camera, params: Params) -> Camera:
        """Return the camera with the added traps."""
        if not params:
            return camera
        move = camera.mosaic.sensor.transfer
        more = {
            f"{name}_traps": getattr(move, f"{name}_traps") + tuple(TrapSpecies(**row) for row in species)
            for name, species in params.items()
        }
        return with_sensor(camera, transfer=replace(move, **more))
