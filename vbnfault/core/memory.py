"""Return memory that is no longer used to the operating system.

drjit and the C library keep freed memory for later use. Over the stages of a sample the kept parts add up to
several hundred MB, because each stage needs arrays of other sizes. To release them takes some milliseconds.
"""

from __future__ import annotations

import ctypes
import os
import sys
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path

# Resident memory in bytes below which nothing is released: memory that is kept makes the next stages faster.
_ENOUGH = 900 << 20


def release_unused(*, always: bool = False) -> None:
    """Return freed memory to the operating system if the process holds much; no array is affected.

    `always`: also if the process holds little.
    """
    if not always and _resident_bytes() < _ENOUGH:
        return
    drjit = sys.modules.get("drjit")
    if drjit is not None:
        drjit.flush_malloc_cache()
    trim = _malloc_trim()
    if trim is not None:
        trim(0)


def _resident_bytes() -> int:
    """Return the resident memory of the process; `_ENOUGH` if the system does not report it."""
    try:
        pages = Path("/proc/self/statm").read_text(encoding="ascii").split()[1]
        return int(pages) * os.sysconf("SC_PAGE_SIZE")
    except (OSError, ValueError, AttributeError):
        return _ENOUGH


@lru_cache(maxsize=1)
def _malloc_trim() -> Callable[[int], int] | None:
    """Return `malloc_trim` of the GNU C library; None where another library allocates."""
    if not sys.platform.startswith("linux"):
        return None
    try:
        trim: Callable[[int], int] = ctypes.CDLL(None).malloc_trim
    except AttributeError:  # musl has none
        return None
    return trim
