"""Banding: amplitude, period and phase of the stripes, with and without double sampling, and row noise."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from test_faults_kit import flat_electrons, make, make_context, rng, with_mosaic

from vbnfault.detector import load_sensor
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
    made = load_sensor("generic_cmos" if architecture == "cmos" else "generic_ccd")
    return with_mosaic(
        make_context(SIZE, architecture=architecture), readout=replace(made.readout, dnl_lsb_rms=0.0, **readout)
    )


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
