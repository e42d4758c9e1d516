"""A small scene whose samples are nine frames of three sequences, and the columns of its table of poses."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from poses_kit import columns_of, row

FRAMES = (3, 1, 5)
NAMES = ("approach", "still", "leave")
SCENE = """
title = "frames"
body.shape = "body.obj"
faults.dust_on_optics.model = "defocused"
faults.cosmic_rays.flux_per_cm2_s = 3000.0
camera = {detector = "generic_ccd", width_px = 64, height_px = 48, fov_deg = 40.0, exposure_s = 0.02}
plan.faulty_fraction = 1.0
plan.classes_per_sample = [2, 2]
render = {bands = 2, samples_per_pixel = 1}
patch = {facet_m = 10.0, radius_m = 40.0, boulders = false, max_triangles = 20_000}
dataset = {shard_samples = 2, seed = 3}
trajectory.file = "poses.csv"
"""
EVENTS = """
[[event]]
cause = "dust event"
faults = ["dust_on_optics", "cosmic_rays"]
onset_s = [0.5, 1.5]
duration_s = 2.0
"""


def columns() -> dict[str, list[Any]]:
    """Return nine poses in three sequences, a second apart."""
    poses = [row(f"{k}", (0.0, 3e3 - 10 * k, 300.0), (0, 1, 0)) for k in range(sum(FRAMES))]
    sequence = np.repeat(NAMES, FRAMES).tolist()
    return {**columns_of(poses), "sequence": sequence, "time_s": [float(k) for n in FRAMES for k in range(n)]}


def write(path: Path, table: dict[str, list[Any]]) -> Path:
    """Write columns as a CSV file."""
    lines = [",".join(table), *(",".join(map(str, values)) for values in zip(*table.values(), strict=True))]
    path.write_text("\n".join(lines) + "\n")
    return path


def write_body(folder: Path, subdivisions: int = 3, relief: float = 0.0) -> Path:
    """Write an ellipsoid of the length and the volume of 67P into a folder, and return its path.

    It has 1280 facets: the packaged shape has 36,000, which would take most of the time of a test. `relief` is the
    standard deviation of the radii of its vertices over their mean.
    """
    ball = trimesh.creation.icosphere(subdivisions=subdivisions)
    ball.vertices *= 1 + relief * np.random.default_rng(0).normal(size=(len(ball.vertices), 1))
    ball.apply_scale([2500.0, 1336.0, 1336.0]).export(folder / "body.obj")
    return folder / "body.obj"


def write_scene(folder: Path, text: str = SCENE, table: dict[str, list[Any]] | None = None) -> Path:
    """Write a scene, its table of poses and its body into a folder, and return the path of the scene."""
    write_body(folder)
    write(folder / "poses.csv", table or columns())
    path = folder / "scene.toml"
    path.write_text(text)
    return path
