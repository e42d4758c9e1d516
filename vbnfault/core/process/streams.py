"""Make standard input, output and error safe for a command: open, and harmless when their reader has left.

When the reader of standard output leaves (`vbnfault list faults | head -1`), the command ends without a message, as
SIGPIPE ends other Unix tools. When the reader of standard error leaves, messages are dropped and the work goes on,
because the results matter more than the messages.
"""

from __future__ import annotations

import contextlib
import io
import logging
import os
import signal
import sys
import warnings
from collections.abc import Callable, Iterator
from typing import Any, TextIO, cast

from .interrupts import Stopped


@contextlib.contextmanager
def steady() -> Iterator[None]:
    """Make the standard streams safe to use within a block.

    A closed stream is connected to the null device. Otherwise the next opened file would get its number, and the
    text that a library prints would be written into that file. Bytes that are no text are escaped. Standard output
    raises `Stopped` when nobody reads it, and an OSError that names it when its disk is full. Standard error raises
    nothing.
    """
    for number in range(3):
        with contextlib.suppress(OSError):
            _open_if_closed(number)
    with contextlib.ExitStack() as stack:
        out = sys.stdout or stack.enter_context(open(os.devnull, "w"))
        error = sys.stderr or stack.enter_context(open(os.devnull, "w"))
        for stream in (out, error):
            if isinstance(stream, io.TextIOWrapper):  # a file name may hold bytes that are no text
                stream.reconfigure(errors="backslashreplace")
        stack.enter_context(contextlib.redirect_stdout(cast(TextIO, _Stream(out, _output_failed))))
        # a lost message does not end the work
        stack.enter_context(contextlib.redirect_stderr(cast(TextIO, _Stream(error, lambda _: None))))
        yield


def warn_in_sentences() -> None:
    """Have this process print warnings as sentences on standard error, without the line of code that warns.

    The library logs to `vbnfault`; other libraries use `warnings`.
    """
    logger = logging.getLogger("vbnfault")
    logger.handlers[:] = [_Sentences()]
    logger.setLevel(logging.INFO)
    warnings.showwarning = lambda message, *_, **__: print(f"warning: {message}", file=sys.stderr, flush=True)


class _Sentences(logging.Handler):
    """Print each record of a logger once, as a warning or as a note."""

    def __init__(self) -> None:
        super().__init__()
        self._said: set[str] = set()

    def emit(self, record: logging.LogRecord) -> None:
        text = f"{'warning' if record.levelno >= logging.WARNING else 'note'}: {record.getMessage()}"
        if text not in self._said:
            self._said.add(text)
            print(text, file=sys.stderr, flush=True)


def is_unread(stop: BaseException) -> bool:
    """Return whether a program ends because the reader of its standard output left."""
    return isinstance(stop, Stopped) and stop.number == signal.SIGPIPE


def _open_if_closed(number: int) -> None:
    """Connect a file descriptor to the null device if it is closed."""
    try:
        os.fstat(number)
    except OSError:
        null = os.open(os.devnull, os.O_RDWR)  # gets the lowest free number, which may be another
        if null != number:
            os.dup2(null, number)
            os.close(null)


class _Stream:
    """Wrap a text stream: at a write error, send all later text to the null device and call `failed`."""

    def __init__(self, stream: TextIO, failed: Callable[[OSError], None]) -> None:
        self._stream, self._failed = stream, failed

    def write(self, text: str) -> int:
        """Write text. Return the number of its characters."""
        if text != "":  # click writes this as a test and would hide the error of a full disk
            self._try(self._stream.write, text)
        return len(text)

    def flush(self) -> None:
        """Write the buffered text."""
        self._try(self._stream.flush)

    def _try(self, write: Callable[..., object], *text: str) -> None:
        """Write; where that fails, let later text, also that of libraries, go nowhere, or Python fails at exit."""
        try:
            write(*text)
        except OSError as error:
            with contextlib.suppress(OSError, ValueError):
                null = os.open(os.devnull, os.O_WRONLY)
                os.dup2(null, self._stream.fileno())
                os.close(null)
            self._failed(error)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


def _output_failed(error: OSError) -> None:
    """Raise `Stopped` where the reader of standard output left, else the error with the stream's name."""
    if isinstance(error, BrokenPipeError):
        raise Stopped(signal.SIGPIPE) from error
    raise OSError(error.errno, error.strerror, "standard output") from error
