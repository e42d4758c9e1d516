"""Hot and dead pixels of the camera's own device: age, dose, exposure, and how far the mosaic spreads them."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from conftest import small_scene
from test_faults_kit import flat_electrons, make, make_context, rng, with_mosaic

from vbnfault import config
from vbnfault.errors import InputError
from vbnfault.faults import FaultContext
from vbnfault.pipeline import Session
from vbnfault.quantities import RTS, RTS_HIGH, STUCK, Charge

SIZE = 128
KEYS: dict[str, Any] = {
    "years": 5.0,
    "growth_factor": 2e4,
    "dose_TeV_g": 0.0,
    "anneal_days": 7.0,
    "clustered_share": 0.0,
    "stuck_per_year": 0.0,
}


def context(exposure_s: float = 0.02, architecture: str = "cmos", up: str = "up", **sensor: Any) -> FaultContext:
    made = with_mosaic(make_context(SIZE, architecture=architecture, readout_direction=up), **sensor)
    return replace(made, camera=replace(made.camera, exposure_s=exposure_s))


def added(where: FaultContext, params: dict[str, Any]) -> Any:
    """Electrons that the defects add to a dark mosaic, float64[y, x]."""
    dark = Charge(array=np.zeros(where.shape, dtype=np.float32))
    return make("broken_pixels", model="hot_pixels").apply(dark, params, where).array.astype(np.float64)


def drawn(where: FaultContext, **keys: Any) -> dict[str, Any]:
    return make("broken_pixels", model="hot_pixels", **(KEYS | keys)).draw(where, rng(1))


def test_defects_grow_with_exposure_from_their_offset() -> None:
    """I = R T + b: from three exposures the same line."""
    params = drawn(context(), least_dn=0.001)
    shots = {t: added(context(t), params) for t in (0.01, 0.05, 0.25)}
    hot = np.logical_and.reduce([shot > 0 for shot in shots.values()])
    assert hot.sum() > 30
    rate = (shots[0.25] - shots[0.05])[hot] / 0.2
    np.testing.assert_allclose((shots[0.05] - shots[0.01])[hot], 0.04 * rate, rtol=1e-3, atol=0.02)
    offset = shots[0.01][hot] - 0.01 * rate
    # Chapman et al.: over 40 % of defects have one; 45 % here, of some 50
    assert 0.2 < (offset > 1).mean() < 0.7
    assert (rate > 0).all()


def test_age_and_dose_keep_what_is_there() -> None:
    where = context(0.1)
    young, old = (added(where, drawn(where, years=y, least_dn=0.01)) for y in (2.0, 8.0))
    assert (young > 0).sum() < (old > 0).sum()
    # a later defect may fall on an earlier one
    assert (old[young > 0] > 0.99999 * young[young > 0]).all()
    assert np.mean(old[young > 0] < 1.00001 * young[young > 0]) > 0.9
    hit, unhurt = (added(where, drawn(where, growth_factor=1.0, dose_TeV_g=d, least_dn=0.01)) for d in (20.0, 0.0))
    assert (hit > 0).sum() > (unhurt > 0).sum() + 100
    cold = replace(where.camera.detector, sensor=replace(where.camera.detector.sensor, temperature_K=253.0))  # type: ignore[union-attr, type-var]
    frozen = replace(where, camera=replace(where.camera, detector=cold))
    params = drawn(where, dose_TeV_g=20.0, growth_factor=1.0, least_dn=0.001)
    # 0.63 eV from 293 to 253 K, in all pixels whose damage shows in both: a factor of 51.6
    warm, less = added(where, params), added(frozen, params)
    both = (warm > 0) & (less > 0)
    assert np.median(warm[both] / less[both]) == pytest.approx(51.6, rel=0.02)


def test_damage_anneals() -> None:
    """Rates fall by the law of Srour & Lo from 7 to 58 days, 1.00 to 0.72, of radiation's defects alone."""
    where = context(0.1)
    keys = {"growth_factor": 1e-3, "dose_TeV_g": 20.0, "least_dn": 0.001}
    week, later = (added(where, drawn(where, **(keys | {"anneal_days": d}))) for d in (7.0, 58.0))
    both = (week > 0) & (later > 0)
    assert np.median(later[both] / week[both]) == pytest.approx(0.7207, rel=0.01)


def test_stuck_pixels_show_their_level_whatever_the_light() -> None:
    where = context(0.01)
    keys = {"growth_factor": 1e3, "years": 10.0, "stuck_per_year": 1e-6, "dead_per_year": 0.0}
    fault = make("broken_pixels", model="hot_pixels", **(KEYS | keys))
    params = fault.draw(where, rng(1))
    stuck = (fault.defects(params, where) & STUCK) > 0  # type: ignore[operator]
    assert 90 < stuck.sum() < 240  # 1e-6 · 1e3 · 10 · 128² = 164
    shown = [
        fault.apply(Charge(array=np.full(where.shape, e, dtype=np.float32)), params, where).array[stuck]
        for e in (0.0, 5000.0)
    ]
    np.testing.assert_array_equal(*shown)
    level = shown[0] / where.camera.detector.full_well_e
    assert 0.4 < level.mean() < 0.6
    assert 0 <= level.min() < level.max() <= 1


def test_telegraph_signals_are_recorded_in_their_state() -> None:
    """New with the dose; what they add is their amplitude for the share of the exposure that they are high."""
    quiet = replace(context(1.0).camera.detector.sensor.individual, rts_per_interaction=0.0)  # type: ignore[union-attr]
    keys = {"growth_factor": 1e-3, "dose_TeV_g": 50.0, "least_dn": 0.001}
    where, without = context(1.0), context(1.0, individual=quiet)
    params = drawn(where, **keys)
    jumps = added(where, params) - added(without, drawn(without, **keys))
    listed = params["rts"]
    assert len(listed) > 30
    expected = np.zeros(where.shape)
    for one in listed:
        expected[one["y"], one["x"]] += one["amplitude_e_s"] * one["high_share"]
    assert len(listed) < 256  # all of them
    np.testing.assert_allclose(jumps, expected, atol=0.05)
    shares = np.array([one["high_share"] for one in listed])
    # mean times from 1 s to 3 h: in a second most are in one state throughout, some change
    assert {0.0, 1.0} <= set(shares)
    kinds = make("broken_pixels", model="hot_pixels", **(KEYS | keys)).defects(params, where)
    assert kinds is not None
    assert ((kinds & RTS) > 0).sum() == len({(one["x"], one["y"]) for one in listed})
    assert ((kinds & RTS_HIGH) > 0).sum() == len({(o["x"], o["y"]) for o in listed if o["high_share"] > 0.5})


@pytest.mark.parametrize("direction", ["up", "down"])
def test_a_hot_pixel_of_a_ccd_draws_a_line_behind_it(direction: str) -> None:
    """Each packet that is clocked past it waits a row's readout time in it: R τ in all rows behind, none before."""
    where = context(0.05, "full_frame_ccd", direction)
    params = drawn(where, growth_factor=1000.0, least_dn=0.001)
    shot = added(where, params)
    assert params["count"] > 3
    sensor: Any = where.camera.detector.sensor  # type: ignore[union-attr]
    facing = shot if direction == "up" else shot[::-1]
    lines = 0
    for column in range(SIZE):
        hot = np.flatnonzero(np.diff(facing[:, column], prepend=0) > 1.0)
        if len(hot) != 1:
            continue
        row = int(hot[0])
        assert facing[:row, column].max(initial=0.0) == 0
        behind = facing[row + 1 :, column]
        if len(behind) > 1 and behind[0] > 0:
            lines += 1
            np.testing.assert_allclose(behind, behind[0], rtol=1e-4)
            # at most: what is not its offset grew for the exposure at the same rate
            assert behind[0] / sensor.transfer.row_readout_s <= facing[row, column] / 0.05 * 1.001
    assert lines >= 3
    with_cmos = added(context(0.05), drawn(context(0.05), growth_factor=1000.0, least_dn=0.001))
    assert ((with_cmos > 0).sum(axis=0) <= 4).all()  # no lines


def test_defects_stay_in_their_mask_when_the_mosaic_spreads_them() -> None:
    where = context(0.1)
    keys = KEYS | {"growth_factor": 2e3, "dead_per_year": 1e-6, "least_dn": 2.0}
    fault = make("broken_pixels", model="hot_pixels", **keys)
    params = fault.draw(where, rng(2))
    assert 0 < params["count"] < 400
    detector: Any = where.camera.detector
    signal = flat_electrons(where, 0.4)

    def act(array: Any) -> Any:
        return fault.apply(Charge(array=array), params, where).array

    before, after = (detector.develop(signal, 0.1, None, acts).array for acts in ({}, {"pixels": [act]}))
    changed = (before != after).any(axis=2)
    mask = fault.footprint(params, where)
    assert mask is not None
    assert changed.any()
    assert not (changed & ~mask).any()
    # and every pixel named by the parameters is in it
    assert mask[params["y"], params["x"]].all()
    assert mask.mean() < 0.6


def test_a_scene_without_a_mosaic_refuses_it() -> None:
    scene = {**small_scene(), "faults": {"broken_pixels": {"model": "hot_pixels"}}}
    with pytest.raises(
        InputError, match=r"faults\.broken_pixels\.model = 'hot_pixels': .* name a camera\.detector"
    ):
        Session(config.parse_scene(scene, source="test"), source="test")


def test_the_years_that_a_device_has_do_not_grow_by_the_faults_factor() -> None:
    """Nor do its own defects move where the fault clusters: no years and no dose are no fault."""
    old = replace(context().camera.detector.sensor.individual, years=20.0, hot_clustered_share=0.0)  # type: ignore[union-attr]
    old = replace(old, hot_growth=replace(old.hot_growth, log10_scale=3.0), dead_share_yr=1e-5)
    where = context(0.1, individual=old)
    device: Any = where.camera.detector.device  # type: ignore[union-attr]
    assert len(device.individual.hot) > 100
    keys = {"growth_factor": 50.0, "clustered_share": 0.5, "stuck_per_year": 1e-6, "least_dn": 0.01}
    none = drawn(where, years=0.0, **keys)
    assert none["count"] == 0
    # one year that counts for fifty: what a device of 70 years has more
    added_ = drawn(where, years=1.0, growth_factor=50.0, dead_per_year=0.0, least_dn=0.001)
    per_yr = len(device.individual.hot) / 20
    assert added_["count"] == pytest.approx(50 * per_yr, rel=0.25)
    # a device may be at most 100 years old; the fault's years count all the same
    oldest = drawn(where, years=100.0, growth_factor=1.0, dead_per_year=0.0, least_dn=0.001)
    assert oldest["count"] == pytest.approx(100 * per_yr, rel=0.25)


def test_the_mask_holds_what_the_camera_mends_with_a_defect() -> None:
    """A pixel that the camera corrects takes its value from neighbours two pixels away."""
    own = replace(context().camera.detector.sensor.individual, stuck_share=0.05, years=0.0)  # type: ignore[union-attr]
    where = context(0.1, individual=own, correct_defects=True)
    fault = make("broken_pixels", model="hot_pixels", **(KEYS | {"least_dn": 1.0}))
    params = fault.draw(where, rng(2))
    assert params["count"] > 5
    detector: Any = where.camera.detector
    signal = flat_electrons(where, 0.4)
    acts = {"pixels": [lambda array: fault.apply(Charge(array=array), params, where).array]}
    before, after = (detector.develop(signal, 0.1, None, a).array for a in ({}, acts))
    changed, mask = (before != after).any(axis=2), fault.footprint(params, where)
    assert mask is not None
    assert changed.any()
    assert not (changed & ~mask).any()
    assert mask.mean() < 0.5
