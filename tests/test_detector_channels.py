"""Channels of a mosaic: their quantum efficiency, light for W and near infrared, and optical faults in each."""

from __future__ import annotations

import dataclasses
import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from conftest import small_scene
from sensor_file import completed
from test_faults_kit import make, make_context, noisy_electrons, rng, with_mosaic

from vbnfault import dataset
from vbnfault.core import spectra
from vbnfault.core.errors import InputError
from vbnfault.core.quantities import Irradiance
from vbnfault.detector import MosaicDetector, ThreeColourDetector, load_sensor
from vbnfault.detector.efficiency import Curve, QuantumEfficiency, white_balance
from vbnfault.detector.mosaic import pattern
from vbnfault.detector.sensor import parse_sensor
from vbnfault.pipeline import Session
from vbnfault.scene.config import parse_scene

NODES = spectra.band_nodes_nm(400.0, 1000.0, 13)


def test_colours_have_their_curves_white_none_and_near_infrared_a_long_pass() -> None:
    efficiency = QuantumEfficiency(channels=("R", "G", "B", "W", "NIR"), response="nikon_5100", peak=0.4)
    nm = np.array([450.0, 550.0, 620.0, 700.0, 725.0, 900.0])
    found = efficiency.at(nm)
    np.testing.assert_array_equal(found[:3], spectra.response("nikon_5100", nm, 0.4))
    np.testing.assert_allclose(found[3], 0.4)
    np.testing.assert_allclose(found[4], [0, 0, 0, 0, 0.2, 0.4])


def test_a_curve_of_a_file_takes_the_place_of_the_default() -> None:
    own = Curve(channel="W", wavelength_nm=(500.0, 600.0, 700.0), value=(0.2, 0.6, 0.4))
    found = QuantumEfficiency(channels=("W",), curves=(own,)).at(np.array([499.0, 500.0, 550.0, 650.0, 701.0]))
    np.testing.assert_allclose(found, [[0, 0.2, 0.4, 0.5, 0]])


def test_sensor_files_may_give_curves() -> None:
    rows = [{"channel": "W", "wavelength_nm": [400, 500, 700], "value": [0.91, 0.93, 0.86]}]
    table: dict[str, Any] = {"pattern": "mono", "quantum_efficiency": rows}
    sensor = parse_sensor(completed({**table, "sources": {"quantum_efficiency": "assumed"}}), source="x.toml")
    np.testing.assert_allclose(sensor.efficiency.at(np.array([450.0])), [[0.92]])
    hash(sensor)  # devices are kept by their sensor


@pytest.mark.parametrize(
    ("row", "message"),
    [
        (
            {"channel": "W", "wavelength_nm": [400, 500], "value": [0.9]},
            "quantum_efficiency[0].value = [0.9]: must be a list of at least 2",
        ),
        ({"channel": "W", "wavelength_nm": [500, 400], "value": [0.9, 0.9]}, "must increase"),
        (
            {"channel": "W", "wavelength_nm": [400, 500], "value": [0.9, 1.2]},
            "quantum_efficiency[0].value[1] = 1.2: must be a number from 0 to 1",
        ),
        ({"channel": "R", "wavelength_nm": [400, 500], "value": [0.9, 0.9]}, "channel = 'R': must be one of W"),
    ],
)
def test_bad_curves_are_refused_in_a_sentence(row: dict[str, Any], message: str) -> None:
    table = {"pattern": "mono", "quantum_efficiency": [row], "sources": {"quantum_efficiency": "assumed"}}
    with pytest.raises(InputError, match=r"x\.toml") as caught:
        parse_sensor(completed(table), source="x.toml")
    assert message in str(caught.value)


@pytest.mark.parametrize("name", ["rggb", "rgbw", "rgb_nir", "mono"])
def test_grey_ground_in_sunlight_is_grey(name: str) -> None:
    """R = G = B = I to a DN of rounding, where the signal is below the full well, whatever the filters."""
    sensor = replace(load_sensor("generic_cmos"), pattern=pattern(name))
    still = {"prnu": 0.0, "dsnu_e": 0.0, "years": 0.0, "rts_fraction": 0.0, "dead_fraction": 0.0}
    clean = {"inl_quadratic_dn": 0.0, "dnl_lsb_rms": 0.0, "column_pattern_e_rms": 0.0}
    sensor = replace(
        sensor,
        individual=replace(sensor.individual, **still),
        readout=replace(sensor.readout, **clean),
    )
    detector = MosaicDetector(sensor=sensor, width_px=32, height_px=32)
    nodes = spectra.band_nodes_nm(400.0, 700.0, 31)
    sun = spectra.solar_band_irradiance_W_m2_nm(nodes, 1.0).astype(np.float32)
    # so dim that what leaks in while rows wait for their readout is nothing beside the exposure
    light = Irradiance(array=np.tile(1e-6 * sun[:, None, None], (1, 32, 32)), wavelength_nm=nodes)
    rate = detector.electrons_expected(light, 1.0)
    exposure_s = 0.5 / float((rate.array / rate.white_e).max())
    image = detector.develop(detector.electrons_expected(light, exposure_s), exposure_s, None).array
    inner = image[8:-8, 8:-8].astype(int)
    assert abs(int(np.median(inner)) - 127) <= 2
    assert np.ptp(inner) <= 1


def test_white_balance_is_that_of_three_colours_and_leaves_the_infrared_out() -> None:
    three = ThreeColourDetector(response="nikon_5100", quantum_efficiency_peak=0.5)
    found = white_balance(QuantumEfficiency(channels=("R", "G", "B", "NIR")))
    np.testing.assert_array_equal(found, [*three.white_balance, 1])
    with pytest.raises(InputError, match="no sunlight"):
        white_balance(
            QuantumEfficiency(
                channels=("W",), curves=(Curve(channel="W", wavelength_nm=(800.0, 900.0), value=(0.5, 0.5)),)
            )
        )


OPTICAL = [
    ("dust_on_optics", "gaussian"),
    ("dust_on_optics", "defocused"),
    ("optics_degradation", "gaussian"),
    ("optics_degradation", "contamination"),
    ("vignetting", "cos4"),
    ("vignetting", "lens"),
    ("straylight", "texture"),
    ("straylight", "traced"),
]


@pytest.mark.parametrize(("fault", "model"), OPTICAL)
@pytest.mark.parametrize("name", ["mono", "rgbw", "rgb_nir"])
def test_optical_faults_act_on_the_channels_there_are(fault: str, model: str, name: str) -> None:
    """On R, G and B as without the others: what happens before the sensor does not know its filters."""
    context = make_context(96, 64, sun_xy_px=(30.0, 20.0), architecture="cmos")
    nodes = spectra.band_nodes_nm(400.0, 900.0, 11)
    context = replace(
        context,
        wavelength_nm=nodes,
        sun_irradiance_W_m2_nm=spectra.solar_band_irradiance_W_m2_nm(nodes, 1.0),
    )
    mosaic, three = (with_mosaic(context, pattern=pattern(kind)) for kind in (name, "rggb"))
    made = make(fault, model=model)
    params = made.draw(mosaic, rng(4))
    given = noisy_electrons(mosaic, 5)
    found = made.apply(given, params, mosaic)
    mask = made.footprint(params, mosaic)
    assert found.array.shape == (64, 96, len(mosaic.camera.detector.channels))
    assert mask is not None
    assert mask.shape == (64, 96)
    assert (found.array != given.array).any()
    if name == "rgb_nir":  # W would change what is white, and with it where the signal is clipped
        colours = replace(given, array=given.array[..., :3].copy(), white_e=given.white_e[:3])
        alone = made.apply(colours, params, dataclasses.replace(three)).array
        np.testing.assert_allclose(found.array[..., :3], alone, rtol=2e-6, atol=1e-3)


def scene(detector: str, **render: Any) -> dict[str, Any]:
    table = small_scene(
        camera={"width_px": 96, "height_px": 80, "detector": detector},
        render={"samples_per_pixel": 4, **render},
        faults={},
    )
    table["faults"] = {"straylight": {"model": "texture"}, "dust_on_optics": {}}
    table["dataset"]["layers"] = ["clean", "raw"]
    return table


def with_pattern(tmp_path: Any, name: str) -> str:
    text = (load_text("generic_cmos")).replace('pattern = "rggb"', f'pattern = "{name}"')
    path = tmp_path / f"{name}.toml"
    path.write_text(text.replace('demosaic = "malvar"', 'demosaic = "bilinear"'))
    return str(path)


def load_text(name: str) -> str:
    from vbnfault.core.files import resources

    return resources.find("scenes/detectors", name).read_text()


def test_scenes_take_white_pixels_for_intensity(tmp_path: Any) -> None:
    """In a picture of an RGBW mosaic I is what its W pixels measured; in one of a mono sensor all are the same."""
    session = Session(parse_scene(scene(with_pattern(tmp_path, "rgbw")), source="x"))
    sample = session.simulate(0)
    image, raw = sample.layers["clean"], sample.layers["raw"]
    assert image.shape == (80, 96, 4)
    assert raw.shape == (80, 96)
    frame = session.frame(0)
    detector: Any = frame.camera.detector
    assert detector.channels == ("R", "G", "B", "W")
    white = np.array(detector.sensor.pattern.tile)[np.arange(80)[:, None] % 4, np.arange(96) % 4] == 3
    black = detector.device.black_dn(frame.camera.exposure_s)
    shown = np.clip(np.rint((raw - black) * (255 / (detector.sensor.readout.top_dn - black))), 0, 255)
    np.testing.assert_allclose(sample.layers["image"][..., 3][white], shown[white], atol=1)
    # the same scene in grey: no filter, one value for all channels
    grey = Session(parse_scene(scene(with_pattern(tmp_path, "mono")), source="x")).simulate(0).layers["image"]
    assert (grey == grey[..., :1]).all()


def test_near_infrared_pixels_need_light_that_they_see(tmp_path: Any) -> None:
    detector = with_pattern(tmp_path, "rgb_nir")
    with pytest.raises(InputError, match=r"band_max_nm = 700: the NIR pixels .* see no such light"):
        _ = Session(parse_scene(scene(detector), source="x")).base_camera
    table = scene(detector, band_max_nm=1000.0, bands=12)
    frame = Session(parse_scene(table, source="x")).frame(0)
    assert frame.images.raw is not None
    lit = frame.rendering.truth.semantic[1::2, ::2] == 1
    assert np.median(frame.images.raw[1::2, ::2][lit]) > np.median(
        frame.images.raw[::2, ::2][lit]
    )  # NIR over the red beside it


def test_stores_say_what_a_user_of_raw_pictures_must_know(tmp_path: Any) -> None:
    session = Session(parse_scene(scene(with_pattern(tmp_path, "rgbw")), source="x"))
    attributes = dataset.store_spec(session, [4]).attributes
    assert attributes["intensity_channel"] == "pixels without a colour filter"
    sensor = json.loads(json.dumps(attributes["detector"]))
    assert sensor["mosaic"][0] == ["W", "B", "W", "G"]
    assert sensor["nodes"] == 1
    assert set(sensor["white_balance"]) == {"R", "G", "B", "W"}
    assert min(sensor["white_balance"].values()) == 1
    assert (sensor["bits"], sensor["bias_dn"], sensor["full_well_e"]) == (12, 64, 13500.0)
    assert sensor["gain_dn_per_e"] == pytest.approx((4095 - 64) / 13500)
    plain = Session(parse_scene(small_scene(), source="x"))
    assert dataset.store_spec(plain, [4]).attributes["intensity_channel"].startswith("luminance")
