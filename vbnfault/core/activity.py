"""What a process is doing between two samples: named stages, such as the terrain of a site."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from contextvars import ContextVar

_listener: ContextVar[Callable[[str], None] | None] = ContextVar("listener", default=None)


def begin(stage: str) -> None:
    """Tell whoever listens in this context that a stage begins that may take seconds."""
    listener = _listener.get()
    if listener is not None:
        listener(stage)


@contextlib.contextmanager
def told_to(listener: Callable[[str], None]) -> Iterator[None]:
    """Let `listener` hear of the stages that begin within."""
    token = _listener.set(listener)
    try:
        yield
    finally:
        _listener.reset(token)
