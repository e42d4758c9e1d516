"""Write the report of a study: figures, and one page that needs no other file.

`write_report` draws every figure into `DIR/plots` and writes `DIR/report.html`. It needs only what a study leaves
in its folder, with the images that `extreme_images` has made before. The template `report.html` holds the words.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from markupsafe import Markup, escape

from ..core.figures import formula, inline_svg, png_bytes, svg_text
from ..core.html_page import image_url, number_text, with_minus, write_page
from ..core.whole_files import own, own_folder, write_whole
from .extreme_images import IMAGES
from .plots import drawings
from .ranking_plots import ranking_rows
from .summaries import DUMMY, StudyResults

if TYPE_CHECKING:
    import pyarrow as pa
    import xarray as xr

PAGE = "report.html"
PLOTS = "plots"

_IMAGE_PX = 400  # longer side of the images in the page; the files keep their size
_COARSE_PX = 200  # an image that is smaller than this shows its pixels as squares
_MOST_ROWS = 30  # of failed evaluations and of missed half-widths
_MOST_LEADING = 4  # factors that the summary names for each metric

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
    figures: dict[str, list[tuple[Markup, str]]] = {}
    for drawing in drawings(results):
        stem, text = folder / PLOTS / drawing.stem, svg_text(drawing.figure)
        write_whole(own(stem.with_name(f"{stem.name}.svg")), text)
        write_whole(own(stem.with_name(f"{stem.name}.png")), png_bytes(drawing.figure))
        label = f"{drawing.kind}: {drawing.metric}" if drawing.metric else drawing.kind
        figures.setdefault(drawing.kind, []).append((inline_svg(text, drawing.stem, label), drawing.note))
    path = folder / PAGE
    write_page(
        own(path),
        "study/report.html",
        results=results,
        design=spec["design"],
        only_faults=results.has("fault_quantile") and len(results.factors) == 1,
        facts=_facts(results),
        figures=figures,
        formula=formula,
        images=_images(results, folder / IMAGES),
        summary=_summary(results),
        model_form=_model_form(results),
        faults=ranking_rows,
        indices=_index_tables(results),
        asked=_asked(results),
        missed=_missed(results),
        without_value=_without_value(results),
        failures=_failures(results),
        timings=_json(dataset.attrs.get("timings")),
        versions=_json(dataset.attrs.get("versions")),
        most_rows=_MOST_ROWS,
        counts=_counts(results),
    )
    return path


def _facts(results: StudyResults) -> dict[str, str]:
    """Return the numbers that describe the study."""
    design, scene = results.spec["design"], results.spec.get("scene", {})
    counts = _counts(results)
    return {
        "Design": f"{results.method.replace('_', ' ')}, n\N{NO-BREAK SPACE}=\N{NO-BREAK SPACE}{design['n']}",
        "Factors": str(len(results.factors)),
        "Metrics": str(len(results.metrics)),
        "Models": ", ".join(results.models) if len(results.models) > 1 else "one",
        "Scene": Path(str(scene.get("base", ""))).name,
        "Views and seeds": f"{counts['views']} × {counts['seeds']}",
        "Evaluations": f"{results.table.num_rows:,}".replace(",", "\N{NARROW NO-BREAK SPACE}"),
        "Failed": str(int((~results.succeeded).sum())),
    }


def _counts(results: StudyResults) -> dict[str, int]:
    """Return how many views, seeds, roles and points the design has."""
    counts = {f"{name}s": len(np.unique(results.column(name))) for name in ("view", "seed", "role")}
    points = results.table.num_rows // (len(np.unique(results.blocks)) * len(results.models))
    return counts | {"points": points}


# ------------------------------------------------------------------------------------ images and indices


def _images(results: StudyResults, folder: Path) -> list[tuple[str, list[dict[str, Any]]]]:
    """Return for each metric its best and its worst image; nothing where there are none."""
    pairs = []
    for metric in results.metrics:
        extremes, pair = results.extremes(metric), []
        if extremes is None:
            continue
        ends = {"best": (extremes.best, extremes.best_row), "worst": (extremes.worst, extremes.worst_row)}
        for name, (value, row) in ends.items():
            image = cv2.imread(str(folder / f"{metric}_{name}.png"), cv2.IMREAD_COLOR_RGB)
            if image is not None:
                url = image_url(np.asarray(image, np.uint8), _IMAGE_PX)
                shown = number_text(value, unit=results.about(metric, "unit"))
                of_row = results.table.slice(row, 1).to_pylist()[0]
                coarse = max(image.shape) < _COARSE_PX
                pair.append({"name": name, "url": url, "coarse": coarse, "value": shown, "row": of_row})
        if len(pair) == 2:
            pairs.append((metric, pair))
    return pairs


def _summary(results: StudyResults) -> list[list[Any]]:
    """Return which factors drive each metric, a row for each metric and model."""
    rows: list[list[Any]] = []
    for metric in results.metrics:
        unit = results.about(metric, "unit")
        name = _code(metric) + Markup('<br><span class="small about">{}</span>').format(
            results.about(metric, "description")
        )
        for model in results.models:
            of_model = results.dataset.sel(metric=metric, model=model)
            numbers = float(of_model["mean"]), float(np.sqrt(of_model["variance"]))
            rows.append(
                [
                    name,
                    *([model] if len(results.models) > 1 else []),
                    _leading(results, metric, model),
                    *(
                        Markup('<span class="unbroken">{}</span>').format(number_text(v, unit=unit))
                        for v in numbers
                    ),
                ]
            )
    return rows


def _leading(results: StudyResults, metric: str, model: str) -> Markup:
    """Return the most important factors of a metric, or why there is none."""
    name = next((n for n in ("ST", "delta", "S1", "mu_star") if results.has(n)), None)
    unit = results.about(metric, "unit")
    if name is None:
        points = results.points(metric, model)
        above = {f: points.swing(f).size for f in results.factors} if points.values.size else {}
        floor = max(points.chance_swing(), 0.0)
        above = {f: swing for f, swing in above.items() if swing > floor}
    else:
        index, bounds = results.index(name, metric, model), results.index(f"{name}_interval", metric, model)
        assert index is not None
        lows, highs = (index if bounds is None else bounds.sel(bound=end) for end in ("low", "high"))
        floor = float(np.nan_to_num(highs.sel(factor=DUMMY)))
        above = {f: float(index.sel(factor=f)) for f in results.factors if float(lows.sel(factor=f)) > floor}
    if not above:
        constant = float(results.dataset["variance"].sel(metric=metric, model=model)) == 0
        return Markup('<span class="small">{}</span>').format("constant" if constant else "none")
    has_unit = name in (None, "mu_star")
    order = sorted(above, key=lambda f: -above[f])
    named = Markup(", ").join(
        _code(f)
        + Markup("&nbsp;")
        + (number_text(above[f], 2, unit) if has_unit else with_minus(f"{above[f]:.2f}"))
        for f in order[:_MOST_LEADING]
    )
    more = len(order) - _MOST_LEADING
    return named + (f" and {more} more" if more > 0 else "")


def _model_form(results: StudyResults) -> dict[str, str]:
    """Return how much of each metric's variance the choice of the model causes, as text."""
    parts = {}
    for metric in results.metrics if results.has("model_share") else ():
        share = float(results.dataset["model_share"].sel(metric=metric))
        interval = ""
        if "model_share_interval" in results.dataset:
            low, high = results.dataset["model_share_interval"].sel(metric=metric, bound=["low", "high"]).values
            interval = f" [{100 * low:.0f}, {100 * high:.0f}]"
        if np.isfinite(share):
            parts[metric] = f"{100 * share:.0f}{interval}\N{NO-BREAK SPACE}%"
    return parts


def _index_tables(results: StudyResults) -> dict[str, tuple[list[str], list[list[Any]]]]:
    """Return headings and rows of the indices of each metric, the dummy's last; empty without indices."""
    names = [name for name in _COLUMNS if results.has(name)]
    tables = {}
    for metric in results.metrics if names else ():
        unit = results.about(metric, "unit")
        heads = ["factor"]
        for model in results.models:
            for name in names:
                head, fraction = _COLUMNS[name]
                head += "" if fraction or unit in ("", "1") else f" / {unit}"
                heads.append(f"{model}: {head}" if len(results.models) > 1 else head)
        rows = [
            [_code(factor), *(_cell(results, n, metric, m, factor) for m in results.models for n in names)]
            for factor in (*results.ranked(metric), DUMMY)
        ]
        tables[metric] = heads, rows
    return tables


def _cell(results: StudyResults, name: str, metric: str, model: str, factor: str) -> str:
    """Return an index with its interval as text."""
    index, bounds = results.index(name, metric, model), results.index(f"{name}_interval", metric, model)
    assert index is not None
    value = float(index.sel(factor=factor))
    if not np.isfinite(value):
        return "–"
    digits = ".3f" if _COLUMNS[name][1] else ".3g"
    if bounds is None:
        return with_minus(f"{value:{digits}}")
    low, high = bounds.sel(factor=factor, bound=["low", "high"]).values
    return with_minus(f"{value:{digits}} [{low:{digits}}, {high:{digits}}]")


# ------------------------------------------------------------------------------------ what was asked, what to watch


def _asked(results: StudyResults) -> dict[str, list[list[Any]]]:
    """Return the study file as rows: factors, metrics, and the values of its other tables."""
    factors = []
    for entry in results.spec.get("factor", ()):
        about = entry.get("description")
        name = _code(entry["key"]) + (Markup('<br><span class="small">{}</span>').format(about) if about else "")
        factors.append([name, _distribution(entry), _unit_words(str(entry.get("unit") or ""))])
    metrics = [
        [
            _code(m),
            results.about(m, "description"),
            _unit_words(results.about(m, "unit")),
            results.about(m, "source"),
        ]
        for m in results.metrics
    ]
    others = [
        [name, [(key, _plain(value)) for key, value in _flat(results.spec[name])]]
        for name in ("design", "scene", "models")
        if results.spec.get(name)
    ]
    return {"factors": factors, "metrics": metrics, "others": others}


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


def _missed(results: StudyResults) -> list[list[Any]] | None:
    """Return the total indices whose intervals are wider than the study asked for; None where it asked for none."""
    asked = results.spec["design"].get("half_width")
    if not asked or "ST_interval" not in results.dataset:
        return None
    bounds = results.dataset["ST_interval"]
    half = (bounds.sel(bound="high") - bounds.sel(bound="low")) / 2
    missed = [
        (float(half.sel(metric=metric, model=model, factor=factor)), metric, model, factor)
        for metric in results.metrics
        for model in results.models
        for factor in results.factors
    ]
    missed = sorted((entry for entry in missed if entry[0] > asked), reverse=True)
    return [[_code(metric), model, _code(factor), f"{width:.3f}"] for width, metric, model, factor in missed]


def _without_value(results: StudyResults) -> dict[str, int]:
    """Return the metrics without a value in some successful evaluations, with their number."""
    counts = {
        metric: int((~np.isfinite(np.asarray(results.column(metric), dtype=float)) & results.succeeded).sum())
        for metric in results.metrics
    }
    return {metric: count for metric, count in counts.items() if count}


def _failures(results: StudyResults) -> list[list[str]]:
    """Return the evaluations that failed, with their errors."""
    names = ("evaluation", "seed", "view", "model", "role", "error")
    failed = results.table.filter(~results.succeeded).select(names).to_pylist()
    return [[_plain(row[name]) for name in names] for row in failed]


# ------------------------------------------------------------------------------------ small pieces


def _code(text: str) -> Markup:
    """Return a name as an element of code."""
    return Markup("<code>") + escape(text) + Markup("</code>")


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
