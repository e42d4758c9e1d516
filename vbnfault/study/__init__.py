"""Run sensitivity studies: which parameters drive a metric, how much depends on the model, with what confidence.

`spec` reads a study file, `distributions` and `designs` make its points, `run` evaluates them, `indices` computes
indices with intervals, and `results` stores both.

The package can be called, as `run.study`: whoever imports one of its modules sets the attribute `study` of
`vbnfault`, which otherwise is that function, to the package.
"""

from __future__ import annotations

import sys
from types import ModuleType
from typing import Any


class _Callable(ModuleType):
    """Run a study when the module is called."""

    def __call__(self, *arguments: Any, **keywords: Any) -> Any:
        """Run a study; see `vbnfault.study.run.study`."""
        from . import run

        return run.study(*arguments, **keywords)


sys.modules[__name__].__class__ = _Callable
