"""Describe what a detector of camera faults says about an image."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

F32 = NDArray[np.float32]


@dataclass(frozen=True, kw_only=True, eq=False)
class Prediction:
    """Hold what a detector says about one image.

    Attributes
    ----------
    masks
        float32[class, y, x]: probability that a class of fault is in a pixel, 0 to 1.
    present
        float32[class]: probability that the image has the class, 0 to 1.
    severity
        float32[class]: level of severity of the class, 0 (absent) to 5; nan where the detector says nothing.
    usable_fraction
        Fraction of the image's pixels that a navigation may use, 0 to 1; nan where the detector says nothing.
    """

    masks: F32
    present: F32
    severity: F32
    usable_fraction: float


class Detector(Protocol):
    """Describe what finds faults in images: a trained network, or the stored masks of another program."""

    @property
    def classes(self) -> tuple[str, ...]:
        """Return the classes of fault on the first axis of a prediction's arrays."""
        ...

    def predict(self, images: NDArray[np.uint8]) -> list[Prediction]:
        """Return a prediction for each image; `images` is uint8[sample, y, x, channel] with R, G, B and I."""
        ...
