"""Draw the figures of a study: indices, tornado, response curves, interactions, models, Morris plane, seeds.

Each function takes `summaries.StudyResults` and returns a matplotlib figure of its own; nothing global is changed.
`drawings` gives all figures of a study one after the other, and `save` writes one as PNG and SVG.

The colours are those of Okabe and Ito (2008), which people with a colour vision deficiency can tell apart.

References
----------
M. Okabe, K. Ito, "Color Universal Design (CUD)", 2008, https://jfly.uni-koeln.de/color/.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from numpy.typing import NDArray

from ..core.whole_files import replacing
from .ranking_plots import ranking
from .response_plots import responses, tornado
from .sheets import (
    BAND,
    BLUE,
    DPI,
    GREEN,
    INK,
    MODEL_COLOURS,
    MODEL_MARKERS,
    MUTED,
    NOISE,
    SKY,
    SMALL,
    STYLE,
    VERMILLION,
    Margins,
    axis_exponent,
    label_rows,
    panel_width,
    rows_of,
    set_linear,
    sheet,
    styled,
    text_width,
    with_unit,
    wrapped,
    write_message,
)
from .summaries import DUMMY, StudyResults

F64 = NDArray[np.float64]

_HEAT = LinearSegmentedColormap.from_list("heat", ["#f3f6f9", "#8fc1e0", BLUE, "#00304d"])
_ON_LIGHT, _ON_DARK = "#101418", "#fdfdfd"  # of text on a coloured cell, in both themes
_MOST_PAIRS = 12  # factors of a matrix of pairs
_LEAST_SCALE = 84.0  # height in points of a panel beside a colour scale


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
    metric: str
    figure: Figure
    note: str = ""

    @property
    def stem(self) -> str:
        """Return the name of the figure's files, without their ending."""
        return f"{self.kind}_{self.metric}" if self.metric else self.kind


def drawings(results: StudyResults) -> Iterator[Drawing]:
    """Yield every figure that the results give, section by section."""
    if results.has("fault_quantile"):
        yield Drawing(kind="ranking", metric="", figure=ranking(results))
        if len(results.factors) == 1:
            return  # nothing else varies
    many = len(results.metrics) > 1 and len(results.factors) > 1
    if many:
        yield Drawing(kind="overview", metric="", figure=overview(results))
    for kind, draw in _BY_METRIC.items():
        for metric in results.metrics:
            drawn = draw(results, metric)
            if drawn is not None:
                figure, note = drawn
                yield Drawing(kind=kind, metric=metric, figure=figure, note=note)
        if kind == "responses" and _has_interactions_of_each(results):
            yield Drawing(kind="interactions", metric="", figure=interactions_of_each(results))
    if len(results.models) > 1:
        yield Drawing(kind="models", metric="", figure=models(results))


def _has_interactions_of_each(results: StudyResults) -> bool:
    """Return whether the results give total and first-order indices of several factors, but none of pairs."""
    several = len(results.factors) > 1
    return several and results.has("ST") and results.has("S1") and not results.has("interaction")


def save(drawing: Drawing, folder: Path) -> tuple[Path, Path]:
    """Write a figure as PNG and SVG to a folder and return the two paths."""
    png, svg = folder / f"{drawing.stem}.png", folder / f"{drawing.stem}.svg"
    with matplotlib.rc_context(STYLE):
        with replacing(png) as temporary:
            drawing.figure.savefig(temporary, format="png", dpi=DPI, metadata={"Software": None})
        nothing = dict.fromkeys(("Date", "Creator", "Format", "Type"))
        with replacing(svg) as temporary:
            drawing.figure.savefig(temporary, format="svg", transparent=True, metadata=nothing)
    return png, svg


# ------------------------------------------------------------------------------------ indices


@dataclass(frozen=True)
class _Series:
    """Describe an index that is drawn as dots with intervals."""

    name: str
    label: str
    colour: str
    filled: bool


_SHARES = (
    _Series("ST", "total index", BLUE, True),
    _Series("delta", "delta", GREEN, True),
    _Series("S1", "first-order index", VERMILLION, False),
)
_EFFECTS = (_Series("mu_star", "mean absolute elementary effect μ*", BLUE, True),)


@styled
def indices(results: StudyResults, metric: str) -> tuple[Figure, str] | None:
    """Draw the indices of one metric with their intervals, sorted, beside the noise floor.

    Sobol' indices are the total and the first-order index; a Latin hypercube gives delta, a Morris design the mean
    absolute elementary effect μ*.
    """
    shares = [series for series in _SHARES if results.has(series.name)]
    drawn = shares or [series for series in _EFFECTS if results.has(series.name)]
    if not drawn:
        return None
    order = [*results.ranked(metric), DUMMY]
    labels = [wrapped(factor) for factor in order]
    left, row = rows_of(labels)
    values = [(_intervals(results, metric, model, series, order)) for model in results.models for series in drawn]
    exponent = 0 if shares else axis_exponent(values)
    handles = [_dot_handle(series) for series in drawn]
    figure, axes = sheet(
        metric,
        (1, len(results.models)),
        (panel_width(len(results.models)), row * len(order)),
        Margins(left=left),
        legend=[*handles, NOISE] if results.has_noise_floor else handles,
        heads=results.models,
    )
    label_rows(axes, labels, separate_last=True)
    everything = np.concatenate(values, axis=1) / 10.0**exponent
    low, high = _index_limits(everything[0], everything[1:], bool(shares))
    label = "index (no unit)" if results.has("delta") else "fraction of the variance"
    if not shares:
        label = with_unit("μ*", results.about(metric, "unit"), exponent)
    for k, one in enumerate(axes):
        one.set_xlim(low, high)
        one.set_xlabel(label)
        set_linear(one.xaxis, 5 if len(axes) == 1 else 4)
        one.axvline(0, color=MUTED, lw=0.7)
        of_model = [v / 10.0**exponent for v in values[k * len(drawn) : (k + 1) * len(drawn)]]
        if not any(np.isfinite(v[0]).any() for v in of_model):
            variance = float(results.dataset["variance"].sel(metric=metric, model=results.models[k]))
            write_message(one, "no variance" if variance == 0 else "no values")
            continue
        _draw_dots(one, drawn, of_model)
    cut = bool(np.nanmax(np.append(everything, 0)) > high or np.nanmin(np.append(everything, 0)) < low)
    return figure, "Intervals that reach the edge of a panel go on beyond it." if cut else ""


def _intervals(results: StudyResults, metric: str, model: str, series: _Series, order: Sequence[str]) -> F64:
    """Return value, low and high of an index, [3, factor]; nan where there is none."""
    index = results.index(series.name, metric, model)
    bounds = results.index(f"{series.name}_interval", metric, model)
    values = np.full((3, len(order)), np.nan)
    for k, factor in enumerate(order):
        if index is None or factor not in index["factor"].values:
            continue
        values[0, k] = float(index.sel(factor=factor))
        if bounds is not None:
            values[1:, k] = bounds.sel(factor=factor, bound=["low", "high"]).values
    return values


def _index_limits(dots: F64, ends: F64, shares: bool) -> tuple[float, float]:
    """Return the limits of the axis of indices: all dots are within, but long intervals of fractions are cut."""
    both = [each[np.isfinite(each)] for each in (dots, np.concatenate([dots.ravel(), ends.ravel()]))]
    if not both[0].size:
        return (-0.03, 1.03) if shares else (-0.04, 1.04)
    (least, most), (low, high) = ((float(each.min()), float(each.max())) for each in both)
    if shares:
        return max(min(low, 0) - 0.03, min(least - 0.03, -0.3)), min(max(high, 1) + 0.03, max(most + 0.03, 1.3))
    extent = max(high, 0.0) - min(low, 0.0) or 1.0
    return min(low, 0.0) - 0.04 * extent, max(high, 0.0) + 0.04 * extent


def _draw_dots(axes: Axes, drawn: Sequence[_Series], values: Sequence[F64]) -> None:
    """Draw dots with intervals, and the noise floor over all rows."""
    floor = values[0][:, -1]
    floor = floor[np.isfinite(floor)]
    if floor.size:
        _draw_floor(axes, float(floor.min()), float(floor.max()))
    offsets = (-0.17, 0.17) if len(drawn) == 2 else (0.0,) * len(drawn)
    for series, offset, (value, low, high) in zip(drawn, offsets, values, strict=True):
        y = np.arange(len(value)) + offset
        axes.hlines(y, low, high, color=series.colour, lw=1.5, zorder=3)
        face = series.colour if series.filled else "white"
        axes.plot(value, y, "o", ms=4.2, mfc=face, mec=series.colour, mew=1.1, zorder=4, ls="none", clip_on=False)
        axes.lines[-1].set_clip_on(True)


def _draw_floor(axes: Axes, low: float, high: float) -> None:
    """Draw the noise floor as a band; as a line where its width is below a pixel, and not at all where it is 0."""
    left, right = axes.get_xlim()
    if high - low > 0.004 * (right - left):
        axes.axvspan(low, high, color=BAND, alpha=0.75, lw=0, zorder=1)
    elif high > low:
        axes.axvline((low + high) / 2, color=BAND, lw=3, zorder=1)


def _dot_handle(series: _Series) -> Line2D:
    """Return the entry of the legend for dots with intervals."""
    face = series.colour if series.filled else "white"
    return Line2D(
        [], [], color=series.colour, lw=1.5, marker="o", ms=4.2, mfc=face, mec=series.colour, label=series.label
    )


@styled
def seeds(results: StudyResults, metric: str) -> tuple[Figure, str] | None:
    """Draw the index of each seed beside the interval of all seeds."""
    name = next((s.name for s in (*_SHARES, *_EFFECTS) if results.has(f"{s.name}_by_seed")), None)
    if name is None or results.dataset.sizes.get("seed", 1) < 2:
        return None
    series = next(s for s in (*_SHARES, *_EFFECTS) if s.name == name)
    order = [*results.ranked(metric), DUMMY]
    labels = [wrapped(factor) for factor in order]
    left, row = rows_of(labels)
    every = results.dataset[f"{name}_by_seed"].sel(metric=metric, factor=order)
    numbers = [str(seed) for seed in results.dataset["seed"].values]
    text = f"interval of the {series.label}, all seeds"
    handles: list[Any] = [Patch(facecolor=SKY, alpha=0.6, lw=0, label=text)]
    marks = [(MODEL_COLOURS[k % 6], MODEL_MARKERS[k % 6]) for k in range(len(numbers))]
    if len(numbers) <= 6:
        handles += [
            Line2D([], [], color=colour, marker=marker, ms=4, ls="none", label=f"seed {number}")
            for (colour, marker), number in zip(marks, numbers, strict=True)
        ]
    figure, axes = sheet(
        metric,
        (1, len(results.models)),
        (panel_width(len(results.models)), row * len(order)),
        Margins(left=left),
        legend=handles,
        heads=results.models,
    )
    label_rows(axes, labels, separate_last=True)
    pooled = [_intervals(results, metric, model, series, order) for model in results.models]
    share = name not in [s.name for s in _EFFECTS]
    exponent = 0 if share else axis_exponent(every.values)
    limits = _index_limits(every.values / 10.0**exponent, np.stack(pooled) / 10.0**exponent, share)
    label = with_unit("μ*", results.about(metric, "unit"), exponent) if not share else series.label
    for one, model, (_, low, high) in zip(axes, results.models, pooled, strict=True):
        one.set_xlim(*limits)
        one.set_xlabel(label)
        set_linear(one.xaxis)
        y = np.arange(len(order))
        one.hlines(y, low / 10.0**exponent, high / 10.0**exponent, color=SKY, alpha=0.6, lw=6, zorder=2)
        values = every.sel(model=model).transpose("factor", "seed").values / 10.0**exponent
        if not np.isfinite(values).any():
            write_message(one, "no values")
        for k, (colour, marker) in enumerate(marks):
            shift = 0.5 * (k / (len(marks) - 1) - 0.5)
            one.plot(values[:, k], y + shift, ls="none", marker=marker, ms=3.2, color=colour, mew=0, zorder=4)
    return figure, ""


def _largest(values: Any) -> float:
    """Return the largest of the values that are numbers, at least 0."""
    return float(np.nan_to_num(np.asarray(values), nan=0.0).max(initial=0.0))


# ------------------------------------------------------------------------------------ heat maps


@styled
def overview(results: StudyResults) -> Figure:
    """Draw the importance of each factor for each metric, one panel per model."""
    words, values = results.importance
    return _heat(
        results, values.sel(factor=[*results.factors, DUMMY]).values, "Every factor and every metric", words
    )


@styled
def interactions_of_each(results: StudyResults) -> Figure:
    """Draw total minus first-order index: the fraction of the variance that interactions with each factor cause."""
    names = list(results.factors)
    values = results.dataset["ST"].sel(factor=names).values - results.dataset["S1"].sel(factor=names).values
    return _heat(results, values, "Interactions of each factor", "total index − first-order index")


def _heat(results: StudyResults, values: F64, title: str, label: str) -> Figure:
    """Draw a matrix of factors and metrics, one panel per model; `values` is [metric, model, factor]."""
    names = [*results.factors, DUMMY][: values.shape[2]]
    summed = np.nan_to_num(values).max(axis=1).sum(axis=0)
    order = sorted(range(len(results.factors)), key=lambda k: -summed[k])
    order += list(range(len(results.factors), values.shape[2]))
    labels = [wrapped(names[k]) for k in order]
    left, row = rows_of(labels)
    row = max(row, _LEAST_SCALE / len(labels))
    columns = [wrapped(metric, 26, 1) for metric in results.metrics]
    cell, slant = 21.0, math.radians(45)
    bottom = max(map(text_width, columns)) * math.sin(slant) + 18
    left = max(left, text_width(columns[0]) * math.cos(slant) - cell / 2 + 6)
    top = min(1.0, _largest(values)) or 1.0
    label = _scale_label(label, row * len(labels))
    figure, axes = sheet(
        title,
        (1, len(results.models)),
        (cell * len(columns), row * len(labels)),
        Margins(left=left, bottom=bottom, right=_scale_width(label), top=8.0, between_columns=16.0),
        heads=results.models,
    )
    for j, one in enumerate(axes):
        cells = values[:, j, :][:, order].T
        mesh = _draw_cells(one, cells, top, numbers=True)
        one.set_yticks(np.arange(len(labels)) + 0.5, labels if j == 0 else [""] * len(labels), linespacing=1.0)
        one.set_xticks(np.arange(len(columns)) + 0.5, columns, rotation=45, ha="right", rotation_mode="anchor")
    _draw_scale(figure, axes[-1], mesh, label)
    return figure


@styled
def interactions(results: StudyResults, metric: str) -> tuple[Figure, str] | None:
    """Draw the total interaction index of each pair of factors, with the first-order indices on the diagonal."""
    if not results.has("interaction"):
        return None
    order = list(results.ranked(metric)[:_MOST_PAIRS])
    labels = [wrapped(factor, 24) for factor in order]
    left, row = rows_of(labels)
    row = max(row, 21.0, _LEAST_SCALE / len(labels))
    columns = [wrapped(factor, 24, 2) for factor in order]
    matrices = []
    for model in results.models:
        pairs = results.dataset["interaction"].sel(metric=metric, model=model)
        both = pairs.sel(factor=order, factor_b=order).values
        both = np.where(np.isfinite(both), both, both.T)  # one triangle may be empty
        lower = np.where(np.tri(len(order), k=-1) > 0, both, np.nan)
        first = results.index("S1", metric, model)
        if first is not None:
            np.fill_diagonal(lower, first.sel(factor=order).values)
        matrices.append(lower)
    top = min(1.0, _largest(matrices)) or 1.0
    label = _scale_label("fraction of the variance", row * len(order))
    figure, axes = sheet(
        metric,
        (1, len(results.models)),
        (23.0 * len(order), row * len(order)),
        Margins(
            left=left,
            bottom=max(map(text_width, columns)) + 16,
            right=_scale_width(label),
            top=8.0,
            between_columns=16.0,
        ),
        heads=results.models,
    )
    for j, (one, matrix) in enumerate(zip(axes, matrices, strict=True)):
        triangle = np.tri(len(order)) == 0
        mesh = _draw_cells(one, matrix, top, numbers=True, empty=triangle)
        one.set_yticks(np.arange(len(order)) + 0.5, labels if j == 0 else [""] * len(order), linespacing=1.0)
        one.set_xticks(np.arange(len(order)) + 0.5, columns, rotation=90)
    _draw_scale(figure, axes[-1], mesh, label)
    left_out = len(results.factors) > len(order)
    words = results.importance[0]
    return figure, f"Drawn are the {len(order)} factors with the highest {words}." if left_out else ""


def _draw_cells(axes: Axes, values: F64, top: float, *, numbers: bool, empty: Any = None) -> Any:
    """Draw a matrix as coloured cells with their values; return what the colour scale needs."""
    rows, columns = values.shape
    mesh = axes.pcolormesh(
        np.clip(values, 0, None), cmap=_HEAT, vmin=0, vmax=top, edgecolors="white", linewidth=0.8
    )
    axes.set_ylim(rows, 0)
    axes.tick_params(length=0, pad=3)
    for spine in axes.spines.values():
        spine.set_visible(False)
    for i in range(rows):
        for j in range(columns):
            value = values[i, j]
            if not np.isfinite(value):
                if empty is None or not empty[i, j]:
                    axes.text(j + 0.5, i + 0.5, "–", ha="center", va="center", fontsize=SMALL, color=MUTED)
            elif numbers and value >= 0.005:
                text = f"{value:.2f}".removeprefix("0") if value < 0.995 else f"{value:.1f}"
                colour = _ON_DARK if value / top > 0.55 else _ON_LIGHT
                axes.text(j + 0.5, i + 0.52, text, ha="center", va="center", fontsize=SMALL, color=colour)
    return mesh


def _scale_label(label: str, height: float) -> str:
    """Return the label of a colour scale beside a panel, in lines that fit its height in points."""
    return wrapped(label, max(12, int(min(height, 150.0) / 5)), 3)


def _scale_width(label: str) -> float:
    """Return the width in points of a colour scale with its label."""
    return 58.0 + 10.0 * (label.count("\n") + 1)


def _draw_scale(figure: Figure, beside: Axes, mesh: Any, label: str) -> None:
    """Draw the colour scale at the right of a panel."""
    box, (width, height) = beside.get_position(), figure.get_size_inches() * 72
    length = min(box.height, 150 / height)
    axes = figure.add_axes((box.x1 + 12 / width, box.y1 - length, 8 / width, length))
    bar = figure.colorbar(mesh, cax=axes)
    bar.outline.set_visible(False)
    axes.tick_params(length=2, width=0.7, pad=2)
    set_linear(axes.yaxis, 4 if length * height > 60 else 2)
    axes.set_ylabel(label, linespacing=1.0)


# ------------------------------------------------------------------------------------ models and Morris


@styled
def models(results: StudyResults) -> Figure:
    """Draw variance by model beside the variance between models, and the mean of each model.

    The bars are the terms of the law of total variance as fractions of the total: the variance of the models'
    means, and the mean of the models' variances, divided among the models.
    """
    labels = [wrapped(metric) for metric in results.metrics]
    left, row = rows_of(labels)
    handles: list[Any] = [Patch(facecolor=INK, lw=0, label="between models (model form)")]
    if "model_share_interval" in results.dataset:
        text = f"its {100 * results.confidence:g} % interval"
        handles.append(Line2D([], [], color=VERMILLION, lw=1.6, label=text))
    handles += [
        Patch(facecolor=MODEL_COLOURS[k % 6], lw=0, label=f"within {model}")
        for k, model in enumerate(results.models)
    ]
    figure, (shares, means) = sheet(
        "Model form beside parametric variance",
        (1, 2),
        (230.0, row * max(len(labels), 2)),
        Margins(left=left, between_columns=22.0, right=20.0),
        legend=handles,
        heads=("variance", "mean"),
    )
    label_rows((shares, means), labels, separate_last=False)
    for y, metric in enumerate(results.metrics):
        _draw_total_variance(shares, results, metric, y)
        values = results.dataset["mean"].sel(metric=metric).values.astype(float)
        middle = np.nanmean(values) if np.isfinite(values).any() else 0.0
        if not middle:
            continue
        for k, value in enumerate(values):
            shift = 0.36 * (k / (len(values) - 1) - 0.5)
            style: Any = {"color": MODEL_COLOURS[k % 6], "marker": MODEL_MARKERS[k % 6]}
            means.plot(value / middle, y + shift, ms=4.5, mew=0, ls="none", zorder=3, **style)
    shares.set_xlim(0, 1)
    shares.set_xlabel("fraction of the total variance")
    set_linear(shares.xaxis, 5)
    means.axvline(1, color=MUTED, lw=0.8)
    means.set_xlabel("mean of a model / mean of all models")
    set_linear(means.xaxis, 5)
    means.margins(x=0.08)
    return figure


def _draw_total_variance(axes: Axes, results: StudyResults, metric: str, y: int) -> None:
    """Draw one bar: the fraction between models, with its interval, then the fraction within each model."""
    share = float(results.dataset["model_share"].sel(metric=metric)) if "model_share" in results.dataset else np.nan
    within = results.dataset["variance"].sel(metric=metric).values.astype(float)
    if not np.isfinite(share):
        axes.text(0.5, y, "no values", ha="center", va="center", color=MUTED, style="italic")
        return
    total = np.nansum(within)
    parts = [share, *((1 - share) * np.nan_to_num(within) / total if total > 0 else np.zeros(len(within)))]
    start = 0.0
    for part, colour in zip(parts, [INK, *MODEL_COLOURS], strict=False):
        axes.barh(y, part, left=start, height=0.62, color=colour, lw=0, zorder=3)
        start += part
    if "model_share_interval" in results.dataset:
        low, high = results.dataset["model_share_interval"].sel(metric=metric, bound=["low", "high"]).values
        axes.plot([low, high], [y, y], color="white", lw=3.4, zorder=4, solid_capstyle="round")
        axes.plot([low, high], [y, y], color=VERMILLION, lw=1.6, zorder=5, solid_capstyle="round")


@styled
def morris(results: StudyResults, metric: str) -> tuple[Figure, str] | None:
    """Draw the plane of μ* and σ of the elementary effects, each factor a number that the list names."""
    if not results.has("mu_star"):
        return None
    order = list(results.ranked(metric))
    keys = [f"{k + 1}  {wrapped(factor, 34, 1)}" for k, factor in enumerate(order)]
    size = max(190.0, 10.5 * len(keys))
    values = {
        m: (
            results.dataset["mu_star"].sel(metric=metric, model=m, factor=order).values.astype(float),
            results.dataset["sigma"].sel(metric=metric, model=m, factor=order).values.astype(float),
        )
        for m in results.models
    }
    exponent = axis_exponent([values[m] for m in results.models])
    unit = results.about(metric, "unit")
    figure, axes = sheet(
        metric,
        (1, len(results.models)),
        (190.0, size if len(results.models) == 1 else 190.0),
        Margins(left=48.0, right=max(map(text_width, keys)) + 24, between_columns=20.0, bottom=34.0),
        legend=[
            Line2D([], [], color=BLUE, marker="o", ms=4, ls="none", label="factor"),
            Line2D([], [], color=MUTED, lw=0.8, ls=":", label="σ = 0.1, 0.5 and 1 times μ*"),
        ],
        heads=results.models,
    )
    finite = np.concatenate([np.ravel(values[m]) for m in results.models]) / 10.0**exponent
    top = _largest(finite) * 1.08 or 1.0
    crowded = False
    for k, (one, model) in enumerate(zip(axes, results.models, strict=True)):
        mu_star, sigma = (v / 10.0**exponent for v in values[model])
        one.set(xlim=(-0.03 * top, top), ylim=(-0.03 * top, top))
        one.set_xlabel(with_unit("μ*", unit, exponent))
        if k == 0:
            one.set_ylabel(with_unit("σ", unit, exponent))
        else:
            one.set_yticklabels([])
        set_linear(one.xaxis)
        set_linear(one.yaxis)
        if k:
            one.set_yticklabels([])
        for slope in (0.1, 0.5, 1.0):
            one.plot([0, top], [0, slope * top], color=MUTED, lw=0.8, ls=":", zorder=2)
        if not np.isfinite(mu_star).any():
            write_message(one, "no values")
            continue
        one.plot(mu_star, sigma, "o", ms=4, color=BLUE, mew=0, ls="none", zorder=4)
        crowded |= _number_points(one, mu_star, sigma, top)
    box, (width, height) = axes[-1].get_position(), figure.get_size_inches() * 72
    for k, key in enumerate(keys):
        figure.text(box.x1 + 14 / width, box.y1 - 10.5 * k / height, key, va="top", ha="left", fontsize=SMALL)
    return figure, "Factors too close to others for a number beside them carry none." if crowded else ""


def _number_points(axes: Axes, x: F64, y: F64, extent: float) -> bool:
    """Write the number of each point beside it, the first ones first; return whether some found no room."""
    box = axes.get_position()
    width_pt = box.width * axes.get_figure().get_size_inches()[0] * 72  # type: ignore[union-attr]
    height_pt = box.height * axes.get_figure().get_size_inches()[1] * 72  # type: ignore[union-attr]
    scale = np.asarray([width_pt, height_pt]) / extent
    points = np.column_stack([x, y]) * scale
    crowded = False
    taken: list[tuple[float, float]] = [tuple(p) for p in points if np.isfinite(p).all()]
    for k, point in enumerate(points):
        if not np.isfinite(point).all():
            continue
        for shift in ((7, 5), (-7, 5), (7, -6), (-7, -6), (0, 9), (0, -10), (11, 0), (-11, 0)):
            place = point + shift
            if place.min() < 2 or (place > np.asarray([width_pt, height_pt]) - 3).any():
                continue
            if all(abs(place[0] - a) > 7.5 or abs(place[1] - b) > 7 for a, b in taken if (a, b) != tuple(point)):
                axes.text(
                    place[0] / scale[0],
                    place[1] / scale[1],
                    str(k + 1),
                    fontsize=SMALL,
                    ha="center",
                    va="center",
                    zorder=5,
                )
                taken.append((float(place[0]), float(place[1])))
                break
        else:
            crowded = True
    return crowded


_BY_METRIC: dict[str, Callable[[StudyResults, str], tuple[Figure, str] | None]] = {
    "indices": indices,
    "morris": morris,
    "seeds": seeds,
    "tornado": tornado,
    "responses": responses,
    "interactions": interactions,
}
