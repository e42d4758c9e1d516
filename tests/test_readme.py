"""Every command and code block of the README runs as printed, on small images.

The commands run in order, in one folder, in this process. What is added to a command makes it smaller, never
different: image size, terrain and number of samples. `pip` and the developers' commands are what continuous
integration itself runs.
"""

from __future__ import annotations

import itertools
import re
import shlex
import sys
from pathlib import Path

import pytest

from vbnfault import cli
from vbnfault.body import load_body

README = (Path(__file__).parents[1] / "README.md").read_text(encoding="utf-8")

# run by continuous integration before the tests, on the whole project
_OF_DEVELOPERS = ("pip", "pytest", "ruff", "mypy", "python -m pytest")
_SMALL_SCENE = ("camera.width_px=64", "camera.height_px=64", "patch.facet_m=12", "patch.radius_m=60")
_SMALLER = {
    "build": [word for key in (*_SMALL_SCENE, "patch.min_boulder_m=6") for word in ("--set", key)],
    "render": [word for key in (*_SMALL_SCENE, "patch.min_boulder_m=6") for word in ("--set", key)],
    "detector": ["--pixels", "64", "--points", "12", "--stack", "4"],
    "flare": ["--pixels", "64"],
}
# the documented count → one with which the command takes seconds
_FEWER = {"--samples": {"40": "4", "16": "2"}, "--append": {"100": "2"}, "--sample": {"7": "3"}}


def blocks(language: str) -> list[str]:
    """The README's fenced code blocks in a language, in order."""
    return re.findall(rf"^```{language}\n(.*?)^```", README, flags=re.DOTALL | re.MULTILINE)


def commands() -> list[list[str]]:
    """Every command of the README's shell blocks, in order, as words."""
    out = []
    for line in "".join(blocks("sh")).replace("\\\n", " ").splitlines():
        words, part = shlex.split(line, comments=True), []
        for word in [*words, "&&"]:
            if word == "&&":
                out.append(part)
                part = []
            else:
                part.append(word)
    return [words for words in out if words]


def smaller(words: list[str]) -> list[str]:
    """The command on small images, with few samples."""
    out = list(words)
    for k, (option, value) in enumerate(itertools.pairwise(words)):
        out[k + 1] = _FEWER.get(option, {}).get(value, value)
    return out + _SMALLER.get(words[1], [])


def smaller_scene(code: str) -> str:
    """The Python block with the scene that it loads on small images."""
    values = dict(setting.split("=") for setting in (*_SMALL_SCENE, "patch.min_boulder_m=6"))
    small = {key: float(value) if key.startswith("patch.") else int(value) for key, value in values.items()}
    return code.replace('load_scene("quickstart")', f'load_scene("quickstart", {small})')


def test_every_line_of_a_shell_block_is_a_known_command() -> None:
    assert len(commands()) > 15
    for words in commands():
        line = " ".join(words)
        assert words[0] == "vbnfault" or line.startswith(_OF_DEVELOPERS), line


def test_commands_and_python_blocks_run_in_order(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    # the README's example of a user's own shape: the real comet's name, the embedded body's form
    body = load_body("embedded")
    rows = [f"v {x:.3f} {y:.3f} {z:.3f}" for x, y, z in body.vertices_m]
    rows += [f"f {a} {b} {c}" for a, b, c in body.faces + 1]
    Path("67p.obj").write_text("\n".join(rows) + "\n", encoding="utf-8")
    for words in commands():
        if words[0] != "vbnfault":
            continue
        arguments = smaller(words)
        monkeypatch.setattr(sys, "argv", arguments)
        with pytest.raises(SystemExit) as ended:
            cli.main()
        said = capsys.readouterr()
        assert not ended.value.code, f"{shlex.join(arguments)}: {said.err}"
        for option, value in itertools.pairwise(arguments):
            if option in ("--out", "--json", "--toml"):
                assert Path(value).exists(), f"{shlex.join(arguments)} wrote no {value}"
    for code in blocks("python"):
        names: dict[str, object] = {}
        exec(compile(smaller_scene(code), "README.md", "exec"), names)
        assert names


def test_inline_commands_name_real_commands() -> None:
    known = {command.name or command.callback.__name__ for command in cli.app.registered_commands}  # type: ignore[union-attr]
    named = set(re.findall(r"`vbnfault ([a-z]+)", README)) | {w[1] for w in commands() if w[0] == "vbnfault"}
    assert len(named) > 8
    assert {name.replace("list_", "list") for name in known} >= named
