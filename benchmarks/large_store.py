"""Measure how long listing, statistics and the resumption of a large store take.

    python benchmarks/large_store.py --samples 100000 [--folder /path/of/a/disk] [--json numbers.json]

The store has the scalars and layers of the scene paper67p, and images of 16 px. Sixteen shards of made-up samples
are written, and every further shard is hard links to one of them, so that a store of 100,000 samples takes a minute
and little room. Its last shard is missing. Measured are:

- `list`: open the store and count its finished samples.
- `stats`: the planned and realised statistics, as `vbnfault stats` prints them.
- `resume`: the time until a build that continues the store begins with its first new sample. What is finished is
  checked after that.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from vbnfault import dataset, pipeline, store
from vbnfault.core.process import interrupts
from vbnfault.core.quantities import Sample
from vbnfault.dataset import build
from vbnfault.dataset.identity import stored_plan
from vbnfault.dataset.statistics import statistics
from vbnfault.scene import config

LIMIT_S = 10.0
TEMPLATES = 16


class Maker:
    """Stop the build at its first new sample."""

    def __call__(self) -> Maker:
        return self

    def simulate(self, index: int) -> Sample:
        """Stop, as Ctrl-C does."""
        raise KeyboardInterrupt


def made_up(spec: store.StoreSpec, index: int, injected: np.ndarray) -> Sample:
    """Return a sample with drawn parameters of about the number that real ones have."""
    rng = np.random.default_rng([1, index])
    layers = {name: np.zeros(spec.shape(row), dtype=row.dtype) for name, row in spec.pixel_layers.items()}
    scalars: dict[str, Any] = {}
    for name, row in store.SCALARS.items():
        scalars[name] = rng.random(spec.shape(row)) if row.dtype == "float64" else 0
    drawn = {
        fault: {"model": "made_up", "x": rng.random(20).tolist(), "y": rng.random(20).tolist(), "level": index}
        for fault, on in zip(spec.faults, injected, strict=True)
        if on
    }
    split = store.SPLITS[index // spec.shard_samples % 3]
    scalars |= {"injected": injected, "parameters": drawn, "proposal": "{}", "split": split, "views": 1, "tries": 1}
    return Sample(index=index, layers=layers, scalars=scalars)


def make(path: Path, samples: int) -> store.Store:
    """Create the store, with 16 samples in a shard, the most that a store has."""
    size = {"camera.width_px": 16, "camera.height_px": 16, "dataset.samples": samples, "dataset.sites": 64}
    session = pipeline.Session(config.load_scene("paper67p", {**size, "dataset.shard_samples": 16}))
    spec = dataset.store_spec(session, (samples,))
    opened = store.create(path, spec, samples)
    commanded = stored_plan(spec.attributes, spec.faults)[1].injected
    made = min(samples, TEMPLATES * spec.shard_samples)
    store.write_samples(opened, (made_up(spec, i, commanded[i]) for i in range(made)))
    names = list(opened.spec.arrays)
    for number in range(TEMPLATES, opened.shards - 1):
        for name in names:
            target = opened.file(name, number)
            target.parent.mkdir(parents=True, exist_ok=True)
            os.link(opened.file(name, number % TEMPLATES), target)
    return opened


def timed(action: Any) -> tuple[tuple[float, float], Any]:
    """Return the duration of a call and the time that it computed, in s, and its result."""
    start, computed = time.perf_counter(), time.process_time()
    result = action()
    return (time.perf_counter() - start, time.process_time() - computed), result


def resume(opened: store.Store) -> None:
    """Continue the store until its first new sample."""
    site = np.zeros(opened.samples, dtype=np.int64)
    plan = build.BuildPlan(spec=opened.spec, site=site, blocks=(opened.samples,))
    try:
        build.build(Maker(), plan, opened.path, build.BuildOptions(progress=False))
    except interrupts.Interrupted:
        return
    raise AssertionError("the build made no sample")


def main() -> None:
    """Make the store, measure, and print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--samples", type=int, default=100_000)
    parser.add_argument("--folder", help="where the store is made, and removed afterwards")
    parser.add_argument("--json", help="also write the numbers to this file")
    options = parser.parse_args()
    if options.folder:
        Path(options.folder).mkdir(parents=True, exist_ok=True)
    folder = Path(tempfile.mkdtemp(dir=options.folder, prefix="large-store-"))
    try:
        (seconds, _), opened = timed(lambda: make(folder / "large.zarr", options.samples))
        print(f"{opened.samples} samples in {opened.shards} shards, made in {seconds:.0f} s")
        results = {}
        results["list"], finished = timed(lambda: store.open_store(opened.path).finished())
        results["stats"], numbers = timed(lambda: statistics(opened.path))
        results["resume"], _ = timed(lambda: resume(opened))
        assert numbers.finished == finished > 0
        for name, (duration, computed) in results.items():
            verdict = "met" if duration < LIMIT_S else "MISSED"
            print(f"{name:8s} {duration:6.2f} s, computed {computed:6.2f} s   under {LIMIT_S:g} s: {verdict}")
        if options.json:
            Path(options.json).write_text(json.dumps(results, indent=1), encoding="utf-8")
    finally:
        shutil.rmtree(folder)


if __name__ == "__main__":
    main()
