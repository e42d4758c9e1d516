"""Banding: interference that the signal picks up while it is read, and noise that a row shares.

A converter of the power supply or a clock of the platform couples into the analogue chain; read in time, a sinusoid
becomes stripes (`detector.readout`: banding over the readout time). Where a line is converted at once, as by the
column converters of a CMOS sensor, they lie along rows; where pixel after pixel passes one node, they are slanted.
Correlated double sampling lets frequency f pass by |2 sin(π f interval)|; the amplitude here is what is left
in the picture, since interference may also enter behind it. Row noise is in the noise alone, of its own variates.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ..camera import Camera
from ..detector.readout import ReadoutSpec
from .base import Fault, FaultContext, Interval, Params, bounds, flag, number, with_sensor

# Of what double sampling leaves: below it, the amplitude before it is not made any larger.
_LEAST_PASSED = 1e-3


@dataclass(frozen=True, kw_only=True)
class InterferenceBanding(Fault):
    """Periodic interference and row noise in the readout."""

    fault = "banding"
    model = "interference"
    step = "raw"
    needs_mosaic = True
    localised = False
    effect_mask = True

    amplitude_dn: Interval = bounds(
        2.0,
        15.0,
        limits=(0, 255),
        unit="DN of 255",
        doc="amplitude as it shows, in shares of white; assumed",
    )
    frequency_hz: Interval = bounds(
        500.0, 200e3, limits=(1, 1e9), unit="Hz", doc="of the interference, drawn evenly in its logarithm; assumed"
    )
    row_noise_dn: Interval = bounds(
        0.0,
        2.0,
        limits=(0, 255),
        unit="DN of 255",
        doc="rms of noise that a row shares, beside the sensor's; assumed",
    )
    lines_at_once: bool = flag(
        True, doc="the lines of a CMOS sensor are converted at once, so that bands are rows; false: pixel by pixel"
    )
    line_time_s: float | None = number(
        None,
        limits=(0, 10),
        unit="s",
        doc="between two lines; left out: the sensor's, or the time in which its rows are read",
    )

    def draw(self, context: FaultContext, rng: np.random.Generator) -> Params:
        """Amplitude and row noise in electrons as they show, frequency, phase, and the times of pixel and line."""
        detector: Any = context.camera.detector
        sensor, readout = detector.sensor, detector.sensor.readout
        dn_e = readout.white_e / 255
        amplitude_e = self.amplitude_dn.uniform(rng) * dn_e
        low, high = math.log(self.frequency_hz.lo), math.log(self.frequency_hz.hi)
        frequency_hz = min(max(math.exp(rng.uniform(low, high)), self.frequency_hz.lo), self.frequency_hz.hi)
        at_once = self.lines_at_once and sensor.architecture == "cmos"
        line_time_s = readout.line_time_s if self.line_time_s is None else self.line_time_s
        if line_time_s is None:
            pixels = -(-context.shape[1] // min(readout.nodes, 2))
            line_time_s = sensor.transfer.row_readout_s or readout.pixel_time_s * pixels
        return {
            "amplitude_e": float(amplitude_e),
            "frequency_hz": float(frequency_hz),
            "phase_rad": float(rng.uniform(0, 2 * math.pi)),
            "row_noise_e_rms": float(self.row_noise_dn.uniform(rng) * dn_e),
            "pixel_time_s": 0.0 if at_once else float(readout.pixel_time_s),
            "line_time_s": float(line_time_s),
        }

    def alter(self, camera: Camera, params: Params) -> Camera:
        """The camera whose readout picks up the interference."""
        detector: Any = camera.detector
        readout: ReadoutSpec = detector.sensor.readout
        passed = replace(readout, banding_amplitude_e=1.0, banding_frequency_hz=params["frequency_hz"])
        return with_sensor(
            camera,
            readout=replace(
                passed,
                banding_amplitude_e=params["amplitude_e"] / max(passed.banding_seen_e, _LEAST_PASSED),
                banding_phase_rad=params["phase_rad"],
                row_noise_e_rms=math.hypot(readout.row_noise_e_rms, params["row_noise_e_rms"]),
                pixel_time_s=params["pixel_time_s"],
                line_time_s=params["line_time_s"],
            ),
        )
