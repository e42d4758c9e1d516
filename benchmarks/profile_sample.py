"""Measure how long each stage of one sample takes.

    python benchmarks/profile_sample.py [SCENE] [--sample I] [--rounds N]

Prints the median duration of each stage in ms, after one warm-up. With --functions N it also prints the N functions
of vbnfault that take longest in the stages after the render. The time of a thread counts for the function that
waits for it.
"""

from __future__ import annotations

import argparse
import cProfile
import pstats
from collections import defaultdict
from collections.abc import Callable
from typing import ParamSpec, TypeVar

from workload import clock, medians

from vbnfault import pipeline
from vbnfault.pipeline.record import to_sample
from vbnfault.pipeline.rendering import render_view
from vbnfault.pipeline.resolve import resolve
from vbnfault.pipeline.spec import SampleSpec
from vbnfault.scene import config

P = ParamSpec("P")
T = TypeVar("T")


def stages(spec: SampleSpec, profile: cProfile.Profile | None = None) -> dict[str, float]:
    """Return the duration in s of each stage of one sample; `profile` records the stages after the render."""
    seconds: dict[str, float] = defaultdict(float)  # a stage runs once for every view of the sample

    def timed(stage: Callable[P, T], /, *inputs: P.args, **options: P.kwargs) -> T:
        after = profile is not None and stage not in (resolve, render_view)
        if after:
            profile.enable()
        duration, output = clock(lambda: stage(*inputs, **options))
        if after:
            profile.disable()
        seconds[stage.__name__] += duration
        return output

    frame = pipeline.simulate_frame(spec, timed)
    seconds["to_sample"], _ = clock(lambda: to_sample(frame))
    return seconds


def main() -> None:
    """Print the stages, and the functions if asked for."""
    parser = argparse.ArgumentParser(description="Time per stage of one sample.")
    parser.add_argument("scene", nargs="?", default="quickstart", help="a scene file or a packaged scene")
    parser.add_argument("--sample", type=int, default=0)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--functions", type=int, default=0, metavar="N")
    options = parser.parse_args()
    spec = pipeline.Session(config.load_scene(options.scene)).spec(options.sample)
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
