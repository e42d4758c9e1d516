"""Rendering with Mitsuba 3 (LLVM, spectral). The only package that imports it; importing this loads it."""

from .integrate import radiance, truth
from .resolve import ground_height_m, is_clear, sun_visible_fraction
from .runtime import set_threads
from .surface import Surface

__all__ = [
    "Surface",
    "ground_height_m",
    "is_clear",
    "radiance",
    "set_threads",
    "sun_visible_fraction",
    "truth",
]
