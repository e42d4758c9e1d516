"""Traps by radiation: what a packet loses, where it trails to, and on which sensors."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import small_scene, verified_store
from test_faults_kit import make, mosaic_context, rng

from vbnfault.core.quantities import Electrons
from vbnfault.faults import FaultContext
from vbnfault.pipeline import Session
from vbnfault.scene import config

FULL_WELL_E = 40_000.0
SIZE = 64


def context(architecture: str = "full_frame_ccd", direction: str = "up", **transfer: Any) -> FaultContext:
    camera = {"readout_direction": direction, "exposure_s": 0.01}
    # without the dark current of charge under way, which fills traps before light does
    dark = {"dark_current_e_s": 0.0}
    return mosaic_context(SIZE, architecture, camera=camera, transfer=transfer, individual=dark)


def collected(c: FaultContext, params: dict[str, Any]) -> np.ndarray:
    """Of a bright pixel at row 40, column 30, with the fault over without."""
    light = np.zeros(c.shape, np.float32)
    light[40, 30] = 1e4
    before, after = (
        k.detector.device.collected_e(light, 0.01)  # type: ignore[union-attr]
        for k in (c.camera, make("cti").alter(c.camera, params))
    )
    return np.asarray(after - before)


def test_species() -> None:
    c = context()
    params = make("cti", parallel_per_px=4, serial_per_px=[1, 2]).draw(c, rng())
    # the trails behind warm pixels of Hubble's ACS, in transfers: Massey et al. 2010, 2014
    published = np.array([0.74, 7.7, 37.0])
    np.testing.assert_allclose([s["release_time_s"] for s in params["parallel"]], published * 1.024e-3)
    np.testing.assert_allclose([s["release_time_s"] for s in params["serial"]], published * 1e-6)
    assert sum(s["density_per_px"] for s in params["parallel"]) == pytest.approx(4)
    assert 1 <= sum(s["density_per_px"] for s in params["serial"]) <= 2
    altered: Any = make("cti").alter(c.camera, params).detector
    own: Any = c.camera.detector
    assert altered.sensor.transfer.parallel_traps[:1] == own.sensor.transfer.parallel_traps
    assert len(altered.sensor.transfer.parallel_traps) == 4
    assert len(altered.sensor.transfer.serial_traps) == 3


@pytest.mark.parametrize("direction", ["up", "down"])
def test_parallel_traps_take_and_trail(direction: str) -> None:
    c = context(direction=direction, parallel_traps=())
    params = make("cti", parallel_per_px=4, serial_per_px=0).draw(c, rng())
    assert set(params) == {"parallel"}
    change = collected(c, params)
    # √(n / full well) of the traps in each of the rows on the way, its own included, but for what comes back:
    # e^(−1/τ) is left after a transfer, of which the packet's own is the first
    way = 41 if direction == "up" else SIZE - 40
    n = 1e4 * float(c.camera.detector.device.response[40, 30])  # type: ignore[union-attr]
    taken = 4 * np.sqrt(n / FULL_WELL_E) * way
    lost = -change[40, 30]
    kept = sum(s["density_per_px"] / 4 * np.exp(-1 / (s["release_time_s"] / 1.024e-3)) for s in params["parallel"])
    assert lost == pytest.approx(taken, rel=0.6)
    assert taken * kept * 0.9 < lost <= taken * 1.01
    behind = change[41:, 30] if direction == "up" else change[39::-1, 30]
    ahead = change[:40, 30] if direction == "up" else change[41:, 30]
    assert behind[0] > behind[1] > behind[2] > 0
    assert behind[:2].sum() > 0.1 * lost
    assert np.abs(ahead).max() < 1  # the dark charge alone


def test_serial_traps_trail_to_the_right() -> None:
    c = context(parallel_traps=())
    params = make("cti", parallel_per_px=0, serial_per_px=4).draw(c, rng())
    assert set(params) == {"serial"}
    change = collected(c, params)
    assert change[40, 30] < -10
    assert change[40, 31] > change[40, 33] > 0
    assert np.abs(change[[39, 41]]).max() < 1


@pytest.mark.parametrize(
    ("architecture", "transfer"),
    [("cmos", {}), ("interline_ccd", {"row_readout_s": 0.0, "pixel_transfer_s": 0.0, "parallel_traps": ()})],
)
def test_nothing_where_there_is_no_transfer(architecture: str, transfer: dict[str, Any]) -> None:
    c = context(architecture, **transfer)
    fault = make("cti")
    assert fault.draw(c, rng()) == {}
    assert fault.alter(c.camera, {}) is c.camera


def test_it_shows_in_a_picture() -> None:
    c = context("frame_transfer_ccd")
    fault = make("cti", parallel_per_px=100)  # over 64 rows as 6 over 1024
    camera = fault.alter(c.camera, fault.draw(c, rng()))
    white = camera.detector.white_e
    light = np.zeros((*c.shape, 3), np.float32)
    light[24:40, 24:40] = 0.5 * white
    noise: Any = c.camera.detector.draw_noise(c.shape, lambda name: rng(len(name)))  # type: ignore[union-attr]
    before, after = (
        k.detector.develop(Electrons(array=light, white_e=white), 0.01, noise).array[..., 3].astype(int)
        for k in (c.camera, camera)
    )
    change = (after - before)[:, 26:38].mean(axis=1)
    assert change[40] > 2  # the first of the trail below: an eighth of what is lost, by the three release times
    assert change[24] < -2  # the first row of the square lost most
    assert np.abs(change[:20]).max() < 1


def test_the_masks_of_a_store_hold_the_trails(tmp_path: Path) -> None:
    """Hot pixels are in the array before the readout, so that they trail, and their masks hold the trails."""
    layers = ["raw", "clean", "mask_effect"]
    table = small_scene(
        dataset={"samples": 1, "sites": 1, "layers": layers},
        camera={"width_px": 64, "height_px": 64, "detector": "rosetta_navcam"},
        plan={"faulty_fraction": 1.0, "classes_per_sample": [2, 2]},
    )
    # over 64 rows as 6 traps over 1024, and pixels so hot that the exposure fills them
    table["faults"] = {
        "broken_pixels": {"model": "hot_pixels", "growth_factor": 1e5, "years": 10.0},
        "cti": {"parallel_per_px": 100.0, "serial_per_px": 0.0},
    }
    opened = verified_store(table, tmp_path / "s.zarr")
    sample = opened.read_sample(0)
    k = opened.spec.faults.index("broken_pixels")
    assert not (sample.layers["mask_effect"][k] & ~sample.layers["mask"][k]).any()
    frame = Session(config.parse_scene(table, source="test")).frame(0)
    draw = frame.injection.draws["broken_pixels"]
    alone = draw.fault.footprint(draw.params, frame.injection.development.context)
    assert alone is not None
    trails = sample.layers["mask"][k] & ~alone
    assert trails.sum() > 20
    # a trail begins behind a hot pixel, away from the register
    away = 1 if frame.camera.readout_direction == "up" else -1
    behind, ahead = (int((trails & np.roll(alone, step, axis=0)).sum()) for step in (away, -away))
    assert behind > 2 * ahead
