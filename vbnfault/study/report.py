"""Write the report of a study: figures, and one page that needs no other file.

`write_report` draws every figure into `DIR/plots` and writes `DIR/report.html`. It needs only what a study leaves
in its folder, with the images that `write_images` has made before. The template `report.html` holds the words.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from markupsafe import Markup, escape
from numpy.typing import NDArray

from ..core import tables
from ..core.figures import formula, inline_svg, png_bytes, svg_text
from ..core.files.images import write_png
from ..core.files.whole_files import own, own_folder, write_whole
from ..core.html_page import image_url, number_text, with_minus, write_page
from .plots import drawings, ranking_rows
from .spec import Evaluation
from .summaries import DUMMY, StudyResults

PAGE = "report.html"
PLOTS = "plots"
IMAGES = "images"

_IMAGE_PX = 400  # longer side of the images in the page; the files keep their size
_COARSE_PX = 200  # an image that is smaller than this shows its pixels as squares
_MOST_ROWS = 30  # of failed evaluations and of missed half-widths
_MOST_LEADING = 4  # factors that the summary names for each metric
_WHITE = 0.998  # quantile of a pair of images that is shown as white
_MIDDLE = 0.3  # grey value of the median of a pair, of 1 for white
_FAINTEST = 1e-6  # of white: the tone curve is linear at least up to here

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


def write_report(folder: Path, results: StudyResults) -> Path:
    """Draw all figures of a study and write its page; return the path of the page.

    The figures go to the folder `plots` of the study's folder; images are taken from its folder `images`. Raises
    OSError if a file cannot be written.
    """
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
        design=results.spec["design"],
        only_faults=results.has("fault_quantile") and len(results.factors) == 1,
        figures=figures,
        formula=formula,
        images=_images(results, folder / IMAGES),
        summary=_summary(results),
        model_form=_model_form(results),
        faults=ranking_rows,
        indices=_index_tables(results),
        distribution=_distribution,
        plain=_plain,
        flat=tables.flat,
        code=_code,
        missed=_missed(results),
        without_value=_without_value(results),
        failures=_failures(results),
        scene=Path(str(results.spec.get("scene", {}).get("base", ""))).name,
        timings=json.loads(results.dataset.attrs.get("timings", "{}")),
        versions=json.loads(results.dataset.attrs.get("versions", "{}")),
        most_rows=_MOST_ROWS,
        counts=_counts(results),
    )
    return path


def _counts(results: StudyResults) -> dict[str, int]:
    """Return how many views, seeds, roles and points the design has."""
    counts = {f"{name}s": len(np.unique(results.column(name))) for name in ("view", "seed", "role")}
    points = results.table.num_rows // (len(np.unique(results.blocks)) * len(results.models))
    return counts | {"points": points}


# ------------------------------------------------------------------------------------ best and worst images


def write_images(folder: Path, results: StudyResults, evaluator: Any) -> list[Path]:
    """Write the images with the best and the worst value of each metric to `images`; return their paths.

    Images of 8 bits are written as they are. Otherwise the two images of a metric have one exposure and one tone
    curve, arcsinh (Lupton et al. 2004, doi 10.1086/382245), which shows ghosts and ground beside the Sun: the
    99.8 % quantile of both is white, and their median is at 30 % of white, or brighter where it is so on a linear
    scale. An evaluator without the method `picture`, and a metric whose values are all equal, give none.

    Parameters
    ----------
    folder, results
        As for `write_report`. The images go to the folder `images`.
    evaluator
        Evaluator of the study; `picture(evaluation)` returns an image, [y, x] or [y, x, 3], in electrons, linear,
        or as stored, uint8.
    """
    picture = getattr(evaluator, "picture", None)
    if picture is None:
        return []
    paths: list[Path] = []
    kept: dict[int, NDArray[Any]] = {}

    def image(row: int) -> NDArray[Any]:
        if row not in kept:
            values = results.table.slice(row, 1).to_pylist()[0]
            evaluation = Evaluation(
                index=int(values["evaluation"]),
                seed=int(values["seed"]),
                view=int(values["view"]),
                model=str(values["model"]),
                role=str(values["role"]),
                values={factor: values[factor] for factor in results.factors},
            )
            kept[row] = np.asarray(picture(evaluation))
        return kept[row]

    for metric in results.metrics:
        extremes = results.extremes(metric)
        if extremes is None:
            continue
        names = ("best", "worst")
        pair = _shown([image(extremes.best_row), image(extremes.worst_row)])
        images = own_folder(folder / IMAGES)
        for name, each in zip(names, pair, strict=True):
            paths.append(write_png(own(images / f"{metric}_{name}.png"), each))
    return paths


def _shown(pair: Sequence[NDArray[Any]]) -> list[NDArray[np.uint8]]:
    """Return two images as they are shown: as they are with 8 bits, otherwise with one exposure and tone curve."""
    if all(image.dtype == np.uint8 for image in pair):
        return list(pair)
    linear = [np.nan_to_num(image).astype(np.float64) for image in pair]
    white, middle = np.quantile(np.concatenate([image.ravel() for image in linear]), [_WHITE, 0.5])
    white = white if white > 0 else 1.0
    # Below `knee`, grey values are proportional to electrons. The lower it is, the brighter is the median.
    knees = white * np.geomspace(1e3, _FAINTEST, 200)
    greys = np.arcsinh(middle / knees) / np.arcsinh(white / knees)
    knee = knees[min(int(np.searchsorted(greys, _MIDDLE)), len(knees) - 1)]
    tones = (np.arcsinh(image / knee) / np.arcsinh(white / knee) for image in linear)
    return [np.rint(255 * np.clip(tone, 0, 1)).astype(np.uint8) for tone in tones]


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
            image = cv2.imread(str(folder / f"{metric}_{name}.png"))
            if image is not None:
                url = image_url(np.ascontiguousarray(image[..., ::-1], np.uint8), _IMAGE_PX)
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
        values, *bounds = results.with_interval(name, metric, model, [*results.factors, DUMMY])
        lows, highs = bounds if f"{name}_interval" in results.dataset else (values, values)
        floor = float(np.nan_to_num(highs[-1]))
        above = {f: float(values[k]) for k, f in enumerate(results.factors) if lows[k] > floor}
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
    parts, dataset = {}, results.dataset
    for metric in results.metrics if results.has("model_share") else ():
        share, interval = float(dataset["model_share"].sel(metric=metric)), ""
        if "model_share_interval" in dataset:
            low, high = dataset["model_share_interval"].sel(metric=metric, bound=["low", "high"]).values
            interval = f" [{100 * low:.0f}, {100 * high:.0f}]"
        if np.isfinite(share):
            parts[metric] = f"{100 * share:.0f}{interval}\N{NO-BREAK SPACE}%"
    return parts


def _index_tables(results: StudyResults) -> dict[str, tuple[list[str], list[list[Any]]]]:
    """Return headings and rows of the indices of each metric, the dummy's last; empty without indices."""
    names = [name for name in _COLUMNS if results.has(name)]
    found = {}
    for metric in results.metrics if names else ():
        unit = results.about(metric, "unit")
        heads, order = ["factor"], [*results.ranked(metric), DUMMY]
        columns: list[list[str]] = [[_code(factor) for factor in order]]
        for model in results.models:
            for name in names:
                head, fraction = _COLUMNS[name]
                head += "" if fraction or unit in ("", "1") else f" / {unit}"
                heads.append(f"{model}: {head}" if len(results.models) > 1 else head)
                values = results.with_interval(name, metric, model, order).T
                columns.append([_cell(v, low, high, ".3f" if fraction else ".3g") for v, low, high in values])
        found[metric] = heads, [list(row) for row in zip(*columns, strict=True)]
    return found


def _cell(value: float, low: float, high: float, digits: str) -> str:
    """Return an index with its interval as text."""
    if not np.isfinite(value):
        return "–"
    interval = f" [{low:{digits}}, {high:{digits}}]" if np.isfinite(low) else ""
    return with_minus(f"{value:{digits}}{interval}")


# ------------------------------------------------------------------------------------ what was asked, what to watch


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


def _plain(value: Any) -> str:
    """Return a value of the study file as text."""
    if isinstance(value, float):
        return with_minus(f"{value:.6g}")
    if isinstance(value, list | tuple):
        return "[" + ", ".join(_plain(entry) for entry in value) + "]"
    return str(value)
