"""Score a detector on all tests of a benchmark, and keep the figures of all detectors in one file."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from ..core.errors import InputError
from ..core.files.whole_files import write_json, writing
from .benchmark import MANIFEST, read_manifest, read_record
from .monitor_log import is_log
from .prediction import Detector
from .scored_samples import ALL, ScoreOptions
from .scoring import score

FILE = "leaderboard.json"


def is_benchmark(path: str | os.PathLike[str]) -> bool:
    """Return whether a path is the folder of a benchmark's datasets."""
    return (Path(path) / MANIFEST).is_file()


def score_benchmark(
    model: str | os.PathLike[str] | Detector,
    benchmark: Path,
    out: Path,
    options: ScoreOptions,
    advance: Callable[[int, int], Any] = lambda done, of: None,
) -> Iterator[tuple[str, dict[str, Any]]]:
    """Score a model on every test of a benchmark, and yield the name and the result of each.

    All samples of a test count. `out` gets a folder for each test. `leaderboard.json` beside the datasets gets the
    figures under the name of the model, in place of those of an earlier model of this name.

    Raises
    ------
    InputError
        There is no test, or model or list cannot be used.
    """
    if is_log(model):
        raise InputError(f"{model}: a log is scored on one dataset with sequences, not on a benchmark")
    parts = {name: part for name, part in read_manifest(benchmark)["parts"].items() if part["purpose"] == "test"}
    if not parts:
        raise InputError(f"{benchmark / MANIFEST}: lists no dataset for a test; make them with vbnfault bench")
    table = read_leaderboard(benchmark)
    given = {**vars(options), "split": ALL}
    row: dict[str, Any] = {}
    for name, part in parts.items():
        result = score(model, benchmark / part["store"], out / name, ScoreOptions(**given), advance)
        row[name] = {"dataset_sha256": result["dataset"]["sha256"], **figures_of(result)}
        table[result["name"]] = {"model": result["model"], "vbnfault": result["vbnfault"], "parts": row}
        with writing(benchmark / FILE):
            write_json(benchmark / FILE, table)
        yield name, result


def figures_of(result: dict[str, Any]) -> dict[str, Any]:
    """Return what a leaderboard says of one score: means, IoU and F1 by class, false alarms, pixels kept."""
    classes, alarms, navigation = result["classes"], result["false_alarms"], result["navigation"]
    return {
        "samples": result["samples"],
        "masks": result["options"]["masks"],
        "mean": result["mean"],
        "iou": {name: one["pixels"]["iou"] for name, one in classes.items()},
        "f1": {name: one["pixels"]["f1"] for name, one in classes.items()},
        "nominal_frames_with_alarm": {
            name: one["frames_with_alarm"] for name, one in alarms.items() if isinstance(one, dict)
        },
        "good_pixels_kept": navigation["good_pixels_kept"],
        "bad_pixels_let_through": navigation["bad_pixels_let_through"],
    }


def read_leaderboard(benchmark: Path) -> dict[str, Any]:
    """Return the figures of all models that were scored on a benchmark, by name. Raises InputError."""
    path = benchmark / FILE
    if not path.exists():
        return {}
    return read_record(
        path,
        lambda table: all(isinstance(row["parts"], dict) for row in table.values()),
        "is no leaderboard; move it away, and score the models again",
    )
