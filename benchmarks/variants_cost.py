"""Measure what a labelled sample costs when several samples share a view, against one view a sample.

    python benchmarks/variants_cost.py [SCENE] [--samples N] [--variants K] [--size PX] [--threads N]
        [--functions N]
    python benchmarks/variants_cost.py [SCENE] --workers N [--samples N] [--variants K] [--size PX]

Both datasets are built into stores in one process: the same scene, seed, terrain and number of samples, with
`dataset.variants_per_view` of 1 and of K. Both plans command each fault class in equally many samples. The shards
of the two builds take turns, so that load and heat of the machine act on both. Before, samples with each fault
class are simulated and not counted, because kernels and the models of the lens serve a whole dataset. So does the
terrain of a site: one is used, and its load is not counted.

Few samples do not stand for a dataset: of `physical67p`, 32 have a fifth more faults a sample than 1000 have, and
with K = 8 only four views. So the default is 128 samples.

Printed are, for both builds, ms of wall and of CPU time per sample of each stage and of whole samples, with `store`
for encoding and writing; the numbers of renders, of samples with faults, and of their classes; and the ratios. With
--functions N, the N functions that take longest after the render of the build with K variants are printed, too; the
profile slows that build, so its ratio is then not the one to quote.

A build with as many workers as cores gives each worker one render thread; --threads 1 measures such a worker. With
--workers N, whole builds in N processes are timed instead. The time of a sample is then the difference between the
times of two builds, one of which has three times as many samples, divided by the difference of these numbers, so
that the start of the processes does not count. Builds with K = 1 have a quarter as many samples. --threads and
--functions have no effect on such builds.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as the command line sets it, before numpy is imported

import argparse
import cProfile
import pstats
import resource
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

import profile_sample

import vbnfault
from vbnfault import dataset, pipeline, store
from vbnfault.core.quantities import Sample
from vbnfault.dataset.tasks import Task, work
from vbnfault.pipeline.record import to_sample
from vbnfault.pipeline.rendering import render_view
from vbnfault.pipeline.resolve import resolve
from vbnfault.pipeline.stages import SharedViews, simulate_frame
from vbnfault.scene import config

P = ParamSpec("P")
T = TypeVar("T")

STAGES = (*profile_sample.STAGES, "store")


@dataclass
class Timed:
    """Build one store shard by shard, and add up wall and CPU time in s by stage.

    Attributes
    ----------
    wall_s, cpu_s
        Seconds by stage, and "sum" for the whole shards.
    calls
        Number of calls by stage.
    """

    session: pipeline.Session
    path: Path
    profile: cProfile.Profile | None = None
    wall_s: Counter[str] = field(default_factory=Counter)
    cpu_s: Counter[str] = field(default_factory=Counter)
    calls: Counter[str] = field(default_factory=Counter)
    failures: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        """Create the store."""
        self.views, samples = SharedViews(), len(self.session.plan)
        self.store = store.create(self.path, dataset.store_spec(self.session, [samples]), samples)

    def run(self, stage: Callable[P, T], /, *inputs: P.args, **options: P.kwargs) -> T:
        """Call a stage and count its time."""
        profiled = self.profile is not None and stage not in (resolve, render_view)
        wall, cpu = time.perf_counter(), time.process_time()
        if profiled:
            self.profile.enable()
        output = stage(*inputs, **options)
        if profiled:
            self.profile.disable()
        name = getattr(stage, "__name__", "stage")
        self.wall_s[name] += time.perf_counter() - wall
        self.cpu_s[name] += time.process_time() - cpu
        self.calls[name] += 1
        return output

    def simulate(self, index: int) -> Sample:
        """Return a sample, as `Session.simulate` does."""
        frame = simulate_frame(self.session.spec(index), self.run, self.views)
        self.calls["faulty"] += bool(frame.drawn)
        self.calls["classes"] += len(frame.drawn)
        return self.run(to_sample, frame)

    def shard(self, number: int) -> None:
        """Build a shard into the store."""

        def tick(index: int, what: str, text: str) -> None:
            if what == "failed":
                self.failures.append(f"sample {index}: {text}")

        sites = tuple(int(self.session.plan.site[i]) for i in self.store.shard(number))
        wall, cpu = time.perf_counter(), time.process_time()
        work(self.simulate, self.store, Task(shard=number, sites=sites), tick)
        self.wall_s["sum"] += time.perf_counter() - wall
        self.cpu_s["sum"] += time.process_time() - cpu

    def finish(self) -> None:
        """Count the rest of the shards' time as encoding and writing, and check that no sample failed."""
        assert not self.failures, self.failures
        for seconds in (self.wall_s, self.cpu_s):
            seconds["store"] = seconds["sum"] - sum(seconds[name] for name in STAGES)


def sessions(
    scene: str, samples: int, variants: int, settings: Mapping[str, Any], threads: int | None = None
) -> list[pipeline.Session]:
    """Return the sessions with one and with `variants` samples of a view, on one terrain."""
    out = []
    for k in (1, variants):
        table = {"samples": samples, "sites": 1, "variants_per_view": k, "shard_samples": variants}
        values = {f"dataset.{key}": value for key, value in table.items()}
        out.append(pipeline.Session(config.load_scene(scene, {**settings, **values}), threads=threads))
    alone, shared = out
    shared.body = alone.body
    shared.terrain = alone.terrain  # type: ignore[method-assign]
    return out


def warm_up(session: pipeline.Session, threads: int | None) -> None:
    """Compile kernels and make textures and the models of the lens, which all sessions of a process share.

    A second session of the same scene and terrain simulates samples until each fault class has been commanded. It
    is released afterwards, so that none of its views stays in memory.
    """
    other = pipeline.Session(session.scene, threads=threads)
    other.body = session.body
    other.terrain = session.terrain  # type: ignore[method-assign]
    missing = set(other.faults)
    for index in range(len(other.plan) - 1, -1, -1):
        here = missing & set(other.plan.commanded(index))
        if here or index == len(other.plan) - 1:
            other.simulate(index)
            missing -= here


def measure(
    scene: str,
    samples: int,
    variants: int,
    folder: Path,
    *,
    settings: Mapping[str, Any] | None = None,
    threads: int | None = None,
    profiled: bool = False,
) -> tuple[Timed, Timed]:
    """Build both stores in `folder`, shard by shard in turn, and return their times.

    `settings` are keys of the scene file with their values, as `build --set` takes them, and `threads` is as there.
    """
    both = sessions(scene, samples, variants, settings or {}, threads)
    profile = cProfile.Profile() if profiled else None
    warm_up(both[-1], threads)
    alone, shared = (
        Timed(session, folder / f"{k}.zarr", profile if k > 1 else None)
        for session, k in zip(both, (1, variants), strict=True)
    )
    for number in range(alone.store.shards):
        for build in (alone, shared):
            build.shard(number)
    for build in (alone, shared):
        build.finish()
    return alone, shared


def seconds_with_workers(
    scene: str, samples: int, variants: int, workers: int, settings: Mapping[str, Any]
) -> float:
    """Return the s a sample that builds in `workers` processes take when `variants` samples share a view.

    A first build fills the caches on disk with kernels and terrain, and is not counted.
    """
    took = []
    for number in (variants * workers, samples, 3 * samples):
        values = {"samples": number, "sites": 1, "variants_per_view": variants, "shard_samples": variants}
        given = config.load_scene(scene, {**settings, **{f"dataset.{key}": value for key, value in values.items()}})
        with tempfile.TemporaryDirectory() as folder:
            start = time.perf_counter()
            vbnfault.build(given, Path(folder) / "built.zarr", workers=workers)
            took.append(time.perf_counter() - start)
    return (took[2] - took[1]) / (2 * samples)


def table(alone: Timed, shared: Timed) -> str:
    """Return the stages of both builds in ms a sample, and the ratios."""
    samples = len(alone.session.plan)
    variants = shared.session.scene.dataset.variants_per_view
    head = f"{'ms a sample':<16}" + "".join(f"{f'K={k} {c}':>12}" for k in (1, variants) for c in ("wall", "CPU"))
    lines = [head]
    for name in (*STAGES, "sum"):
        values = [1e3 * t[name] / samples for build in (alone, shared) for t in (build.wall_s, build.cpu_s)]
        lines.append(f"{name:<16}" + "".join(f"{value:12.1f}" for value in values))
    for k, build in ((1, alone), (variants, shared)):
        calls = build.calls
        lines.append(
            f"K={k}: {samples} samples, {calls['render_view']} renders, {calls['faulty']} with faults, "
            f"{calls['classes'] / max(1, calls['faulty']):.2f} classes each"
        )
    wall, cpu = (b["sum"] / a["sum"] for a, b in ((alone.wall_s, shared.wall_s), (alone.cpu_s, shared.cpu_s)))
    lines.append(f"K={variants} over K=1: {wall:.3f} of the wall time, {cpu:.3f} of the CPU time")
    return "\n".join(lines)


def main() -> None:
    """Print the table, and the functions if asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", nargs="?", default="paper67p", help="a scene file or a packaged scene")
    parser.add_argument("--samples", type=int, default=128)
    parser.add_argument("--variants", type=int, default=8, metavar="K")
    parser.add_argument("--size", type=int, help="pixels along either side of the frame")
    parser.add_argument("--threads", type=int, metavar="N", help="render threads, as of build; default: all cores")
    parser.add_argument("--workers", type=int, metavar="N", help="time whole builds in N processes")
    parser.add_argument("--functions", type=int, default=0, metavar="N")
    given = parser.parse_args()
    size = {} if given.size is None else {"camera.width_px": given.size, "camera.height_px": given.size}
    if given.workers is not None:
        many, one = (
            seconds_with_workers(given.scene, number, k, given.workers, size)
            for k, number in ((given.variants, given.samples), (1, max(1, given.samples // 4)))
        )
        print(
            f"{given.workers} processes: K=1 {one:.3f} s a sample, "
            f"K={given.variants} {many:.3f} s, ratio {many / one:.3f}"
        )
        return
    with tempfile.TemporaryDirectory() as folder:
        alone, shared = measure(
            given.scene,
            given.samples,
            given.variants,
            Path(folder),
            settings=size,
            threads=given.threads,
            profiled=bool(given.functions),
        )
        digests = [store.digest(build.store)[:16] for build in (alone, shared)]
    print(table(alone, shared))
    print(f"digests {' '.join(digests)}")
    print(f"largest resident memory {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20:.2f} GiB")
    if shared.profile is not None:
        pstats.Stats(shared.profile).sort_stats("cumtime").print_stats("vbnfault|numpy|cv2", given.functions)


if __name__ == "__main__":
    main()
