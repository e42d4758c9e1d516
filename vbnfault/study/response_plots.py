"""Draw how a metric responds to each factor: the tornado of swings, and response curves."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from ..core.figures import (
    BAND,
    BLUE,
    INK,
    MUTED,
    SERIES_COLOURS,
    SERIES_MARKERS,
    SKY,
    VERMILLION,
    axis_exponent,
    label_rows,
    panels,
    row_height,
    set_linear,
    set_log,
    with_unit,
    wrapped,
    write_message,
)
from .summaries import DesignPoints, ResponseCurve, StudyResults, Swing

NOISE = Patch(facecolor=BAND, alpha=0.75, lw=0, label="noise floor")

_MOST_PANELS = 12
_PANEL = (134.0, 88.0)  # width and height of a response curve in points
_LOG_RATIO = 100.0  # a metric that varies more gets a logarithmic axis


@contextlib.contextmanager
def rows_of_factors(
    results: StudyResults, metric: str, order: Sequence[str], legend: Sequence[Any], *, separate_last: bool = False
) -> Iterator[tuple[Figure, Sequence[Axes]]]:
    """Give a figure with a panel for each model, side by side, and a row for each factor in them."""
    labels = [wrapped(factor) for factor in order]
    size = {1: 210.0, 2: 165.0}.get(len(results.models), 140.0), row_height(labels) * max(len(order), 2)
    with panels(metric, (1, len(results.models)), size, legend=legend, heads=results.models) as (figure, axes):
        label_rows(axes, labels, separate_last=separate_last)
        yield figure, axes


def tornado(results: StudyResults, metric: str) -> tuple[Figure, str]:
    """Draw how far the mean of a metric moves along each factor, sorted, beside the swing of chance."""
    points = {model: results.points(metric, model) for model in results.models}
    swings = {m: {f: points[m].swing(f) for f in results.factors} for m in results.models}
    sizes = {f: np.nan_to_num([swings[m][f].size for m in results.models], nan=-1).max() for f in results.factors}
    order = sorted(results.factors, key=lambda factor: -sizes[factor])
    ends = np.asarray([end for m in results.models for s in swings[m].values() for end in (s.least, s.most)])
    exponent = axis_exponent(ends)
    unit = 10.0**exponent
    ends = ends[np.isfinite(ends)] / unit
    extent = (float(np.ptp(ends)) or abs(float(ends[0])) or 1.0) if ends.size else 1.0
    legend = [
        Patch(facecolor=SKY, alpha=0.6, lw=0, label="range of the mean"),
        Line2D([], [], color=VERMILLION, marker="<", ms=5, ls="none", label="lowest values of the factor"),
        Line2D([], [], color=BLUE, marker=">", ms=5, ls="none", label="highest values"),
        *([NOISE] if results.shows_chance("tornado") else []),
    ]
    with rows_of_factors(results, metric, order, legend) as (figure, axes):
        for one, model in zip(axes, results.models, strict=True):
            one.set_xlabel(with_unit(f"mean {metric}", results.about(metric, "unit"), exponent, 30))
            set_linear(one.xaxis, 4)
            if not points[model].values.size:
                write_message(one, "no values")
                one.set_xticks([])
                continue
            one.set_xlim(ends.min() - 0.06 * extent, ends.max() + 0.06 * extent)
            centre, chance = points[model].centre(), points[model].chance_swing()
            one.axvspan((centre - chance / 2) / unit, (centre + chance / 2) / unit, color=BAND, alpha=0.75, lw=0)
            one.axvline(centre / unit, color=MUTED, lw=0.8, zorder=2)
            for y, factor in enumerate(order):
                _draw_swing(one, y, swings[model][factor], unit, ordered=not is_categorical(results, factor))
    return figure, ""


def _draw_swing(axes: Axes, y: int, swing: Swing, unit: float, *, ordered: bool) -> None:
    """Draw the range of the mean along one factor, with its ends where the factor's values have an order."""
    axes.barh(y, swing.size / unit, left=swing.least / unit, height=0.6, color=SKY, alpha=0.6, lw=0, zorder=3)
    if ordered:
        axes.plot(swing.at_low_end / unit, y, "<", ms=5, color=VERMILLION, mew=0, zorder=4)
        axes.plot(swing.at_high_end / unit, y, ">", ms=5, color=BLUE, mew=0, zorder=4)


def is_categorical(results: StudyResults, factor: str) -> bool:
    """Return whether a factor has categories, numbers or words, in no order."""
    return results.factor(factor).get("distribution") == "categorical" or results.column(factor).dtype.kind in "OU"


# ------------------------------------------------------------------------------------ response curves


@dataclass(frozen=True, kw_only=True)
class _Responses:
    """Hold what the response curves of one metric draw: by model, and by factor and model."""

    points: Mapping[str, DesignPoints]
    curves: Mapping[str, Mapping[str, ResponseCurve]]
    chance: Mapping[str, tuple[float, float] | None]

    @property
    def every(self) -> list[ResponseCurve]:
        """Return all curves."""
        return [curve for by_model in self.curves.values() for curve in by_model.values()]

    def limits(self) -> tuple[float, float, bool]:
        """Return the common limits of the vertical axes, and whether these are logarithmic."""
        ends = [v for c in self.every for v in (*c.median, *c.low, *c.high)]
        ends += [v for band in self.chance.values() if band for v in band]
        finite = np.asarray([v for v in ends if np.isfinite(v)])
        if not finite.size:
            return 0.0, 1.0, False
        low, high = float(finite.min()), float(finite.max())
        if low > 0 and high / low > _LOG_RATIO:
            return low / 1.4, high * 1.4, True
        margin = 0.06 * (high - low) or 0.1 * abs(high) or 1.0
        return low - margin, high + margin, False


def responses(results: StudyResults, metric: str) -> tuple[Figure, str]:
    """Draw the conditional median of a metric against each factor, with bootstrap bands.

    At most twelve factors are drawn, those of greatest importance.
    """
    factors = results.ranked(metric)[:_MOST_PANELS]
    points = {model: results.points(metric, model) for model in results.models}
    drawn = _Responses(
        points=points,
        curves={f: {m: p.curve(f, results.confidence) for m, p in points.items()} for f in factors},
        chance={model: p.chance_band(results.confidence) for model, p in points.items()},
    )
    low, high, log = drawn.limits()
    exponent = 0 if log else axis_exponent([low, high])
    unit = 10.0**exponent
    columns = min(4, len(factors))
    grid = math.ceil(len(factors) / columns), columns
    with panels(metric, grid, _PANEL, legend=_legend(results, drawn), sharey=True) as (figure, axes):
        for one in axes[len(factors) :]:
            one.set_axis_off()
        axes[0].set_ylim(low / unit, high / unit)
        set_log(axes[0].yaxis, low, high) if log else set_linear(axes[0].yaxis, 5)
        for one in axes[::columns]:
            one.set_ylabel(with_unit(metric, results.about(metric, "unit"), exponent, 20))
        for one, factor in zip(axes, factors, strict=False):
            key = "" if is_categorical(results, factor) else str(results.factor(factor).get("unit") or "")
            one.set_xlabel(with_unit(factor, key, 0, 25) if key else wrapped(factor, 25), linespacing=1.1)
            one.grid(axis="y")
            if not any(curve.x for curve in drawn.curves[factor].values()):
                write_message(one, "no values")
                one.set_xticks([])
                continue
            _draw_chance(one, list(drawn.chance.values()), unit)
            if is_categorical(results, factor):
                _draw_categories(one, drawn, factor, unit)
            else:
                log_factor = results.factor(factor).get("distribution") == "log_uniform"
                _draw_curves(one, drawn.curves[factor], unit, log_factor)
    words = results.importance[0].split(" / ")[0]
    note = f"Drawn are the {len(factors)} of {len(results.factors)} factors with the highest {words}."
    return figure, note if len(results.factors) > len(factors) else ""


def _legend(results: StudyResults, drawn: _Responses) -> list[Any]:
    """Return the legend of response curves."""
    several = len(results.models) > 1
    names = results.models if several else ("median",)
    handles: list[Any] = [
        Line2D([], [], color=SERIES_COLOURS[k % 6], marker=SERIES_MARKERS[k % 6], ms=3.5, lw=1.4, label=name)
        for k, name in enumerate(names)
    ]
    if any(np.isfinite(curve.low).any() for curve in drawn.every):
        text = f"{100 * results.confidence:g} % interval of the median"
        handles.append(Patch(facecolor=MUTED if several else BLUE, alpha=0.3, lw=0, label=text))
    if any(drawn.chance.values()):
        handles.append(Line2D([], [], color=MUTED, lw=3, label="noise floor, right edge") if several else NOISE)
    return handles


def _draw_chance(axes: Axes, bands: Sequence[tuple[float, float] | None], unit: float) -> None:
    """Draw the noise floor: as a band for one model, as a bar at the right edge for each of several."""
    for k, band in enumerate(bands):
        if band is None:
            continue
        if len(bands) == 1:
            axes.axhspan(band[0] / unit, band[1] / unit, color=BAND, alpha=0.75, lw=0)
            continue
        x = 1.02 + 0.022 * k
        ends = [band[0] / unit, band[1] / unit]
        axes.plot(
            [x, x], ends, color=SERIES_COLOURS[k % 6], lw=2.2, transform=axes.get_yaxis_transform(), clip_on=False
        )


def _draw_curves(axes: Axes, curves: Mapping[str, ResponseCurve], unit: float, log: bool) -> None:
    """Draw the median of each model against numbers, with its band."""
    every = [x for curve in curves.values() for x in curve.x if isinstance(x, float)]
    for k, curve in enumerate(curves.values()):
        colour, marker = SERIES_COLOURS[k % 6], SERIES_MARKERS[k % 6]
        x = np.asarray(curve.x, dtype=float)
        axes.fill_between(x, curve.low / unit, curve.high / unit, color=colour, alpha=0.25, lw=0, zorder=3)
        axes.plot(x, curve.median / unit, color=colour, marker=marker, ms=2.6, mew=0, lw=1.3, zorder=4)
    low, high = min(every), max(every)
    if log and 0 < low < high:
        set_log(axes.xaxis, low, high, 3)
        return
    axes.margins(x=0.04)
    set_linear(axes.xaxis, 4)
    if any(len(f"{tick:.6g}") > 6 for tick in axes.get_xticks()):
        set_linear(axes.xaxis, 2)


def _draw_categories(axes: Axes, drawn: _Responses, factor: str, unit: float) -> None:
    """Draw the median of each model at each category as a bar that begins at the median of all points."""
    curves = drawn.curves[factor]
    categories = sorted({x for curve in curves.values() for x in curve.x}, key=lambda x: (isinstance(x, str), x))
    width = 0.8 / len(curves)
    for k, (model, curve) in enumerate(curves.items()):
        if not curve.x:
            continue
        x = np.asarray([categories.index(value) for value in curve.x]) + (k - (len(curves) - 1) / 2) * width
        base = float(np.median(drawn.points[model].values)) / unit
        height = curve.median / unit - base
        axes.bar(x, height, 0.9 * width, bottom=base, color=SERIES_COLOURS[k % 6], lw=0, zorder=3)
        axes.vlines(x, curve.low / unit, curve.high / unit, color=INK, lw=1.0, zorder=4)
        axes.hlines(base, -0.5, len(categories) - 0.5, color=SERIES_COLOURS[k % 6], lw=0.7, zorder=3)
    names = [wrapped(x if isinstance(x, str) else f"{x:g}", 14, 1) for x in categories]
    side_by_side = 4.6 * (max(map(len, names)) + 1) * len(names) < _PANEL[0]
    axes.set_xticks(range(len(names)), names, rotation=0 if side_by_side else 90)
    axes.set_xlim(-0.6, len(names) - 0.4)
