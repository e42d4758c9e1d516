"""Simulate smear: light that falls on charge during its transfer, because a part that should prevent it has failed.

Sᵢ = t Iᵢ + τ_row Σ_{k<i} I_k + τ_clear Σ_{k>i} I_k (`detector.charge.smear`). The possible causes depend on the
architecture:

- Frame-transfer CCD, `clock`: charge moves to the store more slowly, under light. `clear`: the image is no longer
  cleared at once but shifted out, so packets have passed the rows behind them before the exposure.
- Interline CCD, `shield`: the light shield over the registers lets more light through. A packet waits the readout
  time of a row in each pixel of its register.
- Full-frame CCD, `shutter`: the shutter stays partly open, and light falls during the readout. The formula is that
  of the frame transfer. τ_row is the readout time of a row times the fraction of light that passes the shutter.
- CMOS: no cause.

The sums run over the light of a column, so a bright spot draws a line, and dark sky in the same column becomes
brighter.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ..camera import Camera
from .context import FaultContext, Params
from .contract import Fault, with_sensor
from .fields import Interval, Severity, bounds, choice

CAUSES = {
    "frame_transfer_ccd": ("clock", "clear"),
    "interline_ccd": ("shield",),
    "full_frame_ccd": ("shutter",),
    "cmos": (),
}


@dataclass(frozen=True, kw_only=True)
class FrameTransferSmear(Fault):
    """Change the charge transfer: slow clocks, no fast clear, a leaking shield or a shutter that stays open."""

    fault = "smear"
    model = "frame_transfer"
    default = True
    after = "persistence"
    step = "pixels"
    severity = Severity(key="row_transfer_s", low=1e-7, high=1e-2, width_power=-1)
    needs_mosaic = True
    needs_ccd = True
    localised = False
    effect_mask = True

    cause: str = choice(
        "any",
        ("any", "clock", "clear", "shield", "shutter"),
        doc="what has failed; any: drawn from what the sensor's architecture has. Else nothing happens there",
    )
    row_transfer_s: Interval = bounds(
        2e-6,
        1e-5,
        limits=(0, 1),
        unit="s",
        doc="of a row by failing clocks, where the sensor's is shorter; assumed",
    )
    leak: Interval = bounds(
        1e-3, 1e-2, limits=(0, 1), doc="fraction of light through the shield of an interline CCD; assumed"
    )
    shutter_fraction: Interval = bounds(
        2e-3,
        2e-2,
        limits=(0, 1),
        doc="fraction of light past the shutter of a full-frame CCD; 1: open; assumed",
    )

    def draw(self, context: FaultContext, rng: np.random.Generator) -> Params:
        """Return the cause and the changed parameters of the transfer; {} if the cause cannot occur."""
        sensor = context.camera.mosaic.sensor
        move = sensor.transfer
        # the number of variates must not depend on the sensor
        row_s, leak, passed = (v.uniform(rng) for v in (self.row_transfer_s, self.leak, self.shutter_fraction))
        which = rng.random()
        causes = [c for c in CAUSES[sensor.architecture] if self.cause in ("any", c)]
        if not causes:
            return {}
        cause = causes[int(which * len(causes))]
        changes = {
            "clock": {"row_transfer_s": max(row_s, move.row_transfer_s)},
            "clear": {"row_clear_s": max(row_s, move.row_clear_s)},
            "shield": {
                "leak": max(leak, move.leak),
                "row_transfer_s": max(move.row_transfer_s, move.row_readout_s),
            },
            "shutter": {"shutter_transmission": max(passed, move.shutter_transmission)},
        }
        return {"cause": cause} | {key: float(value) for key, value in changes[cause].items()}

    def alter(self, camera: Camera, params: Params) -> Camera:
        """Return the camera with the changed transfer."""
        if not params:
            return camera
        changes = {key: value for key, value in params.items() if key != "cause"}
        return with_sensor(camera, transfer=replace(camera.mosaic.sensor.transfer, **changes))
