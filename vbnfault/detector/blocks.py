"""Run steps on blocks of rows, which fit the cache.

Two threads do not help: numpy works on a block for some microseconds, and the threads then wait for the
interpreter's lock. On two cores they took longer than one thread, and twice its processor time.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

ROWS_PER_BLOCK = 64  # measured as the fastest for steps on one plane and on three colours


def blockwise(step: Callable[..., NDArray[Any]], array: NDArray[Any], *more: NDArray[Any] | None) -> NDArray[Any]:
    """Return `step(block, *blocks of more)` of all blocks of rows, joined.

    `more` are arrays; None stays None.
    """

    def of_block(start: int) -> NDArray[Any]:
        rows = slice(start, start + ROWS_PER_BLOCK)
        return step(array[rows], *(None if extra is None else extra[rows] for extra in more))

    first = of_block(0)
    if len(array) <= ROWS_PER_BLOCK:
        return first
    out = np.empty((len(array), *first.shape[1:]), first.dtype)
    out[:ROWS_PER_BLOCK] = first
    for start in range(ROWS_PER_BLOCK, len(array), ROWS_PER_BLOCK):
        out[start : start + ROWS_PER_BLOCK] = of_block(start)
    return out


def by_rows(step: Callable[[slice], None], height: int) -> None:
    """Call `step` for each block of rows of a plane."""
    for start in range(0, height, ROWS_PER_BLOCK):
        step(slice(start, min(start + ROWS_PER_BLOCK, height)))
