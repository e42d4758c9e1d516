"""Levels of severity: what scenes read, and how they are searched."""

from __future__ import annotations

import itertools
import json
import math
import shlex
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from conftest import Called
from test_faults_kit import make_context, with_mosaic

import vbnfault
from vbnfault.cli.options import overrides as read_overrides
from vbnfault.core.errors import InputError, VbnfaultError
from vbnfault.core.registry import DeclarationError, undoing_registrations
from vbnfault.dataset.progress import Progress
from vbnfault.detect.severity_labels import severity_level
from vbnfault.faults import Fault, Levels, Severity, from_dict, number, read_table, registry
from vbnfault.lens.thin import cos4_map
from vbnfault.study import severity, severity_views
from vbnfault.study.severity import Criterion, levels_of
from vbnfault.study.severity_views import ModelUnderTest, SeverityJob, ViewGroup, ViewWorker, measure

PAPER = {
    "dust_on_optics/gaussian",
    "broken_pixels/texture",
    "broken_lines/texture",
    "straylight/texture",
    "vignetting/cos4",
    "optics_degradation/gaussian",
}
NAN = float("nan")


def table_file(folder: Path, **changes: Any) -> Path:
    """Write a table of levels with those of broken lines, at 256 px, and of cosmic rays, which reach two."""
    common: dict[str, Any] = {"intervals": [[0.1, 0.9]] * 5, "errors": [0.2, 0.35, 0.5, 0.65, 0.8], "views": 9}
    table = {
        "metric": "matches_lost",
        "quantile": 0.5,
        "errors": [0.2, 0.35, 0.5, 0.65, 0.8],
        "scene": "quickstart",
        "lenses": [""],
        "width_px": 256,
        "levels": {
            "broken_lines": {
                "texture": {
                    "key": "count",
                    "values": [1.0, 1.4, 2.0, 4.0, 9.0],
                    "reach": [0.1, 1.0],
                    "detector": "",
                    **common,
                }
            },
            "cosmic_rays": {
                "tracks": {
                    "key": "flux_per_cm2_s",
                    "values": [NAN, 500.0, 2000.0, NAN, NAN],
                    "reach": [0.3, 0.52],
                    "detector": "generic_ccd",
                    **common,
                }
            },
        },
        **changes,
    }
    path = folder / "levels.toml"
    path.write_text(severity.toml_files.toml_text(table), encoding="utf-8")
    return path


# --- scenes -------------------------------------------------------------------------------------------------------


def test_the_packaged_levels_fit_the_models_and_cost_the_same() -> None:
    table = Levels().table
    names = {f"{fault}/{model}" for fault, models in table.levels.items() for model in models}
    assert names >= PAPER
    for fault, models in table.levels.items():
        for model, levels in models.items():
            declared = registry()[fault][model].severity
            assert declared is not None
            assert levels.key == declared.key
            values = np.array(levels.values)
            reached = np.isfinite(values)
            assert (np.diff(values[reached]) * np.sign(declared.high - declared.low) > 0).all(), (fault, model)
            assert np.array(levels.errors)[reached] == pytest.approx(np.array(table.errors)[reached], rel=0.1)
            for k in np.flatnonzero(reached):
                assert levels.intervals[k][0] <= levels.errors[k] <= levels.intervals[k][1]
            if f"{fault}/{model}" in PAPER:
                assert reached.all(), (fault, model)


def test_a_scene_names_a_level() -> None:
    levels = Levels().table.levels["dust_on_optics"]["gaussian"]
    scene = vbnfault.load_scene("quickstart", {"faults.dust_on_optics.severity": 3})
    count = scene.faults["dust_on_optics"]["count"]
    # quickstart has 512 px, the table 256 px
    assert np.mean(count) == pytest.approx(levels.values[2] * 2**0.5, abs=0.26)
    fault = from_dict("vignetting", {"severity": 5}, source="s")
    low = Levels().table.levels["vignetting"]["cos4"].values[4]
    assert fault == from_dict("vignetting", {"frame_illuminance_dn": low}, source="s")


def test_a_level_holds_further_keys_that_the_scene_does_not_set() -> None:
    levels = Levels().table.levels["straylight"]["texture"]
    found = vbnfault.load_scene("quickstart", {"faults.straylight.severity": 2}).faults["straylight"]
    assert found["radius"] == [0.3, 0.6]
    assert found["brightness"] == levels.values[1]
    kept = vbnfault.load_scene("quickstart", {"faults.straylight": {"severity": 2, "radius": 0.1}})
    assert kept.faults["straylight"]["radius"] == 0.1
    under_test = ModelUnderTest(fault="straylight", model="texture", keys={})
    assert vars(under_test.at(1.0)[0])["radius"].hi == 0.6


def test_a_level_means_the_same_in_frames_of_all_widths(tmp_path: Path) -> None:
    path = table_file(tmp_path)

    def lines(width_px: int, level: int) -> Any:
        values = {"camera.width_px": width_px, "severity.file": str(path), "faults.broken_lines.severity": level}
        return vbnfault.load_scene("quickstart", values).faults["broken_lines"]["count"]

    # 9 (width / 256)^0.3 lines: 9, 11.08 and 13.64
    assert [lines(width_px, 5) for width_px in (256, 512, 1024)] == [9, 11, [13, 14]]
    assert lines(256, 2) == [1, 2]  # 1.4 lines, which is nearest to 1.5
    assert lines(1024, 2) == 2


def test_a_scene_names_its_own_table(tmp_path: Path) -> None:
    table_file(tmp_path)
    path = tmp_path / "scene.toml"
    path.write_text('title = "t"\n[severity]\nfile = "levels.toml"\n[faults.broken_lines]\nseverity = 5\n')
    scene = vbnfault.load_scene(path)
    assert scene.faults["broken_lines"]["count"] == [13, 14]
    # the value is part of the scene's identity, not the level, the file or its place
    assert "severity" not in scene.resolved()
    assert vbnfault.load_scene("paper67p", {"title": "t"}).resolved().keys() == scene.resolved().keys()
    other = vbnfault.scene.config.parse_scene(scene.resolved(), source="stored")
    assert other == scene


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"width_px": 8}, "width_px = 8: must be a whole number from 16 to 16384"),
        ({"levels": {"broken_lines": {"texture": {"key": "count"}}}}, "levels.broken_lines.texture.values"),
    ],
)
def test_a_wrong_table_is_named(tmp_path: Path, changes: dict[str, Any], message: str) -> None:
    path = table_file(tmp_path, **changes)
    with pytest.raises(InputError) as error:
        vbnfault.load_scene("quickstart", {"severity.file": str(path)})
    assert f"severity.file: {path}: {message}" in str(error.value)
    assert "\n" not in str(error.value)


def test_a_missing_table_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"severity.file: .*none.toml: severity table file not found"):
        vbnfault.load_scene("quickstart", {"severity.file": str(tmp_path / "none.toml")})
    with pytest.raises(InputError, match=r"severity\.file: is missing"):
        vbnfault.load_scene("quickstart", {"severity": {}})


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ({"severity": 6}, "faults.vignetting.severity = 6: must be a whole number from 1 to 5"),
        ({"severity": "high"}, "faults.vignetting.severity = 'high': must be"),
        (
            {"severity": 2, "frame_illuminance_dn": 100},
            "faults.vignetting.severity = 2: sets frame_illuminance_dn, which is given, too; leave one out",
        ),
    ],
)
def test_a_wrong_level_is_named(table: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError) as error:
        vbnfault.load_scene("quickstart", {"faults.vignetting": table})
    assert message in str(error.value)
    with pytest.raises(InputError, match=r"must|leave one out"):
        from_dict("vignetting", table, source="s")


@pytest.mark.parametrize("value", [float("inf"), -5.0, 0.0, 1e308])
@pytest.mark.parametrize("fault", ["broken_lines", "cosmic_rays"])  # a whole number, and any number
def test_a_value_of_a_level_that_no_key_can_have_is_named(tmp_path: Path, fault: str, value: float) -> None:
    path = table_file(tmp_path)
    path.write_text(path.read_text().replace(" 2.0,", f" {value},").replace("2000.0", str(value)))
    with pytest.raises(
        InputError, match=rf"{fault}\.severity = 3: .*levels.toml has .* there: must be a number above"
    ):
        vbnfault.load_scene("quickstart", {"severity.file": str(path), f"faults.{fault}": {"severity": 3}})


def test_a_level_that_does_not_exist_is_named(tmp_path: Path) -> None:
    def loaded(fault: str, table: dict[str, Any], **changes: Any) -> Any:
        values = {"severity.file": str(table_file(tmp_path, **changes)), f"faults.{fault}": table}
        return vbnfault.load_scene("quickstart", values | {"camera.detector": "generic_cmos"})

    reach = (
        r"faults.cosmic_rays.severity = 5: needs matches_lost = 0.8, but flux_per_cm2_s of the model tracks gives "
        r"0.3 to 0.52; it has the levels 2, 3$"
    )
    with pytest.raises(InputError, match=reach):
        loaded("cosmic_rays", {"severity": 5})
    assert loaded("cosmic_rays", {"severity": 3}).faults["cosmic_rays"] == {"flux_per_cm2_s": 2000.0}
    with pytest.raises(InputError, match=r"levels.toml has no levels of vignetting/lens; vbnfault severity comp"):
        loaded("vignetting", {"model": "lens", "severity": 1})
    wrong = read_table(table_file(tmp_path)).model_dump()["levels"]
    wrong["broken_lines"]["texture"]["key"] = "white_count"
    with pytest.raises(
        InputError, match="has levels of white_count, but the model texture becomes more severe by c"
    ):
        loaded("broken_lines", {"severity": 1}, levels=wrong)
    with pytest.raises(InputError, match="the model texture has no levels of severity; leave the key out"):
        from_dict("pixel_overwriting", {"severity": 1}, source="s")


# --- the declaration ----------------------------------------------------------------------------------------------


def test_severities_are_spaced_in_their_logarithm() -> None:
    rising, falling = Severity(key="a", low=1, high=10_000), Severity(key="a", low=255.0, high=2.55)
    assert [rising.value(p) for p in (0, 0.25, 0.5, 1)] == pytest.approx([1, 10, 100, 10_000])
    assert [falling.value(p) for p in (0, 0.5, 1)] == pytest.approx([255, 25.5, 2.55])
    assert [falling.position(value) for value in (255, 25.5, 2.55)] == pytest.approx([0, 0.5, 1])


@pytest.mark.parametrize(
    ("value", "step", "setting"),
    [(0.2, 1, 1), (1.2, 1, 1), (1.3, 1, [1, 2]), (4.8, 1, 5), (4.6, 1, [4, 5]), (9.4, 2, 9), (10.1, 2, [9, 11])],
)
def test_whole_numbers_take_halves_of_a_step(value: float, step: int, setting: Any) -> None:
    declared = {"kind": "bounds", "integer": True, "limits": (0, 100)}
    assert Severity(key="a", low=1, high=9, step=step).setting(value, declared) == setting
    assert isinstance(Severity(key="a", low=1, high=9).setting(value, {**declared, "kind": "number"}), int)
    assert Severity(key="a", low=1, high=9).setting(value, {**declared, "integer": False}) == value


def test_values_of_other_widths_are_similar() -> None:
    filter_size = registry()["optics_degradation"]["gaussian"].severity
    assert filter_size is not None
    # σ in px is 0.15 (size + 7/3) width / 1024, and rises with width^0.4
    sizes = [filter_size.at_width(9.0, width_px) for width_px in (256, 1024, 4096)]
    widths = np.array([256, 1024, 4096]) / 1024
    assert 0.15 * (np.array(sizes) + 7 / 3) * widths == pytest.approx(1.7 * widths**0.4)
    assert filter_size.position(filter_size.value(0.3, 256), 256) == pytest.approx(0.3)


@pytest.mark.parametrize("fov_deg", [30.0, 65.0])
def test_illuminance_of_the_frame_does_not_depend_on_the_field(fov_deg: float) -> None:
    here = make_context(128, fov_deg=fov_deg)
    fault = from_dict("vignetting", {"frame_illuminance_dn": 80}, source="s")
    factor = fault.soft(fault.draw(here, np.random.default_rng(1)), here)
    assert factor.mean(dtype=np.float64) == pytest.approx(80 / 255, rel=1e-5)
    assert (np.diff(factor[factor.shape[0] // 2, : factor.shape[1] // 2]) >= 0).all()
    weak = from_dict("vignetting", {"frame_illuminance_dn": 255}, source="s")
    assert weak.draw(here, np.random.default_rng(1))["on_axis_illuminance_dn"] == 255
    assert cos4_map(here.shape, here.camera.focal_length_px).mean() < 1


@pytest.mark.parametrize(
    ("declared", "message"),
    [
        (Severity(key="nothing", low=1.0, high=2.0), "its severity names 'nothing', no number of it"),
        (Severity(key="amount", low=1.0, high=11.0), "must be above 0 and within the limits"),
        (Severity(key="amount", low=0.0, high=2.0), "must be above 0 and within the limits"),
        (Severity(key="amount", low=1.0, high=2.0, keys={"none": 1}), "its severity holds 'none', no key of it"),
    ],
)
def test_a_wrong_declaration_is_refused(declared: Severity, message: str) -> None:
    with undoing_registrations(always=True):

        @dataclass(frozen=True, kw_only=True)
        class Wrong(Fault):
            fault = "vignetting"
            model = "wrong"
            step = "electrons"
            severity = declared
            amount: float = number(1.0, limits=(0, 10), doc="a number")

        with pytest.raises(DeclarationError, match=message):
            registry()


# --- the search ---------------------------------------------------------------------------------------------------

DUST = ModelUnderTest(fault="dust_on_optics", model="gaussian", keys={})


def curve(scale: float, least: float = 0.0) -> Callable[[Any], float]:
    """Return an error that rises with the number of grains, by half of 0.9 at 100 · scale of them."""
    return lambda fault: max(least, 0.9 * np.mean(fault.count) / (np.mean(fault.count) + 100 * scale))


def measured(*functions: Callable[[Any], float]) -> list[list[tuple[float, float]]]:
    return [measure(DUST, 1024, function) for function in functions]


@pytest.mark.parametrize("scale", [0.1, 1.0, 4.0])
def test_levels_are_roots_of_the_quantile(scale: float) -> None:
    views = measured(*(curve(scale * factor) for factor in (0.5, 0.8, 1.0, 1.3, 3.0)))
    levels = levels_of(DUST, views, Criterion(), 1024)
    values = np.array(levels.values)
    assert 0.9 * values / (values + 100 * scale) == pytest.approx(np.array(Criterion().errors), rel=0.05)
    assert levels.errors == pytest.approx(Criterion().errors, rel=0.1)
    assert all(low < error < high for (low, high), error in zip(levels.intervals, levels.errors, strict=True))
    assert levels.views == 5
    other = levels_of(DUST, views, Criterion(quantile=0.0), 1024)  # of the view with the least error
    assert np.divide(other.values, levels.values)[:4] == pytest.approx(np.full(4, 3), rel=0.12)


def test_a_model_is_evaluated_at_the_same_values_on_every_view() -> None:
    calls: list[Any] = []

    def steep(fault: Any) -> float:
        calls.append(fault.count)
        return float(np.mean(fault.count) > 300)

    (values,) = measured(steep)
    assert len(calls) == len(values) == 21 == len(dict(values))  # no value is evaluated twice
    assert [value for value, _ in values] == [value for value, _ in measured(curve(1.0))[0]]
    given = ModelUnderTest(fault="dust_on_optics", model="gaussian", keys={"peak_dn": 150}, values=(10.0, 20.5))
    assert [value for value, _ in measure(given, 1024, lambda fault: float(fault.peak_dn.lo))] == [10, 20.5]
    # few whole numbers lie between one line and three
    lines = ModelUnderTest(fault="broken_lines", model="texture", keys={})
    counts = [value for value, _ in measure(lines, 64, lambda fault: float(np.mean(fault.count)))]
    assert counts == sorted(set(counts))
    assert len(counts) < 21


def test_levels_are_those_of_steps_too() -> None:
    """On each view the error jumps, once: its quantile over many views rises smoothly all the same.

    Joining the evaluations of each view first would even out the jumps, and with them the levels.
    """
    rng = np.random.default_rng(3)
    jumps = 60.0 * np.exp(rng.normal(size=400))  # number of grains at which half of the matches are lost
    heights = rng.uniform(size=400)
    views = measured(
        *(
            lambda fault, jump=jump, height=height: 0.6 * height * (np.mean(fault.count) > jump)
            for jump, height in zip(jumps, heights, strict=True)
        )
    )
    criterion = Criterion(quantile=0.8, errors=(0.2, 0.25, 0.3, 0.35, 0.4))
    levels = levels_of(DUST, views, criterion, 1024)
    for value, wanted in zip(levels.values, criterion.errors, strict=True):
        if not math.isnan(value):
            exact = np.quantile(0.6 * heights * (value > jumps), 0.8)
            assert exact == pytest.approx(wanted, rel=0.1)
    assert np.isfinite(levels.values).sum() >= 4


def test_levels_end_where_the_model_does_not_reach_them() -> None:
    # at 3000 grains 0.9 · 3000 / 5000 = 0.54
    levels = levels_of(DUST, measured(curve(20)), Criterion(), 1024)
    assert np.isnan(levels.values).tolist() == [False, False, False, True, True]
    assert levels.reach == pytest.approx((0.0, 0.54), abs=0.01)
    steep = levels_of(DUST, measured(curve(20, least=0.4)), Criterion(), 1024)
    assert np.isnan(steep.values).tolist() == [True, False, False, True, True]
    with pytest.raises(VbnfaultError, match="dust_on_optics/gaussian: matches_lost has no value on any view"):
        levels_of(DUST, measured(lambda fault: NAN), Criterion(), 1024)


def test_intervals_hold_the_truth_at_their_rate() -> None:
    rng = np.random.default_rng(5)
    drawn = (severity.RisingCurve.over([{0.5: error} for error in rng.uniform(size=40)], 0.5) for _ in range(200))
    held = sum(low <= 0.5 <= high for low, high in (curve.interval(0.5) for curve in drawn if curve is not None))
    # 95 % of 200 with a standard deviation of 3; the percentile bootstrap of a median of 40 holds 93 to 95 %
    assert 176 <= held <= 198


def test_a_rising_curve_evens_out_noise() -> None:
    by_view = [{0.0: 0.1, 0.2: 0.4, 0.3: 0.2, 0.8: 0.7, 1.0: NAN}, {}, {0.2: NAN, 0.3: 0.2}]
    rising = severity.RisingCurve.over(by_view, 0.5)
    assert rising is not None
    assert rising.errors.shape == (2, 4)  # the view and the position without a value are left out
    # 0.4 and 0.2 in the wrong order count as their mean
    assert rising.at(np.array([0, 0.2, 0.3, 0.55, 0.8, 0.9])) == pytest.approx([0.1, 0.3, 0.3, 0.5, 0.7, 0.7])
    assert rising.interval(0.55) == pytest.approx((0.45, 0.45))  # of two views with the same errors
    assert severity.RisingCurve.over([{0.5: NAN}], 0.5) is None
    single = severity.RisingCurve.over([{0.5: 0.25}], 0.5)
    assert single is not None
    assert single.at(np.array([0.0, 1.0])) == pytest.approx([0.25, 0.25])
    assert single.interval(0.7) == pytest.approx((0.25, 0.25))


def test_a_criterion_is_checked() -> None:
    with pytest.raises(InputError, match="metric = 'orb_repeatability': must be one of limb_error_px"):
        Criterion(metric="orb_repeatability")
    with pytest.raises(InputError, match="quantile = 2: must be from 0 to 1"):
        Criterion(quantile=2)
    for errors in ((0.1, 0.2, 0.2, 0.3, 0.4), (0.1, 0.2, 0.3, 0.4, math.inf), (-5.0, 0.2, 0.3, 0.4, 0.5)):
        with pytest.raises(InputError, match="must be 5 rising, finite numbers above 0"):
            Criterion(errors=errors)


def test_models_are_named() -> None:
    assert {model.name for model in severity.models_of("quickstart")} == PAPER
    names = [model.name for model in severity.models_of("quickstart", ["vignetting", "straylight/paraxial"])]
    assert names == ["straylight/paraxial", "vignetting/cos4", "vignetting/lens"]
    every = severity.models_of("quickstart", ["all"])
    assert len(every) == sum(cls.severity is not None for models in registry().values() for cls in models.values())
    for model in every:  # both ends of the range can be set
        for width_px in (256, 1024):
            for position in (0, 1):
                fault, value = model.at(model.severity.value(position, width_px))
                assert isinstance(fault, model.type)
                assert value > 0
    # a fault of the scene that does not fit the camera is none of a calibration's concern
    assert severity.models_of("quickstart", ["vignetting/lens"], {"camera.lens": "tessar_50_f2p8"})
    kept = severity.models_of("quickstart", overrides={"faults.dust_on_optics.peak_dn": 150})
    assert next(model for model in kept if model.fault == "dust_on_optics").keys == {"peak_dn": 150}
    with pytest.raises(InputError, match=r"model 'vigneting': no such model with a severity \(did you mean"):
        severity.models_of("quickstart", ["vigneting"])
    with pytest.raises(InputError, match=r"flares: none of its faults|quickstart: none of its faults"):
        severity.models_of("quickstart", overrides={"faults": {}})


def test_a_model_without_a_value_does_not_cost_the_levels_of_the_others(monkeypatch: pytest.MonkeyPatch) -> None:
    class Job:
        def of_lens(self, lens: int, name: str) -> list[list[tuple[float, float]]]:
            return measured(curve(0.8), curve(1.0), curve(1.3)) if name == DUST.name else []

    lines = ModelUnderTest(fault="broken_lines", model="texture", keys={})
    monkeypatch.setattr(severity, "evaluate_models", lambda models, *_: (Job(), {m.name: "" for m in models}))
    views = severity.ViewOptions(scene="quickstart", overrides={"camera.width_px": 256, "patch.boulders": False})
    with pytest.warns(UserWarning, match="broken_lines/texture: matches_lost has no value on any view; it gets no"):
        table = severity.compute_levels([lines, DUST], views, Criterion())
    assert {fault: list(models) for fault, models in table.levels.items()} == {"dust_on_optics": ["gaussian"]}
    with pytest.raises(VbnfaultError, match="has no value on any view"):
        severity.compute_levels([lines], views, Criterion())


def test_the_recorded_command_has_values_as_the_command_line_reads_them() -> None:
    overrides = {"dataset.layers": ["clean"], "plan.pair_strata": True, "camera.detector": "generic_ccd"}
    command = severity._command([DUST], severity.ViewOptions(scene="a b", overrides=overrides), Criterion())
    words = shlex.split(command)
    assert words[:3] == ["vbnfault", "severity", "a b"]
    given = [word for option, word in itertools.pairwise(words) if option == "--set"]
    assert read_overrides(given) == overrides


def test_a_group_done_again_counts_each_view_once_and_names_those_left_out(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    group = ViewGroup(
        scene="quickstart", overrides={}, lens=0, facing_sun=False, site=0, first=3, count=4, models=(DUST,)
    )
    progress = Progress(4, shown=False)
    advanced: list[bool] = []
    said: list[str] = []
    monkeypatch.setattr(progress, "advance", advanced.append)
    monkeypatch.setattr(progress, "say", said.append)
    job = SeverityJob(tmp_path, [group], progress)
    worker = ViewWorker("matches_lost")
    monkeypatch.setattr(worker, "_session_of", lambda _: None)
    monkeypatch.setattr(worker, "_errors", lambda *_: {DUST.name: [(1.0, 0.5)]})
    monkeypatch.setattr(severity_views, "sequences", lambda *_: iter([()] * 4))
    job.tick(3, "built", '{"dust_on_optics/gaussian": [[1.0, 0.5]]}')
    job.tick(4, "failed", "the process ended")  # as the pool reports a view whose process died twice
    worker.do(job.task(0, frozenset({4})), job.tick)
    assert advanced == [True, False, False, False]
    assert [line.partition(" failed")[0] for line in said] == ["view 4", "view 5", "view 6"]
    assert job.of_lens(0, DUST.name) == [[(1.0, 0.5)]]


def test_tables_are_merged_if_they_were_made_alike(tmp_path: Path) -> None:
    path = table_file(tmp_path)
    table = read_table(path)
    lines = table.levels["broken_lines"]["texture"]
    more = table.model_copy(update={"levels": {"broken_lines": {"readout": lines}}, "commands": ("b",)})
    severity.write_table(path, severity.merged(path, more))
    both = read_table(path)
    assert {name: sorted(models) for name, models in both.levels.items()} == {
        "broken_lines": ["readout", "texture"],
        "cosmic_rays": ["tracks"],
    }
    assert both.commands == ("b",)
    with pytest.raises(InputError, match=r"has levels with width_px = 256, not 512; choose another"):
        severity.merged(path, more.model_copy(update={"width_px": 512}))


def test_a_misspelt_lens_is_named(tmp_path: Path, call: Callable[..., Called]) -> None:
    said = call("severity", "quickstart", "--out", tmp_path / "l.toml", "--lens", "foo").said
    assert said.startswith("foo: neither a file nor a packaged name; lenses: ")


def test_the_command_makes_a_table_that_a_scene_reads(tmp_path: Path, call: Callable[..., Called]) -> None:
    sizes = ("camera.width_px=128", "camera.height_px=128", "dataset.sites=1", "patch.max_triangles=60000")
    options = [word for size in sizes for word in ("--set", size)]
    out = tmp_path / "levels.toml"
    words = ["--model", "vignetting/cos4", "--views", "1", "--lens", "thin", "--quantile", "0.5", "--workers", "1"]
    result = call("severity", "quickstart", *words, "--out", out, *options)
    assert result.code == 0, result.err
    assert "vignetting/cos4: frame_illuminance_dn = " in result.out
    table = read_table(out)
    levels = table.levels["vignetting"]["cos4"]
    assert (table.width_px, table.lenses, levels.views) == (128, ("",), 1)
    assert levels.values[4] < levels.values[3] < 255
    start = "vbnfault severity quickstart --views 1 --metric matches_lost --quantile 0.5 --model vignetting/cos4 "
    assert table.commands == (f"{start}--lens thin {' '.join(options)}",)
    scene = vbnfault.load_scene("quickstart", {"severity.file": str(out), "faults.vignetting.severity": 4})
    assert scene.faults["vignetting"]["frame_illuminance_dn"] == levels.values[3]


def test_views_that_fail_do_not_stop_the_others(tmp_path: Path) -> None:
    """Half of the views are enough, whichever they are: a whole group may fail."""
    group: Any = SimpleNamespace(first=0, count=64)
    job = SeverityJob(tmp_path, [group], Progress(64, shown=False))
    for view in range(60):
        job.tick(view, "failed", "its process ended")
    job.tick(60, "built", json.dumps({"a": [[1.0, 0.5]]}))
    assert (len(job.failures), len(job.errors)) == (60, 1)


# --- levels of stored faults: those of the table, of absent and of unknown faults ---------------------------------


LEVELLED = [
    (fault, model, k + 1)
    for fault, models in Levels().table.levels.items()
    for model, levels in models.items()
    for k, value in enumerate(levels.values)
    if not math.isnan(value) and k % 2 == 0
]
# the parameters hold electrons, codes or packets, which without the sensor are no value of the key
UNSAID = {"adc/converter", "banding/interference", "blooming/overflow", "transmission/packets"}


@pytest.mark.parametrize(("fault", "model", "level"), LEVELLED)
def test_a_fault_of_a_level_has_this_level(fault: str, model: str, level: int) -> None:
    table, needs = Levels().table, registry()[fault][model]
    assert needs.severity is not None
    context = make_context(1024, sun_xy_px=(400.0, 300.0))
    if needs.needs_mosaic:
        context = with_mosaic(context)
    made = from_dict(fault, {"model": model, "severity": level}, source="test.toml")
    params = {"model": model, **made.draw(context, np.random.default_rng(3))}
    focal = float(context.camera.intrinsics[0])
    found = severity_level(fault, params, context.shape, focal, table)
    if f"{fault}/{model}" in UNSAID:
        assert math.isnan(found)
    else:  # a whole number that is drawn from two neighbours is off by half a step: 17 px for 16 px, level 1.25
        assert found == pytest.approx(level, abs=0.26)


def test_levels_of_absent_and_unknown_faults() -> None:
    table, (fault, model, _) = Levels().table, LEVELLED[0]
    assert severity_level(fault, None, (8, 8), 8.0, table) == 0
    assert math.isnan(severity_level(fault, {"model": "of_a_plug_in"}, (8, 8), 8.0, table))
    assert math.isnan(severity_level(fault, {"model": model}, (8, 8), 8.0, table))


def test_a_value_milder_than_the_mildest_is_level_0() -> None:
    """A blur by 3 px in a frame of 256 px is less than none in one of 1024 px, whose logarithm does not exist."""
    params = {"model": "gaussian", "filter_size_px": 3}
    assert severity_level("optics_degradation", params, (256, 256), 200.0, Levels().table) == 0


def test_a_level_is_linear_in_the_logarithm_of_its_value() -> None:
    """Half way from the mildest value, 1 in a frame of 1024 px, to the first level, and then to the second."""
    values = np.array(Levels().table.levels["broken_pixels"]["texture"].values)
    values *= 4  # the table's frames have 256 px

    def level(count: float) -> float:
        params = {"model": "texture", "x": [0] * round(count)}
        return severity_level("broken_pixels", params, (1024, 1024), 900.0, Levels().table)

    # a count is rounded to a whole number of about 14 and 270
    assert level(math.sqrt(values[0])) == pytest.approx(0.5, abs=0.5 / 14 / math.log(values[0]) + 1e-9)
    assert level(math.sqrt(values[0] * values[1])) == pytest.approx(
        1.5, abs=0.5 / 270 / math.log(values[1] / values[0])
    )
    assert level(9999) == 5
