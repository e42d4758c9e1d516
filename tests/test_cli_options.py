"""The options of all commands: their help is complete, and each is tried by some test."""

from __future__ import annotations

import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import typer.main
from typer.testing import CliRunner

from vbnfault import cli
from vbnfault.core.errors import InputError
from vbnfault.output.flare_images import RANGES

COMMANDS: dict[str, Any] = typer.main.get_command(cli.app).commands  # type: ignore[attr-defined]


def options() -> Iterator[tuple[str, Any]]:
    """Yield (command, option) of every option but `--help`."""
    for name, command in COMMANDS.items():
        for option in command.params:
            if option.param_type_name == "option" and "--help" not in option.opts:
                yield name, option


def limits(option: Any) -> tuple[float, float] | None:
    """The least and the largest number that an option takes, as its help says them; None if it takes no number."""
    found = re.fullmatch(r"(?:INTEGER|NUMBER) \((\S+) to (\S+)\)", option.metavar or "")
    return (float(found[1]), float(found[2])) if found else None


@cache
def help_of(command: str) -> str:
    """The help of a command as one line of words, without the frame around its tables."""
    shown = CliRunner().invoke(cli.app, [command, "--help"], env={"COLUMNS": "300", "TERMINAL_WIDTH": "300"})
    assert shown.exit_code == 0
    return re.sub(r"[│\s]+", " ", shown.output)


def test_help_shows_the_text_and_the_default_of_every_option() -> None:
    seen = 0
    for command, option in options():
        text = help_of(command)
        assert option.help, (command, option.name)
        assert option.help[-1] == ".", (command, option.name)
        assert option.help in text, (command, option.name)  # a [word] would be taken for markup
        if isinstance(option.show_default, str):
            seen += 1
            assert f"{option.help} [default: ({option.show_default})]" in text, (command, option.name)
        elif option.default is not None and option.default is not False and not option.required:
            seen += 1
            word = option.name if option.default is True else option.default
            assert f"{option.help} [default: {word}]" in text, (command, option.name)
    assert seen > 30


def test_help_shows_every_word_of_a_commands_text() -> None:
    for name, command in COMMANDS.items():
        assert " ".join(command.help.split()) in help_of(name), name  # a [word] would be taken for markup


def test_a_number_without_a_default_says_what_holds_instead() -> None:
    counts = {"append"}  # nothing is appended without it
    for command, option in options():
        if option.default is None and not option.required and limits(option):
            assert isinstance(option.show_default, str) or option.name in counts, (command, option.name)


def test_the_flares_options_have_the_limits_of_the_library() -> None:
    flare = [option for name, option in options() if name == "flare"]
    found = {option.name: limits(option) for option in flare if limits(option)}
    for name, low, high in RANGES:
        assert found.pop(name) == (low, high), name
    assert set(found) == {"wavelength_nm", "focal_length_mm", "sensor_width_mm", "reflections"}


def test_a_number_that_is_none_is_refused_in_a_sentence_with_the_limits() -> None:
    result = CliRunner().invoke(cli.app, ["describe", "quickstart", "--samples", "1e3"], env={"COLUMNS": "200"})
    assert result.exit_code == 2
    assert "Invalid value for '--samples': '1e3' must be a whole number from 1 to 10000000" in result.output


def test_a_path_to_write_is_no_url() -> None:
    """A path `s3://bucket/x` would make a folder `s3:` here."""
    stores = ("build", "merge", "retake", "migrate")  # their --out may be a URL, or is checked with the store
    seen = 0
    for command, option in options():
        if option.name in ("out", "json_", "toml") and command not in stores and not option.is_flag:
            for url in ("s3://bucket/x.png", "file:///data/x"):
                shown = CliRunner().invoke(cli.app, [command, option.opts[0], url])
                assert isinstance(shown.exception, InputError), (command, option.name)
                start = f"{option.opts[0]} {url.split(':')[0]}://"
                assert re.fullmatch(rf"{start}.*: is a URL; must be a path on this machine", str(shown.exception))
            for path, sentence in (
                (" ", "must be a path, and not empty"),
                ("/", "is the root folder; choose a folder"),
            ):
                refused = CliRunner().invoke(cli.app, [command, option.opts[0], path], env={"COLUMNS": "200"})
                assert (refused.exit_code, sentence in refused.output) == (2, True), (command, option.name)
            seen += 1
    assert seen == 22
    assert not Path("s3:").exists()


def test_every_option_is_named_in_a_test() -> None:
    texts = "".join(path.read_text(encoding="utf-8") for path in Path(__file__).parent.rglob("*.py"))
    missing = []
    for command, option in options():
        for name in option.opts:
            if not re.search(rf"{re.escape(name)}(?![\w-])", texts):
                missing.append(f"{command} {name}")
    assert not missing
