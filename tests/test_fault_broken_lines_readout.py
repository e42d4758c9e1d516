"""Broken lines of the readout: what can fail on which architecture, where it begins, and the pixels it reaches."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from test_faults_kit import flat_electrons, make, mosaic_context, noisy, rng

from vbnfault.core.quantities import ARCHITECTURES, RawMosaic
from vbnfault.detector.readout import node_of
from vbnfault.faults import FaultContext
from vbnfault.faults.broken_lines_readout import ONE_WAY, POSSIBLE

SIZE = 64
NOTHING: dict[str, Any] = {"lines": [], "register": None, "node": -1}


def context(architecture: str = "cmos", nodes: int = 1, **camera: Any) -> FaultContext:
    return mosaic_context(SIZE, architecture, camera=camera, readout={"nodes": nodes})


def fault(**keys: Any) -> Any:
    return make("broken_lines", model="readout", **keys)


def line(axis: str, index: int, kind: str, shift_px: int = 0, half: int = -1, begin: int = 0) -> dict[str, Any]:
    return {"axis": axis, "index": index, "kind": kind, "shift_px": shift_px, "half": half, "begin": begin}


def raw_of(where: FaultContext) -> Any:
    """Random codes between the faults' levels, so that what they set differs."""
    return noisy("raw", where).array // 2 + 300


def after(where: FaultContext, **params: Any) -> Any:
    return fault().apply(RawMosaic(array=raw_of(where)), NOTHING | params, where).array


@pytest.mark.parametrize("architecture", ARCHITECTURES)
def test_what_fails_follows_the_architecture(architecture: str) -> None:
    where = context(architecture)
    ccd = architecture != "cmos"
    seen: set[tuple[str, str]] = set()
    both = registers = 0
    for seed in range(80):
        params = fault().draw(where, rng(seed))
        lines = params["lines"]
        axes = {entry["axis"] for entry in lines}
        both += len(axes) == 2
        registers += params["register"] is not None
        assert params["node"] == -1, "one node only: the picture would be gone"
        seen |= {(entry["axis"], entry["kind"]) for entry in lines}
        assert len({(entry["axis"], entry["index"]) for entry in lines}) == len(lines)
        assert 1 <= len(lines) <= 10
        for entry in lines:
            assert (entry["shift_px"] != 0) == (entry["kind"] == "shifted")
            assert (entry["half"] >= 0) == (ccd and entry["axis"] == "column")
    assert seen == {(axis, kind) for (of_ccd, axis), kinds in POSSIBLE.items() if of_ccd == ccd for kind in kinds}
    assert (both == 0) == (architecture in ONE_WAY)
    # a chance of 0.1 in 80: 8 ± 2.7
    assert 1 <= registers <= 17 if ccd else registers == 0


def test_only_the_first_line_cannot_repeat_the_one_before_it() -> None:
    where = context()
    drawn = [entry for seed in range(40) for entry in fault().draw(where, rng(seed))["lines"]]
    repeated = [entry for entry in drawn if entry["kind"] == "duplicated"]
    assert len(repeated) > 10
    assert all(entry["index"] > 0 for entry in repeated)


def test_lines_in_closed_form_on_cmos() -> None:
    where = context()
    raw = raw_of(where)
    lines = [line("row", 5, "dead"), line("row", 9, "saturated"), line("row", 20, "shifted", -3)]
    lines += [line("column", 8, "saturated"), line("column", 12, "dead"), line("row", 31, "duplicated")]
    out = after(where, lines=lines)
    expected = raw.copy()
    expected[31] = raw[30]
    expected[20, :-3], expected[20, -3:] = raw[20, 3:], 0
    expected[5] = expected[:, 12] = 0
    expected[9] = expected[:, 8] = 4095
    assert np.array_equal(out, expected)


@pytest.mark.parametrize(("direction", "broken"), [("up", slice(40, None)), ("down", slice(None, SIZE - 40))])
def test_charge_beyond_a_defect_of_a_ccd_never_arrives(direction: str, broken: slice) -> None:
    where = context("full_frame_ccd", readout_direction=direction)
    out = after(where, lines=[line("column", 7, "dead", half=0, begin=40)])
    expected = raw_of(where)
    expected[broken, 7] = 100  # the bias
    assert np.array_equal(out, expected)


def test_nodes_and_register() -> None:
    where = context("frame_transfer_ccd", nodes=4)
    quadrants = node_of(where.shape, 4)
    assert np.array_equal(after(where, node=0) == 0, quadrants == 0)
    out = after(where, node=2)
    assert np.array_equal(out == 0, quadrants == 2)
    # the right nodes read from the right edge: 10 pixels of 32 pass, 22 lie behind
    out = after(where, register={"node": 1, "begin": 10})
    columns = np.arange(SIZE)
    assert np.array_equal(out == 100, (quadrants == 1) & (columns < SIZE - 10))
    lost = [fault(node_chance=1.0).draw(where, rng(seed))["node"] for seed in range(30)]
    assert set(lost) == {0, 1, 2, 3}
    # a column of the lower half is read downwards
    out = after(where, lines=[line("column", 3, "saturated", half=1, begin=20)])
    assert np.array_equal(np.flatnonzero(out[:, 3] == 4095), np.arange(32, SIZE - 20))


@pytest.mark.parametrize("architecture", ["cmos", "interline_ccd"])
def test_the_mask_is_where_the_picture_changes(architecture: str) -> None:
    where = context(architecture, nodes=2)
    detector: Any = where.camera.detector
    signal = flat_electrons(where, 0.4)
    noise = detector.draw_noise(where.shape, lambda name: rng(len(name)))
    shown = 0
    for seed in range(12):
        params = fault(node_chance=0.3, register_chance=0.3).draw(where, rng(seed))

        def act(array: Any, params: Any = params) -> Any:
            return fault().apply(RawMosaic(array=array), params, where).array

        before, image = (detector.develop(signal, 0.01, noise, acts).array for acts in ({}, {"raw": [act]}))
        changed = (before != image).any(axis=2)
        mask = fault().footprint(params, where)
        assert not (changed & ~mask).any()
        # neighbours of a line repeat it by chance, and Malvar's smallest weight, 1/16, may round away
        shown += changed.sum() / mask.sum() > 0.6
        rows = [entry["index"] for entry in params["lines"] if entry["axis"] == "row"]
        assert mask[rows].all()
    assert shown >= 10
