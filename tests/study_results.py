"""Made-up results of studies, in the form that `vbnfault.study` leaves them, for tests of figures and pages.

The metrics are closed forms: Ishigami's function, or a weighted sum of the factors with one interaction, so that
the indices are known. Intervals have the width that a study of this size would give.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyarrow as pa
import xarray as xr

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
    """Say what results to make up."""

    method: str = "sobol"
    factors: Sequence[tuple[str, str, str]] = LENS_FACTORS
    metrics: Sequence[tuple[str, str, float]] = IMAGE_METRICS
    models: Sequence[str] = ("",)
    seeds: Sequence[int] = (1, 2)
    views: Sequence[int] = (0, 3)
    n: int = 64
    pairs: bool = False
    failed: int = 0
    empty: Sequence[str] = ()  # metrics without any value


def _value(distribution: str, u: np.ndarray) -> np.ndarray:
    """Return a factor's values of numbers in the unit interval."""
    if distribution == "categorical":
        return np.asarray(["5", "7", "9", "round"])[np.minimum((4 * u).astype(int), 3)]
    if distribution == "log_uniform":
        return 0.3 * 100**u
    return 10 + 2 * u if distribution == "uniform" else 1 + 0.02 * (u - 0.5)


def _design(plan: Plan, generator: np.random.Generator) -> list[tuple[str, np.ndarray]]:
    """Return role and unit coordinates of each point."""
    k, n = len(plan.factors), plan.n
    if plan.method == "sobol":
        a, b = generator.random((n, k)), generator.random((n, k))
        rows = [("A", x) for x in a] + [("B", x) for x in b]
        for j, (key, *_) in enumerate(plan.factors):
            mixed = a.copy()
            mixed[:, j] = b[:, j]
            rows += [(f"AB:{key}", x) for x in mixed]
        return rows
    if plan.method == "one_at_a_time":
        rows = [("point", np.full(k, 0.5))]
        for j in range(k):
            for level in np.linspace(0.02, 0.98, n):
                x = np.full(k, 0.5)
                x[j] = level
                rows.append(("point", x))
        return rows
    if plan.method == "grid":
        levels = np.meshgrid(*[np.linspace(0.02, 0.98, n)] * k, indexing="ij")
        return [("point", x) for x in np.stack([level.ravel() for level in levels], axis=1)]
    if plan.method == "morris":
        rows = []
        for t in range(n):
            x = generator.integers(0, 2, k) / 3
            rows.append((f"morris:{t}:0", x.copy()))
            for step, j in enumerate(generator.permutation(k)):
                x[j] += 2 / 3
                rows.append((f"morris:{t}:{step + 1}", np.clip(x, 0, 1 - 1e-9)))
        return rows
    return [("point", x) for x in generator.random((n, k))]


def _weights(plan: Plan, metric: int) -> tuple[np.ndarray, float]:
    """Return the standard deviation that each factor causes, and that of the interaction of the first two."""
    k = len(plan.factors)
    order = np.random.default_rng(100 + metric).permutation(k)
    weights = np.asarray([2.0**-place for place in range(k)])[np.argsort(order)]
    return weights, 0.5 * weights[0] if k > 1 else 0.0


def _function(plan: Plan, metric: int, u: np.ndarray, model: int, view: int) -> float:
    """Return a metric: a weighted sum of standardised factors, one of them squared, and one interaction."""
    weights, cross = _weights(plan, metric)
    z = np.sqrt(12) * (u - 0.5)
    bent = np.abs(4 * u - 2) - 1
    z = np.where(np.arange(len(u)) == 2, np.sqrt(3) * bent, z)
    value = float(weights @ z + (cross * z[0] * z[1] if len(u) > 1 else 0.0))
    scale = plan.metrics[metric][2]
    return scale * (1 + 0.15 * value * (1 + 0.4 * model) + 0.25 * model + 0.6 * view)


def _table(plan: Plan, generator: np.random.Generator) -> pa.Table:
    rows: list[dict[str, Any]] = []
    design = _design(plan, generator)
    for seed in plan.seeds:
        for i_view, view in enumerate(plan.views):
            for i_model, model in enumerate(plan.models):
                for role, u in design:
                    row: dict[str, Any] = {"evaluation": len(rows), "seed": seed, "view": view, "model": model}
                    row |= {"role": role, "status": "ok", "error": ""}
                    row["dummy"] = 0.5
                    row |= {key: _value(d, u[[j]])[0] for j, (key, d, _) in enumerate(plan.factors)}
                    for m, (name, *_) in enumerate(plan.metrics):
                        row[name] = np.nan if name in plan.empty else _function(plan, m, u, i_model, i_view)
                    rows.append(row)
    for index in generator.choice(len(rows), plan.failed, replace=False):
        rows[index] |= {"status": "failed", "error": "lens.surface.3.radius = 0.9: the rays <miss> surface 4"}
        rows[index] |= {name: np.nan for name, *_ in plan.metrics}
    table = pa.Table.from_pylist(rows)
    units = {key: unit for key, _, unit in plan.factors} | {name: unit for name, unit, _ in plan.metrics}
    fields = [field.with_metadata({"units": units.get(field.name, "")}) for field in table.schema]
    return table.cast(pa.schema(fields))


def _indices(plan: Plan, table: pa.Table, generator: np.random.Generator) -> xr.Dataset:
    keys = [*(key for key, *_ in plan.factors), "dummy"]
    shape = (len(plan.metrics), len(plan.models), len(keys))
    first, total = np.zeros(shape), np.zeros(shape)
    pairs = np.zeros((*shape, len(keys)))
    for m, (name, *_) in enumerate(plan.metrics):
        weights, cross = _weights(plan, m)
        variance = (weights**2).sum() + cross**2
        first[m, :, :-1] = weights**2 / variance
        total[m] = first[m]
        total[m, :, :2] += cross**2 / variance
        if len(keys) > 2:
            pairs[m, :, 0, 1] = pairs[m, :, 1, 0] = cross**2 / variance
        if name in plan.empty:
            first[m] = total[m] = pairs[m] = np.nan
    width = 0.6 / np.sqrt(plan.n)
    dims = ("metric", "model", "factor")

    def interval(values: np.ndarray) -> np.ndarray:
        half = width * (0.25 + np.sqrt(np.clip(values, 0, 1)))
        return np.stack([values - half, values + half], axis=-1)

    def noisy(values: np.ndarray) -> np.ndarray:
        return values + width * 0.4 * (0.25 + np.sqrt(np.clip(values, 0, 1))) * generator.standard_normal(
            values.shape
        )

    variables: dict[str, Any] = {}
    if plan.method == "sobol":
        for letter, values in (("S1", first), ("ST", total)):
            found = noisy(values)
            variables[letter] = (dims, found)
            variables[f"{letter}_interval"] = ((*dims, "bound"), interval(found))
            by_seed = np.stack([noisy(values) for _ in plan.seeds], axis=-1)
            variables[f"{letter}_by_seed"] = ((*dims, "seed"), by_seed)
        if plan.pairs:
            variables["interaction"] = ((*dims, "factor_b"), noisy(pairs))
            variables["interaction_interval"] = ((*dims, "factor_b", "bound"), interval(pairs))
    elif plan.method == "morris":
        scale = np.asarray([scale for *_, scale in plan.metrics])[:, None, None]
        mu_star = scale * np.sqrt(first)
        variables["mu"] = (dims, mu_star * np.where(np.arange(len(keys)) % 3 == 1, -0.8, 1.0))
        variables["mu_star"] = (dims, mu_star)
        variables["mu_star_interval"] = ((*dims, "bound"), np.stack([0.85 * mu_star, 1.15 * mu_star], axis=-1))
        variables["sigma"] = (dims, mu_star * generator.uniform(0.02, 0.9, shape))
    elif plan.method == "latin_hypercube":
        found = noisy(0.6 * total) + 0.04
        variables["delta"] = (dims, found)
        variables["delta_interval"] = ((*dims, "bound"), interval(found))
        variables["S1"], variables["S1_interval"] = (dims, noisy(first)), ((*dims, "bound"), interval(first))
    elif plan.method == "grid":
        variables["S1"], variables["ST"] = (dims, first), (dims, total)
    else:
        variables["range"] = (dims, first)
    values = {
        name: np.asarray(table.column(name).to_numpy(zero_copy_only=False), float) for name, *_ in plan.metrics
    }
    model = table.column("model").to_numpy(zero_copy_only=False)
    means, variances = np.full(shape[:2], np.nan), np.full(shape[:2], np.nan)
    for m, name in enumerate(values):
        for j, each in enumerate(plan.models):
            finite = values[name][(model == each) & np.isfinite(values[name])]
            if finite.size:
                means[m, j], variances[m, j] = finite.mean(), finite.var()
    variables |= {"mean": (dims[:2], means), "variance": (dims[:2], variances)}
    if len(plan.models) > 1:
        between = means.var(axis=1)
        share = between / (between + variances.mean(axis=1))
        variables["model_share"] = (("metric",), share)
        bounds = np.stack([share - 0.04, share + 0.05], axis=-1)
        variables["model_share_interval"] = (("metric", "bound"), bounds)
    names = [name for name, *_ in plan.metrics]
    return xr.Dataset(
        variables,
        coords={
            "metric": names,
            "model": list(plan.models),
            "factor": keys,
            "factor_b": keys,
            "seed": list(plan.seeds),
            "bound": ["low", "high"],
            "unit": ("metric", [unit for _, unit, _ in plan.metrics]),
            "description": ("metric", [f"made-up {name.replace('_', ' ')}" for name in names]),
            "source": ("metric", [""] * len(names)),
            "better": ("metric", ["high" if name == "snr" else "low" for name in names]),
        },
        attrs={
            "title": "made up",
            "formulae": "S1 = Var(E[Y|X]) / Var(Y)",
            "versions": json.dumps({"vbnfault": "0.2.0", "numpy": np.__version__}),
            "timings": json.dumps({"ghosts": 812.4, "starburst": 210.0, "glare": 41.5, "metrics": 7.25}),
        },
    )


def _spec(plan: Plan) -> dict[str, Any]:
    bounds = {
        "uniform": {"low": 10.0, "high": 12.0},
        "log_uniform": {"low": 0.3, "high": 30.0},
        "truncated_normal": {"mean": 1.0, "deviation": 0.005, "low": 0.99, "high": 1.01},
        "categorical": {"values": ["5", "7", "9", "round"]},
    }
    spec: dict[str, Any] = {
        "title": "What drives the straylight of one lens",
        "description": "Twelve factors of <one> lens & its sensor.",
        "design": {
            "method": plan.method,
            "n": plan.n,
            "seed": 1,
            "resamples": 1000,
            "confidence": 0.95,
            "half_width": 0.05,
        },
        "scene": {"base": "flares", "samples": list(plan.views), "seeds": list(plan.seeds)},
        "factor": [{"key": k, "distribution": d, "unit": unit, **bounds[d]} for k, d, unit in plan.factors],
        "metrics": {"names": [name for name, *_ in plan.metrics]},
    }
    if len(plan.models) > 1:
        spec["models"] = {"fault": "straylight", "compare": list(plan.models)}
    return spec


def made_up(plan: Plan) -> StudyResults:
    """Return made-up results: dataset, table and study file."""
    generator = np.random.default_rng(7)
    table = _table(plan, generator)
    return StudyResults(dataset=_indices(plan, table, generator), table=table, spec=_spec(plan))


def ishigami(n: int = 256) -> StudyResults:
    """Return results of Ishigami's function with its analytic indices."""
    plan = Plan(
        factors=[(f"x{i}", "uniform", "rad") for i in (1, 2, 3)],
        metrics=[("ishigami", "1", 1.0)],
        seeds=(1,),
        views=(0,),
        n=n,
        pairs=True,
    )
    results = made_up(plan)
    x = np.pi * np.stack([results.column(f"x{i}") - 11 for i in (1, 2, 3)])  # −π to π
    y = np.sin(x[0]) + 7 * np.sin(x[1]) ** 2 + 0.1 * x[2] ** 4 * np.sin(x[0])
    table = results.table.set_column(results.table.schema.get_field_index("ishigami"), "ishigami", pa.array(y))
    dataset = results.dataset.copy(deep=True)
    for name, values in (("S1", [0.3139, 0.4424, 0.0, 0.0]), ("ST", [0.5576, 0.4424, 0.2437, 0.0])):
        exact = np.asarray(values)
        dataset[name][0, 0] = exact
        dataset[f"{name}_interval"][0, 0] = np.stack([exact - 0.04, exact + 0.05], axis=-1)
        dataset[f"{name}_by_seed"][0, 0, :, 0] = exact
    dataset["interaction"][0, 0] = 0.0
    dataset["interaction"][0, 0, 0, 2] = dataset["interaction"][0, 0, 2, 0] = 0.2437
    return StudyResults(dataset=dataset, table=table, spec=results.spec)
