"""Classifier of flight patches: it must see a difference where there is one, and none where there is none."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy import ndimage

import vbnfault

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))
import flight_classifier

SIZE = 16


def frame(seed: int, *, blur_px: float = 0.0) -> np.ndarray:
    """Return a textured disc of mean brightness 150 before a sky of 8, with noise of 2 DN that may be blurred."""
    rng = np.random.default_rng(seed)
    row, column = np.indices((128, 128))
    texture = ndimage.gaussian_filter(rng.normal(size=(128, 128)), 2.0)
    inside = np.hypot(row - 64 - rng.uniform(-5, 5), column - 64) < 34
    noise = ndimage.gaussian_filter(rng.normal(scale=2, size=(128, 128)), blur_px)
    return np.clip(np.round(8 + inside * (142 + 300 * texture) + noise), 0, 255).astype(np.uint8)


def pairs(*, blur_px: float) -> list[tuple[str, np.ndarray, np.ndarray]]:
    return [(f"{k}", frame(k), frame(100 + k, blur_px=blur_px)) for k in range(8)]


def examined(place: str, *, blur_px: float) -> dict[str, tuple[float, float, float]]:
    patches = flight_classifier.patches_of(pairs(blur_px=blur_px), place, SIZE, 8, 1)
    return flight_classifier.examine(patches, place, 2, 1)[0]


def test_patches_lie_where_their_place_says() -> None:
    real, rendered = frame(1), frame(2)
    rng = np.random.default_rng(0)
    lit = [flight_classifier.flight_frames.look(image).lit for image in (real, rendered)]
    for place, low, high in (("body", 0.9, 1.0), ("limb", 0.3, 0.7), ("sky", 0.0, 0.0)):
        corners = flight_classifier.positions(real, rendered, SIZE, place, 6, rng)
        assert len(corners) >= 3
        for y, x in corners:
            for mask in lit:
                assert low <= mask[y : y + SIZE, x : x + SIZE].mean() <= high


def test_equal_noise_is_not_told_apart_and_blurred_noise_is() -> None:
    """Of 64 patches in 8 frames the accuracy of guesses has a deviation of 0.5 / sqrt(128) = 0.044."""
    same, blurred = (examined("sky", blur_px=blur_px) for blur_px in (0.0, 0.6))
    assert abs(same["all features"][0] - 0.5) < 4 * 0.044
    assert abs(same["real against real"][0] - 0.5) < 4 * 0.06
    assert same["blurred"][0] > 0.95
    assert blurred["all features"][0] > 0.95
    assert blurred["noise"][0] > 0.9
    assert {"without noise", "without tracks"} <= set(same)


def test_tracks_and_dark_pixels_are_taken_out_and_noise_is_not() -> None:
    patch = np.full((1, SIZE, SIZE), 8, dtype=np.uint8)
    patch[0, 3, 3:6] = 8 + flight_classifier._SPOT  # noise at most
    expected = patch.copy()
    patch[0, 8, 2:7], patch[0, 12, 12] = 40, 2
    np.testing.assert_array_equal(flight_classifier.without_spots(patch), expected)


def test_frames_never_train_and_test_at_once() -> None:
    numbers = np.repeat(np.arange(7), 3)
    trained = flight_classifier.halves(numbers, 4, 1)
    tested = [np.setdiff1d(numbers, frames) for frames in trained]
    assert all(set(a) | set(b) == set(range(7)) for a, b in zip(tested[::2], tested[1::2], strict=True))
    # a label that only a patch's own frame tells: nothing is learned that holds in others
    rng = np.random.default_rng(3)
    frames = np.repeat(np.arange(12), 10)
    label = np.tile(np.repeat([0, 1], 5), 12)
    secret = rng.choice([-1.0, 1.0], 12)[frames] * (2 * label - 1)
    values = np.stack([secret, rng.normal(size=120)], axis=1)
    right = flight_classifier.score_frames(values, label, frames, flight_classifier.halves(frames, 4, 1))[1]
    mean, low, high = flight_classifier.accuracy(right, frames)
    assert low <= mean <= high
    assert 0.2 < mean < 0.8


def test_the_command_writes_figures_and_names_a_folder_without_pairs(tmp_path: Path) -> None:
    with pytest.raises(vbnfault.InputError, match="has 0 pairs"):
        flight_classifier.main(["--pairs", str(tmp_path), "--out", str(tmp_path / "out")])
    for name, real, rendered in pairs(blur_px=0.6)[:4]:
        cv2.imwrite(str(tmp_path / f"{name}_real.png"), real)
        cv2.imwrite(str(tmp_path / f"{name}_rendered.png"), rendered)
    options = ["--size", str(SIZE), "--patches", "4", "--splits", "2"]
    flight_classifier.main(["--pairs", str(tmp_path), "--out", str(tmp_path / "out"), *options])
    assert {path.name for path in (tmp_path / "out").iterdir()} == {
        "classifier.json",
        *(f"confident_{place}.png" for place in flight_classifier.PLACES),
    }


def test_draws_are_those_of_the_seeds_that_follow(tmp_path: Path) -> None:
    for name, real, rendered in pairs(blur_px=0.6):
        for which, image in (("real", real), ("rendered", rendered)):
            cv2.imwrite(str(tmp_path / f"{name}_{which}.png"), image)

    def figures(*more: str) -> dict[str, dict[str, list[float]]]:
        few = ["--size", "16", "--patches", "3", "--splits", "2", *more]
        flight_classifier.main(["--pairs", str(tmp_path), "--out", str(tmp_path / "out"), *few])
        return dict(json.loads((tmp_path / "out/classifier.json").read_text()))

    both, first, second = figures("--draws", "2", "--seed", "5"), figures("--seed", "5"), figures("--seed", "6")
    for place in ("body", "all"):
        drawn = [one[place]["all features"][0] for one in (first, second)]
        mean = both[place]["all features, mean of draws"]
        assert mean == pytest.approx([np.mean(drawn), min(drawn), max(drawn)])
        assert drawn[0] != drawn[1]
        assert "all features, mean of draws" not in first[place]


def test_one_classifier_for_all_places_has_to_know_what_gives_each_of_them_away() -> None:
    given = argparse.Namespace(size=SIZE, patches=8, splits=2)
    mean, low, high = flight_classifier.told(pairs(blur_px=1.5), flight_classifier.PLACES, given, 1)
    assert low <= mean <= high
    assert mean > 0.9  # each blurred place is told apart, see above
    assert flight_classifier.told(pairs(blur_px=0.0), flight_classifier.PLACES, given, 1)[0] < 0.65
