"""Define what happens to light on its way to charge: the response of each pixel, and smear."""

from __future__ import annotations

from functools import partial
from typing import Any

import cv2
import numpy as np

from ..charge import along_columns, parasitic_light, smear, smear_interline
from .contract import F32, Effect, Exposure, FaultStep


class Response(Effect):
    """Multiply the photo-electrons by the response of each pixel: PRNU and dead pixels."""

    name = "response"
    after = ""

    def apply(self, signal: Any, exposure: Exposure) -> F32:
        """Return the photo-electrons of each pixel."""
        return np.asarray(cv2.multiply(signal, exposure.device.response))


class LightStep(FaultStep):
    """Let faults act on the photo-electrons of each pixel."""

    name = "light"
    after = "response"


class Smear(Effect):
    """Add light that falls on charge while it moves through a CCD, or waits in the store of a global shutter."""

    name = "smear"
    after = "crosstalk"

    def apply(self, signal: F32, exposure: Exposure) -> F32:
        """Return the electrons with the added light."""
        sensor, move, exposure_s = exposure.sensor, exposure.sensor.transfer, exposure.exposure_s
        steps = {
            "frame_transfer_ccd": (
                move.row_transfer_s + move.row_clear_s,
                partial(smear, row_transfer_s=move.row_transfer_s, row_clear_s=move.row_clear_s),
            ),
            "full_frame_ccd": (
                move.row_readout_s * move.shutter_transmission,
                partial(smear, row_transfer_s=move.row_readout_s, shutter_transmission=move.shutter_transmission),
            ),
            "interline_ccd": (
                move.row_transfer_s * move.leak,
                partial(smear_interline, row_transfer_s=move.row_transfer_s, leak=move.leak),
            ),
            # only a global shutter stores charge; a rolling shutter reads each row at once
            "cmos": (
                move.row_readout_s * move.leak * (sensor.shutter == "global"),
                partial(parasitic_light, sensitivity=move.leak, row_period_s=move.row_readout_s),
            ),
        }
        weight, step = steps[sensor.architecture]
        if not weight or exposure_s <= 0:
            return signal
        light = signal if sensor.architecture == "cmos" else signal * np.float32(1 / exposure_s)
        return along_columns(sensor, exposure.device.direction, partial(step, exposure_s=exposure_s), light)
