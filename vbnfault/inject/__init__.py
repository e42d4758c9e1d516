"""Put faults into images that exist already: of a user's own camera, of another renderer, of an archive.

    result = vbnfault.inject(image, {"dust_on_optics": {"model": "defocused"}}, camera={"fov_deg": 5.0})

The package itself can be called, as its function `inject`. Its modules: `response` converts numbers to light,
`picture` holds an image as electrons, `change` lets the faults act, `injector` does all of it, image after image,
`files` reads and writes files, and `batch` works through many.
"""

import sys

from ..core.callable_package import CallablePackage
from .injector import Injected as Injected
from .injector import Injector as Injector
from .injector import inject as inject

__all__ = ["inject"]  # the classes are names of `vbnfault` itself

sys.modules[__name__].__class__ = CallablePackage
