"""Read environment variables, and choose the import path of processes that this one starts."""

from __future__ import annotations

import ctypes
import math
import os
import sys
from pathlib import Path

from ..errors import InputError, shown
from ..files.resources import PACKAGE

# The most threads or processes that an environment variable or option may ask for: more than any machine has.
MOST_THREADS = 1024
MOST_SAMPLES = 10_000_000  # of a dataset
# Options of `mallopt` in the GNU C library, and values: M_ARENA_MAX, M_MMAP_THRESHOLD and M_TRIM_THRESHOLD (bytes).
_MALLOPT = (-8, 2), (-3, 32 << 20), (-1, 512 << 20)


def whole_number(name: str, high: int) -> int:
    """Return the whole number in an environment variable, 0 where it is unset or empty.

    Raises InputError unless it is a whole number from 0 to `high`.
    """
    text = os.environ.get(name, "").strip() or "0"
    if not (text.isascii() and text.isdigit() and len(text) < 20 and int(text) <= high):
        raise InputError(f"{name} = {shown(text)}: must be a whole number from 0 to {high}")
    return int(text)


def usable_cores() -> int:
    """Return how many processor cores this process may use, at least 1.

    On a machine that a batch system divides, this is less than the machine has: the affinity of the process, and
    the quota of processor time of its control groups (`cpu.max`, Linux), rounded up.
    """
    affinity = getattr(os, "sched_getaffinity", None)
    cores = len(affinity(0)) if affinity else os.cpu_count() or 1
    return max(1, math.ceil(min(cores, _quota_of_cores())))


def _quota_of_cores(root: Path = Path("/sys/fs/cgroup"), of_process: Path = Path("/proc/self/cgroup")) -> float:
    """Return the least quota, in cores, of the control groups (version 2) of this process; infinite without one."""
    least = math.inf
    try:
        lines = of_process.read_text(encoding="utf-8").splitlines()
        name = next(line.removeprefix("0::/") for line in lines if line.startswith("0::/"))
        groups = [root / name, *(root / name).parents]
    except (OSError, StopIteration):
        return least
    for group in groups:
        try:
            quota, period = (group / "cpu.max").read_text(encoding="ascii").split()
            least = min(least, int(quota) / int(period))
        except (OSError, ValueError, ZeroDivisionError):  # none here, or "max"
            continue
    return least


def import_path() -> list[str]:
    """Return the import path for a process that this one starts: this one's path without the working folder.

    Under `python -m` and at the prompt, Python puts the working folder first, so that it would run a file
    `random.py` among a user's data. The working folder stays in the path where PYTHONPATH names it, or where it
    follows the standard library, as an editable installation from this folder has it. Where it holds vbnfault
    itself, it moves to the end.
    """
    here, package = os.path.realpath(os.getcwd()), os.path.realpath(PACKAGE.parent)
    wanted = {os.path.realpath(p) for p in os.environ.get("PYTHONPATH", "").split(os.pathsep) if p}
    library, after_library, path = os.path.realpath(os.path.dirname(os.__file__)), False, []
    for entry in (p for p in sys.path if isinstance(p, str)):
        where = os.path.realpath(entry or here)
        after_library |= where == library
        if where != here or here in wanted or after_library:
            path.append(entry)
    return [*path, package] if here == package and here not in wanted else path


def share_arenas() -> None:
    """Let all threads allocate from two arenas of the GNU C library, unless the user has set their number.

    By default, it gives up to eight per core, each of which keeps what its threads have freed: together they held
    100 MB of a process that renders with two threads. Arrays of up to 32 MB take memory that others have left:
    fresh memory costs `inject_faults` a third of its time for a megapixel. Call this before threads start.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None) if sys.platform.startswith("linux") else None
    if mallopt is not None and "MALLOC_ARENA_MAX" not in os.environ:
        for option, value in _MALLOPT:
            mallopt(option, value)


def release_unused() -> None:
    """Return to the system what drjit and the C library keep of freed memory, which takes some milliseconds.

    After each shard of a build, this leaves a fifth less of the process's memory resident. Within a sample it saves
    nothing: the next stage takes as much.
    """
    if "drjit" in sys.modules:
        sys.modules["drjit"].flush_malloc_cache()
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None) if sys.platform.startswith("linux") else None
    if trim is not None:
        trim(0)
