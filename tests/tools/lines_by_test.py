"""Note which lines of the package each test executes: a plugin of pytest for tests/tools/mutation.py.

`python -m pytest -n 0 -p tools.lines_by_test tests/test_plan.py` with the folder `tests` on PYTHONPATH writes
a JSON to the file named by LINES_BY_TEST: `lines`, of "path:line" the tests that execute it, and `seconds`, the
duration of each test. What runs in the set-up of a test is noted for its whole file, and what runs outside of tests
as "import".
"""

from __future__ import annotations

import json
import os
import sys
import threading
import time
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from types import FrameType
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parents[2]


class _Trace:
    """Hooks that follow the calls into the package."""

    def __init__(self, out: Path) -> None:
        self.out, self.now = out, "import"
        self.lines: dict[str, set[str]] = defaultdict(set)  # "path:line" → tests, or files for their set-up
        self.seconds: dict[str, float] = {}
        self.names: dict[str, str | None] = {}
        sys.settrace(self.enter)
        threading.settrace(self.enter)

    def enter(self, frame: FrameType, event: str, arg: object) -> Any:
        """Follow a call into the package, and no other."""
        file = frame.f_code.co_filename
        if file not in self.names:
            inside = Path(file).is_relative_to(ROOT / "vbnfault")
            self.names[file] = str(Path(file).relative_to(ROOT)) if inside else None
        name = self.names[file]
        if name is None:
            return None

        def line(frame: FrameType, event: str, arg: object) -> Any:
            if event == "line":
                self.lines[f"{name}:{frame.f_lineno}"].add(self.now)
            return line

        self.lines[f"{name}:{frame.f_lineno}"].add(self.now)
        return line

    @pytest.hookimpl(wrapper=True, tryfirst=True)
    def pytest_runtest_setup(self, item: pytest.Item) -> Iterator[None]:
        """Count the lines of a set-up for the whole file."""
        self.now = item.nodeid.split("::")[0]
        sys.settrace(self.enter)
        self.seconds[item.nodeid] = -time.monotonic()
        return (yield)

    @pytest.hookimpl(wrapper=True, tryfirst=True)
    def pytest_runtest_call(self, item: pytest.Item) -> Iterator[None]:
        """Count the lines of a test for that test."""
        self.now = item.nodeid
        sys.settrace(self.enter)
        return (yield)

    def pytest_runtest_teardown(self, item: pytest.Item) -> None:
        """Note the test's duration."""
        self.seconds[item.nodeid] += time.monotonic()

    def pytest_sessionfinish(self) -> None:
        """Write what was noted."""
        sys.settrace(None)
        found = {"lines": {k: sorted(v) for k, v in self.lines.items()}, "seconds": self.seconds}
        self.out.write_text(json.dumps(found), encoding="utf-8")


def pytest_configure(config: pytest.Config) -> None:
    """Begin with the imports, before any test is collected."""
    config.pluginmanager.register(_Trace(Path(os.environ["LINES_BY_TEST"])))
