"""Hash whole numbers, for random numbers that are keyed by what they are for."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

STEP = np.uint64(0x9E3779B97F4A7C15)  # between the keys of consecutive numbers


def mixed(key: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """Return the output function of SplitMix64 for keys, uint64 of any shape.

    Source: Steele, Lea & Flood 2014, doi 10.1145/2660193.2660195.
    """
    key = (key ^ (key >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    key = (key ^ (key >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return key ^ (key >> np.uint64(31))


def uniform(key: NDArray[np.uint64]) -> NDArray[np.float64]:
    """Return numbers in [0, 1), of 53 bits, from mixed keys."""
    return (key >> np.uint64(11)).astype(np.float64) * 2.0**-53
