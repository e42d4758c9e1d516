"""Draw charts as SVG, in the colours and letters of the page that holds them."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...core.html_page import escaped, grouped_digits, with_minus

F64 = NDArray[np.float64]

# CSS colours of the splits, in their order; a further split is drawn in the colour of text.
SPLIT_COLOURS = ("var(--blue)", "var(--vermillion)", "var(--green)")
_BINS = 24
_FEW = 6  # a group of fewer values is drawn as dots


def split_colour(k: int) -> str:
    """Return the CSS colour of the split number `k`."""
    return SPLIT_COLOURS[k] if k < len(SPLIT_COLOURS) else "var(--ink)"


def legend(names: Sequence[str]) -> str:
    """Return the legend of the splits."""
    items = (f'<li><i style="background:{split_colour(k)}"></i>{escaped(n)}</li>' for k, n in enumerate(names))
    return f'<ul class="legend">{"".join(items)}</ul>'


def number(value: float) -> str:
    """Return a number as short text with a real minus sign."""
    if value == 0:
        return "0"
    text = f"{value:.3g}"
    if 1000 <= abs(float(text)) < 100_000:
        text = f"{float(text):.0f}"  # beside ticks such as 500, 1000 is easier to read than a power of ten
    if "e" in text:
        mantissa, _, power = text.partition("e")
        raised = str(int(power)).translate(str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"))
        return with_minus(f"10{raised}" if mantissa == "1" else f"{mantissa}·10{raised}")
    return with_minus(text)


def ticks(low: float, high: float, most: int = 4) -> list[float]:
    """Return at most about `most` round numbers from `low` to `high`."""
    if not high > low:
        return [low]
    step = 10 ** math.floor(math.log10((high - low) / most))
    step *= next(k for k in (1, 2, 2.5, 5, 10, 20) if (high - low) / (step * k) <= most)
    return [k * step for k in range(math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9) + 1)]


# --- histograms ---------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class Histogram:
    """Describe a histogram with one line for each split.

    Attributes
    ----------
    title, unit
        Text above it.
    groups
        Name and finite values of each split.
    bounds
        Name, low and high of the intervals in which the values were drawn.
    logarithmic
        Whether the axis is logarithmic. Values of 0 then stand in a bar of their own at the left.
    limits
        Ends of the axis; by default those of values and bounds.
    labels
        Names of the whole numbers from 0 on, where the values are the numbers of kinds.
    """

    title: str
    unit: str
    groups: Sequence[tuple[str, F64]]
    bounds: Sequence[tuple[str, tuple[float, float]]] = ()
    logarithmic: bool = False
    limits: tuple[float, float] | None = None
    labels: Sequence[str] = ()

    def markup(self) -> str:
        """Return the histogram as an element of the page."""
        unit = f" <span>/ {escaped(self.unit)}</span>" if self.unit not in ("", "1") else ""
        head = f"<figcaption>{escaped(self.title)}{unit}</figcaption>"
        return f'<figure class="chart">{head}{self._svg()}</figure>'

    def _svg(self) -> str:
        """Return the drawing."""
        rails = self._rails()
        top = 14.0 + 13.0 * len(rails)
        width, height, left, bottom = 320.0, 118.0 + top, 8.0, 24.0
        given = np.concatenate([values for _, values in self.groups] or [np.zeros(0)])
        if not given.size:
            return '<p class="none">no values</p>'
        if float(given.min()) == float(given.max()) and not self.bounds and not self.labels:
            return f'<p class="none">{number(float(given[0]))} {escaped(self.unit)} in all samples</p>'
        positive = given[given > 0]
        zeros = self.logarithmic and positive.size < given.size
        start = left + (34.0 if zeros else 0.0)
        low, high = self._limits(positive if self.logarithmic and positive.size else given)
        scale = _log if self.logarithmic else _plain

        def x(value: float) -> float:
            part = (scale(value) - scale(low)) / (scale(high) - scale(low))
            return start + float(np.clip(part, 0, 1)) * (width - 8 - start)

        base = height - bottom
        parts = self._drawn_bounds(x, top, base)
        edges = np.linspace(scale(low), scale(high), self._bins(given, low, high) + 1)
        shares = {}
        for k, (name, values) in enumerate(self.groups):
            kept = values[values > 0] if self.logarithmic else values
            counts = np.histogram(np.clip([scale(v) for v in kept], edges[0], edges[-1]), edges)[0]
            shares[k, name] = (counts / max(len(values), 1), 1 - len(kept) / max(len(values), 1), len(values))
        tallest = max(max(float(c.max(initial=0)), z if zeros else 0) for c, z, _ in shares.values()) or 1
        for (k, name), (counts, at_zero, n) in shares.items():
            colour, rise = split_colour(k), (base - top) / tallest
            points = " ".join(
                f"H{start + j / len(counts) * (width - 8 - start):.1f}V{base - c * rise:.1f}"
                f"H{start + (j + 1) / len(counts) * (width - 8 - start):.1f}"
                for j, c in enumerate(counts)
            )
            tip = f"<title>{escaped(name)}: {grouped_digits(n)} values</title>"
            fill = f"fill:{colour};fill-opacity:{0.22 if k == 0 else 0}"
            parts.append(
                f'<path d="M{start:.1f} {base}{points}V{base}" style="{fill};stroke:{colour}">{tip}</path>'
            )
            if zeros:
                y, at = base - at_zero * rise, left + 2 + 7 * k
                bar = f'x="{at}" y="{y:.1f}" width="6" height="{base - y:.1f}"'
                parts.append(f'<rect {bar} style="fill:{colour};fill-opacity:.55;stroke:none">{tip}</rect>')
        parts.append(f'<path class="axis" d="M{start - 2} {base}H{width - 8}"/>')
        if zeros:
            parts.append(f'<path class="axis" d="M{left} {base}H{left + 24}"/>')
            parts.append(f'<text x="{left + 12}" y="{height - 9}" text-anchor="middle">0</text>')
        if self.labels:
            parts += [_tick(x(k), base, escaped(name), width) for k, name in enumerate(self.labels)]
        else:
            parts += [_tick(x(v), base, number(v), width) for v in self._ticks(low, high)]
        parts.append(
            f'<text class="faint" x="{width - 8}" y="{top - 5}" text-anchor="end">{_percent(tallest)}</text>'
        )
        words = "; ".join(f"{name}: {n} values" for (_, name), (_, _, n) in shares.items())
        label = f"{self.title} from {number(low)} to {number(high)} {self.unit}; {words}"
        return svg(width, height, "".join(parts), label)

    def _limits(self, values: F64) -> tuple[float, float]:
        """Return both ends of the axis."""
        if self.limits is not None:
            return self.limits
        ends = [e for _, pair in self.bounds for e in pair if np.isfinite(e) and (e > 0 or not self.logarithmic)]
        low, high = min(float(values.min()), *ends, math.inf), max(float(values.max()), *ends, -math.inf)
        if self.logarithmic:
            return (low / 1.2, high * 1.2) if high > low > 0 else (max(low, 1e-12) / 2, max(high, 1e-12) * 2)
        return (low, high) if high > low else (low - (abs(low) * 0.1 or 0.5), high + (abs(high) * 0.1 or 0.5))

    def _bins(self, values: F64, low: float, high: float) -> int:
        """Return the number of bins: fewer for few values, and one for each of few whole numbers."""
        whole = not self.logarithmic and 2 <= high - low <= _BINS and bool(np.all(values == np.round(values)))
        return max(1, math.ceil(high - low)) if whole else max(6, min(_BINS, round(2 * math.sqrt(len(values)))))

    def _rails(self) -> list[tuple[str, tuple[float, float]]]:
        """Return the bounds that are drawn above the histogram, because they differ."""
        return list(self.bounds) if len({pair for _, pair in self.bounds}) > 1 else []

    def _ticks(self, low: float, high: float) -> list[float]:
        """Return the values at which the axis is marked."""
        if not self.logarithmic:
            return ticks(low, high)
        powers = range(math.ceil(math.log10(low) - 1e-9), math.floor(math.log10(high) + 1e-9) + 1)
        if len(powers) >= 2:
            return [10.0**p for p in powers][:: -(-len(powers) // 5)]
        marks = [m * 10.0**p for p in range(math.floor(math.log10(low)), powers.stop + 1) for m in (1, 2, 5)]
        return [m for m in marks if low <= m <= high] or [low]

    def _drawn_bounds(self, x: Callable[[float], float], top: float, base: float) -> list[str]:
        """Return one pair of bounds as a band behind the histogram, several as named bars above it."""
        rails, parts = self._rails(), []
        if not rails:
            for name, (low, high) in self.bounds[:1]:
                a, b = x(low), max(x(high), x(low) + 1.5)
                tip = f"<title>bounds {escaped(name)} {number(low)} to {number(high)}</title>"
                box = f'x="{a:.1f}" y="{top - 3}" width="{b - a:.1f}" height="{base - top + 3}"'
                parts.append(f'<rect class="bounds" {box}>{tip}</rect>')
                parts.append(f'<path class="bound" d="M{a:.1f} {top - 3}V{base}M{b:.1f} {top - 3}V{base}"/>')
            return parts
        for k, (name, (low, high)) in enumerate(rails):
            a, b, y = x(low), max(x(high), x(low) + 1.5), 1.0 + 13.0 * k
            tip = f"<title>bounds {escaped(name)} {number(low)} to {number(high)}</title>"
            parts.append(
                f'<rect class="bounds rail" x="{a:.1f}" y="{y}" width="{b - a:.1f}" height="11">{tip}</rect>'
            )
            anchor, at = ("start", a + 4) if b - a > 60 else ("start", b + 4) if b < 200 else ("end", a - 4)
            parts.append(
                f'<text class="faint" x="{at:.1f}" y="{y + 8.5}" text-anchor="{anchor}">{escaped(name)}</text>'
            )
        return parts


def _plain(value: float) -> float:
    """Return a value on a linear axis."""
    return value


def _log(value: float) -> float:
    """Return a value on a logarithmic axis."""
    return math.log10(max(value, 1e-300))


def _percent(fraction: float) -> str:
    """Return a fraction in per cent."""
    return (
        f"{100 * fraction:.0f}\N{NO-BREAK SPACE}%"
        if fraction >= 0.0095 or not fraction
        else f"{number(100 * fraction)}\N{NO-BREAK SPACE}%"
    )


def _tick(x: float, base: float, text: str, width: float) -> str:
    """Return a mark of an axis with its number."""
    anchor = "start" if x < 16 else "end" if x > width - 16 else "middle"
    mark = f'<path class="axis" d="M{x:.1f} {base}v3.5"/>'
    return f'{mark}<text x="{x:.1f}" y="{base + 15}" text-anchor="{anchor}">{text}</text>'


def svg(width: float, height: float, content: str, label: str, more: str = "") -> str:
    """Return a drawing as an element of the page, with a description for screen readers."""
    box = f'viewBox="0 0 {width:g} {height:g}" style="aspect-ratio:{width:g}/{height:g}"'
    return f'<svg {box} role="img" aria-label="{escaped(label)}"{more}>{content}</svg>'


# --- bars, boxes, matrices ----------------------------------------------------------------------------------


def balance(rows: Sequence[tuple[str, str, Sequence[tuple[str, int, int | None, int]]]]) -> str:
    """Return bars of how often each class is in the pixels, with a mark at how often it was planned.

    Parameters
    ----------
    rows
        Name and colour of each class, and for each split its name, the realised samples, the planned samples or
        None, and the samples of the split.
    """
    left, right, width, step, gap = 170.0, 110.0, 760.0, 15.0, 11.0
    room, y, parts = width - left - right, 20.0, []
    for fraction in (0, 0.25, 0.5, 0.75, 1):
        x = left + fraction * room
        parts.append(f'<path class="grid" d="M{x:.1f} 16V__BOTTOM__"/>')
        parts.append(f'<text class="faint" x="{x:.1f}" y="10" text-anchor="middle">{_percent(fraction)}</text>')
    for name, colour, splits in rows:
        words = name.replace("_", " ")
        middle = y + step * len(splits) / 2 + 4
        parts.append(f'<circle cx="7" cy="{middle - 4:.1f}" r="5" style="fill:{colour}" class="dot"/>')
        parts.append(f'<text class="name" x="18" y="{middle:.1f}">{escaped(words)}</text>')
        for split, realised, planned, samples in splits:
            part = realised / samples if samples else 0
            tip = f"{words}, {split}: {realised} of {samples} samples" + (
                f", {planned} planned" if planned is not None else ""
            )
            parts.append(
                f'<text class="faint" x="{left - 7}" y="{y + 10.5:.1f}" text-anchor="end">{escaped(split)}</text>'
            )
            bar = f'x="{left}" y="{y + 1.5:.1f}" width="{part * room:.1f}" height="{step - 4}"'
            parts.append(f'<rect class="bar" {bar} style="fill:{colour}"><title>{escaped(tip)}</title></rect>')
            text = grouped_digits(realised)
            if planned is not None:
                x = left + (planned / samples if samples else 0) * room
                parts.append(f'<path class="planned" d="M{x:.1f} {y - 0.5:.1f}v{step}"/>')
                text += "" if planned == realised else f" of {grouped_digits(planned)}"
            parts.append(f'<text x="{width - right + 8}" y="{y + 10.5:.1f}">{text}</text>')
            y += step
        y += gap
    return svg(
        width,
        y,
        "".join(parts).replace("__BOTTOM__", f"{y - gap + 2:.1f}"),
        "Classes by split, planned and realised",
    )


def boxes(rows: Sequence[tuple[str, str, Sequence[tuple[str, F64]]]], low: float) -> str:
    """Return the distributions of fractions on a logarithmic axis from `low` to 1, one box for each split.

    A box holds the middle half, its line nine tenths, its mark the median; few values are drawn as dots.
    """
    left, right, width, step, gap = 170.0, 60.0, 760.0, 14.0, 11.0
    room, y, parts = width - left - right, 20.0, []
    decades = -math.log10(low)

    def x(value: float) -> float:
        return left + float(np.clip((math.log10(max(value, low)) + decades) / decades, 0, 1)) * room

    for power in range(-round(decades), 1):
        parts.append(f'<path class="grid" d="M{x(10.0**power):.1f} 16V__BOTTOM__"/>')
        text = _percent(10.0**power)
        parts.append(f'<text class="faint" x="{x(10.0**power):.1f}" y="10" text-anchor="middle">{text}</text>')
    for name, colour, splits in rows:
        middle = y + step * len(splits) / 2 + 4
        parts.append(f'<circle cx="7" cy="{middle - 4:.1f}" r="5" style="fill:{colour}" class="dot"/>')
        parts.append(f'<text class="name" x="18" y="{middle:.1f}">{escaped(name.replace("_", " "))}</text>')
        for split, values in splits:
            at = y + step / 2
            parts.append(
                f'<text class="faint" x="{left - 7}" y="{at + 4:.1f}" text-anchor="end">{escaped(split)}</text>'
            )
            parts.append(f'<text x="{width - right + 8}" y="{at + 4:.1f}">{grouped_digits(len(values))}</text>')
            if len(values) < _FEW:
                parts += [
                    f'<circle cx="{x(v):.1f}" cy="{at:.1f}" r="3" style="fill:{colour}" class="dot"/>'
                    for v in values
                ]
            else:
                q05, q25, q50, q75, q95 = np.quantile(values, (0.05, 0.25, 0.5, 0.75, 0.95))
                tip = f"<title>median {_percent(q50)}, middle half {_percent(q25)} to {_percent(q75)}</title>"
                parts.append(f'<path class="whisker" d="M{x(q05):.1f} {at:.1f}H{x(q95):.1f}"/>')
                box = f'x="{x(q25):.1f}" y="{at - 4:.1f}" width="{max(x(q75) - x(q25), 1.5):.1f}" height="8" rx="1"'
                parts.append(f'<rect class="bar" {box} style="fill:{colour}">{tip}</rect>')
                parts.append(f'<path class="median" d="M{x(q50):.1f} {at - 5:.1f}v10"/>')
            y += step
        y += gap
    return svg(
        width,
        y,
        "".join(parts).replace("__BOTTOM__", f"{y - gap + 2:.1f}"),
        "Areas of the masks by class and split",
    )


def matrix(
    title: str, faults: Sequence[str], short: Mapping[str, str], counts: NDArray[np.int64], samples: int
) -> str:
    """Return how often two classes occur together, as a matrix of counts whose shade is the fraction of samples."""
    cell, left, top = 30.0, 40.0, 22.0
    size = cell * len(faults)
    parts = []
    for k, fault in enumerate(faults):
        at = (k + 0.5) * cell
        parts.append(f'<text x="{left + at}" y="{top - 7}" text-anchor="middle">{short[fault]}</text>')
        parts.append(f'<text x="{left - 7}" y="{top + at + 4}" text-anchor="end">{short[fault]}</text>')
        for j, other in enumerate(faults):
            count = int(counts[k, j])
            part = count / samples if samples else 0
            tip = f"{fault} and {other}: {count} of {samples}" if j != k else f"{fault}: {count} of {samples}"
            box = (
                f'x="{left + j * cell + 1}" y="{top + k * cell + 1}" width="{cell - 2}" height="{cell - 2}" rx="2"'
            )
            style = f"fill-opacity:{0.06 + 0.8 * part:.3f}"
            mark = ' class="cell own"' if j == k else ' class="cell"'
            text = grouped_digits(count) if count < 10_000 else f"{count / 1000:.0f}k"
            parts.append(f'<rect{mark} {box} style="{style}"><title>{escaped(tip)}</title></rect>')
            parts.append(
                f'<text class="count" x="{left + (j + 0.5) * cell}" y="{top + at + 4}" '
                f'text-anchor="middle">{text}</text>'
            )
    drawn = svg(left + size + 4, top + size + 4, "".join(parts), f"Co-occurrence of the classes, {title}")
    wide = f"max-width:{(left + size + 4) * 1.15:.0f}px"
    head = f"<figcaption>{escaped(title)} <span>{grouped_digits(samples)} samples</span></figcaption>"
    return f'<figure class="chart matrix" style="{wide}">{head}{drawn}</figure>'
