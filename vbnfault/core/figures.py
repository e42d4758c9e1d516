"""Draw the figures of pages in one style, with panels of one size, and put them into the pages.

All sizes are in points (1/72 inch). Matplotlib's constrained layout makes room for labels; the figure grows until
its panels have the size that was asked for, so no label is cut or covers another. The colours are those of Okabe
and Ito (2008), which people with a colour vision deficiency can tell apart.

References
----------
M. Okabe, K. Ito, "Color Universal Design (CUD)", 2008, https://jfly.uni-koeln.de/color/.
"""

from __future__ import annotations

import contextlib
import io
import math
import re
import textwrap
import zlib
from collections.abc import Iterator, Sequence
from typing import Any

import matplotlib
import numpy as np
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.ticker import FixedLocator, FuncFormatter, LogLocator, MaxNLocator, NullFormatter, NullLocator
from numpy.typing import NDArray

from .html_page import number_text, power_of_ten, with_minus

# The colours that a page replaces by those of its light or dark theme.
INK, MUTED, GRID, BAND = "#1b1f24", "#5b6570", "#dfe3e7", "#c9ced4"
BLUE, VERMILLION, GREEN, PURPLE, SKY, ORANGE = "#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9", "#e69f00"
SERIES_COLOURS = (BLUE, ORANGE, GREEN, PURPLE, SKY, VERMILLION)
SERIES_MARKERS = ("o", "s", "^", "D", "v", "P")
# colour → variable of the page's style
THEMED = {
    INK: "ink",
    MUTED: "muted",
    GRID: "grid",
    BAND: "band",
    BLUE: "blue",
    VERMILLION: "vermillion",
    GREEN: "green",
    PURPLE: "purple",
    SKY: "sky",
    ORANGE: "orange",
    "#ffffff": "paper",
}
_HEAT = LinearSegmentedColormap.from_list("heat", ["#f3f6f9", "#8fc1e0", BLUE, "#00304d"])
_ON_LIGHT, _ON_DARK = "#101418", "#fdfdfd"  # of text on a coloured cell, in both themes

SMALL = 7.0  # points
_TEXT, _TITLE = 8.0, 9.5
_LETTER = 4.6  # mean width of a letter
_LEAST_SHRUNK = 0.78  # a figure wider than `_NARROW` shrinks to this fraction on a small screen, and then scrolls
_NARROW = 340.0
_DPI = 160

_STYLE: Any = {
    "font.family": ["DejaVu Sans"],
    "font.size": _TEXT,
    "text.color": INK,
    "axes.edgecolor": MUTED,
    "axes.facecolor": "none",
    "axes.labelcolor": INK,
    "axes.labelsize": _TEXT,
    "axes.linewidth": 0.7,
    "axes.spines.right": False,
    "axes.spines.top": False,
    "axes.titlesize": _TEXT,
    "axes.axisbelow": True,
    "figure.facecolor": "white",
    "grid.color": GRID,
    "grid.linewidth": 0.6,
    "legend.fontsize": _TEXT,
    "legend.frameon": False,
    "lines.solid_capstyle": "butt",
    "svg.fonttype": "none",
    "svg.hashsalt": "vbnfault",
    "xtick.color": MUTED,
    "xtick.labelcolor": INK,
    "xtick.labelsize": _TEXT,
    "xtick.major.size": 2.5,
    "xtick.major.pad": 2,
    "ytick.color": MUTED,
    "ytick.labelcolor": INK,
    "ytick.labelsize": _TEXT,
    "ytick.major.size": 2.5,
    "ytick.major.pad": 2,
}


# ------------------------------------------------------------------------------------ panels


@contextlib.contextmanager
def panels(
    title: str,
    grid: tuple[int, int],
    panel: tuple[float, float],
    *,
    legend: Sequence[Any] = (),
    heads: Sequence[str] = (),
    **of_axes: Any,
) -> Iterator[tuple[Figure, list[Axes]]]:
    """Give a figure and its panels row by row to draw in; at the end of the block, the figure has its final size.

    The style holds within the block only; nothing global stays changed.

    Parameters
    ----------
    title
        Title above the legend; empty for none.
    grid
        Number of rows and columns.
    panel
        Width and height of a panel in points.
    legend
        Handles of the legend.
    heads
        Titles of the columns.
    **of_axes
        Further keywords of `Figure.subplots`.
    """
    rows, columns = grid
    with matplotlib.rc_context(_STYLE):
        roomy = columns * (panel[0] + 120) + 300, rows * (panel[1] + 160) + 300  # else nothing is laid out at all
        layout = ConstrainedLayoutEngine(w_pad=0.08)
        figure = Figure(figsize=(roomy[0] / 72, roomy[1] / 72), layout=layout)
        FigureCanvasAgg(figure)
        axes = list(figure.subplots(rows, columns, squeeze=False, **of_axes).flat)
        for one, head in zip(axes, heads, strict=False):
            one.set_title(head)
        if title or legend:
            entry = 30 + _LETTER * max((len(str(handle.get_label())) for handle in legend), default=0)
            figure.legend(
                handles=legend,
                title=title,
                loc="outside upper left",
                alignment="left",
                title_fontproperties={"weight": "bold", "size": _TITLE},
                ncols=max(1, min(len(legend), int((columns * panel[0] + 100) / entry))),
                borderpad=0.1,
                borderaxespad=0.2,
                columnspacing=1.2,
                handlelength=1.8,
                handletextpad=0.5,
            )
        yield figure, axes
        _fit(figure, axes[0], grid, panel)


@contextlib.contextmanager
def plain_panel(
    size: tuple[float, float], top: float = 0.0, *, bottom: float = 16.0
) -> Iterator[tuple[Figure, Axes]]:
    """Give a figure and its one panel, whose labels are short, in the style of all figures; all sizes in points.

    `size`: width and height of the panel; `top`: room above it.
    """
    width, height = size[0] + 16, size[1] + bottom + top + 2
    with matplotlib.rc_context(_STYLE):
        figure = Figure(figsize=(width / 72, height / 72))
        yield figure, figure.add_axes((8 / width, bottom / height, size[0] / width, size[1] / height))


def _fit(figure: Figure, one: Axes, grid: tuple[int, int], panel: tuple[float, float]) -> None:
    """Grow or shrink a figure until its panels have their size, and keep the layout."""
    engine, points = figure.get_layout_engine(), 72 / figure.dpi
    assert engine is not None
    for _ in range(4):
        engine.execute(figure)
        box = one.get_window_extent()
        missing = np.asarray(panel) - np.asarray([box.width, box.height]) * points
        wide = max((legend.get_window_extent().width * points + 8 for legend in figure.legends), default=0.0)
        width, height = figure.get_size_inches() * 72 + missing * (grid[1], grid[0])
        missing[0] = max(width, wide) - figure.get_figwidth() * 72
        if np.abs(missing).max() < 1:
            break
        figure.set_size_inches(max(width, wide) / 72, height / 72)
    figure.set_layout_engine("none")


def write_message(axes: Axes, text: str) -> None:
    """Write a text in the middle of a panel that has nothing to show."""
    axes.text(0.5, 0.5, text, transform=axes.transAxes, ha="center", va="center", color=MUTED, style="italic")


def label_rows(axes: Sequence[Axes], labels: Sequence[str], *, separate_last: bool = False) -> None:
    """Give panels side by side the same rows, named at the left one; the first row is at the top."""
    for k, one in enumerate(axes):
        one.set_ylim(len(labels) - 0.4, -0.6)
        one.set_yticks(range(len(labels)), labels if k == 0 else [""] * len(labels), linespacing=1.0)
        one.tick_params(axis="y", length=0)
        one.spines["left"].set_visible(False)
        one.grid(axis="x")
        if separate_last:
            one.axhline(len(labels) - 1.5, color=MUTED, lw=0.6, ls=(0, (1, 2)))


def row_height(labels: Sequence[str]) -> float:
    """Return the height of the rows that labels of several lines need, in points."""
    return max(17.0, 9.5 * max((label.count("\n") + 1 for label in labels), default=1) + 5.0)


def draw_cells(
    axes: Axes, values: NDArray[np.float64], top: float, texts: Sequence[Sequence[str]], labels: Sequence[str]
) -> Any:
    """Draw a matrix as coloured cells with their texts and named rows; return what a colour scale needs.

    `top`: the value of the darkest colour.
    """
    mesh = axes.pcolormesh(
        np.clip(values, 0, None), cmap=_HEAT, vmin=0, vmax=top, edgecolors="white", linewidth=0.8
    )
    axes.set_ylim(len(values), 0)
    axes.spines[:].set_visible(False)
    axes.tick_params(length=0, pad=3)
    axes.set_yticks(np.arange(len(labels)) + 0.5, labels, linespacing=1.0)
    for (i, j), value in np.ndenumerate(values):
        colour = MUTED if not np.isfinite(value) else _ON_DARK if value / top > 0.55 else _ON_LIGHT
        axes.text(j + 0.5, i + 0.52, texts[i][j], ha="center", va="center", fontsize=SMALL, color=colour)
    return mesh


# ------------------------------------------------------------------------------------ text and axes


class _AtDots(textwrap.TextWrapper):
    wordsep_re = re.compile(r"(?<=[._ /:-])")


def wrapped(text: str, length: int = 32, lines: int = 3) -> str:
    """Return a text broken at dots, underscores and blanks into lines of about `length` characters.

    Of a text that is too long, the end is kept, because the end of a key says most.
    """
    most = length * lines
    return "\n".join(_AtDots(length).wrap(text if len(text) <= most else "…" + text[1 - most :]))


def axis_exponent(values: Any) -> int:
    """Return the power of ten, a multiple of 3, by which values are divided on an axis; 0 for ordinary numbers."""
    finite = np.abs(np.asarray(values, dtype=float))
    largest = float(finite[np.isfinite(finite)].max(initial=0.0))
    return 0 if largest == 0 or 0.01 <= largest < 10000 else 3 * math.floor(math.log10(largest) / 3)


def with_unit(name: str, unit: str, exponent: int = 0, length: int = 1000) -> str:
    """Return the label of an axis, name and unit, `energy / 10⁶ e`, in lines of about `length` characters."""
    unit = "" if unit in ("", "1") else unit
    if exponent:
        tail = f" / {power_of_ten(exponent)}{' ' + unit if unit else ''}"
    else:
        tail = " (no unit)" if not unit else f" / ({unit})" if "/" in unit else f" / {unit}"
    lines = wrapped(name, length)
    fits = len(lines.rsplit("\n", 1)[-1] + tail) <= length  # the unit is not broken
    return lines + (tail if fits else "\n" + tail.strip())


def set_log(axis: Any, low: float, high: float, most: int = 4) -> None:
    """Make an axis logarithmic, with a few plain ticks."""
    decades = math.log10(high / low)
    (axis.axes.set_xscale if axis.axis_name == "x" else axis.axes.set_yscale)("log")
    if decades < 1.0:
        axis.set_major_locator(
            FixedLocator([t for t in MaxNLocator(most).tick_values(low, high) if low <= t <= high])
        )
    else:
        subs, more = ((1.0, 3.0), 3) if decades < 2.0 else ((1.0,), 1)
        axis.set_major_locator(LogLocator(subs=subs, numticks=most + more))
    axis.set_major_formatter(FuncFormatter(lambda value, _: number_text(value, 4)))
    axis.set_minor_formatter(NullFormatter())
    axis.set_minor_locator(NullLocator())


def set_linear(axis: Any, most: int = 4) -> None:
    """Give a linear axis a few ticks, written without a common offset."""
    axis.set_major_locator(MaxNLocator(most, steps=[1, 2, 2.5, 5, 10]))
    axis.set_major_formatter(FuncFormatter(lambda value, _: with_minus(f"{value:.6g}")))


# ------------------------------------------------------------------------------------ figures in pages


def svg_text(figure: Figure, **options: Any) -> str:
    """Return a figure as SVG, the same text at each run; `options` of matplotlib's `savefig`."""
    file = io.StringIO()
    with matplotlib.rc_context({"svg.hashsalt": "vbnfault", "svg.fonttype": "none", **options.pop("rc", {})}):
        nothing = dict.fromkeys(("Date", "Creator", "Format", "Type"))
        figure.savefig(file, format="svg", transparent=True, metadata=nothing, **options)
    return file.getvalue()


def png_bytes(figure: Figure) -> bytes:
    """Return a figure as PNG, the same bytes at each run."""
    file = io.BytesIO()
    figure.savefig(file, format="png", dpi=_DPI, metadata={"Software": None})
    return file.getvalue()


def inline_svg(text: str, name: str, label: str) -> Markup:
    """Return an SVG file of matplotlib as an element of a page.

    Colours become those of the page's theme, and all that refers to other files is left out.

    Parameters
    ----------
    name
        What no other figure of the page has: it makes identifiers unique.
    label
        What the figure shows, for screen readers.
    """
    text = text[text.index("<svg") :]
    text = re.sub(r"<metadata>.*?</metadata>|<!--.*?-->|<style.*?</style>", "", text, flags=re.DOTALL)
    text = re.sub(r'\s(?:xmlns(?::xlink)?|version)="[^"]*"', "", text).replace("xlink:href", "href")
    used = set(re.findall(r'(?:url\(#|href="#)([^")]+)', text))
    prefix = re.sub(r"[^A-Za-z0-9-]", "-", name)
    text = re.sub(r'\sid="([^"]*)"', lambda m: f' id="{prefix}-{m[1]}"' if m[1] in used else "", text)
    text = re.sub(r'(url\(#|href="#)', rf"\g<1>{prefix}-", text)
    for colour, variable in THEMED.items():
        text = text.replace(f": {colour}", f": var(--{variable})")
    text = re.sub(r"base64,[^\"]*", lambda match: re.sub(r"\s", "", match[0]), text)
    text = re.sub(r"<defs>\s*</defs>", "", re.sub(r"\s+", " ", text)).strip()
    width = re.search(r'width="([\d.]+)pt"', text)
    about = Markup('<svg role="img" aria-label="{}"').format(label)
    if width and float(width[1]) > _NARROW:
        about += Markup(' style="min-width:{:.0f}pt"').format(_LEAST_SHRUNK * float(width[1]))
    return about + Markup(text.removeprefix("<svg"))


def formula(tex: str) -> Markup:
    """Return a formula in matplotlib's TeX as an element of a page."""
    with matplotlib.rc_context({**_STYLE, "mathtext.fontset": "cm"}):
        figure = Figure()
        figure.text(0, 0, f"${tex}$", fontsize=12)
        text = svg_text(figure, bbox_inches="tight", pad_inches=0.02, rc={"svg.fonttype": "path"})
    return inline_svg(text, f"formula-{zlib.crc32(tex.encode())}", tex)
