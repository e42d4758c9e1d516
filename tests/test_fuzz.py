"""The fuzz notices what it looks for, and commands that are killed resume to one digest."""

from __future__ import annotations

import random
import subprocess
import sys
from pathlib import Path

import pytest
import typer
from tools import fuzz, fuzz_inputs

from vbnfault import cli
from vbnfault.core.errors import InputError


def outcome(monkeypatch: pytest.MonkeyPatch, folder: Path, main: object) -> str:
    """The problem that the command finds with a case in which the program does as `main`."""
    monkeypatch.setattr(fuzz, "CASES", {"scene": (lambda seeds, rng, here: (["list", "scenes"], {}), 1)})
    monkeypatch.setattr(cli, "main", main)
    # the peak is that of the whole process, here of all tests that ran before
    monkeypatch.setattr(fuzz, "MEMORY_BYTES", 1 << 50)
    seeds = object.__new__(fuzz.Seeds)
    seeds.folder = folder
    return str(fuzz.attempt(seeds, "s", 0)["problem"])


def test_tracebacks_silence_and_endless_messages_are_noticed(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def refuse(text: str) -> None:
        raise InputError(text)

    def endless() -> None:
        typer.echo("x" * 10_000, err=True)
        raise SystemExit(2)

    assert outcome(monkeypatch, tmp_path, lambda: None) == ""
    assert outcome(monkeypatch, tmp_path, lambda: 1 / 0) == "exit code -1"
    assert outcome(monkeypatch, tmp_path, lambda: refuse("a bug: main did not catch it")) == "exit code -1"
    assert (
        outcome(monkeypatch, tmp_path, lambda: (_ for _ in ()).throw(SystemExit(2))) == "exit code 2 without a word"
    )
    assert "characters" in outcome(monkeypatch, tmp_path, endless)


def test_damage_is_keyed_and_never_nothing() -> None:
    table = {"a": {"b": [1, 2.5, "text"]}, "c": True}
    differ = 0
    for number in range(200):
        one, same = (fuzz_inputs.changed(table, random.Random(f"s/{number}")) for _ in range(2))
        assert fuzz_inputs.toml_value(one) == fuzz_inputs.toml_value(same)
        differ += fuzz_inputs.toml_value(one) != fuzz_inputs.toml_value(table)
    assert differ > 180
    assert table == {"a": {"b": [1, 2.5, "text"]}, "c": True}
    data = bytes(range(256))
    assert sum(fuzz_inputs.flipped(data, random.Random(k), data) != data for k in range(200)) > 180


# --- some rounds of kills: builds, merges and exports that are killed and resumed have one digest -----------------


HERE = Path(__file__).resolve().parent


def test_killed_commands_resume_to_one_digest() -> None:
    """Other ways take longer; test_build_dask, test_object_store, test_retake, test_shard_range have them."""
    ways = ["process", "merge", "bucket", "export"]
    options = ["--each", "1", "--steps", "1", "--samples", "8", "--ways", *ways]
    command = [sys.executable, "-m", "tests.tools.kills", *options]
    done = subprocess.run(command, cwd=HERE.parent, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "one digest" in done.stdout
    table = done.stdout.split("digests\n")[1].splitlines()[: len(ways)]
    assert [int(line[34:40]) for line in table] == [1] * len(ways), done.stdout
