"""Simulate broken lines by failures of the readout: row select, column amplifier, multiplexer, register, node.

The architecture decides which of these parts a sensor has (Waltham 2013, CCD and CMOS sensors; Gallon et al.,
section on broken pixels and lines):

- CMOS, whole lines: a row fails by its row select, a column by its amplifier or by the multiplexer. A line is dead
  (code 0), saturated (top code), or repeats the line of the next smaller index because an address fails to advance.
  A row may also be shifted along itself if the multiplexer loses or gains a clock.
- CCD, columns: a column fails from its defect on, away from the register. It is dead (the bias) if the charge
  beyond the defect cannot pass, or saturated if it takes up charge that the defect injects.
- CCD, rows: the register loses a row (dead), or moves it by too few or too many clocks (shifted). Full-frame and
  frame-transfer CCDs have broken rows or broken columns, never both. Interline CCDs may have both.
- CCD, register: a blocked pixel of the register removes all columns behind it, as counted from its node.
- Several output nodes: one may fail, with its half or quadrant.

The numbers of failures and their fractions are assumed, except that one to five broken lines is the paper's range.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..detector.readout import last_before, node_of, readout_steps
from .context import FaultContext, Params
from .contract import Fault, first_of
from .fields import Interval, Severity, bounds, number

Mask = NDArray[np.bool_]
Ints = NDArray[np.intp]

ONE_WAY = ("full_frame_ccd", "frame_transfer_ccd")

# Kinds in the order in which they are written: where lines cross, the later kind wins.
KINDS = ("duplicated", "shifted", "dead", "saturated")
# kinds that can occur, by (is CCD, axis)
POSSIBLE = {
    (False, "row"): ("dead", "saturated", "duplicated", "shifted"),
    (False, "column"): ("dead", "saturated", "duplicated"),
    (True, "row"): ("dead", "shifted"),
    (True, "column"): ("dead", "saturated"),
}


@dataclass(frozen=True, kw_only=True)
class ReadoutBrokenLines(Fault):
    """Break lines, a part of the register, or an output node in the raw mosaic."""

    fault = "broken_lines"
    model = "readout"
    step = "raw"
    # measured from 256 to 512 px: of many features the strongest count, and lines are strong
    severity = Severity(key="count", low=1, high=500, width_power=0.3, drawn=lambda params, *_: _failures(params))
    needs_mosaic = True

    count: Interval = bounds(1, 5, limits=(0, 10_000), integer=True, doc="number of failures that take lines")
    group: Interval = bounds(
        1, 2, limits=(1, 64), integer=True, unit="px", doc="neighbouring lines that fail together; assumed"
    )
    row_fraction: float = number(
        0.5,
        limits=(0, 1),
        doc="fraction of rows; of samples where a sensor has only rows or only columns; assumed",
    )
    dead_weight: float = number(0.4, limits=(0, 1), doc="weight of dead lines among those that can be; assumed")
    saturated_weight: float = number(0.3, limits=(0, 1), doc="weight of saturated lines; assumed")
    duplicated_weight: float = number(0.15, limits=(0, 1), doc="weight of lines that repeat others; assumed")
    shifted_weight: float = number(0.15, limits=(0, 1), doc="weight of lines that are shifted; assumed")
    shift_px: Interval = bounds(
        1, 32, limits=(1, 16384), integer=True, unit="px", doc="clocks lost or gained in a shifted row; assumed"
    )
    register_chance: float = number(
        0.1, limits=(0, 1), doc="chance that a blocked pixel of a CCD's register takes what is behind it; assumed"
    )
    node_chance: float = number(0.1, limits=(0, 1), doc="chance that one of several output nodes is lost; assumed")

    def validate(self) -> None:
        """Raise ValueError if the weights of all kinds are 0."""
        if not any(getattr(self, f"{kind}_weight") for kind in KINDS):
            raise ValueError("the weights of all kinds of lines are 0: at least one must be above")

    def draw(self, context: FaultContext, rng: np.random.Generator) -> Params:
        """Return the broken lines, the lost part of the register and the lost node.

        - `lines`: axis, index, kind and shift_px of each, the half of the sensor that it is in (-1: the whole line
          is broken) and `begin`, the number of rows between the register and the first broken pixel.
        - `register`: node and first lost pixel, or None.
        - `node`: index of the lost node, or -1.
        """
        sensor = context.camera.mosaic.sensor
        nodes = sensor.readout.nodes
        ccd = sensor.architecture != "cmos"
        count, group = self.count.integer(rng), self.group.integer(rng)
        is_row = rng.random(count) < self.row_fraction
        if sensor.architecture in ONE_WAY:
            is_row[:] = rng.random() < self.row_fraction
        half, steps = _from_register(context)
        lines = []
        for axis, length, wanted in zip(
            ("row", "column"), context.shape, (is_row.sum(), (~is_row).sum()), strict=True
        ):
            kinds = POSSIBLE[ccd, axis]
            weights = np.array([getattr(self, f"{kind}_weight") for kind in kinds], dtype=np.float64)
            weights = weights / weights.sum() if weights.sum() > 0 else np.eye(len(kinds))[0]
            # a frame of a few pixels may have fewer lines than the drawn count
            for block in rng.permutation(max(length // group, 1))[:wanted]:
                first = int(block) * group
                kind = kinds[int(rng.choice(len(kinds), p=weights))]
                shift = self.shift_px.integer(rng) * (1 if rng.random() < 0.5 else -1)
                if kind == "duplicated" and first == 0:
                    kind = "dead"  # line 0 has no line before it
                in_half, begin = -1, 0
                if ccd and axis == "column":
                    in_half = int(rng.integers(half.max(), endpoint=True))
                    begin = int(rng.integers(int(steps[half == in_half].max()), endpoint=True))
                lines += [
                    {
                        "axis": axis,
                        "index": index,
                        "kind": kind,
                        "shift_px": shift if kind == "shifted" else 0,
                        "half": in_half,
                        "begin": begin,
                    }
                    for index in range(first, min(first + group, length))
                ]
        node, register = -1, None
        if rng.random() < self.node_chance and nodes > 1:
            node = int(rng.integers(nodes))
        if rng.random() < self.register_chance and ccd:
            pixels = int(readout_steps(context.shape, nodes)[1].max())
            register = {"node": int(rng.integers(nodes)), "begin": int(rng.integers(1, pixels, endpoint=True))}
        return {"lines": lines, "register": register, "node": node}

    def grown(self, params: Params, fraction: float) -> Params:
        """Return the parameters with only the first `fraction` of the lines."""
        return first_of(params, fraction, "lines")

    def apply(self, quantity: Any, params: Params, context: FaultContext) -> Any:
        """Return the raw digital numbers with the broken lines, register and node."""
        sensor = context.camera.mosaic.sensor
        readout = sensor.readout
        lost_dn = readout.bias_dn if sensor.architecture != "cmos" else 0
        out = quantity.array.copy()
        for kind in KINDS:
            for axis in ("row", "column"):
                for shift in sorted({line["shift_px"] for line in _of(params, kind, axis)}):
                    lines = [line for line in _of(params, kind, axis) if line["shift_px"] == shift]
                    failed = out.copy()
                    _fail(failed if axis == "row" else failed.T, kind, lines, shift, lost_dn, readout.top_dn)
                    np.copyto(out, failed, where=_reached(lines, context))
        if params["register"]:
            out[_behind(params["register"], context)] = readout.bias_dn
        if params["node"] >= 0:
            out[node_of(context.shape, readout.nodes) == params["node"]] = 0
        return quantity.with_array(out)

    def footprint(self, params: Params, context: FaultContext) -> Mask:
        """Return the pixels of the image that the failures can change, bool[y, x]."""
        detector = context.camera.mosaic
        region = _reached(params["lines"], context)
        if params["register"]:
            region |= _behind(params["register"], context)
        if params["node"] >= 0:
            region |= node_of(context.shape, detector.sensor.readout.nodes) == params["node"]
        return detector.footprint(region)


def _fail(
    raw: NDArray[np.uint16], kind: str, lines: list[dict[str, Any]], shift_px: int, lost_dn: int, top_dn: int
) -> None:
    """Let some lines of a mosaic, its first axis, fail in place."""
    index = np.unique(np.array([line["index"] for line in lines], dtype=np.intp))
    if kind == "duplicated":  # a run of lines repeats the last one before it
        source = last_before(index)
        raw[index[source >= 0]] = raw[source[source >= 0]]
        return
    moved = np.full_like(raw[index], top_dn if kind == "saturated" else lost_dn)
    if kind == "shifted":
        to, of = (
            (slice(shift_px, None), slice(-shift_px)) if shift_px > 0 else (slice(shift_px), slice(-shift_px, None))
        )
        moved[:, to] = raw[index][:, of]
    raw[index] = moved


def _failures(params: Mapping[str, Any]) -> int:
    """Return the number of failures that took the lines; neighbouring lines of one kind failed together."""
    keys = [(line["axis"], line["half"], line["begin"], line["kind"], line["index"]) for line in params["lines"]]
    return sum(
        after[:4] != before[:4] or after[4] != before[4] + 1 for before, after in pairwise([(("",) * 5), *keys])
    )


def _of(params: Params, kind: str, axis: str) -> list[dict[str, Any]]:
    """Return the broken lines of one kind and axis."""
    return [line for line in params["lines"] if line["kind"] == kind and line["axis"] == axis]


def _from_register(context: FaultContext) -> tuple[Ints, Ints]:
    """Return the half of each row, int[y], and the number of rows between it and its register, int[y]."""
    detector = context.camera.mosaic
    rows = np.arange(context.shape[0])
    if detector.sensor.readout.nodes == 4:
        return (node_of(context.shape, 4)[:, 0] // 2).astype(np.intp), readout_steps(context.shape, 4)[0]
    return np.zeros_like(rows), rows if detector.direction == "up" else rows[::-1]


def _reached(lines: list[dict[str, Any]], context: FaultContext) -> Mask:
    """Return the mosaic's pixels in the broken parts of the lines, bool[y, x]."""
    out = np.zeros(context.shape, dtype=np.bool_)
    out[[line["index"] for line in lines if line["axis"] == "row"]] = True
    half, steps = _from_register(context)
    columns = [line for line in lines if line["axis"] == "column"]
    index, in_half, begin = (
        np.array([line[key] for line in columns], dtype=np.intp) for key in ("index", "half", "begin")
    )
    broken = ((in_half < 0) | (half[:, None] == in_half)) & (steps[:, None] >= begin)
    out[:, index] |= broken
    return out


def _behind(register: dict[str, int], context: FaultContext) -> Mask:
    """Return the mosaic's pixels that are read through the blocked pixel of the register, bool[y, x]."""
    nodes = context.camera.mosaic.sensor.readout.nodes
    pixels = readout_steps(context.shape, nodes)[1]
    return (node_of(context.shape, nodes) == register["node"]) & (pixels >= register["begin"])
