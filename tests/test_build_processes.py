"""Builds in several processes, killed and interrupted: the same bits, and no finished sample is lost."""

from __future__ import annotations

import multiprocessing
import os
import re
import resource
import signal
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from synthetic import SAMPLES, Deadly, Session, make_spec, run
from tools import victim

from vbnfault import store as st
from vbnfault.core.errors import VbnfaultError
from vbnfault.core.quantities import Sample
from vbnfault.dataset import processes
from vbnfault.dataset.tasks import BuildFailed

HERE = Path(__file__).resolve().parent


def test_two_workers_make_the_same_bits_and_share_the_work(undisturbed: tuple[Path, str], tmp_path: Path) -> None:
    log = tmp_path / "log"
    summary = run(tmp_path / "s.zarr", Session(log=str(log)), workers=2, recycle_shards=2)
    assert st.digest(tmp_path / "s.zarr") == undisturbed[1]
    assert summary.digest == undisturbed[1]
    calls = [line.split() for line in log.read_text().splitlines()]
    assert sorted(int(i) for _, i in calls) == list(range(SAMPLES))
    # 5 shards by processes that end after 2 each: at least 3 processes, none of them this one
    assert len({pid for pid, _ in calls} - {str(os.getpid())}) >= 3


def test_a_warning_of_a_worker_is_one_sentence(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    run(tmp_path / "s.zarr", Session(warns="site 3: the ground is coarse"), workers=2, samples=8)
    said = capfd.readouterr().err.splitlines()
    assert said
    assert set(said) == {"warning: site 3: the ground is coarse"}


def test_workers_run_no_python_files_of_the_working_folder(
    undisturbed: tuple[Path, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "data"
    folder.mkdir()
    for name in ("random", "signal", "struct", "tempfile", "numpy", "zarr", "numcodecs"):
        (folder / f"{name}.py").write_text(f"open({str(tmp_path / 'run')!r}, 'a').write('{name} ')")
    monkeypatch.chdir(folder)
    monkeypatch.setattr(sys, "path", ["", *sys.path])  # as at the prompt, and under python -m
    run(tmp_path / "s.zarr", workers=2)
    assert not (tmp_path / "run").exists(), (tmp_path / "run").read_text()
    assert st.digest(tmp_path / "s.zarr") == undisturbed[1]
    assert sys.path[0] == ""
    assert "PYTHONSAFEPATH" not in os.environ


def build_elsewhere(
    out: Path, workers: int = 1, *, main: Sequence[dict] = (), worker: Sequence[dict] = (), samples: int = SAMPLES
) -> subprocess.CompletedProcess[str]:
    """A build of made-up samples in a process that follows a plan of signals; see `victim`."""
    return victim.run(["build", out, workers, samples], main=main, worker=worker)


@pytest.mark.parametrize("before", ["unlink", "mkdir"])
def test_a_folder_that_another_worker_makes_at_the_same_time_is_used(
    undisturbed: tuple[Path, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, before: str
) -> None:
    # two workers write their first shards of an array: the other one is always a moment earlier
    slower = getattr(os, before)
    made = []

    def late(path: Any, *args: Any, **kwargs: Any) -> None:
        if Path(path).name == "c" and Path(path).parent.is_dir() and not Path(path).exists():
            os.makedirs(Path(path).parent / "c2")
            os.rename(Path(path).parent / "c2", path)
            made.append(path)
        slower(path, *args, **kwargs)

    out = tmp_path / "s.zarr"
    st.create(out, make_spec(attributes={**make_spec().attributes, "blocks": [SAMPLES]}), SAMPLES)
    monkeypatch.setattr(os, before, late)
    run(out)
    assert made
    assert st.digest(out) == undisturbed[1]


@pytest.mark.parametrize(("workers", "number"), [(1, "SIGINT"), (1, "SIGTERM"), (2, "SIGHUP"), (2, "SIGINT")])
def test_an_interrupt_keeps_what_was_made(
    undisturbed: tuple[Path, str], tmp_path: Path, workers: int, number: str
) -> None:
    out = tmp_path / "stores" / "s.zarr"
    out.parent.mkdir()
    # while the second shard is written, by a process that made others of it before
    to = "group" if number != "SIGTERM" else "self"
    # once: a second signal would end the build without waiting for the workers
    step = victim.step("write", text="done/c/", number=number, to=to, once=str(tmp_path / "sent"))
    done = build_elsewhere(out, workers, **{"main" if workers == 1 else "worker": [step]})
    assert done.returncode == 128 + getattr(signal, number), done.stderr
    assert "Traceback" not in done.stderr
    match = re.fullmatch(
        r".*interrupted; (\d+) of 18 samples are finished, and the same command resumes\n", done.stderr
    )
    assert match, done.stderr
    finished = int(match[1])
    assert 1 <= finished < SAMPLES  # the shard in work was kept
    assert st.open_store(out).finished() == finished
    assert run(out).built == SAMPLES - finished
    assert st.digest(out) == undisturbed[1]
    assert [p.name for p in out.parent.iterdir()] == ["s.zarr"]


@pytest.mark.parametrize(("sent", "signalled"), [(False, "kill"), (True, "terminate")])
def test_a_worker_that_has_reported_has_time_to_write(
    monkeypatch: pytest.MonkeyPatch, sent: bool, signalled: str
) -> None:
    """Its report counts although the parent has not read it yet."""
    calls: list[str] = []
    monkeypatch.setattr(processes._Process, "__init__", lambda self: None)
    worker = processes._Process()  # type: ignore[call-arg]
    worker.has_reported = False
    worker.process = SimpleNamespace(kill=lambda: calls.append("kill"), terminate=lambda: calls.append("terminate"))  # type: ignore[assignment]
    worker.pipe, other = multiprocessing.Pipe()
    with other:
        if sent:
            other.send((0, "begun", ""))
        worker.stop(at_once=True)
    assert calls == [signalled]


def test_ctrl_c_as_workers_start_twice_leaves_nobody(tmp_path: Path) -> None:
    # the second one while the first is obeyed: as it kills the workers, which have done nothing yet
    twice = [victim.step("start", count=2, number="SIGINT", to="group")]
    twice += [victim.step("kill", number="SIGINT", to="group")]
    done = build_elsewhere(tmp_path / "s.zarr", 3, main=twice)
    assert done.returncode == 130
    assert re.fullmatch(r".*interrupted; 0 of 18 samples .*\n", done.stderr), done.stderr
    assert run(tmp_path / "s.zarr").built == SAMPLES


def test_a_worker_that_dies_costs_its_sample_alone(undisturbed: tuple[Path, str], tmp_path: Path) -> None:
    out = tmp_path / "s.zarr"
    with pytest.raises(BuildFailed, match=r"sample 6 failed.*worker process was killed \(signal 9.*twice"):
        run(out, Session(dies=frozenset({6})), workers=2)
    assert st.problem_samples(out) == [6]
    assert run(out).built == 1
    assert st.digest(out) == undisturbed[1]


def test_a_worker_that_dies_once_is_replaced(undisturbed: tuple[Path, str], tmp_path: Path) -> None:
    session = Session(dies=frozenset({6}), dies_once=str(tmp_path / "died"))
    assert run(tmp_path / "s.zarr", session, workers=2).built == SAMPLES
    assert (tmp_path / "died").exists()
    assert st.digest(tmp_path / "s.zarr") == undisturbed[1]


def test_workers_that_die_between_samples_are_replaced(
    undisturbed: tuple[Path, str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    died = tmp_path / "died"
    died.mkdir()
    assert run(tmp_path / "s.zarr", Session(dies_writing=str(died)), workers=2, progress=True).built == SAMPLES
    assert len(list(died.iterdir())) == 2
    assert st.digest(tmp_path / "s.zarr") == undisturbed[1]
    said = capsys.readouterr().err
    assert "None" not in said
    for shard in range(2):
        assert re.search(rf"shard {shard}: .*killed \(signal 9.*while no sample was in work; trying again", said)


def test_workers_that_cannot_begin_end_the_build(tmp_path: Path) -> None:
    with pytest.raises(VbnfaultError, match=r"shard \d: .*killed.* twice while no sample was in work; finished"):
        run(tmp_path / "s.zarr", Deadly(), workers=2)


@dataclass(frozen=True)
class FullDisk(Session):
    """From sample 9 on, no file of this process can grow beyond 100 bytes."""

    def simulate(self, index: int) -> Sample:
        if index == 9:
            resource.setrlimit(resource.RLIMIT_FSIZE, (100, resource.getrlimit(resource.RLIMIT_FSIZE)[1]))
        return Session.simulate(self, index)


@pytest.mark.parametrize("workers", [1, 2])
def test_a_full_disk_ends_the_build_and_the_same_command_resumes(
    undisturbed: tuple[Path, str], tmp_path: Path, workers: int
) -> None:
    out, before = tmp_path / "s.zarr", resource.getrlimit(resource.RLIMIT_FSIZE)
    try:
        with pytest.raises(
            VbnfaultError, match=r"File too large while writing samples 8-11; finished .* stay"
        ) as e:
            run(out, FullDisk(), workers=workers)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert e.value.exit_code == 1
    assert not list(out.rglob("*.partial"))
    finished = st.open_store(out).finished()
    assert run(out).built == SAMPLES - finished
    assert st.digest(out) == undisturbed[1]
