"""Classifier of flight patches: it must see a difference where there is one, and none where there is none."""

from __future__ import annotations

import json
import re
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy import ndimage

from vbnfault.core.errors import InputError
from vbnfault.fit.frames import Look, look

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))
import flight_classifier

from vbnfault.fit import two_samples

SIZE = 16


def frame(seed: int, *, blur_px: float = 0.0) -> np.ndarray:
    """Return a textured disc of mean brightness 150 before a sky of 8, with noise of 2 DN that may be blurred."""
    rng = np.random.default_rng(seed)
    row, column = np.indices((128, 128))
    texture = ndimage.gaussian_filter(rng.normal(size=(128, 128)), 2.0)
    inside = np.hypot(row - 64 - rng.uniform(-5, 5), column - 64) < 34
    noise = ndimage.gaussian_filter(rng.normal(scale=2, size=(128, 128)), blur_px)
    return np.clip(np.round(8 + inside * (142 + 300 * texture) + noise), 0, 255).astype(np.uint8)


def pairs(*, blur_px: float) -> list[tuple[np.ndarray, np.ndarray]]:
    return [(frame(k), frame(100 + k, blur_px=blur_px)) for k in range(8)]


def looks(*, blur_px: float) -> list[tuple[Look, Look]]:
    return [(look(real), look(rendered)) for real, rendered in pairs(blur_px=blur_px)]


def examined(place: str, *, blur_px: float) -> dict[str, tuple[float, float, float]]:
    patches = two_samples.patches_of(looks(blur_px=blur_px), place, SIZE, 8, 1)
    return two_samples.examine(patches, place, 2, 1)[0]


def test_patches_lie_where_their_place_says() -> None:
    real, rendered = look(frame(1)), look(frame(2))
    rng = np.random.default_rng(0)
    for place, low, high in (("body", 0.9, 1.0), ("limb", 0.3, 0.7), ("sky", 0.0, 0.0)):
        corners = two_samples.positions(real, rendered, SIZE, place, 6, rng)
        assert len(corners) >= 3
        for y, x in corners:
            for mask in (real.lit, rendered.lit):
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
    patch[0, 3, 3:6] = 8 + two_samples._SPOT  # noise at most
    expected = patch.copy()
    patch[0, 8, 2:7], patch[0, 12, 12] = 40, 2
    np.testing.assert_array_equal(two_samples.without_spots(patch), expected)


def test_frames_never_train_and_test_at_once() -> None:
    numbers = np.repeat(np.arange(7), 3)
    trained = two_samples.halves(numbers, 4, 1)
    tested = [np.setdiff1d(numbers, frames) for frames in trained]
    assert all(set(a) | set(b) == set(range(7)) for a, b in zip(tested[::2], tested[1::2], strict=True))
    # a label that only a patch's own frame tells: nothing is learned that holds in others
    rng = np.random.default_rng(3)
    frames = np.repeat(np.arange(12), 10)
    label = np.tile(np.repeat([0, 1], 5), 12)
    secret = rng.choice([-1.0, 1.0], 12)[frames] * (2 * label - 1)
    values = np.stack([secret, rng.normal(size=120)], axis=1)
    right = two_samples.score_frames(values, label, frames, two_samples.halves(frames, 4, 1))[1]
    mean, low, high = two_samples.accuracy(right, frames)
    assert low <= mean <= high
    assert 0.2 < mean < 0.8


def test_the_benchmark_writes_figures_of_both_kinds(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(two_samples, "_TREES", 10)
    for name, (real, rendered) in enumerate(pairs(blur_px=0.6)[:4]):
        cv2.imwrite(str(tmp_path / f"{name}_real.png"), real)
        cv2.imwrite(str(tmp_path / f"{name}_rendered.png"), rendered)
    options = ["--size", str(SIZE), "--patches", "4", "--splits", "2", "--draws", "1", "--seed", "2"]
    flight_classifier.main(["--pairs", str(tmp_path), "--out", str(tmp_path / "out"), *options])
    written = {path.name for path in (tmp_path / "out").iterdir()}
    assert written == {"classifier.json", *(f"confident_{place}.png" for place in two_samples.PLACES)}
    figures = json.loads((tmp_path / "out/classifier.json").read_text())
    assert {f"{kind}, all features" for kind in two_samples.kinds()} <= set(figures["sky"])


def test_draws_are_those_of_the_seeds_that_follow(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(two_samples, "_TREES", 10)
    monkeypatch.setattr(two_samples, "PLACES", ("body",))
    keys = {"size": SIZE, "count": 3, "splits": 2}
    both = two_samples.two_sample_test(pairs(blur_px=0.6), draws=2, seed=5, **keys)[0]  # type: ignore[arg-type]
    drawn = [two_samples.told(looks(blur_px=0.6), "body", seed=seed, **keys) for seed in (5, 6)]
    for kind in two_samples.kinds():
        found = [one[kind] for one in drawn]
        assert both["body"][f"{kind}, all features"] == pytest.approx((np.mean(found), min(found), max(found)))


def test_each_kind_tells_blurred_patches_and_no_equal_ones() -> None:
    for place in ("body", "sky"):
        same, blurred = (
            two_samples.told(looks(blur_px=blur_px), place, size=SIZE, count=8, splits=2, seed=1)
            for blur_px in (0.0, 1.5)
        )
        for kind in two_samples.kinds():
            assert same[kind] < 0.67 < 0.9 < blurred[kind]


def test_too_few_frames_are_refused() -> None:
    with pytest.raises(InputError, match="3 frames: a classifier needs at least 4"):
        two_samples.two_sample_test(pairs(blur_px=0.0)[:3])


def test_the_shift_says_which_setting_brings_images_nearer(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Rendered noise is blurred by 0.8 px, then by 0.6 px, then not at all, as the real one.

    With n = 128 patches of each class and p = 73 features, equal classes differ by d² = 2 p / n = 1.1 by chance.
    """
    import passport_shift

    for name, size in (("SIZE_PX", SIZE), ("COUNT", 8), ("DRAWS", 2), ("HALVES", 4)):
        monkeypatch.setattr(passport_shift, name, size)
    folders = []
    for blur_px in (0.8, 0.6, 0.0):
        folders.append(tmp_path / f"blur_{blur_px}")
        folders[-1].mkdir()
        for k, (real, rendered) in enumerate(pairs(blur_px=blur_px)):
            cv2.imwrite(str(folders[-1] / f"{k}_real.png"), real)
            cv2.imwrite(str(folders[-1] / f"{k}_rendered.png"), rendered)
    monkeypatch.setattr(sys, "argv", ["passport_shift.py", *map(str, folders)])
    passport_shift.main()
    base, less, none, _ = (float(d) for d in re.findall(r": d ([0-9.]+)(?:,| with)", capsys.readouterr().out))
    assert base > less > 5
    assert none < 1.5
