"""Print how often every fault class of each packaged scene is planned, and how often it is in the pixels.

    python benchmarks/scene_counts.py
    python benchmarks/scene_counts.py --samples 32 --keep stores navcam67p physical67p
    python benchmarks/scene_counts.py --set camera.width_px=2048 --set camera.height_px=2048 physical67p

Every scene is built with its own geometry, faults, lens and sensor, over coarse terrain, and then verified. A scene
with a detector keeps its number of pixels, because a small part of a sensor may have no visible defect. For all
other scenes, `--pixels` is the width, and the height keeps the aspect ratio. The exit status is 1 if a count
differs from the plan, or if `verify` reports a problem.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from vbnfault import dataset, store
from vbnfault.core.files import resources
from vbnfault.output import contact_sheet
from vbnfault.scene import config

HEAD = ("scene", "pixels", "samples", "planned", "realised", "redrawn", "views", "verify")


@dataclass(frozen=True, kw_only=True)
class Counts:
    """Planned and realised samples of one scene by fault class, and how often a view was replaced.

    Attributes
    ----------
    redrawn
        Number of samples whose first rendered view was not kept because a fault could not show in it.
    views
        Largest number of views that were rendered for one sample.
    problem
        The first problem that `verify` reports, or why there is no store.
    """

    scene: str
    size: tuple[int, int] = (0, 0)
    samples: int = 0
    planned: dict[str, int]
    realised: dict[str, int]
    redrawn: int = 0
    views: int = 0
    problem: str = ""

    @property
    def is_exact(self) -> bool:
        """Whether every class is in as many samples as planned, in a store without problems."""
        return not self.problem and self.planned == self.realised

    def cells(self) -> tuple[str, ...]:
        """Return the row of the table; HEAD names its columns."""
        short = contact_sheet.abbreviations(list(self.planned))
        planned, realised = (
            " ".join(f"{short[name]} {n}" for name, n in counts.items()) for counts in (self.planned, self.realised)
        )
        numbers = (str(self.samples), planned, realised, str(self.redrawn), str(self.views))
        return (self.scene, f"{self.size[0]}x{self.size[1]}", *numbers, self.problem or "whole")


def settings(scene: str, *, pixels: int, triangles: int) -> dict[str, object]:
    """Return the settings that make a scene small: fewer pixels, unless it has a detector, and coarse terrain."""
    whole = config.load_scene(scene)
    out: dict[str, object] = {"patch.max_triangles": min(triangles, whole.patch.max_triangles)}
    if not whole.camera.detector:
        width, height = whole.camera.width_px, whole.camera.height_px
        out |= {"camera.width_px": pixels, "camera.height_px": max(16, round(pixels * height / width))}
    return out


def counts(scene: str, path: Path, *, samples: int, given: Sequence[str]) -> Counts:
    """Build a scene's store at `path` with the settings `given`, verify it and return its counts."""
    most = config.load_scene(scene).dataset.samples
    command = [sys.executable, "-m", "vbnfault", "build", scene, "--out", str(path)]
    command += ["--samples", str(min(samples, most))]
    for setting in given:
        command += ["--set", setting]
    run = subprocess.run(command, check=False, capture_output=True, text=True)
    if run.returncode:
        last = (run.stderr.strip().splitlines() or ["no message"])[-1]
        return Counts(scene=scene, planned={}, realised={}, problem=f"build ended with {run.returncode}: {last}")
    opened = store.open_store(path)
    found = store.examine(opened, expected=dataset.planned(opened.attributes, opened.spec.faults))
    views = np.asarray(opened.read("views"))
    return Counts(
        scene=scene,
        size=(opened.spec.width, opened.spec.height),
        samples=opened.samples,
        planned={name: found.counts.planned(name) for name in opened.spec.faults},
        realised={name: found.counts.realised(name) for name in opened.spec.faults},
        redrawn=int((views > 1).sum()),
        views=int(views.max()),
        problem=str(found.problems[0]) if found.problems else "",
    )


def main() -> int:
    """Print one row for each scene and return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--samples", type=int, default=16, help="of each scene, at most [16]")
    parser.add_argument("--pixels", type=int, default=128, help="width of the frame without a detector [128]")
    parser.add_argument("--triangles", type=int, default=100_000, help="of a patch of ground, at most [100000]")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="as of vbnfault build")
    parser.add_argument("--keep", type=Path, help="folder to keep the stores in, SCENE.zarr [none is kept]")
    parser.add_argument("scenes", nargs="*", help="names [default: all packaged scenes]")
    given = parser.parse_args()
    rows = []
    print(" | ".join(HEAD), flush=True)
    with tempfile.TemporaryDirectory() as folder:
        for scene in given.scenes or resources.packaged("scenes"):
            small = settings(scene, pixels=given.pixels, triangles=given.triangles)
            keys = [*(f"{key}={value}" for key, value in small.items()), *given.set]
            path = (given.keep or Path(folder)) / f"{scene}.zarr"
            rows.append(counts(scene, path, samples=given.samples, given=keys))
            print(" | ".join(rows[-1].cells()), flush=True)
    return 0 if all(row.is_exact for row in rows) else 1


if __name__ == "__main__":
    sys.exit(main())
