"""Lost and damaged packets: their places in the order of the nodes, what they show, and the pixels they reach."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from test_faults_kit import flat_electrons, make, make_context, noisy, rng, with_mosaic

from vbnfault.core.quantities import RawMosaic
from vbnfault.detector import load_sensor
from vbnfault.detector.readout import transmission_order
from vbnfault.faults import FaultContext

SIZE = 64
PARAMS: dict[str, Any] = {
    "packet_px": 100,
    "nodes": 1,
    "bits": 12,
    "lost": [],
    "damaged": [],
    "bit_error_rate": 0.0,
    "seed": 5,
    "lines": [],
    "fill": "zero",
}


def context(nodes: int = 1, size: int = SIZE, **sensor: Any) -> FaultContext:
    readout = replace(load_sensor("generic_cmos").readout, nodes=nodes)
    return with_mosaic(make_context(size, architecture="cmos"), readout=readout, **sensor)


def after(where: FaultContext, raw: Any, **params: Any) -> Any:
    return make("transmission").apply(RawMosaic(array=raw), PARAMS | params, where).array


def test_lost_packets_in_closed_form() -> None:
    where = context()
    raw = noisy("raw", where).array + 1
    expected = raw.ravel().copy()
    expected[200:300] = 0
    expected[4000:] = 0  # the last packet, 96 pixels
    assert np.array_equal(after(where, raw, lost=[2, 40]).ravel(), expected)
    expected = raw.ravel().copy()
    expected[200:400] = np.tile(expected[100:200], 2)
    assert np.array_equal(after(where, raw, lost=[2, 3], fill="previous").ravel(), expected)
    rows = after(where, raw, lines=[10, 11], fill="previous")
    assert np.array_equal(rows[10:12], raw[[9, 9]])


def test_what_follows_a_lost_packet_moves_up_to_the_next_mark() -> None:
    where = context()
    raw = noisy("raw", where).array + 1
    expected = raw.ravel().copy()
    block = 16 * SIZE
    expected[200 : block - 100], expected[block - 100 : block] = raw.ravel()[300:block], 0
    lost = after(where, raw, lost=[2, 40], fill="shifted", sync_rows=16)
    assert np.array_equal(lost.ravel()[: 3 * block], expected[: 3 * block])
    assert (lost.ravel()[4000:] == 0).all()
    # a packet that lies across a mark: 24 pixels of it are missing before, 76 behind
    across = after(where, raw, lost=[10], fill="shifted", sync_rows=16).ravel()
    assert np.array_equal(across[1000:block], np.zeros(24, np.uint16))
    assert np.array_equal(across[block : 2 * block - 76], raw.ravel()[block + 76 : 2 * block])
    assert (across[2 * block - 76 : 2 * block] == 0).all()
    assert np.array_equal(across[2 * block :], raw.ravel()[2 * block :])
    mask = make("transmission").footprint(PARAMS | {"lost": [10], "fill": "shifted", "sync_rows": 16}, where)
    assert mask[across.reshape(raw.shape) != raw].all()  # type: ignore[index]
    assert not mask[40:].any()  # type: ignore[index]


def test_lines_lose_their_ends() -> None:
    where = context(size=256)
    fault = make("transmission", cut_rows=100, lost_count=0, damaged_count=0, lost_lines=0)
    params = fault.draw(where, rng(3))
    raw = noisy("raw", where).array + 1
    gone = fault.apply(RawMosaic(array=raw), params, where).array == 0  # type: ignore[union-attr]
    rows = np.flatnonzero(gone.any(axis=1))
    # every second row of Bayer's tiles, of two lines each
    assert len(rows) == 50
    assert (rows % 4 == rows[0] + np.arange(50) % 2 - rows[0] // 4 * 4).all()
    ends = gone[rows].argmax(axis=1)
    assert all(gone[row, end:].all() and not gone[row, :end].any() for row, end in zip(rows, ends, strict=True))
    # a walk of steps of 2 % of the width
    steps = np.diff(ends[::2])
    assert 0 < np.abs(steps).max() < 5 * 0.02 * 256
    assert fault.footprint(params, where)[gone].all()  # type: ignore[index]


def test_nodes_send_in_turn() -> None:
    where = context(nodes=4)
    raw = noisy("raw", where).array + 1
    out = after(where, raw, lost=[0], nodes=4)
    lost = np.flatnonzero(out.ravel() == 0)
    assert np.array_equal(lost, np.sort(transmission_order(where.shape, 4)[:100]))
    # 25 pixels at each of the four corners
    corners = out[[0, 0, -1, -1]]
    assert (corners[:2, :25] == 0).all()
    assert (corners[:2, -25:] == 0).all()
    assert (out[-1, :25] == 0).all()


def test_bits_flip_at_their_rate_and_again_the_same() -> None:
    where = context()
    raw = noisy("raw", where).array
    damaged = {"damaged": list(range(0, 40, 2)), "bit_error_rate": 0.05}
    flips = raw ^ after(where, raw, **damaged)
    assert np.array_equal(flips, after(where, np.zeros_like(raw), **damaged))
    sent = np.repeat(np.arange(41) % 2 == 0, 100)[: SIZE * SIZE]
    sent[4000:] = False
    assert not flips.ravel()[~sent].any()
    assert flips.max() < 4096
    count = int(np.unpackbits(flips.view(np.uint8)).sum())
    # 2000 pixels of 12 bits: 1200 ± 34
    assert abs(count - 1200) < 140
    assert not np.array_equal(flips, raw ^ after(where, raw, **damaged, seed=6))


def test_draws_fit_and_bursts_are_runs() -> None:
    where = context(nodes=2)
    fault = make("transmission", packet_px=16, lost_count=2, burst_packets=[3, 5], damaged_count=6)
    for seed in range(30):
        params = fault.draw(where, rng(seed))
        assert not set(params["lost"]) & set(params["damaged"])
        assert len(params["damaged"]) == 6
        assert params["nodes"] == 2
        runs = np.split(np.array(params["lost"]), np.flatnonzero(np.diff(params["lost"]) > 1) + 1)
        # a burst at the end is cut off; two may join
        assert all(3 <= len(run) <= 10 or run[-1] == 255 for run in runs)
        assert 1 <= len(runs) <= 2
        assert len(params["lines"]) <= 3
    everything = make("transmission", packet_px=10_000, damaged_count=5).draw(where, rng())
    assert (everything["lost"], everything["damaged"]) == ([0], [])
    assert make("transmission", fill="zero").draw(where, rng())["fill"] == "zero"
    fills = {make("transmission").draw(where, rng(seed))["fill"] for seed in range(20)}
    assert fills == {"zero", "previous"}


@pytest.mark.parametrize(("demosaic", "nodes"), [("malvar", 1), ("bilinear", 4), ("menon", 2)])
def test_the_mask_is_where_the_picture_changes(demosaic: str, nodes: int) -> None:
    # Menon's reaches 8 pixels far
    where = context(nodes, 192 if demosaic == "menon" else SIZE, demosaic=demosaic)
    detector: Any = where.camera.detector
    signal = flat_electrons(where, 0.4)
    noise = detector.draw_noise(where.shape, lambda name: rng(len(name)))
    fault = make(
        "transmission",
        packet_px=[40, 90],
        lost_count=3,
        burst_packets=2,
        damaged_count=4,
        lost_lines=1,
        fill="zero",
    )
    for seed in range(5):
        params = fault.draw(where, rng(seed))
        seen = []

        def act(array: Any, params: Any = params, seen: Any = seen) -> Any:
            out = fault.apply(RawMosaic(array=array), params, where).array
            seen.append(out != array)
            return out

        before, image = (detector.develop(signal, 0.01, noise, acts).array for acts in ({}, {"raw": [act]}))
        changed = (before != image).any(axis=2)
        mask = fault.footprint(params, where)
        assert mask is not None
        assert not (changed & ~mask).any()
        assert mask[seen[0]].all()
        # of Menon's mask one picture shows a part; flips of the least bits round away
        assert changed.sum() > (0.2 if demosaic == "menon" else 0.5) * mask.sum()
        assert 0.02 < mask.mean() < 0.9
