"""Signals that end a program: the first one stops the work, what was made is still written.

Ctrl-C (SIGINT), SIGTERM and SIGHUP are raised as `Stopped` in the main thread, wherever it is. While the work is
wound up (`finishing`) another one only makes haste: it never cuts that short.
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
# Those that a terminal sends to every process of a command: of a build, its first process decides for all.
_OF_THE_TERMINAL = tuple(number for number in _SIGNALS if number != signal.SIGTERM)

_winding_up: list[finishing] = []
# Signals that were raised and have not ended the program yet: code in C may put another exception in their place.
_raised: list[int] = []


class Stopped(BaseException):
    """A signal asked the program to end. `number`: of the signal.

    No KeyboardInterrupt: typer would end the program in silence on one.
    """

    def __init__(self, number: int = signal.SIGINT) -> None:
        super().__init__(number)
        self.number = number


def exit_code(stop: BaseException) -> int:
    """Return the exit code of a program that a signal ended, 128 + its number; 130 for any other interrupt."""
    return 128 + (stop.number if isinstance(stop, Stopped) else signal.SIGINT)


def raise_stopped(number: int, _frame: Any = None) -> None:
    """Handle a signal: raise `Stopped`, or make haste where the work is being wound up already."""
    if not _winding_up:
        _raised.append(number)
        raise Stopped(number)
    for block in _winding_up:
        block.arrived(number)


def check() -> None:
    """Raise `Stopped` again where a signal was raised before.

    To be called between steps of long work, and where any other exception is handled: it may be one that code in C
    made of `Stopped`.
    """
    if _raised and threading.current_thread() is threading.main_thread():
        raise Stopped(_raised[-1])


@contextlib.contextmanager
def interruptible() -> Iterator[None]:
    """Raise `Stopped` on a signal for the length of a block, where this is the main thread.

    A signal that is ignored, as SIGHUP is under `nohup`, stays ignored. One that arrives where Python drops every
    exception, such as in a destructor, is raised at the next `check`.
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
    """Wind up without being interrupted: a signal that arrives within the block is raised at its end.

    Where the block belongs to the handling of an interrupt, it is not: the program ends anyway. `hasten` is called
    at every signal that arrives. Only the main thread receives any, so elsewhere this does nothing.
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
        """Note a signal, and make haste."""
        self._arrived = number
        self._hasten()

    def __exit__(self, *_: object) -> None:
        if self._here:
            _winding_up.remove(self)
        if self._arrived is not None and not self._stopping:
            raise_stopped(self._arrived)


@contextlib.contextmanager
def held() -> Iterator[None]:
    """Hold all signals back for the length of a block; a process that is started within holds them back too."""
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
    """In a process that was started while signals were `held`: leave those of the terminal to the parent, and let
    SIGTERM, which the parent sends, raise `Stopped`."""
    ignore()
    signal.signal(signal.SIGTERM, raise_stopped)
    if hasattr(signal, "pthread_sigmask"):
        signal.pthread_sigmask(signal.SIG_UNBLOCK, _SIGNALS)
