"""Print digests of small builds of every packaged scene, to show which scenes a change has altered.

    python benchmarks/scene_digests.py --out digests.json
    python benchmarks/scene_digests.py --out after.json --before digests.json

Every scene is built with its own geometry, faults and lens, with a small image and few samples. Two digests are
printed: `pixels` covers image, clean twin and masks; `store` covers all arrays and attributes, including the
versions of the libraries. Run both versions on one machine with the same libraries: only then are the bits
reproducible.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

from vbnfault import store
from vbnfault.core.files import resources

_PIXELS = ("image", "clean", "mask")


def digests(scene: str, *, samples: int, pixels: int, folder: Path) -> dict[str, str]:
    """Build one packaged scene and return its digests by name, each sha256 in hexadecimal."""
    path = folder / f"{scene}.zarr"
    settings = {
        "camera.width_px": pixels,
        "camera.height_px": pixels,
        "dataset.sites": 2,
        "dataset.shard_samples": max(1, samples // 2),
        "patch.max_triangles": 100_000,
    }
    command = [sys.executable, "-m", "vbnfault", "build", scene, "--out", str(path), "--samples", str(samples)]
    if scene == "paper_example":
        settings["dataset.sites"] = settings["dataset.shard_samples"] = 1
        command[-1] = "1"
    for key, value in settings.items():
        command += ["--set", f"{key}={value}"]
    run = subprocess.run(command, check=False, capture_output=True, text=True)
    if run.returncode:
        return {"pixels": "failed", "store": (run.stderr.strip().splitlines() or ["no message"])[-1]}
    opened = store.open_store(path)
    total = hashlib.sha256()
    for name in _PIXELS:
        total.update(np.ascontiguousarray(opened.read(name)).data)
    return {"pixels": total.hexdigest(), "store": store.digest(opened)}


def main() -> None:
    """Print the table and write it as JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="JSON to write")
    parser.add_argument("--before", type=Path, help="JSON of an earlier run, to compare with")
    parser.add_argument("--samples", type=int, default=4)
    parser.add_argument("--pixels", type=int, default=96)
    parser.add_argument("scenes", nargs="*", help="names [default: all packaged scenes]")
    given = parser.parse_args()
    given.out.parent.mkdir(parents=True, exist_ok=True)
    before = json.loads(given.before.read_text(encoding="utf-8")) if given.before else {}
    table: dict[str, dict[str, str]] = {}
    with tempfile.TemporaryDirectory() as folder:
        for scene in given.scenes or resources.packaged("scenes"):
            table[scene] = digests(scene, samples=given.samples, pixels=given.pixels, folder=Path(folder))
            line = f"{scene:<20} pixels {table[scene]['pixels'][:16]:<16}  store {table[scene]['store'][:80]}"
            if scene in before:
                same = before[scene]["pixels"] == table[scene]["pixels"]
                line += "  as before" if same else f"  pixels were {before[scene]['pixels'][:16]}"
            print(line, flush=True)
            given.out.write_text(json.dumps(table, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
