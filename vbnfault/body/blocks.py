"""Compute large arrays in blocks of rows on two threads; the blocks are small enough for the cache."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
from numpy.typing import NDArray

_ROWS = 1 << 15  # the temporaries of a step then fit the cache of the processor
_THREADS = 2


def in_blocks(step: Callable[..., tuple[NDArray[Any], ...]], *arrays: NDArray[Any]) -> tuple[NDArray[Any], ...]:
    """Call `step(*blocks)` for each block of rows of the arrays, and return the arrays that it gives, joined.

    All arrays have equally many rows. `step` must treat each row on its own, so that the bits do not depend on the
    blocks.
    """
    count = len(arrays[0])
    if count <= _ROWS:
        return step(*arrays)
    blocks = [slice(start, start + _ROWS) for start in range(0, count, _ROWS)]
    with ThreadPoolExecutor(_THREADS) as pool:  # numpy uses one core
        parts = list(pool.map(lambda rows: step(*(array[rows] for array in arrays)), blocks))
    return tuple(np.concatenate(part) for part in zip(*parts, strict=True))
