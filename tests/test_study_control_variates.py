"""Control variates of Sobol' indices: narrow intervals that hold the analytic indices, and none where unsafe."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import study_kit as kit

from vbnfault.core.errors import InputError
from vbnfault.dataset import BuildOptions
from vbnfault.study import indices, results, run
from vbnfault.study.control_variates import fit, make_basis
from vbnfault.study.designs import make_design
from vbnfault.study.spec import StudySpec, parse_study

QUIET = BuildOptions(progress=False)
FACTORS = [
    {"key": "a", "distribution": "categorical", "values": [-1.0, 0.5, 2.0]},
    {"key": "b", "distribution": "truncated_normal", "mean": 1.0, "deviation": 0.5, "low": -1.0, "high": 40.0},
    {"key": "c", "distribution": "log_uniform", "low": 0.5, "high": 2.0},
    {"key": "d", "distribution": "uniform", "low": 0.0, "high": 1.0},
]


def mixed_spec(n: int, seed: int = 0, **design: Any) -> StudySpec:
    """Return a study with a factor of each distribution."""
    table = {"title": "t", "factor": FACTORS, "metrics": {"names": ["y"]}}
    return parse_study(table | {"design": {"n": n, "seed": seed, **design}}, source="test")


def test_the_functions_of_a_factor_are_orthonormal_under_its_distribution() -> None:
    # 2**14 points of a scrambled sequence give means of these functions to some 1e-3
    design = make_design(mixed_spec(2**14))
    base = np.flatnonzero(np.array(design.roles) == "A")
    basis = make_basis(design.spec.factors, design.points[base, :-1])
    chosen = np.flatnonzero(basis.degrees <= 2)
    products = basis.products(np.ones(len(base), dtype=bool), chosen)
    np.testing.assert_allclose(products.T @ products / len(base), np.eye(len(chosen)), atol=0.05)
    assert {len(np.flatnonzero(row)) for row in basis.contains[chosen]} == {0, 1, 2}


def test_surrogates_know_their_own_indices() -> None:
    design = make_design(mixed_spec(32))
    x = np.array(design.values, dtype=float)
    basis = make_basis(design.spec.factors, design.points[:, :-1])
    surrogates = fit(basis, x[0] * x[1] + np.log(x[2]), np.ones(32, dtype=bool))
    # b is nearly normal with mean 1 and deviation 0.5, cut off at -4 deviations; a has mean 0.5 and variance 1.5
    parts = {"a": 1.5, "b": 0.25 * 0.25, "c": np.log(4) ** 2 / 12, "ab": 1.5 * 0.25}
    np.testing.assert_allclose(surrogates.mean, 0.5, rtol=1e-3)
    np.testing.assert_allclose(
        surrogates.first, [[parts["a"], parts["b"], parts["c"], 0]] * 8, rtol=2e-3, atol=1e-6
    )
    np.testing.assert_allclose(surrogates.pairs[:, 0, 1], parts["ab"], rtol=2e-3)
    np.testing.assert_allclose(surrogates.total[:, 1], parts["b"] + parts["ab"], rtol=2e-3)
    np.testing.assert_allclose(surrogates.variance, sum(parts.values()), rtol=2e-3)


def test_a_surrogate_does_not_see_the_fold_that_it_is_compared_with() -> None:
    design = make_design(mixed_spec(32))
    x = np.array(design.values, dtype=float)
    y, complete = x[0] * x[1] + x[3], np.ones(32, dtype=bool)
    basis = make_basis(design.spec.factors, design.points[:, :-1])
    before = fit(basis, y, complete)
    held_out = np.repeat(before.fold == 3, 6)
    after = fit(basis, np.where(held_out, 1e3 * y**2, y), complete)
    np.testing.assert_array_equal(after.values[held_out], before.values[held_out])
    np.testing.assert_array_equal(after.total[3], before.total[3])
    assert not np.allclose(after.total[2], before.total[2])


def test_intervals_are_narrow_and_hold_the_analytic_indices() -> None:
    # x0 x1 with a jump in x2: no polynomial, so that the surrogates are good but not exact
    alone = np.array([1 / 48, 1 / 48, 0.04 * 0.3 * 0.7])
    whole = alone.sum() + 1 / 144
    exact = {"S1": alone / whole, "ST": (alone + np.array([1, 1, 0]) / 144) / whole}
    held, widths = np.zeros((2, 4)), []
    for seed in range(20):
        spec = kit.spec(3, 0.0, 1.0, design={"n": 64, "seed": seed, "resamples": 200})
        data = kit.analysed(spec, lambda x: x[0] * x[1] + 0.2 * (x[2] < 0.3))
        for row, (name, values) in enumerate(exact.items()):
            low, high = data[f"{name}_interval"].values[0, 0].T
            held[row] += (low <= np.append(values, 0.0)) & (np.append(values, 0.0) <= high)
        widths.append(float(indices.half_widths(data).max()))
    assert held.min() >= 16, held  # of 20; with 95 % each, fewer than 16 have a probability of 0.3 %
    assert np.median(widths) < 0.06  # 0.19 without control variates


@pytest.mark.parametrize("n", [16, 64])
def test_without_a_good_surrogate_the_indices_are_those_of_before(n: int, monkeypatch: pytest.MonkeyPatch) -> None:
    generator = np.random.default_rng(4)
    cases = {
        "rough": (12, lambda x: np.prod(1 + np.cos(14 * np.pi * x) / 2, axis=0)),
        "heavy tail": (3, lambda x: np.exp(3 * np.sum(x, axis=0)) ** 3),
        "noise": (2, lambda x: generator.normal(size=x.shape[1])),
    }
    for name, (count, function) in cases.items():
        spec = kit.spec(count, 0.0, 1.0, design={"n": n, "resamples": 100})
        y = function(np.array(make_design(spec).values, dtype=float))
        data = kit.analysed(spec, lambda _, y=y: y)
        assert np.isnan(data["explained"]).all(), name
        with monkeypatch.context() as patch:
            patch.setattr(indices, "LEAST_SAMPLES", 2**30)
            assert data.identical(kit.analysed(spec, lambda _, y=y: y)), name


def test_incomplete_samples_and_several_blocks_have_control_variates() -> None:
    spec = kit.spec(2, 0.0, 1.0, design={"n": 64, "resamples": 100}, scene={"samples": 2, "seeds": [4, 9]})
    design = make_design(spec)
    x = np.array(design.values, dtype=float)
    blocks = np.stack([np.stack([x[0], x[0] + 50]), np.stack([2 * x[1], 2 * x[1] - 7])])
    blocks[0, 1, 40:60] = np.nan
    found = indices.compute(indices.Results(design, tuple(kit.Function.metrics[:1]), blocks[..., None, None]))
    np.testing.assert_allclose(found["ST"].values[0, 0, :2], [0.2, 0.8], atol=1e-3)
    np.testing.assert_allclose(found["ST_by_seed"].values[0, 0, :2], [[1, 0], [0, 1]], atol=1e-2)
    assert list(found["seed"].values) == [4, 9]
    assert found["ST_seed_deviation"].values[0, 0, 0] == pytest.approx(2**-0.5, abs=0.02)
    assert float(found["explained"].squeeze()) == pytest.approx(1.0)


def test_a_finished_study_is_computed_again_from_its_table(tmp_path: Path) -> None:
    with_words = {"key": "x2", "distribution": "categorical", "values": ["1", "2", "3"]}
    plain = kit.spec(2, 0.0, 1.0, design={"n": 16, "resamples": 100}).resolved()
    spec = parse_study(plain | {"factor": [*plain["factor"], with_words]}, source="test")
    data = run.run_study(spec, tmp_path / "s", QUIET, report=False, evaluator=kit.Function).indices
    before = (tmp_path / "s" / results.TABLE).read_bytes()
    (tmp_path / "s" / results.INDICES / "ST" / "zarr.json").unlink()
    results.write_indices(tmp_path / "s" / results.INDICES, data.drop_vars(["ST", "ST_interval"]))
    again = run.recompute(tmp_path / "s")
    assert again.drop_attrs().identical(data.drop_attrs())
    assert again.attrs["timings"] == data.attrs["timings"]
    assert results.open_indices(tmp_path / "s").drop_attrs().identical(data.drop_attrs())
    assert (tmp_path / "s" / results.TABLE).read_bytes() == before
    assert (tmp_path / "s" / "report.html").is_file()
    file = tmp_path / "s" / "study.toml"
    file.write_text(file.read_text().replace("n = 16", "n = 32"))
    with pytest.raises(InputError, match=r"table.parquet: its points are not those of .*study.toml"):
        run.recompute(tmp_path / "s")
    with pytest.raises(InputError, match=r"nothing"):
        run.recompute(tmp_path / "nothing")
