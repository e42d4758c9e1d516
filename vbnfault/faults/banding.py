"""Simulate banding: interference that couples into the signal during the readout, and row noise.

A converter of the power supply or a clock of the platform couples into the analogue chain. A sinusoid in time
becomes stripes in the image (`detector.readout`: banding over the readout time). The stripes follow the rows if a
line is converted at once, as by the column converters of a CMOS sensor. They are slanted if the pixels pass one
node one after the other.

Correlated double sampling multiplies the amplitude at frequency f by |2 sin(π f interval)|. The drawn amplitude is
the one left in the image, because interference may also enter after the double sampling. Row noise is part of the
noise only, and has variates of its own.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from ..camera import Camera
from .context import FaultContext, Params
from .contract import Fault, with_sensor
from .fields import Interval, Severity, bounds, flag, number

# Least factor of double sampling that is compensated. Near its zeros the amplitude would otherwise diverge.
_LEAST_PASSED = 1e-3


@dataclass(frozen=True, kw_only=True)
class InterferenceBanding(Fault):
    """Add periodic interference and row noise to the readout of a mosaic."""

    fault = "banding"
    model = "interference"
    default = True
    after = "cti"
    step = "raw"
    severity = Severity(key="amplitude_dn", low=0.1, high=255.0)
    needs_mosaic = True
    localised = False
    effect_mask = True

    amplitude_dn: Interval = bounds(
        2.0,
        15.0,
        limits=(0, 255),
        unit="DN of 255",
        doc="amplitude as it shows, as a fraction of white; assumed",
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
        doc="between two lines; default: the sensor's, or the time in which its rows are read",
    )

    def draw(self, context: FaultContext, rng: np.random.Generator) -> Params:
        """Return amplitude and row noise in electrons, frequency, phase, and the times per pixel and per line.

        The amplitude is the one left in the image, after double sampling.
        """
        sensor = context.camera.mosaic.sensor
        readout = sensor.readout
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
        """Return the camera whose readout has this interference and row noise."""
        readout = camera.mosaic.sensor.readout
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
