"""Broken pixels against a plain, pixel by pixel reading of the rules."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from test_faults_kit import flat_rgbi, make, make_context, noisy_rgbi, rng

from vbnfault.faults.broken_pixels import STEPS, TextureBrokenPixels

FAULT = TextureBrokenPixels()


def cmos(**columns: list[int]) -> dict[str, Any]:
    return {"sensor": "cmos"} | columns


def ccd(direction: str, **columns: list[int]) -> dict[str, Any]:
    return {"sensor": "ccd", "line_direction": direction} | columns


def plain_intensity(intensity: np.ndarray, params: dict[str, Any]) -> np.ndarray:
    """The module's three rules, one pixel at a time."""
    height, width = intensity.shape
    defects = {(y, x): b for x, y, b in zip(params["x"], params["y"], params["brightness_dn"], strict=True)}
    out = intensity.astype(float)
    dy, dx = STEPS[params.get("line_direction", "right")]
    for x, y, offset in zip(params["x"], params["y"], params.get("line_offset_dn", ()), strict=False):
        i, j = y + dy, x + dx
        while 0 <= i < height and 0 <= j < width:
            out[i, j] += offset
            i, j = i + dy, j + dx
    out = np.minimum(out, 255)
    for (y, x), b in defects.items():
        out[y, x] = b
    read = out.copy()
    demands: dict[tuple[int, int], list[float]] = {}
    for (y, x), b in defects.items():
        for dy, dx in STEPS.values():
            near, far = (y + dy, x + dx), (y + 2 * dy, x + 2 * dx)
            if not (0 <= near[0] < height and 0 <= near[1] < width) or near in defects:
                continue
            inside = 0 <= far[0] < height and 0 <= far[1] < width
            demands.setdefault(near, []).append((b + read[far if inside else near]) / 2)
    for pixel, values in demands.items():
        out[pixel] = np.rint(np.float32(sum(values) / len(values)))
    return out


def test_one_defect_and_its_neighbours() -> None:
    context = make_context(9)
    params = cmos(x=[4], y=[4], brightness_dn=[200])
    out = FAULT.apply(flat_rgbi(context, 50), params, context).array
    assert (out[4, 4] == 200).all()
    for y, x in ((3, 4), (5, 4), (4, 3), (4, 5)):
        assert (out[y, x] == 125).all()  # half way between 200 and the far pixel's 50
    assert (out == 50).all(axis=2).sum() == 81 - 5
    assert FAULT.footprint(params, context).sum() == 5


def test_colour_keeps_its_ratio_and_black_becomes_grey() -> None:
    context = make_context(9)
    array = np.zeros((9, 9, 4), np.uint8)
    array[4, 4] = (80, 60, 20, 60)
    params = cmos(x=[4, 1], y=[4, 1], brightness_dn=[90, 33])
    out = FAULT.apply(flat_rgbi(context, 0).with_array(array), params, context).array
    assert out[4, 4].tolist() == [120, 90, 30, 90]
    assert out[1, 1].tolist() == [33, 33, 33, 33]


@pytest.mark.parametrize("direction", list(STEPS))
def test_subtended_line_runs_to_the_frames_edge(direction: str) -> None:
    context = make_context(31, 21)
    params = ccd(direction, x=[12], y=[8], brightness_dn=[200], line_offset_dn=[40])
    out = FAULT.apply(flat_rgbi(context, 50), params, context).array[..., 3]
    # beyond the neighbour the line is 50 + 40; the neighbour on it is (200 + 90) / 2
    line = {"up": out[:7, 12], "down": out[10:, 12], "left": out[8, :11], "right": out[8, 14:]}[direction]
    assert (line == 90).all()
    dy, dx = STEPS[direction]
    assert out[8 + dy, 12 + dx] == 145
    assert out[8 - dy, 12 - dx] == 125
    assert (out == 90).sum() == len(line)
    length = {"up": 8, "down": 12, "left": 12, "right": 18}[direction]
    assert FAULT.footprint(params, context).sum() == 4 + length


@settings(max_examples=60)
@given(st.data())
def test_against_the_plain_reading_in_any_order(data: st.DataObject) -> None:
    # a crowded frame: neighbours shared, lines over defects, edges, corners
    width, height = data.draw(st.sampled_from([(8, 6), (5, 9)]))
    context = make_context(width, height)
    spots = data.draw(st.lists(st.integers(0, width * height - 1), min_size=1, max_size=14, unique=True))
    brightness = data.draw(st.lists(st.integers(0, 255), min_size=len(spots), max_size=len(spots)))
    offset = data.draw(st.lists(st.integers(0, 65), min_size=len(spots), max_size=len(spots)))
    direction = data.draw(st.sampled_from(list(STEPS)))

    def params(order: np.ndarray) -> dict[str, Any]:
        flat = np.array(spots)[order]
        return ccd(
            direction,
            x=(flat % width).tolist(),
            y=(flat // width).tolist(),
            brightness_dn=np.array(brightness)[order].tolist(),
            line_offset_dn=np.array(offset)[order].tolist(),
        )

    before = noisy_rgbi(context, seed=len(spots))
    given_order = params(np.arange(len(spots)))
    out = FAULT.apply(before, given_order, context).array
    assert np.array_equal(out[..., 3], plain_intensity(before.array[..., 3], given_order))
    shuffled = params(rng(1).permutation(len(spots)))
    assert np.array_equal(FAULT.apply(before, shuffled, context).array, out)


def test_draw_follows_the_table() -> None:
    context = make_context(1024, 16, architecture="interline_ccd", readout_direction="up")
    counts = set()
    for seed in range(60):
        params = make("broken_pixels").draw(context, rng(seed))
        counts.add(len(params["x"]))
        assert len(set(zip(params["x"], params["y"], strict=True))) == len(params["x"])
        assert params["line_direction"] == "up"
        for b, offset in zip(params["brightness_dn"], params["line_offset_dn"], strict=True):
            assert 0 <= b <= 255
            assert 0 <= offset <= min(65, 0.4 * b + 1e-9)
    assert min(counts) >= 10
    assert max(counts) <= 150
    assert len(counts) > 20
    assert len(make("broken_pixels", count=9).draw(context, rng())["x"]) == 9


def test_a_crowded_frame_still_has_as_many_pixels_as_drawn() -> None:
    """Where all neighbours of a defect are taken, and the pixel kept for it too, it goes elsewhere."""
    fault = make("broken_pixels", dense_cluster_probability=1)
    for seed in range(100):  # in one row the first defect has two neighbours, and three are to lie there
        x, y = fault._positions(4, 1, 16, rng(seed))
        assert len(set(zip(x, y, strict=True))) == 4


def test_cmos_has_no_lines() -> None:
    params = make("broken_pixels").draw(make_context(64, architecture="cmos"), rng())
    assert params["sensor"] == "cmos"
    assert "line_offset_dn" not in params
    assert "line_direction" not in params


def crowd(params: dict[str, Any]) -> np.ndarray:
    """How many other defects lie within 3×3 pixels of each."""
    x, y = np.array(params["x"]), np.array(params["y"])
    near = (abs(x[:, None] - x) <= 1) & (abs(y[:, None] - y) <= 1)
    return near.sum(axis=1) - 1


def test_clusters_are_as_stated() -> None:
    context = make_context(1024)
    alone = make("broken_pixels", count=100, cluster_fraction=0, dense_cluster_probability=0)
    some = make("broken_pixels", count=100, cluster_fraction=0.2, dense_cluster_probability=0)
    dense = make("broken_pixels", count=100, cluster_fraction=0, dense_cluster_probability=1)
    # by chance a pair has 8 / 1024²: 100 · 99 / 2 pairs make 0.04 per image
    assert sum(crowd(alone.draw(context, rng(s))).sum() for s in range(20)) <= 6
    for seed in range(20):
        assert (crowd(some.draw(context, rng(seed))) > 0).sum() >= 20
        assert crowd(dense.draw(context, rng(seed))).max() >= 3


def test_salt_and_pepper_share() -> None:
    context = make_context(256)
    fault = make("broken_pixels", count=150, brightness_dn=[1, 254], salt_and_pepper_fraction=0.2)
    values = np.concatenate([fault.draw(context, rng(s))["brightness_dn"] for s in range(20)])
    # 3000 at 0.2: standard deviation 21.9 of 600; four of them. Half are salt: 600 ± 4 · 12.2 · …
    extreme = np.isin(values, (0, 255)).sum()
    assert abs(extreme - 600) < 88
    assert abs((values == 255).sum() - extreme / 2) < 4 * np.sqrt(extreme) / 2
    never = make("broken_pixels", count=150, brightness_dn=[1, 254], salt_and_pepper_fraction=0)
    assert not np.isin(never.draw(context, rng())["brightness_dn"], (0, 255)).any()
