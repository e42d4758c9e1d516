"""Measure what a coma costs beside the render of the same view.

    python benchmarks/coma_timing.py [SCENE ...] [--samples N] [--rounds N] [--jets N]

Prints for each scene the least duration and CPU time in ms, over the rounds, of the stage `render_view` without a
coma and of the coma alone, and the coma over the render. Each is the median over the samples. The coma also needs a
map of the truth on the grid of the render, where a lens distorts and the scene has neither bounces nor stars.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from vbnfault import pipeline
from vbnfault.pipeline.coma import add_coma
from vbnfault.pipeline.rendering import render_view
from vbnfault.pipeline.resolve import resolve
from vbnfault.scene import config

COMA = {"afrho_cm": 1000.0}


def least(action: Callable[[], Any], rounds: int) -> tuple[float, float, Any]:
    """Return the least duration and the least CPU time of a call in s, each over all rounds, and its result."""
    from vbnfault.render.runtime import dr

    durations, busy, result = [], [], None
    for _ in range(rounds):
        dr.sync_thread()
        start, cpu = time.perf_counter(), time.process_time()
        result = action()
        dr.sync_thread()
        durations.append(time.perf_counter() - start)
        busy.append(time.process_time() - cpu)
    return min(durations), min(busy), result


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description="Cost of a coma beside the render.")
    parser.add_argument("scenes", nargs="*", default=["paper67p", "navcam67p", "physical67p"])
    parser.add_argument("--samples", type=int, default=2)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--jets", type=int, default=8)
    options = parser.parse_args()
    print(f"{'scene':<16}{'render ms':>10}{'coma ms':>9}{'ratio':>7}{'render CPU':>12}{'coma CPU':>10}{'ratio':>7}")
    for name in options.scenes:
        scene = config.load_scene(name, {"coma": {**COMA, "random_jets": options.jets}})
        session = pipeline.Session(scene)
        figures = []
        for index in range(options.samples):
            spec = session.spec(index)
            pose = resolve(spec)
            bare = pipeline.spec.SampleSpec(**{**vars(spec), "scene": scene.model_copy(update={"coma": None})})
            render_s, render_cpu_s, rendering = least(lambda b=bare, p=pose: render_view(b, p), options.rounds)
            from vbnfault import render

            view, sun = rendering.scene.view, rendering.scene.sun
            truth = render.truth(spec.terrain.surface, view, sun)
            inputs = (spec, pose, rendering.scene, truth, rendering.light.rendered)
            coma_s, coma_cpu_s, _ = least(lambda i=inputs: add_coma(*i), options.rounds)
            figures.append((render_s, coma_s, render_cpu_s, coma_cpu_s))
        render_s, coma_s, render_cpu_s, coma_cpu_s = np.median(figures, axis=0)
        print(
            f"{name:<16}{1e3 * render_s:>10.0f}{1e3 * coma_s:>9.0f}{coma_s / render_s:>7.3f}"
            f"{1e3 * render_cpu_s:>12.0f}{1e3 * coma_cpu_s:>10.0f}{coma_cpu_s / render_cpu_s:>7.3f}"
        )


if __name__ == "__main__":
    main()
