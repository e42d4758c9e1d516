"""Load drjit and mitsuba once, with a usable LLVM and the spectral variant."""

from __future__ import annotations

from typing import Any

from ..core import llvm

llvm.prepare()

import drjit  # noqa: E402
import mitsuba  # noqa: E402

mitsuba.set_variant("llvm_ad_spectral")
mitsuba.set_log_level(mitsuba.LogLevel.Error)

# their type stubs do not cover broadcasting and swizzling
dr: Any = drjit
mi: Any = mitsuba

__all__ = ["dr", "mi", "set_threads"]


def set_threads(count: int) -> None:
    """Limit the number of render threads of this process."""
    dr.set_thread_count(count)
