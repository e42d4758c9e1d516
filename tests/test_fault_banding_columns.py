"""Offsets of column groups: their period, their size, and that a device keeps them."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from test_faults_kit import flat_electrons, make, make_context, rng, with_mosaic

from vbnfault.detector import load_sensor
from vbnfault.faults import FaultContext

SIZE = 128


def context(seed: int = 0) -> FaultContext:
    """A CCD whose converter is ideal."""
    ideal = replace(load_sensor("generic_ccd").readout, dnl_lsb_rms=0.0)
    where = with_mosaic(make_context(SIZE, architecture="full_frame_ccd"), readout=ideal)
    detector: Any = where.camera.detector
    return replace(where, camera=replace(where.camera, detector=replace(detector, seed=seed)))


def columns(**keys: Any) -> Any:
    return make("banding", model="columns", **keys)


def test_columns_of_a_period_share_their_offset() -> None:
    where, fault = context(), columns(period_px=4, offset_dn=2.0, half_dn=0.0, drift_fraction=0.0)
    params = fault.draw(where, rng())
    detector: Any = where.camera.detector
    signal = flat_electrons(where, 0.4)
    acts = {"offsets": [fault.act_at("offsets", params, where)]}
    after, before = (detector.raw(signal, 0.01, None, acts).astype(float) for acts in (acts, {}))
    added_e = (after - before) / detector.sensor.readout.system_gain_dn_per_e
    expected = np.tile(params["offsets_e"], SIZE // 4)
    # two roundings to codes of 10 e
    np.testing.assert_allclose(added_e, np.broadcast_to(expected, added_e.shape), atol=10.1)
    # 2 DN of 255 of a well of 40 000 e
    assert np.std(params["offsets_e"]) == pytest.approx(2 * 40_000 / 255, rel=1e-3)
    assert abs(np.mean(params["offsets_e"])) < 0.01


def test_the_halves_differ_by_a_step() -> None:
    where, fault = context(), columns(offset_dn=0.0, half_dn=1.5)
    params = fault.draw(where, rng())
    zero = type("Plane", (), {"array": np.zeros(where.shape, np.float32), "with_array": lambda self, a: a})()
    added = fault.apply(zero, params, where)
    step = added[:, SIZE // 2 :] - added[:, : SIZE // 2]
    np.testing.assert_allclose(np.abs(step), 1.5 * 40_000 / 255, rtol=1e-5)


def test_a_device_keeps_its_pattern_but_for_the_drift() -> None:
    fault = columns(period_px=32, offset_dn=2.0, drift_fraction=0.1)
    first, second = (np.array(fault.draw(context(), rng(k))["offsets_e"]) for k in (1, 2))
    # two drifts of 0.1 each: correlated by 1 / 1.01, apart by √2 · 0.1 of the pattern; 32 values know them to 12 %
    assert np.corrcoef(first, second)[0, 1] > 0.97
    assert np.std(first - second) / np.std(first) == pytest.approx(0.141, rel=0.4)
    other = np.array(fault.draw(context(seed=1), rng(1))["offsets_e"])
    assert abs(np.corrcoef(first, other)[0, 1]) < 0.6
    periods = {len(columns().draw(context(seed), rng(k))["offsets_e"]) for seed in range(30) for k in (1, 2)}
    assert periods == {2, 4, 8, 16, 32}
    assert len({len(columns().draw(context(3), rng(k))["offsets_e"]) for k in range(5)}) == 1
