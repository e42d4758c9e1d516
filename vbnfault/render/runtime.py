"""Load drjit and mitsuba once, with a usable LLVM and the spectral variant."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core import llvm

llvm.prepare()

import drjit  # noqa: E402
import mitsuba  # noqa: E402

mitsuba.set_variant("llvm_ad_spectral")
mitsuba.set_log_level(mitsuba.LogLevel.Error)

# their type stubs do not cover broadcasting and swizzling
dr: Any = drjit
mi: Any = mitsuba

__all__ = ["dr", "mi", "packets", "set_threads"]

_ALIGNED_BYTES = 64


def set_threads(count: int) -> None:
    """Limit the number of render threads of this process."""
    dr.set_thread_count(count)


def packets(kind: Any, values: NDArray[Any]) -> Any:
    """Return numbers as a drjit array of the type `kind` from which `dr.gather` fetches two or four at a time.

    drjit uses numpy's memory as it is. Where that is not aligned, it fetches single numbers, by another kernel: the
    one in its cache on disk would serve only some of the processes.
    """
    memory = np.empty(values.nbytes + _ALIGNED_BYTES, np.uint8)
    start = -memory.ctypes.data % _ALIGNED_BYTES
    aligned = memory[start : start + values.nbytes].view(values.dtype)
    aligned[:] = values.ravel()
    return kind(aligned)
