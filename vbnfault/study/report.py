"""Write the report of a study: figures, and one page that needs no other file.

`write_report` draws every figure into `DIR/plots` and writes `DIR/report.html`. It needs only what a study leaves
in its folder, with the images that `extreme_images` has made before.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from ..core.html_page import Page, Section, data_url, escaped, grouped_digits, html_table, with_minus
from ..core.whole_files import own, own_folder
from . import sheets
from .extreme_images import IMAGES
from .plots import drawings, save
from .ranking_plots import ranking_rows
from .report_words import FORMULAE, SECTIONS, sample
from .summaries import DUMMY, StudyResults

if TYPE_CHECKING:
    import pyarrow as pa
    import xarray as xr

PAGE = "report.html"
PLOTS = "plots"

_MOST_DRAWINGS_BYTES = 11_000_000  # of all figures in the page; the largest become PNG above it
_MOST_IMAGES_BYTES = 4_000_000  # before base64, which adds a third
_SIDES = (512, 400, 320, 256, 192, 128)  # of the images in the page, px; the files keep their size
_NARROW_PT = 340.0  # a wider figure shrinks to this fraction of its size, and then scrolls on a small screen:
_LEAST_SCALE = 0.78
_COARSE_PX = 200  # an image that is narrower than this shows its pixels as squares
_MOST_ROWS = 30  # of failed evaluations and of missed half-widths
_SWAP = "probability that the next is worse"  # heading of a column
_MOST_LEADING = 4  # factors that the summary names for each metric

_COLOURS = {
    sheets.INK: "ink",
    sheets.MUTED: "muted",
    sheets.GRID: "grid",
    sheets.BAND: "band",
    sheets.BLUE: "blue",
    sheets.VERMILLION: "vermillion",
    sheets.GREEN: "green",
    sheets.PURPLE: "purple",
    sheets.SKY: "sky",
    sheets.ORANGE: "orange",
    "#ffffff": "paper",
}
# name of the variable → heading, whether it is a fraction
_COLUMNS = {
    "S1": ("first-order index", True),
    "ST": ("total index", True),
    "delta": ("delta", True),
    "mu": ("μ", False),
    "mu_star": ("μ*", False),
    "sigma": ("σ", False),
    "range": ("range", False),
}


def write_report(
    folder: str | os.PathLike[str], dataset: xr.Dataset, table: pa.Table, spec: Mapping[str, Any]
) -> Path:
    """Draw all figures of a study and write its page; return the path of the page.

    Parameters
    ----------
    folder
        Folder of the study. The figures go to its folder `plots`; images are taken from its folder `images`.
    dataset, table, spec
        As in `summaries.StudyResults`.

    Raises
    ------
    OSError
        If a file cannot be written.
    """
    folder = Path(folder)
    results = StudyResults(dataset=dataset, table=table, spec=spec)
    own_folder(folder / PLOTS)
    figures = []
    for drawing in drawings(results):
        png, svg = save(drawing, folder / PLOTS)
        size = drawing.figure.get_size_inches() * 72
        figures.append(
            _Figure(
                drawing.kind, drawing.metric, drawing.note, float(size[0]), svg.read_text(encoding="utf-8"), png
            )
        )
    path = folder / PAGE
    _page(results, _within_budget(figures), folder / IMAGES).write(own(path))
    return path


# ------------------------------------------------------------------------------------ figures and images


@dataclass(frozen=True)
class _Figure:
    """Hold a figure as it goes into the page."""

    kind: str
    metric: str
    note: str
    width_pt: float
    svg: str
    png: Path
    as_png: bool = False

    def markup(self) -> str:
        """Return the figure as an element of the page."""
        least = 0.0 if self.width_pt <= _NARROW_PT else _LEAST_SCALE * self.width_pt
        words = SECTIONS[self.kind].title + (f": {self.metric}" if self.metric else "")
        if self.as_png:
            source = data_url(self.png.read_bytes(), "image/png")
            style = f"width:{self.width_pt:.0f}pt;min-width:{least:.0f}pt"
            drawn = f'<img alt="{escaped(words)}" style="{style}" src="{source}">'
        else:
            drawn = inline_svg(self.svg, f"{self.kind}-{self.metric}", words)
            drawn = drawn.replace("<svg", f'<svg style="min-width:{least:.0f}pt"', 1)
        note = f"<figcaption>{escaped(self.note)}</figcaption>" if self.note else ""
        return f'<figure class="drawing"><div class="scroll">{drawn}</div>{note}</figure>'


def inline_svg(text: str, prefix: str, label: str) -> str:
    """Return an SVG file of matplotlib as an element of a page.

    Colours become those of the page's theme, identifiers become unique within the page, and all that refers to
    other files is left out.
    """
    text = text[text.index("<svg") :]
    text = re.sub(r"<metadata>.*?</metadata>|<!--.*?-->|<style.*?</style>", "", text, flags=re.DOTALL)
    text = re.sub(r'\s(?:xmlns(?::xlink)?|version)="[^"]*"', "", text)
    text = text.replace("xlink:href", "href")
    used = set(re.findall(r'(?:url\(#|href="#)([^")]+)', text))
    prefix = re.sub(r"[^A-Za-z0-9-]", "-", prefix)

    def identifier(match: re.Match[str]) -> str:
        return f' id="{prefix}-{match[1]}"' if match[1] in used else ""

    text = re.sub(r'\sid="([^"]*)"', identifier, text)
    text = re.sub(r'(url\(#|href="#)', rf"\g<1>{prefix}-", text)
    for colour, name in _COLOURS.items():
        text = text.replace(f": {colour}", f": var(--{name})")
    text = re.sub(r"base64,[^\"]*", lambda match: re.sub(r"\s", "", match[0]), text)
    text = re.sub(r"<defs>\s*</defs>", "", re.sub(r"\s+", " ", text))
    return text.replace("<svg", f'<svg role="img" aria-label="{escaped(label)}"', 1).strip()


def _within_budget(figures: Sequence[_Figure]) -> list[_Figure]:
    """Return the figures, the largest as PNG where all together as SVG would make the page too large."""
    kept = list(figures)
    sizes = [len(figure.svg) for figure in kept]
    for k in sorted(range(len(kept)), key=lambda k: -sizes[k]):
        if sum(sizes) <= _MOST_DRAWINGS_BYTES:
            break
        png = kept[k].png.stat().st_size * 4 // 3
        if png < sizes[k]:
            f = kept[k]
            kept[k] = _Figure(f.kind, f.metric, f.note, f.width_pt, f.svg, f.png, as_png=True)
            sizes[k] = png
    return kept


def _images(results: StudyResults, folder: Path) -> str:
    """Return the worst and the best image of each metric as elements of the page; empty where there are none."""
    pairs = {metric: [folder / f"{metric}_{name}.png" for name in ("best", "worst")] for metric in results.metrics}
    pairs = {m: paths for m, paths in pairs.items() if all(p.is_file() for p in paths) and results.extremes(m)}
    data: dict[Path, bytes] = {}
    for side in _SIDES:
        data = {path: _reduced(path, side) for paths in pairs.values() for path in paths}
        if sum(map(len, data.values())) <= _MOST_IMAGES_BYTES:
            break
    parts = []
    for metric, paths in pairs.items():
        extremes, unit = results.extremes(metric), results.about(metric, "unit")
        assert extremes is not None
        items = []
        ends = ((extremes.best, extremes.best_row), (extremes.worst, extremes.worst_row))
        for name, path, (value, row) in zip(("best", "worst"), paths, ends, strict=True):
            where = _where(results, row)
            source = data_url(data[path], "image/png")
            coarse = ' class="coarse"' if _width(data[path]) < _COARSE_PX else ""
            items.append(
                f'<div><img{coarse} alt="{name} image of {escaped(metric)}" src="{source}">'
                f'<span class="small"><b>{name}</b>: {escaped(_quantity(value, unit))}<br>'
                f"{escaped(where)}</span></div>"
            )
        parts.append(
            f'<figure><h3><code>{escaped(metric)}</code></h3><div class="pair">{"".join(items)}</div></figure>'
        )
    return f'<div class="figures">{"".join(parts)}</div>' if parts else ""


def _width(png: bytes) -> int:
    """Return the width of a PNG file in pixels, which stands in its header."""
    return int.from_bytes(png[16:20], "big")


def _reduced(path: Path, side: int) -> bytes:
    """Return a PNG file whose longer side has at most `side` pixels."""
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if image is None:
        return path.read_bytes()
    factor = side / max(image.shape[:2])
    if factor < 1:
        image = cv2.resize(image, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)
    return bytes(cv2.imencode(".png", image, [cv2.IMWRITE_PNG_COMPRESSION, 9])[1].tobytes())


def _where(results: StudyResults, row: int) -> str:
    """Return which evaluation a row of the table is."""
    values = {name: results.table.column(name)[row].as_py() for name in ("evaluation", "seed", "view", "model")}
    model = f", model {values['model']}" if values["model"] else ""
    return f"evaluation {values['evaluation']}, seed {values['seed']}, view {values['view']}{model}"


# ------------------------------------------------------------------------------------ the page


def _page(results: StudyResults, figures: Sequence[_Figure], images: Path) -> Page:
    """Return the whole page."""
    only_faults = results.has("fault_quantile") and len(results.factors) == 1
    parts = [] if only_faults else [Section("summary", "In short", _summary(results))]
    for kind, section in SECTIONS.items():
        members = [figure.markup() for figure in figures if figure.kind == kind]
        if members:
            how = f"{section.how(results)} {sample(results, kind)}"
            body = f'<p class="how">{escaped(how)}</p><div class="figures">{"".join(members)}</div>'
            parts.append(Section(kind, section.title, body + (_ranking(results) if kind == "ranking" else "")))
    pictures = _images(results, images)
    if pictures:
        how = (
            "Each pair shows the evaluations with the best and the worst value of a metric. Images of 8 bits, "
            "which metrics of navigation judge, are shown as they are stored. Expected light in electrons is shown "
            "with one exposure for both images and one curve of brightness (arcsinh), which shows faint light "
            "beside the Sun: what differs between the two is light, not the display."
        )
        parts.append(Section("images", "Best and worst images", f'<p class="how">{escaped(how)}</p>{pictures}'))
    if not only_faults:
        parts.append(Section("tables", "Tables of indices", _index_tables(results)))
    parts += [
        Section("asked", "What was asked", _asked(results)),
        Section("quality", "What to watch", _quality(results)),
        Section("formulae", "Formulae", _formulae(results)),
        Section("versions", "Time and versions", _provenance(results)),
    ]
    return Page(
        title=str(results.spec.get("title") or results.dataset.attrs.get("title") or "Study"),
        description=str(results.spec.get("description") or ""),
        facts=_facts(results),
        sections=parts,
        style=resources.files(__package__).joinpath("report.css").read_text(encoding="utf-8"),
    )


def _facts(results: StudyResults) -> dict[str, str]:
    """Return the numbers that describe the study."""
    design, scene = results.spec["design"], results.spec.get("scene", {})
    failed = int((~results.succeeded).sum())
    return {
        "Design": f"{results.method.replace('_', ' ')}, n\N{NO-BREAK SPACE}=\N{NO-BREAK SPACE}{design['n']}",
        "Factors": str(len(results.factors)),
        "Metrics": str(len(results.metrics)),
        "Models": ", ".join(results.models) if len(results.models) > 1 else "one",
        "Scene": Path(str(scene.get("base", ""))).name,
        "Views and seeds": f"{len(np.unique(results.column('view')))} × {len(np.unique(results.column('seed')))}",
        "Evaluations": grouped_digits(results.table.num_rows),
        "Failed": str(failed),
    }


def _summary(results: StudyResults) -> str:
    """Return which factors drive each metric, as a table."""
    several = len(results.models) > 1
    leading = "factors above the noise floor" if results.has_noise_floor else "strongest factors"
    heads = ["metric", *(["model"] if several else []), leading, "mean", "deviation"]
    rows: list[list[str]] = []
    for metric in results.metrics:
        unit = results.about(metric, "unit")
        for k, model in enumerate(results.models):
            mean = float(results.dataset["mean"].sel(metric=metric, model=model))
            deviation = float(np.sqrt(results.dataset["variance"].sel(metric=metric, model=model)))
            about = results.about(metric, "description")
            name = (
                f'<code>{escaped(metric)}</code><br><span class="small about">{escaped(about)}</span>'
                if k == 0
                else ""
            )
            rows.append(
                [
                    name,
                    *([escaped(model)] if several else []),
                    _leading(results, metric, model),
                    _unbroken(_quantity(mean, unit)),
                    _unbroken(_quantity(deviation, unit)),
                ]
            )
    words = (
        "Means and deviations are over the factors within one view; differences between views are left out. "
        "Factors are named, the most important first"
    )
    if results.has_noise_floor:
        words += ", where their interval lies above that of the dummy factor, which acts on nothing"
    return f"<p>{escaped(words)}.</p>{html_table(heads, rows, group=len(results.models))}{_model_form(results)}"


def _leading(results: StudyResults, metric: str, model: str) -> str:
    """Return the most important factors of a metric as text, or why there is none."""
    name = next((n for n in ("ST", "delta", "S1", "mu_star") if results.has(n)), None)
    if name is None:
        points = results.points(metric, model)
        swings = {factor: points.swing(factor).size for factor in results.factors} if points.values.size else {}
        floor = points.chance_swing()
        above = {f: s for f, s in swings.items() if s > max(floor, 0.0)}
        shown = {f: escaped(_quantity(s, results.about(metric, "unit"), 2)) for f, s in above.items()}
        order = sorted(above, key=lambda f: -above[f])
    else:
        index, bounds = results.index(name, metric, model), results.index(f"{name}_interval", metric, model)
        assert index is not None
        lows = index if bounds is None else bounds.sel(bound="low")
        highs = index if bounds is None else bounds.sel(bound="high")
        floor = float(np.nan_to_num(highs.sel(factor=DUMMY)))
        order = [f for f in results.factors if float(lows.sel(factor=f)) > floor]
        order.sort(key=lambda f: -float(index.sel(factor=f)))
        unit = results.about(metric, "unit") if name == "mu_star" else ""
        values = {f: float(index.sel(factor=f)) for f in order}
        shown = {
            f: escaped(_quantity(v, unit, 2) if name == "mu_star" else with_minus(f"{v:.2f}"))
            for f, v in values.items()
        }
    if not order:
        constant = float(results.dataset["variance"].sel(metric=metric, model=model)) == 0
        return f'<span class="small">{"constant" if constant else "none"}</span>'
    named = ", ".join(f"<code>{escaped(f)}</code>&nbsp;{shown[f]}" for f in order[:_MOST_LEADING])
    more = len(order) - _MOST_LEADING
    return named + (f" and {more} more" if more > 0 else "")


def _model_form(results: StudyResults) -> str:
    """Return how much of each metric's variance the choice of the model causes, as text."""
    if not results.has("model_share"):
        return ""
    parts = []
    for metric in results.metrics:
        share = float(results.dataset["model_share"].sel(metric=metric))
        if not np.isfinite(share):
            continue
        interval = ""
        if "model_share_interval" in results.dataset:
            low, high = results.dataset["model_share_interval"].sel(metric=metric, bound=["low", "high"]).values
            interval = f" [{100 * low:.0f}, {100 * high:.0f}]"
        parts.append(f"<code>{escaped(metric)}</code>&nbsp;{100 * share:.0f}{interval}&nbsp;%")
    listed = ", ".join(parts)
    return f"<p>The choice of the model causes this part of the variance: {listed}.</p>" if parts else ""


def _ranking(results: StudyResults) -> str:
    """Return the tables of faults, the worst first, one for each metric."""
    parts = []
    for metric in results.metrics:
        unit = results.about(metric, "unit")
        end = "" if unit in ("", "1") else f" / {unit}"
        heads = ["rank", "fault", "views", f"median{end}", f"middle half{end}", _SWAP]
        rows = [[escaped(cell) for cell in row] for row in ranking_rows(results, metric)]
        about = escaped(results.about(metric, "description"))
        table = html_table(heads, rows, numbers=[0, 2, 3, 4, 5])
        parts.append(f'<h3><code>{escaped(metric)}</code></h3><p class="small">{about}</p>{table}')
    words = (
        f"Brackets hold the {100 * results.confidence:g} % interval over views. Views: those in which the metric "
        "has a value, of those in which the fault acts. The last column is the fraction of the resamples in which "
        "the median of the next fault is the worse one."
    )
    return f'<p class="how">{escaped(words)}</p>{"".join(parts)}'


def _index_tables(results: StudyResults) -> str:
    """Return the indices of each metric with their intervals."""
    names = [name for name in _COLUMNS if results.has(name)]
    if not names:
        return "<p>This design gives no indices; the response curves and the tornado show what it found.</p>"
    several = len(results.models) > 1
    parts = []
    for metric in results.metrics:
        unit = results.about(metric, "unit")
        heads = ["factor"]
        for model in results.models:
            for name in names:
                head, fraction = _COLUMNS[name]
                end = "" if fraction or unit in ("", "1") else f" / {unit}"
                heads.append(f"{model}: {head}{end}" if several else f"{head}{end}")
        rows, floors = [], []
        for factor in (*results.ranked(metric), DUMMY):
            cells = [f"<code>{escaped(factor)}</code>"]
            for model in results.models:
                cells += [_index_cell(results, name, metric, model, factor) for name in names]
            rows.append(cells)
            floors.append(factor == DUMMY)
        table = html_table(heads, rows, numbers=range(1, len(heads)), faint=floors)
        parts.append(f"<h3><code>{escaped(metric)}</code></h3>{table}")
    words = "The last row is the dummy factor."
    if any(f"{name}_interval" in results.dataset for name in names):
        words = f"Brackets hold the {100 * results.confidence:g}\N{NO-BREAK SPACE}% interval. {words}"
    return f'<p class="how">{escaped(words)}</p>{"".join(parts)}'


def _index_cell(results: StudyResults, name: str, metric: str, model: str, factor: str) -> str:
    """Return an index with its interval as text."""
    fraction = _COLUMNS[name][1]
    index, bounds = results.index(name, metric, model), results.index(f"{name}_interval", metric, model)
    assert index is not None
    value = float(index.sel(factor=factor))
    if not np.isfinite(value):
        return "–"

    def text(number: float) -> str:
        return with_minus(f"{number:.3f}" if fraction else f"{number:.3g}")

    if bounds is None:
        return text(value)
    low, high = (float(bounds.sel(factor=factor, bound=end)) for end in ("low", "high"))
    return f"{text(value)} [{text(low)}, {text(high)}]"


def _asked(results: StudyResults) -> str:
    """Return the study file in words: factors, models, scene, seeds, design, metrics."""
    spec = results.spec
    rows = [
        [
            f"<code>{escaped(entry['key'])}</code>"
            + (
                f'<br><span class="small">{escaped(entry["description"])}</span>'
                if entry.get("description")
                else ""
            ),
            escaped(_distribution(entry)),
            escaped(_unit_words(str(entry.get("unit") or ""))),
        ]
        for entry in spec.get("factor", ())
    ]
    factors = html_table(["factor", "distribution", "unit"], rows)
    rows = [
        [
            f"<code>{escaped(metric)}</code>",
            escaped(results.about(metric, "description")),
            escaped(_unit_words(results.about(metric, "unit"))),
            escaped(results.about(metric, "source")),
        ]
        for metric in results.metrics
    ]
    metrics = html_table(["metric", "meaning", "unit", "source"], rows)
    others = {name: spec[name] for name in ("design", "scene", "models") if spec.get(name)}
    items = "".join(
        f"<li>{escaped(name)}: "
        + ", ".join(f"<code>{escaped(k)}</code> = {escaped(_plain(v))}" for k, v in _flat(entry))
        + "</li>"
        for name, entry in others.items()
    )
    return (
        f"<h3>Factors</h3>{factors}<h3>Metrics</h3>{metrics}<h3>Design, scene and models</h3><ul>{items}</ul>"
        f"<p class='small'>A factor named <code>{DUMMY}</code>, which acts on nothing, was added.</p>"
    )


def _distribution(entry: Mapping[str, Any]) -> str:
    """Return a factor's distribution in words."""
    kind = entry.get("distribution")
    if kind == "categorical":
        return "one of " + ", ".join(_plain(value) for value in entry.get("values", ())) + ", equally likely"
    low, high = _plain(entry.get("low", "")), _plain(entry.get("high", ""))
    if kind == "truncated_normal":
        return (
            f"normal, mean {_plain(entry['mean'])}, deviation {_plain(entry['deviation'])}, cut at {low} and {high}"
        )
    return f"{str(kind).replace('_', '-')}, {low} to {high}"


def _quality(results: StudyResults) -> str:
    """Return missed half-widths, missing values and failed evaluations."""
    return _missed(results) + _left_out(results) + _failures(results)


def _missed(results: StudyResults) -> str:
    """Return the total indices whose intervals are wider than the study asked for."""
    asked = results.spec["design"].get("half_width")
    if not asked or "ST_interval" not in results.dataset:
        return "<p>The study asked for no width of the intervals.</p>"
    bounds = results.dataset["ST_interval"]
    half = (bounds.sel(bound="high") - bounds.sel(bound="low")) / 2
    missed = [
        (float(half.sel(metric=metric, model=model, factor=factor)), metric, model, factor)
        for metric in results.metrics
        for model in results.models
        for factor in results.factors
    ]
    missed = sorted((entry for entry in missed if entry[0] > asked), reverse=True)
    if not missed:
        return f"<p>All total indices have a half-width of at most {asked:g}, as the study asked.</p>"
    n = int(results.spec["design"]["n"])
    needed = 2 ** int(np.ceil(np.log2(n * (missed[0][0] / asked) ** 2)))
    rows = [
        [f"<code>{escaped(metric)}</code>", escaped(model), f"<code>{escaped(factor)}</code>", f"{width:.3f}"]
        for width, metric, model, factor in missed[:_MOST_ROWS]
    ]
    more = f"<p class='small'>and {len(missed) - _MOST_ROWS} more</p>" if len(missed) > _MOST_ROWS else ""
    words = (
        f"{len(missed)} total indices have a half-width above {asked:g}. The widest would need at most about "
        f"n = {needed} in place of n = {n}."
    )
    table = html_table(["metric", "model", "factor", "half-width"], rows, numbers=[3])
    return f'<div class="warning"><p>{escaped(words)}</p></div>{table}{more}'


def _left_out(results: StudyResults) -> str:
    """Return the metrics without values in some evaluations."""
    counts = {
        metric: int((~np.isfinite(np.asarray(results.column(metric), dtype=float)) & results.succeeded).sum())
        for metric in results.metrics
    }
    named = ", ".join(f"<code>{escaped(metric)}</code> ({count})" for metric, count in counts.items() if count)
    return f"<p>Metrics that have no value in some successful evaluations: {named}.</p>" if named else ""


def _failures(results: StudyResults) -> str:
    """Return the evaluations that failed, with their errors."""
    failed = np.flatnonzero(~results.succeeded)
    if not failed.size:
        return "<p>No evaluation failed.</p>"
    names = ("evaluation", "seed", "view", "model", "role", "error")
    rows = [
        [escaped(_plain(results.table.column(name)[int(row)].as_py())) for name in names]
        for row in failed[:_MOST_ROWS]
    ]
    more = f"<p class='small'>and {failed.size - _MOST_ROWS} more</p>" if failed.size > _MOST_ROWS else ""
    words = f"{failed.size} of {results.table.num_rows} evaluations failed; the indices leave them out."
    return f'<div class="warning"><p>{escaped(words)}</p></div>{html_table(names, rows)}{more}'


def _formulae(results: StudyResults) -> str:
    """Return the formulae of what the page shows."""
    parts = []
    for names, (words, formula) in FORMULAE.items():
        if any(results.has(name) for name in names):
            parts.append(
                f'<p>{escaped(words)}</p><div class="formula"><math display="block">{formula}</math></div>'
            )
    return "".join(parts) or "<p>The figures show conditional means and medians only.</p>"


def _provenance(results: StudyResults) -> str:
    """Return the time by stage and the versions of the libraries."""
    timings, versions = (_json(results.dataset.attrs.get(name)) for name in ("timings", "versions"))
    parts = []
    if timings:
        total = sum(timings.values()) or 1.0
        rows = [
            [escaped(stage), f"{seconds:.1f}", f"{100 * seconds / total:.0f}"]
            for stage, seconds in sorted(timings.items(), key=lambda entry: -entry[1])
        ]
        table = html_table(["stage", "time / s", "fraction / %"], rows, numbers=[1, 2])
        parts.append(f"<p>Time by stage, summed over all processes and all runs of the study.</p>{table}")
    if versions:
        named = ", ".join(f"{escaped(name)}&nbsp;{escaped(str(version))}" for name, version in versions.items())
        parts.append(f"<p>Versions: {named}.</p>")
    return "".join(parts) or "<p>Not recorded.</p>"


# ------------------------------------------------------------------------------------ small pieces


def _unbroken(text: str) -> str:
    """Return a text as markup that stays on one line."""
    return f'<span class="unbroken">{escaped(text)}</span>'


def _quantity(value: float, unit: str, digits: int = 3) -> str:
    """Return a value with its unit as text."""
    if not np.isfinite(value):
        return "–"
    leading, _, power = f"{value:.{digits}g}".partition("e")
    number = leading if not power else f"{leading}·{sheets.power(int(power))}"
    return with_minus(number) + ("" if unit in ("", "1") else f" {unit}")


def _unit_words(unit: str) -> str:
    """Return a unit as text."""
    return "no unit" if unit in ("", "1") else unit


def _plain(value: Any) -> str:
    """Return a value of the study file as text."""
    if isinstance(value, float):
        return with_minus(f"{value:.6g}")
    if isinstance(value, list | tuple):
        return "[" + ", ".join(_plain(entry) for entry in value) + "]"
    return str(value)


def _flat(table: Mapping[str, Any], above: str = "") -> list[tuple[str, Any]]:
    """Return the values of nested tables with their dotted keys."""
    pairs: list[tuple[str, Any]] = []
    for key, value in table.items():
        pairs += _flat(value, f"{above}{key}.") if isinstance(value, Mapping) else [(f"{above}{key}", value)]
    return pairs


def _json(text: Any) -> dict[str, Any]:
    """Return an attribute that holds a table as JSON; empty where it is missing or no such table."""
    try:
        table = json.loads(text) if isinstance(text, str) else {}
    except ValueError:
        return {}
    return table if isinstance(table, dict) else {}
