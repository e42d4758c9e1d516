"""Rank faults by what they cost: quantiles of each metric over the views, with bootstrap intervals.

A study with the factor `scene.fault` evaluates every fault on the same views. A view counts for a fault if the
fault acts in it and the metric has a value; where other factors vary, too, the median over their points counts.
Quantiles are taken over these views. The intervals are percentile intervals of `scipy.stats.bootstrap` over all
views of the study at once, so that all faults share each resample. So the fraction of the resamples in which the
median of one fault is worse than that of another (half of those in which both are equal) states how certain their
order is.

The quantile q of n values is the mean of the smallest value with at least q n values up to it, and of the smallest
one with more than q n of them (definition 2 of Hyndman and Fan 1996, doi 10.1080/00031305.1996.10473566); for
q = 0.5 it is the usual median.
"""

from __future__ import annotations

import warnings
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from .bootstrap import bootstrap
from .factors import FAULT_KEY, fault_choices

if TYPE_CHECKING:
    from .indices import Results

F64 = NDArray[np.float64]

QUANTILES = (0.25, 0.5, 0.75)
LONG_NAMES = {
    "fault_quantile": ("quantile of the metric over the views in which the fault acts", "units of the metric"),
    "fault_quantile_interval": (
        "quantile of the metric over the views, confidence interval",
        "units of the metric",
    ),
    "fault_rank": ("rank of the fault by its median, 1 for the worst; faults with equal medians share a rank", "1"),
    "fault_worse": ("fraction of the resamples in which the median of fault is worse than that of fault_b", "1"),
    "fault_views": ("number of views in which the fault acts and the metric has a value", "1"),
    "fault_acts": ("number of views in which the fault acts", "1"),
}


def add(arrays: dict[str, tuple[tuple[str, ...], F64]], results: Results) -> None:
    """Add the quantiles of all faults, their ranks, and how certain their order is."""
    values = by_view(results)  # [metric, model, fault, view]
    shape = values.shape[:3]
    quantiles = np.full((*shape, len(QUANTILES)), np.nan)
    interval = np.full((*quantiles.shape, 2), np.nan)
    rank = np.full(shape, np.nan)
    worse = np.full((*shape, shape[2]), np.nan)
    for i, metric in enumerate(results.metrics):
        sign = -1.0 if metric.better == "high" else 1.0
        for j in range(shape[1]):
            quantiles[i, j], interval[i, j], medians = _resampled(values[i, j], results)
            cost = sign * quantiles[i, j, :, QUANTILES.index(0.5)]
            known = np.flatnonzero(np.isfinite(cost))
            rank[i, j, known] = [1 + np.sum(cost[known] > cost[k]) for k in known]
            for a in known:
                for b in known[known != a]:
                    worse[i, j, a, b] = _fraction_above(sign * medians[a], sign * medians[b])
    dims = ("metric", "model", "fault")
    arrays["fault_quantile"] = ((*dims, "quantile"), quantiles)
    arrays["fault_quantile_interval"] = ((*dims, "quantile", "bound"), interval)
    arrays["fault_rank"] = (dims, rank)
    arrays["fault_worse"] = ((*dims, "fault_b"), worse)
    finite = np.isfinite(values)
    arrays["fault_views"] = (dims, finite.sum(axis=-1).astype(np.float64))
    arrays["fault_acts"] = (("fault",), finite.any(axis=(0, 1)).sum(axis=-1).astype(np.float64))


def by_view(results: Results) -> F64:
    """Return the value of each fault in each view, float64[metric, model, fault, view]; nan where there is none.

    Each seed has its own views. The value is the median over the points of the design with this fault.
    """
    spec = results.design.spec
    column = results.design.values[spec.keys.index(FAULT_KEY)]
    names = fault_choices(spec)
    seeds, views, _, models = results.design.shape
    out = np.full((len(results.metrics), models, len(names), seeds * views), np.nan)
    for k, name in enumerate(names):
        rows = np.flatnonzero(column == name)
        if not len(rows):
            continue
        of_fault = results.values[:, :, rows].reshape(seeds * views, len(rows), models, -1)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)  # no value at all: nan
            out[:, :, k] = np.moveaxis(np.nanmedian(of_fault, axis=1), 0, -1).swapaxes(0, 1)
    return out


def _resampled(values: F64, results: Results) -> tuple[F64, F64, F64]:
    """Return quantiles [fault, quantile], their intervals [fault, quantile, bound], and medians [fault, resample].

    `values` is [fault, view].
    """
    count = values.shape[1]
    quantiles = _quantiles(values[:, None])[..., 0]
    table = results.design.spec.design
    if count < 2:
        return quantiles, np.full((*quantiles.shape, 2), np.nan), quantiles[:, [QUANTILES.index(0.5)]]
    done = bootstrap(lambda views: _quantiles(values[:, views]), count, table)
    medians = done.bootstrap_distribution[:, QUANTILES.index(0.5)]
    return quantiles, _interval(done.bootstrap_distribution, table.confidence), medians


def _interval(distribution: F64, confidence: float) -> F64:
    """Return the percentile interval along the last axis, [..., 2], without the resamples that have no value."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # no value at all: nan
        ends = np.nanquantile(distribution, [(1 - confidence) / 2, (1 + confidence) / 2], axis=-1)
    return np.moveaxis(ends, 0, -1)


def _quantiles(values: F64) -> F64:
    """Return the quantiles of values [fault, resample, view], [fault, quantile, resample]; nan for no value."""
    from scipy import stats

    p = np.reshape(QUANTILES, (1, 1, -1))
    found = stats.quantile(values, p, method="averaged_inverted_cdf", axis=-1, nan_policy="omit")
    return np.moveaxis(found, -1, 1)


def _fraction_above(a: F64, b: F64) -> float:
    """Return the fraction of the pairs in which a is above b; equal ones count half."""
    both = np.isfinite(a) & np.isfinite(b)
    if not both.any():
        return float("nan")
    return float(np.mean((a[both] > b[both]) + 0.5 * (a[both] == b[both])))
