"""Show a mosaic as levels of 8 bits: demosaicing, black level, white balance and luminance."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.quantities import LUMINANCE
from .demosaic import Mask, Method, bounded_at_edges, demosaic
from .mosaic import Pattern

U8 = NDArray[np.uint8]


@dataclass(frozen=True, kw_only=True)
class Display:
    """Hold the numbers with which the raw numbers of an exposure become levels.

    Attributes
    ----------
    black_dn
        Raw number that is shown as 0.
    noise_dn
        Standard deviation of the noise in the dark.
    scale
        Levels per DN of R, G and B.
    """

    black_dn: float
    noise_dn: float
    scale: tuple[float, float, float]


def levels(mosaic: NDArray[Any], pattern: Pattern, method: Method, saturated: Mask, display: Display) -> U8:
    """Return the levels of R, G and B, uint8[y, x, 3], of a mosaic [y, x] in DN.

    `saturated` bool[y, x] says which of its pixels are saturated.
    """
    black = display.black_dn
    linear = demosaic(mosaic, pattern, method)
    linear = bounded_at_edges(
        linear, mosaic, pattern, method, black=black, noise=display.noise_dn, clipped=saturated
    )
    # OpenCV multiplies with 64 bits, rounds to even and saturates at 0 and 255 as it converts
    above = cv2.subtract(linear, (black, black, black, 0.0))
    return np.asarray(cv2.multiply(above, (*display.scale, 0.0), dtype=cv2.CV_8U))


# The weights of R, G and B are rounded to whole 65536ths, and their sum is 1. Their products with levels, and the
# sums of these, are exact in single precision, so every order of the sum, fused or not, gives the same bits.
LUMINANCE_WEIGHTS = np.rint(LUMINANCE.astype(np.float64) * 65536) / 65536


def luminance(rgb: U8) -> U8:
    """Return the luminance, uint8[y, x], of R, G and B, uint8[y, x, 3]; halves become the even level."""
    return np.asarray(cv2.transform(rgb, LUMINANCE_WEIGHTS.reshape(1, 3))).reshape(rgb.shape[:2])


def with_luminance(rgb: U8) -> U8:
    """Return R, G, B and the luminance as I, uint8[y, x, 4], of R, G and B, uint8[y, x, 3]."""
    return np.asarray(cv2.insertChannel(luminance(rgb), cv2.cvtColor(rgb, cv2.COLOR_RGB2RGBA), 3))
