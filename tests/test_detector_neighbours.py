"""Pixels that share their signal, and a response by a table, against closed forms."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from vbnfault.core.errors import InputError
from vbnfault.detector.chain import Device, MosaicNoise
from vbnfault.detector.effects import Effect, Exposure
from vbnfault.detector.effects.neighbours import Crosstalk, InterpixelCapacitance
from vbnfault.detector.effects.output import Nonlinearity
from vbnfault.detector.sensor import Sensor, load_sensor

SHAPE = (256, 256)
MEAN_E = 4000.0


def quiet(*effects: Effect) -> Sensor:
    """A sensor of ideal pixels, whose only noise is that of the light."""
    sensor = load_sensor("generic_cmos")
    same = replace(sensor.individual, prnu=0.0, dsnu_e=0.0, dark_current_e_s=0.0, years=0.0, rts_fraction=0.0)
    same = replace(same, dead_fraction=0.0)
    return replace(sensor, individual=same, transfer=replace(sensor.transfer, leak=0.0), effects=effects)


def collected(*effects: Effect, noise: bool = True) -> NDArray[Any]:
    """What reaches the analogue chain under even light."""
    device = Device(quiet(*effects), 1, shape=SHAPE)
    exposure = Exposure(
        device=device,
        exposure_s=0.01,
        noise=MosaicNoise.draw(SHAPE, *np.random.default_rng(2).spawn(3)) if noise else None,
        acts={},
    )
    signal: Any = np.full(SHAPE, MEAN_E, np.float32)
    for effect in device.chain:
        if effect.name == "analogue":
            break
        signal = effect.apply(signal, exposure)
    return np.asarray(signal, dtype=np.float64)


def covariance(image: NDArray[Any], dy: int, dx: int) -> float:
    rest = image - image.mean()
    return float((rest[: SHAPE[0] - dy, : SHAPE[1] - dx] * rest[dy:, dx:]).mean())


@pytest.mark.parametrize("effect", [Crosstalk, InterpixelCapacitance])
def test_neighbours_get_their_fractions_and_the_sum_stays(effect: Any) -> None:
    device = Device(quiet(), 1, shape=(16, 20))
    exposure = Exposure(device=device, exposure_s=0.1, noise=None, acts={})
    shared = effect(beside_fraction=0.02, corner_fraction=0.003)
    point = np.zeros((16, 20), np.float32)
    point[7, 9] = 1000
    expected = [[3, 20, 3], [20, 908, 20], [3, 20, 3]]
    np.testing.assert_allclose(shared.apply(point, exposure)[6:9, 8:11], expected, rtol=1e-6)
    edges = np.random.default_rng(0).uniform(0, 1e4, (16, 20)).astype(np.float32)
    # 320 sums of nine products of float32
    assert shared.apply(edges, exposure).sum(dtype=np.float64) == pytest.approx(
        edges.sum(dtype=np.float64), rel=1e-6
    )


def test_capacitance_correlates_shot_noise_and_crosstalk_does_not() -> None:
    """Moore et al. 2006: the autocovariance of a flat is the mean times the autocorrelation of the kernel."""
    beside, corner = 0.02, 0.004
    centre = 1 - 4 * (beside + corner)
    kernel = np.full((3, 3), corner)
    kernel[1], kernel[:, 1] = beside, beside
    kernel[1, 1] = centre
    wide = np.pad(kernel, 2)
    coupled = collected(InterpixelCapacitance(beside_fraction=beside, corner_fraction=corner))
    diffused = collected(Crosstalk(beside_fraction=beside, corner_fraction=corner))
    assert coupled.mean() == pytest.approx(MEAN_E, rel=2e-3)
    # a covariance of 65 536 pixels has a standard error of about variance / 256, here five of them
    error = 5 * MEAN_E / 256
    for dy, dx in ((0, 0), (0, 1), (1, 0), (1, 1), (0, 2), (2, 2)):
        expected = MEAN_E * float((wide * np.roll(wide, (-dy, -dx), (0, 1))).sum())
        assert covariance(coupled, dy, dx) == pytest.approx(expected, abs=error)
        assert covariance(diffused, dy, dx) == pytest.approx(MEAN_E if dy == dx == 0 else 0, abs=error)
    # the two are told apart: the variance falls by a fifth, which is eleven of these errors
    assert covariance(coupled, 0, 0) < 0.85 * covariance(diffused, 0, 0)


def test_a_table_bends_the_response() -> None:
    table = ((2000.0, 1900.0), (6000.0, 5500.0), (10_000.0, 8500.0))
    signal = np.array([[0, 1000, 2000, 5000, 10_000, 12_000]], np.float32)
    device = Device(quiet(), 1, shape=(16, 20))
    bent = Nonlinearity(table=table).apply(signal, Exposure(device=device, exposure_s=0.1, noise=None, acts={}))
    # beyond the table its last slope, 3000 e over 4000 e, goes on
    np.testing.assert_allclose(bent, [[0, 950, 1900, 4600, 8500, 10_000]], rtol=1e-6)
    # a full well of 13 500 e reads as 11 125 e, and is white in every colour
    whole = Device(quiet(Nonlinearity(table=table)), 1, shape=(16, 20))
    raw = whole.raw(np.full((16, 20), 1e6, np.float32), 0.01)
    assert (whole.rgbi(raw, 0.01).array == 255).all()
    assert raw.max() < 0.9 * 4095
    straight = Nonlinearity(table=((1.0, 1.0), (2.0, 2.0)))
    np.testing.assert_array_equal(collected(straight), collected())


@pytest.mark.parametrize(
    ("effects", "sentence"),
    [
        (
            {"nonlinearity": {"table": [[10.0, 9.0], [20.0, 8.0]]}},
            r"effects.nonlinearity.table.* pair 1, \[20.0, 8.0\], must be above",
        ),
        ({"nonlinearity": {"table": []}}, r"effects.nonlinearity.table = \[\]: must be .*2"),
        ({"nonlinearity": {"table": [[-1.0, 2.0], [3.0, 4.0]]}}, r"effects.nonlinearity.table.*-1"),
        ({"crosstalks": {}}, r"no such effect \(did you mean crosstalk\?\)"),
        ({"smear": {}}, r"effects.smear: no such effect"),
    ],
)
def test_wrong_tables_are_refused_in_a_sentence(effects: dict[str, Any], sentence: str) -> None:
    from sensor_file import completed

    from vbnfault.detector.sensor import parse_sensor

    with pytest.raises(InputError, match=sentence) as caught:
        parse_sensor(completed({"effects": effects}), source="mine.toml")
    assert str(caught.value).startswith("mine.toml: ")
