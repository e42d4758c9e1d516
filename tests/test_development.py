"""The pixels in which two signals differ, found without taking the channels apart."""

from __future__ import annotations

import numpy as np
import pytest

from vbnfault.pipeline import development

ROWS_OF_THE_FRACTION = slice(70 // 32, None, 16)


def check(a: np.ndarray, b: np.ndarray) -> None:
    expected = (a != b).any(axis=2)
    np.testing.assert_array_equal(development._differ(a, b), expected.ravel())
    np.testing.assert_array_equal(development._differing_pixels(a, b), np.flatnonzero(expected))


@pytest.mark.parametrize("channels", [1, 3, 4])
def test_a_pixel_differs_in_any_channel(channels: int) -> None:
    a = np.random.default_rng(channels).random((70, 5, channels), dtype=np.float32)  # more than a block of 64 rows
    check(a, a.copy())
    for row, column in ((0, 0), (18, 2), (63, 4), (64, 0), (69, 4)):
        for channel in range(channels):
            b = a.copy()
            b[row, column, channel] += 1
            check(a, b)
            expected = (a != b).any(axis=2)[ROWS_OF_THE_FRACTION].mean()
            assert development._differing_fraction(a, b) == expected
            assert (expected > 0) == (row == 18)
    check(a, a + 1)
    assert development._differing_fraction(a, a + 1) == 1


@pytest.mark.parametrize("shape", [(0, 5, 3), (70, 0, 3), (0, 0, 1), (0, 5, 4)])
def test_nothing_differs_in_an_empty_image(shape: tuple[int, int, int]) -> None:
    empty = np.zeros(shape, np.float32)
    check(empty, empty)
    assert development._differing_fraction(empty, empty) == 0
