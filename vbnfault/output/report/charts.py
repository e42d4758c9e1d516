"""Draw the charts of a report: histograms, bars, boxes, matrices of counts, and maps of directions."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from ...core.figures import (
    BAND,
    BLUE,
    GREEN,
    INK,
    MUTED,
    SMALL,
    THEMED,
    VERMILLION,
    draw_cells,
    inline_svg,
    panels,
    plain_panel,
    set_linear,
    set_log,
    svg_text,
)
from ...core.html_page import grouped_digits, number_text

F64 = NDArray[np.float64]
Groups = Sequence[tuple[str, F64]]  # name and values of each split

# Colours of the splits, in their order; a further split is drawn in the colour of text.
SPLIT_COLOURS = (BLUE, VERMILLION, GREEN)
_BINS = 24
_MOST = 1e30
_FEW = 6  # a group of fewer values is drawn as dots
_ROW = 14.0  # height of the bar of a split in points
_SPREAD = 15.0  # positive values whose 99th percentile is so many medians get a logarithmic axis


def split_colour(k: int) -> str:
    """Return the colour of the split number `k`."""
    return SPLIT_COLOURS[k] if k < len(SPLIT_COLOURS) else INK


def percent(fraction: float) -> str:
    """Return a fraction in per cent."""
    digits = f"{100 * fraction:.0f}" if fraction >= 0.0095 or not fraction else number_text(100 * fraction)
    return f"{digits}\N{NO-BREAK SPACE}%"


def _chart(figure: Figure, name: str, title: str, unit: str, label: str) -> Markup:
    """Return a figure as an element of the page, with its title above it."""
    return Markup('<figure class="chart"><figcaption>{}{}</figcaption>{}</figure>').format(
        title,
        Markup(" <span>/ {}</span>").format(unit) if unit not in ("", "1") else "",
        inline_svg(svg_text(figure), name, label),
    )


# --- histograms ---------------------------------------------------------------------------------------------


def histogram(
    title: str,
    unit: str,
    groups: Groups,
    *,
    section: str = "",
    bounds: Sequence[tuple[str, tuple[float, float]]] = (),
    logarithmic: bool = False,
    limits: tuple[float, float] | None = None,
    labels: Sequence[str] = (),
) -> Markup:
    """Return a histogram with one line for each split as an element of the page.

    Parameters
    ----------
    title, unit
        Text above it.
    groups
        Name and finite values of each split.
    section
        Where it stands; with the title, it names no other chart.
    bounds
        Name, low and high of the intervals in which the values were drawn.
    logarithmic
        Whether the axis is logarithmic. Values of 0 then stand in a bar of their own at the left.
    limits
        Ends of the axis; by default those of values and bounds.
    labels
        Names of the whole numbers from 0 on, where the values are the numbers of kinds.
    """
    groups = [(name, _drawable(values)) for name, values in groups]
    bounds = [
        (name, (float(low), float(high))) for name, pair in bounds for low, high in [_drawable(np.array(pair))]
    ]
    given = np.concatenate([values for _, values in groups] or [np.zeros(0)])
    if not given.size or (given.min() == given.max() and not bounds and not labels):
        text = f"{number_text(float(given[0]), unit=unit)} in all samples" if given.size else "no values"
        head = Markup("<figcaption>{}</figcaption>").format(title)
        return Markup('<figure class="chart">{}<p class="small">{}</p></figure>').format(head, text)
    rails = list(bounds) if len({pair for _, pair in bounds}) > 1 else []
    positive = given[given > 0]
    logarithmic = logarithmic and positive.size > 0
    low, high = limits or _limits(positive if logarithmic else given, [pair for _, pair in bounds], logarithmic)
    edges = bin_edges(given, low, high, logarithmic)
    has_zeros = logarithmic and positive.size < given.size
    with plain_panel((240.0, 72.0), 10.0 + 10.0 * len(rails)) as (figure, axes):
        axes.set_xlim(low, edges[-1])
        (set_log if logarithmic else set_linear)(axes.xaxis, *((low, high) if logarithmic else ()))
        axes.spines["left"].set_visible(False)
        axes.set_yticks([])
        tallest = max(_draw_values(axes, k, values, edges, has_zeros) for k, (_, values) in enumerate(groups))
        axes.set_ylim(0, tallest * 1.02)
        above = axes.get_xaxis_transform()
        axes.text(1, 1.02, percent(tallest), transform=axes.transAxes, ha="right", fontsize=SMALL, color=MUTED)
        if labels:
            axes.set_xticks(range(len(labels)), labels)
        for _, (a, b) in [] if rails else list(bounds)[:1]:
            axes.axvspan(a, max(b, a + 0.004 * (high - low)), color=BAND, alpha=0.3, lw=0, zorder=0)
        for k, (name, pair) in enumerate(rails):
            y = 1.2 + 0.15 * k
            axes.plot(pair, [y, y], lw=7, color=BAND, alpha=0.6, transform=above, clip_on=False)
            axes.text(pair[0], y, f" {name}", transform=above, va="center", fontsize=SMALL, color=MUTED)
    words = "; ".join(f"{name}: {len(values)} values" for name, values in groups)
    label = f"{title} from {number_text(low)} to {number_text(high)} {unit}; {words}"
    return _chart(figure, f"{section}-{title}", title, unit, label)


def _drawable(values: F64) -> F64:
    """Return values without those that overflow on an axis: a damaged store may hold any number."""
    return np.where(np.abs(values) < 1 / _MOST, 0.0, np.clip(values, -_MOST, _MOST))


def is_wide(groups: Groups) -> bool:
    """Return whether values ask for a logarithmic axis."""
    values = np.concatenate([v for _, v in groups])
    return bool(values.size and values.min() > 0 and np.quantile(values, 0.99) > _SPREAD * np.median(values))


def _limits(values: F64, bounds: Sequence[tuple[float, float]], logarithmic: bool) -> tuple[float, float]:
    """Return both ends of the axis."""
    ends = [end for pair in bounds for end in pair if np.isfinite(end) and (end > 0 or not logarithmic)]
    low, high = min(float(values.min()), *ends, math.inf), max(float(values.max()), *ends, -math.inf)
    if logarithmic:
        return (low / 1.2, high * 1.2) if high > low else (low / 2, high * 2)
    if high > low and all(np.all(x == np.round(x)) for x in (values, low, high)):
        return low - 0.5, high + 0.5  # so that no whole number is at the edge of a bin
    return (low, high) if high > low else (low - (abs(low) * 0.1 or 0.5), high + (abs(high) * 0.1 or 0.5))


def bin_edges(values: F64, low: float, high: float, logarithmic: bool) -> F64:
    """Return the edges of the bins. Few values get fewer bins; bins of whole numbers cover equally many of them."""
    bins = max(6, min(_BINS, round(2 * math.sqrt(len(values)))))
    if logarithmic:
        return np.geomspace(low, high, bins + 1)
    if high - low < 2 or np.any(values != np.round(values)):
        return np.linspace(low, high, bins + 1)
    width = 1 if high - low <= _BINS else math.ceil((high - low) / bins)
    return np.asarray(low + width * np.arange(math.ceil((high - low) / width) + 1.0))


def _draw_values(axes: Axes, k: int, values: F64, edges: F64, has_zeros: bool) -> float:
    """Draw the fraction of a split's values in each bin, and that of its zeros; return the largest fraction."""
    kept, total = (values[values > 0] if has_zeros else values), max(len(values), 1)
    fractions = np.histogram(np.clip(kept, edges[0], edges[-1]), edges)[0] / total
    colour = split_colour(k)
    axes.stairs(fractions, edges, color=colour, lw=1.1, zorder=3)
    if k == 0:
        axes.stairs(fractions, edges, color=colour, fill=True, alpha=0.22, zorder=2)
    if not has_zeros:
        return float(fractions.max())
    step = (edges[-1] / edges[0]) ** 0.03
    zero = edges[0] / step**4
    axes.set_xlim(zero / step**2, edges[-1])
    axes.set_xticks([tick for tick in axes.get_xticks() if edges[0] <= tick <= edges[-1]])
    at_zero = 1 - len(kept) / total
    axes.bar(zero * step ** (0.8 * (k - 1)), at_zero, width=0.6 * zero * (step - 1), color=colour, alpha=0.6)
    if k == 0:
        axes.text(zero, -0.045, "0", transform=axes.get_xaxis_transform(), ha="center", va="top")
    return max(float(fractions.max()), at_zero)


# --- bars, boxes, matrices, directions ----------------------------------------------------------------------


def _rows(axes: Axes, rows: Sequence[tuple[str, Any, Sequence[tuple[str, Any]]]]) -> list[tuple[float, Any, Any]]:
    """Name a row for each split of each class, and return its y, colour and value."""
    y, named, out = 0.0, [], []
    for name, colour, splits in rows:
        axes.text(
            -0.13, y + (len(splits) - 1) / 2, name, transform=axes.get_yaxis_transform(), ha="right", va="center"
        )
        for split, value in splits:
            named.append((y, split))
            out.append((y, colour, value))
            y += 1
        y += 0.7
    axes.set_ylim(y - 1.0, -0.8)
    axes.set_yticks([at for at, _ in named], [split for _, split in named], fontsize=SMALL, color=MUTED)
    axes.tick_params(axis="y", length=0)
    axes.spines["left"].set_visible(False)
    axes.grid(axis="x")
    return out


def _height(rows: Sequence[tuple[str, Any, Sequence[tuple[str, Any]]]]) -> float:
    """Return the height in points of a panel with these rows."""
    return _ROW * sum(len(splits) + 0.7 for *_, splits in rows)


def balance(rows: Sequence[tuple[str, Any, Sequence[tuple[str, tuple[int, int | None, int]]]]]) -> Markup:
    """Return bars of how often each class is in the pixels, with a mark at how often it was planned.

    Parameters
    ----------
    rows
        Name and colour of each class, and for each split its name and the realised samples, the planned samples or
        None, and the samples of the split.
    """
    with panels("", (1, 1), (430.0, _height(rows))) as (figure, (axes,)):
        for y, colour, (realised, planned, samples) in _rows(axes, rows):
            axes.barh(y, realised / (samples or 1), height=0.72, color=colour, edgecolor=MUTED, lw=0.6, zorder=3)
            text = grouped_digits(realised)
            if planned is not None:
                x = planned / (samples or 1)
                axes.plot([x, x], [y - 0.48, y + 0.48], color=INK, lw=1.6, zorder=4)
                text += "" if planned == realised else f" of {grouped_digits(planned)}"
            axes.text(1.02, y, text, transform=axes.get_yaxis_transform(), va="center", fontsize=SMALL)
        axes.set_xlim(0, 1)
        axes.set_xticks(np.linspace(0, 1, 5), [percent(f) for f in np.linspace(0, 1, 5)])
    return inline_svg(svg_text(figure), "balance", "Classes by split, planned and realised")


def boxes(name: str, rows: Sequence[tuple[str, Any, Sequence[tuple[str, F64]]]], low: float) -> Markup:
    """Return the distributions of fractions on a logarithmic axis from `low` to 1, one box for each split.

    A box holds the middle half, its line nine tenths, its mark the median; few values are drawn as dots.
    """
    with panels("", (1, 1), (430.0, _height(rows))) as (figure, (axes,)):
        axes.set_xscale("log")
        axes.set_xlim(low, 1)
        for y, colour, given in _rows(axes, rows):
            values = np.maximum(given, low)
            axes.text(1.02, y, grouped_digits(len(values)), transform=axes.get_yaxis_transform(), va="center")
            if len(values) < _FEW:
                axes.plot(
                    values, np.full(len(values), y), "o", ms=4, color=colour, mec=MUTED, mew=0.6, clip_on=False
                )
                continue
            whisker, box = np.quantile(values, (0.05, 0.95)), np.quantile(values, (0.25, 0.5, 0.75))
            axes.plot(whisker, [y, y], color=MUTED, lw=1)
            width = max(box[2] - box[0], 0.004 * box[0])
            axes.barh(y, width, left=box[0], height=0.6, color=colour, edgecolor=MUTED, lw=0.6, zorder=3)
            axes.plot([box[1], box[1]], [y - 0.4, y + 0.4], color=INK, lw=1.6, zorder=4)
        powers = 10.0 ** np.arange(round(math.log10(low)), 1)
        axes.set_xticks(powers, [percent(p) for p in powers])
        axes.minorticks_off()
    return inline_svg(svg_text(figure), name, "Areas of the masks by class and split")


def matrix(title: str, short: Sequence[str], counts: NDArray[np.int64], samples: int) -> Markup:
    """Return how often two classes occur together, as a matrix of counts whose shade is the fraction of samples."""
    texts = [[grouped_digits(n) if n < 10_000 else f"{n / 1000:.0f}k" for n in row] for row in counts.tolist()]
    with panels("", (1, 1), (24.0 * len(short), 24.0 * len(short))) as (figure, (axes,)):
        draw_cells(axes, counts / (samples or 1), 1.0, texts, short)
        axes.set_xticks(np.arange(len(short)) + 0.5, short)
        axes.xaxis.tick_top()
    label = f"Co-occurrence of the classes, {title}"
    return _chart(figure, f"together-{title}", f"{title}, {grouped_digits(samples)} samples", "", label)


def directions(title: str, longitudes: str, groups: Sequence[tuple[str, tuple[F64, F64]]]) -> Markup:
    """Return directions on a map of the whole sphere in equal areas (Mollweide).

    Parameters
    ----------
    title
        Text above it.
    longitudes
        What the longitudes are, for the axis.
    groups
        Name, and longitudes and latitudes in degrees, of each split.
    """
    with panels("", (1, 1), (300.0, 150.0), subplot_kw={"projection": "mollweide"}) as (figure, (axes,)):
        for k, (_, angles) in enumerate(groups):
            axes.plot(*np.radians(angles), "o", ms=3.2, mew=0, color=split_colour(k), alpha=0.75)
        axes.grid()
        axes.set_xlabel(longitudes)
        axes.tick_params(labelsize=SMALL, labelcolor=MUTED)
    words = ", ".join(f"{name} {len(angles[0])}" for name, angles in groups)
    return _chart(figure, f"sun-{title}", title, "", f"{title}: {words} directions")


def legend(names: Sequence[str]) -> list[tuple[str, str]]:
    """Return name and colour of each split, as the page's theme has it."""
    return [(name, f"var(--{THEMED[split_colour(k)]})") for k, name in enumerate(names)]
