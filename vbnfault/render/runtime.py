"""Loads drjit and mitsuba, once, with a usable LLVM and the spectral variant."""

from __future__ import annotations

from typing import Any

from ..core import llvm

llvm.prepare()

import drjit  # noqa: E402
import mitsuba  # noqa: E402

mitsuba.set_variant("llvm_ad_spectral")
mitsuba.set_log_level(mitsuba.LogLevel.Error)

# their stubs do not know what broadcasting and swizzling allow
dr: Any = drjit
mi: Any = mitsuba

__all__ = ["dr", "mi", "set_threads"]


def set_threads(count: int) -> None:
    """Cap the number of render threads of this process."""
    dr.set_thread_count(count)
