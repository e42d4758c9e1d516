"""Let classifiers tell rendered frames from real ones: an honest two-sample test on patches.

**Patches.** Squares at random positions, each taken from both images of a pair, so that both classes have as many
patches of each frame and place. Places are `body` (90 % lit in both images), `limb` (30 to 70 % lit, edge and
terminator) and `sky` (nothing lit nearby). Nothing is scaled or smoothed beforehand.

**Features**, in groups: `levels` (moments and quantiles), `spectrum` (logarithm of the power in rings of
frequency, and of horizontal over vertical power), `noise` (second differences: their spread, tails and
correlations), `patterns` (local binary patterns of radius 1 and 2; Ojala, Pietikäinen & Mäenpää 2002, IEEE TPAMI
24, 971) and `gradients` (histogram of orientations weighted by magnitude, as Dalal & Triggs 2005, CVPR, in one
cell; quantiles of magnitudes).

**Classifiers** of two kinds: regularised least squares with a Gaussian kernel (Rifkin, Yeo & Poggio 2003), on
features that are standardised by the training patches, whose width and regularisation are chosen by
cross-validation over training frames; and extremely randomised trees (Geurts, Ernst & Wehenkel 2006, Machine
Learning 63, 3), where scikit-learn is installed.

**Split.** By frame, never by patch: half of the frames train, the others test, in random halves. A frame's accuracy
is the mean over the splits that test it; given are the mean over frames and its 95 % interval by bootstrap over
frames. 50 % means that nothing gives the images away. One draw of 12 patches a frame may be off by 2 %, so patches
and halves are drawn several times, and the mean over the draws is given with the least and the greatest.

Each place has a classifier of its own, which is the harder test.

**Controls.** `real against real`: frames are labelled at random, so nothing can be learned that holds in other
frames: about 50 %. `blurred`: rendered patches against the same after a Gaussian blur of 0.7 px: about 100 %.

The accuracy with one group of features alone says what gives the images away, and so does that of limb and sky
`without noise`, the group, and of sky `without tracks`: in both classes, pixels that differ from their
neighbourhood's median by more than 3 take its value.
"""

from __future__ import annotations

import importlib.util
import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from skimage.feature import local_binary_pattern

from ..core.errors import InputError
from .frames import Look, look

F64 = NDArray[np.float64]
U8 = NDArray[np.uint8]

PLACES = ("body", "limb", "sky")
_BLUR_PX = 0.7
_RINGS = 10
_WIDTHS = (0.5, 1.0, 3.0)  # of the kernel, in root mean square distances of training patches
_PENALTIES = (1e-2, 1e-1, 1.0)
_FOLDS = 4
FEWEST_FRAMES = 4
_BOOTSTRAPS = 2000
_SPOT = 3  # levels of 255 over the median: six times the noise of a sky
_TREES = 300
_SHOWN = 10  # patches of each class in a figure


@dataclass(frozen=True, kw_only=True, eq=False)
class Patches:
    """Hold patches of one place: uint8[n, y, x], their class (1 real, 0 rendered) and the number of their frame."""

    images: U8
    label: NDArray[np.int64]
    frame: NDArray[np.int64]


# --- patches ------------------------------------------------------------------------------------------------------


def positions(
    real: Look, rendered: Look, size: int, place: str, count: int, rng: np.random.Generator
) -> NDArray[np.int64]:
    """Return up to `count` corners (y, x) of patches of a place, spread over the frame, int64[n, 2].

    A frame whose sky is clipped to 0 has no sky and no limb to compare.
    """
    lit = [one.lit for one in (real, rendered)]
    if place != "body" and real.clipped:
        return np.zeros((0, 2), dtype=np.int64)

    def fraction(mask: NDArray[np.bool_]) -> F64:
        """Return the fraction of a patch with its corner at each pixel that a mask covers, float64[y, x]."""
        sums = np.pad(mask.astype(np.float64), ((1, size), (1, size))).cumsum(axis=0).cumsum(axis=1)
        height, width = mask.shape
        whole = sums[size : size + height, size : size + width] - sums[:height, size : size + width]
        return np.asarray((whole - sums[size : size + height, :width] + sums[:height, :width]) / size**2)

    if place == "body":
        fits = np.minimum(*map(fraction, lit)) > 0.9
    elif place == "limb":
        middle = [(part > 0.3) & (part < 0.7) for part in map(fraction, lit)]
        fits = middle[0] & middle[1]
    else:
        near = ndimage.binary_dilation(lit[0] | lit[1], iterations=8)
        fits = fraction(near) < 1e-9
    border = 4  # lines at the edge of a frame are masked, and a shift continues it by its mirror image
    inner = np.zeros_like(fits)
    inner[border : fits.shape[0] - size - border, border : fits.shape[1] - size - border] = True
    y, x = np.nonzero(fits & inner)
    chosen: list[tuple[int, int]] = []
    for k in rng.permutation(len(y))[:4000]:
        if all(max(abs(y[k] - v), abs(x[k] - u)) >= size // 2 for v, u in chosen):
            chosen.append((int(y[k]), int(x[k])))
            if len(chosen) == count:
                break
    return np.array(chosen, dtype=np.int64).reshape(-1, 2)


def cut(image: U8, corners: NDArray[np.int64], size: int) -> U8:
    """Return the patches at some corners, uint8[n, y, x]."""
    return np.array([image[y : y + size, x : x + size] for y, x in corners], dtype=np.uint8).reshape(-1, size, size)


def patches_of(pairs: Sequence[tuple[Look, Look]], place: str, size: int, count: int, seed: int) -> Patches:
    """Return the patches of a place in all pairs (real, rendered), as many real as rendered ones of each frame."""
    images, labels, frames = [], [], []
    for number, pair in enumerate(pairs):
        rng = np.random.default_rng([seed, number, PLACES.index(place)])
        corners = positions(*pair, size, place, count, rng)
        for label, one in zip((1, 0), pair, strict=True):
            images.append(cut(one.image.astype(np.uint8), corners, size))
            labels.append(np.full(len(corners), label))
            frames.append(np.full(len(corners), number))
    return Patches(images=np.concatenate(images), label=np.concatenate(labels), frame=np.concatenate(frames))


# --- features -----------------------------------------------------------------------------------------------------


def _levels(patch: F64) -> F64:
    deviation = patch.std()
    scaled = (patch - patch.mean()) / max(deviation, 1e-3)
    quantiles = np.percentile(patch, (1, 5, 25, 50, 75, 95, 99))
    return np.concatenate(
        [[np.log(deviation + 0.1), (scaled**3).mean(), (scaled**4).mean()], np.log(quantiles + 1)]
    )


def _spectrum(patch: F64) -> F64:
    size = len(patch)
    window = np.outer(np.hanning(size), np.hanning(size))
    power = np.abs(np.fft.rfft2((patch - patch.mean()) * window)) ** 2
    fy, fx = np.fft.fftfreq(size)[:, None], np.fft.rfftfreq(size)[None]
    radius = np.hypot(fy, fx)
    edges = np.geomspace(1.0 / size, 0.71, _RINGS + 1)
    rings = [
        np.log(power[(radius >= low) & (radius < high)].mean() + 1e-3)
        for low, high in itertools.pairwise(edges)
        if ((radius >= low) & (radius < high)).any()
    ]
    along_x = np.abs(fx) > 2 * np.abs(fy)
    along_y = np.abs(fy) > 2 * np.abs(fx)
    ratios = [
        np.log(power[along_x & band].mean() + 1e-3) - np.log(power[along_y & band].mean() + 1e-3)
        for band in ((radius > 1.1 / size) & (radius < 0.15), (radius >= 0.15) & (radius < 0.3), radius >= 0.3)
    ]
    return np.array(rings + ratios)


def _noise(patch: F64) -> F64:
    out = []
    for axis in (0, 1):
        second = np.diff(patch, 2, axis=axis) / 6**0.5
        size = np.percentile(np.abs(second), (50, 75, 90, 99))
        out += [*np.log(size + 0.1), np.log(second.std() + 0.1)]
    smooth = patch - ndimage.uniform_filter(patch, 3)
    variance = max(float((smooth**2).mean()), 1e-6)
    for shift in ((0, 1), (1, 0), (1, 1), (0, 2), (2, 0)):
        moved = np.roll(smooth, shift, (0, 1))
        out.append(float((moved * smooth)[2:, 2:].mean()) / variance)
    # a fixed pattern of columns: variance of their means over that of independent pixels
    residual = patch - ndimage.median_filter(patch, 5)
    for axis in (0, 1):
        out.append(np.log((residual.mean(axis=axis).var() + 1e-4) / (residual.var() / len(patch) + 1e-4)))
    return np.array(out)


def _patterns(patch: F64) -> F64:
    out = []
    for radius in (1, 2):
        codes = local_binary_pattern(patch.astype(np.uint8), 8, radius, method="uniform")
        out.append(np.bincount(codes[2:-2, 2:-2].astype(int).ravel(), minlength=10) / codes[2:-2, 2:-2].size)
    return np.concatenate(out)


def _gradients(patch: F64) -> F64:
    gy, gx = np.gradient(patch)
    magnitude, angle = np.hypot(gx, gy), np.arctan2(gy, gx) % np.pi
    histogram = np.histogram(angle, bins=9, range=(0, np.pi), weights=magnitude)[0]
    return np.concatenate(
        [histogram / max(float(histogram.sum()), 1e-6), np.log(np.percentile(magnitude, (10, 50, 90, 99)) + 0.1)]
    )


GROUPS: dict[str, Callable[[F64], F64]] = {
    "levels": _levels,
    "spectrum": _spectrum,
    "noise": _noise,
    "patterns": _patterns,
    "gradients": _gradients,
}


def features(images: U8) -> dict[str, F64]:
    """Return the features of patches, float64[n, feature] of each group."""
    patches = [np.asarray(image, dtype=np.float64) for image in images]
    return {name: np.array([group(patch) for patch in patches]) for name, group in GROUPS.items()}


# --- classifier ---------------------------------------------------------------------------------------------------


def _standardised(train: F64, test: F64) -> tuple[F64, F64]:
    mean, deviation = train.mean(axis=0), np.maximum(train.std(axis=0), 1e-9)
    return (train - mean) / deviation, np.clip((test - mean) / deviation, -8, 8)


def _distances(a: F64, b: F64) -> F64:
    squares = (a**2).sum(axis=1)[:, None] + (b**2).sum(axis=1)[None] - 2 * a @ b.T
    return np.asarray(np.maximum(squares, 0) / a.shape[1])


def _scores(train: F64, sign: F64, test: F64, settings: tuple[float, float]) -> F64:
    """Return the score of test patches, above 0 for real ones; `sign` is 1 for real training patches, else -1."""
    width, penalty = settings
    train, test = _standardised(train, test)
    scale = 2 * 2 * width**2  # two standardised features differ by 2 in the mean square
    kernel = np.exp(-_distances(train, train) / scale)
    weights = np.linalg.solve(kernel + penalty * len(train) * 0.01 * np.eye(len(train)), sign - sign.mean())
    return np.asarray(np.exp(-_distances(test, train) / scale) @ weights + sign.mean())


def _chosen_settings(
    values: F64, sign: F64, frame: NDArray[np.int64], rng: np.random.Generator
) -> tuple[float, float]:
    """Return the width and the penalty with the best accuracy by cross-validation over frames."""
    numbers = rng.permutation(np.unique(frame))
    fold_of = {int(number): k % _FOLDS for k, number in enumerate(numbers)}
    fold = np.array([fold_of[int(number)] for number in frame])
    best, best_score = (1.0, 0.1), -1.0
    for width in _WIDTHS:
        for penalty in _PENALTIES:
            right = [
                ((_scores(values[fold != k], sign[fold != k], values[fold == k], (width, penalty)) > 0) * 2 - 1)
                == sign[fold == k]
                for k in range(_FOLDS)
                if (fold == k).any() and (fold != k).any()
            ]
            score = float(np.concatenate(right).mean())
            if score > best_score:
                best, best_score = (width, penalty), score
    return best


def _by_kernel(values: F64, sign: F64, frame: NDArray[np.int64], test: F64, split: int) -> F64:
    settings = _chosen_settings(values, sign, frame, np.random.default_rng(split))
    return _scores(values, sign, test, settings)


def _by_trees(values: F64, sign: F64, frame: NDArray[np.int64], test: F64, split: int) -> F64:
    from sklearn.ensemble import ExtraTreesClassifier

    trees = ExtraTreesClassifier(_TREES, min_samples_leaf=2, random_state=split, n_jobs=1)
    return np.asarray(2 * trees.fit(values, sign).predict_proba(test)[:, 1] - 1)


CLASSIFIERS = {"kernel": _by_kernel, "trees": _by_trees}


def kinds() -> list[str]:
    """Return the kinds of classifiers that this environment has."""
    return [kind for kind in CLASSIFIERS if kind != "trees" or importlib.util.find_spec("sklearn")]


def halves(frame: NDArray[np.int64], splits: int, seed: int) -> list[NDArray[np.int64]]:
    """Return the training frames of each split. Every second split exchanges the halves: every frame is tested."""
    numbers = np.unique(frame)
    out = []
    for split in range(splits):
        half = np.random.default_rng([seed, split // 2]).permutation(numbers)[: len(numbers) // 2]
        out.append(np.setdiff1d(numbers, half) if split % 2 else half)
    return out


def score_frames(
    values: F64,
    label: NDArray[np.int64],
    frame: NDArray[np.int64],
    trained: Sequence[NDArray[np.int64]],
    kind: str = "kernel",
) -> tuple[F64, F64]:
    """Return over the splits that test a patch its mean score, above 0 if called real, and how often that is right.

    `trained` holds the frames that train in each split; all others are tested. `kind` is one of `CLASSIFIERS`.
    """
    sign: F64 = np.where(label == 1, 1.0, -1.0)
    total, right, times = np.zeros((3, len(label)))
    for split, frames in enumerate(trained):
        train = np.isin(frame, frames)
        score = CLASSIFIERS[kind](values[train], np.asarray(sign[train]), frame[train], values[~train], split)
        total[~train] += score
        right[~train] += (score > 0) == (sign[~train] > 0)
        times[~train] += 1
    return total / times, right / times


def accuracy(right: F64, frame: NDArray[np.int64], seed: int = 0) -> tuple[float, float, float]:
    """Return the mean accuracy over frames and its 95 % interval by bootstrap over frames."""
    by_frame = np.array([right[frame == number].mean() for number in np.unique(frame)])
    rng = np.random.default_rng(seed)
    means = rng.choice(by_frame, (_BOOTSTRAPS, len(by_frame))).mean(axis=1)
    low, high = np.percentile(means, (2.5, 97.5))
    return float(by_frame.mean()), float(low), float(high)


# --- the test -----------------------------------------------------------------------------------------------------


def without_spots(images: U8) -> U8:
    """Return patches whose tracks, spots and dark pixels took the value of their neighbourhood, uint8[n, y, x]."""
    median = ndimage.median_filter(images, (1, 7, 7))
    far = np.abs(images.astype(np.int64) - median) > _SPOT
    return np.where(far, median, images)


def examine(
    patches: Patches, place: str, splits: int, seed: int
) -> tuple[dict[str, tuple[float, float, float]], F64]:
    """Return the accuracies of the test, of parts of the features and of the controls, and the scores."""
    groups = features(patches.images)
    label, frame = patches.label, patches.frame
    whole = np.hstack(list(groups.values()))
    trained = halves(frame, splits, seed)
    score, right = score_frames(whole, label, frame, trained)
    out = {"all features": accuracy(right, frame)}
    for name, values in groups.items():
        out[name] = accuracy(score_frames(values, label, frame, trained)[1], frame)
    if place != "body":
        others = np.hstack([values for name, values in groups.items() if name != "noise"])
        out["without noise"] = accuracy(score_frames(others, label, frame, trained)[1], frame)
    if place == "sky":
        calm = np.hstack(list(features(without_spots(patches.images)).values()))
        out["without tracks"] = accuracy(score_frames(calm, label, frame, trained)[1], frame)
    real = label == 1
    out["real against real"] = accuracy(*_relabelled(whole[real], frame[real], splits, seed))
    blurred = np.stack(
        [ndimage.gaussian_filter(image.astype(np.float64), _BLUR_PX) for image in patches.images[~real]]
    )
    changed = features(np.round(blurred).astype(np.uint8))
    both, twice = np.vstack([whole[~real], np.hstack(list(changed.values()))]), np.tile(frame[~real], 2)
    kind = np.repeat([1, 0], len(blurred))
    out["blurred"] = accuracy(score_frames(both, kind, twice, trained)[1], twice)
    return out, score


def _relabelled(values: F64, frame: NDArray[np.int64], splits: int, seed: int) -> tuple[F64, NDArray[np.int64]]:
    """Return how often patches are told apart whose frames are called real or not at random, and their frames.

    Of frames that train and of those that test, half are called real.
    """
    right = np.zeros((splits, len(frame)))
    for split in range(splits):
        order = np.random.default_rng([seed, split, 1]).permutation(np.unique(frame))
        label = np.isin(frame, order[::2]).astype(np.int64)
        first = np.array([number for k, number in enumerate(order) if k // 2 % 2])
        right[split] = score_frames(values, label, frame, (first, np.setdiff1d(order, first)))[1]
    return right.mean(axis=0), frame


def told(
    pairs: Sequence[tuple[Look, Look]], place: str, *, size: int, count: int, splits: int, seed: int
) -> dict[str, float]:
    """Return the fraction of patches of a place that each kind of classifier tells.

    Patches and halves follow from `seed`.
    """
    patches = patches_of(pairs, place, size, count, seed)
    values = np.hstack(list(features(patches.images).values()))
    label, frame = patches.label, patches.frame
    trained = halves(frame, splits, seed)
    return {kind: accuracy(score_frames(values, label, frame, trained, kind)[1], frame)[0] for kind in kinds()}


def two_sample_test(
    pairs: Sequence[tuple[U8, U8]],
    *,
    size: int = 32,
    count: int = 12,
    splits: int = 4,
    draws: int = 4,
    seed: int = 1,
    advance: Callable[[], Any] = lambda: None,
) -> tuple[dict[str, dict[str, tuple[float, float, float]]], dict[str, U8]]:
    """Return for each place the accuracies (mean, low, high) by name, and a picture of patches told most surely.

    Parameters
    ----------
    pairs
        Real and rendered image, uint8[y, x], aligned; of at least 4 frames.
    size, count
        Side of the patches in px, and how many of a place are taken from a frame.
    splits, draws
        Random halves of the frames, and draws of patches and halves, of which the mean is `KIND, all features`.
    advance
        Called after each draw.

    Raises InputError for fewer frames.
    """
    if len(pairs) < FEWEST_FRAMES:
        raise InputError(f"{len(pairs)} frames: a classifier needs at least {FEWEST_FRAMES}")
    out: dict[str, dict[str, tuple[float, float, float]]] = {}
    pictures: dict[str, U8] = {}
    looks = [(look(real), look(rendered)) for real, rendered in pairs]
    for place in PLACES:
        patches = patches_of(looks, place, size, count, seed)
        if len(np.unique(patches.frame)) < FEWEST_FRAMES:
            continue
        parts, score = examine(patches, place, splits, seed)
        out[place], pictures[place] = parts, confident(patches, score)
        several = []
        for k in range(draws):
            several.append(told(looks, place, size=size, count=count, splits=splits, seed=seed + k))
            advance()
        for kind in kinds():
            fractions = [one[kind] for one in several]
            out[place][f"{kind}, all features"] = float(np.mean(fractions)), min(fractions), max(fractions)
    return out, pictures


def confident(patches: Patches, score: F64) -> U8:
    """Return the patches recognised most surely, real ones above and rendered ones below, three times enlarged."""
    rows = []
    for label, sign in ((1, 1.0), (0, -1.0)):
        which = np.flatnonzero(patches.label == label)
        best = which[np.argsort(-sign * score[which])][:_SHOWN]
        cells = []
        for k in best:
            patch = patches.images[k].astype(np.float64)
            low, high = np.percentile(patch, (0.5, 99.5))
            shown = np.clip((patch - low) / max(high - low, 6) * 255, 0, 255).astype(np.uint8)
            large = cv2.resize(shown, None, fx=3, fy=3, interpolation=cv2.INTER_NEAREST)
            cells.append(cv2.copyMakeBorder(large, 2, 2, 2, 2, cv2.BORDER_CONSTANT, value=(90,)))
        rows.append(np.hstack(cells))
    width = min(row.shape[1] for row in rows)
    return np.asarray(np.vstack([row[:, :width] for row in rows]), dtype=np.uint8)
