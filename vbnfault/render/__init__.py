"""Render with Mitsuba 3 (LLVM, spectral). This is the only package that imports Mitsuba.

Each public name, listed in `__init__.pyi`, loads its module and Mitsuba when it is first used. `description` holds
the input of a render as plain data and loads without Mitsuba.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
