"""Compare networks that were trained on painted faults, on physical ones, and on both, on the tests of a benchmark.

    vbnfault bench --out bench --workers 2
    python benchmarks/physics_against_paint.py bench --out trained --seeds 0 1 2 --epochs 6

Network, number of images, optimiser and steps are the same: "paint" has the two training parts with faults of the
paper's models, "physics" the same views with physical faults, "both" one part of each. Each is trained with every
seed and scored on every test, with `bench --frames FOLDER` on images of one's own, too; what exists in the folder
is not made again. PyTorch computes in one thread, so that two calls may train different seeds side by side
(`--arms`, `--seeds`). `physics_against_paint.md` has the means over the seeds and their range: mean IoU and
F1, both by class, the figures of straylight alone, severity, and alarms in nominal frames. A figure shows the IoU
by class.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib.lines import Line2D

from vbnfault.core import figures
from vbnfault.detect.benchmark import read_manifest
from vbnfault.detect.scored_samples import ALL, ScoreOptions
from vbnfault.detect.scoring import FILE, score
from vbnfault.detect.training import TrainOptions, train

ARMS = {
    "paint": ("train_paint_a", "train_paint_b"),
    "physics": ("train_physics_a", "train_physics_b"),
    "both": ("train_paint_a", "train_physics_b"),
}
ACROSS = 4  # panels side by side in the figure
Results = dict[str, dict[str, list[dict[str, Any]]]]


def scored(bench: Path, out: Path, options: argparse.Namespace) -> Results:
    """Return the scores by arm and test, one for each seed; train and score what does not exist."""
    parts = read_manifest(bench)["parts"]
    tests = {name: part for name, part in parts.items() if part["purpose"] == "test"}
    results: Results = {arm: {name: [] for name in tests} for arm in options.arms}
    for seed in options.seeds:
        for arm in options.arms:
            stores = [str(bench / parts[name]["store"]) for name in ARMS[arm] if name in parts]
            model = out / f"{arm}_{seed}"
            how = TrainOptions(epochs=options.epochs, patience=options.epochs, seed=seed)
            train(stores, model, how, progress=True)
            for name, part in tests.items():
                folder = out / f"{arm}_{seed}_on_{name}"
                if not (folder / FILE).exists():
                    score(model, bench / part["store"], folder, ScoreOptions(split=ALL, navigation=False))
                results[arm][name].append(json.loads((folder / FILE).read_text()))
    return results


def of_seeds(values: list[float | None]) -> str:
    """Return mean and range of a figure over the seeds."""
    known = [v for v in values if v is not None]
    if not known:
        return "–"
    return f"{np.mean(known):.3f} ({min(known):.3f} to {max(known):.3f})"


def table(results: Results, rows: Mapping[str, Sequence[str]]) -> list[str]:
    """Return the lines of a Markdown table of figures by the keys of `score.json` that lead to each."""
    tests = next(iter(results.values()))
    lines = ["| test | figure | " + " | ".join(results) + " |", "|---|---|" + "---|" * len(results)]
    for test in tests:
        for figure, keys in rows.items():
            cells = [of_seeds([_value(one, keys) for one in results[arm][test]]) for arm in results]
            if set(cells) != {"–"}:
                lines.append(f"| {test} | {figure} | " + " | ".join(cells) + " |")
    return [*lines, ""]


def _value(one: Any, keys: Sequence[str]) -> float | None:
    """Return a figure of a score; None where it has none."""
    for key in keys:
        one = one[key]
    found: float | None = one["value"]
    return found


def tables(results: Results) -> list[str]:
    """Return the lines of all tables."""
    alarms = ("false_alarms", "all")
    classes = next(iter(next(iter(results.values())).values()))[0]["classes"]
    light = ("classes", "straylight")
    return [
        *table(
            results,
            {
                "mean IoU": ("mean", "iou"),
                "mean F1": ("mean", "f1"),
                "severity within one level": ("severity", "within_one_level"),
                "nominal frames with a marked pixel": (*alarms, "frames_with_alarm"),
                "nominal frames told faulty": (*alarms, "frames_told_faulty"),
                "marked pixels of nominal frames": (*alarms, "pixels_fraction"),
            },
        ),
        *table(
            results,
            {
                f"{name}: {text}": ("classes", name, "pixels", figure)
                for name in classes
                for text, figure in (("IoU", "iou"), ("F1", "f1"))
            },
        ),
        *table(
            results,
            {f"straylight {name}": (*light, "pixels", name) for name in ("iou", "precision", "recall")}
            | {"straylight artefact precision": (*light, "artefacts", "pap")},
        ),
    ]


def draw(results: Results, path: Path) -> None:
    """Draw the IoU of each class on each test with faults, the mean over the seeds, with its range."""
    by_test = next(iter(results.values()))
    tests = [name for name, ones in by_test.items() if ones[0]["mean"]["iou"]["value"] is not None]
    classes = list(by_test[tests[0]][0]["classes"])
    panel = (110.0, figures.row_height(classes) * len(classes))
    legend = [
        Line2D([], [], ls="", marker=marker, color=colour, label=arm)
        for arm, marker, colour in zip(results, figures.SERIES_MARKERS, figures.SERIES_COLOURS, strict=False)
    ]
    grid = -(-len(tests) // ACROSS), min(ACROSS, len(tests))
    with figures.panels("trained on", grid, panel, legend=legend) as (figure, axes):
        for axis in axes[len(tests) :]:
            axis.remove()
        for axis, test in zip(axes, tests, strict=False):
            for k, (scores, line) in enumerate(zip(results.values(), legend, strict=True)):
                found = [
                    [_value(one, ("classes", name, "pixels", "iou")) for one in scores[test]] for name in classes
                ]
                iou = np.array([[value or 0.0 for value in row] for row in found])
                middle = iou.mean(axis=1)
                reach = np.abs(np.stack([iou.min(axis=1), iou.max(axis=1)]) - middle)
                place = np.arange(len(classes)) + 0.24 * (k - 1)
                axis.errorbar(middle, place, xerr=reach, fmt=line.get_marker(), color=line.get_color(), ms=4)
            axis.set(xlim=(0, 1), xlabel="IoU", title=test)
        for first in range(0, len(tests), grid[1]):
            figures.label_rows(axes[first : min(first + grid[1], len(tests))], classes)
        path.write_bytes(figures.png_bytes(figure))


def main() -> None:
    """Train, score, and write the table and the figure."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("bench", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--seeds", nargs="+", type=int, default=(0, 1, 2))
    parser.add_argument("--epochs", type=int, default=6)
    parser.add_argument("--arms", nargs="+", choices=tuple(ARMS), default=tuple(ARMS))
    options = parser.parse_args()
    torch.set_num_threads(1)
    results = scored(options.bench, options.out, options)
    lines = tables(results)
    (options.out / "physics_against_paint.md").write_text("\n".join(lines) + "\n")
    draw(results, options.out / "physics_against_paint.png")
    print("\n".join(lines))


if __name__ == "__main__":
    main()
