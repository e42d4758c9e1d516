"""Write a score as a table in Markdown and as one page of plots and worst cases."""

from __future__ import annotations

import contextlib
import itertools
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from markupsafe import Markup
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from ..core.figures import (
    BLUE,
    GRID,
    INK,
    MUTED,
    SERIES_COLOURS,
    SERIES_MARKERS,
    inline_svg,
    label_rows,
    panels,
    row_height,
    svg_text,
    wrapped,
    write_message,
)
from ..core.files.whole_files import own, write_whole
from ..core.html_page import image_url, number_text, rendered, write_page
from ..dataset.card import markdown_table
from ..output.contact_sheet import overlay
from .figures import class_iou
from .navigation_scores import VARIANTS
from .time_scores import ANY

if TYPE_CHECKING:
    from .scored_samples import Batch, Samples
    from .scoring import Tally

U8 = NDArray[np.uint8]

# Heading, place in the result of a class, and name among the means, of the columns of both tables of classes.
PIXELS = {
    "IoU": ("pixels", "iou", "iou"),
    "precision": ("pixels", "precision", "precision"),
    "recall": ("pixels", "recall", "recall"),
    "F1": ("pixels", "f1", "f1"),
    "AP": ("pixels", "average_precision", "average_precision"),
    "ECE": ("calibration", "pixel_ece", ""),
}
ARTEFACTS = {
    "PaR": ("artefacts", "par", "par"),
    "PaP": ("artefacts", "pap", "pap"),
    "PamIoU": ("artefacts", "pamiou", "pamiou"),
    "presence AP": ("presence", "average_precision", "presence_ap"),
    "presence ROC AUC": ("presence", "roc_auc", ""),
}
_GROUPS = {"all": "all", "sun_in_view": "Sun in view", "no_sun_in_view": "no Sun in view"}
_MASKS = {"without": "no mask", "predicted": "predicted mask", "true": "true mask", "clean": "clean twins"}
_CASES, _SIDE_PX, _GAP_PX = 3, 320, 6
_PANEL = (150.0, 120.0)
_ACROSS = 4


def write_pages(folder: Path, result: Mapping[str, Any], samples: Samples, tally: Tally, thresholds: Any) -> None:
    """Write `score.md` and `score.html` to a folder. Raises OSError if a file cannot be written."""
    from .scoring import PAGE, TABLE

    navigation = result["navigation"]
    shared = {
        "result": result,
        "facts": _facts(result),
        "notes": _notes(result),
        "classes": [(["class", *columns], _class_rows(result, columns)) for columns in (PIXELS, ARTEFACTS)],
        "false_alarms": _alarm_rows(result),
        "severity": _severity_rows(result),
        "time": (TIME, _time_rows(result["time"])),
        "reactions": [],
        "kept": with_interval(navigation["good_pixels_kept"], percent=True),
        "let": with_interval(navigation["bad_pixels_let_through"], percent=True),
        "navigation": _navigation_rows(navigation),
        "masks": list(_MASKS.values()),
        "reasons": _reasons(navigation),
    }

    write_whole(own(folder / TABLE), rendered("detect/score.md", as_table=_as_table, **shared))
    write_page(
        own(folder / PAGE),
        "detect/score.html",
        drawings=[
            ("curves", "Precision and recall", _curves(result)),
            ("reliability", "Reliability", _reliability(result)),
            ("presence", "Presence", _presence(result)),
        ],
        alarms=_alarms(result),
        cases=_cases(samples, tally, thresholds),
        **shared,
    )


def write_log_pages(folder: Path, result: Mapping[str, Any]) -> None:
    """Write `score.md` and `score.html` of a fault monitor's log. Raises OSError if a file cannot be written."""
    from .scoring import PAGE, TABLE

    dataset, time = result["dataset"], result["time"]
    facts = {
        "Log": f"{result['model']['name']} ({result['model']['sha256'][:8]})",
        "Dataset": f"{dataset['name']} ({dataset['sha256'][:8]})",
        "Split": f"{result['options']['split']}, {result['samples']} frames of {time['sequences']} sequences",
        "vbnfault": result["vbnfault"],
    }
    shared = {
        "result": result,
        "facts": facts,
        "classes": [],
        "time": (TIME, _time_rows(time)),
        "reactions": _reaction_rows(time["reactions"]),
        "right": with_interval(time["reactions"]["right_fraction"], percent=True),
    }
    write_whole(own(folder / TABLE), rendered("detect/score.md", as_table=_as_table, **shared))
    write_page(own(folder / PAGE), "detect/score.html", **shared)


# --- tables -------------------------------------------------------------------------------------------------------


def _as_table(head: list[str], rows: list[list[str]]) -> str:
    """Return a table as Markdown."""
    return "\n".join(markdown_table([head, *rows]))


def with_interval(figure: Mapping[str, Any], percent: bool = False) -> str:
    """Return a figure with its interval as text, such as `0.873 (0.851 to 0.894)`; – for none."""
    value, low, high = (figure.get(name) for name in ("value", "low", "high"))
    if value is None:
        return "–"
    values = [value] if low is None or high is None else [value, low, high]
    if percent:
        texts = [number_text(100 * one) for one in values]
        texts[0] += "\N{NO-BREAK SPACE}%"
    else:
        texts = [f"{one:.3f}" for one in values]
    return texts[0] if len(texts) == 1 else f"{texts[0]} ({texts[1]} to {texts[2]})"


def _class_rows(result: Mapping[str, Any], columns: Mapping[str, tuple[str, str, str]]) -> list[list[str]]:
    """Return a table of classes, the last row of which is their mean."""
    rows = [
        [name, *(with_interval(one[part][key]) for part, key, _ in columns.values())]
        for name, one in result["classes"].items()
    ]
    means = [with_interval(result["mean"][key]) if key else "" for *_, key in columns.values()]
    return [*rows, ["mean", *means]]


def _facts(result: Mapping[str, Any]) -> dict[str, str]:
    """Return what the head of the page says."""
    dataset, options = result["dataset"], result["options"]
    return {
        "Model": f"{result['model']['name']} ({result['model']['sha256'][:8] or 'no file'})",
        "Dataset": f"{dataset['name']} ({dataset['sha256'][:8]})",
        "Split": f"{options['split']}, {result['samples']} samples of {result['views']} views",
        "Size": f"{dataset['width_px']} × {dataset['height_px']} px",
        "True masks": options["masks"],
        "Thresholds": "best F1 on val" if options["calibrate"] else "0.5",
        "vbnfault": result["vbnfault"],
    }


def _notes(result: Mapping[str, Any]) -> list[str]:
    """Return sentences on classes that are no matter of course."""
    notes = []
    if unknown := [name for name, one in result["classes"].items() if not one["predicted_by_model"]]:
        notes.append(f"Classes that the model does not know count as never predicted: {', '.join(unknown)}.")
    if left_out := [name for name in result["classes"] if name not in result["classes_in_means"]]:
        notes.append(f"No pixel of {', '.join(left_out)} is in the split, so that the means leave them out.")
    if ignored := [name for name in result["model"]["classes"] if name not in result["classes"]]:
        notes.append(f"The dataset does not have {', '.join(ignored)}, whose predictions are left out.")
    if result["options"]["calibrate"]:
        levels = ", ".join(f"{name} {one['threshold']:.3f}" for name, one in result["classes"].items())
        notes.append(f"Thresholds: {levels}.")
    return notes


def _alarm_rows(result: Mapping[str, Any]) -> list[list[str]]:
    """Return the table of false alarms, a row for each group of nominal frames."""
    return [
        [
            text,
            str(result["false_alarms"][key]["frames"]),
            *(
                with_interval(result["false_alarms"][key][name], percent=True)
                for name in ("frames_with_alarm", "frames_told_faulty", "pixels_fraction")
            ),
        ]
        for key, text in _GROUPS.items()
    ]


def _severity_rows(result: Mapping[str, Any]) -> list[list[str]]:
    """Return the table of severity, the last row of which is all classes together; empty without any prediction."""
    named = [*((name, one["severity"]) for name, one in result["classes"].items()), ("all", result["severity"])]
    return [
        [
            name,
            str(one["known"]),
            str(one["truth_unknown"]),
            with_interval(one["mean_absolute_error"]),
            with_interval(one["within_one_level"], percent=True),
        ]
        for name, one in named
        if result["severity"]["known"]
    ]


TIME = ["class", "events", "missed", "delay / s, median", "largest", "false alarms an hour", "flicker"]


def _time_rows(time: Mapping[str, Any] | None) -> list[list[str]]:
    """Return the table of events, the last row of which is all classes together; empty without sequences."""
    if time is None:
        return []
    return [
        [
            name,
            str(one["events"]),
            with_interval(one["missed_fraction"], percent=True),
            with_interval(one["delay_s_median"]),
            "–" if one["delay_s_largest"] is None else f"{one['delay_s_largest']:.4g}",
            with_interval(one["false_alarms_per_hour"]),
            with_interval(one["flicker"], percent=True),
        ]
        for name, one in {**time["classes"], **{key: time[key] for key in (ANY, "all") if key in time}}.items()
    ]


def _reaction_rows(reactions: Mapping[str, Any]) -> list[list[str]]:
    """Return how often each reaction was given, the head and a row for each right one."""
    table = reactions["given"]
    heads = ["right reaction", *(f"{name} given" for name in next(iter(table.values())))]
    return [heads, *([right, *map(str, given.values())] for right, given in table.items())]


def _navigation_rows(navigation: Mapping[str, Any]) -> list[list[str]]:
    """Return the errors of navigation, a column for each mask."""
    limb, matches, poses = (navigation.get(name) for name in ("limb_rms_px", "matches", "relative_pose"))
    rows: list[list[str]] = []
    if limb and limb["frames"]:
        cells = [with_interval(limb[v]["median"]) for v in VARIANTS]
        rows.append([f"limb, RMS, median of {limb['frames']} frames / px", *cells, ""])
        cells = [with_interval(limb[v]["hidden_fraction"], percent=True) for v in VARIANTS]
        rows.append(["limbs that the mask hides", *cells, ""])
    if matches and matches["frames"]:
        for key, text in (
            ("wrong_fraction", "wrong ORB matches"),
            ("right_fraction_of_unmasked", "right ORB matches, of those without mask"),
        ):
            cells = [with_interval(matches[v][key], percent=True) for v in VARIANTS]
            rows.append([f"{text}, {matches['frames']} frames", *cells, ""])
    if poses and poses["pairs"]:
        for key, text in (("rotation_deg", "rotation / °"), ("translation_deg", "direction of translation / °")):
            cells = [with_interval(poses[v][key]) for v in _MASKS]
            rows.append([f"{text}, median of {poses['pairs']} pairs", *cells])
    return rows


def _reasons(navigation: Mapping[str, Any]) -> list[str]:
    """Return sentences on errors of navigation that could not be measured."""
    names = {"limb_rms_px": "limb", "relative_pose": "relative pose"}
    return [
        f"There is no error of the {text}: {navigation[key]['reason']}."
        for key, text in names.items()
        if navigation.get(key, {}).get("reason")
    ]


# --- plots --------------------------------------------------------------------------------------------------------


def _grid(count: int) -> tuple[int, int]:
    """Return rows and columns for a number of panels."""
    across = min(count, _ACROSS)
    return -(-count // across), across


@contextlib.contextmanager
def _panel_of_each(
    classes: Mapping[str, Any], below: str, left: str, legend: Sequence[Any] = ()
) -> Iterator[tuple[Any, list[tuple[Any, Any]]]]:
    """Give a figure, and a labelled panel with axes from 0 to 1 for each class, with its result."""
    rows, across = _grid(len(classes))
    with panels("", (rows, across), _PANEL, legend=legend) as (figure, axes):
        yield figure, list(zip(axes, classes.values(), strict=False))
        for k, (one, name) in enumerate(zip(axes, classes, strict=False)):
            one.set(xlim=(-0.03, 1.03), ylim=(-0.03, 1.03), xticks=(0, 0.5, 1), yticks=(0, 0.5, 1))
            one.set_title(wrapped(name, 24))
            if k % across == 0:
                one.set_ylabel(left)
            if k + across >= len(classes):
                one.set_xlabel(below)
        for one in axes[len(classes) :]:
            one.set_axis_off()


def _curves(result: Mapping[str, Any]) -> Markup:
    """Return precision over recall of each class, with a mark at its threshold."""
    legend = [
        Line2D([], [], color=BLUE, label="any threshold"),
        Line2D([], [], color=INK, marker="o", ls="", label="threshold of the score"),
    ]
    with _panel_of_each(result["classes"], "recall", "precision", legend) as (figure, axes):
        for one, of_class in axes:
            curve, pixels = of_class["curve"], of_class["pixels"]
            if of_class["predicted_by_model"] and curve["recall"]:
                # the precision of a threshold holds from the recall of the next higher one, or 0, to its own
                recall, precision = [*curve["recall"], 0.0], [*curve["precision"], curve["precision"][-1]]
                one.step(recall, precision, color=BLUE, where="post")
            else:
                write_message(one, "never predicted" if curve["recall"] else "not in the split")
            if pixels["precision"]["value"] is not None and pixels["recall"]["value"] is not None:
                one.plot(pixels["recall"]["value"], pixels["precision"]["value"], "o", color=INK, ms=5, zorder=4)
    return inline_svg(svg_text(figure), "curves", "Precision over recall of each class")


def _reliability(result: Mapping[str, Any]) -> Markup:
    """Return frequency over mean probability of each class; larger dots stand for more pixels."""
    with _panel_of_each(result["classes"], "probability", "frequency") as (figure, axes):
        for one, of_class in axes:
            bins = of_class["calibration"]["pixel_reliability"]
            size = np.log10([b["count"] + 1.0 for b in bins])
            one.plot((0, 1), (0, 1), color=MUTED, lw=0.8, ls=(0, (3, 2)))
            x, y = ([b[key] for b in bins] for key in ("mean_probability", "frequency"))
            one.plot(x, y, color=BLUE, lw=0.8)
            one.scatter(x, y, s=3.5 * size**2, color=BLUE, zorder=3, linewidths=0, clip_on=False)
    return inline_svg(svg_text(figure), "reliability", "Frequency over probability of each class")


def _dots(axes: Any, figures: Sequence[Mapping[str, Any]], offset: float, series: int) -> None:
    """Draw figures with their intervals, a row each."""
    for y, figure in enumerate(figures):
        if figure["value"] is None:
            continue
        if figure["low"] is not None:
            axes.plot((figure["low"], figure["high"]), (y + offset,) * 2, color=SERIES_COLOURS[series], lw=1.4)
        axes.plot(
            figure["value"],
            y + offset,
            SERIES_MARKERS[series],
            color=SERIES_COLOURS[series],
            ms=4.5,
            clip_on=False,
            zorder=4,
        )


def _series(names: Sequence[str]) -> list[Line2D]:
    """Return the legend of series of dots."""
    return [
        Line2D([], [], color=SERIES_COLOURS[k], marker=SERIES_MARKERS[k], label=name)
        for k, name in enumerate(names)
    ]


def _presence(result: Mapping[str, Any]) -> Markup:
    """Return average precision and area under the ROC of presence by class."""
    labels = list(result["classes"])
    with panels("", (1, 1), (330.0, 24.0 * len(labels)), legend=_series(("average precision", "ROC AUC"))) as (
        figure,
        (axes,),
    ):
        label_rows([axes], labels)
        for k, key in enumerate(("average_precision", "roc_auc")):
            _dots(axes, [one["presence"][key] for one in result["classes"].values()], 0.24 * k - 0.12, k)
        axes.set_xlim(0, 1.02)
    return inline_svg(svg_text(figure), "presence", "Presence of each class: average precision and ROC AUC")


def _alarms(result: Mapping[str, Any]) -> Markup:
    """Return the fraction of nominal frames with an alarm by class, with the Sun in view and without."""
    groups = [key for key in ("sun_in_view", "no_sun_in_view") if result["false_alarms"][key]["frames"]]
    labels = ["any class", *result["classes"]]
    legend = _series([f"{_GROUPS[key]} ({result['false_alarms'][key]['frames']} frames)" for key in groups])
    height = max(24.0, row_height(labels)) * len(labels)
    with panels("", (1, 1), (330.0, height), legend=legend) as (figure, (axes,)):
        label_rows([axes], labels)
        axes.axhline(0.5, color=GRID, lw=0.8)
        for k, key in enumerate(groups):
            group = result["false_alarms"][key]
            _dots(axes, [group["frames_with_alarm"], *group["classes"].values()], 0.24 * k - 0.12, k)
        axes.set_xlim(-0.01, 1.02)
        axes.set_xlabel("fraction of the frames without a fault")
    return inline_svg(svg_text(figure), "alarms", "Fraction of nominal frames with an alarm by class")


# --- worst cases --------------------------------------------------------------------------------------------------


def _cases(
    samples: Samples, tally: Tally, thresholds: NDArray[np.int64]
) -> list[tuple[str, list[tuple[str, str]]]]:
    """Return the worst frames of each class: heading, and caption and image of each."""
    iou, names = class_iou(tally, thresholds), samples.classes
    nominal = ~samples.column("injected").astype(bool).any(axis=1)
    wanted: list[tuple[int, int]] = []  # row and class, -1 for a false alarm of any
    for c in range(len(names)):
        has_truth = tally.histograms[:, c, 1].any(axis=1)
        rows = np.flatnonzero(has_truth)
        wanted += [(int(row), c) for row in rows[np.argsort(iou[rows, c], kind="stable")][:_CASES]]
    alarmed = np.flatnonzero(nominal & (tally.predicted_px[:, -1] > 0))
    alarmed = alarmed[np.argsort(-tally.predicted_px[alarmed, -1], kind="stable")][:_CASES]
    wanted += [(int(row), -1) for row in alarmed]
    drawn = dict(_drawn(samples, wanted, thresholds))
    headings = [*(f"Lowest IoU of {name}" for name in names), "Largest false alarms in frames without a fault"]
    cases = []
    for heading, c in zip(headings, [*range(len(names)), -1], strict=True):
        shown = [(row, drawn[row, c]) for row, of_class in wanted if of_class == c]
        captions = [
            f"sample {samples.indices[row]}: "
            + (f"IoU {number_text(iou[row, c])}" if c >= 0 else f"{tally.predicted_px[row, -1]} px")
            for row, _ in shown
        ]
        if shown:
            cases.append((heading, [(text, url) for text, (_, url) in zip(captions, shown, strict=True)]))
    return cases


def _drawn(samples: Samples, wanted: Sequence[tuple[int, int]], thresholds: NDArray[np.int64]) -> Any:
    """Yield each wanted row and class with its image: the frame, the true mask and the predicted one beside it."""
    rows = sorted({row for row, _ in wanted})
    of_row = {
        row: [c for _, c in group] for row, group in itertools.groupby(sorted(wanted), key=lambda pair: pair[0])
    }
    for batch in samples.batches(rows, ["masks"]):
        for k, row in enumerate(batch.rows.tolist()):
            for c in of_row[row]:
                yield (row, c), image_url(_side_by_side(samples, batch, k, c, thresholds), 3 * _SIDE_PX)


def _side_by_side(samples: Samples, batch: Batch, k: int, c: int, thresholds: NDArray[np.int64]) -> U8:
    """Return a frame, the same with the true mask, and with the predicted one; `c` = -1: masks of all classes."""
    spec, rgb = samples.store.spec, batch.layers["image"][k][..., :3]
    predicted = batch.predictions[k][0] >= thresholds[:, None, None]
    truth = next(batch.layers[name] for name in batch.layers if name != "image")[k]
    chosen = list(range(len(spec.faults))) if c < 0 else [c]
    localised = [spec.faults[i] in (spec.localised_faults or ()) for i in chosen]
    shown = [rgb]
    for masks in (truth[chosen], predicted[chosen]):
        shown.append(overlay(rgb, masks, [bool(mask.any()) for mask in masks], localised))
    gap = np.full((len(rgb), max(1, rgb.shape[1] * _GAP_PX // _SIDE_PX), 3), 128, np.uint8)
    return np.hstack([shown[0], gap, shown[1], gap, shown[2]])
