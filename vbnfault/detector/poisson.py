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


def poisson_least_count(probability: ArrayLike, mean: float) -> NDArray[np.int64]:
    """Return the least counts whose cumulative probabilities reach `probability`, in (0, 1); `mean` > 0."""
    count = np.ceil(pdtrik(probability, mean))
    fewer = np.maximum(count - 1, 0)
    return np.asarray(np.where(pdtr(fewer, mean) >= probability, fewer, count)).astype(np.int64)


def poisson_above_0(mean: float, uniform: ArrayLike) -> NDArray[np.int64]:
    """Return Poisson variates, given that they are not 0, for uniform numbers in [0, 1), int64 of their shape.

    A variate is the inverse of the upper tail at a probability below that of 1 or more.
    """
    chance = -np.expm1(-mean) * (1 - np.asarray(uniform))
    if mean < 1e-12:
        return np.ones(chance.shape, dtype=np.int64)
    return np.maximum(poisson_least_count(1 - chance, mean), 1)
