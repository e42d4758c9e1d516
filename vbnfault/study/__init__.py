"""Run sensitivity studies: which parameters drive a metric, how much depends on the model, with what confidence.

    indices = vbnfault.study("flare_lens", "results", workers=2)

The package itself can be called, as its function `study`. Its modules: `spec` reads a study file, `distributions`
and `designs` make its points, `run` evaluates them in `chunks`, `indices` computes indices with intervals, and
with surrogates as `control_variates`, and `results` stores both.

Each public name, listed in `__init__.pyi`, loads its module when it is first used.
"""

import sys

import lazy_loader

from ..core.callable_package import CallablePackage

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

sys.modules[__name__].__class__ = CallablePackage
