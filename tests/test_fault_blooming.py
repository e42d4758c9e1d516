"""Blooming of wells that hold less: by hand, on every architecture, and in a picture."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from test_faults_kit import flat_electrons, make, mosaic_context, noisy, rng

from vbnfault.core.quantities import Charge, Electrons
from vbnfault.faults import FaultContext

FULL_WELL_E = 40_000.0


def context(architecture: str = "full_frame_ccd", drain: float = 0.0) -> FaultContext:
    transfer = {"antiblooming": drain, "parallel_traps": ()}
    return mosaic_context(64, architecture, camera={"exposure_s": 0.01}, transfer=transfer)


def test_a_column_by_hand() -> None:
    c = context()
    fault = make("blooming", full_well_fraction=0.5)
    params = fault.draw(c, rng())
    assert params == {"full_well_e": 20_000.0, "antiblooming": 0.0, "direction": "up"}
    charge = np.full(c.shape, 19_000, np.float32)
    charge[30, 10] = 24_000
    out = fault.apply(Charge(array=charge), params, c).array
    # 4000 e too many: 2000 either way, 1000 to a pixel
    assert out[28:33, 10].tolist() == [20_000] * 5
    assert out[27, 10] == out[33, 10] == 19_000
    changed = np.argwhere(out != charge)
    assert set(changed[:, 1]) == {10}
    assert len(changed) == 5


def test_nothing_exceeds_the_full_well_and_charge_is_kept() -> None:
    c = context()
    fault = make("blooming")
    params = fault.draw(c, rng(1))
    charge = np.zeros(c.shape, np.float32)
    charge[20:24, 5:9] = rng(2).uniform(0, 2 * FULL_WELL_E, (4, 4))
    out = fault.apply(Charge(array=charge), params, c).array
    assert 0.7 * FULL_WELL_E <= params["full_well_e"] <= 0.95 * FULL_WELL_E
    assert out.max() <= params["full_well_e"] * (1 + 1e-6)
    assert out.sum(dtype=float) == pytest.approx(charge.sum(dtype=float), rel=1e-6)


def test_a_lost_drain() -> None:
    c = context(drain=1.0)
    detector: Any = c.camera.detector
    fault = make("blooming", full_well_fraction=1)
    params = fault.draw(c, rng())
    assert (params["full_well_e"], params["antiblooming"]) == (FULL_WELL_E, 0.0)
    light = np.zeros(c.shape, np.float32)
    light[30, 10] = 3.5 * FULL_WELL_E
    acts = {"charge": [lambda a: fault.apply(Charge(array=a), params, c).array]}
    drained, lost = (detector.device.collected_e(light, 0.01, None, a) for a in ({}, acts))
    assert drained[29, 10] < 10
    assert lost[29:32, 10] == pytest.approx(FULL_WELL_E)
    assert lost[27:34, 10].sum() == pytest.approx(light.sum() * detector.device.response[30, 10], rel=1e-3)
    # a drain that is left never takes more than the sensor's own
    assert make("blooming", antiblooming=0.7).draw(context(), rng())["antiblooming"] == 0
    assert make("blooming", antiblooming=0.7).draw(c, rng())["antiblooming"] == 0.7


def test_nothing_on_cmos() -> None:
    c = context("cmos")
    fault = make("blooming")
    params = fault.draw(c, rng())
    charge = noisy("charge", c)
    assert params == {}
    assert fault.apply(charge, params, c) is charge


def test_it_shows_in_a_picture() -> None:
    c = context("interline_ccd")
    detector: Any = c.camera.detector
    fault = make("blooming", full_well_fraction=0.5)
    params = fault.draw(c, rng())
    dark, white = flat_electrons(c, 0.02), detector.white_e
    light = dark.array.copy()
    light[28:36, 20:28] = 0.9 * white
    noise = detector.draw_noise(c.shape, lambda name: rng(len(name)))
    expected = Electrons(array=light, white_e=white)
    acts = {"charge": [lambda a: fault.apply(Charge(array=a), params, c).array]}
    before, after = (detector.develop(expected, 0.01, noise, a).array[..., 3].astype(int) for a in ({}, acts))
    rise = after - before
    assert rise[26, 20:28].mean() > 10  # above the spot
    assert rise[37, 20:28].mean() > 10  # below it
    assert rise[30:34, 22:26].mean() < -10  # its wells hold less
    assert not rise[:, :16].any()
    assert not rise[:, 32:].any()
