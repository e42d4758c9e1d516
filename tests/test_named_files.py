"""Every key of a scene that names a file: what is wrong with it is said with scene, key and value."""

from __future__ import annotations

from pathlib import Path

import pytest
from typer.testing import CliRunner

from vbnfault import cli
from vbnfault.faults import path_fields, registry

# Key → suffix of the file, and the lines of a scene that name it.
KEYS = {
    "body.shape": ("obj", '[body]\nshape = "{}"'),
    "body.albedo_map.file": ("png", '[body.albedo_map]\nfile = "{}"'),
    "spacecraft.model": ("glb", '[spacecraft]\nmodel = "{}"'),
    "severity.file": ("toml", '[severity]\nfile = "{}"'),
    "camera.lens": ("toml", '[camera]\nlens = "{}"'),
    "camera.detector": ("toml", '[camera]\ndetector = "{}"'),
    "trajectory.file": ("csv", '[trajectory]\nfile = "{}"'),
    "spice.kernels": ("tls", '[spice]\nkernels = ["{}"]\ntarget = "X"'),
    "plugins": ("py", 'plugins = ["{}"]'),
    "faults.pixel_overwriting: texture_file": ("png", '[faults.pixel_overwriting]\ntexture_file = "{}"'),
    **{
        f"faults.straylight: {key}": ("png", f'[faults.straylight]\n{key} = ["{{}}"]')
        for key in ("close_textures", "far_textures", "glare_textures")
    },
    **{
        f"faults.{name}: lens": ("toml", f'[faults.{name}]\nmodel = "{model}"\nlens = "{{}}"')
        for name, model in (
            ("dust_on_optics", "defocused"),
            ("straylight", "traced"),
            ("straylight", "paraxial"),
            ("vignetting", "lens"),
            ("optics_degradation", "contamination"),
        )
    },
}


def describe(folder: Path, lines: str) -> str:
    """Return what `describe` says of a scene with these lines, which must be one sentence."""
    (folder / "my.toml").write_text(f'title = "t"\n{lines}\n')
    result = CliRunner().invoke(cli.app, ["describe", str(folder / "my.toml")])
    assert result.exit_code == 1, result.output
    error = result.exception
    assert type(error).__name__ == "InputError", error
    assert "\n" not in str(error)
    return str(error)


@pytest.mark.parametrize("key", KEYS)
def test_a_file_that_cannot_be_used_is_reported_with_scene_key_and_value(
    tmp_path: Path, key: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    suffix, lines = KEYS[key]
    for name, content in (("absent", None), ("folder", ""), ("empty", b""), ("garbage", b"\0\1garbage\xff" * 10)):
        path = tmp_path / f"{name}.{suffix}"
        if content == "":
            path.mkdir()
        elif content is not None:
            path.write_bytes(content)
        sentence = describe(tmp_path, lines.format(path.name))
        assert sentence.startswith(f"{tmp_path / 'my.toml'}: {key}"), sentence
        # SPICE takes any file; it is then without the data, and which of several files lacks them is unknown
        assert str(path) in sentence or (key, name) == ("spice.kernels", "garbage")


def test_no_key_of_a_fault_that_names_a_file_is_left_out() -> None:
    for name in registry():
        for key in path_fields(name):
            assert f"faults.{name}: {key}" in KEYS
