"""Resample what a study evaluated, base samples or views, with replacement."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .spec import DesignTable

F64 = NDArray[np.float64]


def bootstrap(statistic: Callable[[F64], F64], n: int, table: DesignTable) -> Any:
    """Return what `scipy.stats.bootstrap` gives for a statistic of `n` samples: percentile interval, distribution.

    `statistic` gets how often each sample was drawn, float64[resample, n], and returns the estimates, with the
    resamples along the last axis. `table` gives the number of resamples, the confidence level and the seed, so that
    every statistic of a study gets the same resamples.
    """
    from scipy import stats

    def of_indices(index: NDArray[np.int64], axis: int) -> F64:
        rows = np.atleast_2d(index)
        flat = rows + n * np.arange(len(rows))[:, None]
        counts = np.bincount(flat.ravel(), minlength=n * len(rows)).reshape(len(rows), n)
        estimates = statistic(counts.astype(np.float64))
        return estimates if index.ndim == 2 else estimates[..., 0]

    with warnings.catch_warnings():
        # samples of equal values, or without any: the interval is that value, or nan
        warnings.simplefilter("ignore", stats.DegenerateDataWarning)
        return stats.bootstrap(
            (np.arange(n),),
            of_indices,
            n_resamples=table.resamples,
            batch=256,
            vectorized=True,
            axis=-1,
            confidence_level=table.confidence,
            method="percentile",
            rng=np.random.default_rng(table.seed),
        )
