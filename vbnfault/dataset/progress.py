"""Show the progress of a build or a study: a bar on a terminal, plain lines elsewhere."""

from __future__ import annotations

import sys
import time
from typing import Any

_SECONDS_BETWEEN_LINES = 5.0


def size_text(count: float) -> str:
    """Return a number of bytes as text with a decimal unit: `1.23 GB`."""
    for unit in ("B", "kB", "MB", "GB"):
        if count < 1000:
            return f"{count:.3g} {unit}"
        count /= 1000
    return f"{count:.3g} TB"


def duration_text(seconds: float) -> str:
    """Return a duration as text in seconds, minutes or hours."""
    minutes, hours = seconds / 60, seconds / 3600
    return f"{seconds:.0f} s" if seconds < 100 else f"{minutes:.0f} min" if minutes < 100 else f"{hours:.1f} h"


class Progress:
    """Show items done, rate, time left and the current stage, on standard error; `noun`: what the items are."""

    def __init__(self, total: int, *, shown: bool, noun: str = "samples") -> None:
        self._total, self._shown, self._noun = total, shown, noun
        self._done = self._built = 0
        self._began = self._last_line = time.monotonic()
        self._bar: Any = None
        self._task: Any = None

    def __enter__(self) -> Progress:
        if self._shown and sys.stderr.isatty():
            from rich.console import Console
            from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn

            columns = (
                BarColumn(bar_width=None),
                MofNCompleteColumn(),
                TextColumn(f"{self._noun}, {{task.description}}"),
            )
            self._bar = Progress(*columns, console=Console(stderr=True))
            self._task = self._bar.add_task("checking", total=self._total)
            self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._bar is not None:
            self._bar.stop()
        elif self._shown and self._built:
            print(self._line(), file=sys.stderr, flush=True)

    def _pace(self) -> str:
        """Return rate and time left as text; `checking` until an item has been built."""
        seconds = time.monotonic() - self._began
        if not self._built or seconds <= 0:
            return "checking"
        rate = self._built / seconds
        unit = f"{rate:.2f} {self._noun}/s" if rate >= 0.1 else f"{1 / rate:.0f} s/{self._noun.removesuffix('s')}"
        return f"{unit}, {duration_text((self._total - self._done) / rate)} left"

    def _line(self) -> str:
        """Return the progress as one line."""
        return f"{self._done}/{self._total} {self._noun}, {self._pace()}"

    def advance(self, built: bool) -> None:
        """Count one more item as done; `built`: it was made now, not kept."""
        self._done += 1
        self._built += built
        if self._bar is not None:
            self._bar.update(self._task, advance=1, description=self._pace())
        elif self._shown and time.monotonic() - self._last_line > _SECONDS_BETWEEN_LINES:
            self._last_line = time.monotonic()
            print(self._line(), file=sys.stderr, flush=True)

    def stage(self, text: str) -> None:
        """Show a stage that may take seconds: beside the bar until the next item is done, or as a line."""
        if self._bar is not None:
            self._bar.update(self._task, description=f"{self._pace()}; {text}")
        else:
            self.say(text)

    def say(self, text: str) -> None:
        """Print a line; a bar stays intact."""
        if self._bar is not None:
            self._bar.console.print(text, highlight=False, markup=False)
        elif self._shown:
            print(text, file=sys.stderr, flush=True)
