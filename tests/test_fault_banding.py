"""Banding: amplitude, period and phase of the stripes, with and without double sampling, and row noise."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from test_faults_kit import flat_electrons, make, mosaic_context, rng

from vbnfault.faults import FaultContext

SIZE = 128
PARAMS = {
    "amplitude_e": 500.0,
    "frequency_hz": 3125.0,
    "phase_rad": 0.4,
    "row_noise_e_rms": 0.0,
    "pixel_time_s": 0.0,
    "line_time_s": 2e-5,
}


def context(architecture: str = "cmos", **readout: Any) -> FaultContext:
    return mosaic_context(SIZE, architecture, readout={"dnl_lsb_rms": 0.0, **readout})


def stripes(where: FaultContext, params: dict[str, Any], noise: Any = None) -> Any:
    """What the fault adds to a grey mosaic, in electrons, float64[y, x]."""
    fault = make("banding")
    signal = flat_electrons(where, 0.3)
    bent = [
        camera.detector.raw(signal, 0.01, noise).astype(np.float64)  # type: ignore[union-attr]
        for camera in (fault.alter(where.camera, params), where.camera)
    ]
    detector: Any = where.camera.detector
    return (bent[0] - bent[1]) / detector.sensor.readout.system_gain_dn_per_e


@pytest.mark.parametrize("cds", [True, False])
def test_rows_follow_the_sinusoid_as_it_shows(cds: bool) -> None:
    where = context(cds=cds, inl_quadratic_dn=0.0)
    added = stripes(where, PARAMS)
    # 3125 Hz and 20 µs a line: 16 lines a period
    expected = 500 * np.sin(2 * math.pi * np.arange(SIZE) / 16 + 0.4)
    # two roundings to codes of 3.35 e
    np.testing.assert_allclose(added, np.broadcast_to(expected[:, None], added.shape), atol=3.5)


def test_pixel_by_pixel_the_stripes_are_slanted() -> None:
    where = context("full_frame_ccd")
    params = PARAMS | {"frequency_hz": 1e5, "pixel_time_s": 1e-6, "line_time_s": 1.3e-4, "phase_rad": 0.0}
    added = stripes(where, params)
    time_s = np.arange(SIZE)[:, None] * 1.3e-4 + np.arange(SIZE) * 1e-6
    # two roundings to codes of 10.0 e
    np.testing.assert_allclose(added, 500 * np.sin(2 * math.pi * 1e5 * time_s), atol=10.5)


def test_draws_are_within_bounds_and_follow_the_sensor() -> None:
    fault = make("banding")
    where = context()
    draws = [fault.draw(where, rng(seed)) for seed in range(200)]
    frequency = np.array([p["frequency_hz"] for p in draws])
    assert frequency.min() >= 500
    assert frequency.max() <= 200e3
    # evenly in the logarithm: half below 10 kHz; 0.5 ± 0.035
    assert abs((frequency < 1e4).mean() - 0.5) < 0.14
    dn_e = 13500 / 255
    amplitude = np.array([p["amplitude_e"] for p in draws]) / dn_e
    assert amplitude.min() >= 2
    assert amplitude.max() <= 15
    assert {(p["pixel_time_s"], p["line_time_s"]) for p in draws} == {(0.0, 2e-5)}
    ccd = fault.draw(context("full_frame_ccd"), rng())
    assert (ccd["pixel_time_s"], ccd["line_time_s"]) == (1e-6, 1.024e-3)
    slow = make("banding", lines_at_once=False, line_time_s=1e-3).draw(context(), rng())
    assert (slow["pixel_time_s"], slow["line_time_s"]) == (1e-7, 1e-3)


def test_row_noise_adds_in_quadrature() -> None:
    where = context(inl_quadratic_dn=0.0, row_noise_e_rms=30.0)
    params = PARAMS | {"amplitude_e": 0.0, "row_noise_e_rms": 40.0}
    camera: Any = make("banding").alter(where.camera, params)
    assert camera.detector.sensor.readout.row_noise_e_rms == pytest.approx(50.0)
    noise = where.camera.detector.draw_noise(where.shape, lambda name: rng(len(name)))
    added = stripes(where, params, noise)
    # of the same variates, 50 e for 30 e: 20 e a row, to the rounding of two codes
    np.testing.assert_allclose(added, np.broadcast_to(20 * noise.readout.row[:, None], added.shape), atol=3.5)


# --- offsets of column groups: their period, their size, and that a device keeps them -----------------------------


def of_device(seed: int = 0) -> FaultContext:
    """A CCD whose converter is ideal."""
    where = context("full_frame_ccd")
    detector: Any = where.camera.detector
    return replace(where, camera=replace(where.camera, detector=replace(detector, seed=seed)))


def columns(**keys: Any) -> Any:
    return make("banding", model="columns", **keys)


def test_columns_of_a_period_share_their_offset() -> None:
    where, fault = of_device(), columns(period_px=4, offset_dn=2.0, half_dn=0.0, drift_fraction=0.0)
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
    where, fault = of_device(), columns(offset_dn=0.0, half_dn=1.5)
    params = fault.draw(where, rng())
    zero = type("Plane", (), {"array": np.zeros(where.shape, np.float32), "with_array": lambda self, a: a})()
    added = fault.apply(zero, params, where)
    step = added[:, SIZE // 2 :] - added[:, : SIZE // 2]
    np.testing.assert_allclose(np.abs(step), 1.5 * 40_000 / 255, rtol=1e-5)


def test_a_device_keeps_its_pattern_but_for_the_drift() -> None:
    fault = columns(period_px=32, offset_dn=2.0, drift_fraction=0.1)
    first, second = (np.array(fault.draw(of_device(), rng(k))["offsets_e"]) for k in (1, 2))
    # two drifts of 0.1 each: correlated by 1 / 1.01, apart by √2 · 0.1 of the pattern; 32 values know them to 12 %
    assert np.corrcoef(first, second)[0, 1] > 0.97
    assert np.std(first - second) / np.std(first) == pytest.approx(0.141, rel=0.4)
    other = np.array(fault.draw(of_device(seed=1), rng(1))["offsets_e"])
    assert abs(np.corrcoef(first, other)[0, 1]) < 0.6
    periods = {len(columns().draw(of_device(seed), rng(k))["offsets_e"]) for seed in range(30) for k in (1, 2)}
    assert periods == {2, 4, 8, 16, 32}
    assert len({len(columns().draw(of_device(3), rng(k))["offsets_e"]) for k in range(5)}) == 1
