"""Simulate degraded optics as in the paper (Gallon et al.): blur the image by a Gaussian filter of odd size.

The paper states the filter's size (3-17 px), not its σ. Here σ follows from the size k by OpenCV's rule for
`GaussianBlur` with σ = 0,

    σ = 0.3 ((k - 1) / 2 - 1) + 0.8,

which gives 0.8 px at k = 3 and 2.9 px at k = 17 of a 1024 px wide image. Only odd sizes are drawn, so that the
filter has a centre. An even bound stands for the next odd size within the interval. σ is scaled with the width of
the image, but never below 0.4 px (the smallest filter of the paper at 512 px): a narrower filter hardly blurs.

The paper filters an 8 bit image, in which the Sun is no brighter than white. Signal above white is therefore
clipped to white before filtering. Otherwise the Sun (10⁵ times white) would be a white square as wide as the
filter, since it is above white even in the filter's corners. Beyond the frame the image is mirrored about its
outermost pixels.

Real optics blur light before it saturates. With the paper's order the Sun becomes a grey spot; with `unclipped` it
stays white and grows to the radius at which the Gaussian has fallen to its 10⁻⁵th part. The filter is then cut at
six standard deviations, so that the cut does not show.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from .context import FaultContext, Params
from .contract import Fault
from .fields import Interval, Severity, bounds, flag
from .planes import by_channel

_LEAST_SIGMA_PX = 0.4
_CUT_SIGMA = 6.0  # of the filter of light that is not clipped: the Sun is 10⁵ times white, exp(-6²/2) is 1.5e-8


@dataclass(frozen=True, kw_only=True)
class GaussianDegradation(Fault):
    """Blur the image uniformly by a Gaussian filter (Gallon et al., table of optics degradation parameters)."""

    fault = "optics_degradation"
    model = "gaussian"
    default = True
    after = "dust_on_optics"
    axis = 5
    step = "electrons"
    needs_light = True
    # σ of the filter is 0.15 (size + 7/3) px of a 1024 px wide image; the power is measured from 256 to 512 px
    severity = Severity(key="filter_size_px", low=1, high=201, step=2, width_power=-0.6, offset=7 / 3)
    localised = False

    filter_size_px: Interval = bounds(
        3, 17, limits=(1, 1001), integer=True, unit="px", doc="size of the square filter; odd sizes are drawn"
    )
    scale_with_resolution: bool = flag(True, doc="filter size refers to a 1024 px wide image and scales with it")
    unclipped: bool = flag(
        False,
        doc="whether light is blurred before it saturates, as by real optics, so that the Sun stays white; false: "
        "as in the paper",
    )

    def validate(self) -> None:
        """Raise ValueError if the interval contains no odd size."""
        if _odd_bounds(self.filter_size_px)[0] > _odd_bounds(self.filter_size_px)[1]:
            raise ValueError(f"filter_size_px = {list(self.filter_size_px)}: no odd size within")

    def draw(self, context: FaultContext, rng: np.random.Generator) -> Params:
        """Return the drawn size, and the size and σ of the filter at this resolution, in px."""
        lo, hi = _odd_bounds(self.filter_size_px)
        size = 2 * int(rng.integers(lo // 2, hi // 2, endpoint=True)) + 1
        scale = context.scale if self.scale_with_resolution else 1.0
        kernel_px = size if scale == 1 else max(3, 2 * round((size * scale - 1) / 2) + 1)
        sigma = max(float(sigma_px(size) * scale), _LEAST_SIGMA_PX)
        params: Params = {"filter_size_px": size, "kernel_px": kernel_px, "sigma_px": sigma}
        if self.unclipped:  # so that the stored parameters of other scenes stay as they are
            params |= {"kernel_px": 2 * math.ceil(_CUT_SIGMA * sigma) + 1, "unclipped": True}
        return params

    def apply(self, quantity: Any, params: Params, context: FaultContext) -> Any:
        """Return the expected electrons after the filter; first clipped to white, unless `unclipped` is set."""
        taps = cv2.getGaussianKernel(params["kernel_px"], params["sigma_px"], cv2.CV_32F)
        light = quantity.array
        if not params.get("unclipped"):
            light = by_channel(np.minimum, light, quantity.white_e)
        blurred = cv2.sepFilter2D(light, -1, taps, taps, borderType=cv2.BORDER_REFLECT_101)
        return quantity.with_array(blurred.reshape(light.shape))

    def footprint(self, params: Params, context: FaultContext) -> NDArray[np.bool_]:
        """Return the whole image as bool[y, x]."""
        return np.ones(context.shape, dtype=bool)


def sigma_px(size: int) -> float:
    """Return the standard deviation in px of a filter of odd `size`, by OpenCV's rule."""
    return 0.3 * ((size - 1) / 2 - 1) + 0.8


def _odd_bounds(interval: Interval) -> tuple[int, int]:
    """Return the smallest and the largest odd size within the interval."""
    lo, hi = int(interval.lo), int(interval.hi)
    return lo + (lo % 2 == 0), hi - (hi % 2 == 0)
