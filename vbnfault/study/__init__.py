"""Run sensitivity studies: which parameters drive a metric, how much depends on the model, with what confidence.

    indices = vbnfault.study("flare_lens", "results", workers=2)

The package itself can be called, as its function `study`. Its modules: `spec` reads a study file, `distributions`
and `designs` make its points, `run` evaluates them in `chunks`, `indices` computes indices with intervals, and
with surrogates as `control_variates`, and `results` stores both.

Each public name, listed in `__init__.pyi`, loads its module when it is first used.
"""

import sys
from types import ModuleType
from typing import Any

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)


class _Callable(ModuleType):
    """Run a study when the module is called.

    The attribute `study` of `vbnfault` cannot be the function: the import of any module of this package sets it to
    the package.
    """

    def __call__(self, *arguments: Any, **keywords: Any) -> Any:
        """Run a study; see `vbnfault.study.study`."""
        return self.study(*arguments, **keywords)


sys.modules[__name__].__class__ = _Callable
