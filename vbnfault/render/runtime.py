"""Loads drjit and mitsuba, once, with a usable LLVM and the spectral variant."""

from __future__ import annotations

from .. import llvm

llvm.prepare()

import drjit as dr  # noqa: E402
import mitsuba as mi  # noqa: E402

mi.set_variant("llvm_ad_spectral")
mi.set_log_level(mi.LogLevel.Error)

__all__ = ["dr", "mi", "set_threads"]


def set_threads(count: int) -> None:
    """Cap the number of render threads of this process."""
    dr.set_thread_count(count)
