"""Scores of detectors: metrics against scikit-learn and closed forms, pages and commands."""

from __future__ import annotations

import dataclasses
import json
import math
import shutil
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from sklearn import metrics
from synthetic import FAULTS, LOCALISED, fake_sample, filled, make_spec

from vbnfault import navigation
from vbnfault import store as st
from vbnfault.core.errors import InputError, VbnfaultError
from vbnfault.core.quantities import BODY
from vbnfault.detect import Prediction, score_page
from vbnfault.detect.artefacts import artefact_counts, artefact_figures
from vbnfault.detect.figures import view_numbers
from vbnfault.detect.navigation_scores import VARIANTS, candidate_pairs, frame_errors, pair_errors
from vbnfault.detect.scores import (
    BINS,
    HALF,
    RESAMPLES,
    Bootstrap,
    average_precision,
    best_threshold,
    binned,
    calibration_error,
    histogram,
    pixel_figures,
    roc_auc,
)
from vbnfault.detect.scoring import ScoreOptions, score
from vbnfault.detect.severity_labels import severity_labels
from vbnfault.output.export import export_store
from vbnfault.output.export.regions import region_labels

# --- figures of counts --------------------------------------------------------------------------------------------


def drawn_pixels(seed: int = 1, size: int = 4000) -> tuple[np.ndarray, np.ndarray]:
    """Return a truth and probabilities that tell something of it, in multiples of 1/255."""
    rng = np.random.default_rng(seed)
    truth = rng.random(size) < 0.15
    return truth, np.rint(255 * np.clip(rng.normal(0.3 + 0.35 * truth, 0.2), 0, 1)) / 255


@pytest.mark.parametrize("threshold", [1, 60, HALF, 250])
def test_figures_of_pixels_are_those_of_scikit_learn(threshold: int) -> None:
    truth, probability = drawn_pixels()
    counted = histogram(truth, binned(probability))
    predicted = np.rint(255 * probability) >= threshold
    found = pixel_figures(counted, threshold)
    assert found["iou"] == pytest.approx(metrics.jaccard_score(truth, predicted))
    assert found["f1"] == pytest.approx(metrics.f1_score(truth, predicted))
    assert found["precision"] == pytest.approx(metrics.precision_score(truth, predicted))
    assert found["recall"] == pytest.approx(metrics.recall_score(truth, predicted))


def test_areas_are_those_of_scikit_learn() -> None:
    truth, probability = drawn_pixels()
    counted = histogram(truth, binned(probability))
    assert average_precision(counted) == pytest.approx(metrics.average_precision_score(truth, probability))
    assert roc_auc(counted) == pytest.approx(metrics.roc_auc_score(truth, probability))


def test_half_a_probability_is_predicted_and_less_is_not() -> None:
    assert binned(np.array([0.5, 0.4999, 0.0, 1.0])).tolist() == [HALF, HALF - 1, 0, BINS - 1]


def test_figures_of_nothing() -> None:
    """Nothing true and nothing predicted has no figure; a missed class has IoU 0, and no precision."""
    nothing, missed = np.zeros((2, BINS), int), np.zeros((2, BINS), int)
    nothing[0, 0] = missed[1, 0] = 10
    assert all(math.isnan(v) for v in pixel_figures(nothing, HALF).values())
    assert math.isnan(average_precision(nothing))
    assert math.isnan(roc_auc(nothing))
    found = pixel_figures(missed, HALF)
    assert (found["iou"], found["recall"], found["f1"]) == (0, 0, 0)
    assert math.isnan(found["precision"])


def test_the_best_threshold_has_the_best_f1() -> None:
    truth, probability = drawn_pixels(5)
    best = best_threshold(histogram(truth, binned(probability)))
    all_f1 = [metrics.f1_score(truth, np.rint(255 * probability) >= k) for k in range(1, BINS)]
    assert all_f1[best - 1] == max(all_f1)


def test_calibration_error_in_closed_form() -> None:
    """The frequency is the probability: 0. Sure of everything and right in half of it: 0.5. A mix: the mean."""
    calibrated, sure = np.zeros((2, BINS)), np.zeros((2, BINS))
    for k in (0, 51, 204):  # probabilities 0, 0.2, 0.8
        calibrated[:, k] = 1000 * (1 - k / 255), 1000 * k / 255
    sure[:, 255] = 500, 500
    assert calibration_error(calibrated) == pytest.approx(0)
    assert calibration_error(sure) == 0.5
    assert calibration_error(calibrated + 3 * sure) == pytest.approx(0.5 * 3000 / 6000)


# --- intervals ----------------------------------------------------------------------------------------------------


def test_the_interval_of_a_fraction_is_that_of_the_binomial() -> None:
    """Of 400 views 30 %: ±1.96 √(p q/n) = ±0.0449.

    The 2.5 % quantile of 1000 resamples has the standard error √(0.025 · 0.975/1000)/φ(1.96) = 0.084 σ: 3 of it
    are 0.0058, and the steps of 1/400 add half a step.
    """
    hit = np.arange(400) < 120
    found = Bootstrap(np.arange(400)).fraction(hit, np.ones(400))
    assert found.value == 0.3
    half = 1.96 * math.sqrt(0.3 * 0.7 / 400)
    assert found.interval == pytest.approx((0.3 - half, 0.3 + half), abs=0.0058 + 0.0013)


def test_samples_of_one_view_count_as_one() -> None:
    hit = np.arange(200) % 3 == 0
    once = Bootstrap(np.arange(200)).fraction(hit, np.ones(200))
    twice = Bootstrap(np.repeat(np.arange(200), 2)).fraction(np.repeat(hit, 2), np.ones(400))
    assert twice.interval == once.interval
    apart = Bootstrap(np.arange(400)).fraction(np.repeat(hit, 2), np.ones(400)).interval
    assert apart[1] - apart[0] < 0.85 * (once.interval[1] - once.interval[0])  # 1/√2 of it


def test_resampled_ranks_and_medians_are_those_of_repeated_samples() -> None:
    rng = np.random.default_rng(2)
    truth, scores = rng.random(30) < 0.4, np.round(rng.random(30), 1)
    bootstrap = Bootstrap(np.arange(30))
    area = bootstrap.ranked(truth, scores, average_precision)
    middle = bootstrap.median(np.where(truth, scores, np.nan))
    assert area.value == pytest.approx(metrics.average_precision_score(truth, scores))
    assert middle.value == np.median(scores[truth])
    for k in (0, 77, RESAMPLES - 1):
        repeated = np.repeat(np.arange(30), bootstrap._drawn[k].astype(int))
        assert area.resampled[k] == pytest.approx(
            metrics.average_precision_score(truth[repeated], scores[repeated])
        )
        assert middle.resampled[k] == np.median(scores[repeated][truth[repeated]])


# --- artefacts ----------------------------------------------------------------------------------------------------


def discs(*places: tuple[int, int]) -> np.ndarray:
    y, x = np.mgrid[:64, :64]
    return np.any([np.hypot(x - cx, y - cy) <= 4 for cx, cy in places], axis=0)


FIVE = (10, 10), (30, 10), (50, 10), (10, 40), (40, 40)


def artefacts(truth: np.ndarray, predicted: np.ndarray, flares: np.ndarray | None = None) -> dict[str, float]:
    found = artefact_figures(artefact_counts(region_labels(truth, flares), predicted))
    return {name: float(value) for name, value in found.items()}


def test_one_of_five_flares_is_missed_and_one_invented() -> None:
    found = artefacts(discs(*FIVE), discs(*FIVE[:4], (58, 58)))
    assert found == {"par": 0.8, "pap": 0.8, "pamiou": 0.8}


def test_artefacts_that_a_prediction_joins_are_all_found() -> None:
    truth = discs(*FIVE)
    joined = truth.copy()
    joined[10, 10:50] = True  # 2 × 11 px outside of the discs of radius 4: columns 15 to 25 and 35 to 45
    found, area = artefacts(truth, joined), int(discs(FIVE[0]).sum())
    assert found["par"] == found["pap"] == 1
    assert found["pamiou"] == pytest.approx((2 + 3 * area / (area + 22)) / 5)


def test_flares_that_touch_are_told_apart_by_their_discs() -> None:
    """Without the parameters two flares that touch are one, of which half is found."""
    flares = np.array([[20.5, 20.5, 8.0], [33.5, 20.5, 8.0]])
    y, x = np.mgrid[:64, :64] + 0.5
    each = [np.hypot(x - cx, y - cy) <= r for cx, cy, r in flares]
    truth = each[0] | each[1]
    assert artefacts(truth, each[0], flares)["par"] == 0.5
    assert artefacts(truth, each[0])["par"] == 1


def test_a_shifted_square_has_the_iou_of_the_hand() -> None:
    truth, predicted = np.zeros((32, 32), bool), np.zeros((32, 32), bool)
    truth[5:15, 5:15] = predicted[5:15, 8:18] = True
    assert artefacts(truth, predicted)["pamiou"] == pytest.approx(70 / 130)
    counted = histogram(truth, binned(predicted))
    assert pixel_figures(counted, HALF)["iou"] == pytest.approx(70 / 130)


def test_nothing_true_and_nothing_predicted() -> None:
    nothing = np.zeros((8, 8), bool)
    assert all(math.isnan(value) for value in artefacts(nothing, nothing).values())
    assert artefacts(~nothing, nothing) | {"pap": 0.0} == {"par": 0, "pap": 0, "pamiou": 0}
    assert artefacts(nothing, ~nothing)["pap"] == 0


# --- what a score of a store holds --------------------------------------------------------------------------------

SUN_INSIDE = (3, 7)  # samples whose Sun is in the frame; both have no fault


@pytest.fixture(scope="module")
def labelled(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a store of 16 samples, two of a view; 0 to 7 are in the split test, and every fourth has no fault."""
    spec = make_spec(48, layers=("mask_effect", "depth_m", "semantic"))
    store = st.create(tmp_path_factory.mktemp("labelled") / "labelled.zarr", spec, 16)
    samples = []
    for i in range(16):
        made = fake_sample(spec, i)
        injected = np.array([(i + k) % 3 != 0 for k in range(4)]) & (i % 4 != 3)
        mask = made.layers["mask"] & injected[:, None, None]
        for k, name in enumerate(FAULTS):
            if injected[k] and not mask[k].any():
                mask[k, 8 + 4 * k : 16 + 4 * k, 5 + i : 11 + i] = True
                mask[k] |= name not in LOCALISED
        effect = mask & (np.arange(56) % 2 == 0)
        layers = made.layers | {"mask": mask, "mask_effect": effect, "mask_any": mask[:3].any(axis=0)}
        layers["image"] = np.where(mask.any(axis=0)[..., None], 200, made.layers["clean"]).astype(np.uint8)
        layers["image"][0, 0, 0] = i  # each image is another one
        scalars = made.scalars | {
            "injected": injected,
            "parameters": {
                name: {"model": "gaussian", "x_px": [1.0] * (20 * i + 1)}
                for k, name in enumerate(FAULTS)
                if injected[k]
            },
            "split": "test" if i < 8 else "val",
            "camera_position_T_m": np.full(3, float(i // 2)),
            "camera_from_T": np.array([1.0, 0, 0, 0]),
            "sun_direction_T": np.array([1.0, 0, 0]),
            "intrinsics": np.array([50.0, 50, 28, 24]),
            "distortion": np.zeros(8),
            "sun_xy_px": np.array([20.0, 20.0]) if i in SUN_INSIDE else np.array([-5.0, 20.0]),
            "sun_visible_fraction": 1.0,
        }
        samples.append(dataclasses.replace(made, layers=layers, scalars=scalars))
    st.write_samples(store, samples)
    return store.path


class Known:
    """Detect by knowing the truth of each image of a store, and changing it."""

    def __init__(
        self,
        path: Path,
        change: Callable[[np.ndarray, int], np.ndarray] = lambda masks, i: masks,
        classes: tuple[str, ...] = FAULTS,
        **heads: Any,
    ) -> None:
        self.classes, self._change, self._heads = classes, change, heads
        store = st.open_store(path)
        read = [store.read_sample(i, ("image", "mask")) for i in range(store.samples)]
        self._of = {sample.layers["image"].tobytes(): (sample.layers["mask"], sample.index) for sample in read}
        self.asked: list[int] = []

    def predict(self, images: np.ndarray) -> list[Prediction]:
        self.asked.append(len(images))
        found = []
        for image in images:
            truth, index = self._of[image.tobytes()]
            masks = self._change(truth.astype(np.float32), index)[: len(self.classes)]
            values = {
                "present": masks.max(axis=(1, 2)),
                "severity": np.full(len(masks), np.nan, np.float32),
                "usable_fraction": math.nan,
            }
            values |= {name: head(index) for name, head in self._heads.items()}
            found.append(Prediction(masks=masks, **values))
        return found


def figures(*given: Any, **options: Any) -> dict[str, Any]:
    """Score without the pages, which take a second to draw."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(score_page, "write_pages", lambda *_: None)
        return score(*given, ScoreOptions(**options))


def scored(
    labelled: Path, tmp_path: Path, change: Any = lambda masks, i: masks, *, pages: bool = False, **options: Any
) -> dict[str, Any]:
    heads = options.pop("heads", {})
    detector = Known(labelled, change, options.pop("classes", FAULTS), **heads)
    if pages:
        return score(detector, labelled, tmp_path / "s", ScoreOptions(**options))
    return figures(detector, labelled, tmp_path / "s", **options)


def value(figure: dict[str, Any]) -> Any:
    return figure["value"]


def test_a_perfect_prediction_scores_one_everywhere(labelled: Path, tmp_path: Path) -> None:
    found = scored(labelled, tmp_path)
    assert {value(figure) for figure in found["mean"].values()} == {1.0}
    for of_class in found["classes"].values():
        assert {value(of_class["pixels"][name]) for name in ("iou", "precision", "recall", "f1")} == {1.0}
        assert value(of_class["calibration"]["pixel_ece"]) == value(of_class["calibration"]["presence_ece"]) == 0
        frames = of_class["calibration"]["presence_reliability"]
        assert [(b["frequency"], b["mean_probability"]) for b in frames] == [(0, 0), (1, 1)]
        assert sum(b["count"] for b in frames) == 8
        assert value(of_class["presence"]["roc_auc"]) == 1
    alarms = found["false_alarms"]
    assert (alarms["all"]["frames"], alarms["sun_in_view"]["frames"]) == (2, 2)
    assert value(alarms["all"]["frames_with_alarm"]) == 0
    assert value(alarms["no_sun_in_view"]["frames_with_alarm"]) is None
    assert value(found["navigation"]["good_pixels_kept"]) == 1
    assert value(found["navigation"]["bad_pixels_let_through"]) == 0
    limb = found["navigation"]["limb_rms_px"]
    assert limb["predicted"] == limb["true"]
    assert (found["samples"], found["views"]) == (8, 4)


def test_an_empty_prediction_finds_nothing(labelled: Path, tmp_path: Path) -> None:
    found = scored(labelled, tmp_path, lambda masks, i: 0 * masks, pages=True)
    assert {value(found["mean"][name]) for name in ("iou", "recall", "f1", "par", "pamiou")} == {0.0}
    assert value(found["mean"]["precision"]) is None
    assert value(found["navigation"]["good_pixels_kept"]) == 1
    assert value(found["navigation"]["bad_pixels_let_through"]) == 1
    limb = found["navigation"]["limb_rms_px"]
    assert limb["predicted"] == limb["without"]
    assert value(limb["without"]["hidden_fraction"]) in (0, None)


def test_a_detector_is_scored_by_what_it_learned(labelled: Path, tmp_path: Path) -> None:
    detector, store = Known(labelled), st.open_store(labelled)
    detector.masks = "effect"  # type: ignore[attr-defined]
    found = figures(detector, labelled, tmp_path / "s", navigation=False)
    assert found["options"]["masks"] == "effect"
    both = [store.read_sample(i, ("mask", "mask_effect")).layers for i in range(8)]
    all_px, seen_px = (np.sum([one[name][:3].any(axis=0) for one in both]) for name in ("mask", "mask_effect"))
    assert value(found["classes"][FAULTS[3]]["pixels"]["precision"]) == 0.5
    assert value(found["classes"][FAULTS[3]]["pixels"]["recall"]) == 1
    kept = 1 - (all_px - seen_px) / (8 * 48 * 56 - seen_px)
    assert value(found["navigation"]["good_pixels_kept"]) == pytest.approx(kept)
    again = figures(detector, labelled, tmp_path / "s", navigation=False, masks="footprint")
    assert value(again["mean"]["iou"]) == 1


def test_pixel_figures_are_those_of_all_pixels_together(labelled: Path, tmp_path: Path) -> None:
    def noisy(masks: np.ndarray, index: int) -> np.ndarray:
        rng = np.random.default_rng(index)
        return np.clip(0.6 * np.roll(masks, 2, axis=2) + rng.uniform(-0.1, 0.4, masks.shape), 0, 1).astype(
            np.float32
        )

    found = scored(labelled, tmp_path, noisy, navigation=False, batch=3)
    store = st.open_store(labelled)
    truth = np.stack([store.read_sample(i, ("mask",)).layers["mask"] for i in range(8)])
    guess = np.stack([noisy(t.astype(np.float32), i) for i, t in enumerate(truth)])
    injected = store.read("injected")[:8]
    for k, name in enumerate(FAULTS):
        of_class, flat = found["classes"][name], (truth[:, k].ravel(), guess[:, k].ravel())
        assert value(of_class["pixels"]["iou"]) == pytest.approx(metrics.jaccard_score(flat[0], flat[1] >= 0.5))
        rounded = np.rint(255 * flat[1])
        expected = metrics.average_precision_score(flat[0], rounded)
        assert value(of_class["pixels"]["average_precision"]) == pytest.approx(expected)
        present = guess[:, k].max(axis=(1, 2))
        expected = metrics.roc_auc_score(injected[:, k], present)
        assert value(of_class["presence"]["roc_auc"]) == pytest.approx(expected)
    union, bad = (guess[:, :3] >= 0.5).any(axis=1), truth[:, :3].any(axis=1)
    assert value(found["navigation"]["good_pixels_kept"]) == pytest.approx((~union & ~bad).sum() / (~bad).sum())
    assert value(found["navigation"]["bad_pixels_let_through"]) == pytest.approx((~union & bad).sum() / bad.sum())


def test_false_alarms_with_the_sun_in_view_and_without(labelled: Path, tmp_path: Path) -> None:
    def alarms(masks: np.ndarray, index: int) -> np.ndarray:
        out = masks.copy()
        if index == 3:
            out[2, :4, :5] = 1
        return out

    found = scored(labelled, tmp_path, alarms, split="all", navigation=False)["false_alarms"]
    assert [found[name]["frames"] for name in ("all", "sun_in_view", "no_sun_in_view")] == [4, 2, 2]
    assert value(found["sun_in_view"]["frames_with_alarm"]) == 0.5
    assert value(found["no_sun_in_view"]["frames_with_alarm"]) == 0
    assert value(found["all"]["classes"][FAULTS[2]]) == 0.25
    assert value(found["all"]["classes"][FAULTS[1]]) == 0
    assert value(found["all"]["pixels_fraction"]) == pytest.approx(20 / (4 * 48 * 56))


def test_thresholds_are_calibrated_on_val_alone(labelled: Path, tmp_path: Path) -> None:
    def timid(masks: np.ndarray, index: int) -> np.ndarray:
        return 0.2 + 0.2 * masks if index >= 8 else 0.1 + 0.3 * masks

    assert value(scored(labelled, tmp_path, timid)["mean"]["iou"]) == 0
    found = scored(labelled, tmp_path, timid, calibrate=True)
    assert value(found["mean"]["iou"]) == 1
    # the lowest that tells 0.4 from 0.2 = 51/255, which samples of val alone have
    assert found["classes"][FAULTS[0]]["threshold"] == pytest.approx(51.5 / 255)


def test_severity_is_compared_in_levels(labelled: Path, tmp_path: Path) -> None:
    """The first class is of a model that the table of levels has; the others are not."""
    truth = severity_labels(st.open_store(labelled), range(8))
    known = np.isfinite(truth[:, 0]) & (truth[:, 0] > 0)
    off = np.where(np.arange(8) % 2, 0.5, 2.0)
    found = scored(
        labelled, tmp_path, navigation=False, heads={"severity": lambda i: (truth[i % 8] + off[i % 8]).astype("f4")}
    )
    of_class = found["classes"][FAULTS[0]]["severity"]
    assert of_class["known"] == known.sum() > 2
    assert value(of_class["mean_absolute_error"]) == pytest.approx(off[known].mean(), abs=1e-5)
    assert value(of_class["within_one_level"]) == pytest.approx((off[known] < 1).mean())
    assert found["classes"][FAULTS[1]]["severity"]["known"] == 0
    assert found["classes"][FAULTS[1]]["severity"]["truth_unknown"] > 0


def test_a_usable_fraction_is_compared_with_mask_any(labelled: Path, tmp_path: Path) -> None:
    store = st.open_store(labelled)
    usable = [1 - store.read_sample(i, ("mask_any",)).layers["mask_any"].mean() for i in range(16)]
    found = scored(labelled, tmp_path, navigation=False, heads={"usable_fraction": lambda i: usable[i] - 0.125})
    assert value(found["navigation"]["usable_fraction_mean_absolute_error"]) == pytest.approx(0.125)


def test_a_class_that_the_model_does_not_know_is_never_predicted(labelled: Path, tmp_path: Path) -> None:
    found = scored(labelled, tmp_path, classes=FAULTS[:3], navigation=False, pages=True)
    assert [found["classes"][name]["predicted_by_model"] for name in FAULTS] == [True] * 3 + [False]
    assert value(found["classes"][FAULTS[3]]["pixels"]["iou"]) == 0
    assert value(found["mean"]["iou"]) == 0.75
    assert f"count as never predicted: {FAULTS[3]}." in (tmp_path / "s/score.md").read_text()


def test_a_class_that_the_store_does_not_have_is_left_out(labelled: Path, tmp_path: Path) -> None:
    def more(masks: np.ndarray, index: int) -> np.ndarray:
        return np.concatenate([np.ones_like(masks[:1]), masks])

    found = scored(labelled, tmp_path, more, classes=("of_a_plug_in", *FAULTS), navigation=False, pages=True)
    assert value(found["mean"]["iou"]) == value(found["classes"][FAULTS[0]]["presence"]["roc_auc"]) == 1
    assert "does not have of_a_plug_in" in (tmp_path / "s/score.md").read_text()


def test_a_score_depends_neither_on_batches_nor_on_the_run(labelled: Path, tmp_path: Path) -> None:
    def noisy(masks: np.ndarray, index: int) -> np.ndarray:
        return np.random.default_rng(index).random(masks.shape, np.float32)

    written = []
    for batch in (1, 1, 5):
        scored(labelled, tmp_path, noisy, batch=batch, pages=True)
        written.append([(tmp_path / "s" / name).read_bytes() for name in ("score.json", "score.md", "score.html")])
    assert written[0] == written[1] == written[2]
    detector = Known(labelled)
    figures(detector, labelled, tmp_path / "s", batch=3, navigation=False)
    assert max(detector.asked) == 3  # never more than a batch is held


@pytest.mark.parametrize(
    ("change", "heads", "says"),
    [
        (lambda masks, i: masks[:, :5], {}, r"sample 0: masks has the shape \(4, 5, 56\); must be \(4, 48, 56\)"),
        (lambda masks, i: 2 * masks, {}, "sample [0-9]: masks must be probabilities from 0 to 1"),
        (lambda masks, i: masks, {"present": lambda i: np.full(4, math.nan)}, "present must be probabilities"),
    ],
)
def test_a_wrong_prediction_is_refused(labelled: Path, tmp_path: Path, change: Any, heads: Any, says: str) -> None:
    with pytest.raises(VbnfaultError, match=says):
        scored(labelled, tmp_path, change, heads=heads)


# --- navigation ---------------------------------------------------------------------------------------------------


def test_a_masked_limb_has_no_error() -> None:
    """A third of a straight limb is drawn 3 px too far: RMS √(9/3) without a mask, 0 with it."""
    clean = np.zeros((96, 96, 4), np.uint8)
    clean[:, :48] = 150
    image, mask = clean.copy(), np.zeros((96, 96), bool)
    image[32:64, 48:51] = 150
    mask[28:68, 46:54] = True
    semantic = np.where(clean[..., 0] > 0, BODY, 0).astype(np.uint8)
    found = frame_errors(clean, image, semantic, [np.zeros_like(mask), mask, ~mask])
    # the limb's normals leave 11 px at both ends out, and the blur of 1 px mixes the ends of the third
    assert found[0, 0] == pytest.approx(math.sqrt(9 * 32 / (96 - 22)), rel=0.05)
    assert found[1, 0] == pytest.approx(0, abs=0.02)
    assert found[2, 0] == pytest.approx(3, rel=0.12)
    assert np.isnan(frame_errors(clean, image, None, [mask])[0, 0])


def textured(seed: int, size: int = 320) -> np.ndarray:
    noise = np.random.default_rng(seed).random((size, size), np.float32)
    smooth = cv2.GaussianBlur(noise, (0, 0), 2.0)
    return np.clip(110 + 900 * (smooth - smooth.mean()), 0, 255).astype(np.uint8)


def test_a_mask_saves_the_pose_from_defects_that_do_not_move() -> None:
    """A plane from two places: defects of the detector take the places of features, or match where they are."""
    ground, step_px = textured(4), 24
    cleans = [np.repeat(ground[20:276, x : x + 256, None], 4, axis=2) for x in (0, step_px)]
    depth, focal = np.full((256, 256), 50.0), 200.0
    rotation = np.eye(3)
    views = [
        navigation.CameraView(
            intrinsics=np.array([focal, focal, 128, 128]),
            camera_from_T=rotation,
            camera_position_T_m=np.array([k * step_px * 50 / focal, 0, 0]),
            depth_m=depth,
        )
        for k in (0, 1)
    ]
    rng, mask = np.random.default_rng(8), np.zeros((256, 256), bool)
    images = [clean.copy() for clean in cleans]
    for x, y in rng.integers(16, 230, (120, 2)):
        patch = rng.integers(0, 2, (11, 11, 1)).astype(np.uint8) * 255
        mask[y : y + 11, x : x + 11] = True
        for image in images:
            image[y : y + 11, x : x + 11] = patch
    nothing = [np.zeros_like(mask)] * 2
    found = pair_errors(views, images, cleans, [nothing, [mask, mask], [mask, mask]])
    assert found is not None
    assert found.shape == (len(VARIANTS) + 1, 2)
    assert found[3] == pytest.approx(0, abs=0.1)  # the ground is the same to the pixel
    assert found[1] == pytest.approx(0, abs=0.1)
    assert found[0, 1] > 10
    assert found[1].tolist() == found[2].tolist()
    first, second = (navigation.match(*images, unused=m) for m in ((None, None), (mask, mask)))
    inside = mask[tuple(np.floor(second.first_xy).astype(int).T[::-1])]
    assert len(second) > 1.5 * len(first)
    assert not inside.any()
    blank = [np.full_like(image, 90) for image in images]
    assert pair_errors(views, images, blank, [nothing]) is None
    lost = pair_errors(views, blank, cleans, [nothing])
    assert lost is not None
    assert lost[0].tolist() == [180, 180]


def test_no_feature_is_detected_in_a_masked_pixel() -> None:
    """Patches that hide the ground cost right matches; a mask gives their features to the ground again."""
    clean = np.repeat(textured(4)[:256, :256, None], 4, axis=2)
    image, mask, rng = clean.copy(), np.zeros((256, 256), bool), np.random.default_rng(8)
    for x, y in rng.integers(16, 230, (120, 2)):
        mask[y : y + 7, x : x + 7] = True
        image[y : y + 7, x : x + 7] = rng.integers(0, 2, (7, 7, 1)).astype(np.uint8) * 255
    (_, *without), (_, *masked) = frame_errors(clean, image, None, [np.zeros_like(mask), mask])
    assert masked[1] - masked[0] > 1.2 * (without[1] - without[0])


def test_samples_of_one_pose_are_of_one_view_and_those_without_are_their_own() -> None:
    columns = {
        "camera_position_T_m": np.array([[0.0, 0, 0], [0, 0, 0], [1, 0, 0], [np.nan] * 3, [np.nan] * 3]),
        "camera_from_T": np.tile([1.0, 0, 0, 0], (5, 1)),
        "sun_direction_T": np.tile([1.0, 0, 0], (5, 1)),
    }
    number = view_numbers(SimpleNamespace(column=columns.__getitem__))  # type: ignore[arg-type]
    assert number[0] == number[1]
    assert len(set(number.tolist())) == 4


def test_pairs_are_of_one_site_under_one_sun() -> None:
    columns: dict[str, Any] = {
        "camera_position_T_m": np.array([[0.0, 0, 0], [1, 0, 0], [3, 0, 0], [0, 0, 0], [2, 0, 0], [np.nan] * 3]),
        "camera_from_T": np.tile([1.0, 0, 0, 0], (6, 1)),
        "sun_direction_T": np.tile([1.0, 0, 0], (6, 1)),
        "site": np.array([0, 0, 0, 0, 1, 0]),
        "injected": np.array([[True], [False], [False], [False], [True], [True]]),
    }
    assert candidate_pairs(columns) == [(0, [1, 2])]  # 3 is at the same place, 4 at another site, 5 nowhere
    columns["sun_direction_T"][1] = [0, 1, 0]
    columns["camera_from_T"][2] = [0, 1, 0, 0]
    assert candidate_pairs(columns) == []


# --- folders of masks, and the command ----------------------------------------------------------------------------


def masks_of(labelled: Path, folder: Path, name: str = "{i}.png") -> Path:
    store = st.open_store(labelled)
    for i in range(store.samples):
        for fault, mask in zip(FAULTS, store.read_sample(i, ("mask",)).layers["mask"], strict=True):
            (folder / fault).mkdir(parents=True, exist_ok=True)
            assert cv2.imwrite(str(folder / fault / name.format(i=i)), mask.astype(np.uint8) * 255)
    return folder


@pytest.mark.parametrize("name", ["{i}.png", "{i:06d}.png"])
def test_a_folder_of_true_masks_scores_one(labelled: Path, tmp_path: Path, name: str) -> None:
    found = figures(masks_of(labelled, tmp_path / "masks", name), labelled, tmp_path / "s")
    assert value(found["mean"]["iou"]) == value(found["mean"]["pamiou"]) == 1
    assert found["name"] == "masks"
    again = figures(masks_of(labelled, tmp_path / "other", "{i:03d}.png"), labelled, tmp_path / "s")
    assert again["model"]["sha256"] == found["model"]["sha256"]  # of the masks, not of their names


@pytest.mark.parametrize("masks", ["footprint", "effect"])
def test_exported_masks_score_one(labelled: Path, tmp_path: Path, masks: str) -> None:
    export_store(labelled, tmp_path / "png", "png", progress=False)
    found = figures(tmp_path / "png", labelled, tmp_path / "s", split="all", masks=masks)
    assert value(found["mean"]["iou"]) == value(found["mean"]["pap"]) == 1


def test_a_grey_value_is_a_probability(labelled: Path, tmp_path: Path) -> None:
    folder = masks_of(labelled, tmp_path / "masks")
    for file in folder.glob("*/*.png"):
        assert cv2.imwrite(str(file), (cv2.imread(str(file), cv2.IMREAD_GRAYSCALE) > 0).astype(np.uint8) * 127)
    assert value(figures(folder, labelled, tmp_path / "s")["mean"]["iou"]) == 0
    assert value(figures(folder, labelled, tmp_path / "s", calibrate=True)["mean"]["iou"]) == 1


def test_a_bad_folder_is_refused_in_one_sentence(labelled: Path, tmp_path: Path) -> None:
    folder = masks_of(labelled, tmp_path / "masks")
    file = folder / FAULTS[1] / "5.png"

    def refused() -> str:
        with pytest.raises(InputError) as caught:
            score(folder, labelled, tmp_path / "s")
        assert "\n" not in str(caught.value)
        return str(caught.value)

    file.write_bytes(b"no image")
    assert refused() == f"{file}: is no PNG file, whatever its name says"
    assert cv2.imwrite(str(file), np.zeros((48, 48), np.uint8))
    assert refused() == f"{file}: has 48 x 48 pixels; must be 56 x 48, as the store's images"
    assert cv2.imwrite(str(file), np.zeros((48, 56, 3), np.uint8))
    assert refused() == f"{file}: a mask must be a grey PNG of 8 bits, 255 for a probability of 1"
    shutil.copy(folder / FAULTS[1] / "6.png", folder / FAULTS[1] / "06.png")
    assert "6.png: is a mask of the same sample as 06.png; remove one of them" in refused()
    (folder / FAULTS[1] / "06.png").unlink()
    file.unlink()
    assert refused() == (
        f"{folder / FAULTS[1] / '000005.png'}: there is no mask of sample 5; each sample needs one"
    )
    assert not (tmp_path / "s").exists()


def test_the_command_writes_a_score(labelled: Path, tmp_path: Path, call: Any) -> None:
    folder = masks_of(labelled, tmp_path / "masks")
    done = call("score", folder, labelled, "--name", "truth", "--navigation")
    assert done.code == 0, done.err
    out = tmp_path / "masks_on_labelled"
    assert f"page: {out / 'score.html'}" in done.out
    assert "mean IoU: 1.000 (1.000 to 1.000)" in done.out
    found = json.loads((out / "score.json").read_text())
    assert found["kind"] == "vbnfault score"
    assert found["name"] == "truth"
    assert found["dataset"]["classes"] == list(FAULTS)
    assert len(found["dataset"]["sha256"]) == len(found["model"]["sha256"]) == 64
    page = (out / "score.html").read_text()
    assert page.count("<svg") == 4
    assert page.count("<img") >= len(FAULTS)
    text = (out / "score.md").read_text()
    assert "| mean | 1.000 (1.000 to 1.000)" in text
    assert "wrong ORB matches" in text
    assert call("score", folder, labelled, "--no-navigation").code == 0
    assert "wrong ORB matches" not in (out / "score.md").read_text()


def test_a_trained_detector_is_scored(tmp_path: Path, call: Any) -> None:
    pytest.importorskip("torch", reason="PyTorch is not installed: pip install '.[torch]'")
    model, store = tmp_path / "detector", filled(tmp_path / "made.zarr", size=40).path
    done = call("train", store, "--out", model, "--epochs", 1, "--crop-px", 32, "--batch-size", 2, "--no-onnx")
    assert done.code == 0, done.err
    done = call("score", model, store, "--no-navigation")
    assert done.code == 0, done.err
    found = json.loads((tmp_path / "detector_on_made/score.json").read_text())
    record = json.loads((model / "model.json").read_text())
    assert found["model"]["sha256"] == record["weights_sha256"]
    assert found["options"]["masks"] == record["options"]["masks"]
    assert found["severity"]["truth_unknown"] > 0  # the models of the store are made up


def test_the_command_refuses_in_one_sentence(
    labelled: Path, finished_store: Path, tmp_path: Path, call: Any
) -> None:
    folder, nothing = masks_of(labelled, tmp_path / "masks"), tmp_path / "nothing"
    nothing.mkdir()
    (tmp_path / "file").touch()
    for arguments, says in (
        ((tmp_path / "none", labelled), "none: there is no such folder; a model is a folder with model.json"),
        ((nothing, labelled), "nothing: is no detector, for it has no model.json, and no folder of masks"),
        ((folder, tmp_path / "none.zarr"), "none.zarr: "),
        ((folder, labelled, "--split", "train"), "no finished sample fits split = train"),
        ((folder, labelled, "--split", "val", "--calibrate"), "so split = val cannot be scored with them"),
        ((folder, labelled, "--out", labelled), "is a store, in which no other file may lie"),
        ((folder, labelled, "--out", tmp_path / "file"), "file: is a file, not a folder; choose another --out"),
    ):
        done = call("score", *arguments)
        assert (done.code, says in done.said) == (2, True), done.err
