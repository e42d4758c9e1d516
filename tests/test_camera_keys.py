"""Test the keys of [camera] that set its focal length, its binning and its gain, and the scale of previews."""

from __future__ import annotations

import dataclasses
import json
import math
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import small_scene
from typer.testing import CliRunner

from vbnfault import dataset, store
from vbnfault.cli import app
from vbnfault.cli.options import SceneOptions
from vbnfault.core.errors import InputError
from vbnfault.core.quantities import Electrons
from vbnfault.detector import MosaicDetector, amplified, binned, load_sensor
from vbnfault.detector.chain import Device
from vbnfault.detector.effects.contract import parse as parse_effects
from vbnfault.detector.mosaic import pattern
from vbnfault.lens import load_lens, paraxial_properties
from vbnfault.pipeline import Session
from vbnfault.scene.config import Scene, parse_scene
from vbnfault.world import cameras


def scene(**camera: Any) -> Scene:
    return parse_scene({"title": "t", "camera": camera}, source="t")


def width_mm(fov_deg: float, focal_mm: float) -> float:
    return 2 * focal_mm * math.tan(math.radians(fov_deg / 2))


# --- focal length -----------------------------------------------------------------------------------------------


def test_a_focal_length_sets_the_field_of_view() -> None:
    camera = scene(focal_length_mm=12.5, width_px=640).camera
    assert width_mm(camera.fov_deg, 12.5) == pytest.approx(640 * 5.5e-3)
    assert cameras.base_camera(scene(focal_length_mm=12.5)).lens.focal_length_mm == pytest.approx(12.5)


def test_the_pitch_is_that_of_the_detector_and_of_binned_pixels() -> None:
    pitch_mm = load_sensor("rosetta_navcam").pixel_pitch_um * 1e-3
    for n in (1, 2):
        given = scene(focal_length_mm=152.5, width_px=512, height_px=512, detector="rosetta_navcam", binning=n)
        assert width_mm(given.camera.fov_deg, 152.5) == pytest.approx(512 * n * pitch_mm)
        camera = cameras.base_camera(given)
        assert (camera.lens.focal_length_mm, camera.fov_deg) == (pytest.approx(152.5), given.camera.fov_deg)


def test_a_scene_of_a_store_is_read_again() -> None:
    for keys in (
        {"focal_length_mm": 30.0},
        {"lens": "tessar_50_f2p8"},
        {"lens": "tessar_50_f2p8", "fov_deg": 30.0},
    ):
        once = scene(**keys)
        assert parse_scene(once.resolved(), source="t").resolved() == once.resolved()


@pytest.mark.parametrize(
    ("keys", "sentence"),
    [
        (
            {"focal_length_mm": 30.0, "fov_deg": 65.0},
            "focal_length_mm = 30: gives a field of 10.72 deg, and fov_deg",
        ),
        ({"focal_length_mm": 0.1}, r"focal_length_mm = 0.1: 0.1 mm give 5.632 mm .* 176 deg; must be from 0.01"),
        ({"lens": "no_such_lens"}, "lens: no_such_lens: neither"),
        ({"focal_length_mm": 9.0, "detector": "no_such"}, "detector: no_such: neither"),
    ],
)
def test_a_field_that_cannot_be_is_refused(keys: dict[str, Any], sentence: str) -> None:
    with pytest.raises(InputError, match=sentence):
        scene(**keys)


def test_a_lens_stays_as_it_is_unless_a_field_is_asked_for() -> None:
    own_mm = paraxial_properties(load_lens("tessar_50_f2p8")).efl_mm
    as_it_is = scene(lens="tessar_50_f2p8")
    real = cameras.base_camera(as_it_is).lens.real
    assert real is not None
    assert real.prescription.scale == 1
    assert width_mm(as_it_is.camera.fov_deg, own_mm) == pytest.approx(1024 * 5.5e-3)
    assert cameras.scaled_lens(as_it_is) == ""
    for asked in ({"fov_deg": 40.0}, {"focal_length_mm": 20.0}):
        scaled = scene(lens="tessar_50_f2p8", **asked)
        real = cameras.base_camera(scaled).lens.real
        assert real is not None
        assert f"scales Tessar 50 mm f/2.8 by {real.focal_length_mm / own_mm:.3g}" in cameras.scaled_lens(scaled)


def test_a_session_warns_of_a_scaled_lens() -> None:
    table = small_scene(camera={"lens": "tessar_50_f2p8", "fov_deg": 20.0}) | {"faults": {}}
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        Session(parse_scene(table, source="t"), source="t").warn_of_doubts()
    assert any("scales Tessar 50 mm f/2.8 by" in str(w.message) for w in caught)


# --- previews ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("keys", [{"fov_deg": 40.0}, {"focal_length_mm": 40.0}, {"lens": "tessar_50_f2p8"}])
def test_a_preview_has_fewer_pixels_of_the_same_field(tmp_path: Path, keys: dict[str, Any]) -> None:
    path = tmp_path / "s.toml"
    lines = "\n".join(f"{key} = {json.dumps(value)}" for key, value in keys.items())
    path.write_text(f'title = "s"\n[camera]\nwidth_px = 400\nheight_px = 300\n{lines}\n')
    whole, small = SceneOptions().load(str(path)).camera, SceneOptions(scale=0.25).load(str(path)).camera
    assert (small.width_px, small.height_px, small.fov_deg) == (100, 75, whole.fov_deg)


def test_describe_takes_a_scale() -> None:
    told = CliRunner().invoke(app, ["describe", "quickstart", "--scale", "0.25", "--samples", "2"])
    assert told.exit_code == 0
    assert "camera: 128 x 128 px, 65 deg across" in told.output


# --- binning and gain -------------------------------------------------------------------------------------------


def raw(sensor: Any, electrons: float, pixels: int, seed: int, exposure_s: float = 0.01) -> np.ndarray[Any, Any]:
    """Return a raw frame of even light of `electrons` a pixel, in DN above the bias, float64[y, x]."""
    device = MosaicDetector(sensor=sensor, seed=3, width_px=pixels, height_px=pixels)
    light = np.full((pixels, pixels, len(device.channels)), electrons, np.float32)
    rng = np.random.default_rng(seed)
    noise = device.draw_noise((pixels, pixels), lambda name: rng)
    frame = device.raw(Electrons(array=light, white_e=device.white_e), exposure_s, noise)
    return np.asarray(frame, np.float64) - sensor.readout.bias_dn


@pytest.mark.parametrize("name", ["generic_ccd", "generic_cmos"])
def test_binned_pixels_have_signal_and_noise_of_the_sum(name: str) -> None:
    """Two frames of even light give mean and temporal variance in electrons.

    The sum of n² pixels of a Poisson mean m has the mean and the variance n² m, and the read noise of one readout
    (CCD) or of n² (CMOS). The variance of 128² differences has a relative standard error of √(2/128²) = 1.1 %; four
    of them are the tolerance.
    """
    sensor, n, mean_e = load_sensor(name), 2, 1000.0
    sum_of = binned(sensor, n)
    gain = sum_of.readout.system_gain_dn_per_e
    one, two = (raw(sum_of, n**2 * mean_e, 128, seed) / gain for seed in (1, 2))
    assert np.median(one) == pytest.approx(n**2 * mean_e, rel=0.01)
    read = sensor.readout.noise_e_rms * (1 if name == "generic_ccd" else n)
    difference = (one - two)[np.abs(one - two) < 10 * math.sqrt(n**2 * mean_e)]  # without telegraph signals
    row = sensor.readout.row_noise_e_rms * (1 if name == "generic_ccd" else n**1.5)
    expected = n**2 * mean_e + read**2 + row**2 + 1 / (12 * gain**2)
    assert np.var(difference) / 2 == pytest.approx(expected, rel=0.045)


@pytest.mark.parametrize(
    ("changes", "effects"),
    [
        ({"row_noise_e_rms": 60.0}, {}),
        ({}, {"nonlinearity": {"table": [[500.0, 500.0], [13_500.0, 7000.0]]}}),
        ({}, {"interpixel_capacitance": {"beside_fraction": 0.06, "corner_fraction": 0.02}}),
    ],
)
def test_a_binned_cmos_sensor_gives_the_sum_of_numbers(changes: dict[str, Any], effects: dict[str, Any]) -> None:
    """Mean and temporal variance are those of 2 × 2 numbers of the sensor itself, added.

    The ratio of two variances has a relative standard error of 1.6 % from 128² pixels each, and of 18 % from 128
    rows, of which four and two are the tolerances: with the row noise of n pixels in place of n rows, it is 1/2.
    """
    sensor = load_sensor("generic_cmos")
    sensor = dataclasses.replace(
        sensor,
        pattern=pattern("mono"),
        individual=dataclasses.replace(sensor.individual, rts_fraction=0.0, dead_fraction=0.0, years=0.0),
        readout=dataclasses.replace(sensor.readout, inl_quadratic_dn=0.0, dnl_lsb_rms=0.0, **changes),
        effects=parse_effects(effects),
    )
    moments = []
    for one, electrons, pixels in ((sensor, 2500.0, 256), (binned(sensor, 2), 10_000.0, 128)):
        frames = [raw(one, electrons, pixels, seed) / one.readout.system_gain_dn_per_e for seed in (1, 2)]
        first, second = (frame.reshape(128, pixels // 128, 128, -1).sum(axis=(1, 3)) for frame in frames)
        moments.append((np.median(first), np.var(first - second) / 2))
    assert moments[1][0] == pytest.approx(moments[0][0], rel=0.01)
    assert moments[1][1] == pytest.approx(moments[0][1], rel=0.36 if changes else 0.064)


def test_one_pixel_is_not_binned_and_a_gain_of_one_changes_nothing() -> None:
    sensor = load_sensor("generic_cmos")
    assert binned(sensor, 1) is sensor
    assert amplified(sensor, 1.0) is sensor


def test_binning_keeps_the_hot_pixels_of_an_area() -> None:
    """The growth law counts defects of an area by the pitch of its single pixels."""
    for name in ("generic_ccd", "generic_cmos"):
        sensor = load_sensor(name)
        sum_of = binned(sensor, 4)
        counts = [
            spec.individual.hot_growth.expected(5.0, (side, side), spec.pixel_pitch_um, spec.individual.iso)
            for spec, side in ((sensor, 400), (sum_of, 100))
        ]
        assert counts[0] == pytest.approx(counts[1])


def test_binning_keeps_the_telegraph_signal_of_a_pixel() -> None:
    """One of the n² pixels has it, so that the sum has as many electrons of it."""
    sensor = load_sensor("generic_cmos")
    sensor = dataclasses.replace(sensor, individual=dataclasses.replace(sensor.individual, rts_fraction=0.01))
    one, sum_of = (
        Device(of, 3, shape=(side, side)).individual.rts.amplitude_e_s
        for of, side in ((sensor, 128), (binned(sensor, 4), 32))
    )
    assert len(sum_of) == pytest.approx(len(one), rel=0.3)
    np.testing.assert_allclose(sum_of[:100], one[:100])


def test_a_gain_multiplies_signal_and_hot_pixels_in_dn() -> None:
    sensor = load_sensor("generic_cmos")
    base, louder = (raw(amplified(sensor, g), 50.0, 64, 5, exposure_s=5.0) for g in (1.0, 4.0))
    below = louder < sensor.readout.top_dn - sensor.readout.bias_dn
    assert np.median(louder[below]) == pytest.approx(4 * np.median(base), rel=0.03)
    # The 40 hottest pixels of a dark frame, in two others of equal noise: a mean of 40 pixels of 300 e and more
    # has a standard error of at most 1.4 %, mostly shared by both, and rounding to DN adds less than 1 %.
    chosen = np.argsort(raw(sensor, 0.0, 64, 6, exposure_s=20.0), axis=None)[-40:]
    dark, louder_dark = (raw(amplified(sensor, g), 0.0, 64, 5, exposure_s=20.0).ravel()[chosen] for g in (1.0, 4.0))
    assert dark.mean() > 1.1 * np.median(raw(sensor, 0.0, 64, 5, exposure_s=20.0))
    assert louder_dark.mean() / dark.mean() == pytest.approx(4, rel=0.05)
    three = cameras.base_camera(scene(gain=4.0)).detector
    assert three.white_e == pytest.approx(cameras.base_camera(scene()).detector.white_e / 4)


def test_a_binned_and_amplified_camera_builds_a_store(tmp_path: Path) -> None:
    for k, extra in enumerate(({}, {"detector": "cmv4000"})):
        keys = {"width_px": 48, "height_px": 40, "focal_length_mm": 10.0, "binning": 2, "gain": 2.0, **extra}
        table = small_scene(camera=keys, dataset={"samples": 2, "sites": 1})
        del table["camera"]["fov_deg"]
        path = tmp_path / f"{k}.zarr"
        dataset.build_scene(parse_scene(table, source="t"), path, progress=False)
        opened = store.open_store(path)
        fx = opened.read("intrinsics")[0, 0]
        pitch = 5.5 * 2
        assert fx == pytest.approx(10.0e3 / pitch)
        kept = opened.attributes["scene"]["camera"]
        assert (kept["binning"], kept["gain"], kept["focal_length_mm"]) == (2, 2.0, 10.0)


# --- the paper's hot pixels -------------------------------------------------------------------------------------


def test_brightness_of_the_papers_broken_pixels_follows_exposure_and_gain() -> None:
    from dataclasses import replace

    from test_faults_kit import make_context

    from vbnfault.faults import from_dict

    keys = {"count": 150, "brightness_dn": [10, 40], "salt_and_pepper_fraction": 0.0}
    fixed = from_dict("broken_pixels", keys, source="t")
    grows = from_dict("broken_pixels", {**keys, "reference_exposure_s": 0.01}, source="t")
    context = make_context(96, 96)

    def drawn(fault: Any, exposure_s: float, gain: float) -> np.ndarray[Any, Any]:
        camera = replace(context.camera, exposure_s=exposure_s, gain=gain)
        return np.array(fault.draw(replace(context, camera=camera), np.random.default_rng(4))["brightness_dn"])

    base = drawn(fixed, 0.01, 1.0)
    assert np.array_equal(drawn(fixed, 0.08, 2.0), base)
    assert np.array_equal(drawn(grows, 0.01, 1.0), base)
    assert np.array_equal(drawn(grows, 0.02, 1.0), 2 * base)
    assert np.array_equal(drawn(grows, 0.02, 2.0), 4 * base)
    assert np.array_equal(drawn(grows, 1.0, 1.0), np.full(150, 255))


# --- the field of view of `lens` and `flare` --------------------------------------------------------------------


def test_the_field_of_view_means_the_same_in_lens_and_flare(tmp_path: Path) -> None:
    own_mm = paraxial_properties(load_lens("tessar_50_f2p8")).efl_mm
    for given, focal_mm in (
        (["--fov-deg", "20"], own_mm),
        (["--fov-deg", "20", "--sensor-width-mm", "9"], 4.5 / math.tan(math.radians(10))),
        (["--sensor-width-mm", "9"], own_mm),
    ):
        told = tmp_path / "t.json"
        common = ["tessar_50_f2p8", "--out", str(tmp_path / "x.png"), "--json", str(told), *given]
        assert CliRunner().invoke(app, ["lens", *common]).exit_code == 0
        assert json.loads(told.read_text())["efl_mm"] == pytest.approx(focal_mm)
        common += ["--sun-deg", "5", "--pixels", "32", "--model", "paraxial", "--wavelength-nm", "550"]
        assert CliRunner().invoke(app, ["flare", *common]).exit_code == 0
        sun_mm = json.loads(told.read_text())["sun_xy_mm"][0]
        assert sun_mm == pytest.approx(focal_mm * math.tan(math.radians(5)))
