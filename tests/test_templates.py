"""Files that `vbnfault new` writes work as they are."""

from __future__ import annotations

import tomllib
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from vbnfault import cli, dataset, store
from vbnfault.core.errors import InputError
from vbnfault.core.quantities import Electrons
from vbnfault.detector import load_sensor
from vbnfault.faults import plugins
from vbnfault.faults.models import undoing_registrations
from vbnfault.lens import first_order, load_lens
from vbnfault.output import template_files
from vbnfault.output.template_files import write_template
from vbnfault.pipeline import configure_faults
from vbnfault.scene.config import load_scene
from vbnfault.testing import check_fault, make_context


def test_the_command_writes_each_kind(tmp_path: Path) -> None:
    for kind in template_files.KINDS:
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
    assert store.verify(tmp_path / "first.zarr") == []
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
    path.write_text(text, encoding="utf-8")
    scene = load_scene(path)
    assert scene.geometry.sun_averted is not None
    assert scene.geometry.sun_averted.reference == "nadir"
    assert (scene.camera.lens, scene.camera.detector) == ("tessar_50_f2p8", "generic_cmos")


def test_the_lens_and_the_sensor_are_read(tmp_path: Path) -> None:
    lens = load_lens(write_template("lens", "glass", tmp_path))
    assert lens.name == "glass"
    assert first_order(lens).efl_mm == pytest.approx(first_order(load_lens("tessar_50_f2p8")).efl_mm)
    sensor = load_sensor(write_template("sensor", "chip", tmp_path))
    assert (sensor.name, sensor.readout.bits) == ("chip", 12)


@pytest.fixture
def undone() -> Iterator[None]:
    """What a plug-in has registered is gone after the test."""
    with undoing_registrations(always=True):
        yield
        plugins.forget_all()


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
    with pytest.raises(InputError, match="cannot be written"):
        write_template("lens", "glass", path)


@pytest.mark.parametrize(
    ("kind", "name", "sentence"),
    [
        ("camera", "a", "new 'camera': must be one of scene, lens, sensor, fault"),
        ("lens", "../a", r"new lens '\.\./a': must be letters, digits, hyphens and underscores"),
        ("lens", "", "new lens '': must be letters"),
        ("fault", "My-fault", "new fault 'My-fault': must be lower-case letters, digits and underscores"),
    ],
)
def test_bad_names_are_refused(kind: str, name: str, sentence: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=sentence):
        write_template(kind, name, tmp_path)
    assert not list(tmp_path.iterdir())
