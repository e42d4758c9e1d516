"""Score a detector, a folder of masks of any other program, or a monitor's log, against the labels of a store.

One pass over the samples counts, a batch at a time (`Tally`); all figures and intervals follow from the counts. The
pages read the few samples again that they show.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .. import __version__
from ..core.errors import InputError
from ..core.files.path_checks import check_folder
from ..core.files.whole_files import own, write_json, writing
from ..store import MASK_RULES, Store, is_store, open_store
from ..train import Columns, select
from . import navigation_scores as nav
from .artefacts import artefact_counts, artefact_labels, flares_of
from .figures import json_result
from .mask_folder import MODEL_FILE, MaskFolder
from .monitor_log import is_log, log_result
from .prediction import Detector
from .scored_samples import ALL, EFFECT, FOOTPRINT, OfImages, Samples, ScoreOptions
from .scores import BINS, HALF, best_threshold, histogram

I64 = NDArray[np.int64]

FILE, TABLE, PAGE = "score.json", "score.md", "score.html"


class Tally:
    """Hold the counts of each sample, a row each.

    Attributes
    ----------
    histograms
        uint32[sample, class, 2, 256]: pixels without and with the class, by bin of the probability.
    artefacts
        float64[sample, class, 5]: `artefacts.COUNTS`.
    predicted_px
        int64[sample, class + 1]: pixels of each predicted mask, and of the union of all.
    union
        int64[sample, 4]: true positives, false positives, false negatives and true negatives of the union of the
        predicted masks over the classes of `mask_any`. The truth is `mask_any`, or the union of their effects if
        the masks are effects.
    present, severity
        What the predictions say, float32[sample, class] each.
    usable
        float64[sample, 2]: usable fraction as predicted, and outside `mask_any`.
    errors
        float64[sample, variant, 3]: `navigation_scores.frame_errors`; nan where no fault is injected.
    """

    def __init__(self, samples: int, classes: int) -> None:
        self.histograms = np.zeros((samples, classes, 2, BINS), np.uint32)
        self.artefacts = np.zeros((samples, classes, 5))
        self.predicted_px = np.zeros((samples, classes + 1), np.int64)
        self.union = np.zeros((samples, 4), np.int64)
        self.present = np.zeros((samples, classes), np.float32)
        self.severity = np.full((samples, classes), np.nan, np.float32)
        self.usable = np.full((samples, 2), np.nan)
        self.errors = np.full((samples, len(nav.VARIANTS), 3), np.nan)


def score(
    model: str | os.PathLike[str] | Detector,
    dataset: str | os.PathLike[str] | Store,
    out: Path,
    options: ScoreOptions | None = None,
    advance: Callable[[int, int], Any] = lambda done, of: None,
) -> dict[str, Any]:
    """Score a model on a dataset, and write `score.json`, `score.md` and `score.html` to a folder.

    Parameters
    ----------
    model
        Folder of a detector or of masks (`MaskFolder`), an object that detects, or a monitor's log.
    dataset
        A store or its path.
    out
        Folder, made if missing.
    advance
        Called with the number of finished steps and of all.

    Returns
    -------
    dict
        What `score.json` holds.

    Raises
    ------
    InputError
        The model, the store or the split cannot be used.
    VbnfaultError
        A sample is damaged, or a file cannot be written.
    """
    from .score_page import write_log_pages, write_pages  # matplotlib is loaded only for the pages

    options, store = options or ScoreOptions(), open_store(dataset)
    check_folder(out)
    if is_store(out) or (out / MODEL_FILE).is_file():
        kind = "store" if is_store(out) else "model"
        raise InputError(f"{out}: is a {kind}, in which no other file may lie; choose another --out")
    if not store.spec.faults:
        raise InputError(f"{store.path}: it has no fault class, so there is nothing to detect")
    head = {
        "kind": "vbnfault score",
        "version": 1,
        "vbnfault": __version__,
        "name": options.name or _name(model),
    }
    if is_log(model):
        of_log = log_result(str(model), store, options)  # refuses a wrong log before the store is read
        result = {**head, "dataset": _described(store), **of_log}
        with writing(out, within=True):
            out.mkdir(parents=True, exist_ok=True)
            write_json(own(out / FILE), result)
            write_log_pages(out, result)
        return result
    samples = _samples(store, model, options, options.split)
    thresholds = np.full(len(store.spec.faults), HALF)
    steps = len(samples.indices)
    before = _samples(store, model, options, "val") if options.calibrate else None
    if before is not None:
        steps += len(before.indices)
        counted = _tally(before, thresholds, lambda done: advance(done, steps), only_histograms=True)
        thresholds = np.array([best_threshold(h) for h in counted.histograms.sum(axis=0, dtype=np.int64)])
    begun = 0 if before is None else len(before.indices)
    tally = _tally(samples, thresholds, lambda done: advance(begun + done, steps))
    pairs, reason = _pairs(samples, thresholds) if options.navigation else (None, "--no-navigation")
    result = {
        **head,
        "model": {
            "name": _name(model),
            "sha256": samples.predictor.sha256,
            "classes": list(samples.predictor.classes),
        },
        "dataset": _described(store),
        "options": {
            "split": options.split,
            "masks": samples.masks,
            "calibrate": options.calibrate,
            "seed": options.seed,
        },
        **json_result(samples, tally, thresholds, pairs, reason),
    }
    with writing(out, within=True):
        out.mkdir(parents=True, exist_ok=True)
        write_json(own(out / FILE), result)
        write_pages(out, result, samples, tally, thresholds)
    return result


# --- reading ------------------------------------------------------------------------------------------------------


def _samples(store: Store, model: Any, options: ScoreOptions, split: str) -> Samples:
    """Return the samples of a split with the predictor of the model."""
    indices = select(store, None if split == ALL else split)
    if not isinstance(model, str | os.PathLike):
        return Samples(store, OfImages(model), options, indices)
    path = Path(model)
    if not path.is_dir():
        raise InputError(f"{path}: there is no such folder; a model is a folder with {MODEL_FILE}, or one of masks")
    if (path / MODEL_FILE).is_file():
        from .networks import load_detector, read_model  # only this needs PyTorch

        detector = load_detector(path)  # refuses a damaged file
        return Samples(store, OfImages(detector, read_model(path)["weights_sha256"]), options, indices)
    columns = Columns(store)
    splits = columns["split"][np.searchsorted(columns.samples, indices)].tolist()
    masks = MaskFolder(path, store, indices.tolist(), splits, options.masks or FOOTPRINT)
    return Samples(store, masks, options, indices)


def _name(model: Any) -> str:
    """Return the name of a model: that of its folder, or of its class."""
    return Path(model).resolve().name if isinstance(model, str | os.PathLike) else type(model).__name__


def _described(store: Store) -> dict[str, Any]:
    """Return what the score says of the store."""
    from ..output.export.run import contents_sha256

    return {
        "name": store.path.name,
        "sha256": contents_sha256(store),
        "samples": store.samples,
        "classes": list(store.spec.faults),
        "width_px": store.spec.width,
        "height_px": store.spec.height,
    }


# --- counting -----------------------------------------------------------------------------------------------------


def _tally(
    samples: Samples, thresholds: I64, advance: Callable[[int], Any], *, only_histograms: bool = False
) -> Tally:
    """Return the counts of all samples at thresholds, a bin for each class."""
    spec, tally = samples.store.spec, Tally(len(samples.indices), len(samples.classes))
    injected = samples.column("injected").astype(bool)
    in_any = [samples.classes.index(name) for name in spec.mask_any_faults]
    has_semantic = "semantic" in spec.pixel_layers
    flares = [] if only_histograms else flares_of(samples.store, samples.indices)
    names = ["masks"] if only_histograms else ["masks", "mask_any", "clean", *["semantic"] * has_semantic]
    mask_layer, done = MASK_RULES[samples.masks], 0
    for batch in samples.batches(np.arange(len(samples.indices)), names):
        for k, row in enumerate(batch.rows.tolist()):
            bins, prediction = batch.predictions[k]
            truth = batch.layers[mask_layer][k]
            for c in range(len(samples.classes)):
                tally.histograms[row, c] = histogram(truth[c], bins[c])
            if only_histograms:
                continue
            predicted = bins >= thresholds[:, None, None]
            for c, labels in enumerate(artefact_labels(spec, truth, flares[row])):
                tally.artefacts[row, c] = artefact_counts(labels, predicted[c])
            tally.predicted_px[row] = [*predicted.sum(axis=(1, 2)), predicted.any(axis=0).sum()]
            union, bad = predicted[in_any].any(axis=0), batch.layers["mask_any"][k]
            tally.usable[row] = prediction.usable_fraction, 1 - bad.mean()
            bad = truth[in_any].any(axis=0) if samples.masks == EFFECT else bad
            hit, wrong, missed = (np.count_nonzero(m) for m in (union & bad, union & ~bad, ~union & bad))
            tally.union[row] = hit, wrong, missed, bad.size - hit - wrong - missed
            tally.present[row], tally.severity[row] = prediction.present, prediction.severity
            if samples.options.navigation and injected[row].any():
                semantic = batch.layers["semantic"][k] if has_semantic else None
                masks = [np.zeros_like(bad), np.asarray(union), bad]
                images = batch.layers["clean"][k], batch.layers["image"][k]
                tally.errors[row] = nav.frame_errors(*images, semantic, masks)
        done += len(batch.rows)
        advance(done)
    return tally


def _pairs(samples: Samples, thresholds: I64) -> tuple[tuple[NDArray[np.float64], I64] | None, str]:
    """Return errors of relative poses with the row of each pair's first sample, or None and why there are none."""
    spec = samples.store.spec
    if "depth_m" not in spec.pixel_layers:
        return None, "the store has no layer depth_m"
    of_pose = ("camera_position_T_m", "camera_from_T", "sun_direction_T", "site", "injected")
    scalars = {name: samples.column(name) for name in (*of_pose, "intrinsics", "distortion")}
    candidates = nav.candidate_pairs(scalars)
    in_any = [samples.classes.index(name) for name in spec.mask_any_faults]
    errors, rows = [], []
    for i, others in candidates[:: -(-len(candidates) // nav.MOST_PAIRS) or 1]:
        first = next(samples.batches([i], ["depth_m"], predict=False))
        view = nav.view_of(spec, scalars, i, first.layers["depth_m"][0])
        for j in others:
            views = view, nav.view_of(spec, scalars, j, None)
            if not nav.sees_the_same(*views, (spec.height, spec.width)):
                continue
            (pair,) = samples.batches([i, j], ["clean", "masks", "mask_any"], size=2)
            unions = [np.any((bins >= thresholds[:, None, None])[in_any], axis=0) for bins, _ in pair.predictions]
            masks: list[list[Any]] = [
                [np.zeros_like(mask) for mask in unions],
                unions,
                [layers[in_any].any(axis=0) for layers in pair.layers[MASK_RULES[EFFECT]]]
                if samples.masks == EFFECT
                else list(pair.layers["mask_any"]),
            ]
            found = nav.pair_errors(views, list(pair.layers["image"]), list(pair.layers["clean"]), masks)
            if found is not None:
                errors.append(found)
                rows.append(i)
            break
    if not errors:
        return None, (
            "no faulty sample shares half of its ground with another one of its site, under a Sun within 10 "
            "degrees of its own, so that their clean twins give a pose"
        )
    return (np.array(errors), np.array(rows)), ""
