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

from workload import clock, medians

from vbnfault import pipeline
from vbnfault.pipeline.expose import render_frame
from vbnfault.pipeline.record import to_sample
from vbnfault.pipeline.resolve import resolve
from vbnfault.pipeline.spec import Frame, SampleSpec
from vbnfault.scene import config


def stages(spec: SampleSpec, profile: cProfile.Profile | None = None) -> dict[str, float]:
    """Return the duration in s of each stage of one sample; `profile` records the stages after the render."""
    frame, seconds = Frame(spec=spec), {}
    for stage in pipeline.STAGES:
        after = profile is not None and stage not in (resolve, render_frame)
        if after:
            profile.enable()
        seconds[stage.__name__], _ = clock(lambda stage=stage: stage(frame))
        if after:
            profile.disable()
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
