"""Files that `vbnfault new` writes work as they are."""

from __future__ import annotations

import tomllib
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from vbnfault import cli, dataset, store
from vbnfault.core.errors import InputError
from vbnfault.core.quantities import Electrons
from vbnfault.core.registry import undoing_registrations
from vbnfault.detector import MosaicDetector, load_sensor
from vbnfault.detector.chain import Device
from vbnfault.faults import plugins
from vbnfault.lens import load_lens, paraxial_properties
from vbnfault.output.starters import KINDS, write_template
from vbnfault.pipeline import configure_faults
from vbnfault.reflectance import radiance_factor
from vbnfault.scene.config import load_scene
from vbnfault.testing import check_effect, check_fault, make_context
from vbnfault.world.cameras import base_camera


def test_the_command_writes_each_kind(tmp_path: Path) -> None:
    for kind in KINDS:
        name = f"own_{kind}"
        done = CliRunner().invoke(cli.app, ["new", kind, name, "--out", str(tmp_path)])
        assert done.exit_code == 0, done.output
        path = Path(done.output.strip())
        text = path.read_text(encoding="utf-8")
        assert path.parent == tmp_path
        assert name in text
        assert f"my_{kind}" not in text


def test_the_scene_builds_and_verifies(tmp_path: Path) -> None:
    path = write_template("scene", "first", tmp_path)
    small = {"dataset.samples": 2, "camera.width_px": 64, "camera.height_px": 48, "patch.facet_m": 12.0}
    small |= {"patch.radius_m": 60.0, "patch.min_boulder_m": 6.0}
    scene = load_scene(path, small)
    assert scene.title == "first"
    dataset.build_scene(scene, tmp_path / "first.zarr", progress=False)
    assert store.examine(tmp_path / "first.zarr").problems == []
    whole = tomllib.loads(path.read_text(encoding="utf-8"))
    assert load_scene(path).resolved()["camera"]["fov_deg"] == whole["camera"]["fov_deg"] == 45.0


def test_the_keys_that_the_scene_shows_as_comments_are_accepted(tmp_path: Path) -> None:
    path = write_template("scene", "first", tmp_path)
    text = path.read_text(encoding="utf-8")
    for line in (
        "[geometry.sun_averted]",
        "reference",
        "sun_elevation_deg",
        "roll_deg",
        "pitch_deg",
        "lens",
        "detector",
    ):
        assert f"\n# {line}" in text
        text = text.replace(f"\n# {line}", f"\n{line}")
    path.write_text(text.replace('model = "cos4"', 'model = "lens"'), encoding="utf-8")
    scene = load_scene(path)
    assert scene.geometry.sun_averted is not None
    assert scene.geometry.sun_averted.reference == "nadir"
    assert (scene.camera.lens, scene.camera.detector) == ("tessar_50_f2p8", "generic_cmos")


def test_the_lens_and_the_sensor_are_read(tmp_path: Path) -> None:
    lens = load_lens(write_template("lens", "glass", tmp_path))
    assert lens.name == "glass"
    assert paraxial_properties(lens).efl_mm == pytest.approx(
        paraxial_properties(load_lens("tessar_50_f2p8")).efl_mm
    )
    sensor = load_sensor(write_template("sensor", "chip", tmp_path))
    assert (sensor.name, sensor.readout.bits) == ("chip", 12)


@pytest.fixture
def undone() -> Iterator[None]:
    """What a plug-in has registered is gone after the test."""
    with undoing_registrations(always=True):
        yield
        plugins.loaded.clear()


@pytest.mark.usefixtures("undone")
def test_the_fault_keeps_the_contract_and_acts_in_a_scene(tmp_path: Path) -> None:
    write_template("fault", "rain_drop", tmp_path)
    path = write_template("scene", "first", tmp_path)
    text = path.read_text(encoding="utf-8")
    path.write_text(f'plugins = ["rain_drop.py"]\n{text}\n[faults.rain_drop]\nradius_px = 200\n', encoding="utf-8")
    scene = load_scene(path)
    fault = configure_faults(scene)["rain_drop"]
    assert type(fault).__name__ == "RainDrop"
    check_fault(type(fault), examples=3)
    context = make_context(128)
    params = fault.draw(context, np.random.default_rng(0))
    assert params["radius_px"] == 200 / 8
    flat = Electrons(array=np.full((128, 128, 3), 1000.0, np.float32), white_e=13500.0)
    dark = fault.apply(flat, params, context).array < 999
    assert np.array_equal(dark.all(axis=2), fault.footprint(params, context))
    assert dark.any()


@pytest.mark.usefixtures("undone")
def test_the_effect_keeps_the_contract_and_acts_in_a_detector(tmp_path: Path) -> None:
    plugin = write_template("effect", "amplifier_glow", tmp_path)
    path = write_template("sensor", "chip", tmp_path)
    table = "[effects.amplifier_glow]\nglow_e_s = 200.0\nreach_px = 10.0\n\n[sources]"
    text = path.read_text(encoding="utf-8").replace("\n[sources]", f"\n{table}", 1)
    names = ("glow_e_s", "reach_px")
    path.write_text(text + "".join(f'"effects.amplifier_glow.{n}" = "assumed"\n' for n in names), encoding="utf-8")
    plugins.load_plugins([str(plugin)])
    sensor = load_sensor(path)
    (effect,) = sensor.effects
    assert type(effect).__name__ == "AmplifierGlow"
    check_effect(type(effect), examples=3)
    scene = write_template("scene", "first", tmp_path)
    text = scene.read_text(encoding="utf-8").replace('\n# detector = "generic_cmos"', '\ndetector = "chip.toml"')
    scene.write_text(f'plugins = ["amplifier_glow.py"]\n{text}', encoding="utf-8")
    detector = base_camera(load_scene(scene, {"camera.width_px": 64, "camera.height_px": 48})).detector
    assert isinstance(detector, MosaicDetector)
    dark = np.zeros((48, 64), np.float32)
    without = Device(replace(sensor, effects=()), detector.seed, shape=dark.shape)
    gained_e = detector.device.expected_e(dark, 2.0) - without.expected_e(dark, 2.0)
    # 200 e/s for 2 s, at half a pixel's diagonal from the corner
    assert gained_e[0, 0] == pytest.approx(400 * np.exp(-np.sqrt(0.5) / 10), rel=1e-4)
    assert gained_e[-1, -1] < 1


@pytest.mark.usefixtures("undone")
def test_the_reflectance_is_lamberts_law_at_an_exponent_of_one(tmp_path: Path) -> None:
    write_template("reflectance", "own_law", tmp_path)
    path = write_template("scene", "first", tmp_path)
    text = path.read_text(encoding="utf-8").replace('\nmodel = "hapke"', '\nmodel = "own_law"\nexponent = 1.0', 1)
    path.write_text(f'plugins = ["own_law.py"]\n{text}', encoding="utf-8")
    model = load_scene(path).body.photometry
    assert type(model).__name__ == "OwnLaw"
    bands = model.at(np.array([550.0]), np.array([0.05]))
    light = [[0.6, 0, 0.8], [0.8, 0, -0.6]]
    np.testing.assert_allclose(radiance_factor(bands, light, [[0, 0, 1]]), [[0.04, 0]], atol=1e-12)


def test_a_sensor_without_sources_is_told_all_that_are_missing(tmp_path: Path) -> None:
    path = write_template("sensor", "chip", tmp_path)
    text = path.read_text(encoding="utf-8")
    path.write_text(text[: text.index("\n[sources]")], encoding="utf-8")
    with pytest.raises(InputError) as caught:
        load_sensor(path)
    for key in ("width_px", "pixel_pitch_um", "individual.prnu", "readout.bits", "transfer.row_readout_s"):
        assert key in str(caught.value)


def test_a_file_is_not_replaced_unless_asked(tmp_path: Path) -> None:
    path = write_template("lens", "glass", tmp_path)
    path.write_text("mine", encoding="utf-8")
    with pytest.raises(InputError, match=r"glass\.toml: exists already; --overwrite replaces it"):
        write_template("lens", "glass", tmp_path)
    assert path.read_text(encoding="utf-8") == "mine"
    write_template("lens", "glass", tmp_path, overwrite=True)
    assert load_lens(path).name == "glass"
    with pytest.raises(InputError, match=r"glass\.toml: is a file, not a folder; choose another --out"):
        write_template("lens", "glass", path)
    with pytest.raises(InputError, match="cannot be written: Not a directory"):
        write_template("lens", "glass", path / "within")


@pytest.mark.parametrize(
    ("kind", "name", "sentence"),
    [
        ("camera", "a", "new 'camera': must be one of scene, lens, sensor, fault, effect, reflectance"),
        ("lens", "../a", r"new lens '\.\./a': must be letters, digits, hyphens and underscores"),
        ("lens", "", "new lens '': must be letters"),
        ("fault", "My-fault", "new fault 'My-fault': must be lower-case letters, digits and underscores"),
        ("effect", "blooming", "new effect 'blooming': vbnfault has one of this name already; choose another"),
        ("fault", "vignetting", "new fault 'vignetting': vbnfault has one of this name already"),
        ("reflectance", "lambert", "new reflectance 'lambert': vbnfault has one of this name already"),
        ("effect", "lambda", "new effect 'lambda': must be .* and no keyword of Python"),
    ],
)
def test_bad_names_are_refused(kind: str, name: str, sentence: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=sentence):
        write_template(kind, name, tmp_path)
    assert not list(tmp_path.iterdir())
