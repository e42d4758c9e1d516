"""Return memory that is no longer used to the operating system, and let threads share what they allocate from.

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

# Resident memory in bytes that a process reaches before it releases any. To take memory back from the system costs
# a tenth of a sample's time where every stage does it, so memory is released only where a step would pass this.
_MOST = 1360 << 20
_M_ARENA_MAX, _ARENAS = -8, 2  # option of `mallopt` in the GNU C library, and its value


def release_unused(coming_bytes: int = 0, *, always: bool = False) -> None:
    """Return freed memory to the operating system if the process would otherwise hold too much of it.

    No array is affected.

    Parameters
    ----------
    coming_bytes
        Memory that the next step takes in arrays of other sizes than those that were freed.
    always
        Release it also if the process holds little.
    """
    for release in (_trim, _flush):  # what drjit keeps serves the next wavefront, so it is released last
        if not always and _resident_bytes() + coming_bytes < _MOST:
            return
        release()


def share_arenas() -> None:
    """Let all threads allocate from two arenas of the GNU C library, unless the user has set their number.

    By default, it gives up to eight per core. Each keeps what its threads have freed, and trimming finds little of
    it: together they held 100 MB of a process that renders with two threads. Call this before threads start.
    """
    if "MALLOC_ARENA_MAX" not in os.environ and _malloc_trim() is not None:
        ctypes.CDLL(None).mallopt(_M_ARENA_MAX, _ARENAS)


def _flush() -> None:
    """Return to the system what drjit keeps."""
    drjit = sys.modules.get("drjit")
    if drjit is not None:
        drjit.flush_malloc_cache()
        _trim()


def _trim() -> None:
    """Return to the system what the C library keeps."""
    trim = _malloc_trim()
    if trim is not None:
        trim(0)


def _resident_bytes() -> int:
    """Return the resident memory of the process; `_MOST` if the system does not report it."""
    try:
        pages = Path("/proc/self/statm").read_text(encoding="ascii").split()[1]
        return int(pages) * os.sysconf("SC_PAGE_SIZE")
    except (OSError, ValueError, AttributeError):
        return _MOST


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
