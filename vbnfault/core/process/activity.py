"""Report which stage a process works on between two samples, such as the terrain of a site.

Code that may take seconds names its stage with `begin`; a caller receives these names through `reported_to`.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from contextvars import ContextVar

_listener: ContextVar[Callable[[str], None] | None] = ContextVar("listener", default=None)


def begin(stage: str) -> None:
    """Report to the listener of this context, if it has one, that a stage of some seconds begins."""
    listener = _listener.get()
    if listener is not None:
        listener(stage)


@contextlib.contextmanager
def reported_to(listener: Callable[[str], None]) -> Iterator[None]:
    """Call `listener` with the name of every stage that begins within a block."""
    token = _listener.set(listener)
    try:
        yield
    finally:
        _listener.reset(token)
