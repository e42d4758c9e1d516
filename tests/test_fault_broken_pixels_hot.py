"""Hot and dead pixels of the camera's own device: age, dose, exposure, and how far the mosaic spreads them."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from conftest import recorded_calls, small_scene
from test_faults_kit import flat_electrons, inside, make, make_context, rng, with_mosaic

from vbnfault.core.errors import InputError
from vbnfault.core.quantities import RTS, RTS_HIGH, STUCK, Charge, Offset, RawMosaic
from vbnfault.detector.chain import MosaicNoise
from vbnfault.detector.individual import offset_e
from vbnfault.faults import FaultContext, broken_pixels_hot
from vbnfault.pipeline import Session
from vbnfault.scene import config

SIZE = 128
KEYS: dict[str, Any] = {
    "years": 5.0,
    "growth_factor": 2e4,
    "dose_TeV_g": 0.0,
    "anneal_days": 7.0,
    "clustered_fraction": 0.0,
    "stuck_per_year": 0.0,
}


def context(exposure_s: float = 0.02, architecture: str = "cmos", up: str = "up", **sensor: Any) -> FaultContext:
    made = with_mosaic(make_context(SIZE, architecture=architecture, readout_direction=up), **sensor)
    return replace(made, camera=replace(made.camera, exposure_s=exposure_s))


def added(where: FaultContext, params: dict[str, Any]) -> Any:
    """Electrons that the defects add to a dark mosaic, as charge and as offsets, float64[y, x]."""
    none, fault = np.zeros(where.shape, dtype=np.float32), make("broken_pixels", model="hot_pixels")
    charge = fault.apply_at("pixels", Charge(array=none), params, where).array.astype(np.float64)
    return charge + fault.apply_at("offsets", Offset(array=none), params, where).array


def drawn(where: FaultContext, **keys: Any) -> dict[str, Any]:
    return make("broken_pixels", model="hot_pixels", **(KEYS | keys)).draw(where, rng(1))


def test_the_damage_of_a_sample_is_computed_once(monkeypatch: pytest.MonkeyPatch) -> None:
    calls = recorded_calls(monkeypatch, broken_pixels_hot, "_damage")
    where, fault = context(), make("broken_pixels", model="hot_pixels")
    params = fault.draw(where, rng(1))
    added(where, params)
    fault.footprint(params, where)
    assert len(calls) == 1


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


def test_the_annealed_damage_of_the_device_does_not_become_fresh_with_the_faults_dose() -> None:
    """A device that annealed for years gets of a dose what a device without damage gets."""
    spec = replace(context().camera.detector.sensor.individual, years=0.0)  # type: ignore[union-attr]
    new, flown = (context(0.1, individual=replace(spec, dose_TeV_g=d, anneal_s=1e8)) for d in (0.0, 40.0))
    keys = {"years": 0.0, "least_dn": 0.001}
    assert drawn(flown, **keys)["count"] == 0
    # Each has some 700 interactions of an exponentially distributed rate: the sums differ by 5 % and more rarely.
    sums = [added(where, drawn(where, dose_TeV_g=20.0, **keys)).sum() for where in (new, flown)]
    assert sums[1] == pytest.approx(sums[0], rel=0.3)


def test_stuck_pixels_show_their_level_whatever_the_light() -> None:
    where = context(0.01)
    keys = {"growth_factor": 1e3, "years": 10.0, "stuck_per_year": 1e-6, "dead_per_year": 0.0}
    fault = make("broken_pixels", model="hot_pixels", **(KEYS | keys))
    params = fault.draw(where, rng(1))
    stuck = (fault.defects(params, where) & STUCK) > 0  # type: ignore[operator]
    assert 90 < stuck.sum() < 240  # 1e-6 · 1e3 · 10 · 128² = 164
    top_dn = where.camera.detector.sensor.readout.top_dn  # type: ignore[union-attr]
    shown = []
    for dn in (0, top_dn):
        before = RawMosaic(array=np.full(where.shape, dn, dtype=np.uint16))
        after = fault.apply_at("raw", before, params, where).array
        assert (after[~stuck] == dn).all()
        shown.append(after[stuck])
    np.testing.assert_array_equal(*shown)
    level = shown[0] / top_dn
    assert 0.4 < level.mean() < 0.6
    assert 0 <= level.min() < level.max() <= 1
    assert {(s["x"], s["y"]) for s in params["stuck"]} == set(zip(*np.nonzero(stuck.T), strict=True))


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

    before, after = (detector.develop(signal, 0.1, None, acts).array for acts in ({}, inside(fault, params, where)))
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
    old = replace(context().camera.detector.sensor.individual, years=20.0, hot_clustered_fraction=0.0)  # type: ignore[union-attr]
    old = replace(old, hot_growth=replace(old.hot_growth, log10_scale=3.0), dead_fraction_yr=1e-5)
    where = context(0.1, individual=old)
    device: Any = where.camera.detector.device  # type: ignore[union-attr]
    assert len(device.individual.hot) > 100
    keys = {"growth_factor": 50.0, "clustered_fraction": 0.5, "stuck_per_year": 1e-6, "least_dn": 0.01}
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
    own = replace(context().camera.detector.sensor.individual, stuck_fraction=0.05, years=0.0)  # type: ignore[union-attr]
    where = context(0.1, individual=own, correct_defects=True)
    fault = make("broken_pixels", model="hot_pixels", **(KEYS | {"least_dn": 1.0}))
    params = fault.draw(where, rng(2))
    assert params["count"] > 5
    detector: Any = where.camera.detector
    signal = flat_electrons(where, 0.4)
    before, after = (detector.develop(signal, 0.1, None, a).array for a in ({}, inside(fault, params, where)))
    changed, mask = (before != after).any(axis=2), fault.footprint(params, where)
    assert mask is not None
    assert changed.any()
    assert not (changed & ~mask).any()
    assert mask.mean() < 0.5


@pytest.mark.parametrize("architecture", ["cmos", "full_frame_ccd"])
def test_a_defect_is_the_same_whether_the_devices_own_or_the_faults(architecture: str) -> None:
    """Mean and variance of raw numbers, of each class of defect, against a device that has them of its own.

    Noise of the two is independent, so they differ by standard errors, which the spread of the frames tells.
    """
    frames, exposure_s, years = 300, 0.1, 10.0
    made = make_context(64, architecture=architecture, readout_direction="up")
    young = with_mosaic(made).camera.detector.sensor  # type: ignore[union-attr]
    growth = young.individual.hot_growth
    own = replace(
        young.individual,
        # charge without light, of which a dead pixel loses nothing
        dark_current_e_s=3e4,
        years=2.0,
        hot_growth=replace(growth, log10_scale=2.6),  # type: ignore[type-var]
        hot_rate_e_s=(1e3, 1e5),
        hot_offset_e=1500.0,
        dead_fraction_yr=1e-3,
        stuck_fraction_yr=1e-3,
        rts_fraction=0.0,
        rts_per_interaction=0.2,
    )
    # the fault's rates hold for its own years only
    older = replace(
        own,
        years=2.0 + years,
        dose_TeV_g=20.0,
        dead_fraction_yr=1e-3 + 1e-3 * years / (2.0 + years),
        stuck_fraction_yr=1e-3 + 1e-3 * years / (2.0 + years),
    )
    # a well that does not reach the top code: offsets show above it
    readout = replace(young.readout, gain_dn_per_e=0.6 * young.readout.system_gain_dn_per_e)
    where, aged = (
        replace(c, camera=replace(c.camera, exposure_s=exposure_s))
        for c in (with_mosaic(made, individual=spec, readout=readout) for spec in (own, older))
    )
    keys = {"years": years, "growth_factor": 1.0, "dose_TeV_g": 20.0, "anneal_days": 7.0, "clustered_fraction": 0.0}
    fault = make(
        "broken_pixels", model="hot_pixels", dead_per_year=1e-3, stuck_per_year=1e-3, least_dn=0.001, **keys
    )
    params = fault.draw(where, rng(1))
    device, with_own = (c.camera.detector.device for c in (where, aged))  # type: ignore[union-attr]
    photo_e = np.full(where.shape, 0.3 * young.readout.full_well_e, dtype=np.float32)
    photo_e[:, 48:] *= 5  # saturated

    def noise(*key: int) -> MosaicNoise:
        return MosaicNoise.draw(where.shape, *(np.random.default_rng([*key, k]) for k in range(3)))

    stacks = np.empty((2, frames, *where.shape))
    for k in range(frames):
        stacks[0, k] = with_own.raw(photo_e, exposure_s, noise(k, 0))
        shot, now = params | {"telegraph_seed": k}, replace(where)
        stacks[1, k] = device.raw(photo_e, exposure_s, noise(k, 1), inside(fault, shot, now))

    # with the same noise, rounding of float32 may move a number over a code's edge; telegraph signals are random
    once = device.raw(photo_e, exposure_s, noise(0, 0), inside(fault, params, where))
    calm = np.ones(where.shape, dtype=bool)
    calm[with_own.individual.rts.row, with_own.individual.rts.column] = False
    assert np.abs(once - stacks[0, 0])[calm].max() <= 1

    # pixels of the new defects, each of one class only
    sets, new = {}, with_own.individual
    for name in ("hot", "dead", "stuck", "rts"):
        some, first = getattr(new, name), len(getattr(device.individual, name))
        sets[name] = np.zeros(where.shape, dtype=bool)
        sets[name][some.row[first:], some.column[first:]] = True
    sets["offset"] = sets["hot"] & (offset_e(new) - device.offset_e > 100)
    sets["hot"] &= ~sets["offset"]
    kinds = np.sum(list(sets.values()), axis=0)
    classes = {name: one & (kinds == 1) for name, one in sets.items()} | {"whole": kinds == 0}

    off = stacks - stacks.mean(axis=1, keepdims=True)
    for name, one in classes.items():
        assert one.sum() >= 20, name
        # of each frame, so that what pixels share, such as noise of rows, is in the standard errors
        for what in (stacks, off**2):
            device_has, fault_makes = what[..., one].mean(axis=2)
            error = np.hypot(device_has.std(), fault_makes.std()) / np.sqrt(frames)
            # five standard errors: a chance of 6e-7 a comparison
            assert abs(device_has.mean() - fault_makes.mean()) <= 5 * error, name
    assert not off[..., classes["stuck"]].any()
