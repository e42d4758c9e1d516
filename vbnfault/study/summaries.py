"""Summarise the table of a study for figures and pages: points, conditional medians, swings, extreme rows.

All functions read only the results that a study leaves: the indices (an xarray dataset), the table of evaluations
(a pyarrow table) and the resolved study file.

An evaluation belongs to a *point* of the design (one value of each factor) and to a *block* (one seed and one
view). Blocks differ by far more than points do, so each block is shifted to the mean of all blocks before the
values of a point are averaged over its blocks. The shifts cancel where every point has a value in every block.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import pyarrow as pa
import xarray as xr
from numpy.typing import NDArray

from .designs import plain_value

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

DUMMY = "dummy"
_RESAMPLES = 200  # of medians: their intervals are drawn, not tabulated
_MOST_LEVELS = 12  # a factor with more different values is divided into bins
_LEAST_IN_BIN = 8
_MOST_BINS = 12
_PARTS = 5  # the factor's range is divided into fifths for its swing
_LEAST_OF_SWING, _LEAST_OF_BAND = 2 * _PARTS, 2 * _LEAST_IN_BIN  # points, for noise floors


@dataclass(frozen=True, kw_only=True, eq=False)
class ResponseCurve:
    """Hold the conditional median of a metric against one factor.

    Attributes
    ----------
    x
        Values of the factor, numbers or categories.
    median, low, high
        Median of the metric and its bootstrap interval at each x; low and high are nan where there is one value.
    """

    x: tuple[float, ...] | tuple[str, ...]
    median: F64
    low: F64
    high: F64


@dataclass(frozen=True, kw_only=True)
class Swing:
    """Hold the least and greatest conditional mean of a metric along one factor, and those at the factor's ends."""

    least: float
    most: float
    at_low_end: float
    at_high_end: float

    @property
    def size(self) -> float:
        """Return the difference between the greatest and the least conditional mean."""
        return self.most - self.least


@dataclass(frozen=True, kw_only=True, eq=False)
class DesignPoints:
    """Hold the values of one metric with one model at the points of the design.

    Attributes
    ----------
    columns
        Factor → its value at each point.
    values
        Mean over the blocks at each point, [point].
    by_block
        Values with each block shifted to the common mean, [point, block]; nan where there is none.
    cluster
        Number of the trajectory of each point of a Morris design, which depend on each other; of the other designs
        the number of the point itself.
    base
        Factor → value of the base of a one-at-a-time design; None for the other designs.
    """

    columns: Mapping[str, NDArray[Any]]
    values: F64
    by_block: F64
    cluster: I64
    base: Mapping[str, Any] | None

    def curve(self, factor: str, confidence: float) -> ResponseCurve:
        """Return the conditional median of the metric against a factor, with bootstrap intervals."""
        generator = np.random.default_rng(0)
        x, rows = [], []
        for value, members in self._groups(factor):
            x.append(value)
            sample = self._sample(members)
            cluster = self.cluster[members] if len(members) > 1 else np.arange(len(sample))
            rows.append((np.median(sample), *_median_interval(sample, cluster, confidence, generator)))
        median, low, high = np.asarray(rows, dtype=float).reshape(-1, 3).T
        return ResponseCurve(x=tuple(x), median=median, low=low, high=high)

    def swing(self, factor: str) -> Swing:
        """Return how far the conditional mean of the metric moves along a factor.

        A factor with few values is taken at each of them; otherwise its values are divided into fifths.
        """
        means = [float(self._sample(members).mean()) for _, members in self._groups(factor, parts=_PARTS)]
        if not means:
            return Swing(least=np.nan, most=np.nan, at_low_end=np.nan, at_high_end=np.nan)
        return Swing(least=min(means), most=max(means), at_low_end=means[0], at_high_end=means[-1])

    def centre(self) -> float:
        """Return the mean of the metric, or its value at the base of a one-at-a-time design; nan without values."""
        if not self.values.size:
            return float("nan")
        at_base = self._at_base(self.columns) if self.base is not None else np.zeros(0, dtype=bool)
        return float(self.values[at_base].mean() if at_base.any() else self.values.mean())

    def chance_swing(self) -> float:
        """Return the median swing of factors that act on nothing: of the values in random order.

        A one-at-a-time design has no such noise, and a few points show none: 0.
        """
        if self.base is not None or len(self.values) < _LEAST_OF_SWING:
            return 0.0
        means = ([group.mean() for group in groups] for groups in self._by_chance(1, _PARTS))
        return float(np.median([max(each) - min(each) for each in means]))

    def chance_band(self, confidence: float) -> tuple[float, float] | None:
        """Return the interval of medians along a factor that acts on nothing; None where there is no noise."""
        if self.base is not None or len(self.values) < _LEAST_OF_BAND:
            return None
        medians = [np.median(group) for groups in self._by_chance(2) for group in groups]
        low, high = np.quantile(medians, _tails(confidence))
        return float(low), float(high)

    def _by_chance(self, seed: int, parts: int | None = None) -> Iterator[list[F64]]:
        """Yield the values in groups of similar value of a factor, each time in another random order."""
        generator = np.random.default_rng(seed)
        for factor in self.columns:
            groups = [members for _, members in self._groups(factor, parts=parts)]
            for _ in range(max(1, _RESAMPLES // len(self.columns))):
                values = self._shuffled(generator)
                yield [values[members] for members in groups]

    def _shuffled(self, generator: np.random.Generator) -> F64:
        """Return the values in random order; trajectories stay whole, and each begins at a random step."""
        if self.cluster[-1] == len(self.cluster) - 1:  # every point is a cluster of its own
            return generator.permutation(self.values)
        first = np.flatnonzero(np.diff(self.cluster, prepend=-1))
        parts = np.split(self.values, first[1:])
        order = generator.permutation(len(parts))
        return np.concatenate([np.roll(parts[k], generator.integers(len(parts[k]))) for k in order])

    def _sample(self, members: I64) -> F64:
        """Return the values at some points; at a single point its values in all blocks."""
        if len(members) > 1:
            return self.values[members]
        row = self.by_block[members].ravel()
        return row[np.isfinite(row)]

    def _groups(self, factor: str, parts: int | None = None) -> list[tuple[Any, I64]]:
        """Return points of similar value of a factor: (its value, their numbers), in order of the value."""
        column = self.columns[factor]
        chosen = np.arange(len(column))
        if self.base is not None:
            chosen = chosen[self._at_base(name for name in self.columns if name != factor)]
        if not len(chosen):
            return []
        column = column[chosen]
        levels, level = np.unique(column, return_inverse=True)
        if len(levels) <= _MOST_LEVELS or column.dtype.kind in "OU":
            return [(plain_value(value), chosen[level == k]) for k, value in enumerate(levels)]
        order = np.argsort(column, kind="stable")
        split = np.array_split(order, parts or _bins(len(order)))
        return [(float(np.median(column[part])), chosen[part]) for part in split]

    def _at_base(self, factors: Iterable[str]) -> NDArray[np.bool_]:
        """Return which points have the base's values of the named factors."""
        assert self.base is not None
        at_base = np.ones(len(self.values), dtype=bool)
        for name in factors:
            at_base &= self.columns[name] == self.base[name]
        return at_base


@dataclass(frozen=True, kw_only=True)
class Extremes:
    """Hold the numbers of the table's rows with the best and the worst value of a metric, and these values."""

    best_row: int
    worst_row: int
    best: float
    worst: float


@dataclass(frozen=True, kw_only=True, eq=False)
class StudyResults:
    """Hold what a study leaves, and answer what figures and pages ask of it.

    Attributes
    ----------
    dataset
        Indices, as in `indices.zarr`.
    table
        Evaluations, as in `table.parquet`.
    spec
        The resolved study as plain data, as in `study.toml`.
    """

    dataset: xr.Dataset
    table: pa.Table
    spec: Mapping[str, Any]

    @cached_property
    def metrics(self) -> tuple[str, ...]:
        """Return the names of the metrics."""
        return tuple(str(name) for name in self.dataset["metric"].values)

    @cached_property
    def models(self) -> tuple[str, ...]:
        """Return the names of the models; one empty name where none are compared."""
        return tuple(str(name) for name in self.dataset["model"].values)

    @cached_property
    def factors(self) -> tuple[str, ...]:
        """Return the keys of the factors, without the dummy."""
        return tuple(str(name) for name in self.dataset["factor"].values if name != DUMMY)

    @property
    def method(self) -> str:
        """Return the method of the design."""
        return str(self.spec["design"]["method"])

    @property
    def has_noise_floor(self) -> bool:
        """Return whether the indices of the dummy factor show noise; in some designs they are exactly 0."""
        return self.method not in ("morris", "grid", "one_at_a_time")

    @property
    def confidence(self) -> float:
        """Return the confidence of the intervals."""
        return float(self.spec["design"].get("confidence", 0.95))

    def about(self, metric: str, what: str) -> str:
        """Return `unit`, `description`, `source` or `better` of a metric; an empty text where it has none."""
        if what not in self.dataset.coords:
            return ""
        return str(self.dataset[what].sel(metric=metric).item())

    def factor(self, key: str) -> Mapping[str, Any]:
        """Return the table `[[factor]]` of the study file that defines a factor."""
        return next((entry for entry in self.spec.get("factor", ()) if entry["key"] == key), {"key": key})

    def index(self, name: str, metric: str, model: str) -> xr.DataArray | None:
        """Return a variable of the indices for one metric and model; None where the design does not give it."""
        if name not in self.dataset:
            return None
        return self.dataset[name].sel(metric=metric, model=model)

    def with_interval(self, name: str, metric: str, model: str, factors: Sequence[str]) -> F64:
        """Return value, low and high of an index of factors, [3, factor]; nan where the design gives none."""
        index, bounds = self.index(name, metric, model), self.index(f"{name}_interval", metric, model)
        values = np.full((3, len(factors)), np.nan)
        if index is not None:
            values[0] = index.reindex(factor=factors).values
        if bounds is not None:
            values[1:] = (
                bounds.reindex(factor=factors).sel(bound=["low", "high"]).transpose("bound", "factor").values
            )
        return values

    def has(self, name: str) -> bool:
        """Return whether a variable is among the indices, with at least one value."""
        return name in self.dataset and bool(np.isfinite(self.dataset[name].values).any())

    def column(self, name: str) -> NDArray[Any]:
        """Return a column of the table."""
        return np.asarray(self.table.column(name).to_numpy(zero_copy_only=False))

    @cached_property
    def succeeded(self) -> NDArray[np.bool_]:
        """Return which rows of the table are of evaluations that did not fail."""
        return np.asarray(self.column("status") == "ok")

    @cached_property
    def blocks(self) -> I64:
        """Return the number of the block, a seed and a view, of each row."""
        return _numbered([self.column("seed"), self.column("view")])

    def shows_chance(self, kind: str) -> bool:
        """Return whether tornado or responses have enough points for the noise floor of chance."""
        least = {"tornado": _LEAST_OF_SWING, "responses": _LEAST_OF_BAND}[kind]
        sizes = (len(self.points(metric, model).values) for metric in self.metrics for model in self.models)
        return self.method != "one_at_a_time" and max(sizes) >= least

    @cached_property
    def _points(self) -> I64:
        """Return the number of the design's point of each row."""
        return _numbered([self.column(factor) for factor in self.factors])

    @cached_property
    def _trajectories(self) -> I64:
        """Return the number of the trajectory of each row of a Morris design."""
        return np.asarray([int(str(role).split(":")[1]) for role in self.column("role")], dtype=np.int64)

    @cached_property
    def _base(self) -> Mapping[str, Any] | None:
        """Return the most frequent value of each factor, in a one-at-a-time design its base."""
        if self.method != "one_at_a_time":
            return None
        base = {}
        for factor in self.factors:
            values, counts = np.unique(self.column(factor), return_counts=True)
            # the middle level where no value is more frequent, as with a single factor
            frequent = values[counts == counts.max()]
            base[factor] = frequent[len(frequent) // 2]
        return base

    def points(self, metric: str, model: str) -> DesignPoints:
        """Return the values of a metric with one model at the points of the design.

        Of a Sobol' design only the matrices A and B are used: points of AB share all values but one with A.
        """
        values = np.asarray(self.column(metric), dtype=float)
        rows = self.succeeded & (self.column("model") == model) & np.isfinite(values)
        if self.method == "sobol":
            rows &= np.isin(self.column("role"), ["A", "B"])
        numbers, first, point = np.unique(self._points[rows], return_index=True, return_inverse=True)
        blocks, block = np.unique(self.blocks[rows], return_inverse=True)
        by_block = np.full((len(numbers), len(blocks)), np.nan)
        by_block[point, block] = values[rows]
        columns = {factor: self.column(factor)[rows][first] for factor in self.factors}
        cluster = np.arange(len(numbers))
        if self.method == "morris":
            cluster = self._trajectories[rows][first]
            order = np.argsort(cluster, kind="stable")
            cluster, by_block = cluster[order], by_block[order]
            columns = {factor: column[order] for factor, column in columns.items()}
        if numbers.size:
            level = np.nanmean(by_block, axis=0)
            by_block += level.mean() - level
        mean = np.nanmean(by_block, axis=1) if numbers.size else np.zeros(0)
        return DesignPoints(columns=columns, values=mean, by_block=by_block, cluster=cluster, base=self._base)

    @cached_property
    def importance(self) -> tuple[str, xr.DataArray]:
        """Return by which index factors are ordered, in words, and its values (metric, model, factor).

        It is the total index where the design gives it, otherwise delta or the first-order index. Mean absolute
        elementary effects and swings have units, so they are divided by the largest of their metric and model.
        """
        for name, words in (("ST", "total index"), ("delta", "delta"), ("S1", "first-order index")):
            if self.has(name):
                return words, self.dataset[name]
        if self.has("mu_star"):
            values, words = self.dataset["mu_star"], "mean absolute elementary effect"
        elif self.has("range"):
            values, words = self.dataset["range"], "range"
        else:
            values, words = self._swings(), "swing"
        largest = values.max("factor")
        return f"{words} / largest of the metric", values / largest.where(largest > 0)

    def _swings(self) -> xr.DataArray:
        """Return the size of each factor's swing (metric, model, factor), the dummy's last."""
        sizes = np.full((len(self.metrics), len(self.models), len(self.factors) + 1), np.nan)
        for i, metric in enumerate(self.metrics):
            for j, model in enumerate(self.models):
                points = self.points(metric, model)
                sizes[i, j] = [*(points.swing(factor).size for factor in self.factors), points.chance_swing()]
        return xr.DataArray(
            sizes,
            dims=("metric", "model", "factor"),
            coords={"metric": list(self.metrics), "model": list(self.models), "factor": [*self.factors, DUMMY]},
        )

    def ranked(self, metric: str) -> tuple[str, ...]:
        """Return the factors, without the dummy, the most important of a metric first."""
        values = self.importance[1].sel(metric=metric)
        largest = {f: np.nan_to_num(values.sel(factor=f).values, nan=-np.inf).max() for f in self.factors}
        return tuple(sorted(self.factors, key=lambda factor: -largest[factor]))

    def extremes(self, metric: str) -> Extremes | None:
        """Return the rows with the best and the worst value of a metric; None where all are equal or missing."""
        values = np.where(self.succeeded, np.asarray(self.column(metric), dtype=float), np.nan)
        finite = np.flatnonzero(np.isfinite(values))
        if not finite.size or np.ptp(values[finite]) == 0:
            return None
        least, most = finite[values[finite].argmin()], finite[values[finite].argmax()]
        best, worst = (most, least) if self.about(metric, "better") == "high" else (least, most)
        return Extremes(
            best_row=int(best), worst_row=int(worst), best=float(values[best]), worst=float(values[worst])
        )


def _numbered(columns: list[NDArray[Any]]) -> I64:
    """Return a number for each row, equal where all columns are equal."""
    codes = [np.unique(column, return_inverse=True)[1] for column in columns]
    return np.asarray(np.unique(np.stack(codes, axis=1), axis=0, return_inverse=True)[1], dtype=np.int64)


def _bins(count: int) -> int:
    """Return into how many bins so many points are divided."""
    return max(1, min(_MOST_BINS, count // _LEAST_IN_BIN, round(math.sqrt(count) / 2) + 1))


def _tails(confidence: float) -> list[float]:
    """Return the two quantiles that bound a central interval."""
    return [(1 - confidence) / 2, (1 + confidence) / 2]


def _median_interval(
    sample: F64, cluster: I64, confidence: float, generator: np.random.Generator
) -> tuple[float, float]:
    """Return the bootstrap interval of the median over whole clusters; nan for a single cluster."""
    number = np.unique(cluster, return_inverse=True)[1]
    clusters = int(number.max(initial=-1)) + 1
    if clusters < 2:
        return np.nan, np.nan
    times = generator.multinomial(clusters, np.full(clusters, 1 / clusters), size=_RESAMPLES)
    order = np.argsort(sample)
    reached = np.cumsum(times[:, number[order]], axis=1)  # how many drawn values are not above each value
    middle = (reached >= reached[:, -1:] / 2).argmax(axis=1)
    low, high = np.quantile(sample[order][middle], _tails(confidence))
    return float(low), float(high)
