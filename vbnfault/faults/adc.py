"""Simulate a damaged analogue-to-digital converter: stuck bits, missing codes and uneven steps.

- A bit of the output that is stuck at 0 or 1 folds the scale. A stuck most significant bit halves it.
- A run of missing codes makes a step in the curve: signals in the run get the code below it, or the code above it
  if the run begins at 0.
- Integral and differential non-linearity (IEEE 1241) grow with dose. The differential non-linearity keeps the
  device's own pattern and becomes larger.

All sizes but the differential non-linearity, which is in LSB, are fractions of the converter's range, so they mean
the same for 8 and for 14 bits. All of them are assumed.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from ..camera import Camera
from .context import FaultContext, Params
from .contract import Fault, with_sensor
from .fields import Interval, Severity, bounds

# The curve rises everywhere if 4 |quadratic| + 6√3 |cubic| is below the range. Non-linearity may use up to this
# fraction of the range.
_STEEPEST = 0.9


@dataclass(frozen=True, kw_only=True)
class ConverterFault(Fault):
    """Add stuck bits, missing codes and non-linearity to the converter of a mosaic's readout."""

    fault = "adc"
    model = "converter"
    default = True
    after = "banding"
    step = "raw"
    severity = Severity(key="missing_fraction", low=1e-3, high=0.5)
    needs_mosaic = True
    localised = False
    effect_mask = True

    stuck_count: Interval = bounds(
        0, 1, limits=(0, 16), integer=True, doc="number of bits stuck at 0 or 1, with equal chance; assumed"
    )
    stuck_place: Interval = bounds(
        1, 5, limits=(0, 15), integer=True, doc="which bits: 0 is the most significant, the next 1, …; assumed"
    )
    missing_fraction: Interval = bounds(
        0.004, 0.02, limits=(0, 0.5), doc="fraction of the codes that are missing, in one run: 1 to 5 levels of 255"
    )
    inl_fraction: Interval = bounds(
        2e-4,
        3e-3,
        limits=(0, 0.2),
        doc="height of the arc of integral non-linearity, of either sign: 1 LSB of 12 bits, as of new converters, "
        "to 12 after dose; assumed",
    )
    inl_cubic_fraction: Interval = bounds(
        0.0, 1e-3, limits=(0, 0.1), doc="height of its S, of either sign; assumed"
    )
    dnl_lsb_rms: Interval = bounds(
        0.0, 0.5, limits=(0, 10), unit="LSB", doc="differential non-linearity beside the device's; assumed"
    )

    def draw(self, context: FaultContext, rng: np.random.Generator) -> Params:
        """Return `stuck_bits` as (bit, value) pairs, the run of missing codes, and the added non-linearities.

        `missing_from` and `missing_count` are in codes, `inl_quadratic_dn` and `inl_cubic_dn` in DN of the
        converter.
        """
        readout = context.camera.mosaic.sensor.readout
        # a converter with few bits lacks the less significant ones of the range
        low, high = (min(int(p), readout.bits - 1) for p in self.stuck_place)
        bits = rng.permutation(np.arange(low, high + 1))[: self.stuck_count.integer(rng)]
        values = rng.integers(0, 2, len(bits))
        codes = readout.top_dn + 1
        missing = min(round(self.missing_fraction.uniform(rng) * codes), codes // 2)
        range_dn = readout.top_dn - readout.bias_dn
        signs = np.where(rng.random(2) < 0.5, -1.0, 1.0)
        heights = (
            np.array([self.inl_fraction.uniform(rng), self.inl_cubic_fraction.uniform(rng)]) * range_dn * signs
        )
        before = _steepness(readout.inl_quadratic_dn, readout.inl_cubic_dn)
        room = max(_STEEPEST * range_dn - before, 0.0)
        heights *= min(1.0, room / max(_steepness(*heights), 1e-9))
        return {
            "stuck_bits": [
                [readout.bits - 1 - int(bit), int(value)] for bit, value in zip(bits, values, strict=True)
            ],
            "missing_from": int(rng.integers(0, codes - missing, endpoint=True)),
            "missing_count": int(missing),
            "inl_quadratic_dn": float(heights[0]),
            "inl_cubic_dn": float(heights[1]),
            "dnl_lsb_rms": self.dnl_lsb_rms.uniform(rng),
        }

    def alter(self, camera: Camera, params: Params) -> Camera:
        """Return the camera with this converter."""
        readout = camera.mosaic.sensor.readout
        first = params["missing_from"]
        missing = range(first, first + params["missing_count"])
        stuck = dict(readout.stuck_bits) | dict(params["stuck_bits"])
        return with_sensor(
            camera,
            readout=replace(
                readout,
                stuck_bits=tuple(sorted(stuck.items())),
                missing_codes=tuple(sorted({*readout.missing_codes, *missing})),
                inl_quadratic_dn=readout.inl_quadratic_dn + params["inl_quadratic_dn"],
                inl_cubic_dn=readout.inl_cubic_dn + params["inl_cubic_dn"],
                dnl_lsb_rms=math.hypot(readout.dnl_lsb_rms, params["dnl_lsb_rms"]),
            ),
        )


def _steepness(quadratic: float, cubic: float) -> float:
    """Return the largest slope, in DN over the whole range, that both non-linearities can take from the curve."""
    return 4 * abs(quadratic) + 6 * math.sqrt(3) * abs(cubic)
