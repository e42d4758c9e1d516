"""Lay out figures of panels whose labels have lengths that only the data know.

All sizes are in points (1/72 inch). The width of a label is measured and the figure grows with it, so that no label
is cut or overlaps another. The style is set within `styled` only; nothing global stays changed.

References
----------
M. Okabe, K. Ito, "Color Universal Design (CUD)", 2008, https://jfly.uni-koeln.de/color/.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache, wraps
from typing import Any, ParamSpec, TypeVar

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.font_manager import FontProperties
from matplotlib.patches import Patch
from matplotlib.textpath import text_to_path
from matplotlib.ticker import FixedLocator, FuncFormatter, LogLocator, MaxNLocator, NullFormatter, NullLocator

_P = ParamSpec("_P")
_R = TypeVar("_R")

# The colours that the page replaces by those of its light or dark theme.
INK, MUTED, GRID, BAND = "#1b1f24", "#5b6570", "#dfe3e7", "#c9ced4"
BLUE, VERMILLION, GREEN, PURPLE, SKY, ORANGE = "#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9", "#e69f00"
MODEL_COLOURS = (BLUE, ORANGE, GREEN, PURPLE, SKY, VERMILLION)
MODEL_MARKERS = ("o", "s", "^", "D", "v", "P")

TEXT = 8.0  # points
SMALL = 7.0
LINE = 9.5
FAMILY = "DejaVu Sans"
DPI = 160
LABEL = 32  # characters of a factor's key on one line
SUPERSCRIPT = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")

STYLE: Any = {
    "font.family": [FAMILY],
    "font.size": TEXT,
    "text.color": INK,
    "axes.edgecolor": MUTED,
    "axes.facecolor": "none",
    "axes.labelcolor": INK,
    "axes.labelsize": TEXT,
    "axes.linewidth": 0.7,
    "axes.spines.right": False,
    "axes.spines.top": False,
    "axes.titlesize": TEXT,
    "axes.unicode_minus": True,
    "figure.facecolor": "white",
    "grid.color": GRID,
    "grid.linewidth": 0.6,
    "hatch.color": MUTED,
    "hatch.linewidth": 0.6,
    "legend.fontsize": TEXT,
    "legend.frameon": False,
    "lines.solid_capstyle": "butt",
    "path.simplify": True,
    "savefig.facecolor": "auto",
    "svg.fonttype": "none",
    "svg.hashsalt": "vbnfault",
    "text.usetex": False,
    "xtick.color": MUTED,
    "xtick.labelcolor": INK,
    "xtick.labelsize": TEXT,
    "ytick.color": MUTED,
    "ytick.labelcolor": INK,
    "ytick.labelsize": TEXT,
}


def styled(draw: Callable[_P, _R]) -> Callable[_P, _R]:
    """Run a function that draws with the style of all figures, and restore what it was."""

    @wraps(draw)
    def within(*args: _P.args, **kwargs: _P.kwargs) -> _R:
        with matplotlib.rc_context(STYLE):
            return draw(*args, **kwargs)

    return within


# ------------------------------------------------------------------------------------ text and axes


@cache
def text_width(text: str, size: float = TEXT) -> float:
    """Return the width of a text in points; the widest line of several."""
    font = FontProperties(family=FAMILY, size=size)
    widths = (text_to_path.get_text_width_height_descent(line, font, False)[0] for line in text.split("\n"))
    return max(map(float, widths))


def wrapped(text: str, length: int = LABEL, lines: int = 3) -> str:
    """Return a text broken at dots, underscores and blanks into lines of at most `length` characters."""
    parts = [part for part in re.split(r"(?<=[._ /:-])", text) if part]
    rows = [""]
    for part in parts:
        while len(part) > length:  # a word longer than a line
            rows.append(part[:length])
            part = part[length:]
        if len(rows[-1]) + len(part.rstrip()) > length:
            rows.append("")
        rows[-1] += part
    rows = [row.rstrip(" ") for row in rows if row.strip()]
    if len(rows) > lines:
        tail = ""
        while parts and len(parts[-1] + tail) < length:  # the end of a key says most
            tail = parts.pop() + tail
        rows = [*rows[: lines - 1], "…" + (tail or text[1 - length :])]
    return "\n".join(rows)


def power(exponent: int) -> str:
    """Return a power of ten as text: 10⁶."""
    return "10" + str(exponent).translate(SUPERSCRIPT)


def axis_exponent(values: Any) -> int:
    """Return the power of ten, a multiple of 3, by which values are divided on an axis; 0 for ordinary numbers."""
    finite = np.abs(np.asarray(values, dtype=float))
    finite = finite[np.isfinite(finite)]
    largest = float(finite.max()) if finite.size else 0.0
    if largest == 0 or 0.01 <= largest < 10000:
        return 0
    return 3 * math.floor(math.log10(largest) / 3)


def with_unit(name: str, unit: str, exponent: int = 0) -> str:
    """Return the label of an axis: name and unit, `energy / 10⁶ e`."""
    unit = "" if unit in ("", "1") else unit
    if exponent:
        return f"{name} / {power(exponent)}{' ' + unit if unit else ''}"
    if not unit:
        return f"{name} (no unit)"
    return f"{name} / ({unit})" if "/" in unit else f"{name} / {unit}"


def axis_label(name: str, unit: str, exponent: int, length: int) -> str:
    """Return the label of an axis in lines of at most `length` characters; the unit is not broken."""
    wraps, whole = wrapped(name, length), with_unit(name, unit, exponent)
    tail = whole.removeprefix(name)
    last = wraps.rsplit("\n", 1)[-1]
    return wraps + (tail if len(last + tail) <= length else "\n" + tail.strip())


def log_text(value: float, _position: object = None) -> str:
    """Return the label of a tick of a logarithmic axis."""
    if value <= 0:
        return ""
    exponent = math.floor(math.log10(value) + 1e-9)
    if -3 <= exponent <= 3:
        return f"{value:.4g}"
    leading = value / 10.0**exponent
    return power(exponent) if abs(leading - 1) < 1e-6 else f"{leading:.2g}·{power(exponent)}"


def set_log(axis: Any, low: float, high: float, most: int = 4) -> None:
    """Make an axis logarithmic, with a few plain ticks."""
    decades = math.log10(high / low)
    (axis.axes.set_xscale if axis.axis_name == "x" else axis.axes.set_yscale)("log")
    if decades < 1.0:
        ticks = [tick for tick in MaxNLocator(most).tick_values(low, high) if low <= tick <= high and tick > 0]
        axis.set_major_locator(FixedLocator(ticks))
    elif decades < 2.0:
        axis.set_major_locator(LogLocator(subs=(1.0, 3.0), numticks=most + 3))
    else:
        axis.set_major_locator(LogLocator(subs=(1.0,), numticks=most + 1))
    axis.set_major_formatter(FuncFormatter(log_text))
    axis.set_minor_formatter(NullFormatter())
    axis.set_minor_locator(NullLocator())


def set_linear(axis: Any, most: int = 4) -> None:
    """Give a linear axis a few ticks, written without a common offset."""
    axis.set_major_locator(MaxNLocator(most, steps=[1, 2, 2.5, 5, 10]))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:.6g}".replace("-", "\N{MINUS SIGN}")))


# ------------------------------------------------------------------------------------ sheets of panels


@dataclass(frozen=True, kw_only=True)
class Margins:
    """Space in points around the panels of a sheet and between them."""

    left: float
    bottom: float = 34.0
    top: float = 6.0  # between the panels and the legend
    right: float = 12.0
    between_columns: float = 14.0
    between_rows: float = 0.0


def _draw_legend(
    figure: Figure, legend: Sequence[Any], rows: Sequence[Sequence[int]], widths: Sequence[float]
) -> None:
    """Draw the entries of a legend line by line below the title; `rows` has the entries of each line."""
    width, height = figure.get_size_inches() * 72
    for line, members in enumerate(rows):
        x = 6.0
        for k in members:
            y = 1 - (20 + 13.0 * line) / height
            figure.legend(
                handles=[legend[k]],
                loc="upper left",
                bbox_to_anchor=(x / width, y),
                borderaxespad=0,
                borderpad=0.1,
                handlelength=1.8,
                handletextpad=0.5,
            )
            x += widths[k]


def sheet(
    title: str,
    grid: tuple[int, int],
    panel: tuple[float, float],
    margins: Margins,
    *,
    legend: Sequence[Any] = (),
    heads: Sequence[str] = (),
) -> tuple[Figure, list[Axes]]:
    """Return a figure with a title, a legend above the panels, and its panels row by row.

    Parameters
    ----------
    grid
        Number of rows and columns.
    panel
        Width and height of a panel in points.
    legend
        Handles of the legend.
    heads
        Titles of the columns.
    """
    rows, columns = grid
    panels_width = columns * panel[0] + (columns - 1) * margins.between_columns
    width = margins.left + panels_width + margins.right
    names = [str(handle.get_label()) for handle in legend]
    widths = [26 + text_width(name) + 10 for name in names]
    width = max(width, text_width(title, 9.5) + 16, max(widths, default=0.0) + 12)
    legend_rows: list[list[int]] = [[]]
    for k, needed in enumerate(widths):  # as many entries on a line as fit
        if legend_rows[-1] and sum(widths[i] for i in legend_rows[-1]) + needed > width - 8:
            legend_rows.append([])
        legend_rows[-1].append(k)
    legend_height = 13.0 * len(legend_rows) if legend else 0.0
    head_height = 15.0 if any(heads) else 0.0
    above = 20.0 + legend_height + margins.top + head_height
    height = above + rows * panel[1] + (rows - 1) * margins.between_rows + margins.bottom
    figure = Figure(figsize=(width / 72, height / 72))
    FigureCanvasAgg(figure)
    figure.text(6 / width, 1 - 6 / height, title, fontsize=9.5, fontweight="bold", va="top", ha="left")
    _draw_legend(figure, legend, legend_rows, widths)
    axes = []
    for k in range(rows * columns):
        row, column = divmod(k, columns)
        x = margins.left + column * (panel[0] + margins.between_columns)
        y = height - above - (row + 1) * panel[1] - row * margins.between_rows
        one = figure.add_axes((x / width, y / height, panel[0] / width, panel[1] / height))
        one.tick_params(length=2.5, width=0.7, pad=2)
        axes.append(one)
    for one, head in zip(axes, heads, strict=False):
        one.set_title(head, pad=4)
    return figure, axes


def write_message(axes: Axes, text: str) -> None:
    """Write a text in the middle of a panel that has nothing to show."""
    axes.text(0.5, 0.5, text, transform=axes.transAxes, ha="center", va="center", color=MUTED, style="italic")


def label_rows(axes: Sequence[Axes], labels: Sequence[str], separate_last: bool) -> None:
    """Give panels side by side the same rows, named at the left one; the first row is at the top."""
    for k, one in enumerate(axes):
        one.set_ylim(len(labels) - 0.4, -0.6)
        one.set_yticks(range(len(labels)), labels if k == 0 else [""] * len(labels), linespacing=1.0)
        one.tick_params(axis="y", length=0)
        one.spines["left"].set_visible(False)
        one.grid(axis="x", zorder=0)
        one.set_axisbelow(True)
        if separate_last:
            one.axhline(len(labels) - 1.5, color=MUTED, lw=0.6, ls=(0, (1, 2)))


def rows_of(labels: Sequence[str]) -> tuple[float, float]:
    """Return the width of the labels of rows and the height of one row, in points."""
    lines = max((label.count("\n") + 1 for label in labels), default=1)
    return max((text_width(label) for label in labels), default=0.0) + 14.0, max(17.0, LINE * lines + 5.0)


def panel_width(models: int) -> float:
    """Return the width in points of one of several panels side by side."""
    return 210.0 if models == 1 else 165.0 if models == 2 else 140.0


NOISE = Patch(facecolor=BAND, alpha=0.75, lw=0, label="noise floor")
