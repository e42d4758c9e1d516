"""Handle the signals that end a program: the first one stops the work, and finished results are still written.

Within `listening`, Ctrl-C (SIGINT), SIGTERM and SIGHUP are recorded. Within `interruptible`, they also raise
`Stopped` in the main thread. A recorded signal is not forgotten: whatever exception leaves the block, it counts as
`Stopped`. Within `finishing`, a signal only speeds up the final steps; it never interrupts them.
"""

from __future__ import annotations

import contextlib
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from types import FrameType
from typing import Any

from ..errors import VbnfaultError

_SIGNALS: tuple[int, ...] = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
# A terminal sends these to every process of a command; the first process of a build acts on them for all.
_OF_THE_TERMINAL: tuple[int, ...] = (signal.SIGINT, signal.SIGHUP)

_winding_up: list[finishing] = []
# What reports an exception that Python drops, while a `listening` block runs.
_reporters: list[Callable[[sys.UnraisableHookArgs], Any]] = []
# The signals since the outermost `listening` block began: C code may replace `Stopped` by another exception.
_recorded: list[int] = []
# The frames of the functions with an `interruptible` block. A signal is raised only in these functions and in those
# that they call; so a caller reports the outcome without interruption, however many signals arrive.
_interruptible: list[FrameType] = []


class Stopped(BaseException):
    """Report that a signal asked the program to end; `number` is the signal's number.

    This is not a KeyboardInterrupt, because typer ends the program without a message on that one.
    """

    def __init__(self, number: int = signal.SIGINT) -> None:
        super().__init__(number)
        self.number = number


class Interrupted(VbnfaultError):
    """Report that the user or the system stopped some work, which the same command or call resumes.

    `exit_code`: 128 + the signal's number.
    """

    def __init__(self, sentence: str, exit_code: int = 130) -> None:
        super().__init__(sentence)
        self.exit_code = exit_code


def exit_code(stop: BaseException) -> int:
    """Return the exit code of an interrupted program: 128 + the signal's number, or 130 for any other interrupt."""
    return 128 + (stop.number if isinstance(stop, Stopped) else signal.SIGINT)


def raise_stopped(number: int, frame: FrameType | None) -> None:
    """Handle a signal that arrives in the function `frame`: raise `Stopped` within `interruptible`.

    Where `finishing` blocks are running, they get the number instead.
    """
    if _winding_up:
        for block in _winding_up:
            block.arrived(number)
        return
    _recorded.append(number)
    while frame is not None:
        if frame in _interruptible:
            raise Stopped(number)
        frame = frame.f_back


def check() -> None:
    """Raise `Stopped` again where a signal was recorded before.

    Call this between the steps of long work, and where any other exception is handled: C code may have replaced
    `Stopped` by that exception.
    """
    if _recorded and threading.current_thread() is threading.main_thread():
        raise Stopped(_recorded[-1])


@contextlib.contextmanager
def listening() -> Iterator[None]:
    """Record the signals that arrive within a block, if this is the main thread and no such block runs already.

    An ignored signal, such as SIGHUP under `nohup`, stays ignored. Python drops every exception of a destructor;
    a signal that arrives there is raised at the next `check`.
    """
    if _reporters or threading.current_thread() is not threading.main_thread():
        yield
        return
    _reporters.append(sys.unraisablehook)
    sys.unraisablehook = _report
    before: dict[int, Any] = {}
    for number in _SIGNALS:
        if signal.getsignal(number) not in (signal.SIG_IGN, None, raise_stopped):
            before[number] = signal.signal(number, raise_stopped)
    try:
        yield
    finally:
        for number, handler in before.items():
            if signal.getsignal(number) is raise_stopped:
                signal.signal(number, handler)
        sys.unraisablehook = _reporters.pop()
        _recorded.clear()


def _report(dropped: sys.UnraisableHookArgs) -> None:
    """Report an exception that Python drops, unless it is `Stopped`."""
    if not isinstance(dropped.exc_value, Stopped):
        _reporters[-1](dropped)


@contextlib.contextmanager
def interruptible(sentence: Callable[[], str] | None = None) -> Iterator[None]:
    """Raise `Stopped` when a signal arrives within a block, if this is the main thread.

    The block ends in `Stopped` also where other code has replaced or dropped that exception. With a `sentence`, it
    ends in `Interrupted` with this message.
    """
    with listening():
        _interruptible.append(here := sys._getframe(2))  # beyond this function and `contextlib`
        try:
            yield
            check()
        except BaseException as error:
            stop = _stop_behind(error)
            if stop is None:
                raise
            if sentence is None:
                raise stop from (None if stop is error else error)
            with finishing():
                message = sentence()
            raise Interrupted(message, exit_code(stop)) from error
        finally:
            _interruptible.remove(here)


def _stop_behind(error: BaseException) -> Stopped | None:
    """Return the interrupt that an exception stands for; None if it stands for none, or is `Interrupted`."""
    if isinstance(error, Stopped | Interrupted):
        return error if isinstance(error, Stopped) else None
    if isinstance(error, KeyboardInterrupt):
        return Stopped()
    in_main = threading.current_thread() is threading.main_thread()
    return Stopped(_recorded[-1]) if _recorded and in_main else None


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
        self._stopping = bool(_recorded) or isinstance(sys.exc_info()[1], Stopped | KeyboardInterrupt)

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
            raise_stopped(self._arrived, sys._getframe())


@contextlib.contextmanager
def held() -> Iterator[None]:
    """Hold all signals back within a block. A process that is started within it holds them back too."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, _SIGNALS)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def ignore(*, sigterm: bool = False) -> None:
    """Ignore the signals of a terminal, such as a second Ctrl-C while the program ends, and on request SIGTERM."""
    for number in _SIGNALS if sigterm else _OF_THE_TERMINAL:
        signal.signal(number, signal.SIG_IGN)


def obey_parent() -> None:
    """Set up the signals of a process that was started within `held`.

    The parent acts on the terminal's signals, so this process ignores them. SIGTERM, which the parent sends,
    raises `Stopped` in the next `interruptible` block.
    """
    ignore()
    signal.signal(signal.SIGTERM, raise_stopped)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, _SIGNALS)
