"""Draw the figures of a study: indices, heat maps, models, the Morris plane, seeds.

Each function takes `summaries.StudyResults` and returns a matplotlib figure of its own. `drawings` gives all
figures of a study one after the other, with those of `response_plots`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator
from numpy.typing import NDArray

from ..core.figures import (
    BAND,
    BLUE,
    GREEN,
    INK,
    MUTED,
    SERIES_COLOURS,
    SERIES_MARKERS,
    SKY,
    SMALL,
    VERMILLION,
    axis_exponent,
    draw_cells,
    label_rows,
    panels,
    row_height,
    set_linear,
    with_unit,
    wrapped,
    write_message,
)
from ..core.html_page import number_text, with_minus
from ..faults import registry
from .ranking import QUANTILES
from .response_plots import NOISE, responses, rows_of_factors, tornado
from .summaries import DUMMY, StudyResults

F64 = NDArray[np.float64]

_MOST_PAIRS = 12  # factors of a matrix of pairs
_LEAST_SCALE = 84.0  # height in points of a panel beside a colour scale
_RANKING_COLUMNS = 3
_RANKING_WIDTH, _RANKING_ROW = 128.0, 13.0  # of a panel and of its rows, points
_LOG_RATIO = 30.0  # of the largest to the median cost, above which an axis is logarithmic beyond its linear part
_BELOW = 0.02  # of the largest cost: a cost further below 0 needs a linear axis
_LOW, _MEDIAN, _HIGH = range(len(QUANTILES))


@dataclass(frozen=True, kw_only=True, eq=False)
class Drawing:
    """Hold one figure and what is said about it.

    Attributes
    ----------
    kind
        Section of the page: `ranking`, `overview`, `indices`, `morris`, `seeds`, `tornado`, `responses`,
        `interactions` or `models`.
    metric
        Metric that the figure is about; empty where it is about all.
    figure
        The figure.
    note
        What the figure leaves out; empty where it shows everything.
    """

    kind: str
    metric: str = ""
    figure: Figure
    note: str = ""

    @property
    def stem(self) -> str:
        """Return the name of the figure's files, without their ending."""
        return f"{self.kind}_{self.metric}" if self.metric else self.kind


def drawings(results: StudyResults) -> Iterator[Drawing]:
    """Yield every figure that the results give, section by section."""
    if results.has("fault_quantile"):
        yield Drawing(kind="ranking", figure=ranking(results))
        if len(results.factors) == 1:
            return  # nothing else varies
    several = len(results.factors) > 1
    if several and len(results.metrics) > 1:
        yield Drawing(kind="overview", figure=overview(results))
    for kind, draw in _BY_METRIC.items():
        for metric in results.metrics:
            drawn = draw(results, metric)
            if drawn is not None:
                yield Drawing(kind=kind, metric=metric, figure=drawn[0], note=drawn[1])
    if several and results.has("ST") and results.has("S1") and not results.has("interaction"):
        yield Drawing(kind="interactions", figure=interactions_of_each(results))
    if len(results.models) > 1:
        yield Drawing(kind="models", figure=models(results))


# ------------------------------------------------------------------------------------ indices


@dataclass(frozen=True)
class _Series:
    """Describe an index that is drawn as dots with intervals."""

    name: str
    label: str
    colour: str
    is_fraction: bool = True
    filled: bool = True

    @property
    def style(self) -> dict[str, Any]:
        """Return how its dots are drawn."""
        face = self.colour if self.filled else "white"
        return {"marker": "o", "ms": 4.2, "mfc": face, "mec": self.colour, "mew": 1.1, "color": self.colour}


_SERIES = (
    _Series("ST", "total index", BLUE),
    _Series("delta", "delta", GREEN),
    _Series("S1", "first-order index", VERMILLION, filled=False),
    _Series("mu_star", "mean absolute elementary effect μ*", BLUE, is_fraction=False),
)


def indices(results: StudyResults, metric: str) -> tuple[Figure, str] | None:
    """Draw the indices of one metric with their intervals, sorted, beside the noise floor.

    Sobol' indices are the total and the first-order index; a Latin hypercube gives delta, a Morris design the mean
    absolute elementary effect μ*.
    """
    drawn = [series for series in _SERIES if results.has(series.name)]
    drawn = [series for series in drawn if series.is_fraction] or drawn
    if not drawn:
        return None
    shares, order = drawn[0].is_fraction, [*results.ranked(metric), DUMMY]
    values = np.asarray([[results.with_interval(s.name, metric, m, order) for s in drawn] for m in results.models])
    exponent = 0 if shares else axis_exponent(values)
    values /= 10.0**exponent
    low, high = _index_limits(values[:, :, 0], values, shares)
    label = "index (no unit)" if results.has("delta") else "fraction of the variance"
    if not shares:
        label = with_unit("μ*", results.about(metric, "unit"), exponent)
    handles: list[Any] = [Line2D([], [], lw=1.5, label=s.label, **s.style) for s in drawn]
    legend = [*handles, NOISE] if results.has_noise_floor else handles
    with rows_of_factors(results, metric, order, legend, separate_last=True) as (figure, axes):
        for one, model, of_model in zip(axes, results.models, values, strict=True):
            one.set_xlim(low, high)
            one.set_xlabel(label)
            set_linear(one.xaxis, 5 if len(axes) == 1 else 4)
            one.axvline(0, color=MUTED, lw=0.7)
            if not np.isfinite(of_model[:, 0]).any():
                variance = float(results.dataset["variance"].sel(metric=metric, model=model))
                write_message(one, "no variance" if variance == 0 else "no values")
                continue
            _draw_floor(one, *of_model[0, :, -1])
            for series, offset, (value, least, most) in zip(
                drawn, (-0.17, 0.17) if len(drawn) == 2 else (0.0,), of_model, strict=True
            ):
                y = np.arange(len(order)) + offset
                one.hlines(y, least, most, color=series.colour, lw=1.5, zorder=3)
                one.plot(value, y, ls="none", zorder=4, **series.style)
    cut = np.nanmax(values, initial=0) > high or np.nanmin(values, initial=0) < low
    return figure, "Intervals that reach the edge of a panel go on beyond it." if cut else ""


def _index_limits(dots: F64, every: F64, shares: bool) -> tuple[float, float]:
    """Return the limits of the axis of indices: all dots are within, but long intervals of fractions are cut."""
    dots, every = dots[np.isfinite(dots)], every[np.isfinite(every)]
    low, high = float(every.min(initial=0.0)), float(every.max(initial=0.0))
    if not shares:
        extent = high - low or 1.0
        return low - 0.04 * extent, high + 0.04 * extent
    least, most = float(dots.min(initial=0.0)), float(dots.max(initial=0.0))
    return max(low - 0.03, min(least - 0.03, -0.3)), min(max(high, 1) + 0.03, max(most + 0.03, 1.3))


def _draw_floor(axes: Axes, _value: float, low: float, high: float) -> None:
    """Draw the noise floor as a band; as a line where its width is below a pixel, and not at all where it is 0."""
    left, right = axes.get_xlim()
    if high - low > 0.004 * (right - left):
        axes.axvspan(low, high, color=BAND, alpha=0.75, lw=0, zorder=1)
    elif high > low:
        axes.axvline((low + high) / 2, color=BAND, lw=3, zorder=1)


def seeds(results: StudyResults, metric: str) -> tuple[Figure, str] | None:
    """Draw the index of each seed beside the interval of all seeds."""
    series = next((s for s in _SERIES if results.has(f"{s.name}_by_seed")), None)
    if series is None or results.dataset.sizes.get("seed", 1) < 2:
        return None
    order = [*results.ranked(metric), DUMMY]
    every = results.dataset[f"{series.name}_by_seed"].sel(metric=metric, factor=order)
    pooled = np.stack([results.with_interval(series.name, metric, model, order) for model in results.models])
    exponent = 0 if series.is_fraction else axis_exponent(every.values)
    unit = 10.0**exponent
    numbers = [str(seed) for seed in results.dataset["seed"].values]
    marks: list[Any] = [
        {"color": SERIES_COLOURS[k % 6], "marker": SERIES_MARKERS[k % 6], "ls": "none"} for k in range(len(numbers))
    ]
    handles: list[Any] = [Patch(facecolor=SKY, alpha=0.6, lw=0, label=f"interval of the {series.label}, all seeds")]
    if len(numbers) <= 6:
        handles += [Line2D([], [], ms=4, label=f"seed {n}", **m) for m, n in zip(marks, numbers, strict=True)]
    label = series.label if series.is_fraction else with_unit("μ*", results.about(metric, "unit"), exponent)
    with rows_of_factors(results, metric, order, handles, separate_last=True) as (figure, axes):
        y = np.arange(len(order))
        for one, model, (_, low, high) in zip(axes, results.models, pooled / unit, strict=True):
            one.set_xlim(*_index_limits(every.values / unit, pooled / unit, series.is_fraction))
            one.set_xlabel(label)
            set_linear(one.xaxis)
            one.hlines(y, low, high, color=SKY, alpha=0.6, lw=6, zorder=2)
            values = every.sel(model=model).transpose("seed", "factor").values / unit
            if not np.isfinite(values).any():
                write_message(one, "no values")
            for shift, of_seed, mark in zip(np.linspace(-0.25, 0.25, len(marks)), values, marks, strict=True):
                one.plot(of_seed, y + shift, ms=3.2, mew=0, zorder=4, **mark)
    return figure, ""


# ------------------------------------------------------------------------------------ heat maps


def overview(results: StudyResults) -> Figure:
    """Draw the importance of each factor for each metric, one panel per model."""
    words, values = results.importance
    every = values.sel(factor=[*results.factors, DUMMY]).transpose("metric", "model", "factor").values
    return _of_each(results, every, "Every factor and every metric", words)


def interactions_of_each(results: StudyResults) -> Figure:
    """Draw total minus first-order index: the fraction of the variance that interactions with each factor cause."""
    both = results.dataset[["ST", "S1"]].sel(factor=list(results.factors))
    values = (both["ST"] - both["S1"]).transpose("metric", "model", "factor").values
    return _of_each(results, values, "Interactions of each factor", "total index − first-order index")


def _of_each(results: StudyResults, values: F64, title: str, label: str) -> Figure:
    """Draw a matrix of factors and metrics, one panel per model; `values` is [metric, model, factor]."""
    summed = np.nan_to_num(values).max(axis=1).sum(axis=0)
    order = sorted(range(len(results.factors)), key=lambda k: -summed[k])
    order += range(len(results.factors), values.shape[2])
    names = [*results.factors, DUMMY]
    matrices = values.transpose(1, 2, 0)[:, order]
    columns = [wrapped(metric, 26, 1) for metric in results.metrics]
    return _heat(results, title, matrices, ([names[k] for k in order], columns), label, rotation=45)


def interactions(results: StudyResults, metric: str) -> tuple[Figure, str] | None:
    """Draw the total interaction index of each pair of factors, with the first-order indices on the diagonal."""
    if not results.has("interaction"):
        return None
    order = list(results.ranked(metric)[:_MOST_PAIRS])
    matrices = []
    for model in results.models:
        both = results.dataset["interaction"].sel(metric=metric, model=model, factor=order, factor_b=order)
        pairs = both.transpose("factor", "factor_b").values
        pairs = np.where(np.isfinite(pairs), pairs, pairs.T)  # one triangle may be empty
        first = results.index("S1", metric, model)
        diagonal = np.full(len(order), np.nan) if first is None else first.sel(factor=order).values
        matrices.append(np.where(np.eye(len(order)) > 0, diagonal, pairs))
    columns = [wrapped(factor, 24, 2) for factor in order]
    figure = _heat(results, metric, np.stack(matrices), (order, columns), "fraction of the variance", rotation=90)
    words = f"Drawn are the {len(order)} factors with the highest {results.importance[0]}."
    return figure, words if len(results.factors) > len(order) else ""


def _heat(
    results: StudyResults,
    title: str,
    matrices: F64,
    names: tuple[Sequence[str], Sequence[str]],
    label: str,
    *,
    rotation: float,
) -> Figure:
    """Draw matrices [model, row, column] with a colour scale; pairs (upright names) in the lower triangle only."""
    labels, columns = [wrapped(name, 24 if rotation == 90 else 32) for name in names[0]], names[1]
    row = max(row_height(labels), 21.0, _LEAST_SCALE / len(labels))
    top = min(1.0, float(np.nan_to_num(matrices).max(initial=0.0))) or 1.0
    hidden = np.tri(*matrices.shape[1:]) == 0 if rotation == 90 else np.zeros(matrices.shape[1:], bool)
    with panels(
        title, (1, len(matrices)), (22.0 * len(columns), row * len(labels)), heads=results.models, sharey=True
    ) as (figure, axes):
        for one, matrix in zip(axes, matrices, strict=True):
            texts = [[_cell_text(v, h) for v, h in zip(*r, strict=True)] for r in zip(matrix, hidden, strict=True)]
            mesh = draw_cells(one, np.where(hidden, np.nan, matrix), top, texts, labels)
            slanted: Any = {"ha": "right", "rotation_mode": "anchor"} if rotation == 45 else {}
            one.set_xticks(np.arange(len(columns)) + 0.5, columns, rotation=rotation, **slanted)
        bar = figure.colorbar(
            mesh, ax=axes, fraction=0.05, pad=0.02, aspect=max(8, 1.4 * len(labels)), anchor=(0.0, 1.0)
        )
        bar.outline.set_visible(False)
        bar.ax.tick_params(length=2)
        set_linear(bar.ax.yaxis, 4)
        bar.ax.set_ylabel(wrapped(label, max(12, int(min(row * len(labels), 150.0) / 5))), linespacing=1.0)
    return figure


def _cell_text(value: float, hidden: bool) -> str:
    """Return the text of a cell: a fraction without its 0, nothing for a small one, – where there is none."""
    if hidden or value < 0.005:
        return ""
    if not np.isfinite(value):
        return "–"
    return f"{value:.2f}".removeprefix("0") if value < 0.995 else f"{value:.1f}"


# ------------------------------------------------------------------------------------ models and Morris


def models(results: StudyResults) -> Figure:
    """Draw variance by model beside the variance between models, and the mean of each model.

    The bars are the terms of the law of total variance as fractions of the total: the variance of the models'
    means, and the mean of the models' variances, divided among the models.
    """
    labels = [wrapped(metric) for metric in results.metrics]
    handles: list[Any] = [Patch(facecolor=INK, lw=0, label="between models (model form)")]
    if "model_share_interval" in results.dataset:
        text = f"its {100 * results.confidence:g} % interval"
        handles.append(Line2D([], [], color=VERMILLION, lw=1.6, label=text))
    handles += [
        Patch(facecolor=SERIES_COLOURS[k % 6], lw=0, label=f"within {model}")
        for k, model in enumerate(results.models)
    ]
    with panels(
        "Model form beside parametric variance",
        (1, 2),
        (230.0, row_height(labels) * max(len(labels), 2)),
        legend=handles,
        heads=("variance", "mean"),
    ) as (figure, (shares, means)):
        label_rows((shares, means), labels)
        for y, metric in enumerate(results.metrics):
            _draw_total_variance(shares, results, metric, y)
            values = results.dataset["mean"].sel(metric=metric).values.astype(float)
            middle = np.nanmean(values) if np.isfinite(values).any() else 0.0
            if not middle:
                continue
            for k, (value, shift) in enumerate(zip(values, np.linspace(-0.18, 0.18, len(values)), strict=True)):
                style: Any = {"color": SERIES_COLOURS[k % 6], "marker": SERIES_MARKERS[k % 6]}
                means.plot(value / middle, y + shift, ms=4.5, mew=0, ls="none", zorder=3, **style)
        shares.set(xlim=(0, 1), xlabel="fraction of the total variance")
        means.axvline(1, color=MUTED, lw=0.8)
        means.set_xlabel("mean of a model / mean of all models")
        means.margins(x=0.08)
        for one in (shares, means):
            set_linear(one.xaxis, 5)
    return figure


def _draw_total_variance(axes: Axes, results: StudyResults, metric: str, y: int) -> None:
    """Draw one bar: the fraction between models, with its interval, then the fraction within each model."""
    share = float(results.dataset["model_share"].sel(metric=metric)) if "model_share" in results.dataset else np.nan
    within = results.dataset["variance"].sel(metric=metric).values.astype(float)
    if not np.isfinite(share):
        axes.text(0.5, y, "no values", ha="center", va="center", color=MUTED, style="italic")
        return
    total = np.nansum(within) or 1.0
    parts = np.asarray([share, *((1 - share) * np.nan_to_num(within) / total)])
    axes.barh(
        y, parts, left=np.cumsum(parts) - parts, height=0.62, color=[INK, *SERIES_COLOURS][: len(parts)], zorder=3
    )
    if "model_share_interval" in results.dataset:
        interval = results.dataset["model_share_interval"].sel(metric=metric, bound=["low", "high"]).values
        for colour, width in (("white", 3.4), (VERMILLION, 1.6)):
            axes.plot(interval, [y, y], color=colour, lw=width, zorder=4, solid_capstyle="round")


def morris(results: StudyResults, metric: str) -> tuple[Figure, str] | None:
    """Draw the plane of μ* and σ of the elementary effects, each factor a number that the list names."""
    if not results.has("mu_star"):
        return None
    order, unit = list(results.ranked(metric)), results.about(metric, "unit")
    chosen = results.dataset[["mu_star", "sigma"]].sel(metric=metric, factor=order)
    values = np.stack([chosen[n].transpose("model", "factor").values for n in ("mu_star", "sigma")], axis=1)
    exponent = axis_exponent(values)
    values = values.astype(float) / 10.0**exponent  # [model, μ* or σ, factor]
    top = 1.08 * float(np.nan_to_num(values).max(initial=0.0)) or 1.0
    size = max(190.0, 11.5 * len(order)) if len(results.models) == 1 else 190.0
    handles = [
        Line2D([], [], color=BLUE, marker="o", ms=4, ls="none", label="factor"),
        Line2D([], [], color=MUTED, lw=0.8, ls=":", label="σ = 0.1, 0.5 and 1 times μ*"),
    ]
    crowded = False
    with panels(
        metric, (1, len(results.models)), (size, size), legend=handles, heads=results.models, sharey=True
    ) as (figure, axes):
        for one, of_model in zip(axes, values, strict=True):
            one.set(xlim=(-0.03 * top, top), ylim=(-0.03 * top, top), xlabel=with_unit("μ*", unit, exponent))
            set_linear(one.xaxis)
            set_linear(one.yaxis)
            for slope in (0.1, 0.5, 1.0):
                one.plot([0, top], [0, slope * top], color=MUTED, lw=0.8, ls=":", zorder=2)
            if not np.isfinite(of_model[0]).any():
                write_message(one, "no values")
                continue
            one.plot(*of_model, "o", ms=4, color=BLUE, mew=0, zorder=4)
            crowded |= _number_points(one, of_model.T, size / top)
        axes[0].set_ylabel(with_unit("σ", unit, exponent))
        names = [f"{k + 1}  {wrapped(factor, 34, 1)}" for k, factor in enumerate(order)]
        listed = [Line2D([], [], ls="none", label=name) for name in names]
        figure.legend(handles=listed, loc="outside right upper", fontsize=SMALL, handlelength=0, labelspacing=0.3)
    return figure, "Factors too close to others for a number beside them carry none." if crowded else ""


def _number_points(axes: Axes, points: F64, scale: float) -> bool:
    """Write the number of each point beside it, the first ones first; return whether some found no room.

    `scale`: points (1/72 inch) in a unit of the axes.
    """
    taken = [point * scale for point in points]
    crowded = False
    for k, point in enumerate(points * scale):
        places = [point + shift for shift in ((0, 9), (8, 5), (-8, 5), (8, -6), (-8, -6), (0, -10))]
        rest = [other for j, other in enumerate(taken) if j != k]
        free = [p for p in places if p.min() > 3 and all((np.abs(p - o) > (8.5, 8)).any() for o in rest)]
        if np.isfinite(point).all() and free:
            axes.text(
                free[0][0] / scale,
                free[0][1] / scale,
                str(k + 1),
                fontsize=SMALL,
                ha="center",
                va="center",
                zorder=5,
            )
            taken.append(free[0])
        else:
            crowded |= bool(np.isfinite(point).all())
    return crowded


_BY_METRIC: dict[str, Callable[[StudyResults, str], tuple[Figure, str] | None]] = {
    "indices": indices,
    "morris": morris,
    "seeds": seeds,
    "tornado": tornado,
    "responses": responses,
    "interactions": interactions,
}


# ------------------------------------------------------------------------------------ ranking of faults


def ranking(results: StudyResults) -> Figure:
    """Draw the median cost of each fault with its interval, one panel for each metric, the worst fault on top.

    The thin line spans the middle half of the views. Where a large value is the better one, the axis is reversed,
    so that the right side is the worse one in every panel.
    """
    count, level = len(results.metrics), f"{100 * results.confidence:g} %"
    columns = min(_RANKING_COLUMNS, count)
    legend = [
        _handle(BLUE, "class of Gallon et al.: median"),
        _handle(VERMILLION, "other class: median"),
        Line2D([], [], color=INK, lw=2.6, label=f"its {level} interval"),
        Line2D([], [], color=MUTED, lw=0.9, label="middle half of the views"),
    ]
    grid, size = (-(-count // columns), columns), (_RANKING_WIDTH, _RANKING_ROW * results.dataset.sizes["fault"])
    with panels("Cost of each fault to navigation", grid, size, legend=legend) as (figure, axes):
        for panel, metric in zip(axes, results.metrics, strict=False):
            _draw_ranking(panel, results, metric, results.models[0])
        for panel in axes[count:]:
            panel.set_axis_off()
    return figure


def _handle(colour: str, label: str) -> Line2D:
    """Return the entry of the legend for a median."""
    return Line2D([], [], color=colour, marker="o", ms=4.2, ls="none", label=label)


def _of_paper(name: str) -> bool:
    """Return whether a fault is of a class of Gallon et al."""
    return any(model.axis is not None for model in registry().get(name.partition("/")[0], {}).values())


def worst_first(results: StudyResults, metric: str) -> list[str]:
    """Return the faults with a median of a metric, the worst first."""
    rank = results.dataset["fault_rank"].sel(metric=metric, model=results.models[0])
    names = [str(name) for name in rank["fault"].values if np.isfinite(rank.sel(fault=name))]
    return sorted(names, key=lambda name: float(rank.sel(fault=name)))


def _draw_ranking(axes: Axes, results: StudyResults, metric: str, model: str) -> None:
    """Draw the faults of one metric."""
    order = worst_first(results, metric)
    reverse = results.about(metric, "better") == "high"
    axes.set_title(metric, pad=4, fontweight="bold")
    axes.set_xlabel(with_unit("median over views", results.about(metric, "unit")), labelpad=2)
    if not order:
        write_message(axes, "no values")
        axes.set_yticks([])
        return
    chosen = results.dataset.sel(metric=metric, model=model, fault=order)
    values, interval = chosen["fault_quantile"].values, chosen["fault_quantile_interval"].values[:, _MEDIAN]
    views = chosen["fault_views"].values.astype(int)
    total = results.dataset.sizes["fault"]
    axes.set_ylim(total - 0.4, -0.6)
    axes.set_yticks(range(len(order)), [f"{n} ({k})" for n, k in zip(order, views, strict=True)], fontsize=SMALL)
    axes.tick_params(axis="y", length=0)
    axes.spines["left"].set_visible(False)
    axes.grid(axis="x")
    _set_scale(axes, values, interval, reverse=reverse)
    zero = 1.0 if reverse else 0.0
    axes.axvline(zero, color=MUTED, lw=0.7, zorder=1)
    for y, name in enumerate(order):
        colour = BLUE if _of_paper(name) else VERMILLION
        axes.hlines(y, values[y, _LOW], values[y, _HIGH], color=MUTED, lw=0.9, zorder=2)
        axes.hlines(y, *interval[y], color=colour, lw=2.6, alpha=0.6, zorder=3)
        axes.plot(values[y, _MEDIAN], y, "o", ms=4.2, color=colour, mew=0, zorder=4)


def _set_scale(axes: Axes, values: F64, interval: F64, *, reverse: bool) -> None:
    """Set scale and limits of the axis: linear, or logarithmic beyond a linear part next to 0.

    Costs of both signs, those around 0, are always on a linear axis.
    """
    ends = np.concatenate([values.ravel(), interval.ravel()])
    ends = ends[np.isfinite(ends)]
    low, high = float(min(ends.min(), 1.0 if reverse else 0.0)), float(max(ends.max(), 1.0 if reverse else 0.0))
    sizes = np.abs(values[:, _MEDIAN])
    sizes = sizes[sizes > 0]
    both_signs = low < -_BELOW * high
    if reverse or both_signs or not len(sizes) or high < _LOG_RATIO * float(np.median(sizes)):
        extent = high - low or 1.0
        axes.set_xlim(low - 0.03 * extent, high + 0.03 * extent)
        set_linear(axes.xaxis, 4)
        if reverse:
            axes.invert_xaxis()
        return
    linear = 10.0 ** np.floor(np.log10(max(float(np.quantile(sizes, 0.25)), 1e-3 * high)))
    axes.set_xscale("symlog", linthresh=linear, linscale=0.6)
    axes.set_xlim(min(low, -0.12 * linear), high * 1.3)
    axes.xaxis.set_major_locator(FixedLocator([0.0, *(p for p in linear * 10.0 ** np.arange(8) if p <= high)]))
    axes.xaxis.set_minor_locator(NullLocator())
    axes.xaxis.set_major_formatter(FuncFormatter(lambda v, _: with_minus(f"{v:g}")))


def ranking_rows(results: StudyResults, metric: str) -> list[list[str]]:
    """Return the faults of a metric, the worst first, as texts.

    A row has rank, fault, views, median with its interval, lower and upper quartile, and the probability that the
    next fault is worse.
    """
    order, model = worst_first(results, metric), results.models[0]
    chosen = results.dataset.sel(metric=metric, model=model)
    rows = []
    for k, name in enumerate(order):
        of_fault = chosen.sel(fault=name)
        low, median, high = (_number(v) for v in of_fault["fault_quantile"].values)
        ends = [_number(v) for v in of_fault["fault_quantile_interval"].values[_MEDIAN]]
        swap = ""
        if k + 1 < len(order):
            swap = f"{float(chosen['fault_worse'].sel(fault=order[k + 1], fault_b=name)):.2f}"
        rank = f"{int(of_fault['fault_rank'])}"
        views = f"{int(of_fault['fault_views'])} of {int(of_fault['fault_acts'])}"
        rows.append([rank, name, views, f"{median} [{ends[0]}, {ends[1]}]", f"{low} to {high}", swap])
    return rows


def _number(value: float) -> str:
    """Return a number with three digits and a real minus sign."""
    return with_minus(f"{value:.3f}") if 0.001 <= abs(value) < 1 else number_text(value)
