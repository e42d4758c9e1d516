"""Handle the signals that end a program: the first one stops the work, and finished results are still written.

Within `interruptible`, Ctrl-C (SIGINT), SIGTERM and SIGHUP raise `Stopped` in the main thread. Within `finishing`,
a signal only speeds up the final steps; it never interrupts them.
"""

from __future__ import annotations

import contextlib
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from typing import Any

# Windows has no SIGHUP.
_SIGNALS = tuple(getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name))
# A terminal sends these to every process of a command; the first process of a build acts on them for all.
_OF_THE_TERMINAL = tuple(number for number in _SIGNALS if number != signal.SIGTERM)

_winding_up: list[finishing] = []
# Signals that were raised and have not ended the program yet: C code may replace `Stopped` by another exception.
_raised: list[int] = []


class Stopped(BaseException):
    """Report that a signal asked the program to end; `number` is the signal's number.

    This is not a KeyboardInterrupt, because typer ends the program without a message on that one.
    """

    def __init__(self, number: int = signal.SIGINT) -> None:
        super().__init__(number)
        self.number = number


def exit_code(stop: BaseException) -> int:
    """Return the exit code of an interrupted program: 128 + the signal's number, or 130 for any other interrupt."""
    return 128 + (stop.number if isinstance(stop, Stopped) else signal.SIGINT)


def raise_stopped(number: int, _frame: Any = None) -> None:
    """Handle a signal: raise `Stopped`, or pass the number to the `finishing` blocks that are running."""
    if not _winding_up:
        _raised.append(number)
        raise Stopped(number)
    for block in _winding_up:
        block.arrived(number)


def check() -> None:
    """Raise `Stopped` again where a signal was raised before.

    Call this between the steps of long work, and where any other exception is handled: C code may have replaced
    `Stopped` by that exception.
    """
    if _raised and threading.current_thread() is threading.main_thread():
        raise Stopped(_raised[-1])


@contextlib.contextmanager
def interruptible() -> Iterator[None]:
    """Raise `Stopped` when a signal arrives within a block, if this is the main thread.

    An ignored signal, such as SIGHUP under `nohup`, stays ignored. Python drops every exception of a destructor;
    a signal that arrives there is raised at the next `check`.
    """
    before: dict[int, Any] = {}
    unraisable, raised = sys.unraisablehook, _raised.copy()

    def report(dropped: sys.UnraisableHookArgs) -> None:
        if not isinstance(dropped.exc_value, Stopped):
            unraisable(dropped)

    sys.unraisablehook = report
    if threading.current_thread() is threading.main_thread():
        for number in _SIGNALS:
            if signal.getsignal(number) not in (signal.SIG_IGN, None, raise_stopped):
                before[number] = signal.signal(number, raise_stopped)
    try:
        yield
    finally:
        sys.unraisablehook = unraisable
        _raised[:] = raised
        for number, handler in before.items():
            signal.signal(number, handler)


class finishing:
    """Finish work without interruption: a signal that arrives within the block is raised at its end.

    Where the block runs while an interrupt is handled, the signal is not raised, because the program ends anyway.
    Every signal that arrives calls `hasten`. Only the main thread receives signals, so in other threads this class
    does nothing.
    """

    def __init__(self, hasten: Callable[[], None] = lambda: None) -> None:
        self._hasten = hasten
        self._arrived: int | None = None
        self._here = threading.current_thread() is threading.main_thread()
        self._stopping = isinstance(sys.exc_info()[1], Stopped | KeyboardInterrupt)

    def __enter__(self) -> None:
        if self._here:
            _winding_up.append(self)

    def arrived(self, number: int) -> None:
        """Record a signal and call `hasten`."""
        self._arrived = number
        self._hasten()

    def __exit__(self, *_: object) -> None:
        if self._here:
            _winding_up.remove(self)
        if self._arrived is not None and not self._stopping:
            raise_stopped(self._arrived)


@contextlib.contextmanager
def held() -> Iterator[None]:
    """Hold all signals back within a block. A process that is started within it holds them back too."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, _SIGNALS)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def ignore() -> None:
    """Ignore the signals of a terminal from now on, such as a second Ctrl-C while the program ends."""
    for number in _OF_THE_TERMINAL:
        signal.signal(number, signal.SIG_IGN)


def obey_parent() -> None:
    """Set up the signals of a process that was started within `held`.

    The parent acts on the terminal's signals, so this process ignores them. SIGTERM, which the parent sends,
    raises `Stopped`.
    """
    ignore()
    signal.signal(signal.SIGTERM, raise_stopped)
    if hasattr(signal, "pthread_sigmask"):
        signal.pthread_sigmask(signal.SIG_UNBLOCK, _SIGNALS)
