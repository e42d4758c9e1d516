"""Measure how long each stage of one or several samples takes.

    python benchmarks/profile_sample.py [SCENE] [--sample I] [--rounds N]
    python benchmarks/profile_sample.py physical67p --samples 0 1 2 3

The first form prints the median duration of each stage of one sample in ms, after one warm-up. With --functions N
it also prints the N functions of vbnfault that take longest in the stages after the render. The time of a thread
counts for the function that waits for it.

The second form runs each named sample once and prints two rows for it: the durations of the stages and their CPU
times, in s, each with its sum; millions of samples traced and kept; the number of views; `noise_fraction_p99`. The
last rows are the medians and the largest values. On a machine with other load, CPU times and counts tell more than
durations. The terrain of a sample is loaded or built before its stages; its duration is not part of the sum.
"""

from __future__ import annotations

import argparse
import cProfile
import pstats
import resource
import time
from collections import defaultdict
from collections.abc import Callable
from typing import Any, ParamSpec, TypeVar

import numpy as np
from workload import clock, medians

from vbnfault import pipeline
from vbnfault.pipeline.record import to_sample
from vbnfault.pipeline.rendering import render_view
from vbnfault.pipeline.resolve import resolve
from vbnfault.pipeline.spec import Frame, SampleSpec
from vbnfault.render import light, sampling
from vbnfault.scene import config

P = ParamSpec("P")
T = TypeVar("T")

STAGES = (
    "resolve",
    "render_view",
    "meter",
    "add_stars",
    "inject_faults",
    "take_images",
    "label",
    "to_sample",
)


def stages(
    spec: SampleSpec,
    profile: cProfile.Profile | None = None,
    frames: list[Frame] | None = None,
    cpu: dict[str, float] | None = None,
) -> dict[str, float]:
    """Return the duration in s of each stage of one sample; `profile` records the stages after the render.

    The frame is appended to `frames`, and the stages' CPU times in s are added to `cpu`, if they are given.
    """
    seconds: dict[str, float] = defaultdict(float)  # a stage runs once for every view of the sample

    def timed(stage: Callable[P, T], /, *inputs: P.args, **options: P.kwargs) -> T:
        after = profile is not None and stage not in (resolve, render_view)
        if after:
            profile.enable()
        start = time.process_time()
        duration, output = clock(lambda: stage(*inputs, **options))
        if after:
            profile.disable()
        seconds[stage.__name__] += duration
        if cpu is not None:
            cpu[stage.__name__] += time.process_time() - start
        return output

    frame = pipeline.simulate_frame(spec, timed)
    seconds["to_sample"], _ = clock(lambda: to_sample(frame))
    if frames is not None:
        frames.append(frame)
    return seconds


def count_traced() -> Callable[[], float]:
    """Count the samples of all wavefronts; return the function that returns the count and resets it."""
    traced = 0
    of_pixels, of_cells = sampling.Strata.__init__, light.CellStrata.__init__

    def pixels_counted(self: sampling.Strata, pixels: sampling.Pixels, samples: int, *more: Any) -> None:
        nonlocal traced
        traced += pixels.count * samples
        of_pixels(self, pixels, samples, *more)

    def cells_counted(self: light.CellStrata, listed: light.Cells, samples: int, *more: Any) -> None:
        nonlocal traced
        traced += len(listed.pixel) * samples
        of_cells(self, listed, samples, *more)

    sampling.Strata.__init__ = pixels_counted  # type: ignore[method-assign]
    light.CellStrata.__init__ = cells_counted  # type: ignore[method-assign]

    def taken() -> float:
        nonlocal traced
        count, traced = traced, 0
        return float(count)

    return taken


def compare(session: pipeline.Session, samples: list[int]) -> None:
    """Print two rows for each sample, and the medians and the largest values."""
    traced, rows = count_traced(), []
    columns = (*STAGES, "sum", "traced_M", "kept_M", "views", "noise_p99", "terrain")
    print("sample       " + " ".join(f"{name[:11]:>11}" for name in columns))

    def show(title: str, row: dict[str, float], cpu: dict[str, float]) -> None:
        print(f"{title:<8}wall " + " ".join(f"{row[name]:11.2f}" for name in columns))
        times = (*STAGES, "sum")
        print(f"{'':<8}cpu  " + " ".join(f"{cpu[name]:11.2f}" for name in times), flush=True)

    for index in samples:
        frames: list[Frame] = []
        duration, spec = clock(lambda index=index: session.spec(index))
        traced()
        cpu: dict[str, float] = dict.fromkeys(STAGES, 0.0)
        row = {**dict.fromkeys(STAGES, 0.0), **stages(spec, frames=frames, cpu=cpu)}
        for times in (row, cpu):
            times["sum"] = sum(times[name] for name in STAGES)
        rendering, view = frames[0].rendering, frames[0].rendering.scene.view
        row["traced_M"] = traced() / 1e6
        row["kept_M"] = rendering.samples_per_pixel * view.width_px * view.height_px / 1e6
        row |= {"views": frames[0].views, "noise_p99": rendering.noise_fraction_p99, "terrain": duration}
        rows.append((row, cpu))
        show(str(index), row, cpu)
        del frames, spec, rendering, view  # they hold the terrain, beside which the next one would be made
    for title, of in (("median", np.median), ("largest", np.max)):
        both = [{name: float(of([pair[k][name] for pair in rows])) for name in rows[0][k]} for k in (0, 1)]
        show(title, *both)
    print(f"largest resident memory {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20:.2f} GiB")


def main() -> None:
    """Print the stages, and the functions if asked for."""
    parser = argparse.ArgumentParser(description="Time per stage of one sample, or of each of several.")
    parser.add_argument("scene", nargs="?", default="quickstart", help="a scene file or a packaged scene")
    parser.add_argument("--sample", type=int, default=0)
    parser.add_argument("--samples", type=int, nargs="+", metavar="I", help="a row for each of these samples")
    parser.add_argument("--size", type=int, help="pixels along either side of the frame")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--functions", type=int, default=0, metavar="N")
    options = parser.parse_args()
    size = {} if options.size is None else {"camera.width_px": options.size, "camera.height_px": options.size}
    session = pipeline.Session(config.load_scene(options.scene, size))
    if options.samples:
        compare(session, options.samples)
        return
    spec = session.spec(options.sample)
    stages(spec)
    found = medians([stages(spec) for _ in range(options.rounds)])
    for name, seconds in found.items():
        print(f"{name:<16}{seconds * 1e3:9.1f} ms")
    print(f"{'sum':<16}{sum(found.values()) * 1e3:9.1f} ms")
    if options.functions:
        profile = cProfile.Profile()
        stages(spec, profile)
        pstats.Stats(profile).sort_stats("cumtime").print_stats("vbnfault", options.functions)


if __name__ == "__main__":
    main()
