"""Levels of severity: what scenes read, and how they are searched."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import vbnfault
from vbnfault.core.errors import InputError
from vbnfault.core.registry import DeclarationError
from vbnfault.faults import Fault, Severity, from_dict, levels, number, registry
from vbnfault.faults.models import undoing_registrations
from vbnfault.study import severity
from vbnfault.study.severity import Criterion, Levels, ViewSet, levels_of, write_levels

PAPER = {
    ("dust_on_optics", "gaussian"),
    ("broken_pixels", "texture"),
    ("broken_lines", "texture"),
    ("straylight", "texture"),
    ("vignetting", "cos4"),
    ("optics_degradation", "gaussian"),
}


def packaged() -> dict[tuple[str, str], Any]:
    return {(name, model): table for name, models in levels._packaged().items() for model, table in models.items()}


def test_the_packaged_levels_fit_the_models_and_cost_the_same() -> None:
    wanted = np.array(Criterion().errors)
    assert set(packaged()) >= PAPER
    for (name, model), table in packaged().items():
        cls = registry()[name][model]
        assert cls.severity is not None
        assert table["key"] == cls.severity.key
        rising = np.sign(cls.severity.high - cls.severity.low)
        reached = np.isfinite(table["values"])
        assert (np.diff(np.array(table["values"])[reached]) * rising > 0).all()
        assert np.array(table["errors"])[reached] == pytest.approx(wanted[reached], rel=0.2)
        assert reached.sum() >= 4
        assert len(table["values"]) == 5


def test_a_scene_names_a_level() -> None:
    scene = vbnfault.load_scene("quickstart", {"faults.dust_on_optics.severity": 3})
    value = packaged()["dust_on_optics", "gaussian"]["values"][2]
    assert scene.faults["dust_on_optics"] == {"model": "gaussian", "count": value}
    fault = from_dict("vignetting", {"severity": 5}, source="s")
    low = packaged()["vignetting", "cos4"]["values"][4]
    assert fault == from_dict("vignetting", {"on_axis_illuminance_dn": low}, source="s")


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ({"severity": 6}, "faults.vignetting.severity = 6: must be a whole number from 1 to 5"),
        ({"severity": 0}, "faults.vignetting.severity = 0: must be"),
        ({"severity": True}, "faults.vignetting.severity = True: must be"),
        ({"severity": "high"}, "faults.vignetting.severity = 'high': must be"),
        (
            {"severity": 2, "on_axis_illuminance_dn": 100},
            "faults.vignetting.severity = 2: sets on_axis_illuminance_dn, which is given, too; leave one out",
        ),
    ],
)
def test_a_wrong_level_is_named(table: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError) as error:
        vbnfault.load_scene("quickstart", {"faults.vignetting": table})
    assert message in str(error.value)
    with pytest.raises(InputError, match=r"must|leave one out"):
        from_dict("vignetting", table, source="s")


def test_a_model_without_levels_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        levels, "_packaged", lambda: {"vignetting": {"cos4": {"values": [100.0, float("nan"), 50.0]}}}
    )
    with pytest.raises(InputError, match=r"severity = 2: no value of on_axis_ill.* it has the levels 1, 3$"):
        from_dict("vignetting", {"severity": 2}, source="s")
    with pytest.raises(InputError, match=r"severity = 4: no value"):
        from_dict("vignetting", {"severity": 4}, source="s")
    with pytest.raises(InputError, match=r"severity = 1: no value of decentre .* it has no level$"):
        from_dict("vignetting", {"model": "lens", "severity": 1}, source="s")
    with pytest.raises(InputError, match="the model texture has no levels of severity; leave the key out"):
        from_dict("pixel_overwriting", {"severity": 1}, source="s")


def test_severities_are_spaced_in_their_logarithm() -> None:
    rising, falling = Severity(key="a", low=1, high=10_000), Severity(key="a", low=255.0, high=2.55)
    assert [rising.value(p, integer=True) for p in (0, 0.25, 0.5, 1)] == [1, 10, 100, 10_000]
    assert [falling.value(p, integer=False) for p in (0, 0.5, 1)] == [255, 25.5, 2.55]
    odd = Severity(key="a", low=1, high=201, step=2)
    assert all(odd.value(p, integer=True) % 2 == 1 for p in np.linspace(0, 1, 50))


@pytest.mark.parametrize(
    ("declared", "message"),
    [
        (Severity(key="nothing", low=1.0, high=2.0), "its severity names 'nothing', no number of it"),
        (Severity(key="amount", low=1.0, high=11.0), "must be above 0 and within the limits"),
        (Severity(key="amount", low=0.0, high=2.0), "must be above 0 and within the limits"),
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


@dataclass(frozen=True, kw_only=True, eq=False)
class Curve(ViewSet):
    """Stand for views whose error is a known function of the fault."""

    scale: float = 1.0
    least: float = 0.0

    def error(self, fault: Any) -> float:
        value = fault.count.lo
        return max(self.least, 0.9 * value / (value + 100 * self.scale))


def dust() -> type[Fault]:
    return registry()["dust_on_optics"]["gaussian"]


@pytest.mark.parametrize("scale", [0.3, 1.0, 4.0])
def test_bisection_meets_the_errors(scale: float) -> None:
    said: list[str] = []
    found = levels_of(dust(), Curve(sequences=(), scale=scale), said=said.append)
    # the search ends at 5 %
    assert found.errors == pytest.approx(Criterion().errors, rel=0.06)
    roots = [100 * scale * error / (0.9 - error) for error in Criterion().errors]
    assert found.values == pytest.approx(roots, rel=0.25)
    assert len(said) == len(set(said)) <= 7 + 6 * 5  # no value is evaluated twice


def test_levels_end_where_the_model_does_not_reach_them() -> None:
    found = levels_of(dust(), Curve(sequences=(), scale=20), said=lambda _: None)
    # at 3000 grains 0.54 = 0.9 · 3000 / 5000, which is within 20 % of 0.6
    assert found.errors == pytest.approx([0.15, 0.3, 0.45, 0.54, np.nan], rel=0.06, nan_ok=True)
    assert np.isnan(found.values).tolist() == [False, False, False, False, True]
    steep = levels_of(dust(), Curve(sequences=(), least=0.4), said=lambda _: None)
    assert np.isnan(steep.values).tolist() == [True, True, False, False, False]
    with pytest.raises(InputError, match="pixel_overwriting/texture: has no severity"):
        levels_of(registry()["pixel_overwriting"]["texture"], Curve(sequences=()))


def test_a_rising_curve_evens_out_noise() -> None:
    curve = severity.RisingCurve.through({0.0: 0.1, 0.2: 0.4, 0.3: 0.2, 0.8: 0.7, 1.0: np.nan})
    assert curve.errors == pytest.approx([0.1, 0.3, 0.7])  # 0.4 and 0.2 in the wrong order count as their mean
    assert curve.positions == pytest.approx([0, 0.25, 0.8])
    assert curve.position(0.5) == pytest.approx(0.525)
    assert curve.error(0.525) == pytest.approx(0.5)
    assert (curve.position(0.01), curve.position(0.9)) == (0, 0.8)


def test_a_criterion_is_checked() -> None:
    with pytest.raises(InputError, match="metric = 'orb_repeatability': must be one of limb_error_px"):
        Criterion(metric="orb_repeatability")
    with pytest.raises(InputError, match="quantile = 2: must be from 0 to 1"):
        Criterion(quantile=2)
    with pytest.raises(InputError, match="must be 5 rising numbers above 0"):
        Criterion(errors=(0.1, 0.2, 0.2, 0.3, 0.4))


def test_what_is_written_is_what_scenes_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    entry = Levels(
        fault="vignetting", model="cos4", key="on_axis_illuminance_dn", values=(90.0, 40.0), errors=(0.1, 0.3)
    )
    write_levels(tmp_path / "levels.toml", [entry], Criterion(), "quickstart", 8)
    monkeypatch.setattr(levels.resources, "find", lambda *_: tmp_path / "levels.toml")
    levels._packaged.cache_clear()
    try:
        assert from_dict("vignetting", {"severity": 2}, source="s") == from_dict(
            "vignetting", {"on_axis_illuminance_dn": 40.0}, source="s"
        )
    finally:
        levels._packaged.cache_clear()


def test_errors_of_views_rise_with_severity() -> None:
    size = {"camera.width_px": 128, "camera.height_px": 128, "dataset.sites": 1, "patch.max_triangles": 60_000}
    views = severity.view_set("quickstart", 1, overrides=size)
    errors = [views.error(from_dict("vignetting", {"on_axis_illuminance_dn": e}, source="s")) for e in (255, 40, 3)]
    assert 0 <= errors[0] < errors[1] < errors[2] <= 1
    assert errors[1] == views.error(from_dict("vignetting", {"on_axis_illuminance_dn": 40}, source="s"))
    assert len(views.sequences[0]) == 2
    worst = replace(views, criterion=Criterion(quantile=1.0))
    assert worst.error(from_dict("vignetting", {"on_axis_illuminance_dn": 40}, source="s")) == errors[1]
