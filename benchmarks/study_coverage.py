"""Count how often the intervals of a study hold the analytic indices, through the whole engine.

    python benchmarks/study_coverage.py --seeds 100 --n 1024

Each seed is a study of its own: study file, scrambled Sobol' design, evaluations, table, indices with bootstrap
intervals. The functions are Ishigami's with 3 factors and Sobol's g with 8. For each index it prints the number of
seeds in which the analytic value lies within the 95 % interval, and for the dummy factor the number in which the
interval holds 0; then the number of seeds in which all intervals of a function hold at once.
"""

from __future__ import annotations

import argparse
import math
import sys
import time
from collections.abc import Mapping, Sequence

import numpy as np

import vbnfault
from vbnfault.study.spec import Evaluation, Metric, StudySpec, parse_study

G = (0.0, 1.0, 4.5, 9.0, 99.0, 99.0, 99.0, 99.0)  # coefficients of Saltelli & Sobol' 1995


FACTORS = {"ishigami": 3, "sobol_g": len(G)}


class Benchmark:
    """Evaluate the function that the study names, of factors in the unit interval."""

    metrics = tuple(Metric(name=name, unit="1", description="test function") for name in FACTORS)

    def __init__(self, spec: StudySpec) -> None:
        (self.name,) = spec.metrics.names

    def check(self) -> Sequence[str]:
        return ()

    def evaluate(self, evaluation: Evaluation) -> Mapping[str, float]:
        u = [float(value) for value in evaluation.values.values()]
        if self.name == "sobol_g":
            return {self.name: math.prod((abs(4 * v - 2) + a) / (1 + a) for v, a in zip(u, G, strict=True))}
        x = [math.pi * (2 * value - 1) for value in u]
        return {self.name: math.sin(x[0]) + 7 * math.sin(x[1]) ** 2 + 0.1 * x[2] ** 4 * math.sin(x[0])}

    def timings(self) -> Mapping[str, float]:
        return {}


def study(name: str, n: int, seed: int) -> StudySpec:
    """Return the study of a function."""
    factors = [{"key": f"x{i}", "distribution": "uniform", "low": 0.0, "high": 1.0} for i in range(FACTORS[name])]
    table = {"title": name, "factor": factors, "metrics": {"names": [name]}, "design": {"n": n, "seed": seed}}
    return parse_study(table, source=name)


def analytic() -> dict[str, dict[str, np.ndarray]]:
    """Return S1 and ST of both functions for their factors and the dummy factor."""
    a, b = 7.0, 0.1
    whole = a**2 / 8 + b * math.pi**4 / 5 + b**2 * math.pi**8 / 18 + 0.5
    first = np.array([(1 + b * math.pi**4 / 5) ** 2 / 2, a**2 / 8, 0.0]) / whole
    both = 8 * b**2 * math.pi**8 / 225 / whole
    parts = 1 / (3 * (1 + np.array(G)) ** 2)
    variance = np.prod(1 + parts) - 1
    return {
        "ishigami": {"S1": np.r_[first, 0.0], "ST": np.r_[np.add(first, [both, 0, both]), 0.0]},
        "sobol_g": {
            "S1": np.r_[parts / variance, 0.0],
            "ST": np.r_[parts * np.prod(1 + parts) / (1 + parts) / variance, 0.0],
        },
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=100)
    parser.add_argument("--n", type=int, default=1024, help="base samples, a power of two")
    arguments = parser.parse_args()
    exact = analytic()
    for name, count in FACTORS.items():
        held = {index: np.zeros(count + 1, dtype=int) for index in ("S1", "ST")}
        whole, began = 0, time.monotonic()
        for seed in range(arguments.seeds):
            data = vbnfault.study(study(name, arguments.n, seed), evaluator=Benchmark, progress=False)
            inside = {}
            for index in held:
                low, high = data[f"{index}_interval"].values[0, 0].T
                inside[index] = (low <= exact[name][index]) & (exact[name][index] <= high)
                held[index] += inside[index]
            whole += all(bool(one.all()) for one in inside.values())
            print(f"{name}, seed {seed}: all intervals held in {whole}", file=sys.stderr)
        print(f"{name}: n = {arguments.n}, {arguments.seeds} seeds, {time.monotonic() - began:.0f} s")
        for index, counts in held.items():
            print(f"    {index} held, by factor with the dummy factor last: {counts}")
        print(f"    all at once: {whole}", flush=True)


if __name__ == "__main__":
    main()
