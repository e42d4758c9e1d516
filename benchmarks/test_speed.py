"""Measure how fast a labelled sample is made, compared with the tracing bound and with Blender Cycles.

    python -m pytest benchmarks --benchmark-only -n 0
    python -m pytest benchmarks --benchmark-only -n 0 --picture pair.png     (to compare both images by eye)

The image has 1024×1024 pixels with 16 samples per pixel; 1.2 million triangles fill the frame. Every round times
the bound, the render, the truth, the later stages and the store one after the other, so that other load on the
machine affects all of them equally. The table is printed at the end. Cycles is optional: see `blender_cycles.py`.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from blender_cycles import Cycles, Unavailable, interpreter
from report import SAMPLE
from workload import Workload, clock, medians

from vbnfault.core.files.images import write_png
from vbnfault.pipeline.spec import Frame


@pytest.fixture(scope="session")
def workload(request: pytest.FixtureRequest) -> Workload:
    """Return the benchmark's sample; its terrain is built once."""
    return Workload.load(request.config.getoption("--size"), facet_m=request.config.getoption("--facet-m"))


def test_labelled_sample(
    benchmark: Any, workload: Workload, results: dict[str, float], rounds: int, tmp_path: Path
) -> None:
    """Time one labelled sample, stage by stage, and the tracing bound."""
    folder, taken = workload.empty_store(tmp_path / "store.zarr"), []

    def one_round() -> Frame:
        bound, _ = clock(workload.bound)
        seconds, frame = workload.labelled_sample(folder)
        taken.append({"bound": bound, **seconds})
        return frame

    frame = benchmark.pedantic(one_round, rounds=rounds, warmup_rounds=1)
    results |= medians(taken[1:] or taken)
    benchmark.extra_info |= results
    assert set(SAMPLE) <= set(results)
    assert (frame.rendering.truth.semantic == 1).all(), "the terrain must fill the frame"
    missing = set(workload.spec.faults) - set(frame.drawn)
    assert not missing, f"every fault must show: {missing}"
    assert folder.finished() == folder.samples


@pytest.mark.parametrize("bounces", [0, 1])
def test_cycles(
    benchmark: Any,
    workload: Workload,
    results: dict[str, float],
    rounds: int,
    bounces: int,
    request: pytest.FixtureRequest,
) -> None:
    """Time Blender's render of the same scene, and check that both images agree."""
    try:
        python = interpreter()
    except Unavailable as why:
        pytest.skip(str(why))
    scene, patch = workload.scene, workload.patch
    with Cycles(
        python,
        vertices_m=patch.vertices_L_m,
        faces=patch.faces,
        flat=patch.face_is_flat,
        position_L_m=scene.view.position_L_m,
        L_from_C=scene.view.L_from_C,
        fov_deg=workload.session.base_camera.fov_deg,
        size_px=scene.view.width_px,
        samples_per_pixel=scene.samples_per_pixel,
        sun_direction_L=scene.sun.direction_L,
        sun_angular_radius_rad=scene.sun.angular_radius_rad,
        threads=os.cpu_count() or 1,
        bounces=bounces,
    ) as blender:
        taken: list[dict[str, float]] = []
        name = "cycles_bounce" if bounces else "cycles"
        # the warm-up builds the BVH; later renders reuse it, as ours do
        benchmark.pedantic(lambda: taken.append({name: blender.render()}), rounds=rounds, warmup_rounds=1)
        theirs = blender.picture()
    results |= medians(taken[1:] or taken)
    ours = workload.grey()
    if (path := request.config.getoption("--picture")) and not bounces:
        _write_pair(path, ours, theirs)
    assert np.corrcoef(ours.ravel(), theirs.ravel())[0, 1] > 0.9


def _write_pair(path: Path, ours: np.ndarray, theirs: np.ndarray) -> None:
    """Write both images side by side as a PNG, each scaled to its 99th percentile."""
    shown = [np.clip(255 * (p / np.percentile(p, 99)) ** (1 / 2.2), 0, 255) for p in (ours, theirs)]
    path.parent.mkdir(parents=True, exist_ok=True)
    write_png(path, np.hstack(shown).astype(np.uint8))
