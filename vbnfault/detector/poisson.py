"""Evaluate the Poisson distribution.

scipy.stats has the same functions with the same bits, but it takes a second to import.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import gammaln, pdtr, pdtrik, xlogy

F64 = NDArray[np.float64]


def poisson_probability(count: ArrayLike, mean: float) -> F64:
    """Return the probability of each whole `count` ≥ 0, float64 in its shape."""
    k = np.asarray(count, dtype=np.float64)
    return np.asarray(np.minimum(np.exp(xlogy(k, mean) - gammaln(k + 1) - mean), 1))


def poisson_cumulative(count: ArrayLike, mean: float) -> F64:
    """Return the probability of at most `count`, float64 in its shape."""
    return np.asarray(pdtr(np.floor(np.asarray(count, dtype=np.float64)), mean))


def poisson_least_count(probability: float, mean: float) -> int:
    """Return the least count whose cumulative probability reaches `probability`, in (0, 1); `mean` > 0."""
    count = np.ceil(pdtrik(probability, mean))
    fewer = np.maximum(count - 1, 0)
    return int(fewer if pdtr(fewer, mean) >= probability else count)
