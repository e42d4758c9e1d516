"""Smear by failed clocks, shields and shutters, against the sums that they add up."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from test_faults_kit import make, make_context, rng, with_mosaic

from vbnfault.faults import FaultContext

EXPOSURE_S = 0.01
SIZE = 64


def context(architecture: str, direction: str = "up") -> FaultContext:
    base = make_context(SIZE, architecture=architecture, readout_direction=direction, exposure_s=EXPOSURE_S)
    return with_mosaic(base)


def smeared(c: FaultContext, params: dict[str, Any]) -> tuple[np.ndarray, np.ndarray]:
    """Electrons that one bright pixel at row 20, column 30 gives its column, without and with the fault."""
    light = np.zeros(c.shape, np.float32)
    light[20, 30] = 1e4
    out = []
    for camera in (c.camera, make("smear").alter(c.camera, params)):
        device = camera.detector.device  # type: ignore[union-attr]
        dark = device.expected_e(np.zeros_like(light), EXPOSURE_S)
        out.append((device.expected_e(light, EXPOSURE_S) - dark) / device.response[20, 30])
    return out[0], out[1]


def of_row(time_s: float) -> float:
    """What the bright pixel gives a packet that waits beneath it."""
    return 1e4 * time_s / EXPOSURE_S


@pytest.mark.parametrize("direction", ["up", "down"])
def test_slow_clocks(direction: str) -> None:
    c = context("frame_transfer_ccd", direction)
    params = make("smear", cause="clock", row_transfer_s=1e-5).draw(c, rng())
    assert params == {"cause": "clock", "row_transfer_s": 1e-5}
    before, after = smeared(c, params)
    behind = slice(21, None) if direction == "up" else slice(None, 20)
    ahead = slice(None, 20) if direction == "up" else slice(21, None)
    # float32 of the dark signal, some 0.2 e, beside it
    assert before[behind, 30] == pytest.approx(of_row(1e-6), abs=1e-2)  # the sensor's own
    assert after[behind, 30] == pytest.approx(of_row(1e-5), abs=1e-2)
    assert after[ahead, 30] == pytest.approx(0, abs=1e-3)
    assert after[20, 30] == pytest.approx(1e4, rel=1e-6)
    assert after[:, 29] == pytest.approx(0, abs=1e-3)


def test_no_fast_clear() -> None:
    c = context("frame_transfer_ccd")
    params = make("smear", cause="clear", row_transfer_s=5e-6).draw(c, rng())
    assert params == {"cause": "clear", "row_clear_s": 5e-6}
    _, after = smeared(c, params)
    assert after[:20, 30] == pytest.approx(of_row(5e-6), abs=1e-2)
    assert after[21:, 30] == pytest.approx(of_row(1e-6), abs=1e-2)


def test_a_shield_that_leaks() -> None:
    c = context("interline_ccd")
    params = make("smear", leak=0.01).draw(c, rng())
    assert params == {"cause": "shield", "leak": 0.01, "row_transfer_s": 1.024e-3}
    _, after = smeared(c, params)
    others = np.arange(SIZE) != 20
    assert after[others, 30] == pytest.approx(of_row(0.01 * 1.024e-3), abs=1e-2)


def test_a_shutter_ajar() -> None:
    c = context("full_frame_ccd")
    params = make("smear", shutter_fraction=0.01).draw(c, rng())
    assert params["cause"] == "shutter"
    before, after = smeared(c, params)
    assert before[21:, 30] == pytest.approx(0, abs=1e-3)
    assert after[21:, 30] == pytest.approx(of_row(0.01 * 1.024e-3), abs=1e-2)
    assert after[:20, 30] == pytest.approx(0, abs=1e-3)


@pytest.mark.parametrize(
    ("architecture", "cause"), [("cmos", "any"), ("full_frame_ccd", "clear"), ("interline_ccd", "shutter")]
)
def test_what_cannot_occur_changes_nothing(architecture: str, cause: str) -> None:
    c = context(architecture)
    fault = make("smear", cause=cause)
    params = fault.draw(c, rng())
    assert params == {}
    assert fault.alter(c.camera, params) is c.camera


def test_a_better_sensor_does_not_mend() -> None:
    c = context("frame_transfer_ccd")
    causes = set()
    for seed in range(20):
        params = make("smear", row_transfer_s=0).draw(c, rng(seed))
        causes.add(params["cause"])
        if params["cause"] == "clock":
            assert params["row_transfer_s"] == 1e-6
    assert causes == {"clock", "clear"}
