"""Faults from outside the package: found in every process, part of the scene's identity, and refused if broken."""

from __future__ import annotations

import importlib
import json
import pickle
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import small_scene

from vbnfault import dataset, faults, pipeline, store, testing
from vbnfault.core.errors import InputError
from vbnfault.detector import effects
from vbnfault.faults import models, plugins
from vbnfault.scene import config

GLINT = '''
from dataclasses import dataclass

from vbnfault import Fault, Interval, bounds


@dataclass(frozen=True, kw_only=True)
class Glint(Fault):
    """Brighten a square."""

    fault = "glint"
    model = "square"
    default = True
    after = "straylight"
    step = "electrons"

    level: Interval = bounds(0.2, 0.9, limits=(0, 1), doc="added fraction of white")

    def draw(self, context, rng):
        return {"level": self.level.uniform(rng)}

    def apply(self, quantity, params, context):
        array = quantity.array.copy()
        array[4:12, 4:12] += params["level"] * quantity.white_e
        return quantity.with_array(array)

    def footprint(self, params, context):
        import numpy as np

        mask = np.zeros(context.shape, dtype=bool)
        mask[4:12, 4:12] = True
        return mask
'''


@pytest.fixture(autouse=True)
def nothing_stays_loaded() -> Iterator[None]:
    """Forget the plug-ins of a test, and its modules."""
    modules = set(sys.modules)
    with models.undoing_registrations(always=True):
        yield
        plugins.forget_all()
    for name in set(sys.modules) - modules:
        if name.startswith(("my_", "vbnfault_plugin_")):
            del sys.modules[name]


def plugin(folder: Path, text: str = GLINT, name: str = "my_glint.py") -> Path:
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path


def scene_file(folder: Path, *named: str, faults: str = "[faults.glint]\n", **tables: str) -> Path:
    """A small scene with plug-ins."""
    path = folder / "scene.toml"
    listed = ", ".join(f'"{name}"' for name in named)
    path.write_text(f'title = "t"\nplugins = [{listed}]\n{faults}', encoding="utf-8")
    return path


def small(path: Path, **overrides: Any) -> config.Scene:
    """The scene of a file, with few and small samples of a quickly made body."""
    dataset = {"samples": 4, "sites": 1, "layers": ["clean", "mask_effect"]}
    tables = small_scene(dataset=dataset, camera={"width_px": 48, "height_px": 48}, **overrides)
    keep = ("dataset", "patch", "camera", "render", "plan")
    return config.load_scene(path, {key: tables[key] for key in keep})


# --- loading ------------------------------------------------------------------------------------------------


def test_a_file_beside_the_scene_is_a_fault_like_any_other(tmp_path: Path) -> None:
    plugin(tmp_path)
    scene = config.load_scene(scene_file(tmp_path, "my_glint.py", faults="[faults.glint]\nlevel = 0.5\n"))
    assert scene.plugins == (str(tmp_path / "my_glint.py"),)
    (fault,) = pipeline.configure_faults(scene).values()
    assert fault.to_dict() == {"model": "square", "level": [0.5, 0.5]}
    assert faults.physical_order(["dust_on_optics", "glint", "straylight"]) == [
        "straylight",
        "glint",
        "dust_on_optics",
    ]
    assert list(faults.registry())[:6] == faults.dataset_order([*list(faults.registry())[:6], "glint"])[:6]
    with pytest.raises(InputError, match=r"faults.glint.level = 2: must be"):
        pipeline.configure_faults(scene.model_copy(update={"faults": {"glint": {"level": 2}}}))


def test_a_path_on_the_command_line_starts_from_the_working_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "here").mkdir()
    plugin(tmp_path / "here")
    monkeypatch.chdir(tmp_path / "here")
    (tmp_path / "there").mkdir()
    path = scene_file(tmp_path / "there")
    scene = config.load_scene(path, {"plugins": ["my_glint.py"]})
    assert scene.plugins == (str(tmp_path / "here" / "my_glint.py"),)


def test_a_module_is_imported_but_not_from_the_working_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plugin(tmp_path, name="my_glint_module.py")
    path = scene_file(tmp_path, "my_glint_module")
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend("")
    with pytest.raises(InputError, match=r"plugins = 'my_glint_module': no such module; install it"):
        config.load_scene(path)
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    monkeypatch.syspath_prepend(str(tmp_path))
    pipeline.configure_faults(config.load_scene(path))
    plugin(tmp_path, GLINT + "# edited\n", name="my_glint_module.py")
    with pytest.raises(InputError, match=r"plug-in my_glint_module has changed since this process loaded it"):
        pipeline.configure_faults(config.load_scene(path))


def test_a_new_model_of_a_known_class(tmp_path: Path) -> None:
    text = GLINT.replace('"glint"', '"vignetting"').replace('    default = True\n    after = "straylight"\n', "")
    plugin(tmp_path, text)
    path = scene_file(tmp_path, "my_glint.py", faults='[faults.vignetting]\nmodel = "square"\n')
    (fault,) = pipeline.configure_faults(config.load_scene(path)).values()
    assert (fault.fault, fault.model) == ("vignetting", "square")
    assert list(faults.registry()["vignetting"]) == ["cos4", "lens", "square"]


def test_a_key_that_holds_a_path_starts_from_the_scene_and_is_hashed(tmp_path: Path) -> None:
    key = '    level: Interval = bounds(0.2, 0.9, limits=(0, 1), doc="added fraction of white")\n'
    text = GLINT.replace(key, key + '    table: str = path(doc="spectrum of the glint")\n')
    plugin(tmp_path, text.replace("import Fault", "import path, Fault"))
    (tmp_path / "spectrum.csv").write_text("1,2\n")
    file = scene_file(tmp_path, "my_glint.py", faults='[faults.glint]\ntable = "spectrum.csv"\n')
    scene = config.load_scene(file)
    assert scene.faults["glint"]["table"] == str(tmp_path / "spectrum.csv")
    first = dataset.scene_identity(pipeline.Session(scene))
    (tmp_path / "spectrum.csv").rename(tmp_path / "renamed.csv")
    renamed = config.load_scene(file, {"faults.glint.table": str(tmp_path / "renamed.csv")})
    assert dataset.scene_identity(pipeline.Session(renamed)) == first
    (tmp_path / "renamed.csv").write_text("1,3\n")
    assert dataset.scene_identity(pipeline.Session(renamed)) != first


# --- entry points -------------------------------------------------------------------------------------------


def installed(folder: Path, value: str, name: str = "glints") -> None:
    """Make a folder on the import path look like an installed distribution with a plug-in."""
    info = folder / "my_distribution-1.0.dist-info"
    info.mkdir(exist_ok=True)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: my-distribution\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(f"[vbnfault.faults]\n{name} = {value}\n")


def run(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Run vbnfault in a process that has `folder` on its import path."""
    root = str(Path(faults.__file__).parents[2])
    script = f"import sys; sys.path[:0] = [{root!r}]; sys.path.append({str(folder)!r}); "
    script += f"sys.argv = ['vbnfault', *{list(arguments)!r}]; from vbnfault.cli import main; main()"
    return subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)


def test_an_installed_plug_in_is_known_without_being_named(tmp_path: Path) -> None:
    plugin(tmp_path, name="my_installed_glint.py")
    installed(tmp_path, "my_installed_glint:Glint")
    path = scene_file(tmp_path)
    done = run(tmp_path, "describe", str(path))
    assert done.returncode == 0, done.stderr
    assert "glint" in done.stdout
    listed = run(tmp_path, "list", "faults")
    assert "glint / square" in listed.stdout


@pytest.mark.parametrize(
    ("value", "sentence"),
    [
        ("my_missing_glint", "installed plug-in glints (my_missing_glint): no such module"),
        ("my_installed_glint:Nothing", "its module has no Nothing"),
    ],
)
def test_a_broken_installed_plug_in_is_named(tmp_path: Path, value: str, sentence: str) -> None:
    plugin(tmp_path, name="my_installed_glint.py")
    installed(tmp_path, value)
    done = run(tmp_path, "list", "faults")
    assert done.returncode == 2
    assert sentence in done.stderr
    assert done.stderr.count("\n") == 1


# --- a dataset ----------------------------------------------------------------------------------------------

EVERY = {"mode": "per_class", "faulty_fraction": 1.0}


def test_a_plug_in_through_the_store_and_back(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(tmp_path))
    text = GLINT.replace(
        "        array[4:12, 4:12]", "        from my_tools.size import square\n\n        array[square]"
    )
    source = plugin(tmp_path, text)
    (tmp_path / "my_tools").mkdir()
    helper = plugin(tmp_path / "my_tools", "square = slice(4, 12), slice(4, 12)\n", "size.py")
    scene = small(scene_file(tmp_path, "my_glint.py"), plan=EVERY)
    out = tmp_path / "store.zarr"
    summary = dataset.build_scene(scene, out, workers=2)
    assert summary.built == 4
    data = store.open_dataset(out)
    assert data["injected"].sel(fault="glint").values.all()
    assert data["mask"].sel(fault="glint").values.sum() == 4 * 64
    kept = data.attrs["scene"]["plugins"]["my_glint.py"]
    assert kept["models"] == ["glint/square"]
    np.testing.assert_array_equal(data["image"].values[2], pipeline.simulate(scene, 2).layers["image"])

    # another process, which knows nothing of the plug-in, verifies the store and names it
    done = run(tmp_path, "verify", str(out))
    assert done.returncode == 0, done.stderr
    assert f"the scene uses the plug-in my_glint.py (sha256 {kept['sha256'][:12]}, glint/square)" in done.stderr

    # the plug-in is part of what the store holds, and so is what it imports from its own folder
    for changed in (helper, source):
        kept_text = changed.read_text()
        changed.write_text(f"{kept_text}# edited\n")
        differs = r"scene.plugins.my_glint.py.sha256 is '\w+.* in the store and '\w+.* now"
        with pytest.raises(InputError, match=differs):
            dataset.build_scene(small(tmp_path / "scene.toml", plan=EVERY), out)
        changed.write_text(kept_text)
    assert dataset.build_scene(small(tmp_path / "scene.toml", plan=EVERY), out).built == 0
    source.unlink()
    with pytest.raises(InputError, match=r"my_glint.py: plug-in file not found"):
        config.load_scene(tmp_path / "scene.toml")


def test_a_plug_in_edited_during_a_build_stops_it(tmp_path: Path) -> None:
    plugin(tmp_path)
    scene = small(scene_file(tmp_path, "my_glint.py"), plan=EVERY)
    from vbnfault.core import file_contents
    from vbnfault.core.errors import InputChanged

    contents = file_contents.Contents()
    with contents.in_use():
        pipeline.Session(scene)
    contents.complete()
    plugin(tmp_path, GLINT.replace("4:12", "5:13"))
    factory = dataset.SessionFactory(scene, (4,), 1, contents)
    with pytest.raises(InputChanged, match=r"my_glint.py: plug-in file has changed since the build began"):
        factory()


def test_a_class_of_the_running_program_simulates_but_does_not_build(tmp_path: Path) -> None:
    import dataclasses

    @dataclasses.dataclass(frozen=True, kw_only=True)
    class Local(faults.Fault):
        fault, model, step = "local", "one", "rgbi"
        default, after = True, "adc"

    scene = config.parse_scene(small_scene(faults={"local": {}}), source="here")
    session = pipeline.Session(scene)
    with pytest.raises(
        InputError, match=r"faults.local.model = 'one': its class .*Local is defined in test_plugins"
    ):
        dataset.store_spec(session, (4,))


def test_a_plug_in_of_another_scene_has_to_be_named(tmp_path: Path) -> None:
    plugin(tmp_path)
    scene = config.load_scene(scene_file(tmp_path, "my_glint.py"))
    pipeline.configure_faults(scene)
    with pytest.raises(InputError, match=r"faults.glint.model = 'square': comes from the plug-in my_glint.py"):
        pipeline.configure_faults(scene.model_copy(update={"plugins": ()}))
    # two scenes may define the same class; the one that is used last holds
    (tmp_path / "b").mkdir()
    plugin(tmp_path / "b", GLINT.replace('"square"', '"disc"'), "my_other.py")
    other = config.load_scene(scene_file(tmp_path / "b", "my_other.py"))
    assert pipeline.configure_faults(other)["glint"].model == "disc"
    assert pipeline.configure_faults(scene)["glint"].model == "square"
    both = config.Scene.model_validate(scene.model_dump() | {"plugins": scene.plugins + other.plugins})
    with pytest.raises(InputError, match=r"my_other.py': fault model glint/disc: default = True, but glint/square"):
        pipeline.configure_faults(both)


@pytest.mark.parametrize("kind", ["fault", "effect"])
def test_a_plug_in_of_another_scene_has_no_place_in_the_order(tmp_path: Path, kind: str) -> None:
    """What a scene may name by `after`, and what it is refused for, do not depend on scenes loaded before it."""
    text, own, root = {"fault": (GLINT, "glint", "straylight"), "effect": (EFFECT, "afterglow", "dark_current")}[
        kind
    ]

    def write(name: str, after: str, known: str | None = None) -> None:
        changed = text.replace(f'"{own}"', f'"{name}"').replace(f'"{root}"', f'"{after}"')
        plugin(tmp_path, changed if known is None else f"# {name} is {known}\n", f"my_{name}.py")

    def load(*names: str) -> None:
        config.load_scene(scene_file(tmp_path, *(f"my_{name}.py" for name in names), faults=""))

    def order() -> list[str]:
        known = faults.physical_order(faults.registry()) if kind == "fault" else effects.order()
        return [name for name in known if name in ("one", "two", "three")]

    write("one", root)
    write("two", "one")
    write("three", "one")
    load("one", "two")
    assert order() == ["one", "two"]
    with pytest.raises(InputError, match=r"my_three.py': .* three: after = 'one': there is none of this name"):
        load("three")  # a fresh process knows no `one`
    load("two", "one")
    write("one", root, known="gone")
    load("one")  # `two` of the earlier scene comes after nothing now, which is not this scene's fault
    assert order() == []
    with pytest.raises(InputError, match=r"two: after = 'one': there is none of this name"):
        load("one", "two")


# --- broken plug-ins ----------------------------------------------------------------------------------------

EFFECT = """
from vbnfault import Effect


class Afterglow(Effect):
    name = "afterglow"
    after = "dark_current"

    def apply(self, signal, exposure):
        return signal
"""
LAW = """
from typing import Literal

from vbnfault.reflectance import DiscReflectance


class Law(DiscReflectance):
    model: Literal["law"] = "law"

    def disc(self, m, cos_i, cos_e, phase_deg):
        return cos_i
"""
BROKEN = {
    "effect without after": (
        EFFECT.replace('    after = "dark_current"\n', ""),
        r"detector effect class Afterglow: states no after \(my_glint.py, line 5\)",
    ),
    "effect without name": (
        EFFECT.replace('    name = "afterglow"\n', ""),
        r"effect class Afterglow: states no name \(my_glint.py, line 5\)",
    ),
    "effect without all": (
        EFFECT[: EFFECT.index("    name")] + "    pass\n",
        r"effect class Afterglow: states no name, states no after, has no method apply \(my_glint.py, line 5\)",
    ),
    "effect without apply": (EFFECT.replace("def apply", "def aply"), r"Afterglow: has no method apply \(my_gl"),
    "effect with a typed name": (EFFECT.replace("name =", "name: str ="), r"write name: ClassVar\[str\] = \.\.\. "),
    "effect with a space": (
        EFFECT.replace('"afterglow"', '"after glow"'),
        r"name = 'after glow': must be lower",
    ),
    "law without name": (
        LAW.replace('    model: Literal["law"] = "law"\n', ""),
        r"ground reflectance class Law: states no model \(my_glint.py, line 7\)",
    ),
    "law without hook": (LAW.replace("def disc", "def disk"), r"reflectance class Law: has no method disc \(my_gl"),
    "syntax": ("def f(:\n", r"cannot be loaded: SyntaxError: invalid syntax .*line 1"),
    "import": ("import my_nothing\n", r"ModuleNotFoundError: No module named 'my_nothing' \(my_glint.py, line 1\)"),
    "error": ("\n1 / 0\n", r"ZeroDivisionError: division by zero \(my_glint.py, line 2\)"),
    "exit": ("import sys\nsys.exit('no')\n", r"SystemExit: no"),
    "clash": (
        GLINT.replace('"glint"', '"dust_on_optics"').replace('"square"', '"gaussian"'),
        r"fault model dust_on_optics/gaussian is defined twice: in .*dust.py and in .*my_glint.py",
    ),
    "default": (GLINT.replace('"glint"', '"vignetting"'), r"default = True, but vignetting/cos4 is the default"),
    "order": (GLINT.replace('"straylight"', '"strailight"'), r"after = 'strailight': .* \(did you mean straylight"),
    "circle": (
        GLINT.replace('"straylight"', '"glint"'),
        r"fault class: what glint state by `after` runs in a circle",
    ),
    "step": (GLINT.replace('"electrons"', '"light", "raw"'), r"my_glint.py, line"),
    "no step": (GLINT.replace('    step = "electrons"\n', ""), r"fault model glint/square: states no step"),
    "no dataclass": (GLINT.replace("@dataclass(frozen=True, kw_only=True)\n", ""), r"must be decorated with @data"),
    "field": (
        GLINT.replace("level: Interval = bounds", "x: int = 3\n    level: Interval = bounds"),
        r"x must be dec",
    ),
}


@pytest.mark.parametrize("kind", BROKEN)
def test_a_broken_plug_in_is_refused_in_one_sentence(tmp_path: Path, kind: str) -> None:
    text, sentence = BROKEN[kind]
    plugin(tmp_path, text)
    path = scene_file(tmp_path, "my_glint.py")
    before = {name: list(of) for name, of in faults.registry().items()}
    for _ in range(2):  # nothing of it stays behind
        with pytest.raises(InputError, match=sentence) as caught:
            config.load_scene(path)
        assert str(caught.value).startswith(f"{path}: plugins = '{tmp_path}/my_glint.py': ")
        assert "\n" not in str(caught.value)
        assert {name: list(of) for name, of in faults.registry().items()} == before
    plugin(tmp_path)
    pipeline.configure_faults(config.load_scene(path))


@pytest.mark.parametrize(
    ("named", "sentence"),
    [
        (
            "my glint",
            r"plugins = 'my glint': must be the name of a module, or the path of a file that ends with .py",
        ),
        ("folder/glint", r"unsupported plug-in type ''; allowed are .py|plug-in file not found"),
        ("nowhere.py", r"nowhere.py: plug-in file not found"),
        ("", r"plugins.*"),
    ],
)
def test_what_is_no_plug_in_is_refused(tmp_path: Path, named: str, sentence: str) -> None:
    with pytest.raises(InputError, match=sentence):
        config.load_scene(scene_file(tmp_path, named))


def test_two_plug_ins_of_one_name_are_refused(tmp_path: Path) -> None:
    (tmp_path / "b").mkdir()
    plugin(tmp_path)
    plugin(tmp_path / "b", "")
    with pytest.raises(InputError, match=r"plug-in file is empty"):
        config.load_scene(scene_file(tmp_path, "my_glint.py", "b/my_glint.py"))
    plugin(tmp_path / "b", "# nothing\n")
    with pytest.raises(InputError, match=r"another plug-in of the scene has the name my_glint.py"):
        config.load_scene(scene_file(tmp_path, "my_glint.py", "b/my_glint.py"))


def test_the_command_line_loads_plug_ins(tmp_path: Path) -> None:
    path = plugin(tmp_path)
    listed = run(tmp_path, "list", "faults", "--plugin", str(path))
    assert "glint / square (default model)\n    level = [0.2, 0.9]    added fraction of white" in listed.stdout
    plugin(tmp_path, BROKEN["order"][0])
    refused = run(tmp_path, "describe", str(scene_file(tmp_path, "my_glint.py")))
    assert refused.returncode == 2
    assert refused.stderr.count("\n") == 1


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


def test_a_sensor_with_an_effect_of_a_plugin_is_characterised(tmp_path: Path) -> None:
    path, sensor, out = plugin(tmp_path, GROUND, "my_ground.py"), tmp_path / "mine.toml", tmp_path / "mine"
    sensor.write_text(SENSOR, encoding="utf-8")
    small = ("--pixels", "64", "--points", "8", "--stack", "2", "--out", str(out))
    refused = run(tmp_path, "detector", str(sensor), *small)
    assert refused.returncode == 2
    assert "--plugin" in refused.stderr
    assert not out.exists()
    done = run(tmp_path, "detector", str(sensor), "--plugin", str(path), *small)
    assert done.returncode == 0, done.stderr
    assert ", with pedestal" in done.stdout
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
    from vbnfault import reflectance
    from vbnfault.lens.glass import GLASSES

    if kind == "fault":
        return faults.registry()["glint"]["square"]
    if kind == "ground":
        return reflectance.registry()["glazed"]
    return effects.registry()["pedestal"] if kind == "effect" else GLASSES["jelly"]


@pytest.mark.parametrize("kind", KINDS)
def test_two_files_that_define_one_name_are_refused_together_only(tmp_path: Path, kind: str) -> None:
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

    def load(*names: str) -> Any:
        config.load_scene(scene_file(tmp_path, *names, faults=""))
        return defined(kind)

    first, second = load("my_a.py"), load("my_b.py")  # each alone, and the scene in use decides
    assert first != second
    assert load("my_a.py") == first
    with pytest.raises(InputError, match=sentence):  # also where both have been loaded before
        load("my_a.py", "my_b.py")
    assert load("my_b.py") == second


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
        assert models.is_registered(imported.Glint)
        assert models.registry()["glint"]["square"] is imported.Glint
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
