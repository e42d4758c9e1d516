"""Load drjit and mitsuba once, with a usable LLVM and the spectral variant."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.process import llvm

llvm.prepare()

import drjit  # noqa: E402
import mitsuba  # noqa: E402

mitsuba.set_variant("llvm_ad_spectral")
mitsuba.set_log_level(mitsuba.LogLevel.Error)

# their type stubs do not cover broadcasting and swizzling
dr: Any = drjit
mi: Any = mitsuba

__all__ = ["columns", "dr", "mi", "packets", "set_threads"]


def set_threads(count: int) -> None:
    """Limit the number of render threads of this process."""
    dr.set_thread_count(count)


def packets(kind: Any, values: NDArray[Any]) -> Any:
    """Return numbers as a drjit array of the type `kind` from which `dr.gather` fetches two or four at a time.

    The array may use the memory of `values`, which must not change while the array is used. Where they are not
    aligned, drjit fetches single numbers, by another kernel: the one in its cache on disk would serve only some of
    the processes.
    """
    return kind(llvm.flat(values))


def columns(vectors: NDArray[Any]) -> list[Any]:
    """Return the columns of an array [n, k] as drjit floats, such as the components of vectors."""
    return [mi.Float(llvm.flat(np.asarray(column, np.float32))) for column in vectors.T]
