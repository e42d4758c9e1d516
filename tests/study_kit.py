"""Studies of functions with known indices, for the tests of the engine."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from vbnfault.study import indices
from vbnfault.study.designs import make_design
from vbnfault.study.spec import Evaluation, Metric, StudySpec, parse_study

_VARIANCE = 49 / 8 + 0.1 * math.pi**4 / 5 + 0.01 * math.pi**8 / 18 + 0.5
_FIRST = ((1 + 0.1 * math.pi**4 / 5) ** 2 / 2 / _VARIANCE, 49 / 8 / _VARIANCE, 0.0)
_BOTH = 8 * 0.01 * math.pi**8 / 225 / _VARIANCE  # of the first and the third factor together
# Ishigami & Homma 1990 with a = 7, b = 0.1
ANALYTIC_ISHIGAMI = {"S1": _FIRST, "ST": (_FIRST[0] + _BOTH, _FIRST[1], _BOTH)}


def spec(count: int = 3, low: float = -math.pi, high: float = math.pi, **tables: Any) -> StudySpec:
    """Return a study of `count` uniform factors x0, x1, …; keywords replace its tables."""
    factors = [{"key": f"x{i}", "distribution": "uniform", "low": low, "high": high} for i in range(count)]
    plain = {"title": "test", "design": {"n": 64}, "factor": factors, "metrics": {"names": ["y"]}}
    return parse_study(plain | tables, source="test")


def analysed(study: StudySpec, function: Any) -> Any:
    """Return the indices of a function that takes the design's points x[factor, row] at once."""
    design = make_design(study)
    values = np.asarray(function(np.array(design.values, dtype=float)))[None, None, :, None, None]
    return indices.compute(indices.Results(design, tuple(Function.metrics[:1]), values))


class Function:
    """Evaluate a function of the factors; the metric z is the same plus the view and the seed."""

    metrics: Sequence[Metric] = (
        Metric(name="y", unit="1", description="value of the function"),
        Metric(name="z", unit="px", description="value plus 100 view plus seed", source="test"),
    )

    def __init__(self, study: StudySpec) -> None:
        self.study, self.count = study, 0

    def function(self, x: np.ndarray) -> Any:
        """Ishigami's function of x[factor]."""
        return np.sin(x[0]) + 7 * np.sin(x[1]) ** 2 + 0.1 * x[2] ** 4 * np.sin(x[0])

    def check(self) -> Sequence[str]:
        return ()

    def evaluate(self, evaluation: Evaluation) -> Mapping[str, float]:
        self.count += 1
        y = float(self.function(np.array([float(v) for v in evaluation.values.values()])))
        return {"y": y, "z": y + 100 * evaluation.view + evaluation.seed}

    def timings(self) -> Mapping[str, float]:
        return {"function": 1e-3 * self.count}


class Stopping(Function):
    """Send this process a signal at the evaluation `VBNFAULT_TEST_STOP`, once."""

    def evaluate(self, evaluation: Evaluation) -> Mapping[str, float]:
        at, number, once = os.environ.get("VBNFAULT_TEST_STOP", "-1 15 /").split()
        if evaluation.index == int(at) and not Path(once).exists():
            Path(once).touch()
            os.kill(os.getpid(), int(number))
        return super().evaluate(evaluation)


def small_spec() -> StudySpec:
    """Return a study of 320 evaluations in two blocks."""
    return spec(design={"n": 32, "resamples": 100}, scene={"samples": [0, 3]}, metrics={"names": ["y", "z"]})


def of_small_spec(folder: str) -> None:
    """Run this study in a process of its own."""
    from vbnfault.dataset import BuildOptions
    from vbnfault.study.run import run_study

    run_study(small_spec(), Path(folder), BuildOptions(progress=False), report=False, evaluator=Stopping)
