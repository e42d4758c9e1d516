"""Measure how well the levels of severity reproduce their errors on views that they were not computed from.

    python benchmarks/severity_levels.py --table scenes/severity/levels.toml --views 64 --workers 2

For each model, level and lens: the error on new views of new sites, divided by the error of the level, with its
95 % interval. A model that acts behind a thin lens alone is tested with two fields of view instead.
"""

from __future__ import annotations

import argparse
import json
import math
from pathlib import Path

import numpy as np

from vbnfault.dataset import BuildOptions
from vbnfault.faults import SeverityTable, read_table
from vbnfault.study import severity


def reproduced(
    table: SeverityTable, views: severity.ViewOptions, models: list[str], workers: int
) -> dict[str, dict[str, list[tuple[float, float, float]]]]:
    """Return the error and its interval at each level, by model and lens, for all levels that exist."""
    width_px = int(views.overrides["camera.width_px"])
    tested = []
    for model in severity.models_of(views.scene, models):
        levels = table.levels.get(model.fault, {}).get(model.model)
        if levels is None:
            continue
        values = tuple(
            model.severity.at_width(value, width_px, given_for_px=table.width_px)
            for value in levels.values
            if not math.isnan(value)
        )
        if not values:  # the model reaches no level
            continue
        tested.append(severity.ModelUnderTest(fault=model.fault, model=model.model, keys={}, values=values))
    job, _ = severity.evaluate_models(tested, views, table.metric, BuildOptions(workers=workers))
    errors: dict[str, dict[str, list[tuple[float, float, float]]]] = {}
    for model in tested:
        for k, lens in enumerate(views.lenses):
            by_view = job.of_lens(k, model.name)
            if by_view:
                errors.setdefault(model.name, {})[lens or "thin"] = [
                    _with_interval([dict(view)[model.at(value)[1]] for view in by_view], table.quantile)
                    for value in model.values
                ]
    return errors


def _with_interval(errors: list[float], quantile: float) -> tuple[float, float, float]:
    """Return the quantile over views of an error, and its 95 % interval by a bootstrap over the views."""
    curve = severity.RisingCurve.over([{0.0: error} for error in errors], quantile)
    return (math.nan,) * 3 if curve is None else (float(curve.at(np.zeros(1))[0]), *curve.interval(0.0))


def main() -> None:
    """Print the errors over those of the levels as a Markdown table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--table", type=Path, required=True, help="table of levels")
    parser.add_argument("--models", nargs="*", default=["all"], help="models or classes; default: all of the table")
    parser.add_argument("--lenses", nargs="*", help="lenses; default: those of the table")
    parser.add_argument("--views", type=int, default=64, help="number of views behind each lens")
    parser.add_argument("--sites", type=int, default=32, help="number of sites")
    parser.add_argument("--seed", type=int, default=99, help="seed of views and sites")
    parser.add_argument("--width-px", type=int, help="width and height of the images; default: that of the table")
    parser.add_argument("--fov-deg", type=float, default=65.0, help="field of view")
    parser.add_argument("--workers", type=int, default=1, help="number of processes")
    parser.add_argument("--json", type=Path, help="file for the figures")
    given = parser.parse_args()
    table = read_table(given.table)
    width_px = given.width_px or table.width_px
    overrides = {
        "camera.width_px": width_px,
        "camera.height_px": width_px,
        "camera.fov_deg": given.fov_deg,
        "dataset.seed": given.seed,
        "dataset.sites": given.sites,
        "patch.max_triangles": 200_000,
    }
    lenses = tuple("" if lens == "thin" else lens for lens in given.lenses or table.lenses)
    views = severity.ViewOptions(scene=table.scene, overrides=overrides, lenses=lenses, views=given.views)
    errors = reproduced(table, views, given.models, given.workers)
    print("| model | lens | level: error / error of the level [95 % interval] |\n|---|---|---|")
    for name, by_lens in errors.items():
        fault, model = name.split("/")
        kept = [k for k, value in enumerate(table.levels[fault][model].values) if not math.isnan(value)]
        for lens, levels in by_lens.items():
            cells = ", ".join(
                "{}: {:.2f} [{:.2f}, {:.2f}]".format(k + 1, *(error / table.errors[k] for error in level))
                for k, level in zip(kept, levels, strict=True)
            )
            print(f"| {name} | {lens} | {cells} |", flush=True)
    if given.json:
        given.json.write_text(json.dumps(errors), encoding="utf-8")


if __name__ == "__main__":
    main()
