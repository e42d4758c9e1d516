"""The benchmarks still run: tiny frame, coarse terrain, one round."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


@pytest.mark.slow
def test_benchmarks_print_every_stage_and_ratio(tmp_path: Path) -> None:
    options = [
        "--size",
        "96",
        "--facet-m",
        "6",
        "--rounds",
        "1",
        "--deselect",
        "benchmarks/test_speed.py::test_cycles[0]",
        "--deselect",
        "benchmarks/test_speed.py::test_cycles[1]",
    ]
    done = subprocess.run(
        [
            sys.executable,
            "-m",
            "pytest",
            "benchmarks",
            "--benchmark-only",
            "-n",
            "0",
            "-p",
            "no:cacheprovider",
            *options,
        ],
        cwd=ROOT,
        # benchmarks refuse to run in what looks like one of several processes of tests
        env={k: v for k, v in os.environ.items() if not k.startswith("PYTEST_")},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
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
        assert line in done.stdout
