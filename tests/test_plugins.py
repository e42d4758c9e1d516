"""Faults from outside the package: found in every process, part of the scene's identity, and refused if broken."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import small_scene

from vbnfault import dataset, faults, pipeline, store
from vbnfault.core.errors import InputError
from vbnfault.core.registry import undoing_registrations
from vbnfault.faults import plugins
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
    with undoing_registrations(always=True):
        yield
        plugins.loaded.clear()
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
    from vbnfault.core.errors import InputChanged
    from vbnfault.core.files import file_contents

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
