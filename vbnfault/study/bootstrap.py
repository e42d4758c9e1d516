"""Resample what a study evaluated, base samples or views, with replacement."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .spec import DesignTable

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]


def bootstrap(statistic: Callable[[I64], F64], n: int, table: DesignTable) -> Any:
    """Return what `scipy.stats.bootstrap` gives for a statistic of `n` samples: percentile interval, distribution.

    `statistic` gets the numbers of the samples that were drawn, int64[resample, n], and returns the estimates, with
    the resamples along the last axis. `table` gives the number of resamples, the confidence level and the seed, so
    that every statistic of a study gets the same resamples.
    """
    from scipy import stats

    def of_numbers(numbers: I64, axis: int) -> F64:
        estimates = statistic(np.atleast_2d(numbers))
        return estimates if numbers.ndim == 2 else estimates[..., 0]

    with warnings.catch_warnings():
        # samples of equal values, or without any: the interval is that value, or nan
        warnings.simplefilter("ignore", stats.DegenerateDataWarning)
        return stats.bootstrap(
            (np.arange(n),),
            of_numbers,
            n_resamples=table.resamples,
            batch=256,
            vectorized=True,
            axis=-1,
            confidence_level=table.confidence,
            method="percentile",
            rng=np.random.default_rng(table.seed),
        )


def bootstrap_of_counts(statistic: Callable[[F64], F64], n: int, table: DesignTable) -> Any:
    """Return the same for a statistic that gets how often each sample was drawn, float64[resample, n]."""

    def of_numbers(numbers: I64) -> F64:
        drawn = numbers + n * np.arange(len(numbers))[:, None]
        counts = np.bincount(drawn.ravel(), minlength=numbers.size).reshape(numbers.shape)
        return statistic(counts.astype(np.float64))

    return bootstrap(of_numbers, n, table)
