"""Broken lines by what reads the mosaic: row select, column amplifiers and multiplexer, register, output nodes.

Which of them a sensor has follows its architecture (Waltham 2013, CCD and CMOS sensors; Gallon et al., whose
section on broken pixels and lines it is taken from):
- CMOS: a row by its row select, a column by its amplifier or the multiplexer, over the whole frame, each line one
  or the other. Dead (code 0), saturated (top code), or repeating the line of the next smaller index, where an
  address fails to advance; rows also shifted along themselves, where the multiplexer loses or gains a clock.
- CCD: a column from its defect away from the register, since charge beyond cannot pass (dead: the bias) or takes up
  what the defect injects (saturated). A row that the register lost (dead) or moved by clocks too few or too many
  (shifted). Full-frame and frame-transfer CCDs have rows or columns, never both; interline CCDs either.
- CCD: a blocked pixel of the register takes all columns behind it, seen from its node.
- Several output nodes: one may be lost with its half or quadrant.

The numbers of failures and their shares are assumed; one to five of them is the paper's.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from ..detector.readout import (
    Axis,
    dead_lines,
    duplicated_lines,
    lost_node,
    node_of,
    readout_steps,
    saturated_lines,
    shifted_lines,
)
from .base import Fault, FaultContext, Interval, Params, bounds, number

Mask = NDArray[np.bool_]
Ints = NDArray[np.intp]

ONE_WAY = ("full_frame_ccd", "frame_transfer_ccd")

# What comes later wins where lines cross.
KINDS = ("duplicated", "shifted", "dead", "saturated")
# (is CCD, axis): what can happen there
POSSIBLE = {
    (False, "row"): ("dead", "saturated", "duplicated", "shifted"),
    (False, "column"): ("dead", "saturated", "duplicated"),
    (True, "row"): ("dead", "shifted"),
    (True, "column"): ("dead", "saturated"),
}


@dataclass(frozen=True, kw_only=True)
class ReadoutBrokenLines(Fault):
    """Lines, a part of the register or a node that the readout loses, in the raw mosaic."""

    fault = "broken_lines"
    model = "readout"
    step = "raw"
    needs_mosaic = True

    count: Interval = bounds(1, 5, limits=(0, 10_000), integer=True, doc="number of failures that take lines")
    group: Interval = bounds(
        1, 2, limits=(1, 64), integer=True, unit="px", doc="neighbouring lines that fail together; assumed"
    )
    row_share: float = number(
        0.5, limits=(0, 1), doc="share of rows; of samples where the architecture has rows or columns only; assumed"
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
        if not any(getattr(self, f"{kind}_weight") for kind in KINDS):
            raise ValueError("the weights of all kinds of lines are 0: at least one must be above")

    def draw(self, context: FaultContext, rng: np.random.Generator) -> Params:
        """`lines`: each with axis, index, kind, shift_px, and where it begins: half of the sensor and rows from
        its register (half -1: the whole line); `register`: node and first pixel lost, or None; lost `node`, or -1.
        """
        detector: Any = context.camera.detector
        sensor, nodes = detector.sensor, detector.sensor.readout.nodes
        ccd = sensor.architecture != "cmos"
        count, group = self.count.integer(rng), self.group.integer(rng)
        is_row = rng.random(count) < self.row_share
        if sensor.architecture in ONE_WAY:
            is_row[:] = rng.random() < self.row_share
        half, steps = _from_register(context)
        lines = []
        for axis, length, wanted in zip(
            ("row", "column"), context.shape, (is_row.sum(), (~is_row).sum()), strict=True
        ):
            kinds = POSSIBLE[ccd, axis]
            weights = np.array([getattr(self, f"{kind}_weight") for kind in kinds], dtype=np.float64)
            weights = weights / weights.sum() if weights.sum() > 0 else np.eye(len(kinds))[0]
            # a frame of a few pixels may have fewer lines than asked for
            for place in rng.permutation(max(length // group, 1))[:wanted]:
                first = int(place) * group
                kind = kinds[int(rng.choice(len(kinds), p=weights))]
                shift = self.shift_px.integer(rng) * (1 if rng.random() < 0.5 else -1)
                if kind == "duplicated" and first == 0:
                    kind = "dead"  # there is none before
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

    def apply(self, quantity: Any, params: Params, context: FaultContext) -> Any:
        """Raw numbers with the lines, the part of the register and the node as they fail."""
        detector: Any = context.camera.detector
        readout = detector.sensor.readout
        lost_dn = readout.bias_dn if detector.sensor.architecture != "cmos" else 0
        out = quantity.array.copy()
        for kind in KINDS:
            for axis in ("row", "column"):
                for shift in sorted({line["shift_px"] for line in _of(params, kind, axis)}):
                    lines = [line for line in _of(params, kind, axis) if line["shift_px"] == shift]
                    index = [line["index"] for line in lines]
                    along = cast(Axis, axis)
                    if kind == "dead":
                        failed = dead_lines(out, index, along, lost_dn)
                    elif kind == "saturated":
                        failed = saturated_lines(out, index, along, readout.bits)
                    elif kind == "duplicated":
                        failed = duplicated_lines(out, index, along)
                    else:
                        failed = shifted_lines(out, index, along, shift, lost_dn)
                    np.copyto(out, failed.raw, where=_reached(lines, context))
        if params["register"]:
            out[_behind(params["register"], context)] = readout.bias_dn
        if params["node"] >= 0:
            out = lost_node(out, readout.nodes, params["node"]).raw
        return quantity.with_array(out)

    def footprint(self, params: Params, context: FaultContext) -> Mask:
        """bool[y, x]: pixels of the picture that what fails can reach."""
        detector: Any = context.camera.detector
        sensor = detector.sensor
        region = _reached(params["lines"], context)
        if params["register"]:
            region |= _behind(params["register"], context)
        if params["node"] >= 0:
            region |= node_of(context.shape, sensor.readout.nodes) == params["node"]
        reached: Mask = detector.footprint(region)
        return reached


def _of(params: Params, kind: str, axis: str) -> list[dict[str, Any]]:
    return [line for line in params["lines"] if line["kind"] == kind and line["axis"] == axis]


def _from_register(context: FaultContext) -> tuple[Ints, Ints]:
    """The half of each row, int[y], and how many rows lie between it and the register of that half."""
    detector: Any = context.camera.detector
    rows = np.arange(context.shape[0])
    if detector.sensor.readout.nodes == 4:
        return (node_of(context.shape, 4)[:, 0] // 2).astype(np.intp), readout_steps(context.shape, 4)[0]
    return np.zeros_like(rows), rows if detector.direction == "up" else rows[::-1]


def _reached(lines: list[dict[str, Any]], context: FaultContext) -> Mask:
    """bool[y, x]: pixels of the mosaic that lie in the broken part of a line."""
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
    """bool[y, x]: pixels read through a node's register from its blocked pixel on."""
    detector: Any = context.camera.detector
    nodes = detector.sensor.readout.nodes
    pixels = readout_steps(context.shape, nodes)[1]
    return (node_of(context.shape, nodes) == register["node"]) & (pixels >= register["begin"])
