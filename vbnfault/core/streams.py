"""Standard input, output and error as a command may rely on them: open, and harmless where nobody reads them.

The reader of standard output may leave (`vbnfault list faults | head -1`): that ends a command as SIGPIPE ends
other Unix tools, without a word. The reader of standard error may leave as well: messages are then dropped, and the
work goes on, since what is made matters more than what is said about it.
"""

from __future__ import annotations

import contextlib
import io
import os
import signal
import sys
from collections.abc import Iterator
from typing import Any, TextIO, cast

from .interrupts import Stopped

_SIGPIPE = int(getattr(signal, "SIGPIPE", 13))  # Windows has none


@contextlib.contextmanager
def steady() -> Iterator[None]:
    """Make the standard streams fit to be used within a block.

    A closed one leads to the null device: else the next file that is opened would get its number, and whatever a
    library prints would be written into that file. Bytes that are no text are escaped. A standard output that
    nobody reads raises `Stopped`, one that is full an OSError that names it; standard error raises nothing.
    """
    for number in range(3):
        with contextlib.suppress(OSError):
            _open_if_closed(number)
    with contextlib.ExitStack() as stack:
        out = sys.stdout or stack.enter_context(open(os.devnull, "w"))
        error = sys.stderr or stack.enter_context(open(os.devnull, "w"))
        for stream in (out, error):
            if isinstance(stream, io.TextIOWrapper):  # a file's name may have bytes that are no text
                stream.reconfigure(errors="backslashreplace")
        stack.enter_context(contextlib.redirect_stdout(cast(TextIO, _Output(out))))
        stack.enter_context(contextlib.redirect_stderr(cast(TextIO, _Messages(error))))
        yield


def is_unread(stop: BaseException) -> bool:
    """Return whether a program ends because whoever read its standard output left."""
    return isinstance(stop, Stopped) and stop.number == _SIGPIPE


def _open_if_closed(number: int) -> None:
    try:
        os.fstat(number)
    except OSError:
        null = os.open(os.devnull, os.O_RDWR)  # the lowest free number: this one, if those below are open
        if null != number:
            os.dup2(null, number)
            os.close(null)


class _Stream:
    """A text stream that meets its write errors with `_failed`, and leads to the null device from then on."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream

    def write(self, text: str) -> int:
        """Write text. Returns the number of its characters."""
        try:
            if text == "":  # click tries what a stream takes, and hides the error of a full disk
                return 0
            return self._stream.write(text)
        except OSError as error:
            self._give_up()
            self._failed(error)
            return len(text)

    def flush(self) -> None:
        """Write what is still held back."""
        try:
            self._stream.flush()
        except OSError as error:
            self._give_up()
            self._failed(error)

    def _give_up(self) -> None:
        """Send the rest nowhere, also what libraries and other processes write: else Python complains at exit."""
        with contextlib.suppress(OSError, ValueError):
            null = os.open(os.devnull, os.O_WRONLY)
            os.dup2(null, self._stream.fileno())
            os.close(null)

    def _failed(self, error: OSError) -> None:
        raise NotImplementedError

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


class _Output(_Stream):
    def _failed(self, error: OSError) -> None:
        if isinstance(error, BrokenPipeError):
            raise Stopped(_SIGPIPE) from error
        raise OSError(error.errno, error.strerror, "standard output") from error


class _Messages(_Stream):
    def _failed(self, error: OSError) -> None:
        """Go on: a message that nobody reads is no reason to end the work."""
