"""Simulate single event upsets: a bit of a register in the camera flips, and stays so until the register is reset.

An ion that crosses a flip-flop turns its bit (ECSS-E-HB-10-12A). Registers of an image sensor hold its settings,
such as the gain, the first row and column of the window, and the direction of readout. Beams of ions changed the
images of CMOS sensors by upsets of their offset, output and row address registers (Wang et al. 2019, Acta Opt. Sin.
39, 0504001; Proc. SPIE, doi 10.1117/12.2521237). With D the raw number, B the bias, and N the top code:

    gain     D' = round(B + (c XOR 2^b) / c · (D - B)), within 0 to N; c is the register, b its bit
    window   the image is shifted by 2^b px to either side, and what leaves at one side enters at the other
    flip     rows, columns or both come in the opposite order

The gain is that of a multiplication behind the converter: what was cut off there stays so, and turns grey by a
lower gain. Bias and black level stay as they are. The window is the whole sensor, whose address counter wraps.

The receiver knows nothing of it: it takes colours of the mosaic, listed defects and black levels to be where they
were. So images that are mirrored, or shifted by an odd number, have exchanged colours. Masks, strengths and defects
of faults before it are moved with the image; truth of the scene stays as the pose has it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .context import FaultContext, Params
from .contract import Fault
from .fields import Interval, Severity, bounds, choice, number

_AXES: dict[str, tuple[int, ...]] = {"rows": (0,), "columns": (1,), "both": (0, 1)}


@dataclass(frozen=True, kw_only=True)
class _RegisterUpset(Fault):
    """Change the whole raw mosaic; by default, move its pixels."""

    fault = "register_upset"
    step = "raw"
    needs_mosaic = True
    localised = False
    effect_mask = True

    def apply(self, quantity: Any, params: Params, context: FaultContext) -> Any:
        """Return the mosaic with its pixels moved."""
        return quantity.with_array(self.moved(quantity.array, params))


@dataclass(frozen=True, kw_only=True)
class GainUpset(_RegisterUpset):
    """Multiply the signal of the raw mosaic by the gain that a flipped bit makes."""

    model = "gain"
    default = True
    after = "broken_lines"

    code: int = number(
        24, limits=(1, 65535), integer=True, doc="gain register before, such as 1.5 in steps of 1/16; assumed"
    )
    bit: Interval = bounds(
        2, 6, limits=(0, 15), integer=True, doc="which bit flips, from the least significant; assumed"
    )

    def draw(self, context: FaultContext, rng: np.random.Generator) -> Params:
        """Return the register before and after."""
        return {"code": int(self.code), "flipped_code": int(self.code) ^ (1 << self.bit.integer(rng))}

    def apply(self, quantity: Any, params: Params, context: FaultContext) -> Any:
        """Return the raw digital numbers with another gain."""
        readout = context.camera.mosaic.sensor.readout
        signal = quantity.array.astype(np.int64) - readout.bias_dn
        numbers = readout.bias_dn + np.rint(signal * params["flipped_code"] / params["code"])
        return quantity.with_array(np.clip(numbers, 0, readout.top_dn).astype(np.uint16))


@dataclass(frozen=True, kw_only=True)
class WindowUpset(_RegisterUpset):
    """Shift the raw mosaic by a power of two rows or columns."""

    model = "window"
    severity = Severity(
        key="bit", low=1, high=13, drawn=lambda params, shape, focal_px: math.log2(abs(params["shift_px"]))
    )

    lines: str = choice("drawn", ("drawn", "rows", "columns"), doc="whose first address is wrong; drawn: either")
    bit: Interval = bounds(
        3, 9, limits=(0, 13), integer=True, doc="which bit flips, at most the highest that the frame needs; assumed"
    )

    def draw(self, context: FaultContext, rng: np.random.Generator) -> Params:
        """Return rows or columns, and the shift: negative where the window begins later, as the bit turns to 1."""
        lines = ("rows", "columns")[int(rng.integers(2))] if self.lines == "drawn" else self.lines
        highest = (context.shape[_AXES[lines][0]] - 1).bit_length() - 1
        shift = 1 << min(self.bit.integer(rng), highest)
        return {"lines": lines, "shift_px": shift if rng.random() < 0.5 else -shift}

    def moved(self, layer: NDArray[Any], params: Params) -> NDArray[Any]:
        """Return a layer of the mosaic, [y, x], shifted."""
        return np.roll(layer, params["shift_px"], _AXES[params["lines"]])


@dataclass(frozen=True, kw_only=True)
class FlipUpset(_RegisterUpset):
    """Mirror the raw mosaic."""

    model = "flip"

    lines: str = choice(
        "drawn",
        ("drawn", "rows", "columns", "both"),
        doc="what comes in the opposite order; drawn: one of the three",
    )

    def draw(self, context: FaultContext, rng: np.random.Generator) -> Params:
        """Return what comes in the opposite order."""
        drawn = list(_AXES)[int(rng.integers(len(_AXES)))]
        return {"lines": drawn if self.lines == "drawn" else self.lines}

    def moved(self, layer: NDArray[Any], params: Params) -> NDArray[Any]:
        """Return a layer of the mosaic, [y, x], mirrored."""
        return np.flip(layer, _AXES[params["lines"]]).copy()
