"""Studies that rank faults: the factor scene.fault, quantiles over views, and the figure."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import study_kit
import tomli_w
from conftest import small_scene

from vbnfault.core.errors import InputError
from vbnfault.faults import registry
from vbnfault.scene import plan
from vbnfault.study import factors, plots, ranking, report, results, run
from vbnfault.study.evaluate import SceneEvaluator
from vbnfault.study.spec import Evaluation, Metric, StudySpec, load_study, parse_study
from vbnfault.study.summaries import StudyResults

FAULTS = ("dust_on_optics", "broken_lines", "straylight", "cti")
COST = {"dust_on_optics": 1.0, "broken_lines": 3.0, "straylight": 2.0}  # cti never acts
CHOICE = {"key": "scene.fault", "distribution": "categorical", "values": list(FAULTS)}
OF_LIGHT = CHOICE | {"values": ["straylight", "vignetting"]}


def spec(**tables: Any) -> StudySpec:
    plain = {
        "design": {"method": "grid", "n": 1, "resamples": 200},
        "factor": [CHOICE],
        "scene": {"samples": 24},
        "metrics": {"names": ["lost", "kept"]},
    }
    return study_kit.spec(**plain | tables)


class Costs(study_kit.Function):
    """A cost in px that depends on fault and view; straylight acts in every third view."""

    metrics: Sequence[Metric] = (
        Metric(name="lost", unit="px", description="cost"),
        Metric(name="kept", unit="1", description="what is left", better="high"),
    )

    def evaluate(self, evaluation: Evaluation) -> Mapping[str, float]:
        fault = str(evaluation.values["scene.fault"])
        cost = COST.get(fault, np.nan) + 0.1 * np.sin(37.0 * evaluation.view)
        if fault == "straylight" and evaluation.view % 3:
            cost = np.nan
        return {"lost": cost, "kept": 1 - cost / 10}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("ranking") / "study"
    run.study(spec(), path, evaluator=Costs, progress=False)
    return path


def test_faults_are_ranked_by_their_median_over_the_views_in_which_they_act(folder: Path) -> None:
    found = results.open_indices(folder)
    assert list(found["fault"].values) == list(FAULTS)
    for metric in ("lost", "kept"):  # 1 is the worst, whether large values are good or bad
        assert found["fault_rank"].sel(metric=metric).squeeze().values.tolist()[:3] == [3, 1, 2]
    median = found["fault_quantile"].sel(metric="lost", quantile=0.5, model="")
    values = np.asarray(results.read_table(folder).column("lost")).reshape(24, len(FAULTS))
    assert median.values[:3] == pytest.approx(np.nanmedian(values[:, :3], axis=0))
    assert np.isnan(median.sel(fault="cti"))
    assert found["fault_acts"].values.tolist() == [24, 24, 8, 0]
    low, high = (
        found["fault_quantile_interval"].sel(metric="lost", quantile=0.5, bound=b) for b in ("low", "high")
    )
    assert (low.values[0, :3] <= median.values[:3]).all()
    assert (low.values[0, :3] < high.values[0, :3]).all()
    worse = found["fault_worse"].sel(metric="lost", model="")
    assert worse.sel(fault="broken_lines", fault_b="dust_on_optics") == 1  # 3 ± 0.1 against 1 ± 0.1
    assert worse.sel(fault="dust_on_optics", fault_b="broken_lines") == 0
    assert found["S1"].isnull().all()  # no view has a value of every fault


def test_the_figure_shows_the_worst_fault_on_top_and_at_the_right(folder: Path) -> None:
    plain = spec().resolved()
    done = StudyResults(dataset=results.open_indices(folder), table=results.read_table(folder), spec=plain)
    (drawing,) = plots.drawings(done)
    for axes in drawing.figure.axes[:2]:
        labels = [text.get_text() for text in axes.get_yticklabels()]
        assert labels == ["broken_lines (24)", "straylight (8)", "dust_on_optics (24)"]
        dots = [line.get_xdata()[0] for line in axes.lines if line.get_marker() == "o"]
        across = [axes.transData.transform((x, 0))[0] for x in dots]
        assert across == sorted(across, reverse=True)
    text = (folder / report.PAGE).read_text(encoding="utf-8")
    assert "probability that the next is worse" in text
    assert (folder / "plots/ranking.svg").is_file()


def test_equal_faults_swap_with_a_probability_of_a_half() -> None:
    assert ranking._quantiles(np.arange(5.0)[None, None]).ravel().tolist() == [1, 2, 3]
    twice = ranking._quantiles(np.array([[[1.0, 2.0, np.nan], [np.nan] * 3]]))[0]
    assert twice[1, 0] == 1.5  # the median of an even number
    assert np.isnan(twice[:, 1]).all()  # a resample without a view in which the fault acts
    assert ranking._fraction_above(np.arange(5.0), np.arange(5.0)) == 0.5


@pytest.mark.parametrize(
    ("tables", "words"),
    [
        (
            {"factor": [CHOICE | {"values": ["broken_line", "cti"]}]},
            r"'broken_line' is no fault \(did you mean broken_",
        ),
        (
            {"factor": [CHOICE | {"values": ["cti/radation", "adc"]}]},
            r"no model of cti \(did you mean radiation\?\)",
        ),
        ({"factor": [CHOICE | {"values": [1, 2]}]}, "must have distribution = 'categorical', and names of faults"),
        ({"models": {"fault": "straylight", "compare": ["texture", "traced"]}}, r"cannot stand beside \[models\]"),
        ({"metrics": {"names": ["snr"]}, "factor": [OF_LIGHT]}, "'snr' measures the straylight of the scene"),
        ({}, r"scene.fault = 'cti': faults.cti.model = 'radiation': acts inside a detector with a mosaic"),
    ],
)
def test_a_wrong_choice_of_faults_is_named(tables: dict[str, Any], words: str) -> None:
    plain = {"scene": {"base": "quickstart"}, "metrics": {"names": ["centroid_shift_px"]}}
    if "models" in tables:
        plain["scene"] = {"base": "flares"}
    with pytest.raises(InputError, match=words):
        SceneEvaluator(spec(**plain | tables))


def test_a_view_is_rendered_once_for_all_faults_and_a_fault_that_cannot_act_has_no_value(tmp_path: Path) -> None:
    scene = small_scene(
        dataset={"samples": 2, "sites": 1, "layers": ["clean"]},
        camera={"width_px": 64, "height_px": 64},
    )
    scene["faults"] = {"broken_lines": {"model": "texture", "count": [9, 9]}}
    (tmp_path / "scene.toml").write_text(tomli_w.dumps(scene), encoding="utf-8")
    names = ["centroid_shift_px", "matches_lost"]
    values = ["straylight", "broken_lines", "dust_on_optics", "optics_degradation/gaussian"]
    made = SceneEvaluator(
        spec(
            scene={"base": str(tmp_path / "scene.toml"), "samples": [0], "seeds": [5]},
            factor=[CHOICE | {"values": values}],
            metrics={"names": names},
        )
    )
    costs = {
        value: made.evaluate(
            Evaluation(index=k, seed=5, view=0, model="", role="point", values={"scene.fault": value})
        )
        for k, value in enumerate(values)
    }
    assert made.kept.events["render"] == 1
    assert made.kept.events["clean twins"] == 1
    assert all(np.isnan(cost) for cost in costs["straylight"].values())  # the camera looks away from the Sun
    for value in values[1:]:
        assert costs[value]["centroid_shift_px"] > 0, value
    chosen = made.scene_of(5, "", (("fault", "broken_lines"),))
    assert chosen.scene.faults == {"broken_lines": {"model": "texture", "count": [9, 9]}}  # the scene's own bounds
    assert made.scene_of(5, "", ()).scene.faults == {}


def test_a_key_of_any_chosen_fault_is_read(tmp_path: Path) -> None:
    """Neither where the others are nominal nor where they are large does the fault with this key act."""
    scene = small_scene(dataset={"samples": 1, "sites": 1}, camera={"width_px": 64, "height_px": 64})
    (tmp_path / "scene.toml").write_text(tomli_w.dumps(scene), encoding="utf-8")
    values = ["dust_on_optics", "broken_lines", "vignetting"]
    count = {"key": "scene.faults.broken_lines.count", "distribution": "categorical", "values": [1, 9]}
    made = SceneEvaluator(
        spec(
            scene={"base": str(tmp_path / "scene.toml"), "samples": [0], "seeds": [5]},
            factor=[CHOICE | {"values": values}, count],
            metrics={"names": ["centroid_shift_px"]},
        )
    )
    assert made.check() == []


@pytest.mark.parametrize("is_flown", [True, False])
def test_on_a_trajectory_the_sun_alone_decides(is_flown: bool) -> None:
    """Poses of a table or of SPICE have no strata: all count as averted from the Sun."""
    view: Any = SimpleNamespace(
        index=0, scene=SimpleNamespace(is_flown=is_flown), plan=SimpleNamespace(stratum=[plan.SUN_AVERTED])
    )
    pose: Any = SimpleNamespace(sees_sun=True)
    faults: Any = {"straylight": SimpleNamespace(needs_sun=True), "vignetting": SimpleNamespace(needs_sun=False)}
    assert factors.acting_faults(faults, view, pose) == (["straylight"] if is_flown else []) + ["vignetting"]


def test_the_packaged_ranking_names_every_class_that_its_camera_can_have() -> None:
    packaged = load_study("fault_ranking")
    (factor,) = packaged.factors
    default = {name: next(m for m in models.values() if m.default) for name, models in registry().items()}
    able = {
        name for name, m in default.items() if not m.needs_ccd and m.__module__.startswith("vbnfault.")
    }  # plug-ins of other tests apart
    # the first needs an image of one's own, the second has no usual bounds, since densities span six decades, and
    # two need the exposure before, which a still only imitates; of the last, one flipped bit decides everything
    others = {"pixel_overwriting", "particles", "frozen_frame", "persistence", "register_upset"}
    assert {*factor.choices} == able - others
    assert parse_study(packaged.resolved(), source="again") == packaged
