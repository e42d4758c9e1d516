"""Degraded optics, the paper's model: the image blurred by a Gaussian filter of odd size.

The paper states the filter's size (3-17 px), not its σ. Here σ follows from the size k by OpenCV's rule for
`GaussianBlur` with σ = 0,

    σ = 0.3 ((k - 1) / 2 - 1) + 0.8,

which gives 0.8 px at k = 3 and 2.9 px at k = 17 of a 1024 px wide image. Sizes are drawn odd, so that the
filter has a centre; an even bound means the odd sizes within. Scaled to a smaller image σ stays at least 0.4 px
(the smallest filter of the paper at 512 px): below that nothing is left of the blur.

The paper filters an 8 bit image, in which the Sun is no brighter than white. Signal above white is therefore
clipped to white before filtering: otherwise the Sun (10⁵ times white) would flood the frame through the
filter's tails. Beyond the frame the image is mirrored about its outermost pixels.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from .base import Fault, FaultContext, Interval, Params, bounds, flag

_LEAST_SIGMA_PX = 0.4


@dataclass(frozen=True, kw_only=True)
class GaussianDegradation(Fault):
    """Uniform Gaussian blur (Gallon et al., table of optics degradation parameters)."""

    fault = "optics_degradation"
    model = "gaussian"
    step = "electrons"
    localised = False

    filter_size_px: Interval = bounds(
        3, 17, limits=(1, 1001), integer=True, unit="px", doc="size of the square filter; odd sizes are drawn"
    )
    scale_with_resolution: bool = flag(True, doc="filter size refers to a 1024 px wide image and scales with it")

    def validate(self) -> None:
        if _odd_bounds(self.filter_size_px)[0] > _odd_bounds(self.filter_size_px)[1]:
            raise ValueError(f"filter_size_px = {list(self.filter_size_px)}: no odd size within")

    def draw(self, context: FaultContext, rng: np.random.Generator) -> Params:
        """The drawn size, and the size and σ of the filter at this resolution, in px."""
        lo, hi = _odd_bounds(self.filter_size_px)
        size = 2 * int(rng.integers(lo // 2, hi // 2, endpoint=True)) + 1
        scale = context.scale if self.scale_with_resolution else 1.0
        return {
            "filter_size_px": size,
            "kernel_px": size if scale == 1 else max(3, 2 * round((size * scale - 1) / 2) + 1),
            "sigma_px": max(float(sigma_px(size) * scale), _LEAST_SIGMA_PX),
        }

    def apply(self, quantity: Any, params: Params, context: FaultContext) -> Any:
        """Expected electrons, clipped to white, then filtered."""
        taps = cv2.getGaussianKernel(params["kernel_px"], params["sigma_px"], cv2.CV_32F)
        kernel = np.asarray(taps, dtype=np.float32)
        return quantity.with_array(_blur(quantity.array, quantity.white_e, kernel))

    def footprint(self, params: Params, context: FaultContext) -> NDArray[np.bool_]:
        """bool[y, x]: the whole image."""
        return np.ones(context.shape, dtype=bool)


def sigma_px(size: int) -> float:
    """Standard deviation of a filter of odd `size`, px: OpenCV's rule."""
    return 0.3 * ((size - 1) / 2 - 1) + 0.8


def _odd_bounds(interval: Interval) -> tuple[int, int]:
    lo, hi = int(interval.lo), int(interval.hi)
    return lo + (lo % 2 == 0), hi - (hi % 2 == 0)


def _blur(
    array: NDArray[np.float32], white_e: NDArray[np.float32], kernel: NDArray[np.float32]
) -> NDArray[np.float32]:
    height, width = array.shape[:2]
    white_row = np.tile(white_e, width)  # rows of channels · width values: far faster than broadcasting
    reach = len(kernel) // 2
    out = np.empty_like(array)

    def filter_rows(start: int, stop: int) -> None:
        if start == stop:
            return
        # with `reach` more rows on either side a part comes out as it does in the whole image
        lo, hi = max(0, start - reach), min(height, stop + reach)
        clipped = np.minimum(array[lo:hi].reshape(hi - lo, -1), white_row).reshape(hi - lo, width, -1)
        blurred = cv2.sepFilter2D(clipped, -1, kernel, kernel, borderType=cv2.BORDER_REFLECT_101)
        out[start:stop] = blurred[start - lo : stop - lo].reshape(stop - start, width, -1)

    # OpenCV filters in one thread. Halves need rows enough to be mirrored at the frame's edge.
    middle = height // 2 if height // 2 > reach else 0
    with ThreadPoolExecutor(2) as pool:
        list(pool.map(filter_rows, (0, middle), (middle, height)))
    return out
