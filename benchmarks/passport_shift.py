"""Measure how far rendered patches of a passport lie from real ones, and which settings bring them nearer.

    python benchmarks/passport_shift.py passport/pairs --place limb
    python benchmarks/passport_shift.py passport/pairs halo/pairs core/pairs --place limb

The shift between the means of the classifier's features (`fit.two_samples`) is measured by their covariance within
the classes: d is its length (Mahalanobis 1936), and a linear discriminant (Fisher 1936) tells real from rendered by
its direction. For Rosetta's camera that tells as many patches as the other classifiers do. The same ground under
other sensors gave d from 1.33 to 1.36 where accuracies moved by 2 %, so d is what to compare settings by. A partial
shift is what a feature still says where all others are known, in standard deviations. By chance, equal classes of n
patches with p features have d² = 2 p / n.

Further folders hold images of the same frames at the same poses, each with one setting changed. Each setting moves
the means. By least squares, multiples of the changes are found that together leave the shortest shift. A large
multiple must be rendered before it is believed.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vbnfault.fit import two_samples
from vbnfault.fit.frames import look, read_frame

F64 = NDArray[np.float64]

SIZE_PX, COUNT, DRAWS, HALVES = 32, 12, 4, 12
RIDGE = 0.02  # added to the variance of standardised features
PENALTY = 0.1  # on squared multiples of the settings


def images(folder: Path) -> dict[str, list[NDArray[np.float32]]]:
    """Return the real and the rendered image of each frame."""
    names = sorted(path.stem.removesuffix("_real") for path in folder.glob("*_real.png"))
    return {name: [read_frame(folder, f"{name}_{which}") for which in ("real", "rendered")] for name in names}


def vectors(parts: list[NDArray[np.float32]], corners: list[NDArray[np.int64]]) -> tuple[F64, list[str]]:
    """Return the features of patches of some images, float64[n, feature], and their names."""
    patches = [two_samples.cut(part.astype(np.uint8), at, SIZE_PX) for part, at in zip(parts, corners, strict=True)]
    groups = two_samples.features(np.concatenate(patches))
    names = [f"{group} {k}" for group, values in groups.items() for k in range(values.shape[1])]
    return np.hstack(list(groups.values())), names


def discriminant(real: F64, rendered: F64) -> tuple[F64, F64, F64]:
    """Return the scale of the features, the inverse of their covariance within classes, and the shift of the means.

    Covariance and shift are of the features over their scale.
    """
    scale = np.sqrt((real.var(axis=0) + rendered.var(axis=0)) / 2) + 1e-9
    within = np.vstack([real - real.mean(axis=0), rendered - rendered.mean(axis=0)]) / scale
    covariance = within.T @ within / len(within) + RIDGE * np.eye(len(scale))
    return scale, np.linalg.inv(covariance), (real.mean(axis=0) - rendered.mean(axis=0)) / scale


def told(real: F64, rendered: F64, frame: NDArray[np.int64]) -> float:
    """Return the fraction of patches that the discriminant tells in frames that it has not seen."""
    right = []
    for trained in two_samples.halves(frame, HALVES, 0):
        train = np.isin(frame, trained)
        scale, inverse, shift = discriminant(real[train], rendered[train])
        middle = (real[train].mean(axis=0) + rendered[train].mean(axis=0)) / 2
        scores = (((part[~train] - middle) / scale) @ inverse @ shift for part in (real, rendered))
        right.append(np.mean([sign * score > 0 for sign, score in zip((1, -1), scores, strict=True)]))
    return float(np.mean(right))


def main() -> int:
    """Print the shift of the first folder, and those of the others."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("pairs", nargs="+", type=Path, help="folders of NAME_real.png and NAME_rendered.png")
    parser.add_argument("--place", choices=two_samples.PLACES, default="body")
    given = parser.parse_args()
    base, place = images(given.pairs[0]), two_samples.PLACES.index(given.place)
    corners = []
    for number, pair in enumerate(base.values()):
        looks, draws = [look(part) for part in pair], range(DRAWS)
        rngs = (np.random.default_rng([draw, number, place]) for draw in draws)
        corners.append(
            np.concatenate([two_samples.positions(*looks, SIZE_PX, given.place, COUNT, rng) for rng in rngs])
        )
    frame = np.repeat(np.arange(len(corners)), [len(at) for at in corners])
    (real, names), (rendered, _) = (vectors([pair[k] for pair in base.values()], corners) for k in (0, 1))
    scale, inverse, shift = discriminant(real, rendered)
    whitening = np.linalg.cholesky(inverse).T
    start = whitening @ shift
    print(f"{given.pairs[0]}: d {np.linalg.norm(start):.3f}, told {100 * told(real, rendered, frame):.1f} %")
    partial = inverse @ shift / np.sqrt(np.diag(inverse))
    for k in np.argsort(-np.abs(partial))[:10]:
        print(f"  {names[k]:<14} shift {shift[k]:+.2f}, partial {partial[k]:+.2f}")
    moves = []
    for folder in given.pairs[1:]:
        other = images(folder)
        changed, _ = vectors([other[name][1] for name in base], corners)
        move = whitening @ ((changed.mean(axis=0) - rendered.mean(axis=0)) / scale)
        best = float(move @ start / (move @ move))
        print(
            f"{folder}: d {np.linalg.norm(start - move):.3f}, told {100 * told(real, changed, frame):.1f} %; "
            f"{best:+.2f} times the change: d {np.linalg.norm(start - best * move):.3f}"
        )
        moves.append(move)
    if len(moves) > 1:
        by_setting = np.array(moves).T
        times = np.linalg.solve(by_setting.T @ by_setting + PENALTY * np.eye(len(moves)), by_setting.T @ start)
        print(f"together: d {np.linalg.norm(start - by_setting @ times):.3f} with")
        for folder, multiple in zip(given.pairs[1:], times, strict=True):
            print(f"  {multiple:+.2f} times {folder}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
