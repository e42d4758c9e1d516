"""Describe the target body: its shape, gravity, sites and terrain.

Frame T is fixed to the body. It has the origin and the axes of the shape file, and the body rotates about +z.

Each public name, listed in `__init__.pyi`, loads its module when it is first used.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
