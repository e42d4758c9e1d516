"""Draw and tabulate what each fault costs navigation, from the indices of a study that ranks faults."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator
from numpy.typing import NDArray

from ..core.figures import (
    BLUE,
    INK,
    MUTED,
    SMALL,
    VERMILLION,
    panels,
    set_linear,
    with_unit,
    write_message,
)
from ..core.html_page import number_text, with_minus
from ..faults import registry
from .ranking import QUANTILES
from .summaries import StudyResults

F64 = NDArray[np.float64]

_COLUMNS = 3
_WIDTH, _ROW = 128.0, 13.0  # of a panel and of its rows, points
_LOG_RATIO = 30.0  # of the largest to the median cost, above which an axis is logarithmic beyond its linear part
_BELOW = 0.02  # of the largest cost: a cost further below 0 needs a linear axis
_LOW, _MEDIAN, _HIGH = range(len(QUANTILES))


def ranking(results: StudyResults) -> Figure:
    """Draw the median cost of each fault with its interval, one panel for each metric, the worst fault on top.

    The thin line spans the middle half of the views. Where a large value is the better one, the axis is reversed,
    so that the right side is the worse one in every panel.
    """
    count, level = len(results.metrics), f"{100 * results.confidence:g} %"
    columns = min(_COLUMNS, count)
    legend = [
        _handle(BLUE, "class of Gallon et al.: median"),
        _handle(VERMILLION, "other class: median"),
        Line2D([], [], color=INK, lw=2.6, label=f"its {level} interval"),
        Line2D([], [], color=MUTED, lw=0.9, label="middle half of the views"),
    ]
    grid, size = (-(-count // columns), columns), (_WIDTH, _ROW * results.dataset.sizes["fault"])
    with panels("Cost of each fault to navigation", grid, size, legend=legend) as (figure, axes):
        for panel, metric in zip(axes, results.metrics, strict=False):
            _draw_panel(panel, results, metric, results.models[0])
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


def _draw_panel(axes: Axes, results: StudyResults, metric: str, model: str) -> None:
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
