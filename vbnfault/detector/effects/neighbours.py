"""Define how pixels share their signal with neighbours: carriers that diffuse, and capacitance between sense nodes.

Both keep the sum of the signal. Carriers that diffuse are counted once, where they are collected, so the noise of
crosstalk stays Poisson's and independent from pixel to pixel. Capacitance couples voltages of charge that is
collected already, so it spreads noise as it spreads signal: the variance of a flat falls to the sum of the squares
of the kernel, and neighbours are correlated (Moore, Ninkov & Forrest 2006, doi 10.1117/1.2219103). A gain in DN per
electron that is taken from this variance is too low.
"""

from __future__ import annotations

from abc import ABC
from typing import Self

import cv2
import numpy as np
from pydantic import Field

from .contract import F32, Effect, Exposure


class _Sharing(Effect, ABC):
    """Let each pixel give fractions of its signal to the eight pixels around it; at the edges none is lost."""

    spreads = True

    beside_fraction: float = Field(
        ge=0, le=0.12, description="fraction that each of the four pixels above, below, left and right gets"
    )
    corner_fraction: float = Field(
        0.0, ge=0, le=0.12, description="fraction that each of the four pixels at the corners gets"
    )

    def binned(self, pixels: int, tile: tuple[int, ...]) -> Self:
        """Return what blocks of pixels share across their edges. With a mosaic, blocks of colours interlace."""
        if max(tile) > 1:
            return self
        beside = pixels * self.beside_fraction + 2 * (pixels - 1) * self.corner_fraction
        fractions = {"beside_fraction": beside, "corner_fraction": self.corner_fraction}
        return self.model_copy(update={key: value / pixels**2 for key, value in fractions.items()})

    def apply(self, signal: F32, exposure: Exposure) -> F32:
        """Return the electrons that each pixel collects or shows."""
        kernel = np.full((3, 3), self.corner_fraction, dtype=np.float32)
        kernel[1, :] = kernel[:, 1] = self.beside_fraction
        kernel[1, 1] = 1 - 4 * (self.beside_fraction + self.corner_fraction)
        return np.asarray(cv2.filter2D(signal, -1, kernel, borderType=cv2.BORDER_REFLECT))


class Crosstalk(_Sharing):
    """Let carriers diffuse to neighbouring pixels before they are collected (Janesick 2001)."""

    name = "crosstalk"
    after = "light"


class InterpixelCapacitance(_Sharing):
    """Couple the voltages of neighbouring sense nodes, as in hybrid CMOS sensors and infrared arrays.

    Hubble's WFC3/IR has about 0.015 beside and 0.001 at the corners (Hilbert & McCullough 2011, WFC3 ISR 2011-10;
    recalled). That the coupling depends on the signal (Donlon et al. 2018, doi 10.1088/1538-3873/aac261) is not
    modelled.
    """

    name = "interpixel_capacitance"
    after = "full_well"
