"""The benchmarks still run: tiny frame, coarse terrain, one round, in this process."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))


@pytest.mark.slow
def test_benchmarks_print_every_stage_and_ratio(tmp_path: Path) -> None:
    from report import SAMPLE, table
    from workload import Workload, clock

    work = Workload.load(64, facet_m=12.0)
    folder = work.empty_store(tmp_path / "store.zarr")
    bound, _ = clock(work.bound)
    seconds, frame = work.labelled_sample(folder)
    assert set(SAMPLE) <= set(seconds)
    assert (frame.rendering.truth.semantic == 1).all()
    assert set(work.spec.faults) == set(frame.drawn)
    assert folder.finished() == folder.samples
    printed = table({"bound": bound, **seconds})
    for line in (
        "bound:",
        "render:",
        "inject_faults:",
        "take_images:",
        "store:",
        "labelled sample",
        "at least 0.7",
        "at most 0.25",
    ):
        assert line in printed
