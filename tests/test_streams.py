"""Standard streams that are closed, full or that nobody reads: one sentence, the right exit code, nothing lost."""

from __future__ import annotations

import contextlib
import errno
import logging
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, TextIO

import pytest
from synthetic import run as build
from test_cli import run

from vbnfault import store
from vbnfault.core.process import streams


def test_the_library_warns_in_sentences_each_of_them_once(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    logger = logging.getLogger("vbnfault")
    for name, value in (("handlers", []), ("level", logger.level)):
        monkeypatch.setattr(logger, name, value)
    monkeypatch.setattr(streams.warnings, "showwarning", None)
    streams.warn_in_sentences()
    for _ in range(2):
        logger.warning("the root of s.zarr is damaged")
        logger.info("2 of 4 samples are taken")
    said = ["warning: the root of s.zarr is damaged", "note: 2 of 4 samples are taken"]
    assert capsys.readouterr().err.splitlines() == said


# arguments with which a command prints: its result, a table, a progress bar beside it, files, a sheet
COMMANDS = {
    "list": "faults",
    "describe": "quickstart --samples 8",
    "stats": "{}/s.zarr",
    "verify": "{}/s.zarr",
    "flare": "tessar_50_f2p8 --sun-deg 9 --model paraxial --pixels 16 --wavelength-nm 550 --out {}/f.png",
    "detector": "cmv4000 --out {}/d --pixels 64 --points 8 --stack 2",
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder that holds a store of made-up samples."""
    made = tmp_path_factory.mktemp("streams")
    build(made / "s.zarr", samples=2)
    return made


def arguments(name: str, folder: Path) -> list[str]:
    return [name, *(word.format(folder) for word in COMMANDS[name].split())]


@contextlib.contextmanager
def nobody_reads() -> Iterator[TextIO]:
    """A pipe whose reader has left."""
    reading, writing = os.pipe()
    os.close(reading)
    with contextlib.suppress(OSError), os.fdopen(writing, "w") as file:
        yield file


@contextlib.contextmanager
def full() -> Iterator[TextIO]:
    """A device without room."""
    with contextlib.suppress(OSError), open("/dev/full", "w") as file:
        yield file


@pytest.fixture(autouse=True)
def plan_of_made_up_samples(monkeypatch: pytest.MonkeyPatch) -> None:
    """Their scene is none that could be planned."""
    monkeypatch.setattr("vbnfault.dataset.identity.planned", lambda *_: None)
    monkeypatch.setattr("vbnfault.dataset.identity.check_described", lambda _: None)
    monkeypatch.setattr("vbnfault.dataset.identity.is_exact", lambda *_: False)


@pytest.mark.parametrize("name", COMMANDS)
def test_a_reader_that_leaves_ends_a_command_in_silence_and_a_full_disk_with_a_sentence(
    name: str, folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(monkeypatch, *arguments(name, folder)) == 0
    before = capsys.readouterr()
    assert before.out
    for opened, code, said in (
        (nobody_reads, 141, ""),
        (full, 1, f"vbnfault: standard output: {os.strerror(errno.ENOSPC)}\n"),
    ):
        with opened() as out, monkeypatch.context() as patch:
            patch.setattr(sys, "stdout", out)
            assert run(patch, *arguments(name, folder)) == code
        assert capsys.readouterr().err == before.err + said


@pytest.mark.parametrize("name", ["verify", "flare", "detector"])
def test_progress_is_shown_on_a_terminal_alone(
    name: str, folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(monkeypatch, *arguments(name, folder)) == 0
    assert capsys.readouterr().err == ""
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    assert run(monkeypatch, *arguments(name, folder)) == 0
    assert "100%" in capsys.readouterr().err


@pytest.mark.parametrize("opened", [nobody_reads, full])
def test_messages_that_nobody_reads_change_nothing(
    opened: Callable[[], Any], folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for words, code in (
        (arguments("describe", folder), 0),  # a warning
        (["list", "nothing"], 2),  # an error's sentence
        (["list"], 2),  # one of the parser
    ):
        assert run(monkeypatch, *words) == code
        printed = capsys.readouterr().out
        with opened() as err, monkeypatch.context() as patch:
            patch.setattr(sys, "stderr", err)
            assert run(patch, *words) == code
        assert capsys.readouterr().out == printed


def test_a_build_goes_on_where_nobody_reads_its_progress(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = build(tmp_path / "whole.zarr")
    with nobody_reads() as err, monkeypatch.context() as patch:
        patch.setattr(sys, "stderr", err)
        with streams.steady():
            done = build(tmp_path / "s.zarr", progress=True)
    assert (done.built, done.digest) == (whole.built, whole.digest)
    assert store.examine(tmp_path / "s.zarr").problems == []


@pytest.mark.parametrize("closed", [(0,), (1,), (2,), (0, 1, 2)])
def test_no_file_takes_the_number_of_a_closed_stream(closed: tuple[int, ...]) -> None:
    # what a library writes to its standard error would land in the file
    program = (
        "import os, sys, stat\n"
        "from vbnfault import cli\n"
        "from vbnfault.core.files import resources\n"
        "was, kinds = resources.packaged, []\n"
        "def looked_at(kind):\n"
        "    kinds.extend(stat.S_ISREG(os.fstat(n).st_mode) for n in range(3))\n"
        "    number = os.open(__import__('vbnfault').__file__, os.O_RDONLY)\n"
        "    os._exit(0 if number > 2 and not any(kinds) else 3)\n"
        "resources.packaged = looked_at\n"
        "sys.argv = ['vbnfault', 'list', 'scenes']\n"
        "cli.main()\n"
    )
    redirections = " ".join(f"{n}{'<' if n == 0 else '>'}&-" for n in closed)
    done = subprocess.run(
        ["sh", "-c", f'exec "$0" -c "$1" {redirections}', sys.executable, program],
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr


def test_with_standard_error_closed_its_messages_do_not_reach_standard_output(folder: Path) -> None:
    program = "import sys; from vbnfault import cli; sys.argv[0] = 'vbnfault'; cli.main()"
    done = subprocess.run(
        ["sh", "-c", 'exec "$0" -c "$1" digest "$2" 2>&-', sys.executable, program, str(folder / "s.zarr")],
        stdout=subprocess.PIPE,
        text=True,
    )
    assert done.returncode == 0
    assert done.stdout == store.digest(folder / "s.zarr") + "\n"
