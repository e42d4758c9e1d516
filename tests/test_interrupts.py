"""Signals that arrive in odd moments end a command all the same: with one sentence, and nothing half written."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import signal_moments
import typer
from synthetic import SAMPLES, Session
from synthetic import run as build
from test_cli import run

from vbnfault import store
from vbnfault.core.errors import InputError
from vbnfault.core.files import resources
from vbnfault.core.process import interrupts
from vbnfault.core.process.interrupts import Interrupted
from vbnfault.core.quantities import Sample

SENTENCE = "vbnfault: interrupted; the files written so far stay, and the same command continues the work\n"
NUMBERS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


@pytest.fixture(autouse=True)
def handlers() -> Iterator[None]:
    """A command that is interrupted leaves the terminal's signals ignored, which here would last."""
    before = [signal.getsignal(number) for number in NUMBERS]
    yield
    for number, handler in zip(NUMBERS, before, strict=True):
        signal.signal(number, handler)


def in_a_destructor(number: int) -> None:
    """Python reports and drops what a destructor raises."""

    class Passing:
        def __del__(self) -> None:
            signal.raise_signal(number)

    Passing()


def replaced(number: int) -> None:
    """Code in C replaces exceptions, as matplotlib's Agg does while it draws a lens."""
    try:
        signal.raise_signal(number)
    except BaseException:
        raise ValueError("Invalid bounding box") from None


def replaced_below(number: int) -> None:
    """A library function such as `build` has an interruptible block of its own, within that of the command."""
    with interrupts.interruptible():
        replaced(number)


@pytest.mark.parametrize("number", NUMBERS)
@pytest.mark.parametrize("arrive", [signal.raise_signal, in_a_destructor, replaced, replaced_below])
def test_a_signal_ends_a_command_wherever_it_arrives(
    arrive: Callable[[int], None],
    number: int,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    signal.signal(number, signal.default_int_handler)  # also where the tests run under nohup

    def interrupted(_: str) -> dict[str, Path]:
        arrive(number)
        return {}

    hook = sys.unraisablehook
    monkeypatch.setattr(resources, "packaged", interrupted)
    assert run(monkeypatch, "list", "lenses") == 128 + number
    assert capsys.readouterr().err == SENTENCE
    assert sys.unraisablehook is hook
    # and it is forgotten
    monkeypatch.setattr(resources, "packaged", lambda _: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        run(monkeypatch, "list", "lenses")


def test_at_every_moment_signals_end_the_command_with_one_sentence() -> None:
    """From the first import of the command line until its outcome is known; later ones change nothing."""
    command = [sys.executable, signal_moments.__file__, "3", "90", "--version"]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    ended = [json.loads(line) for line in done.stdout.splitlines() if line.startswith("[")]
    known = next(k for k, (_, code, _) in enumerate(ended) if code == 0)
    assert known > 20
    for k, (number, *outcome) in enumerate(ended):
        assert outcome == ([128 + number, SENTENCE] if k < known else [0, ""])
    assert done.stderr == ""


def test_more_signals_after_the_sentence_change_nothing(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    echo = typer.echo

    def echo_and_arrive(*args: object, **kwargs: bool) -> None:
        echo(*args, **kwargs)
        signal.raise_signal(signal.SIGINT)
        signal.raise_signal(signal.SIGHUP)

    monkeypatch.setattr(resources, "packaged", lambda _: signal.raise_signal(signal.SIGINT))
    monkeypatch.setattr(typer, "echo", echo_and_arrive)
    assert run(monkeypatch, "list", "lenses") == 130
    assert capsys.readouterr().err == SENTENCE


def misread(number: int) -> None:
    """Code that imports or reads something reports any failure as the user's."""
    try:
        signal.raise_signal(number)
    except BaseException:
        raise InputError("body.shape = 'x.obj': cannot be read") from None


@pytest.mark.parametrize("arrive", [signal.raise_signal, replaced, misread])
def test_a_build_that_ends_before_its_first_sample_says_so(
    arrive: Callable[[int], None], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The first session imports drjit, whose C code replaces exceptions."""
    monkeypatch.setattr(Session, "__call__", lambda _: arrive(signal.SIGTERM))
    with pytest.raises(Interrupted, match="interrupted; 0 of 18 samples are finished") as stopped:
        build(tmp_path / "s.zarr")
    assert stopped.value.exit_code == 143


@pytest.mark.parametrize("arrive", [in_a_destructor, replaced])
def test_a_sample_never_fails_of_a_signal(
    arrive: Callable[[int], None], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    simulate = Session.simulate

    def interrupted(self: Session, index: int) -> Sample:
        if index == 6:
            arrive(signal.SIGTERM)
        return simulate(self, index)

    with monkeypatch.context() as patch:
        patch.setattr(Session, "simulate", interrupted)
        with pytest.raises(Interrupted, match=r"interrupted; \d+ of 18 samples are finished") as stopped:
            build(tmp_path / "s.zarr")
    assert stopped.value.exit_code == 128 + signal.SIGTERM
    finished = store.open_store(tmp_path / "s.zarr").finished()
    assert f" {finished} of 18 samples" in str(stopped.value)
    assert 2 <= finished < SAMPLES  # 4 and 5 at least: of the first shard, as sites come
    assert build(tmp_path / "s.zarr").built == SAMPLES - finished
    assert not list((tmp_path / "s.zarr").rglob("*.partial"))
