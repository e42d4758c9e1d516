"""Run the command line, and at every moment a copy of the process that gets signals there.

    python tests/signal_moments.py 3 12 list lenses

A moment is every 12th import of a module, or a line of the functions that begin and end the program. At each moment
the process forks. The copy gets a signal there and at the two next moments, and goes on to its end. A line of the
output has the number of the signal, which changes with the moment, the exit code of the copy and its messages.
"""

from __future__ import annotations

import importlib.util
import itertools
import json
import os
import signal
import sys
import tempfile
from pathlib import Path
from types import FrameType
from typing import Any

PACKAGE = importlib.util.find_spec("vbnfault")
assert PACKAGE is not None
assert PACKAGE.origin is not None
FILES = tuple(str(Path(PACKAGE.origin).parent / name) for name in ("__main__.py", "cli/app.py"))


class Moments:
    """Count moments; `left`: how many signals this process, if it is a copy, still gets."""

    def __init__(self, signals: int, every: int) -> None:
        self.numbers = itertools.cycle([signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
        self.number, self.signals, self.every = signal.SIGINT, signals, every
        self.left, self.imports = -1, 0

    def of_import(self, event: str, args: tuple[Any, ...]) -> None:
        """Fork at an import, once the package `vbnfault.cli` is being imported."""
        if event == "import" and (self.imports or args[0] == "vbnfault.cli"):
            self.imports += 1
            if self.left >= 0 or self.imports % self.every == 1:
                self.pass_by()

    def of_line(self, frame: FrameType, event: str, _: Any) -> Any:
        """Fork at a line of `FILES`."""
        if frame.f_code.co_filename not in FILES:
            return None
        if event == "line" and self.imports:
            self.pass_by()
        return self.of_line

    def pass_by(self) -> None:
        """Fork in the first process; send the signal in a copy."""
        if self.left < 0:
            self.number = next(self.numbers)
            with tempfile.TemporaryFile() as messages:
                copy = os.fork()
                if copy:
                    _, status = os.waitpid(copy, 0)
                    messages.seek(0)
                    line = [self.number, os.waitstatus_to_exitcode(status), messages.read().decode()]
                    os.write(1, json.dumps(line).encode() + b"\n")
                    return
                os.dup2(messages.fileno(), 2)
                os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
            self.left = self.signals
        if self.left:
            self.left -= 1
            os.kill(os.getpid(), self.number)


if __name__ == "__main__":
    count, step, *arguments = sys.argv[1:]
    moments = Moments(int(count), int(step))
    from vbnfault import __main__ as program

    sys.argv = ["vbnfault", *arguments]
    sys.addaudithook(moments.of_import)
    sys.settrace(moments.of_line)
    program.main()
