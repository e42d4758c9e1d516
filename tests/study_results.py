"""Made-up results of studies for tests of figures and pages: real designs and indices of metrics in closed form.

The metrics are Ishigami's function, or a weighted sum of the factors with one interaction.
"""

from __future__ import annotations

import json
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from vbnfault.study import results
from vbnfault.study.designs import make_design
from vbnfault.study.indices import Results, compute
from vbnfault.study.spec import Metric, parse_study
from vbnfault.study.summaries import StudyResults

LENS_FACTORS = (
    ("lens.coating.layer_1.thickness", "truncated_normal", "fraction"),
    ("lens.coating.layer_2.thickness", "truncated_normal", "fraction"),
    ("lens.coating.layer_1.index", "truncated_normal", "1"),
    ("lens.surface.3.radius", "truncated_normal", "fraction"),
    ("lens.surface.5.spacing", "uniform", "mm"),
    ("lens.stop.rounding", "uniform", "1"),
    ("lens.sensor.reflectance", "uniform", "1"),
    ("scene.faults.straylight.roughness_nm", "log_uniform", "nm"),
    ("scene.faults.straylight.cleanliness_level", "log_uniform", "1"),
    ("lens.stop.blades", "categorical", "1"),
    ("sun.angle_deg", "uniform", "deg"),
    ("detector.temperature_K", "uniform", "K"),
)
IMAGE_METRICS = (
    ("straylight_total_e", "e", 3e7),
    ("straylight_peak_e", "e", 4e4),
    ("ghost_total_e", "e", 2e6),
    ("starburst_total_e", "e", 8e5),
    ("glare_total_e", "e", 2e7),
    ("veil_median_e", "e/px", 12.0),
    ("contrast_loss", "1", 0.08),
    ("pixels_above_1dn", "px", 4e5),
    ("pixels_above_noise", "px", 6e5),
    ("pixels_saturated", "px", 300.0),
    ("snr", "1", 80.0),
    ("mask_area", "px", 2e5),
)


@dataclass(frozen=True, kw_only=True)
class Plan:
    """Say what results to make up; `function` of the points u[factor, row] is by default a sum of the factors."""

    method: str = "sobol"
    factors: Sequence[tuple[str, str, str]] = LENS_FACTORS
    metrics: Sequence[tuple[str, str, float]] = IMAGE_METRICS
    models: Sequence[str] = ("",)
    seeds: Sequence[int] = (1, 2)
    views: Sequence[int] = (0, 3)
    n: int = 64
    failed: int = 0
    empty: Sequence[str] = ()  # metrics without any value
    function: Callable[[np.ndarray], np.ndarray] | None = None


def _sum(metric: int, u: np.ndarray) -> np.ndarray:
    """Return a weighted sum of standardised factors, one of them squared, with an interaction of the first two."""
    k = len(u)
    weights = 2.0 ** -np.argsort(np.random.default_rng(100 + metric).permutation(k))
    z = np.sqrt(12) * (u - 0.5)
    if k > 2:
        z[2] = np.sqrt(3) * (np.abs(4 * u[2] - 2) - 1)
    return weights @ z + (0.5 * weights[0] * z[0] * z[1] if k > 1 else 0.0)


def _spec(plan: Plan) -> dict[str, Any]:
    bounds = {
        "uniform": {"low": 10.0, "high": 12.0},
        "log_uniform": {"low": 0.3, "high": 30.0},
        "truncated_normal": {"mean": 1.0, "deviation": 0.005, "low": 0.99, "high": 1.01},
        "categorical": {"values": ["5", "7", "9", "round"]},
    }
    wanted = {"half_width": 0.05} if plan.method == "sobol" else {}
    spec: dict[str, Any] = {
        "title": "What drives the straylight of one lens",
        "description": "Twelve factors of <one> lens & its sensor.",
        "design": {"method": plan.method, "n": plan.n, "resamples": 200, **wanted},
        "scene": {"base": "flares", "samples": list(plan.views), "seeds": list(plan.seeds)},
        "factor": [{"key": k, "distribution": d, "unit": unit, **bounds[d]} for k, d, unit in plan.factors],
        "metrics": {"names": [name for name, *_ in plan.metrics]},
    }
    if len(plan.models) > 1:
        spec["models"] = {"fault": "straylight", "compare": list(plan.models)}
    return spec


def made_up(plan: Plan) -> StudyResults:
    """Return the indices, the table and the file of a study whose values are made up."""
    spec = parse_study(_spec(plan), source="made up")
    design = make_design(spec)
    metrics = tuple(
        Metric(name=name, unit=unit, description=f"made-up {name}", better="high" if name == "snr" else "low")
        for name, unit, _ in plan.metrics
    )
    values = np.full((*design.shape, len(metrics)), np.nan)
    view, model = np.arange(len(plan.views))[:, None, None], np.arange(len(plan.models))
    for m, (name, _, scale) in enumerate(plan.metrics):
        u = design.points[:, :-1].T
        points = (_sum(m, u) if plan.function is None else plan.function(u))[:, None]
        if name not in plan.empty:
            values[..., m] = scale * (1 + 0.15 * points * (1 + 0.4 * model) + 0.25 * model + 0.6 * view)
    by_row = values.reshape(len(design), -1)
    failed = np.random.default_rng(7).choice(len(design), plan.failed, replace=False)
    by_row[failed] = np.nan
    error = "lens.surface.3.radius = 0.9: the rays <miss> surface 4"
    names = [metric.name for metric in metrics]
    outcomes = [
        {"values": dict(zip(names, row, strict=True)), "error": error if k in failed else ""}
        for k, row in enumerate(by_row)
    ]
    with tempfile.TemporaryDirectory() as folder:
        table = results.write_table(Path(folder) / "table.parquet", design, metrics, outcomes)
    dataset = compute(Results(design, metrics, values)).assign_attrs(
        title="made up",
        formulae="S1 = Var(E[Y|X]) / Var(Y)",
        versions=json.dumps({"vbnfault": "0.2.0", "numpy": np.__version__}),
        timings=json.dumps({"ghosts": 812.4, "starburst": 210.0, "glare": 41.5, "metrics": 7.25}),
    )
    return StudyResults(dataset=dataset, table=table, spec=spec.resolved())


def ishigami(n: int = 128) -> StudyResults:
    """Return results of Ishigami's function."""

    def function(u: np.ndarray) -> np.ndarray:
        x = np.pi * (2 * u - 1)
        return np.sin(x[0]) + 7 * np.sin(x[1]) ** 2 + 0.1 * x[2] ** 4 * np.sin(x[0])

    factors = [(f"x{i}", "uniform", "rad") for i in (1, 2, 3)]
    plan = Plan(factors=factors, metrics=[("ishigami", "1", 1.0)], seeds=(1,), views=(0,), n=n, function=function)
    return made_up(plan)
