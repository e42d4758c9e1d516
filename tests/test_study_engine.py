"""The engine of sensitivity studies: designs, indices, resuming, failures, and what users may get wrong."""

from __future__ import annotations

import functools
import json
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import study_kit as kit
import xarray
from conftest import Called

import vbnfault
from vbnfault.core.errors import InputError, VbnfaultError
from vbnfault.core.process.interrupts import Interrupted
from vbnfault.dataset import BuildOptions
from vbnfault.study import indices, results, run
from vbnfault.study.designs import make_design
from vbnfault.study.spec import DUMMY, Evaluation, StudySpec, parse_study

QUIET = BuildOptions(progress=False)


# ------------------------------------------------------------------------------------ the whole engine


def test_ishigami_through_the_whole_engine(tmp_path: Path) -> None:
    spec = kit.spec(design={"n": 512, "seed": 3, "resamples": 300})
    data = run.run_study(spec, tmp_path / "s", QUIET, report=False, evaluator=kit.Function).indices
    for name, exact in kit.ANALYTIC_ISHIGAMI.items():
        low, high = data[f"{name}_interval"].sel(metric="y", model="").values.T
        assert np.all(low[:3] <= exact), (name, low)
        assert np.all(exact <= high[:3]), (name, high)
        assert low[3] < 0 < high[3]  # the noise floor
    assert data["S1"].dims == ("metric", "model", "factor")
    assert list(data["factor"].values) == ["x0", "x1", "x2", DUMMY]
    assert float(data["interaction"].sel(factor="x0", factor_b="x2").squeeze()) == pytest.approx(0.2437, abs=0.05)
    assert all({"long_name", "units"} <= variable.attrs.keys() for variable in data.data_vars.values())
    assert results.open_indices(tmp_path / "s").identical(data)
    with xarray.open_zarr(tmp_path / "s" / "indices.zarr") as plain:  # without a warning
        assert plain.load().identical(data)
    table = results.read_table(tmp_path / "s")
    assert table.num_rows == 512 * 5
    assert set(table["status"].to_pylist()) == {"ok"}
    assert table.schema.field("y").metadata[b"units"] == b"1"


def test_the_package_can_be_called_and_has_its_public_names() -> None:
    assert all(getattr(vbnfault.study, name) is not None for name in vbnfault.study.__all__)
    assert vbnfault.study.StudySpec is StudySpec
    with pytest.raises(InputError, match=r"neither a file nor a packaged name; studies"):
        vbnfault.study("nothing")


def test_sobol_indices_without_control_variates_are_those_of_scipy(monkeypatch: pytest.MonkeyPatch) -> None:
    from scipy.stats import sobol_indices

    monkeypatch.setattr(indices, "LEAST_SAMPLES", 2**30)
    spec = kit.spec(design={"n": 256})
    function = kit.Function(spec).function
    data = kit.analysed(spec, function)
    f = function(np.array(make_design(spec).values, dtype=float)).reshape(256, 5).T
    exact = sobol_indices(func={"f_A": f[None, 0], "f_B": f[None, 1], "f_AB": f[2:, None]}, n=256)
    np.testing.assert_allclose(data["S1"].values[0, 0, :3], exact.first_order, atol=1e-12)
    np.testing.assert_allclose(data["ST"].values[0, 0, :3], exact.total_order, atol=1e-12)


def test_morris_is_that_of_salib() -> None:
    from SALib.analyze import morris
    from SALib.sample import morris as sample

    spec = kit.spec(design={"method": "morris", "n": 10, "seed": 5, "resamples": 200})
    data = kit.analysed(spec, kit.Function(spec).function)
    problem = {"num_vars": 4, "names": list("abcd"), "bounds": [[0.0, 1.0]] * 4}
    points = sample.sample(problem, 10, num_levels=4, seed=5)
    y = kit.Function(spec).function(np.pi * (2 * points.T - 1))
    exact = morris.analyze(problem, points, y, num_resamples=200, num_levels=4, seed=5)
    np.testing.assert_allclose(data["mu_star"].values[0, 0], exact["mu_star"], atol=1e-12)
    np.testing.assert_allclose(data["sigma"].values[0, 0], exact["sigma"], atol=1e-12)
    half = np.diff(data["mu_star_interval"].values[0, 0], axis=-1)[:, 0] / 2
    # Student's quantile for 10 trajectories over the normal one, and the spread of 10 values about their mean
    np.testing.assert_allclose(
        half, np.array(exact["mu_star_conf"]) * 2.2622 / 1.9600 * (10 / 9) ** 0.5, rtol=1e-4, atol=1e-12
    )
    assert data["mu_star"].values[0, 0, -1] == 0


def test_a_grid_gives_the_analysis_of_variance() -> None:
    spec = kit.spec(2, -1.0, 1.0, design={"method": "grid", "n": 3})
    data = kit.analysed(spec, lambda x: x[0] + x[0] * x[1])  # variances 2/3 and 4/9 over the levels -1, 0, 1
    np.testing.assert_allclose(data["S1"].values[0, 0], [0.6, 0.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(data["ST"].values[0, 0], [1.0, 0.4, 0.0], atol=1e-12)


def test_one_at_a_time_gives_ranges() -> None:
    spec = kit.spec(2, -1.0, 3.0, design={"method": "one_at_a_time", "n": 3})
    design = make_design(spec)
    assert [list(values) for values in design.values] == [[1, -1, 1, 3, 1, 1, 1], [1, 1, 1, 1, -1, 1, 3]]
    data = kit.analysed(spec, lambda x: 2 * x[0] - x[1])
    np.testing.assert_allclose(data["range"].values[0, 0], [8.0, 4.0, 0.0])


def test_a_latin_hypercube_gives_delta_and_keeps_the_global_random_numbers(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(indices, "_MOST_RESAMPLES_OF_DELTA", 2)
    state = np.random.get_state()[1].copy()  # noqa: NPY002
    spec = kit.spec(2, 0.0, 1.0, design={"method": "latin_hypercube", "n": 128, "resamples": 100})
    plain, steep = (kit.analysed(spec, f)["delta"].values for f in (lambda x: x[0], lambda x: np.exp(40 * x[0])))
    assert plain[0, 0, 0] > 0.5 > plain[0, 0, 1]
    # the densities of the values themselves gave deltas from -4.4 to 1.9 for veils with a few bright ones
    np.testing.assert_array_equal(plain, steep)
    assert ((plain > -0.1) & (plain < 1)).all()
    assert np.array_equal(np.random.get_state()[1], state)  # noqa: NPY002


def test_first_order_indices_of_a_latin_hypercube_and_their_intervals_hold_the_analytic_ones(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The variance between four groups of one resample gave 0.758 for 0.8 and 0.045 for 0, within 0.06."""
    monkeypatch.setattr(indices, "LEAST_SAMPLES_OF_DELTA", 1000)
    truth, hits, found = np.array([0.8, 0.2, 0.0, 0.0]), 0.0, []
    for seed in range(20):
        design = {"method": "latin_hypercube", "n": 128, "resamples": 100, "seed": seed}
        data = kit.analysed(kit.spec(3, 0.0, 1.0, design=design), lambda x: 2 * x[0] + x[1])
        low, high = data["S1_interval"].values[0, 0].T
        hits = hits + ((low <= truth) & (truth <= high))
        found.append(data["S1"].values[0, 0])
    # standard deviations of one seed are 0.02, 0.065, 0.05 and 0.05
    np.testing.assert_array_less(np.abs(np.mean(found, axis=0) - truth), [0.015, 0.05, 0.035, 0.035])
    assert (hits >= 17).all()


def test_first_order_indices_of_a_latin_hypercube_pool_the_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    """Variances of blocks are summed: x0 alone has 9, x1 alone 1, each in a block of its own."""
    study = kit.spec(
        2, 0.0, 1.0, design={"method": "latin_hypercube", "n": 512, "resamples": 100}, scene={"samples": 2}
    )
    design = make_design(study)
    monkeypatch.setattr(indices, "LEAST_SAMPLES_OF_DELTA", 1000)
    x = np.array(design.values, dtype=float)
    values = np.stack([3 * x[0], x[1]])[None, :, :, None, None]
    values[0, 1, :8] = np.nan  # evaluations that failed
    data = indices.compute(indices.Results(design, tuple(kit.Function.metrics[:1]), values))
    np.testing.assert_allclose(data["S1"].values[0, 0, :2], [0.9, 0.1], atol=0.05)


def test_a_latin_hypercube_of_nearly_constant_values_has_no_delta() -> None:
    """One value of 128 differs: some resamples lack it, and a single value has no density."""
    spec = kit.spec(2, 0.0, 1.0, design={"method": "latin_hypercube", "n": 128, "resamples": 100})
    data = kit.analysed(spec, lambda x: (x[0] == x[0].max()).astype(float))
    assert np.isnan(data["delta"].values).all()
    assert np.isfinite(data["S1"].values).all()


def test_the_law_of_total_variance_splits_models_from_factors() -> None:
    spec = kit.spec(design={"n": 64}, models={"fault": "f", "compare": ["a", "b", "c"]})
    design = make_design(spec)
    y = kit.Function(spec).function(np.array(design.values, dtype=float))
    shifted = np.stack([y, y + 3, y - 3], axis=-1)[None, None, ..., None]
    data = indices.compute(indices.Results(design, tuple(kit.Function.metrics[:1]), shifted))
    base = np.array([not role.startswith("AB") for role in design.roles])
    assert float(data["model_share"][0]) == pytest.approx(6 / (6 + y[base].var()), rel=1e-12)
    low, high = data["model_share_interval"].values[0]
    assert low < float(data["model_share"][0]) < high


@pytest.mark.parametrize("n", [1, 2, 4, 8])
def test_intervals_of_few_samples_hold_the_indices(n: int) -> None:
    """Bootstraps of so few samples gave an ST of 1.73 with the interval 1.32 to 2.89."""
    for seed in range(10):
        spec = kit.spec(
            design={"n": n, "seed": seed, "resamples": 100}, models={"fault": "f", "compare": ["a", "b"]}
        )
        y = kit.Function(spec).function(np.array(make_design(spec).values, dtype=float))
        both = np.stack([y, y + 1], axis=-1)[None, None, ..., None]
        data = indices.compute(indices.Results(make_design(spec), tuple(kit.Function.metrics[:1]), both))
        for name, exact in kit.ANALYTIC_ISHIGAMI.items():
            low, high = np.moveaxis(data[f"{name}_interval"].values[0, 0], -1, 0)
            assert (low[:-1] <= exact).all()
            assert (exact <= high[:-1]).all()
            assert low[-1] <= 0 <= high[-1]  # of the dummy factor
            assert ((data[name].values >= low) & (data[name].values <= high)).all()
            assert data[name].max() <= 1
        for name in ("interaction", "model_share", "ST_by_seed", "S1_by_seed"):
            finite = data[name].values[np.isfinite(data[name].values)]
            assert (np.abs(finite) <= 1).all()
        assert data["model_share_interval"].values.tolist() == [[0.0, 1.0]]


@pytest.mark.parametrize("method", ["latin_hypercube", "morris"])
def test_a_missing_library_is_told_before_the_first_evaluation(
    method: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in [name for name in sys.modules if name.partition(".")[0] == "SALib"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "SALib", None)
    spec = kit.spec(design={"method": method, "n": 4})
    with pytest.raises(InputError, match=f"design.method = '{method}': needs SALib; pip install"):
        run.run_study(spec, tmp_path / "s", QUIET, report=False, evaluator=kit.Function)
    assert not (tmp_path / "s").exists()


def test_what_few_points_cannot_tell_is_said(tmp_path: Path) -> None:
    spec = kit.spec(design={"method": "latin_hypercube", "n": 4})
    summary = run.run_study(spec, tmp_path / "s", QUIET, report=False, evaluator=kit.Function)
    assert [sentence.partition(":")[2][:16] for sentence in summary.warnings] == [
        " below n = 16 in",
        " delta needs n =",
    ]


# ------------------------------------------------------------------------------------ resuming and workers


def table_bytes(folder: Path) -> bytes:
    return (folder / results.TABLE).read_bytes()


@pytest.fixture(scope="module")
def spec() -> StudySpec:
    return kit.small_spec()


@pytest.fixture(scope="module")
def reference(spec: StudySpec, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("study") / "s"
    run.run_study(spec, folder, QUIET, report=False, evaluator=kit.Stopping)
    return folder


@pytest.mark.slow
def test_two_workers_of_which_one_is_killed_give_the_same_table(
    spec: StudySpec, reference: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("VBNFAULT_TEST_STOP", f"77 {int(signal.SIGKILL)} {tmp_path / 'once'}")
    options = BuildOptions(workers=2, progress=False)
    summary = run.run_study(spec, tmp_path / "s", options, report=False, evaluator=kit.Stopping)
    assert (tmp_path / "once").exists()
    assert table_bytes(tmp_path / "s") == table_bytes(reference)
    assert summary.indices.drop_attrs().identical(results.open_indices(reference).drop_attrs())
    assert summary.seconds_by_stage["function"] > 0


@pytest.mark.slow
def test_a_study_that_is_killed_continues_to_the_same_table(
    spec: StudySpec, reference: Path, tmp_path: Path
) -> None:
    # evaluation 150 lies within a chunk: what was finished before it in this chunk has not been written yet
    done = subprocess.run(
        [sys.executable, "-c", f"import study_kit; study_kit.of_small_spec({str(tmp_path / 's')!r})"],
        env={
            **os.environ,
            "PYTHONPATH": os.pathsep.join([str(Path(__file__).parents[1]), str(Path(__file__).parent)]),
            "VBNFAULT_TEST_STOP": f"150 {int(signal.SIGKILL)} {tmp_path / 'once'}",
        },
        check=False,
    )
    assert done.returncode == -signal.SIGKILL
    assert not (tmp_path / "s" / results.TABLE).exists()
    summary = run.run_study(spec, tmp_path / "s", QUIET, report=False, evaluator=kit.Stopping)
    assert 140 <= summary.finished <= 150
    assert table_bytes(tmp_path / "s") == table_bytes(reference)


@pytest.mark.parametrize("at", [0, 1, 150, 319])
def test_an_interrupted_study_continues_to_the_same_table(
    spec: StudySpec, reference: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, at: int
) -> None:
    monkeypatch.setenv("VBNFAULT_TEST_STOP", f"{at} {int(signal.SIGTERM)} {tmp_path / 'once'}")
    with pytest.raises(Interrupted, match=rf"{at} of 320 evaluations are finished, and the same command continues"):
        run.run_study(spec, tmp_path / "s", QUIET, report=False, evaluator=kit.Stopping)
    assert not (tmp_path / "s" / results.TABLE).exists()
    summary = run.run_study(spec, tmp_path / "s", QUIET, report=False, evaluator=kit.Stopping)
    assert summary.finished == at
    # of both runs together, which finished each evaluation once; an evaluation counts as 1 ms, however long it took
    assert summary.seconds_by_stage["function"] == pytest.approx(0.32, abs=2e-3)
    assert table_bytes(tmp_path / "s") == table_bytes(reference)


def test_a_complete_study_evaluates_nothing_again(spec: StudySpec, reference: Path) -> None:
    before = table_bytes(reference)
    (reference / "rows" / ".0000001.json.0.partial").touch()
    summary = run.run_study(spec, reference, QUIET, report=False, evaluator=kit.Stopping)
    assert summary.finished == 320
    assert summary.seconds_by_stage == {"function": pytest.approx(0.32)}  # those of the run that evaluated
    assert table_bytes(reference) == before
    assert not list((reference / "rows").glob(".*"))


@pytest.mark.parametrize("value", [1.25, None, "x", [1, 2]])
def test_a_damaged_row_is_computed_again(
    value: Any, reference: Path, tmp_path: Path, spec: StudySpec, capfd: pytest.CaptureFixture[str]
) -> None:
    folder = shutil.copytree(reference, tmp_path / "s")
    file = folder / "rows" / "0000001.json"
    record = json.loads(file.read_text())
    number = next(iter(record))
    record[number]["values"]["y"] = value
    file.write_text(json.dumps(record))
    summary = run.run_study(spec, folder, BuildOptions(), report=False, evaluator=kit.Stopping)
    assert summary.finished == 320 - (len(record) - 2)  # without the seconds and the checksum
    assert "0000001.json: damaged; its evaluations are made again" in capfd.readouterr().err
    assert table_bytes(folder) == table_bytes(reference)


def test_a_damaged_table_is_not_recomputed_from(reference: Path, tmp_path: Path) -> None:
    folder = shutil.copytree(reference, tmp_path / "s")
    content = bytearray(table_bytes(folder))
    content[len(content) // 2] ^= 1
    (folder / results.TABLE).write_bytes(content)
    with pytest.raises(InputError, match=rf"{results.TABLE}: damaged .*; the command of the study writes it again"):
        run.recompute(folder)


# ------------------------------------------------------------------------------------ failures


class Failing(kit.Function):
    """Fail at some evaluations; `worse` fails always."""

    def __init__(self, study: StudySpec, wrong: tuple[int, ...] = (7, 8, 50)) -> None:
        super().__init__(study)
        self.wrong = wrong

    def evaluate(self, evaluation: Evaluation) -> Mapping[str, float]:
        if not self.wrong or evaluation.index in self.wrong:
            raise RuntimeError(f"no image\nat {evaluation.index}")
        return super().evaluate(evaluation)


def test_evaluations_that_fail_are_marked_and_the_rest_goes_on(tmp_path: Path) -> None:
    spec = kit.spec(design={"n": 64, "resamples": 100})
    with pytest.raises(
        vbnfault.study.StudyFailed, match=r"3 evaluations \(7, 8, 50\) of 320 failed, .*no image at 7"
    ) as error:
        run.run_study(spec, tmp_path / "s", QUIET, report=False, evaluator=Failing)
    table = results.read_table(tmp_path / "s").to_pylist()
    assert [row["evaluation"] for row in table if row["status"] == "failed"] == [7, 8, 50]
    assert table[7]["error"].startswith("RuntimeError: no image at 7 (test_study_engine.py:")
    assert np.isnan(table[7]["y"])
    data = error.value.indices
    assert float(data["samples_left_out"].squeeze()) == 2  # base samples 1 and 10
    assert float(data["samples_used"].squeeze()) == 62
    whole = vbnfault.study(spec, evaluator=kit.Function, progress=False)
    assert abs(data["ST"] - whole["ST"]).max() < 0.1
    # the same study tries the failed ones again
    function = functools.partial(Failing, wrong=(50,))
    with pytest.raises(vbnfault.study.StudyFailed, match=r"evaluation 50 of 320 failed"):
        run.run_study(spec, tmp_path / "s", QUIET, report=False, evaluator=function)


def test_a_study_whose_evaluations_all_fail_is_stopped(tmp_path: Path) -> None:
    with pytest.raises(
        vbnfault.study.StudyFailed, match=r"32 evaluations .* before any succeeded, so the study was stopped"
    ):
        run.run_study(
            kit.spec(), tmp_path / "s", QUIET, report=False, evaluator=functools.partial(Failing, wrong=())
        )


class Forgetful(kit.Function):
    """Leave the metric out."""

    def evaluate(self, evaluation: Evaluation) -> Mapping[str, float]:
        return {}


def test_a_metric_without_a_value_is_named(tmp_path: Path) -> None:
    with pytest.raises(vbnfault.study.StudyFailed, match=r"the evaluator gives no value for y, of metrics\.names"):
        run.run_study(kit.spec(), tmp_path / "s", QUIET, report=False, evaluator=Forgetful)


def test_incomplete_blocks_count_where_they_are_complete() -> None:
    spec = kit.spec(2, 0.0, 1.0, design={"n": 128}, scene={"samples": 2})
    design = make_design(spec)
    x = np.array(design.values, dtype=float)
    y = np.stack([x[0] + x[1], np.full(len(x[0]), np.nan)])[None, ..., None, None]
    data = indices.compute(indices.Results(design, tuple(kit.Function.metrics[:1]), y))
    alone = kit.analysed(kit.spec(2, 0.0, 1.0, design={"n": 128}), lambda x: x[0] + x[1])
    np.testing.assert_allclose(data["ST"].values, alone["ST"].values, atol=1e-12)
    constant = kit.analysed(kit.spec(2, 0.0, 1.0, design={"n": 8}), lambda x: np.ones_like(x[0]))
    assert np.isnan(constant["ST"].values[..., :2]).all()


# ------------------------------------------------------------------------------------ bad input


FACTOR = {"key": "a", "distribution": "uniform", "low": 0.0, "high": 1.0}


@pytest.mark.parametrize(
    ("tables", "sentence"),
    [
        ({"factor": [FACTOR | {"low": 3.0}]}, r"factor\[0\].low = 3, high = 1: bounds reversed"),
        ({"factor": [FACTOR, FACTOR]}, r"factor\[1\].key = 'a': the key is given twice"),
        ({"factor": [FACTOR | {"key": DUMMY}]}, r"factor\[0\].key = 'dummy': this factor is always added"),
        ({"factor": [FACTOR | {"distribution": "normal"}]}, r"distribution = 'normal': must be one of"),
        ({"factor": [FACTOR | {"hihg": 2.0}]}, r"factor\[0\].hihg: unknown key \(did you mean high\?\)"),
        (
            {"factor": [{"key": "a", "distribution": "log_uniform", "low": 0.0, "high": 1.0}]},
            r"low = 0.*above 0",
        ),
        (
            {"factor": [FACTOR | {"distribution": "truncated_normal", "mean": 2.0, "deviation": 1.0}]},
            r"factor\[0\].mean = 2: must be from low = 0 to high = 1",
        ),
        (
            {"factor": [FACTOR | {"distribution": "truncated_normal", "mean": 0.5, "deviation": 1e9}]},
            r"factor\[0\].deviation = 1e\+09: must be at most 1e\+06",
        ),
        ({"factor": [{"key": "a", "distribution": "categorical", "values": ["x", "x"]}]}, r"'x' is given twice"),
        ({"metrics": {"names": []}}, r"metrics.names = \[\]: must be a list of at least 1"),
        ({"metrics": {}}, r"metrics.names: is missing"),
        ({"design": {"n": 100}}, r"design.n = 100: must be a power of two .* such as 64 or 128"),
        ({"design": {"n": 8, "method": "morris", "half_width": 0.1}}, r"half_width = 0.1: needs method = 'sobol'"),
        ({"scene": {"seeds": [1, 1]}}, r"scene.seeds = \[1, 1\]: 1 is given twice"),
        ({"models": {"fault": "f", "compare": ["a"]}}, r"models.compare = \['a'\]: must be a list of at least 2"),
    ],
)
def test_a_wrong_study_file_is_refused(tables: dict[str, Any], sentence: str) -> None:
    with pytest.raises(InputError, match=sentence):
        kit.spec(**tables)


def test_too_few_samples_say_how_many_are_needed(tmp_path: Path) -> None:
    assert kit.spec(design={"n": 8, "half_width": 0}).design.half_width is None  # 0 asks for none
    spec = kit.spec(design={"n": 8, "half_width": 0.05})
    with pytest.raises(InputError, match=r"design.n = 8: too few .*half_width = 0.05, which needs at least n = 16"):
        run.run_study(spec, tmp_path / "s", QUIET, report=False, evaluator=kit.Function)
    assert not (tmp_path / "s").exists()
    spec = kit.spec(design={"n": 32, "half_width": 0.1, "resamples": 200})
    summary = run.run_study(spec, tmp_path / "s", QUIET, report=False, evaluator=kit.Function)
    (sentence,) = summary.warnings
    assert "the total index of x0 has a half-width of 0." in sentence
    assert "at most about design.n = " in sentence


def test_unknown_metrics_and_columns_of_one_name_are_refused(tmp_path: Path) -> None:
    for tables, sentence in (
        ({"metrics": {"names": ["yy"]}}, r"unknown metric 'yy'"),
        ({"factor": [FACTOR | {"key": "y"}]}, r"'y': the table of the study has another column of this name"),
        ({"factor": [FACTOR | {"key": "role"}]}, r"'role': the table"),
    ):
        with pytest.raises(InputError, match=sentence):
            run.run_study(kit.spec(**tables), tmp_path / "s", QUIET, report=False, evaluator=kit.Function)


def test_a_folder_that_holds_something_else_is_left_alone(tmp_path: Path) -> None:
    """What a study leaves that was killed as it began is no hindrance."""
    folder = tmp_path / "s"
    (folder / "rows").mkdir(parents=True)
    for name in ("study.toml", ".identity.json.1.partial", "rows/.0.1.partial"):
        (folder / name).touch()
    (folder / "photos").mkdir()
    with pytest.raises(InputError, match=r"s: holds something else than a study of vbnfault, so it is left alone"):
        run.run_study(kit.spec(), folder, QUIET, report=False, evaluator=kit.Function)
    assert len(list(folder.rglob("*"))) == 5
    (folder / "photos").rmdir()
    run.run_study(kit.spec(), folder, QUIET, report=False, evaluator=kit.Function)
    assert (folder / "identity.json").exists()


def test_a_folder_of_another_study_is_refused(spec: StudySpec, reference: Path) -> None:
    other = spec.model_copy(update={"design": spec.design.model_copy(update={"n": 64})})
    with pytest.raises(InputError, match=r"holds another study: design.n is 32 there and 64 here; choose another"):
        run.run_study(other, reference, QUIET, report=False, evaluator=kit.Stopping)
    with pytest.raises(InputError, match=r"evaluator is 'study_kit.Stopping' there and 'study_kit.Function' here"):
        run.run_study(spec, reference, QUIET, report=False, evaluator=kit.Function)


def test_a_folder_that_cannot_be_written_is_refused(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    cases = (
        (tmp_path / "file" / "s", r"file.*(cannot be|can be) (created|written)"),
        (tmp_path / "file", "file: is a file, not a folder; choose another --out"),
    )
    for out, sentence in cases:
        with pytest.raises(VbnfaultError, match=sentence):
            run.run_study(kit.spec(), out, QUIET, report=False, evaluator=kit.Function)


def test_a_resolved_study_file_is_read_again(reference: Path, spec: StudySpec) -> None:
    from vbnfault.study.spec import load_study

    assert load_study(reference / "study.toml") == spec
    changed = load_study(reference / "study.toml", {"design.n": 8, "scene.camera.width_px": 128})
    assert (changed.design.n, changed.scene.overrides) == (8, {"camera.width_px": 128})
    assert json.loads((reference / "identity.json").read_text())["study"]["title"] == "test"


# ------------------------------------------------------------------------------------ distributions


def test_distributions_go_to_values_and_back() -> None:
    table = [
        FACTOR | {"low": -2.0, "high": 6.0},
        {"key": "b", "distribution": "log_uniform", "low": 0.01, "high": 100.0},
        {"key": "c", "distribution": "truncated_normal", "mean": 1.0, "deviation": 2.0, "low": 0.0, "high": 9.0},
        {"key": "d", "distribution": "categorical", "values": ["x", 2.5, "z"]},
    ]
    spec = parse_study(
        {"title": "t", "design": {"n": 1}, "factor": table, "metrics": {"names": ["y"]}}, source="test"
    )
    u = np.linspace(0.0, 1.0, 7)
    for factor in spec.factors[:3]:
        values = factor.values(u)
        np.testing.assert_allclose(values[[0, -1]], [factor.low, factor.high], rtol=1e-12)
        assert (np.diff(values) > 0).all()
        assert values.min() >= factor.low
        assert values.max() <= factor.high
    uniform, logarithmic, normal, categorical = spec.factors
    assert uniform.values(0.5) == 2.0
    assert logarithmic.values(0.5) == pytest.approx(1.0)
    assert normal.values(normal.nominal()) == pytest.approx(1.0)
    assert list(categorical.values([0.0, 0.34, 0.99, 1.0])) == ["x", 2.5, "z", "z"]
    np.testing.assert_allclose(categorical.points(), [1 / 6, 0.5, 5 / 6])


# --- the command --------------------------------------------------------------------------------------------------


def test_a_dry_run_says_how_much_a_study_evaluates_and_writes_nothing(
    tmp_path: Path, call: Callable[..., Called]
) -> None:
    out = tmp_path / "out"
    code, said, errors = call("study", "flare_textures", "--out", out, "--dry-run", "--set", "design.n=8")
    assert (code, errors, out.exists()) == (0, "", False)
    lines = said.splitlines()
    assert lines[1] == ("latin_hypercube, n = 8: 8 points × 20 views × 1 seed × 3 models = 480 evaluations")
    assert lines[2].startswith("factors: sun.distance_au (au), ")
    assert "straylight_total_e (electrons), " in lines[3]
    assert lines[4].startswith("warning: design.n = 8: below n = 16 ")


@pytest.mark.parametrize(
    ("setting", "sentence"),
    [
        ("design.n=9", "design.n = 9: must be a power of two with method = 'sobol', such as 8 or"),
        ("desing.n=8", "desing: unknown key (did you mean design?)"),
        ("factor[4].high=-0.5", "factor[4].low = -0.03, high = -0.5: bounds reversed or equal"),
        ("factor.4.key=lens.coating.thicknes", "did you mean lens.coating.thickness?"),
        ("factor[15].low=1", "factor[15].low = 1: factor is a list; its entries are 0 to 14"),
        ("metrics.names[0]=straylight_total", "did you mean straylight_total_e?"),
        ("scene.samples=[999]", "scene.samples: sample 999: must be below dataset.samples = "),
        ("scene.plan.sun_facing_nominal_fraction=1.0", "plan.sun_facing_nominal_fraction"),
    ],
)
def test_what_is_wrong_is_one_sentence(
    setting: str, sentence: str, tmp_path: Path, call: Callable[..., Called]
) -> None:
    words = ("study", "flare_lens", "--out", tmp_path / "out", "--dry-run", "--set", setting)
    code, said, errors = call(*words)
    assert (code, said) == (2, "")
    (line,) = errors.splitlines()
    assert sentence in line
