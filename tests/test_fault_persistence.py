"""Persistence: its law in time, what was seen before, and its limits."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import small_scene, verified_store
from scipy.integrate import quad
from test_faults_kit import make, make_context, noisy, rng, with_mosaic

from vbnfault.core.quantities import Charge
from vbnfault.faults import FaultContext
from vbnfault.faults.persistence import power_integral

SIZE = 64


def context(exposure_s: float = 0.5) -> FaultContext:
    return with_mosaic(make_context(SIZE, architecture="cmos", exposure_s=exposure_s))


def gained(where: FaultContext, signal: np.ndarray, **keys: Any) -> tuple[np.ndarray, dict[str, Any]]:
    fault = make("persistence", **keys)
    params = fault.draw(where, rng(3))
    after: Any = fault.apply(Charge(array=signal), params, where)
    return after.array - signal, params


@pytest.mark.parametrize("power", [0.5, 1.0, 1.0 + 1e-9, 1.7])
def test_the_release_is_the_integral_of_a_power_law(power: float) -> None:
    expected, _ = quad(lambda t: t**-power, 0.3, 4.3)
    # near 1 the difference of two powers loses 9 digits
    assert power_integral(power, 0.3, 4.3) == pytest.approx(expected, rel=1e-6)


def test_it_decays_as_the_inverse_of_the_time_and_lag_does_not() -> None:
    signal = np.full((SIZE, SIZE), 2000.0, np.float32)
    keys = {"source": "frame", "shift_px": 0.0, "exposure_factor": 1.0}
    trapped = {"lag_fraction": 0.0, "trap_fraction": 0.01}
    where = context(exposure_s=0.5)
    later = [gained(where, signal, wait_s=w, **keys, **trapped)[0].mean() for w in (10.0, 100.0, 1000.0)]
    # N f ln(1 + T/w)
    expected = [2000 * 0.01 * np.log1p(0.5 / w) for w in (10.0, 100.0, 1000.0)]
    # of float32 numbers of 2000, which are 1.2e-4 apart
    assert later == pytest.approx(expected, abs=2e-4)
    at_once = {"lag_fraction": 0.02, "trap_fraction": 0.0}
    lag = [gained(where, signal, wait_s=w, **keys, **at_once)[0].mean() for w in (0.01, 100.0)]
    assert lag == pytest.approx([40.0, 40.0], abs=2e-4)


def test_the_earlier_frame_is_this_one_displaced_and_full_wells_hold_no_more() -> None:
    where = context()
    signal: Any = noisy("pixels", where).array
    full_e = where.camera.mosaic.sensor.readout.full_well_e
    keys = {"source": "frame", "lag_fraction": 0.1, "trap_fraction": 0.0}
    added, params = gained(where, signal, shift_px=160.0, exposure_factor=5.0, **keys)
    dx, dy = params["shift_px"]
    assert np.hypot(dx, dy) == pytest.approx(10, abs=1.5)  # 160 px of 1024; rounded to the mosaic's tile
    assert (dx % 2, dy % 2) == (0, 0)
    inner = slice(12, SIZE - 12)
    seen = signal[12 - dy : SIZE - 12 - dy, 12 - dx : SIZE - 12 - dx]
    np.testing.assert_allclose(added[inner, inner], 0.1 * np.minimum(5 * seen, full_e), rtol=1e-3, atol=0.01)
    assert added.max() <= 0.1 * full_e * 1.001
    _, params = gained(where, signal, source="frame", lag_fraction=1.0, trap_fraction=0.1, wait_s=1e-3)
    assert params["released"] == 1.0


def test_the_sun_leaves_a_disc_of_its_size() -> None:
    where = replace(context(), sun_angular_radius_rad=0.05)
    dark = np.zeros((SIZE, SIZE), np.float32)
    full_e = where.camera.mosaic.sensor.readout.full_well_e
    fault = make("persistence", source="sun", lag_fraction=0.5, trap_fraction=0.0)
    params = fault.draw(where, rng(3)) | {"sun_xy_px": [30.0, 20.0]}
    quantity: Any = fault.apply(Charge(array=dark), params, where)
    radius_px = 0.05 * where.camera.intrinsics[0]
    assert quantity.array.max() == pytest.approx(0.5 * full_e)
    # the rim of pixels that it covers in part is right to 1 % of the disc
    assert quantity.array.sum() == pytest.approx(0.5 * full_e * np.pi * radius_px**2, rel=0.02)
    y, x = np.average(
        np.indices(dark.shape) + 0.5, axis=(1, 2), weights=np.broadcast_to(quantity.array, dark.shape)
    )
    assert (x, y) == pytest.approx((30.0, 20.0), abs=0.05)


@pytest.mark.parametrize(
    ("name", "table"),
    [
        *(("persistence", {"source": source, "lag_fraction": 0.3}) for source in ("drawn", "frame", "sun")),
        ("frozen_frame", {}),
        ("transmission", {"fill": "shifted", "sync_rows": 8, "packet_px": 64}),
        ("transmission", {"cut_rows": 16, "cut_every": 1, "lost_count": 0, "damaged_count": 0, "lost_lines": 0}),
    ],
)
def test_faults_of_earlier_exposures_and_of_the_link_reach_the_store(
    name: str, table: dict[str, Any], tmp_path: Path
) -> None:
    scene = small_scene(
        dataset={"samples": 2, "sites": 1, "layers": ["clean"], "shard_samples": 2},
        camera={"width_px": 48, "height_px": 40, "detector": "generic_cmos"},
        plan={"faulty_fraction": 1.0},
    )
    opened = verified_store({**scene, "faults": {name: table}}, tmp_path / "a.zarr")
    for k in range(2):
        sample = opened.read_sample(k)
        assert sample.scalars["injected"].all()
        mask = sample.layers["mask"][0]
        changed = (sample.layers["image"] != sample.layers["clean"]).any(axis=2)
        assert mask.any()
        if name == "transmission":  # a footprint, beyond which nothing changes
            assert not (changed & ~mask).any()
        elif name == "frozen_frame":
            first, last = json.loads(sample.scalars["parameters"])[name]["rows"]
            near = np.zeros(len(mask), bool)
            near[max(first - 2, 0) : last + 2] = True  # demosaicing reaches two rows
            assert not (changed | mask)[~near].any()
