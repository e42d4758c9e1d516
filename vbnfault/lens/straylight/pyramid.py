"""Add up the levels of an image pyramid, on whose coarser levels images with soft edges are drawn."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from ...core.process.llvm import backend

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
T = TypeVar("T")

LEVELS = 6
MARGIN = 4  # pixels around each level, for cells that lie partly outside
_CALM_SIGMA = 0.8  # sigma by which a coarser level is smoothed, in pixels of this level


@dataclass(frozen=True, kw_only=True, eq=False)
class Canvas:
    """Describe a sensor of `shape` (height, width) pixels of `pitch_mm`, centred on the axis, in `bands` bands."""

    shape: tuple[int, int]
    pitch_mm: float
    bands: int

    @property
    def sizes(self) -> NDArray[np.int64]:
        """Return height and width of each level with its margins, int64[level, 2]."""
        return np.array([[-(-n // 2**k) + 2 * MARGIN for n in self.shape] for k in range(LEVELS)])

    @property
    def starts(self) -> NDArray[np.int64]:
        """Return the index in a flat array at which each level begins, and the array's length, int64[level + 1]."""
        return np.concatenate([[0], np.cumsum(self.sizes.prod(axis=1) * self.bands)])


def summed(canvas: Canvas, levels: Sequence[NDArray[np.int64]], unit: float) -> F32:
    """Return the sum of levels of resolution, each resized to the frame, float32[layer, y, x].

    `levels` are int64[layer, y, x] each; `unit` is the value of an integer of 1.
    """
    out = np.empty((len(levels[0]), *canvas.shape), np.float32)

    def resize(layer: int) -> None:
        """Resize and add the levels of one layer, from the coarsest to the finest."""
        below: F32 | None = None
        for level in range(LEVELS - 1, -1, -1):
            height, width = (int(v) for v in canvas.sizes[level])
            # layer by layer, because a copy of all levels takes 45 MB for 1024 pixels
            here = np.multiply(levels[level][layer], unit, dtype=np.float32)
            if below is not None:
                # folds end in steps, which pixel centres sample unevenly
                calm = cv2.GaussianBlur(below, (3, 3), _CALM_SIGMA)
                bigger = cv2.resize(calm, None, fx=2, fy=2, interpolation=cv2.INTER_LINEAR)
                # pixel 0 of a level covers two pixels of the finer level, -M·2 + M and the next
                here += bigger[MARGIN : MARGIN + height, MARGIN : MARGIN + width]
            below = here
        assert below is not None
        rows, columns = (slice(MARGIN, MARGIN + n) for n in canvas.shape)
        # the parts are sampled on different lattices, so that their sum may be slightly negative
        np.maximum(below[rows, columns], 0, out=out[layer])

    in_layers(resize, len(out))
    return out


def scaled(array: F32, factors: F64) -> F32:
    """Return float32[band, y, x] after multiplying each band by a factor in place."""
    in_layers(lambda band: np.multiply(array[band], np.float32(factors[band]), out=array[band]), len(array))
    return array


def in_layers(step: Callable[[int], T], count: int) -> list[T]:
    """Return `step` of every layer from 0 to below `count`, computed in as many threads as a render has."""
    # numpy and OpenCV release the interpreter's lock
    with ThreadPoolExecutor(backend().dr.thread_count()) as pool:
        return list(pool.map(step, range(count)))
