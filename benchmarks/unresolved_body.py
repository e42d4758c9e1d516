"""Measure the light of a body of few pixels against that of a frame which resolves it.

    python benchmarks/unresolved_body.py [--pointings N] [--lens NAME] [--shape FILE.obj] [--phase-deg A ...]

Prints, for each width in pixels, the sum over the frame of its radiance times the square of its distance, over the
mean of a body 16 pixels wide at the same phase: its mean and its largest deviation over pointings that differ by
fractions of a pixel. It must be 1 at any width. The body is an ellipsoid of 500 m, or the shape of a file.
"""

from __future__ import annotations

import argparse
import warnings
from typing import Any

import numpy as np

import vbnfault
from vbnfault.scene import config
from vbnfault.scene.config import Scene

WIDTHS_PX = (0.01, 0.1, 0.25, 0.5, 1.0, 2.0, 8.0, 16.0, 60.0, 70.0)
PIXELS, FOV_DEG = 128, 0.5
RADIUS_M = 500.0


def poses(
    widths_px: tuple[float, ...],
    pointings: int,
    phase_deg: float,
    diameter_m: float,
    fov_deg: float = FOV_DEG,
    reach_px: float = 4.0,
) -> dict[str, list[Any]]:
    """Return a table of poses from which the body has these widths, several for each."""
    pixel_rad = 2 * np.tan(np.radians(fov_deg) / 2) / PIXELS
    phase = np.radians(phase_deg)
    shifts = np.random.default_rng(1).uniform(-reach_px, reach_px, (pointings, 2))
    rows = []
    for width in widths_px:
        distance = diameter_m / (width * pixel_rad)
        for right, down in shifts * pixel_rad * distance:
            row = {"name": str(len(rows)), "julian_date": 2457000.5, "sun_distance_au": 2.5}
            row |= {"camera_x_T_m": right, "camera_y_T_m": down, "camera_z_T_m": distance}
            row |= {"camera_from_T_w": 0.0, "camera_from_T_x": 1.0, "camera_from_T_y": 0.0, "camera_from_T_z": 0.0}
            rows.append(row | {"sun_x_T": np.sin(phase), "sun_y_T": 0.0, "sun_z_T": np.cos(phase)})
    return {key: [row[key] for row in rows] for key in rows[0]}


def scene(lens: str = "", shape: str = "", **more: dict[str, Any]) -> Scene:
    """Return the scene of a body before a dark sky; `more` adds keys to its tables."""
    camera = {"fov_deg": FOV_DEG, "width_px": PIXELS, "height_px": PIXELS, "exposure_s": 0.01}
    body = {"shape": shape} if shape else {"shape": "ellipsoid", "semi_axes_m": [RADIUS_M] * 3}
    tables: dict[str, Any] = {
        "camera": {**camera, **({"lens": lens} if lens else {})},
        "body": {"name": "body", **body},
        "render": {"bands": 3},
        "dataset": {"layers": ["clean", "radiance"], "radiance_dtype": "float32"},
        "faults": {},
    }
    for name, table in more.items():
        tables[name] = {**tables.get(name, {}), **table}
    return config.parse_scene({"title": "unresolved", **tables}, source="unresolved")


def relative_light(
    of: Scene, widths_px: tuple[float, ...], pointings: int, phase_deg: float
) -> dict[float, np.ndarray]:
    """Return the light of each width over the mean of that of 16 pixels, float64[pointing] for each width."""
    diameter_m = float(np.ptp(vbnfault.Session(of).body.vertices_m, axis=0).max())
    session = vbnfault.Session(of, poses=poses((16.0, *widths_px), pointings, phase_deg, diameter_m))
    light = {}
    for row, width in enumerate((16.0, *widths_px)):
        radiance = [
            session.simulate(row * pointings + k).layers["radiance"].astype(np.float64).sum()
            for k in range(pointings)
        ]
        light[width] = np.array(radiance) / width**2
    reference = light[16.0].mean()
    return {width: light[width] / reference for width in widths_px}


def main() -> None:
    """Print the table of the arguments."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pointings", type=int, default=6)
    parser.add_argument("--lens", default="")
    parser.add_argument("--shape", default="")
    parser.add_argument("--phase-deg", type=float, nargs="*", default=[37.0, 90.0, 150.0])
    arguments = parser.parse_args()
    warnings.simplefilter("ignore")
    of = scene(arguments.lens, arguments.shape)
    print("width in px | " + " | ".join(f"phase {phase:g}°" for phase in arguments.phase_deg))
    columns = [relative_light(of, WIDTHS_PX, arguments.pointings, phase) for phase in arguments.phase_deg]
    for width in WIDTHS_PX:
        cells = [f"{c[width].mean():.4f} ± {np.abs(c[width] / c[width].mean() - 1).max():.4f}" for c in columns]
        print(f"{width:>11g} | " + " | ".join(cells))


if __name__ == "__main__":
    main()
