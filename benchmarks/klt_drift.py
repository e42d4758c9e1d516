"""Track features by OpenCV's KLT over a descent, with each fault and without, against where the ground truly is.

    python benchmarks/klt_drift.py --out docs/figures/klt_drift.png [--size 256] [--frames 50] [--json FILE]

The camera of `descent67p` falls from 60 m to 40 m. For each class of fault, a data set of one sequence is built, in
which all frames have the fault from the first to the last. Corners of the first clean frame are tracked from frame
to frame, in the clean images and in those with the fault. The figure shows the median distance from the truth
(`vbnfault.navigation.tracks`) of the corners that are still tracked, and the fraction that is within 2 px of it.
"""

from __future__ import annotations

import argparse
import itertools
import json
import tempfile
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

import vbnfault
from vbnfault.navigation import tracks

F64 = NDArray[np.float64]

FAULTS: dict[str, dict[str, Any]] = {
    "dust_on_optics": {"model": "defocused"},
    "broken_pixels": {"model": "hot_pixels", "growth_factor": 200.0},
    "broken_lines": {"model": "readout"},
    "straylight": {"model": "surroundings"},
    "optics_degradation": {"model": "contamination"},
    "frozen_frame": {"model": "repeated", "rows_fraction": [0.3, 0.6]},
}
CORNERS, WITHIN_PX = 200, 2.0
SEQUENCE = "descent/0"


def scene_with(fault: str, size: int, frames: int) -> Any:
    """Return the scene of one descent whose frames all have a fault."""
    flight = {
        "kind": "descent",
        "frames": frames,
        "period_s": 450.0 / frames,
        "height_m": 60.0,
        "end_height_m": 40.0,
        "sun_elevation_deg": [30.0, 60.0],
        "attitude_noise_deg": 0.3,
    }
    changes = {
        "camera.width_px": size,
        "camera.height_px": size,
        "patch.max_triangles": 800_000,
        "trajectory.flight": [flight],
        "dataset.layers": ["clean", "depth_m", "semantic"],
        "dataset.seed": 7,
        "plan.faulty_fraction": 1.0,
        "plan.classes_per_sample": [1, 1],
        "faults": {fault: FAULTS[fault]},
        "event": [],
    }
    return vbnfault.load_scene("descent67p", changes)


def tracked(images: NDArray[np.uint8], corners: NDArray[np.float32]) -> tuple[F64, NDArray[np.bool_]]:
    """Return positions float64[frame, corner, 2] from the top left corner, and which are still tracked, by KLT."""
    positions, alive = [corners.astype(float)], [np.ones(len(corners), bool)]
    now = corners.reshape(-1, 1, 2)
    for before, after in itertools.pairwise(images):
        now, status, _ = cv2.calcOpticalFlowPyrLK(before, after, now, None, winSize=(21, 21), maxLevel=3)
        alive.append(alive[-1] & (status.ravel() == 1))
        positions.append(now.reshape(-1, 2).astype(float))
    return np.array(positions) + 0.5, np.array(alive)


def drift(path: Path) -> dict[str, dict[str, list[float]]]:
    """Return the median error in px and the fraction within 2 px of each frame, clean and faulty."""
    with vbnfault.open_dataset(path) as data:
        images = {name: data[name].values[..., 3] for name in ("clean", "image")}
        corners = cv2.goodFeaturesToTrack(images["clean"][0], CORNERS, 0.01, 7).reshape(-1, 2)
        truth = tracks(data, SEQUENCE, np.floor(corners) + 0.5)
    # a corner keeps its offset from the centre of its pixel
    true = truth.xy_px + (corners - np.floor(corners))
    out = {}
    for name, frames in images.items():
        positions, alive = tracked(frames, corners)
        error = np.linalg.norm(positions - true, axis=2)
        inside = truth.visible & np.isfinite(error)
        counted = alive & inside
        out[name] = {
            "median_px": [
                float(np.median(e[c])) if c.any() else float("nan") for e, c in zip(error, counted, strict=True)
            ],
            "within": [
                float(((e < WITHIN_PX) & c).sum() / max(int(i.sum()), 1))
                for e, c, i in zip(error, counted, inside, strict=True)
            ],
        }
    return out


def main() -> None:
    """Build the data sets, track, and draw the figure."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--size", type=int, default=256)
    parser.add_argument("--frames", type=int, default=50)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    found = {}
    with tempfile.TemporaryDirectory() as folder:
        for fault in FAULTS:
            path = Path(folder) / f"{fault}.zarr"
            vbnfault.build(scene_with(fault, options.size, options.frames), path, workers=2, progress=False)
            found[fault] = drift(path)
            last = {
                name: [round(values[-1], 3) for values in curves.values()] for name, curves in found[fault].items()
            }
            print(fault, last, flush=True)
    if options.json:
        options.json.write_text(json.dumps(found))
    draw(found, options.out)


def draw(found: dict[str, dict[str, dict[str, list[float]]]], path: Path) -> None:
    """Draw median errors and fractions over the frames."""
    from matplotlib.figure import Figure

    drawn = Figure(figsize=(9.0, 3.4), layout="constrained")
    left, right = drawn.subplots(1, 2)
    clean = next(iter(found.values()))["clean"]
    for axes, key, label in ((left, "median_px", "median error / px"), (right, "within", "fraction within 2 px")):
        frames = range(1, len(clean[key]))  # in the first one, corners are where they are
        for fault, curves in found.items():
            axes.plot(frames, curves["image"][key][1:], label=fault.replace("_", " "))
        axes.plot(frames, clean[key][1:], color="black", linestyle="--", label="no fault")
        axes.set_xlabel("frame")
        axes.set_ylabel(label)
    left.set_yscale("log")
    right.set_ylim(0, 1.05)
    right.legend(fontsize=7)
    drawn.savefig(path, dpi=110)


if __name__ == "__main__":
    main()
