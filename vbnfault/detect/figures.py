"""Turn the counts of samples into the figures of `score.json`, each with its interval."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from . import navigation_scores as nav
from .artefacts import artefact_figures
from .scores import (
    BINS,
    HALF,
    RELIABILITY_BINS,
    Bootstrap,
    Estimate,
    average_precision,
    binned,
    calibration_error,
    counts_at,
    histogram,
    pixel_figures,
    precision_recall,
    ratio,
    reliability,
    roc_auc,
)
from .severity_labels import severity_labels
from .time_scores import Frames, time_figures

if TYPE_CHECKING:
    from .scored_samples import Samples
    from .scoring import Tally

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

MEANS = ("iou", "precision", "recall", "f1", "average_precision", "par", "pap", "pamiou", "presence_ap")
PRESENT = 0.5  # probability from which on a class is told present
_WITHIN = 1.0  # level of severity


def json_result(
    samples: Samples, tally: Tally, thresholds: I64, pairs: tuple[F64, I64] | None, no_pairs: str
) -> dict[str, Any]:
    """Return the figures of a score as plain data.

    Parameters
    ----------
    samples, tally
        What was scored, and its counts.
    thresholds
        The bin of each class from which on a pixel is predicted.
    pairs, no_pairs
        Errors of relative poses with the row of each pair's first sample, or None and why there are none.
    """
    views = view_numbers(samples)
    bootstrap = Bootstrap(views, samples.options.seed)
    injected = samples.column("injected").astype(bool)
    severity = severity_labels(samples.store, samples.indices)
    classes: dict[str, Any] = {}
    estimates: dict[str, list[Estimate]] = {name: [] for name in MEANS}
    for c, name in enumerate(samples.classes):
        counted = tally.histograms[:, c].sum(axis=0, dtype=np.int64)
        pixels = bootstrap.figures(tally.histograms[:, c], partial(_of_pixels, threshold=int(thresholds[c])))
        artefacts = bootstrap.figures(tally.artefacts[:, c], artefact_figures)
        presence, of_frames = _presence(bootstrap, injected[:, c], tally.present[:, c])
        number = tally.artefacts[:, c].sum(axis=0)
        eces = {"pixel_ece": pixels.pop("ece"), "presence_ece": presence.pop("ece")}
        classes[name] = {
            "predicted_by_model": c in samples.known,
            "threshold": (int(thresholds[c]) - 0.5) / (BINS - 1),
            "frames": int(injected[:, c].sum()),
            "true_pixels_fraction": float(ratio(counted[1].sum(), counted.sum())),
            "pixels": _plain(pixels),
            "artefacts": {"true": int(number[0]), "predicted": int(number[3]), **_plain(artefacts)},
            "presence": _plain(presence),
            "calibration": {
                **_plain(eces),
                "pixel_reliability": _reliability(counted),
                "presence_reliability": _reliability(of_frames),
            },
            "severity": _severity(bootstrap, injected[:, c], severity[:, c], tally.severity[:, c]),
            "curve": _curve(counted),
        }
        if counted[1].any():
            found = {**pixels, **artefacts, "presence_ap": presence["average_precision"]}
            for of_mean in MEANS:
                estimates[of_mean].append(found[of_mean])
    return {
        "samples": len(samples.indices),
        "views": bootstrap.views,
        "classes_in_means": [name for name, one in classes.items() if one["true_pixels_fraction"] > 0],
        "mean": {name: Estimate.mean(values).plain() for name, values in estimates.items()},
        "classes": classes,
        "severity": _severity(bootstrap, injected, severity, tally.severity),
        "false_alarms": _false_alarms(samples, tally, bootstrap, injected),
        "navigation": _navigation(samples, tally, bootstrap, views, pairs, no_pairs),
        "time": _time(samples, tally, injected),
    }


def _time(samples: Samples, tally: Tally, injected: NDArray[np.bool_]) -> dict[str, Any] | None:
    """Return what is seen when in the sequences of a store; None if it has none."""
    if not samples.store.spec.sequence_names:
        return None
    sequence, time_s = samples.column("sequence"), samples.column("time_s")
    drawn, said = list(samples.store.drawn(samples.indices)), tally.present >= PRESENT
    frames = Frames.of(sequence.astype(np.int64), time_s, injected, said, drawn, tuple(samples.classes))
    return time_figures(frames, tuple(samples.classes), samples.options.seed)


def view_numbers(samples: Samples) -> I64:
    """Return the number of each sample's view, int64[sample].

    Samples with the same position, attitude and Sun are of one view. A sample without a pose, such as an injected
    image, is a view of its own.
    """
    names = ("camera_position_T_m", "camera_from_T", "sun_direction_T")
    pose = np.concatenate([samples.column(name) for name in names], axis=1)
    number = np.unique(np.nan_to_num(pose), axis=0, return_inverse=True)[1].ravel()
    without = ~np.isfinite(pose).all(axis=1)
    number[without] = len(pose) + np.arange(np.count_nonzero(without))
    return np.asarray(number, dtype=np.int64)


def _plain(estimates: Mapping[str, Estimate]) -> dict[str, Any]:
    """Return estimates for JSON."""
    return {name: estimate.plain() for name, estimate in estimates.items()}


def _of_pixels(sums: F64, threshold: int) -> dict[str, F64]:
    """Return the figures of a class of histograms float64[n, 2, 256]."""
    return {
        **pixel_figures(sums, threshold),
        "average_precision": average_precision(sums),
        "ece": calibration_error(sums),
    }


def _presence(
    bootstrap: Bootstrap, truth: NDArray[np.bool_], present: NDArray[np.float32]
) -> tuple[dict[str, Estimate], I64]:
    """Return how well a class is told present or not, and a histogram of the frames, int64[2, 256]."""
    bins = binned(present)
    histograms = np.stack([histogram(t, b) for t, b in zip(truth[:, None], bins[:, None], strict=True)])
    figures = bootstrap.figures(
        histograms, lambda sums: {"f1": pixel_figures(sums, HALF)["f1"], "ece": calibration_error(sums)}
    )
    areas = {"average_precision": average_precision, "roc_auc": roc_auc}
    ranked = {name: bootstrap.ranked(truth, present, area) for name, area in areas.items()}
    return {**ranked, **figures}, histograms.sum(axis=0)


def _severity(
    bootstrap: Bootstrap, injected: NDArray[np.bool_], truth: NDArray[Any], predicted: NDArray[Any]
) -> dict[str, Any]:
    """Return the errors of severity in levels over faulty frames whose true and predicted levels are known."""
    known = injected & np.isfinite(truth) & np.isfinite(predicted)
    error = np.where(known, np.abs(np.nan_to_num(truth) - np.nan_to_num(predicted)), 0.0).reshape(len(known), -1)
    known = known.reshape(len(known), -1)
    number = known.sum(axis=1)
    return {
        "known": int(number.sum()),
        "truth_unknown": int((injected & ~np.isfinite(truth)).sum()),
        "mean_absolute_error": bootstrap.fraction(error.sum(axis=1), number).plain(),
        "within_one_level": bootstrap.fraction(((error <= _WITHIN) & known).sum(axis=1), number).plain(),
    }


def _reliability(histograms: NDArray[Any]) -> list[dict[str, Any]]:
    """Return the bins of a reliability diagram that hold a pixel, or a frame."""
    number, expected, positive = reliability(histograms)
    return [
        {
            "from": k / RELIABILITY_BINS,
            "to": (k + 1) / RELIABILITY_BINS,
            "count": int(number[k]),
            "mean_probability": float(expected[k] / number[k]),
            "frequency": float(positive[k] / number[k]),
        }
        for k in np.flatnonzero(number)
    ]


def _curve(histograms: NDArray[Any]) -> dict[str, list[float]]:
    """Return the precision-recall curve where it changes, thresholds rising."""
    precision, recall = precision_recall(histograms)
    changes = np.flatnonzero(np.any(histograms, axis=0) & np.isfinite(recall) & np.isfinite(precision))
    columns = {
        "threshold": (changes - 0.5).clip(0) / (BINS - 1),
        "precision": precision[changes],
        "recall": recall[changes],
    }
    return {name: [round(float(v), 6) for v in values] for name, values in columns.items()}


def _false_alarms(
    samples: Samples, tally: Tally, bootstrap: Bootstrap, injected: NDArray[np.bool_]
) -> dict[str, Any]:
    """Return how often a fault is seen in frames without one, with the Sun in view and without."""
    nominal, spec = ~injected.any(axis=1), samples.store.spec
    with np.errstate(invalid="ignore"):
        xy, visible = samples.column("sun_xy_px"), samples.column("sun_visible_fraction")
        in_view = ((xy >= 0) & (xy < (spec.width, spec.height))).all(axis=1) & ~(visible <= 0)
    alarm = tally.predicted_px > 0
    told = (tally.present >= PRESENT).any(axis=1)
    out: dict[str, Any] = {}
    for name, chosen in (
        ("all", nominal),
        ("sun_in_view", nominal & in_view),
        ("no_sun_in_view", nominal & ~in_view),
    ):
        number = chosen.astype(np.float64)
        out[name] = {
            "frames": int(chosen.sum()),
            "frames_with_alarm": bootstrap.fraction(alarm[:, -1] & chosen, number).plain(),
            "frames_told_faulty": bootstrap.fraction(told & chosen, number).plain(),
            "pixels_fraction": bootstrap.fraction(
                tally.predicted_px[:, -1] * chosen, number * spec.width * spec.height
            ).plain(),
            "classes": {
                of_class: bootstrap.fraction(alarm[:, c] & chosen, number).plain()
                for c, of_class in enumerate(samples.classes)
            },
        }
    return out


def _navigation(
    samples: Samples,
    tally: Tally,
    bootstrap: Bootstrap,
    views: I64,
    pairs: tuple[F64, I64] | None,
    no_pairs: str,
) -> dict[str, Any]:
    """Return what the union of the predicted masks leaves a navigator, and the errors with it."""
    hit, wrong, missed, left = tally.union.T
    predicted, usable = tally.usable.T
    known = np.isfinite(predicted)
    out = {
        "classes": list(samples.store.spec.mask_any_faults),
        "good_pixels_kept": bootstrap.fraction(left, left + wrong).plain(),
        "bad_pixels_let_through": bootstrap.fraction(missed, hit + missed).plain(),
        "usable_fraction_mean_absolute_error": bootstrap.fraction(
            np.where(known, np.abs(np.nan_to_num(predicted) - usable), 0.0), known
        ).plain(),
    }
    if not samples.options.navigation:
        return out
    has_semantic = "semantic" in samples.store.spec.pixel_layers
    of_pairs = None if pairs is None else Bootstrap(views[pairs[1]], samples.options.seed)
    errors = np.empty((0, 4, 2)) if pairs is None else pairs[0]
    return {
        **out,
        **nav.frame_summary(tally.errors, bootstrap, "" if has_semantic else "the store has no layer semantic"),
        "relative_pose": nav.pair_summary(errors, of_pairs, no_pairs),
    }


def class_iou(tally: Tally, thresholds: I64) -> F64:
    """Return the IoU of each class in each sample, float64[sample, class]; nan where truth and mask are empty."""
    columns = []
    for c, threshold in enumerate(thresholds.tolist()):
        hit, wrong, missed = counts_at(tally.histograms[:, c], threshold)
        columns.append(ratio(hit, hit + wrong + missed))
    return np.stack(columns, axis=1)
