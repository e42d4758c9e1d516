"""Run sensitivity studies: which parameters drive a metric, how much depends on the model, with what confidence.

    indices = vbnfault.study("flare_lens", "results", workers=2)

The package itself can be called, as its function `study`. Its modules: `spec` reads a study file, `distributions`
and `designs` make its points, `run` evaluates them in `chunks`, `indices` computes indices with intervals, and
with surrogates as `control_variates`, and `results` stores both.
"""

from __future__ import annotations

import sys
from types import ModuleType
from typing import TYPE_CHECKING, Any

from ..core.lazy_names import load_name

if TYPE_CHECKING:
    from .chunks import StudyFailed
    from .results import open_indices, read_table
    from .run import StudySummary, recompute, run_study, study
    from .spec import Evaluation, Evaluator, Metric, StudySpec, load_study, parse_study

# public name → the module that defines it; it is loaded when the name is first used
_HOMES = {
    "Evaluation": "spec",
    "Evaluator": "spec",
    "Metric": "spec",
    "StudyFailed": "chunks",
    "StudySpec": "spec",
    "StudySummary": "run",
    "load_study": "spec",
    "open_indices": "results",
    "parse_study": "spec",
    "read_table": "results",
    "recompute": "run",
    "run_study": "run",
    "study": "run",
}

__all__ = [
    "Evaluation",
    "Evaluator",
    "Metric",
    "StudyFailed",
    "StudySpec",
    "StudySummary",
    "load_study",
    "open_indices",
    "parse_study",
    "read_table",
    "recompute",
    "run_study",
    "study",
]


if not TYPE_CHECKING:  # a type checker that saw the function would accept every misspelled name

    def __getattr__(name: str) -> Any:
        """Return a public name from the module that defines it."""
        return load_name(__name__, name, _HOMES)


class _Callable(ModuleType):
    """Run a study when the module is called.

    The attribute `study` of `vbnfault` cannot be the function: the import of any module of this package sets it to
    the package.
    """

    def __call__(self, *arguments: Any, **keywords: Any) -> Any:
        """Run a study; see `vbnfault.study.study`."""
        return self.study(*arguments, **keywords)


sys.modules[__name__].__class__ = _Callable
