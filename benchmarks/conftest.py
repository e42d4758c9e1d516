"""Define the options of the benchmarks, and print the table at the end of a run."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

# as the command line sets it, before numpy is imported: a thread of OpenBLAS that waits keeps a core busy, by which
# a flare frame takes twice as long
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

RESULTS = pytest.StashKey[dict[str, float]]()


def pytest_addoption(parser: pytest.Parser) -> None:
    group = parser.getgroup("vbnfault benchmarks")
    group.addoption("--size", type=int, default=1024, help="pixels along either side of the frame")
    group.addoption("--facet-m", type=float, help="coarser terrain, for a quick look (default: the scene's)")
    group.addoption("--rounds", type=int, default=5, help="timed rounds after the warm-up")
    group.addoption("--picture", type=Path, help="write our picture and Blender's, side by side, to this PNG")


def pytest_configure(config: pytest.Config) -> None:
    config.stash[RESULTS] = {}


@pytest.fixture(scope="session")
def results(request: pytest.FixtureRequest) -> dict[str, float]:
    """Return the median durations in s by name; the tests fill them in for the table."""
    return request.config.stash[RESULTS]


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter, config: pytest.Config) -> None:
    from report import table

    seconds = config.stash[RESULTS]
    if seconds:
        terminalreporter.section(
            f"vbnfault, {config.getoption('--size')} px, medians of {config.getoption('--rounds')}"
        )
        terminalreporter.write_line(table(seconds))


@pytest.fixture
def rounds(request: pytest.FixtureRequest) -> int:
    """Return the number of timed rounds."""
    return request.config.getoption("--rounds")
