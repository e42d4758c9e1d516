"""Upsets of registers: gain, window and direction of readout, alone and until a reset, and the labels that move."""

from __future__ import annotations

import json
import re
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from frames_kit import FRAMES, SCENE, write_scene
from numpy.typing import NDArray
from test_faults_kit import make, make_context, noisy, rng, with_mosaic

import vbnfault
from vbnfault.core.errors import InputError
from vbnfault.core.quantities import RawMosaic
from vbnfault.detector import load_sensor
from vbnfault.faults import FaultContext
from vbnfault.scene import config

BIAS_DN, TOP_DN = 64, 4095  # of generic_cmos
MODELS: list[dict[str, Any]] = [
    {"model": "gain", "bit": 5},
    {"model": "gain", "bit": 4},
    {"model": "window", "bit": 4},
    {"model": "flip"},
]


def context(width: int = 64, height: int = 48) -> FaultContext:
    sensor = load_sensor("generic_cmos")
    assert (sensor.readout.bias_dn, sensor.readout.top_dn) == (BIAS_DN, TOP_DN)
    return with_mosaic(make_context(width, height, architecture="cmos"), readout=sensor.readout)


def gained(number: int, before: int, after: int) -> int:
    """The formula in exact arithmetic, to the nearest whole number, of two the even one."""
    return min(max(BIAS_DN + round(Fraction((number - BIAS_DN) * after, before)), 0), TOP_DN)


def expected(raw: NDArray[Any], params: dict[str, Any]) -> NDArray[Any]:
    """What the receiver gets of a raw mosaic, from the stored parameters."""
    if "code" in params:
        table = [gained(number, params["code"], params["flipped_code"]) for number in range(TOP_DN + 1)]
        return np.array(table, np.uint16)[raw]
    if "shift_px" in params:
        return np.roll(raw, params["shift_px"], axis=["rows", "columns"].index(params["lines"]))
    turned = {"rows": raw[::-1], "columns": raw[:, ::-1], "both": raw[::-1, ::-1]}
    return np.asarray(turned[params["lines"]])


# --- closed forms -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("bit", "after"), [(0, 25), (2, 28), (3, 16), (4, 8), (5, 56), (6, 88)])
def test_a_flipped_bit_of_the_gain_in_exact_arithmetic(bit: int, after: int) -> None:
    """24 is 0b11000: bits 3 and 4 turn to 0, the others to 1."""
    where, fault = context(), make("register_upset", bit=bit)
    params = fault.draw(where, rng())
    assert params == {"code": 24, "flipped_code": after}
    codes = np.arange(TOP_DN + 1, dtype=np.uint16).reshape(64, 64)
    got: Any = fault.apply(RawMosaic(array=codes), params, where)
    np.testing.assert_array_equal(got.array.ravel(), [gained(number, 24, after) for number in range(TOP_DN + 1)])
    assert got.array.ravel()[BIAS_DN] == BIAS_DN
    none: Any = fault.apply(RawMosaic(array=codes), {"code": 16, "flipped_code": 0}, where)
    assert (none.array == BIAS_DN).all()


def test_a_window_is_shifted_by_a_power_of_two_to_either_side() -> None:
    where = context()
    raw = noisy("raw", where)
    shifts = set()
    for seed in range(40):
        fault = make("register_upset", model="window", bit=[0, 13])
        params = fault.draw(where, rng(seed))
        shifts.add((params["lines"], params["shift_px"]))
        got: Any = fault.apply(raw, params, where)
        np.testing.assert_array_equal(got.array, expected(raw.array, params))
    powers = [sign * 2**k for k in range(6) for sign in (1, -1)]  # 32 is the highest below 48 and 64
    assert shifts <= {(lines, shift) for lines in ("rows", "columns") for shift in powers}
    assert {abs(shift) for _, shift in shifts} >= {1, 32}
    assert len({shift > 0 for _, shift in shifts}) == 2
    alone = make("register_upset", model="window", lines="rows", bit=3)
    assert {tuple(alone.draw(where, rng(seed)).values()) for seed in range(9)} == {("rows", 8), ("rows", -8)}
    of_level = type(alone).severity
    assert of_level is not None
    assert of_level.of_sample({"lines": "rows", "shift_px": -8}, (48, 64), 100.0) == 3


def test_readout_in_the_opposite_order_mirrors() -> None:
    where = context()
    raw = noisy("raw", where)
    drawn = set()
    for seed in range(12):
        fault = make("register_upset", model="flip")
        params = fault.draw(where, rng(seed))
        drawn.add(params["lines"])
        got: Any = fault.apply(raw, params, where)
        np.testing.assert_array_equal(got.array, expected(raw.array, params))
    assert drawn == {"rows", "columns", "both"}


# --- through the store --------------------------------------------------------------------------------------------


def scene_in(folder: Path) -> Path:
    """Nine frames; no device or image has anything but light, noise and the faults that a test names."""
    text = re.sub(r"(?m)^faults.*\n|^plan.classes.*\n", "", SCENE).replace("generic_ccd", "generic_cmos")
    return write_scene(folder, text.replace("0.02}", "0.006}"))


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    return scene_in(tmp_path)


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> list[Any]:
    """Return the raw frames without a fault."""
    session = vbnfault.Session(
        config.load_scene(scene_in(tmp_path_factory.mktemp("plain")), {"dataset.layers": ["raw"]})
    )
    return [session.simulate(k).layers["raw"] for k in range(9)]


@pytest.mark.parametrize("table", MODELS)
def test_an_upset_lasts_until_the_reset(
    scene: Path, plain: list[Any], tmp_path: Path, table: dict[str, Any]
) -> None:
    """From 1 s on, for 2 s: frames 1 and 2 of each sequence, with the same noise as without the fault."""
    event = {"cause": "heavy ion", "faults": ["register_upset"], "onset_s": 1.0}
    event |= {"profile": "until_reset", "reset_s": 3.0}
    keys = {"faults": {"register_upset": table}, "event": [event], "dataset.layers": ["raw", "mask_effect"]}
    keys |= {"plan.classes_per_sample": [1, 1]}
    out, workers = tmp_path / "s.zarr", 2 if table is MODELS[0] else 1
    vbnfault.build(config.load_scene(scene, keys), out, progress=False, workers=workers)
    assert vbnfault.verify(out).problems == []
    with vbnfault.open_dataset(out) as data:
        injected, parameters = data["injected"].values[:, 0], [json.loads(t) for t in data["parameters"].values]
        raws, masks, effects = (data[name].values for name in ("raw", "mask", "mask_effect"))
        differs = (data["image"].values != data["clean"].values).any(axis=-1)
        assert not data["mask_any"].values.any()
    frame = np.concatenate([np.arange(n) for n in FRAMES])
    np.testing.assert_array_equal(injected, (frame == 1) | (frame == 2))
    for k in range(9):
        raw = plain[k]
        upset = parameters[k].get("register_upset")
        if upset:
            raw = expected(raw, upset)
            assert upset["event"]["cause"] == "heavy ion"
        np.testing.assert_array_equal(raws[k], raw)
        np.testing.assert_array_equal(masks[k], effects[k])
        assert masks[k].any() == differs[k].any() == bool(upset)
    assert len({json.dumps(one, sort_keys=True) for one in parameters[5:7]}) == 1
    listed = {event.sequence: (event.first_frame, event.last_frame, event.end_s) for event in vbnfault.events(out)}
    assert listed == {"approach": (1, 2, 3.0), "leave": (1, 2, 3.0)}
    np.testing.assert_array_equal(vbnfault.simulate(config.load_scene(scene, keys), 6).layers["raw"], raws[6])


@pytest.mark.parametrize("table", MODELS[2:])
def test_labels_of_faults_before_it_move_with_the_image(scene: Path, table: dict[str, Any]) -> None:
    """Grains, hot pixels and cosmic rays, before the register; lost packets, behind it, stay."""
    faults: dict[str, Any] = {
        "dust_on_optics": {"model": "gaussian", "count": 12},
        "broken_pixels": {"model": "hot_pixels", "dose_TeV_g": 10.0},
        "cosmic_rays": {"flux_per_cm2_s": 3e4},
        "transmission": {"packet_px": 64, "lost_count": 1, "lost_lines": 0, "damaged_count": 0, "fill": "zero"},
    }
    layers = ["dust_opacity", "defects", "mask_effect"]
    keys = {"dataset.layers": layers, "plan.faulty_fraction": 1.0}
    frames = []
    for more in ({}, {"register_upset": table}):
        of = faults | more
        scene_of = config.load_scene(scene, keys | {"faults": of, "plan.classes_per_sample": [len(of)] * 2})
        frames.append(vbnfault.Session(scene_of).frame(2))
    after = frames[1]
    params = after.drawn["register_upset"]
    defects = [np.asarray(frame.images.defects) for frame in frames]
    np.testing.assert_array_equal(defects[1], expected(defects[0], params))
    assert np.count_nonzero(defects[1]) > 20
    opacity = [frame.labels.strengths["dust_opacity"] for frame in frames]
    np.testing.assert_array_equal(opacity[1], expected(opacity[0], params))
    for name in faults:
        masks = [frame.labels.masks[list(frame.spec.faults).index(name)] for frame in frames]
        still = name == "transmission"
        moved = masks[0] if still else expected(masks[0], params)
        effect = after.labels.effects[name]
        assert masks[0].any()
        assert masks[1][moved].all()
        assert not (masks[1] & ~moved & ~effect).any()
        assert still or not (effect & ~masks[1]).any()


# --- own images ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("table", MODELS)
def test_an_own_mosaic_gets_the_same(table: dict[str, Any]) -> None:
    """The sensor's response of 1 % rms stays in place: 8.4 DN of 836, whose difference of two has a mean of 9.4 DN.

    With a gain g, |g - 1| · 8.4 DN rms are left over, of 2.33 at most. Pattern of columns and curve add a little.
    """
    raw = np.random.default_rng(0).normal(900, 200, (48, 64)).round().astype(np.uint16)
    result = vbnfault.inject(
        raw,
        {"register_upset": table},
        camera={"detector": "generic_cmos", "fov_deg": 5.0, "exposure_s": 0.006},
        raw=True,
    )
    wanted = expected(raw, result.parameters["register_upset"])
    assert np.abs(result.image.astype(int) - wanted).mean() < 11
    assert np.abs(result.image.astype(int) - raw).mean() > 150


def test_three_colours_in_every_pixel_have_no_registers(scene: Path) -> None:
    with pytest.raises(
        InputError, match=r"faults\.register_upset\.model = 'gain': acts inside a detector with a mo"
    ):
        config.load_scene(scene, {"camera.detector": "", "faults": {"register_upset": {}}})
