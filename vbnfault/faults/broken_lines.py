"""Simulate broken lines as in the paper (Gallon et al.): rows or columns of 0 or 255 in R, G, B and I.

The sensor's architecture, the same for broken pixels of the sample, decides between rows and columns:

- Full-frame and frame-transfer CCD: rows or columns, never both. The lines run along the camera's readout direction
  (left, right: rows; up, down: columns). The paper sets the direction of lines by this flag. It is the direction in
  which charge is shifted, so a fault affects all charge that follows in the same line. Broken lines are therefore
  parallel to the lines that broken pixels cause.
- Interline CCD and CMOS: each line is a row or a column with equal probability.

Each line is dead (0) or saturated (255) with equal probability, unless the scene fixes the numbers. No line occurs
twice. A pixel where a saturated and a dead line cross is saturated.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .context import FaultContext, Params
from .contract import Fault, first_of
from .fields import Interval, Severity, bounds, choice, number

BOTH_WAYS = ("interline_ccd", "cmos")


@dataclass(frozen=True, kw_only=True)
class TextureBrokenLines(Fault):
    """Set whole lines to dead or saturated (Gallon et al., table of broken pixels and lines)."""

    fault = "broken_lines"
    model = "texture"
    default = True
    after = "adc"
    axis = 2
    step = "rgbi"
    # measured from 256 to 512 px: of many features the strongest count, and lines are strong
    severity = Severity(
        key="count",
        low=1,
        high=500,
        width_power=0.3,
        drawn=lambda params, *_: len(params["rows"]) + len(params["columns"]),
    )

    count: Interval = bounds(1, 5, limits=(0, 10_000), integer=True, doc="number of broken lines")
    white_count: int | None = number(
        None, limits=(0, 10_000), integer=True, doc="how many of them are saturated; default: drawn"
    )
    black_count: int | None = number(
        None,
        limits=(0, 10_000),
        integer=True,
        doc="how many are dead; default: the rest. With both given, their sum is the number of lines",
    )
    direction: str = choice(
        "camera",
        ("camera", "rows", "columns"),
        doc="camera: by the sensor's architecture and readout direction; rows or columns: all lines so",
    )

    def validate(self) -> None:
        """Raise ValueError if the only fixed number exceeds the smallest total number of lines."""
        fixed = {"white_count": self.white_count, "black_count": self.black_count}
        given = {name: value for name, value in fixed.items() if value is not None}
        if len(given) == 1:
            ((name, value),) = given.items()
            if value > self.count.lo:
                raise ValueError(f"{name} = {value}: must not exceed the least number of lines, {self.count.lo:g}")

    def draw(self, context: FaultContext, rng: np.random.Generator) -> Params:
        """Return the indices of the broken `rows` and `columns` in pixels, with their values 0 or 255."""
        height, width = context.shape
        count = self.count.integer(rng)
        if self.white_count is not None and self.black_count is not None:
            count = int(self.white_count) + int(self.black_count)
        whites = int(rng.binomial(count, 0.5))
        if self.white_count is not None:
            whites = int(self.white_count)
        elif self.black_count is not None:
            whites = count - int(self.black_count)
        values = rng.permutation(np.where(np.arange(count) < whites, 255, 0))

        is_row = rng.random(count) < 0.5
        if self.direction != "camera":
            is_row[:] = self.direction == "rows"
        elif context.camera.architecture not in BOTH_WAYS:
            is_row[:] = context.camera.readout_direction in ("left", "right")
        # a frame of a few pixels may have fewer lines than the drawn count
        rows = rng.permutation(height)[: int(is_row.sum())]
        columns = rng.permutation(width)[: int((~is_row).sum())]
        return {
            "rows": rows.tolist(),
            "row_values": values[is_row][: len(rows)].tolist(),
            "columns": columns.tolist(),
            "column_values": values[~is_row][: len(columns)].tolist(),
        }

    def grown(self, params: Params, fraction: float) -> Params:
        """Return the parameters with only the first `fraction` of the rows and of the columns."""
        return first_of(params, fraction, "rows", "row_values", "columns", "column_values")

    def apply(self, quantity: Any, params: Params, context: FaultContext) -> Any:
        """Return the image with the lines set in all four channels."""
        out = quantity.array.copy()
        for value in (0, 255):  # saturated lines come last, so they win at crossings
            out[_of_value(params, "row", value)] = value
            out[:, _of_value(params, "column", value)] = value
        return quantity.with_array(out)

    def footprint(self, params: Params, context: FaultContext) -> NDArray[np.bool_]:
        """Return the pixels of the lines, bool[y, x]."""
        out = np.zeros(context.shape, dtype=bool)
        out[params["rows"]] = True
        out[:, params["columns"]] = True
        return out


def _of_value(params: Params, kind: str, value: int) -> list[int]:
    """Return the indices of the broken rows or columns that have the given value."""
    lines = zip(params[f"{kind}s"], params[f"{kind}_values"], strict=True)
    return [index for index, v in lines if v == value]
