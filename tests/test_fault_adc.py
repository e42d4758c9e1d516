"""A failing converter: stuck bits, missing codes and non-linearity, within what a readout allows."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from test_faults_kit import make, mosaic_context, rng

from vbnfault.detector.readout import convert
from vbnfault.faults import FaultContext

SIZE = 64
NOTHING: dict[str, Any] = {
    "stuck_bits": [],
    "missing_from": 0,
    "missing_count": 0,
    "inl_quadratic_dn": 0.0,
    "inl_cubic_dn": 0.0,
    "dnl_lsb_rms": 0.0,
}


def context(**readout: Any) -> FaultContext:
    return mosaic_context(SIZE, readout=readout)


def readout_of(where: FaultContext, **params: Any) -> Any:
    camera: Any = make("adc").alter(where.camera, NOTHING | params)
    return camera.detector.sensor.readout


def test_codes_in_closed_form() -> None:
    levels = np.arange(4096, dtype=np.float32)[None]
    stuck = convert(levels, readout_of(context(), stuck_bits=[[7, 1], [2, 0]]))[0]
    assert np.array_equal(stuck, (np.arange(4096) | 128) & ~4)
    missing = convert(levels, readout_of(context(), missing_from=1000, missing_count=60))[0]
    expected = np.arange(4096)
    expected[1000:1060] = 999
    assert np.array_equal(missing, expected)


def test_it_adds_to_what_the_sensor_has() -> None:
    where = context(stuck_bits=((3, 0),), missing_codes=(7,), dnl_lsb_rms=0.3, inl_quadratic_dn=4.0)
    got = readout_of(
        where, stuck_bits=[[9, 1]], missing_from=8, missing_count=2, dnl_lsb_rms=0.4, inl_quadratic_dn=-50.0
    )
    assert got.stuck_bits == ((3, 0), (9, 1))
    assert got.missing_codes == (7, 8, 9)
    assert got.dnl_lsb_rms == pytest.approx(0.5)
    assert got.inl_quadratic_dn == -46.0
    # the same device: its pattern grows, it is not another
    camera: Any = make("adc").alter(where.camera, NOTHING | {"dnl_lsb_rms": 0.4})
    steps = [
        np.diff(c.detector.device.readout_individual.transitions_dn.astype(np.float64)) - 1
        for c in (camera, where.camera)
    ]
    assert np.corrcoef(*steps)[0, 1] > 0.98


@pytest.mark.parametrize("bits", [1, 8, 12, 16])
def test_draws_fit_every_converter(bits: int) -> None:
    where = context(bits=bits, bias_dn=0, inl_quadratic_dn=0.0)
    fault = make(
        "adc", stuck_count=2, stuck_place=[0, 15], inl_fraction=0.2, inl_cubic_fraction=0.1, missing_fraction=0.5
    )
    range_dn = 2**bits - 1
    signs, values = set(), set()
    for seed in range(30):
        params = fault.draw(where, rng(seed))
        got = readout_of(where, **params)
        assert len(got.stuck_bits) == min(2, bits)
        assert len(got.missing_codes) == 2**bits // 2
        steep = 4 * abs(got.inl_quadratic_dn) + 6 * 3**0.5 * abs(got.inl_cubic_dn)
        assert steep == pytest.approx(0.9 * range_dn)
        signs.add((got.inl_quadratic_dn > 0, got.inl_cubic_dn > 0))
        values |= {value for _, value in got.stuck_bits}
    assert len(signs) == 4
    assert values == {0, 1}


def test_defaults_stick_none_of_the_small_bits() -> None:
    where = context()
    drawn = [make("adc").draw(where, rng(seed)) for seed in range(100)]
    bits = [bit for params in drawn for bit, _ in params["stuck_bits"]]
    # half of the samples: 50 ± 5
    assert 30 < len(bits) < 70
    assert set(bits) == {6, 7, 8, 9, 10}
    # a run of 16 codes is one level of 255, so each shows
    assert all(16 <= params["missing_count"] <= round(0.02 * 4096) for params in drawn)
    # 1 to 12 LSB: 0.02 to 0.3 % of the 4031 codes above the bias
    assert all(0.8 <= abs(params["inl_quadratic_dn"]) <= 12.1 for params in drawn)
