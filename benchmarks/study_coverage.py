"""Count how often the intervals of a study hold the analytic indices.

    python benchmarks/study_coverage.py --seeds 100 --n 64 256 1024
    python benchmarks/study_coverage.py --seeds 1000 --n 16 --functions lognormal rough --direct

Each seed is a study of its own: study file, scrambled Sobol' design, evaluations, table, indices with bootstrap
intervals. With `--direct` the function is evaluated at all points at once, without files; the indices are the same.
The functions are Ishigami's and Sobol's g, and four that are hard for the surrogates of the control variates: one
with jumps, one with a categorical factor, one with a log-normal output whose standard deviation is twice its mean,
and a rough one of twelve factors, of which surrogates learn nothing.

For each index it prints the percentage of seeds in which the analytic value lies within the 95 % interval, and for
the dummy factor, which is the last, the percentage in which the interval holds 0; then the percentage in which all
intervals of a function hold at once, and the median half-widths of the total indices. For comparison, `--plain`
leaves out the control variates.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.stats import norm

import vbnfault
from vbnfault.study import indices
from vbnfault.study.designs import make_design
from vbnfault.study.spec import Evaluation, Metric, StudySpec, parse_study


@dataclass(frozen=True)
class Function:
    """Hold a function of x[factor, ...], each from 0 to 1, and its S1 and ST.

    `choices`: values of the first factor, if it is a categorical one.
    """

    of: Callable[[np.ndarray], Any]
    first: np.ndarray
    total: np.ndarray
    choices: tuple[float, ...] = ()


def product(functions: Callable[[np.ndarray], np.ndarray], variances: np.ndarray) -> Function:
    """Return the product of one function of each factor, of mean 1 and these variances."""
    whole = np.prod(1 + variances) - 1
    return Function(
        lambda x: np.prod(functions(x), axis=0),
        variances / whole,
        variances * np.prod(1 + variances) / (1 + variances) / whole,
    )


def column(values: Sequence[float], x: np.ndarray) -> np.ndarray:
    """Return one value for each factor in the shape that x needs."""
    return np.array(values).reshape(-1, *(1,) * (x.ndim - 1))


def ishigami() -> Function:
    """Return Ishigami's function (Ishigami & Homma 1990) with a = 7, b = 0.1."""
    a, b = 7.0, 0.1
    whole = a**2 / 8 + b * np.pi**4 / 5 + b**2 * np.pi**8 / 18 + 0.5
    first = np.array([(1 + b * np.pi**4 / 5) ** 2 / 2, a**2 / 8, 0.0]) / whole
    both = 8 * b**2 * np.pi**8 / 225 / whole

    def of(x: np.ndarray) -> Any:
        z = np.pi * (2 * x - 1)
        return np.sin(z[0]) + a * np.sin(z[1]) ** 2 + b * z[2] ** 4 * np.sin(z[0])

    return Function(of, first, first + np.array([both, 0, both]))


def sobol_g() -> Function:
    """Return Sobol's g with the coefficients of Saltelli & Sobol' 1995."""
    a = (0.0, 1.0, 4.5, 9.0, 99.0, 99.0, 99.0, 99.0)
    variances = 1 / (3 * (1 + np.array(a)) ** 2)
    return product(lambda x: (np.abs(4 * x - 2) + column(a, x)) / (1 + column(a, x)), variances)


def jump() -> Function:
    """Return 1 in a corner of the first two factors and 0 elsewhere, plus half the third; the fourth is inert."""
    p, q = 0.63, 0.4
    alone = np.array([q**2 * p * (1 - p), p**2 * q * (1 - q), 0.25 / 12, 0.0])
    both = p * (1 - p) * q * (1 - q)
    whole = alone.sum() + both
    total = alone + np.array([both, both, 0, 0])
    return Function(lambda x: 1.0 * ((x[0] < p) & (x[1] < q)) + 0.5 * x[2], alone / whole, total / whole)


def categorical() -> Function:
    """Return h (1 + x1) + x2² with the categorical factor h; the fourth factor is inert."""
    h = np.array([-1.0, 0.5, 2.0])
    alone = np.array([2.25 * h.var(), h.mean() ** 2 / 12, 4 / 45, 0.0])
    both = h.var() / 12
    whole = alone.sum() + both
    total = alone + np.array([both, both, 0, 0])
    return Function(lambda x: x[0] * (1 + x[1]) + x[2] ** 2, alone / whole, total / whole, tuple(h))


def lognormal() -> Function:
    """Return a product of log-normal factors."""
    a = (1.0, 0.7, 0.4, 0.0)
    variances = np.exp(np.square(a)) - 1
    return product(lambda x: np.exp(column(a, x) * norm.ppf(x) - column(a, x) ** 2 / 2), variances)


def rough() -> Function:
    """Return a product of twelve factors that oscillate: 1 + w √2 cos 14 π x."""
    w = 0.6 * 0.8 ** np.arange(12)
    return product(lambda x: 1 + np.sqrt(2) * column(w, x) * np.cos(14 * np.pi * x), w**2)


FUNCTIONS = {make.__name__: make() for make in (ishigami, sobol_g, jump, categorical, lognormal, rough)}


class Benchmark:
    """Evaluate the function that the study names."""

    metrics = tuple(Metric(name=name, unit="1", description="test function") for name in FUNCTIONS)

    def __init__(self, spec: StudySpec) -> None:
        (self.name,) = spec.metrics.names

    def check(self) -> Sequence[str]:
        return ()

    def evaluate(self, evaluation: Evaluation) -> Mapping[str, float]:
        x = np.array([float(value) for value in evaluation.values.values()])
        return {self.name: float(FUNCTIONS[self.name].of(x))}

    def timings(self) -> Mapping[str, float]:
        return {}


def study(name: str, n: int, seed: int) -> StudySpec:
    """Return the study of a function."""
    function = FUNCTIONS[name]
    factors: list[dict[str, Any]] = [
        {"key": f"x{i}", "distribution": "uniform", "low": 0.0, "high": 1.0} for i in range(len(function.first))
    ]
    if function.choices:
        factors[0] = {"key": "x0", "distribution": "categorical", "values": list(function.choices)}
    table = {"title": name, "factor": factors, "metrics": {"names": [name]}, "design": {"n": n, "seed": seed}}
    return parse_study(table, source=name)


def direct(spec: StudySpec) -> Any:
    """Return the indices of a study without its files."""
    (name,) = spec.metrics.names
    design = make_design(spec)
    y = FUNCTIONS[name].of(np.array(design.values, dtype=float))
    metric = Metric(name=name, unit="1", description="test function")
    return indices.compute(indices.Results(design, (metric,), np.asarray(y)[None, None, :, None, None]))


def run(name: str, n: int, arguments: argparse.Namespace) -> None:
    """Run the studies of a function and print the counts."""
    function, began, whole = FUNCTIONS[name], time.monotonic(), 0
    exact = {"S1": np.append(function.first, 0.0), "ST": np.append(function.total, 0.0)}
    held = {index: np.zeros(len(values)) for index, values in exact.items()}
    widths = []
    for seed in range(arguments.seeds):
        spec = study(name, n, seed)
        data = direct(spec) if arguments.direct else vbnfault.study(spec, evaluator=Benchmark, progress=False)
        inside = {}
        for index, values in exact.items():
            low, high = data[f"{index}_interval"].values[0, 0].T
            inside[index] = (low <= values) & (values <= high)
            held[index] += inside[index]
        whole += all(each.all() for each in inside.values())
        widths.append(indices.half_widths(data).values[0, 0])
        if not arguments.direct:
            print(f"{name}, seed {seed}: all intervals held in {whole}", file=sys.stderr)
    percent = 100 / arguments.seeds
    print(f"{name}: n = {n}, {arguments.seeds} seeds, {time.monotonic() - began:.0f} s")
    for index, counts in held.items():
        print(f"    {index} held / %, dummy factor last:", *(f"{percent * count:.1f}" for count in counts))
    print(f"    all at once / %: {percent * whole:.1f}")
    print("    half-widths of ST:", *(f"{width:.4f}" for width in np.median(widths, axis=0)), flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=100)
    parser.add_argument("--n", type=int, nargs="+", default=[1024], help="base samples, powers of two")
    parser.add_argument("--functions", nargs="+", choices=list(FUNCTIONS), default=list(FUNCTIONS))
    parser.add_argument("--direct", action="store_true", help="evaluate without the files of a study")
    parser.add_argument("--plain", action="store_true", help="leave out the control variates")
    arguments = parser.parse_args()
    if arguments.plain:
        indices.LEAST_SAMPLES = 2**62  # type: ignore[misc]
    for name in arguments.functions:
        for n in arguments.n:
            run(name, n, arguments)


if __name__ == "__main__":
    main()
