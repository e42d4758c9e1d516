"""Build, resume, repair, extend and check a dataset.

`store_spec`, `scene_identity` and `planned` compute from a scene what the store of its dataset must hold.

Each public name, listed in `__init__.pyi`, loads its module when it is first used, so that a process that only
builds or checks a store starts without the modules that simulate samples.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
