"""Measure whether a process that builds samples grows: its resident size after many samples and after a few.

    python benchmarks/resident_size.py paper67p --samples 500 --after 50 --size 128 [--limit 0.05]

The samples are made and written by this process alone, shard by shard as a worker of a build does it, but without
the replacement of worker processes by which a build limits what libraries leave behind. The size is read when the
shard with the sample is complete. The exit code is 1 if it grows by more than the limit.
"""

from __future__ import annotations

import argparse
import gc
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import psutil

from vbnfault import dataset, pipeline, store
from vbnfault.dataset import tasks
from vbnfault.scene import config


def resident_mib() -> float:
    """Return the resident size of this process in MiB, after a collection."""
    gc.collect()
    return float(psutil.Process().memory_info().rss / 2**20)


def measure(scene: str, samples: int, size: int, marks: list[int]) -> dict[int, float]:
    """Return the resident size in MiB after each number of samples in `marks`."""
    overrides: dict[str, Any] = {"dataset.samples": samples}
    if size:
        overrides |= {"camera.width_px": size, "camera.height_px": size}
    session = pipeline.Session(config.load_scene(scene, overrides))
    spec = dataset.store_spec(session, (samples,))
    sizes: dict[int, float] = {}
    began = time.monotonic()
    with tempfile.TemporaryDirectory() as folder:
        opened = store.create(Path(folder) / "s.zarr", spec, samples)
        for number in range(opened.shards):
            shard = opened.shard(number)
            task = tasks.Task(shard=number, sites=(0,) * len(shard))
            tasks.work(session.simulate, opened, task, lambda index, kind, text: None)
            for mark in (mark for mark in marks if shard.start < mark <= shard.stop):
                sizes[mark] = resident_mib()
                seconds = time.monotonic() - began
                print(f"{shard.stop:6d} samples  {sizes[mark]:8.1f} MiB  {seconds:6.0f} s", flush=True)
    return sizes


def main() -> None:
    """Measure and compare."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene")
    parser.add_argument("--samples", type=int, default=500)
    parser.add_argument("--after", type=int, default=50, help="number of samples with which the end is compared")
    parser.add_argument("--size", type=int, default=128, help="width and height in pixels; 0 keeps the scene's")
    parser.add_argument("--limit", type=float, default=0.05, help="largest growth as a fraction")
    options = parser.parse_args()
    step = max(1, options.samples // 10)
    marks = sorted({options.after, options.samples, *range(step, options.samples, step)})
    sizes = measure(options.scene, options.samples, options.size, marks)
    growth = sizes[options.samples] / sizes[options.after] - 1
    print(f"growth from {options.after} to {options.samples} samples: {growth:+.1%}, limit {options.limit:.0%}")
    sys.exit(growth > options.limit)


if __name__ == "__main__":
    main()
