"""Compute the luminance of levels of 8 bits."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.quantities import LUMINANCE

U8 = NDArray[np.uint8]


# The weights of R, G and B are rounded to whole 65536ths, and their sum is 1. Their products with levels, and the
# sums of these, are exact in single precision, so every order of the sum, fused or not, gives the same bits.
LUMINANCE_WEIGHTS = np.rint(LUMINANCE.astype(np.float64) * 65536) / 65536


def luminance(rgb: U8) -> U8:
    """Return the luminance, uint8[y, x], of R, G and B, uint8[y, x, 3]; halves become the even level."""
    return np.asarray(cv2.transform(rgb, LUMINANCE_WEIGHTS.reshape(1, 3))).reshape(rgb.shape[:2])


def with_luminance(rgb: U8) -> U8:
    """Return R, G, B and the luminance as I, uint8[y, x, 4], of R, G and B, uint8[y, x, 3]."""
    return np.asarray(cv2.insertChannel(luminance(rgb), cv2.cvtColor(rgb, cv2.COLOR_RGB2RGBA), 3))
