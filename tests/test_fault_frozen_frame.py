"""Rows of an earlier exposure: which rows, moved by how much, and what they keep."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from test_faults_kit import make, make_context, noisy_electrons, rng, with_mosaic

from vbnfault.faults.planes import displaced

SIZE = 96


@pytest.mark.parametrize("mosaic", [False, True])
def test_stale_rows_show_the_scene_displaced(mosaic: bool) -> None:
    where = make_context(SIZE, architecture="cmos")
    where = with_mosaic(where) if mosaic else where
    light = noisy_electrons(where)
    ends = set()
    for seed in range(8):
        fault = make("frozen_frame", rows_fraction=0.25, shift_px=100.0)
        params = fault.draw(where, rng(seed))
        after: Any = fault.apply(light, params, where)
        first, last = params["rows"]
        dx, dy = params["shift_px"]
        ends.add((first, last))
        assert np.hypot(dx, dy) == pytest.approx(100 * SIZE / 1024, abs=1.5)
        stale = np.zeros(SIZE, bool)
        stale[first:last] = True
        np.testing.assert_array_equal(after.array[~stale], light.array[~stale])
        for y in range(max(first, abs(dy)), min(last, SIZE - abs(dy))):
            columns = np.arange(abs(dx), SIZE - abs(dx))
            np.testing.assert_array_equal(after.array[y, columns], light.array[y - dy, columns - dx])
    assert ends == {(0, SIZE // 4), (SIZE - SIZE // 4, SIZE)}


def test_displacements_add_and_mirror_what_lies_beyond_the_edges() -> None:
    image = np.arange(12 * 9, dtype=np.float32).reshape(12, 9)
    np.testing.assert_array_equal(displaced(image, 0, 0), image)
    moved = displaced(image, 3, -2)
    np.testing.assert_array_equal(moved[:10, 3:], image[2:, :6])
    np.testing.assert_array_equal(moved[:10, :3], image[2:, 3:0:-1])  # columns 3, 2, 1 mirrored about column 0
    np.testing.assert_array_equal(displaced(moved, -3, 2)[2:, :6], image[2:, :6])


def test_a_whole_frame_may_be_stale_and_none_of_it() -> None:
    where = make_context(SIZE)
    light = noisy_electrons(where)
    for fraction, changed in ((1.0, SIZE), (0.0, 0)):
        fault = make("frozen_frame", rows_fraction=fraction, shift_px=50.0)
        after: Any = fault.apply(light, fault.draw(where, rng()), where)
        assert (after.array != light.array).any(axis=(1, 2)).sum() == changed
