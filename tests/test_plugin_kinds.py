"""Plug-ins of every kind (fault, reflectance, detector effect, glass): where they act; one name, one definition."""

from __future__ import annotations

import importlib
import json
import pickle
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from conftest import Called
from test_plugins import GLINT, nothing_stays_loaded, plugin, scene_file

from vbnfault import dataset, faults, pipeline, reflectance, testing
from vbnfault.core.errors import InputError
from vbnfault.detector import effects
from vbnfault.scene import config

__all__ = ["nothing_stays_loaded"]  # a fixture of each test here

# --- other kinds of classes ---------------------------------------------------------------------------------

GROUND = '''
from typing import Literal

import numpy as np
from pydantic import Field

from vbnfault.detector.effects import Effect
from vbnfault.reflectance import DiscReflectance


class Glazed(DiscReflectance):
    """Reflect as a power of the cosine of incidence."""

    model: Literal["glazed"] = "glazed"
    power: int = Field(2, ge=1, le=4, description="power of the cosine")

    def disc(self, m, cos_i, cos_e, phase_deg):
        return cos_i * cos_i


class Pedestal(Effect):
    """Add electrons to every pixel."""

    name = "pedestal"
    after = "dark_current"

    level_e: float = Field(ge=0, le=1e5, description="added electrons")

    def apply(self, signal, exposure):
        return signal + np.float32(self.level_e)
'''
SENSOR = """
architecture = "cmos"
pixel_pitch_um = 5.5
[readout]
bits = 12
full_well_e = 13500.0
[effects.pedestal]
level_e = 2000.0
[sources]
pixel_pitch_um = "assumed"
"readout.bits" = "assumed"
"readout.full_well_e" = "assumed"
"effects.pedestal.level_e" = "assumed"
"""


def test_a_ground_and_a_detector_effect_come_from_a_plugin(tmp_path: Path) -> None:
    """The names in the scene's and the sensor's file are enough, also in another process, and edits are seen."""
    path = plugin(tmp_path, GROUND, "my_ground.py")
    (tmp_path / "mine.toml").write_text(SENSOR, encoding="utf-8")
    tables = '[body.photometry]\nmodel = "glazed"\npower = 3\n[camera]\ndetector = "mine.toml"\n'
    file = scene_file(tmp_path, "my_ground.py", faults=tables)
    scene = config.load_scene(file)
    assert scene.body.photometry.model_dump()["power"] == 3
    camera = pipeline.Session(scene).base_camera
    assert [effect.model_dump() for effect in camera.mosaic.sensor.effects] == [{"level_e": 2000.0}]
    assert any(
        line.startswith("detector: mine with pedestal, cmos") for line in dataset.describe_scene(scene, source="a")
    )
    with pytest.raises(InputError, match=r"effects = .*effects belong in the sensor file, as \[effects.NAME\]"):
        config.load_scene(file, {"effects.pedestal.level_e": 3.0})
    (tmp_path / "scene.pickle").write_bytes(pickle.dumps(scene))
    code = (
        f"import pickle; scene = pickle.load(open({str(tmp_path / 'scene.pickle')!r}, 'rb'))\n"
        "from vbnfault.world import assemble\n"
        "print(scene.body.photometry.power, assemble.ground_reflectance(scene).terms)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert (done.stdout.strip(), done.stderr) == ("3 1", "")
    path.write_text(GROUND.replace("le=4", "le=2"), encoding="utf-8")
    with pytest.raises(InputError, match=r"body.photometry.power = 3: must be a whole number from 1 to 2"):
        config.load_scene(file)


def test_a_detector_effect_behind_an_unknown_one_is_refused(tmp_path: Path) -> None:
    text = re.sub(r"(after.*= )\"\w+\"", r'\1"dark_curent"', GROUND)
    assert text != GROUND
    plugin(tmp_path, text, "my_ground.py")
    with pytest.raises(InputError, match=r"my_ground.py': .*after = 'dark_curent'.*did you mean dark_current"):
        config.load_scene(scene_file(tmp_path, "my_ground.py", faults=""))
    config.load_scene(scene_file(tmp_path, faults=""))


def test_a_sensor_with_an_effect_of_a_plugin_is_characterised(tmp_path: Path, call: Callable[..., Called]) -> None:
    path, sensor, out = plugin(tmp_path, GROUND, "my_ground.py"), tmp_path / "mine.toml", tmp_path / "mine"
    sensor.write_text(SENSOR, encoding="utf-8")
    small = ("--pixels", "64", "--points", "8", "--stack", "2", "--out", str(out))
    refused = call("detector", sensor, *small)
    assert refused.code == 2
    assert "--plugin" in refused.said
    assert not out.exists()
    done = call("detector", sensor, "--plugin", path, *small)
    assert done.code == 0, done.err
    assert ", with pedestal" in done.out
    assert json.loads((out / "emva1288.json").read_text())["effects"] == {"pedestal": {"level_e": 2000.0}}


def test_a_plugin_that_defines_a_known_reflectance_is_refused(tmp_path: Path) -> None:
    plugin(tmp_path, GROUND.replace("glazed", "lambert"), "my_ground.py")
    with pytest.raises(
        InputError,
        match=r"my_ground.py': .*ground reflectance lambert is defined twice: in .*disc.*py and in .*my_ground.py",
    ):
        config.load_scene(scene_file(tmp_path, "my_ground.py", faults=""))
    assert config.load_scene(scene_file(tmp_path, faults="")).body.photometry.model == "lambert"


# --- one name, one definition ---------------------------------------------------------------------------------

GLASS = """
from vbnfault.lens.glass import Glass, register

register(Glass(name="jelly", formula="cauchy", coefficients=(1.4, 0.0)))
"""
KINDS = {
    "fault": (GLINT, "fault model glint/square"),
    "ground": (GROUND.split("class Pedestal")[0], "ground reflectance glazed"),
    "effect": (GROUND.replace('"glazed"', '"frosted"'), "detector effect pedestal"),
    "glass": (GLASS, "glass jelly"),
}


def defined(kind: str) -> Any:
    """Return what the kind's plug-in has registered."""
    from vbnfault.lens.glass import GLASSES

    if kind == "fault":
        return faults.registry()["glint"]["square"]
    if kind == "ground":
        return reflectance.registry()["glazed"]
    return effects.registry()["pedestal"] if kind == "effect" else GLASSES["jelly"]


@pytest.mark.parametrize("kind", KINDS)
def test_two_files_that_define_one_name_are_refused(tmp_path: Path, kind: str) -> None:
    text, name = KINDS[kind]
    if kind == "effect":
        plugin(tmp_path, GROUND, "my_a.py")
    else:
        plugin(tmp_path, text, "my_a.py")
    changed = text.replace("1.4", "1.5")  # two glasses of one name and one index do not contradict
    plugin(tmp_path, changed, "my_b.py")
    sentence = rf"plugins = '.*my_b.py': {name} is defined twice: in .*my_a.py and in .*my_b.py"
    both = scene_file(tmp_path, "my_a.py", "my_b.py", faults="")
    with pytest.raises(InputError, match=sentence) as caught:
        config.load_scene(both)
    assert "\n" not in str(caught.value)

    config.load_scene(scene_file(tmp_path, "my_a.py", faults=""))
    first = defined(kind)
    with pytest.raises(InputError, match=sentence):  # a process keeps what it has loaded
        config.load_scene(scene_file(tmp_path, "my_b.py", faults=""))
    assert defined(kind) == first


@pytest.mark.parametrize("kind", KINDS)
def test_an_edited_file_is_loaded_again_and_a_broken_edit_leaves_nothing(tmp_path: Path, kind: str) -> None:
    text, _ = KINDS[kind]
    plugin(tmp_path, text, "my_a.py")
    file = scene_file(tmp_path, "my_a.py", faults="")
    config.load_scene(file)
    first = defined(kind)
    plugin(tmp_path, text.replace("1.4", "1.5") + "# edited\n", "my_a.py")
    config.load_scene(file)
    second = defined(kind)
    assert second != first
    plugin(tmp_path, text.replace("1.4", "1.6") + "1 / 0\n", "my_a.py")
    with pytest.raises(InputError, match="division by zero"):
        config.load_scene(file)
    assert defined(kind) == second
    plugin(tmp_path, text.replace("1.4", "1.5") + "# edited\n", "my_a.py")
    config.load_scene(file)
    assert defined(kind) == second


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("import_first", [True, False])
def test_one_file_is_one_definition_however_it_is_loaded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str, import_first: bool
) -> None:
    """A script may import a plug-in before or after it loads the scene that names it; the later load holds."""
    text, _ = KINDS[kind]
    name = f"my_same_{kind}_{import_first}"
    plugin(tmp_path, text, f"{name}.py")
    monkeypatch.syspath_prepend(str(tmp_path))
    file = scene_file(tmp_path, f"{name}.py", faults="")

    def load() -> None:
        config.load_scene(file)

    steps = [lambda: importlib.import_module(name), load]
    for step in steps if import_first else steps[::-1]:
        step()
    if kind != "glass":  # a glass is a value without a module
        assert defined(kind).__module__.startswith("vbnfault_plugin_") == import_first
    imported = sys.modules[name]
    load()
    if kind == "fault":
        testing.check_fault(imported.Glint, examples=1)
    if kind == "effect":
        testing.check_effect(imported.Pedestal, examples=1)
    load()


def test_only_the_plug_ins_own_lines_are_named(tmp_path: Path) -> None:
    """Neither a frame of pydantic nor one of numpy is of use to the author of a plug-in."""
    plugin(tmp_path, GROUND, "my_a.py")
    plugin(tmp_path, GROUND.replace('"glazed"', '"frosted"'), "my_b.py")
    with pytest.raises(InputError, match=r"pedestal is defined twice: .* \(my_b.py, line 21\)"):
        config.load_scene(scene_file(tmp_path, "my_a.py", "my_b.py", faults=""))
    plugin(tmp_path, "import numpy as np\nnp.zeros(2).reshape(3)\nnp.linalg.inv(np.zeros((2, 2)))\n", "my_a.py")
    with pytest.raises(InputError, match=r"\(my_a.py, line 2\)"):
        config.load_scene(scene_file(tmp_path, "my_a.py", faults=""))


def test_an_edited_helper_acts_at_once_and_in_no_other_case_matters(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The digest covers what the plug-in imports from its folder, and what runs is what the digest covers."""
    monkeypatch.syspath_prepend(str(tmp_path))
    package = tmp_path / "my_law"
    package.mkdir()
    for name, text in {
        "__init__": "",
        "base": "from .power import index\n",
        "power": "index = 1.4\n",
        "unused": "",
    }.items():
        plugin(package, text, f"{name}.py")
    plugin(tmp_path, "from my_law import base\n" + GLASS.replace("1.4", "base.index"), "my_a.py")
    file = scene_file(tmp_path, "my_a.py", faults="")

    def load() -> tuple[str, float]:
        config.load_scene(file)
        loaded = faults.loaded_plugin("my_a.py")
        assert loaded is not None
        return loaded.sha256, defined("glass").coefficients[0]

    importlib.import_module("my_law.power")  # the digest must not depend on what is imported already
    first = load()
    assert first[1] == 1.4
    plugin(package, "edited = True\n", "unused.py")
    assert load() == first
    plugin(package, "index = 1.25\n", "power.py")
    second = load()
    assert second[0] != first[0]
    assert second[1] == 1.25
    plugin(package, "index = 1 / 0\n", "power.py")
    with pytest.raises(InputError, match=r"division by zero \(power.py, line 1\)"):
        load()
    plugin(package, "index = 1.25\n", "power.py")
    assert load() == second
