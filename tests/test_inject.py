"""Faults in images that exist already: the bits of a data set's own images, noise, response and Sun."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

import vbnfault
from vbnfault.camera import Camera
from vbnfault.core.errors import InputError
from vbnfault.core.files import resources
from vbnfault.core.registry import forget
from vbnfault.detector.effects import transfer
from vbnfault.detector.three_colour import ThreeColourDetector
from vbnfault.faults import registry
from vbnfault.inject.injector import Injector
from vbnfault.inject.response import Response
from vbnfault.lens.straylight.total import SunStraylight
from vbnfault.pipeline import Session
from vbnfault.pipeline.development import take_images
from vbnfault.pipeline.injection import inject_faults
from vbnfault.pipeline.labels import label
from vbnfault.pipeline.spec import Frame
from vbnfault.scene.config import Scene, configure_faults, load_scene, parse_scene

SMALL = {
    "camera.width_px": 96,
    "camera.height_px": 64,
    "dataset.samples": 4,
    "dataset.sites": 1,
    "dataset.mask_any": None,
    "patch.facet_m": 12.0,
    "patch.radius_m": 60.0,
    "patch.min_boulder_m": 6.0,
    "patch.max_triangles": 60_000,
    "plan.on_invisible": "drop",
}
CAMERA = {"fov_deg": 20.0, "full_well_e": 13500.0, "read_noise_e_rms": 13.0, "exposure_s": 0.01}


def small(name: str) -> Scene:
    return load_scene(name, {key: value for key, value in SMALL.items() if value is not None})


# --- the bits of a data set ---------------------------------------------------------------------------------------


@cache
def sun_facing(name: str) -> Frame:
    """Return a frame of a packaged scene, with the Sun in it where a fault of the scene needs that."""
    session = Session(small(name))
    suns = session.plan.stratum == 1
    return session.frame(int(np.argmax(suns)))


MODELS = [f"{fault}/{model}" for fault, models in registry().items() for model in models]


def fits_camera(name: str, camera: Camera) -> bool:
    """Return whether a model of a fault can act in a camera."""
    fault, _, model = name.partition("/")
    cls = registry()[fault][model]
    return not (
        (cls.needs_mosaic and camera.detector.mosaic is None)
        or (cls.thin_lens_only and camera.lens.real is not None)
        or (cls.needs_ccd and not camera.is_ccd)
    )


def only(scene: Scene, name: str) -> Scene:
    """Return a scene with one model of a fault, and its defaults."""
    fault, _, model = name.partition("/")
    texture = {"texture_file": str(resources.data_dir("textures") / "flare_01.png")}
    table = {"model": model, **(texture if fault == "pixel_overwriting" else {})}
    return scene.model_copy(update={"faults": {fault: table}})


@pytest.mark.parametrize("base", ["quickstart", "navcam67p", "physical67p"])
@pytest.mark.parametrize("name", MODELS)
def test_own_electrons_give_the_data_sets_own_image(name: str, base: str) -> None:
    fault, frame = name.partition("/")[0], sun_facing(base)
    if not fits_camera(name, frame.camera):
        pytest.skip("the model has no meaning with this camera")
    scene = only(frame.spec.scene, name)
    spec = replace(frame.spec, scene=scene, faults=configure_faults(scene, "scene"))
    stages = inject_faults(spec, frame.pose, frame.rendering, frame.exposure, commanded=[fault])
    images, labels = take_images(spec, stages), label(spec, stages)
    context = stages.development.context
    known = {key: value for key, value in vars(context).items() if key not in ("camera", "of_view", "_memo")}
    result = Injector(scene)(stages.development.signal({}, []), spec.index, camera=frame.camera, context=known)
    np.testing.assert_array_equal(result.image, images.image.array)
    np.testing.assert_array_equal(result.clean, images.clean.array)
    np.testing.assert_array_equal(result.masks, labels.masks)
    assert result.injected.tolist() == [fault in stages.draws]


def test_every_model_was_seen_in_some_image() -> None:
    """The test above would also pass if nothing was ever drawn."""
    seen = set()
    for base in ("quickstart", "navcam67p", "physical67p"):
        frame = sun_facing(base)
        image = np.maximum(frame.images.clean.array[..., 0], 40).astype(np.uint16) * 257
        # charge that lags behind is little, and shows where numbers lie between the levels of 8 bits
        image += np.random.default_rng(0).integers(-128, 128, image.shape).astype(np.uint16)
        for name in MODELS:
            if name in seen or not fits_camera(name, frame.camera):
                continue
            result = Injector(only(frame.spec.scene, name))(image, sun=(60.0, 20.0))
            if result.injected.any():
                seen.add(name)
                assert (result.image != result.clean).any()
    assert seen == set(MODELS)


# --- noise --------------------------------------------------------------------------------------------------------


@pytest.fixture
def simple_faults() -> Iterator[None]:
    """Define faults of known effect, and take them out of the registry again."""

    def define(name: str, act: Callable[[Any], Any]) -> None:
        @dataclass(frozen=True, kw_only=True)
        class Simple(vbnfault.Fault):
            fault, model, default, step, after = name, "simple", True, "electrons", "dust_on_optics"

            def apply(self, quantity: Any, params: Any, context: Any) -> Any:
                return quantity.with_array(act(quantity.array))

    define("test_half", lambda array: array * np.float32(0.5))
    define("test_veil", lambda array: array + np.float32(2000))
    define("test_blur", lambda array: cv2.blur(array, (5, 5)).reshape(array.shape))
    yield
    forget(__file__)


@pytest.mark.parametrize(
    ("name", "mean", "variance"),
    [
        # of 10,000 electrons and a readout of 13: half of the light has 5,000 and 5,000 + 169, where scaling alone
        # has 2,542 and scaling with the shot noise of the result 7,542
        ("test_half", 5000.0, 5169.0),
        ("test_veil", 12000.0, 12169.0),
        ("test_blur", 10000.0, 10169.0),
    ],
)
@pytest.mark.usefixtures("simple_faults")
def test_noise_is_that_of_the_light_that_remains(name: str, mean: float, variance: float) -> None:
    """The variance of n = 65,536 pixels is χ² with a standard deviation of √(2/n) = 0.6 %; the bound is four such.

    A blur of 5 px leaves a 25th of the variance, whose measurement over 15 px errs by some per cent of that.
    """
    rng = np.random.default_rng(0)
    detector = ThreeColourDetector(full_well_e=13500.0, read_noise_e_rms=13.0)
    electrons = rng.poisson(10000, (256, 256)) + rng.normal(0, 13, (256, 256))
    white = detector.white_e[1]  # green has the largest signal at white: the full well
    numbers = np.rint(electrons / white * 65535).astype(np.uint16)
    colours = np.stack([numbers] * 3, axis=-1)
    for given in (colours, numbers):
        result = vbnfault.inject(given, {name: {}}, camera=CAMERA, seed=3)
        after = np.atleast_3d(result.image)[..., 1 if given.ndim == 3 else 0] / 65535 * white
        assert after.mean() == pytest.approx(mean, rel=4 * np.sqrt(variance) / mean / 256)
        assert after.var() == pytest.approx(variance, rel=4 * np.sqrt(2 / after.size))


@pytest.mark.parametrize("exposure_s", [0.1, 1e-3])
@pytest.mark.parametrize("detector", ["rosetta_navcam", "cmv4000"])
@pytest.mark.parametrize("raw", [False, True])
@pytest.mark.usefixtures("simple_faults")
def test_light_that_a_sensor_saw_halves_with_its_noise(detector: str, raw: bool, exposure_s: float) -> None:
    """A device's own pattern and smear are in the image already: half of the light leaves half of the numbers.

    Steps of the converter add their square over 12 twice; NAVCAM smears as much as it exposes in 1 ms. The bound is
    four standard deviations, 2.2 %, and 1 % for what the sensor's model rounds.
    """
    camera = CAMERA | {"detector": detector, "exposure_s": exposure_s}
    levels = {"black_dn": 0.0, "white_dn": 1.0, "raw": raw, "response": "linear"}
    own = vbnfault.inject(np.full((32, 32), 0.1, np.float32), {"test_half": {}}, camera=camera, image_keys=levels)
    sensor = own.camera.mosaic
    white, read = float(sensor.white_e.max()), sensor.read_noise_e_rms
    rng = np.random.default_rng(0)
    electrons = rng.poisson(4000, (256, 256)) + rng.normal(0, read, (256, 256))
    given = (electrons / white).astype(np.float32)
    result = vbnfault.inject(given, {"test_half": {}}, camera=camera, seed=3, image_keys=levels)
    after = result.image * white
    variance = 2000 + read**2 + 2 / 12 / sensor.sensor.readout.system_gain_dn_per_e**2
    assert after.mean() == pytest.approx(2000, rel=2e-3)
    assert after.var() == pytest.approx(variance, rel=4 * np.sqrt(2 / after.size) + 0.01)


@pytest.mark.parametrize("detector", ["", "cmv4000"])
@pytest.mark.usefixtures("simple_faults")
def test_dark_sky_over_a_black_level_keeps_mean_and_noise_of_its_light(detector: str) -> None:
    """Numbers below black and at black are noise of the readout, too.

    Bounds are four standard deviations, and 0.1 e for what the sensor's model rounds.
    """
    gain_dn_per_e, black_dn, white_e = 0.3, 70, 13400.0
    camera = CAMERA | {"exposure_s": 1e-3} | ({"detector": detector} if detector else {"full_well_e": white_e})
    rng = np.random.default_rng(0)
    electrons = rng.poisson(5, (256, 256)) + rng.normal(0, 13, (256, 256))
    image = np.rint(black_dn + gain_dn_per_e * electrons).astype(np.uint16)
    keys = {"black_dn": black_dn, "white_dn": black_dn + gain_dn_per_e * white_e, "raw": bool(detector)}
    result = vbnfault.inject(image, {"test_half": {}}, camera=camera, seed=3, image_keys=keys)
    after = (result.image.astype(float) - black_dn) / gain_dn_per_e
    variance = 2.5 + 13**2 + 2 / 12 / gain_dn_per_e**2
    assert after.mean() == pytest.approx(2.5, abs=0.1 + 4 * np.sqrt(variance) / 256)
    assert after.var() == pytest.approx(variance, rel=4 * np.sqrt(2 / after.size) + 0.01)


def test_pixels_that_no_fault_touches_keep_their_numbers() -> None:
    rng = np.random.default_rng(1)
    for dtype in (np.uint8, np.uint16, np.float32):
        top = np.iinfo(dtype).max if np.dtype(dtype).kind == "u" else 1
        image = (rng.random((96, 128, 3)) * 0.6 * top).astype(dtype)
        result = vbnfault.inject(
            image, {"broken_pixels": {"model": "texture"}, "dust_on_optics": {}}, camera=CAMERA, seed=2
        )
        assert result.image.dtype == dtype
        assert result.injected.all()
        changed = (result.image != image).any(axis=2)
        assert changed.any()
        np.testing.assert_array_equal(result.image[~result.mask_any], image[~result.mask_any])


def test_the_same_seed_gives_the_same_image_and_another_one_another() -> None:
    image = np.full((64, 64), 30000, np.uint16)
    images = [vbnfault.inject(image, {"dust_on_optics": {}}, camera=CAMERA, seed=s).image for s in (4, 4, 5)]
    np.testing.assert_array_equal(images[0], images[1])
    assert (images[0] != images[2]).any()


def test_a_raw_mosaic_changes_where_the_defects_are() -> None:
    for name in resources.packaged("scenes/detectors"):
        raw = np.full((64, 64), 900, np.uint16)
        table = {"model": "hot_pixels"}
        result = vbnfault.inject(
            raw, {"broken_pixels": table}, camera={"detector": name, "exposure_s": 0.5}, seed=1, raw=True
        )
        assert result.image.dtype == np.uint16
        assert set(np.unique(result.image[~result.masks[0]])) == {900}


def test_a_mosaic_in_the_upper_bits_of_its_numbers_changes_as_in_the_lower_ones() -> None:
    image = np.random.default_rng(2).integers(200, 900, (64, 64)).astype(np.uint16)
    camera = {"detector": "generic_cmos", "exposure_s": 0.01, "fov_deg": 5.0}
    faults = {"vignetting": {"on_axis_illuminance_dn": [200.0, 200.0]}}
    top = 2**12 - 1
    low, high = (
        vbnfault.inject(
            image * k, faults, camera=camera, image_keys={"raw": True, "black_dn": 64 * k, "white_dn": top * k}
        )
        for k in (1, 16)
    )
    assert low.injected.all()
    assert high.image.max() > top
    np.testing.assert_allclose(high.image / 16, low.image, atol=1)


# --- response and Sun ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("curve", ["linear", "srgb", "gamma", "table"])
def test_responses_invert_each_other(curve: Any) -> None:
    table = np.array([[0.0, 0.0], [0.1, 0.4], [1.0, 1.0]])
    response = Response(black_dn=10, white_dn=250, curve=curve, gamma=2.2, table=table)
    light = np.linspace(0, 1, 101)
    np.testing.assert_allclose(response.light(response.numbers(light)), light, atol=1e-12)
    assert response.numbers(0.0) == 10
    assert response.numbers(1.0) == pytest.approx(250)


def test_srgb_is_that_of_colour_science() -> None:
    import colour

    light = np.linspace(0, 1, 101)
    expected = colour.models.eotf_inverse_sRGB(light)
    np.testing.assert_allclose(Response(black_dn=0, white_dn=1, curve="srgb").numbers(light), expected, atol=1e-7)


def test_the_sun_is_found_as_the_saturated_disc() -> None:
    y, x = np.mgrid[:200, :200] + 0.5
    image = np.where(np.hypot(x - 120.3, y - 61.7) < 6, 255, 20).astype(np.uint8)
    image[150, 20:90] = 255  # a bright line is no disc
    result = vbnfault.inject(image, {"straylight": {}}, camera=CAMERA, sun="auto", seed=1)
    assert result.sun_xy_px == pytest.approx([120.3, 61.7], abs=0.2)
    assert result.injected.all()
    assert result.unrecoverable[61, 120]
    by_pixel = vbnfault.inject(image, {"straylight": {}}, camera=CAMERA, sun=tuple(result.sun_xy_px), seed=1)
    assert np.abs(by_pixel.image.astype(int) - result.image).max() <= 1


def test_faults_that_an_image_cannot_have_are_left_out_with_a_reason() -> None:
    image = np.full((64, 64), 90, np.uint8)
    result = vbnfault.inject(image, {"straylight": {}, "dust_on_optics": {}}, camera=CAMERA)
    assert result.injected.tolist() == [True, False]
    assert result.left_out == {
        "straylight": "needs the Sun before the camera; give its position: image.sun, --sun or sun="
    }


@pytest.mark.parametrize(
    ("known", "sentence"),
    [
        ({"faults": ["dust_on_optics"]}, "must be tables by class"),
        ({"camera": "rosetta_navcam"}, "must be keys of [camera]"),
        ({"commanded": ["dust"]}, "dust is none of dust_on_optics"),
        ({"depth_m": np.ones((96, 64))}, "depth_m of shape [96, 64]: must be [64, 96]"),
        ({"sun": "nome"}, "image.sun = 'nome': must be 'auto', 'none'"),
        ({"sun": ("a", 1)}, "image.sun = ('a', 1): must be x and y"),
        ({"sun": (0, 0, 0)}, "image.sun = (0, 0, 0): must be x and y"),
        ({"image_keys": {"raw": True}}, "cannot be a raw mosaic"),
    ],
)
def test_mistakes_of_a_caller_are_named(known: dict[str, Any], sentence: str) -> None:
    faults = known.pop("faults", {"dust_on_optics": {}})
    with pytest.raises(InputError, match=re.escape(sentence)):
        vbnfault.inject(np.full((64, 96), 90, np.uint8), faults, **{"camera": CAMERA, **known})


@pytest.mark.parametrize(("circle_deg", "away_deg", "seen"), [(180, 89, True), (180, 101, False), (220, 101, True)])
def test_the_sun_behind_a_fisheye_makes_no_straylight(circle_deg: float, away_deg: float, seen: bool) -> None:
    angle = np.radians(away_deg)
    calibration = {"model": "fisheye", "fx": 24.0, "cx": 47.5, "cy": 35.5, "width_px": 96, "height_px": 72}
    result = vbnfault.inject(
        np.full((72, 96), 9000, np.uint16),
        {"straylight": {"model": "texture"}},
        camera={"calibration": calibration | {"circle_deg": circle_deg}, "exposure_s": 0.02},
        sun=(np.sin(angle), 0.0, np.cos(angle)),
    )
    assert result.injected.tolist() == [seen]


# Numbers of an image of 96 x 72 px, whose polynomial folds back 86 px from the principal point: a frame of the
# default 1024 x 1024 px reaches beyond.
UNSIZED = {"fx": 100.0, "cx": 47.5, "cy": 35.5, "k1": -0.2}


@pytest.mark.parametrize("in_file", [False, True])
def test_a_calibration_without_a_size_is_that_of_the_first_image(tmp_path: Path, in_file: bool) -> None:
    calibration: dict[str, Any] = UNSIZED
    if in_file:
        storage = cv2.FileStorage(str(tmp_path / "camera.yml"), cv2.FILE_STORAGE_WRITE)
        storage.write("camera_matrix", np.array([[100, 0, 47.5], [0, 100, 35.5], [0, 0, 1]]))
        storage.write("distortion_coefficients", np.array([[-0.2, 0, 0, 0]]))
        storage.release()
        calibration = {"file": str(tmp_path / "camera.yml")}
    table = {"calibration": calibration, "exposure_s": 0.02}
    faults: dict[str, Any] = {"vignetting": {}}
    injector = Injector(parse_scene({"title": "own", "camera": table, "faults": faults}, source="own"))
    large, small = (np.full(shape, 9000, np.uint16) for shape in ((72, 96), (36, 48)))
    found = injector(large).camera.lens.calibration
    assert found is not None
    assert (found.width_px, found.height_px) == (96, 72)
    np.testing.assert_array_equal(found.intrinsics, [100, 100, 48, 36])
    with pytest.raises(InputError, match="is of an image of 96 x 72 px, and the camera has 48 x 36 px"):
        injector(small)
    one_side = {**table, "calibration": UNSIZED, "width_px": 96}
    assert vbnfault.inject(large, faults, camera=one_side).camera.lens.calibration == found
    # numbers with a size keep it, also where it is that of the camera
    size = {"width_px": 96, "height_px": 72}
    for sized in ({**table, **size, "calibration": UNSIZED}, {**table, "calibration": UNSIZED | size}):
        with pytest.raises(InputError, match="is of an image of 96 x 72 px, and the camera has 48 x 36 px"):
            vbnfault.inject(small, faults, camera=sized)
    table["calibration"] = {**calibration, "scale_to_frame": True}
    injector = Injector(parse_scene({"title": "own", "camera": table, "faults": faults}, source="own"))
    injector(large)
    np.testing.assert_array_equal(injector(small).camera.intrinsics, [50, 50, 24, 18])


@pytest.mark.parametrize("key", ["focal_length_mm", "lens"])
def test_a_focal_length_is_that_of_images_of_any_size(key: str) -> None:
    camera = {key: {"focal_length_mm": 50.0, "lens": "nikkor_28_f2p8"}[key], "exposure_s": 0.02}
    result = vbnfault.inject(np.full((72, 96), 9000, np.uint16), {"dust_on_optics": {}}, camera=camera)
    focal_mm = 50.0 if key == "focal_length_mm" else 28.6  # the lens's own
    assert result.camera.lens.focal_length_mm == pytest.approx(focal_mm, rel=1e-4)


def test_the_sun_may_be_in_the_corner_of_the_frame() -> None:
    result = vbnfault.inject(np.full((64, 96), 90, np.uint8), {"straylight": {}}, camera=CAMERA, sun=(0, 0))
    assert result.sun_xy_px == pytest.approx([0, 0], abs=1e-6)


def test_what_was_assumed_is_said() -> None:
    result = vbnfault.inject(np.full((64, 64), 90, np.uint8), {"dust_on_optics": {}})
    assert {text.partition(" ")[0] for text in result.assumptions} == {
        "camera.exposure_s",
        "camera.fov_deg",
        "camera.detector",
        "image.black_dn",
        "image.white_dn",
        "image.response",
    }


def test_images_with_one_sun_share_its_straylight_and_have_the_bits_of_their_own() -> None:
    image = np.full((64, 96), 90, np.uint8)
    camera = {**CAMERA, "exposure_s": 2e-6}
    tables = {"title": "inject", "camera": camera, "faults": {"straylight": {"model": "traced"}}}
    scene = Scene.model_validate(tables)
    injector = Injector(scene)
    places = [(40.0, 20.0), (40.0, 20.0), (10.0, 50.0), (40.0, 20.0)]
    results = [injector(image, number, sun=place) for number, place in enumerate(places)]
    for number, (place, result) in enumerate(zip(places, results, strict=True)):
        assert result.injected.all()
        np.testing.assert_array_equal(Injector(scene)(image, number, sun=place).image, result.image)
    assert (results[0].image != results[2].image).any()


def test_images_with_one_sun_and_one_state_of_the_lens_sum_its_straylight_once(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    made: list[float] = []
    total = SunStraylight.total
    monkeypatch.setattr(SunStraylight, "total", lambda light, s: made.append(s) or total(light, s))
    image, tables = np.full((64, 96), 90, np.uint8), {"straylight": {"model": "traced"}}
    scene = Scene.model_validate({"title": "inject", "camera": CAMERA, "faults": tables})
    injector = Injector(scene, effects=False)
    for number, state, y, count in ((0, 0, 20, 1), (1, 0, 20, 1), (2, 1, 20, 2), (3, None, 20, 3), (4, 0, 21, 4)):
        injector(image, number, state=state, sun=(40, y))
        assert len(made) == count


@pytest.mark.parametrize("exposure_s", [0.3, 2.5e-4])
def test_light_of_a_flare_smears_in_the_image_as_in_its_mask(exposure_s: float) -> None:
    """In a frame-transfer CCD a short exposure has lines above and below a flare; both say where."""
    image = np.full((128, 128), 20, np.uint8)
    camera = {"fov_deg": 5.0, "detector": "rosetta_navcam", "exposure_s": exposure_s}
    result = vbnfault.inject(image, {"straylight": {"model": "texture"}}, camera=camera, sun=(90.0, 30.0), seed=3)
    changed, mask = result.image != image, result.masks[0]
    assert 0.1 < mask.mean() < 0.9
    assert (changed != mask).mean() < 0.05  # levels that noise moves across a rounding, at the edge of the flare
    assert (mask.all(axis=0).mean() > 0.2) == (exposure_s < 0.01)


def test_images_that_differ_in_the_readout_alone_share_the_charge_before_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    overflown: list[object] = []
    bloom = transfer.bloom
    monkeypatch.setattr(transfer, "bloom", lambda charge, **how: overflown.append(how) or bloom(charge, **how))
    camera = {**CAMERA, "detector": "rosetta_navcam"}
    camera = {key: value for key, value in camera.items() if key not in ("full_well_e", "read_noise_e_rms")}
    tables = {"title": "inject", "camera": camera, "faults": {"cti": {}, "banding": {}, "adc": {}}}
    result = Injector(Scene.model_validate(tables), effects=False)(np.full((64, 96), 90, np.uint8))
    assert result.masks.any(axis=(1, 2)).all()
    assert len(overflown) == 2  # with the traps and without


def test_images_of_one_state_share_what_lasts_and_differ_in_what_happens_in_an_exposure() -> None:
    image = np.full((96, 128), 90, np.uint8)
    tables = {
        "title": "inject",
        "camera": {"detector": "rosetta_navcam", "fov_deg": 5.0, "exposure_s": 0.3},
        "faults": {"dust_on_optics": {"model": "gaussian"}, "cosmic_rays": {"flux_per_cm2_s": [900.0, 1000.0]}},
    }
    injector = Injector(Scene.model_validate(tables))
    film = [injector(image, number, state=4) for number in (4, 5)]
    alone = [injector(image, number) for number in (4, 5)]
    np.testing.assert_array_equal(film[0].image, alone[0].image)
    for class_ in injector.faults:
        same = film[0].parameters[class_] == film[1].parameters[class_]
        assert same == (not injector.faults[class_].per_exposure)
        assert alone[0].parameters[class_] != alone[1].parameters[class_]
    dust = (
        film[0].masks[film[0].faults.index("dust_on_optics")] & ~film[0].masks[film[0].faults.index("cosmic_rays")]
    )
    assert (film[0].image != film[1].image)[dust].any()  # the noise of the light that is left is that of its frame


def test_an_exposure_at_which_the_sun_would_be_far_too_bright_is_said() -> None:
    image, faults = np.full((64, 96), 90, np.uint8), {"dust_on_optics": {}}
    for exposure_s, said in ((0.3, True), (1e-3, False)):
        camera = {"fov_deg": 5.0, "f_number": 2.5, "exposure_s": exposure_s, "detector": "rosetta_navcam"}
        assumptions = vbnfault.inject(image, faults, camera=camera).assumptions
        assert any("times too bright" in text for text in assumptions) == said


@pytest.mark.parametrize("detector", ["", "rosetta_navcam"])
def test_light_that_saturates_the_sensor_is_white(detector: str) -> None:
    image = np.full((64, 96), 90, np.uint8)
    camera = {"fov_deg": 20.0, "exposure_s": 0.1, "detector": detector}
    result = vbnfault.inject(image, {"straylight": {"model": "traced"}}, camera=camera, sun=(40.0, 20.0))
    assert (result.image == 255).all()
    assert (result.white_fraction(result.image), result.white_fraction(result.clean)) == (1, 0)
