"""One build of a store at a time."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path

from ..errors import VbnfaultError


@contextlib.contextmanager
def locked(path: Path) -> Iterator[None]:
    """One build at a time: two would remove each other's files in work. The lock ends with the process."""
    try:
        import fcntl
    except ImportError:  # no such locks on Windows
        yield
        return
    folder = os.open(path, os.O_RDONLY)
    try:
        try:
            fcntl.flock(folder, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise VbnfaultError(f"{path}: another build is writing to it; wait until it ends") from None
        except OSError:
            pass  # a file system without locks
        yield
    finally:
        os.close(folder)
