r"""Compute the indices of a study from its evaluations, with bootstrap intervals.

All indices of a metric pool the blocks b of a study, which are its seeds and views: each variance and each part of
it is summed over the blocks before the ratio is formed (the generalised index of Gamboa et al. 2014, doi
10.1214/14-EJS895). So an index says how the metric varies within one view, and the differences between views do not
enter it. With one block this is the usual index.

==================  ==========================================================================================
index               formula, with y_A, y_B, y_Ai the metric at A, B and A with factor i from B
==================  ==========================================================================================
first order S1      Σ_b ⟨y_B (y_Ai − y_A)⟩ / Σ_b V_b  (Saltelli et al. 2010, doi 10.1016/j.cpc.2009.09.018)
total ST            Σ_b ⟨(y_A − y_Ai)²⟩ / 2 Σ_b V_b  (Jansen 1999, doi 10.1016/S0010-4655(98)00154-4)
total interaction   Σ_b ⟨(y_A − y_Ai) (y_A − y_Aj)⟩ / Σ_b V_b: all terms that contain both i and j (Liu & Owen
of i and j          2006, doi 10.1198/016214505000001410; Fruth et al. 2014, doi 10.1016/j.jspi.2013.11.007)
dummy, first order  Σ_b ⟨y_A y_B⟩ / Σ_b V_b  (Khorashadi Zadeh et al. 2017, doi 10.1016/j.envsoft.2017.02.001)
dummy, total        1 − Σ_b ⟨y_B²⟩ / Σ_b V_b  (the same)
model form          Σ_b V_m(E[y|m]) / Σ_b V_b, with the law of total variance V = E_m[V(y|m)] + V_m(E[y|m])
==================  ==========================================================================================

The mean of each block is subtracted first, and V_b is the variance over A and B together. The estimators of S1 and
ST give nothing but zeros for the dummy factor, because y_Ai = y_A. Those of Khorashadi Zadeh et al. do not cancel:
their expectation is 0, and their spread shows the noise of a study of this size.

Surrogates of the metric reduce the variance of all these means, as control variates (`control_variates` and
`sobol_terms` have the formulae and the conditions). With them the intervals are symmetric bootstrap-t intervals
(Hall 1988, doi 10.1111/j.2517-6161.1988.tb01706.x). Without them, the intervals are percentile intervals, and S1
and ST are those of `scipy.stats.sobol_indices` for one block (a test compares them). That function takes neither
several blocks nor a number of base samples that is no power of two, as failed evaluations leave, and its bootstrap
takes no seed. Both kinds of intervals come from `scipy.stats.bootstrap` over base samples, as if these were
independent, so with a Sobol' sequence they are too wide rather than too narrow. Morris' effects and the densities
of delta come from SALib.

A bootstrap of few samples knows too little of a distribution: of 95 % intervals from 8 samples, 58 to 95 % held the
true index (`benchmarks/study_coverage.py`). Below `LEAST_SAMPLES_OF_INTERVALS`, the interval of a fraction of the
variance is therefore all that is known without samples, 0 to 1 (of the dummy factor, whose index may err to both
sides, -1 to 1), and an estimate beyond it takes its nearest end. Half-widths of Morris' means become those of
Student's distribution.
"""

from __future__ import annotations

import contextlib
import itertools
import math
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from . import ranking
from .bootstrap import bootstrap_of_counts
from .control_variates import LEAST_SAMPLES, Surrogates, fit, make_basis
from .designs import Design, levels, salib, unit_problem
from .factors import FAULT_KEY, fault_choices
from .sobol_terms import SobolTerms, complete_samples, explained_variance, ratios, sobol_terms, split
from .spec import DUMMY, Metric

if TYPE_CHECKING:
    import xarray as xr

# SALib makes two bootstraps with some twenty density estimates for each resample: minutes for a thousand of them.
_MOST_RESAMPLES_OF_DELTA = 20
LEAST_SAMPLES_OF_DELTA = 100  # SALib refuses to estimate delta from fewer
LEAST_SAMPLES_OF_INTERVALS = 16
_ROUNDING = 1e-9  # of indices
_Array = NDArray[np.float64]
_Arrays = dict[str, tuple[tuple[str, ...], _Array]]  # name → dimensions and values
_DIMS = ("metric", "model", "factor")


@dataclass(frozen=True)
class Results:
    """Hold the values of all evaluations of a study.

    Attributes
    ----------
    design
        The design.
    metrics
        The metrics.
    values
        float64[seed, view, row, model, metric]; nan where an evaluation failed or a metric has no value.
    """

    design: Design
    metrics: tuple[Metric, ...]
    values: _Array

    def blocks(self, metric: int, model: int) -> _Array:
        """Return the values of a metric with a model, float64[block, row]."""
        return self.values[:, :, :, model, metric].reshape(-1, self.values.shape[2])


def compute(results: Results) -> xr.Dataset:
    """Return the indices of a study by metric, model and factor, the dummy factor last, as labelled arrays."""
    import xarray as xr

    design = results.design
    spec = design.spec
    method = spec.design.method
    arrays: _Arrays = {}
    _add_moments(arrays, results)
    if method == "sobol":
        _add_sobol(arrays, results)
    elif method == "morris":
        _add_morris(arrays, results)
    elif method == "latin_hypercube":
        _add_delta(arrays, results)
    elif method == "grid":
        _add_grid(arrays, results)
    else:
        _add_ranges(arrays, results)
    if spec.models is not None and method in ("sobol", "latin_hypercube", "grid"):
        _add_model_share(arrays, results)
    if FAULT_KEY in spec.keys:
        ranking.add(arrays, results)
    names = [*spec.keys, DUMMY]
    coordinates: dict[str, Any] = {
        "metric": [metric.name for metric in results.metrics],
        "model": list(spec.model_names),
        "factor": names,
        "factor_b": names,
        "seed": list(spec.scene.seeds),
        "bound": ["low", "high"],
        "fault": list(fault_choices(spec)),
        "fault_b": list(fault_choices(spec)),
        "quantile": list(ranking.QUANTILES),
    }
    used = {name for dims, _ in arrays.values() for name in dims}
    data = xr.Dataset(
        {name: (dims, values, _attributes(name)) for name, (dims, values) in arrays.items()},
        {
            name: (name, np.array(values, dtype=None if name in _NUMBERS else object), {"long_name": name})
            for name, values in coordinates.items()
            if name in used
        },
    )
    about = {
        name: ("metric", np.array([getattr(metric, name) for metric in results.metrics], dtype=object))
        for name in ("unit", "description", "source", "better")
    }
    return data.assign_coords(about)


# --- names and units of the variables -----------------------------------------------------------------------------

_LONG_NAMES = {
    "mean": ("mean of the metric over the design", "units of the metric"),
    "variance": ("variance of the metric within a block, over the design", "squared units of the metric"),
    "samples_used": ("number of complete base samples of the design that the indices use", "1"),
    "samples_left_out": ("number of base samples left out, because an evaluation failed or gave no value", "1"),
    "S1": ("first-order index: fraction of the variance due to the factor alone", "1"),
    "ST": ("total index: fraction of the variance due to the factor and its interactions", "1"),
    "interaction": ("total interaction index: fraction of the variance due to terms with both factors", "1"),
    "explained": (
        "fraction of the variance that the surrogates of the control variates explain at samples that they were "
        "not fitted to; nan where control variates are not used",
        "1",
    ),
    "model_share": ("fraction of the variance over factors and models that is due to the model", "1"),
    "mu": ("mean elementary effect, over the whole range of the factor", "units of the metric"),
    "mu_star": ("mean absolute elementary effect, over the whole range of the factor", "units of the metric"),
    "sigma": ("standard deviation of the elementary effects", "units of the metric"),
    "delta": ("moment-independent index (Borgonovo 2007), bias-reduced (Plischke et al. 2013)", "1"),
    "range": ("largest minus smallest value with the other factors nominal", "units of the metric"),
    **ranking.LONG_NAMES,
}
_NUMBERS = ("seed", "quantile")  # coordinates that are no words
_SUFFIXES = {
    "_interval": ", confidence interval",
    "_by_seed": ", of each seed",
    "_seed_deviation": ", standard deviation over the seeds",
}
_FORMULAE = {
    "S1": "of a Sobol' design: sum_b <y_B (y_AB - y_A)> / sum_b V_b",
    "ST": "of a Sobol' design: sum_b <(y_A - y_AB)^2> / (2 sum_b V_b)",
    "interaction": "sum_b <(y_A - y_ABi) (y_A - y_ABj)> / sum_b V_b",
    "model_share": "sum_b V_m(E[y|m]) / sum_b V_b, where V = E_m[V(y|m)] + V_m(E[y|m]) (law of total variance)",
}


def _attributes(name: str) -> dict[str, str]:
    """Return long name, units and formula of a variable."""
    for suffix, text in _SUFFIXES.items():
        if name.endswith(suffix) and name not in _LONG_NAMES:
            long_name, units = _LONG_NAMES[name.removesuffix(suffix)]
            return {"long_name": long_name + text, "units": units}
    long_name, units = _LONG_NAMES[name]
    formula = {"formula": _FORMULAE[name]} if name in _FORMULAE else {}
    return {"long_name": long_name, "units": units, **formula}


# --- bootstrap ----------------------------------------------------------------------------------------------------


def _intervals(statistic: Any, n: int, design: Design) -> _Array:
    """Return percentile bootstrap intervals, float64[..., 2], over `n` base samples.

    `statistic` is that of `bootstrap_of_counts`. All metrics and models get the same resamples.
    """
    if n < 2:
        return np.full((*np.shape(statistic(np.ones((1, n))))[:-1], 2), np.nan)
    interval = bootstrap_of_counts(statistic, n, design.spec.design).confidence_interval
    return np.stack([interval.low, interval.high], axis=-1)


def _studentised_intervals(terms: SobolTerms, design: Design) -> _Array:
    """Return symmetric bootstrap-t intervals of indices, float64[index, 2] (Hall 1988).

    The half-width is the standard error times the quantile of |θ* − θ| / (standard error of θ*) over resamples,
    with θ* the index of a resample: percentile intervals would be too narrow, because few samples decide how far
    surrogates err.
    """
    n = len(terms.variance)
    once = np.ones((1, n))
    index, deviation = terms.estimates(once), terms.deviations(once)

    def distances(counts: _Array) -> _Array:
        with np.errstate(divide="ignore", invalid="ignore"):
            ratio = np.abs(terms.estimates(counts) - index) / terms.deviations(counts)
        return np.where(np.isfinite(ratio), ratio, 0.0)

    drawn = bootstrap_of_counts(distances, n, design.spec.design).bootstrap_distribution
    half = np.quantile(drawn, design.spec.design.confidence, axis=-1) * deviation[:, 0]
    # an index of which the surrogates know all is exact up to rounding
    half = np.maximum(half, _ROUNDING)
    return np.stack([index[:, 0] - half, index[:, 0] + half], axis=-1)


def _possible(values: _Array, n: int, dummy: Any = None) -> tuple[_Array, _Array | None]:
    """Return fractions of the variance, and their intervals where `n` samples are too few to give any.

    `dummy` indexes those of the dummy factor.
    """
    if n >= LEAST_SAMPLES_OF_INTERVALS:
        return values, None
    low = np.zeros_like(values)
    if dummy is not None:
        low[dummy] = -1.0
    within = np.clip(values, low, 1.0)
    return within, np.stack([low, np.ones_like(low)], axis=-1) + 0 * within[..., None]


def _add_index(
    arrays: _Arrays, name: str, values: _Array, interval: _Array | None = None, by_seed: _Array | None = None
) -> None:
    """Add an index, [metric, model, factor], its interval, and that of each seed with their deviation."""
    arrays[name] = (_DIMS, values)
    if interval is not None:
        arrays[f"{name}_interval"] = ((*_DIMS, "bound"), interval)
    if by_seed is not None:
        arrays[f"{name}_by_seed"] = ((*_DIMS, "seed"), by_seed)
        if by_seed.shape[-1] > 1:
            arrays[f"{name}_seed_deviation"] = (_DIMS, by_seed.std(axis=-1, ddof=1))


# --- Sobol' indices -----------------------------------------------------------------------------------------------


def _surrogates(results: Results) -> dict[tuple[int, int], list[Surrogates | None]]:
    """Return, by metric and model, the surrogates of each block; None where it has too few complete samples."""
    factors, models = results.design.spec.factors, results.design.shape[3]
    if len(results.design.roles) // (len(factors) + 2) < LEAST_SAMPLES:
        basis = None
    else:
        basis = make_basis(factors, results.design.points[:, :-1])

    def of_block(y: _Array) -> Surrogates | None:
        complete = complete_samples(y.reshape(-1, len(factors) + 2))
        return None if basis is None or complete.sum() < LEAST_SAMPLES else fit(basis, y, complete)

    return {
        (i, j): [of_block(y) for y in results.blocks(i, j)] for i, j in np.ndindex(len(results.metrics), models)
    }


def _add_sobol(arrays: _Arrays, results: Results) -> None:
    """Add S1, ST and the interactions, with intervals and by seed."""
    factors, (seeds, views, rows, models) = len(results.design.spec.keys), results.design.shape
    metrics, base = len(results.metrics), rows // (factors + 2)
    values = np.empty((metrics, models, 2 * factors + 2 + factors * (factors - 1) // 2))
    bounds, by_seed = np.empty((*values.shape, 2)), np.empty((*values.shape, seeds))
    used, explained = np.zeros((metrics, models)), np.full((metrics, models), np.nan)

    def estimated(terms: SobolTerms) -> tuple[_Array, _Array | None]:
        n = len(terms.variance)
        return _possible(terms.estimates(np.ones((1, n)))[:, 0], n, [2 * factors, 2 * factors + 1])

    for (i, j), surrogates in _surrogates(results).items():
        blocks = results.blocks(i, j).reshape(-1, base, factors + 2)
        explained[i, j] = explained_variance(blocks, surrogates)
        if np.isnan(explained[i, j]):
            surrogates = [None] * len(surrogates)
        terms = sobol_terms(blocks, surrogates)
        used[i, j] = n = len(terms.variance)
        values[i, j], possible = estimated(terms)
        if possible is not None:
            bounds[i, j] = possible
        elif np.isnan(explained[i, j]):
            bounds[i, j] = _intervals(terms.estimates, n, results.design)
        else:
            bounds[i, j] = _studentised_intervals(terms, results.design)
        for k in range(seeds):
            of_seed = slice(k * views, (k + 1) * views)
            by_seed[i, j, :, k], _ = estimated(sobol_terms(blocks[of_seed], surrogates[of_seed]))
    s1, total, pairs = zip(*(split(v, factors) for v in (values, bounds, by_seed)), strict=True)
    _add_index(arrays, "S1", *s1)
    _add_index(arrays, "ST", *total)
    arrays["interaction"] = ((*_DIMS, "factor_b"), pairs[0])
    arrays["interaction_interval"] = ((*_DIMS, "factor_b", "bound"), pairs[1])
    arrays["samples_used"] = (_DIMS[:2], used)
    arrays["samples_left_out"] = (_DIMS[:2], base - used)
    arrays["explained"] = (_DIMS[:2], explained)


def half_widths(indices: xr.Dataset) -> xr.DataArray:
    """Return half the width of the intervals of the total indices, without the dummy factor's."""
    interval = indices["ST_interval"].drop_sel(factor=DUMMY)
    return (interval.sel(bound="high") - interval.sel(bound="low")) / 2


def needed_samples(n: int, reached: float, asked: float) -> int:
    """Return how many samples, a power of two, should reach a half-width, if `n` samples reached another one.

    Half-widths shrink as 1 / √n, or faster where surrogates get better with more samples.
    """
    needed = n * (reached / asked) ** 2
    return 1 << max(0, int(np.ceil(np.log2(max(needed, 1.0)))))


# --- the other designs --------------------------------------------------------------------------------------------


def _add_moments(arrays: _Arrays, results: Results) -> None:
    """Add mean and variance of each metric and model: of Sobol' designs over A and B."""
    base = [i for i, role in enumerate(results.design.roles) if not role.startswith("AB:")]
    values = results.values[:, :, base]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # a metric that never has a value
        mean = np.nanmean(values, axis=(0, 1, 2))
        variance = np.nanmean(np.nanvar(values, axis=2), axis=(0, 1))
    arrays["mean"] = (("metric", "model"), mean.T)
    arrays["variance"] = (("metric", "model"), variance.T)


@contextlib.contextmanager
def _steady() -> Iterator[None]:
    """Keep numpy's global random numbers and the display of warnings, which SALib changes."""
    state, form = np.random.get_state(), warnings.formatwarning  # noqa: NPY002
    try:
        with warnings.catch_warnings(record=True):  # SALib has its warnings shown, whatever the filters say
            warnings.simplefilter("ignore")
            yield
    finally:
        np.random.set_state(state)  # noqa: NPY002
        warnings.formatwarning = form


def _student(n: int, confidence: float) -> float:
    """Return by what half-widths of a mean grow for `n` samples: SALib takes their bootstrap's as those of many."""
    from scipy import stats

    if n < 2:
        return float("nan")
    q = 0.5 + confidence / 2
    return float(stats.t.ppf(q, n - 1) / stats.norm.ppf(q) * np.sqrt(n / (n - 1)))


def _by_block(
    results: Results, names: Sequence[str], analyse: Callable[[_Array], Mapping[str, Any]]
) -> list[_Array]:
    """Return what SALib gives of each block by name, float64[metric, model, factor, block]; nan for nothing."""
    seeds, views, _, models = results.design.shape
    shape = (len(results.metrics), models, len(results.design.spec.keys) + 1, seeds * views)
    values = {name: np.full(shape, np.nan) for name in names}
    for i, j in np.ndindex(*shape[:2]):
        for k, y in enumerate(results.blocks(i, j)):
            with _steady():
                found = analyse(y)
            for name in values.keys() & found.keys():
                values[name][i, j, :, k] = found[name]
    return list(values.values())


def _mean(values: _Array) -> _Array:
    """Return the mean along the last axis of what has a value; nan for none."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # a metric that never has a value
        return np.asarray(np.nanmean(values, axis=-1))


def _mean_with_interval(values: _Array, half: _Array, seeds: int) -> tuple[_Array, _Array, _Array]:
    """Return the mean of an index over blocks, its interval from half-widths, and the means of each seed."""
    mean, mean_half = _mean(values), _mean(half)
    interval = np.stack([mean - mean_half, mean + mean_half], axis=-1)
    return mean, interval, _mean(values.reshape(*values.shape[:3], seeds, -1))


def _add_morris(arrays: _Arrays, results: Results) -> None:
    """Add the elementary effects of a Morris design, by SALib.

    Over several blocks, `mu` and `mu_star` are means, `sigma` is the root mean square, and the half-width of the
    interval is the mean, because all blocks share the trajectories. Incomplete trajectories are left out.
    """
    analyze = salib("analyze.morris", "design.method = 'morris'").analyze
    design, table = results.design, results.design.spec.design
    problem, steps = unit_problem(design.spec), len(design.spec.keys) + 2

    def analyse(y: _Array) -> Mapping[str, Any]:
        whole = np.isfinite(y.reshape(table.n, steps)).all(axis=1)
        if not whole.any():
            return {}
        rows = np.repeat(whole, steps)
        found = analyze(
            problem,
            design.points[rows],
            y[rows],
            num_resamples=table.resamples,
            conf_level=table.confidence,
            num_levels=table.levels,
            seed=table.seed % 2**32,
        )
        half = np.asarray(found["mu_star_conf"]) * _student(int(whole.sum()), table.confidence)
        return {**found, "mu_star_conf": half}

    mu, star, sigma, half = _by_block(results, ("mu", "mu_star", "sigma", "mu_star_conf"), analyse)
    _add_index(arrays, "mu", _mean(mu))
    _add_index(arrays, "sigma", np.sqrt(_mean(sigma**2)))
    _add_index(arrays, "mu_star", *_mean_with_interval(star, half, design.shape[0]))
    finite = np.isfinite(results.values).reshape(-1, table.n, steps, *results.values.shape[3:])
    used = finite.all(axis=2).any(axis=0).sum(axis=0).T.astype(np.float64)
    arrays["samples_used"] = (_DIMS[:2], used)
    arrays["samples_left_out"] = (_DIMS[:2], table.n - used)


def _add_delta(arrays: _Arrays, results: Results) -> None:
    """Add the moment-independent index delta, a mean over blocks, and the first-order index of given data.

    Delta needs 100 samples; from fewer it is nan. Its bootstrap has at most 20 resamples. Where nearly all values
    are equal, a resample can have a single value, which has no density, and delta is nan, too. Delta is that of the
    values' ranks, since it does not depend on the scale of the values (Borgonovo 2007, section 2).
    """
    from scipy import stats

    of_groups = salib("analyze.delta", "design.method = 'latin_hypercube'").calc_delta
    design, table = results.design, results.design.spec.design
    quantile = stats.norm.ppf(0.5 + table.confidence / 2)

    def analyse(y: _Array) -> Mapping[str, Any]:
        rows = np.isfinite(y)
        n = int(rows.sum())
        if n < LEAST_SAMPLES_OF_DELTA or np.ptp(y[rows]) == 0:
            return {}
        # ranks have the same delta; densities of a few far values lie between the nodes of the grid
        x, ranks = design.points[rows], stats.rankdata(y[rows])
        grid = np.linspace(ranks.min(), ranks.max(), 100)
        ends = np.linspace(0, n, 1 + min(48, math.ceil(n ** (2 / (7 + math.tanh((1500 - n) / 500))))))
        resamples = min(table.resamples, _MOST_RESAMPLES_OF_DELTA)
        drawn = np.random.default_rng(table.seed).integers(n, size=(resamples, n))
        with contextlib.suppress(ValueError):
            once = np.array([of_groups(ranks, grid, column, ends) for column in x.T])
            again = np.array([[of_groups(ranks[k], grid, column[k], ends) for k in drawn] for column in x.T])
            return {"delta": 2 * once - again.mean(axis=1), "half": quantile * again.std(axis=1, ddof=1)}
        return {}

    delta, half = _by_block(results, ("delta", "half"), analyse)
    finite = np.isfinite(results.values).reshape(-1, *results.values.shape[2:])
    used = finite.sum(axis=1).max(axis=0).T.astype(np.float64)
    first, seeds = np.empty(delta.shape[:3]), design.shape[0]
    first_half, by_seed = np.full_like(first, np.nan), np.empty((*first.shape, seeds))
    once = np.ones((1, len(design.points)))
    for i, j in np.ndindex(*first.shape[:2]):
        blocks = results.blocks(i, j)
        statistic = partial(_first_order, design.points, blocks)
        first[i, j] = statistic(once)[:, 0]
        for k, of_seed in enumerate(np.split(blocks, seeds)):
            by_seed[i, j, :, k] = _first_order(design.points, of_seed, once)[:, 0]
        if len(design.points) > 1:
            found = bootstrap_of_counts(statistic, len(design.points), table)
            first_half[i, j] = quantile * found.bootstrap_distribution.std(axis=-1, ddof=1)
    interval = np.stack([first - first_half, first + first_half], axis=-1)
    of_delta, of_first = _mean_with_interval(delta, half, seeds), (first, interval, by_seed)
    for name, (values, interval, by_seed) in (("delta", of_delta), ("S1", of_first)):
        values, possible = _possible(values, int(used.max()), (..., -1))
        _add_index(arrays, name, values, interval if possible is None else possible, by_seed)
    arrays["samples_used"] = (_DIMS[:2], used)
    arrays["samples_left_out"] = (_DIMS[:2], len(design.roles) - used)


def _first_order(points: _Array, blocks: _Array, counts: _Array) -> _Array:
    """Return first-order indices of given data, float64[factor, resample], as an analysis of variance.

    The values of a block are divided by a factor into some √(2n) groups of equal size. The index is one minus the
    variance within groups over the whole one, both without bias (ε² of Kelley 1935, doi 10.1073/pnas.21.9.554), and
    both summed over blocks. Variances between groups alone are too large by (groups - 1) / n.

    Parameters
    ----------
    points
        float64[sample, factor].
    blocks
        float64[block, sample]; nan where a sample has no value.
    counts
        float64[resample, sample], how often each sample counts.
    """
    within, whole = np.zeros((points.shape[1], len(counts))), np.zeros(len(counts))
    for y in blocks:
        rows = np.isfinite(y)
        n = int(rows.sum())
        if n < 2:
            continue
        y, times = y[rows] - y[rows].mean(), counts[:, rows]
        number, squares = times.sum(axis=1), times @ y**2
        groups = min(round(math.sqrt(2 * n)), n // 2)
        first = np.arange(groups) * n // groups
        with np.errstate(divide="ignore", invalid="ignore"):
            whole += (squares - (times @ y) ** 2 / number) / (number - 1)
            for k, order in enumerate(np.argsort(points[rows], axis=0).T):
                size = np.add.reduceat(times[:, order], first, axis=1)
                sums = np.add.reduceat(times[:, order] * y[order], first, axis=1)
                between = np.where(size > 0, sums**2 / size, 0.0).sum(axis=1)
                within[k] += (squares - between) / (number - (size > 0).sum(axis=1))
    return 1 - ratios(within, whole)


def _add_grid(arrays: _Arrays, results: Results) -> None:
    """Add S1 and ST over the points of a grid, exactly, as the analysis of variance of a full factorial design.

    There is nothing to resample, so they have no interval. A metric without a value at a point has no index.
    """
    spec, (_, _, _, models) = results.design.spec, results.design.shape
    axes = [len(axis) for axis in levels(spec)]
    shape = (len(results.metrics), models, len(axes) + 1)
    s1, total = np.full(shape, np.nan), np.full(shape, np.nan)
    for i, j in np.ndindex(*shape[:2]):
        blocks = results.blocks(i, j)
        complete = np.isfinite(blocks).all(axis=1)
        if not complete.any():
            continue
        y = blocks[complete].reshape(-1, *axes)
        variance = y.reshape(len(y), -1).var(axis=1).sum()
        s1[i, j, -1] = total[i, j, -1] = 0.0
        for k in range(len(axes)):
            others = tuple(a + 1 for a in range(len(axes)) if a != k)
            s1[i, j, k] = ratios(y.mean(axis=others).var(axis=1).sum(), variance)
            total[i, j, k] = ratios(y.var(axis=k + 1).mean(axis=tuple(range(1, len(axes)))).sum(), variance)
    _add_index(arrays, "S1", s1)
    _add_index(arrays, "ST", total)


def _add_ranges(arrays: _Arrays, results: Results) -> None:
    """Add the range of each metric over the levels of one factor with the others nominal: the mean over blocks."""
    spec, (_, _, rows, models) = results.design.spec, results.design.shape
    ends = np.cumsum([1, *(len(axis) for axis in levels(spec))])
    values = np.full((len(results.metrics), models, len(ends)), np.nan)
    assert ends[-1] == rows
    for i, j in np.ndindex(*values.shape[:2]):
        y = results.blocks(i, j)
        for k, (first, last) in enumerate(itertools.pairwise(ends)):
            moved = y[:, [0, *range(first, last)]]
            moved = moved[np.isfinite(moved).all(axis=1)]
            values[i, j, k] = np.ptp(moved, axis=1).mean() if len(moved) else np.nan
        values[i, j, -1] = 0.0
    _add_index(arrays, "range", values)


def _add_model_share(arrays: _Arrays, results: Results) -> None:
    """Add the fraction of the variance that is due to the choice of the model, by the law of total variance.

    All models count equally, and a point counts only where every model has a value. A grid has no interval.
    """
    design = results.design
    rows = np.array([not role.startswith("AB:") for role in design.roles])
    per_base = 2 if design.spec.design.method == "sobol" else 1
    share = np.full(len(results.metrics), np.nan)
    interval = np.full((len(share), 2), np.nan)
    for i in range(len(share)):
        y = results.values[:, :, rows, :, i]  # [seed, view, row, model]
        y = y.reshape(-1, int(rows.sum()) // per_base, per_base * y.shape[-1])
        complete = np.asarray(np.isfinite(y).all(axis=-1))
        if not complete.any():
            continue  # a metric that never has a value
        y, complete = y[:, complete.any(axis=0)], complete[:, complete.any(axis=0)]
        y = np.where(complete[..., None], y, 0.0)
        centre = y.sum(axis=(1, 2)) / np.maximum(complete.sum(axis=1), 1) / y.shape[-1]
        y = np.where(complete[..., None], y - centre[:, None, None], 0.0)
        y = y.reshape(*y.shape[:2], per_base, -1)  # [block, base, A or B, model]
        sums, squares = np.moveaxis(y.sum(axis=2), -1, 0), (y**2).sum(axis=(2, 3))
        count = complete.astype(np.float64)

        def of_counts(
            counts: _Array, sums: _Array = sums, squares: _Array = squares, count: _Array = count
        ) -> _Array:
            with np.errstate(divide="ignore", invalid="ignore"):
                weight = 1 / (count @ counts.T)  # [block, resample]
                weight = np.where(np.isfinite(weight), weight, 0.0)
                means = (sums @ counts.T) * weight / per_base  # [model, block, resample]
                mean_squares = (squares @ counts.T) * weight / per_base / len(sums)
            between = means.var(axis=0).sum(axis=0)
            whole = (mean_squares - means.mean(axis=0) ** 2).sum(axis=0)
            return ratios(between, whole)[None]

        n = count.shape[1]
        share[i] = of_counts(np.ones((1, n)))[0, 0]
        if design.spec.design.method != "grid":
            _, possible = _possible(share[i : i + 1], n)
            interval[i] = (_intervals(of_counts, n, design) if possible is None else possible)[0]
    arrays["model_share"] = (("metric",), share)
    if design.spec.design.method != "grid":
        arrays["model_share_interval"] = (("metric", "bound"), interval)
