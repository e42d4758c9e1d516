"""Builds: what is built, kept, repaired, refused and reported."""

from __future__ import annotations

import contextlib
import dataclasses
import errno
import json
import os
import pickle
import platform
import re
import resource
import shutil
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import psutil
import pytest
from conftest import deny
from synthetic import SAMPLES, Broken, Session, fake_sample, flip, make_spec, run, site_of

from vbnfault import store as st
from vbnfault.core.errors import InputError, VbnfaultError
from vbnfault.core.quantities import Sample
from vbnfault.dataset import build as bd
from vbnfault.dataset import claims, lock, progress, tasks
from vbnfault.dataset.resume import planned_blocks
from vbnfault.dataset.tasks import BuildFailed
from vbnfault.store import codec, disk

HERE = Path(__file__).resolve().parent


def test_a_finished_store_is_left_as_it_is(undisturbed: tuple[Path, str], tmp_path: Path) -> None:
    summary = run(tmp_path / "s.zarr")
    assert (summary.built, summary.finished, summary.shards, summary.sites) == (SAMPLES, 0, 5, 3)
    assert st.examine(tmp_path / "s.zarr").problems == []
    assert summary.digest == undisturbed[1] == st.digest(undisturbed[0]) == st.digest(tmp_path / "s.zarr")
    times = {p: p.stat().st_mtime_ns for p in (tmp_path / "s.zarr").rglob("c/**/*") if p.is_file()}
    log = tmp_path / "log"
    summary = run(tmp_path / "s.zarr", Session(log=str(log)))
    assert (summary.built, summary.finished) == (0, SAMPLES)
    assert not log.exists()
    assert {p: p.stat().st_mtime_ns for p in times} == times


def test_damage_is_repaired_by_building_exactly_the_samples_concerned(
    undisturbed: tuple[Path, str], tmp_path: Path
) -> None:
    out, log = tmp_path / "s.zarr", tmp_path / "log"
    run(out)
    store = st.open_store(out)
    flip(store.file("image", 1), 20)  # the first chunk: sample 4
    store.file("depth_m", 3).unlink()  # 12 to 15
    chunks = store.chunk("clean", 2)
    del chunks[9]
    store.file("clean", 2).write_bytes(codec.join_shard({i - 8: c for i, c in chunks.items()}, 4))
    (out / "image" / "c" / "0.1f.partial").write_bytes(b"half")
    summary = run(out, Session(log=str(log)))
    assert (summary.built, summary.digest) == (6, undisturbed[1])  # of samples kept and samples made again
    assert sorted(int(line.split()[1]) for line in log.read_text().splitlines()) == [4, 9, 12, 13, 14, 15]
    assert st.examine(out).problems == []
    assert st.digest(out) == undisturbed[1]
    assert not list(out.rglob("*.partial"))


@pytest.mark.parametrize("workers", [1, 2])
def test_samples_that_are_not_as_planned_or_labelled_are_built_again(
    undisturbed: tuple[Path, str], tmp_path: Path, workers: int
) -> None:
    """Their checksums are right: another plan, or another program, wrote them."""
    out = shutil.copytree(undisturbed[0], tmp_path / "s.zarr")
    spec = make_spec()

    def planned(index: int, tries: int) -> dict:
        scalars = fake_sample(spec, index, site=int(site_of(index + 1)[-1])).scalars
        return {name: scalars[name] for name in ("site", "split", "proposal", "roll_deg", "injected")}

    wrong = {3: {"split": "test"}, 6: {"proposal": "{}"}, 11: {"roll_deg": 1.5}, 12: {"site": 2}}
    samples = [fake_sample(spec, i, site=int(site_of(i + 1)[-1])) for i in (*wrong, 16)]
    for sample, changes in zip(samples, wrong.values(), strict=False):
        sample.scalars.update(changes)  # type: ignore[attr-defined]
    samples[-1].layers["mask_any"] = ~samples[-1].layers["mask"].any(0)  # type: ignore[index]
    st.write_samples(out, samples)
    assert len(st.examine(out, expected=planned).problems) >= 5
    log = tmp_path / "log"
    assert run(out, Session(log=str(log)), workers=workers, expected=planned).built == 5
    assert sorted(int(line.split()[1]) for line in log.read_text().splitlines()) == [*wrong, 16]
    assert st.examine(out, expected=planned).problems == []
    assert st.digest(out) == undisturbed[1]
    assert run(out, workers=workers, expected=planned).built == 0


def test_samples_that_fail_are_named_and_all_others_are_built(
    undisturbed: tuple[Path, str], tmp_path: Path
) -> None:
    out = tmp_path / "s.zarr"
    with pytest.raises(
        BuildFailed, match=r"2 samples \(5, 9\) failed, the first with: KeyError.*for 5.*py:\d"
    ) as e:
        run(out, Session(raises=frozenset({5, 9})))
    assert set(e.value.failures) == {5, 9}
    assert "Traceback" in e.value.failures[5]
    assert pickle.loads(pickle.dumps(e.value)).failures == e.value.failures
    assert st.problem_samples(out) == [5, 9]
    assert run(out, workers=2).built == 2
    assert st.digest(out) == undisturbed[1]


def test_a_hopeless_build_stops_early(tmp_path: Path) -> None:
    log = tmp_path / "log"
    with pytest.raises(BuildFailed, match=r"32 samples .* before any succeeded"):
        run(tmp_path / "s.zarr", Session(raises=frozenset(range(60)), log=str(log)), samples=60)
    assert len(log.read_text().splitlines()) == 32


@pytest.mark.parametrize("workers", [1, 2])
def test_a_session_that_cannot_start_ends_the_build_with_its_sentence(tmp_path: Path, workers: int) -> None:
    with pytest.raises(VbnfaultError, match=r"^67P.obj: no such mesh$"):
        run(tmp_path / "s.zarr", Broken(), workers=workers)


def test_append_keeps_earlier_bits_and_resumes_itself(undisturbed: tuple[Path, str], tmp_path: Path) -> None:
    out = tmp_path / "s.zarr"
    assert planned_blocks(out, SAMPLES) == (SAMPLES,)
    with pytest.raises(InputError, match="there is no store"):
        planned_blocks(out, SAMPLES, append=3)
    run(out)
    old = [st.open_store(out).read_sample(i) for i in (0, 16, 17)]
    blocks = planned_blocks(out, SAMPLES, append=5)
    assert blocks == (SAMPLES, 5)
    with pytest.raises(BuildFailed):
        run(out, Session(raises=frozenset({20})), samples=23, blocks=blocks)
    assert planned_blocks(out, SAMPLES, append=5) == blocks  # the same command resumes
    assert planned_blocks(out, SAMPLES) == blocks
    assert run(out, samples=23, blocks=blocks).built == 1
    assert planned_blocks(out, SAMPLES, append=5) == (SAMPLES, 5, 5)
    assert st.examine(out).problems == []
    for sample in old:
        again = st.open_store(out).read_sample(sample.index)
        assert all(again.layers[n].tobytes() == a.tobytes() for n, a in sample.layers.items())
    with pytest.raises(InputError, match=r"samples = 20, but the store was made with 18; use --append"):
        planned_blocks(out, 20)
    with pytest.raises(InputError, match=r"holds blocks of 18 \+ 5 samples, not 23"):
        run(out, samples=23)


def test_another_scene_is_refused_and_says_what_differs(tmp_path: Path) -> None:
    out = tmp_path / "s.zarr"
    run(out)
    before = st.digest(out)
    scene = {
        "scene": {"body": {"name": "1P"}, "samples": 10, "sun": {"deg": [1, 2]}},
        "fault_models": {"straylight": "xyz"},
        "seed": 7,
    }
    with pytest.raises(InputError) as e:
        run(out, spec=make_spec(attributes={**scene, "created": "2031"}))
    assert "scene.body.name is '67P' in the store and '1P' now" in str(e.value)
    assert "scene.sun.deg is absent in the store and [1, 2] now" in str(e.value)
    effect = {
        "name": "glow",
        "note": "a text too long to be shown as a whole, and whose end is ",
        "level": 1,
    }
    nested = {**make_spec().attributes, "detector": {"effects": [effect]}}
    run(tmp_path / "b.zarr", spec=make_spec(attributes=nested))
    other = {**effect, "level": 2, "note": f"{effect['note']}another"}
    nested = {**nested, "detector": {"effects": [other]}}
    with pytest.raises(InputError) as deep:
        run(tmp_path / "b.zarr", spec=make_spec(attributes=nested))
    assert "detector.effects[0].level is 1 in the store and 2 now" in str(deep.value)
    assert "and whose end is another' now" in str(deep.value)
    assert str(e.value).index("scene.body") < str(e.value).index("fault_models")
    with pytest.raises(InputError, match="height is 24 in the store and 32 now"):
        run(out, spec=make_spec(32, width=32))
    run(out, spec=make_spec(attributes={**make_spec().attributes, "created": "2031"}))
    assert st.digest(out) == before
    run(out, spec=make_spec(attributes=scene), overwrite=True)
    assert st.digest(out) != before


def test_free_texts_of_a_scene_do_not_hinder_a_resume(tmp_path: Path) -> None:
    def attributes(text: str, **tables: object) -> dict[str, object]:
        texts = dict.fromkeys(("title", "description", "licence", "citation", "scene_hash"), text)
        scene = {"title": text, "description": text, "dataset": {"seed": 7, "licence": text, "citation": text}}
        return {**texts, "scene": {**scene, **tables}, "seed": 7}

    def retaken(text: str, **tables: object) -> dict[str, object]:
        return {
            **attributes(text),
            "retake": {"repeats": 1, "samples": [], "source": {**attributes(text, **tables), "faults": []}},
        }

    out = tmp_path / "s.zarr"
    with pytest.raises(BuildFailed):
        run(out, Session(raises=frozenset({5})), spec=make_spec(attributes=retaken("before")))
    for others in (retaken("now", camera={"fov_deg": 9}), {**retaken("now"), "fault_models": {"adc": "now"}}):
        with pytest.raises(InputError, match=r"holds another dataset: [^;]*; choose another --out"):
            run(out, spec=make_spec(attributes=others))
    assert run(out, spec=make_spec(attributes=retaken("now"))).built == 1
    assert st.open_store(out).attributes["scene"]["title"] == "before"


def test_a_store_of_other_versions_is_completed_on_request_and_says_by_whom(
    tmp_path: Path, undisturbed: tuple[Path, str]
) -> None:
    out = tmp_path / "s.zarr"

    def made_with(number: str, accept: bool = False, session: Session | None = None) -> bd.Summary:
        versions = {"numpy": number, "machine": "x"}
        attributes = {**make_spec().attributes, "versions": versions, "scene_hash": number}
        return run(out, session, spec=make_spec(attributes=attributes), accept_versions=accept)

    def noted() -> dict[str, list[list[int]]]:
        entries = st.open_store(out).attributes.get("versions_of_samples", [])
        return {entry["versions"]["numpy"]: entry["samples"] for entry in entries}

    with pytest.raises(BuildFailed):
        made_with("1", session=Session(raises=frozenset({5, 9, 10})))
    with pytest.raises(InputError, match=r"made with other versions: numpy 1 \(now 2\); --accept-versions") as e:
        made_with("2")
    assert "machine" not in str(e.value)
    assert noted() == {}
    with pytest.raises(BuildFailed):
        made_with("2", accept=True, session=Session(raises=frozenset({10})))
    assert noted() == {"2": [[5, 5], [9, 10]]}
    assert made_with("2").built == 1  # accepted once
    flip(st.open_store(out).file("image", 1), 20)  # sample 4
    assert made_with("3", accept=True).built == 1
    assert noted() == {"2": [[5, 5], [9, 10]], "3": [[4, 4]]}
    flip(st.open_store(out).file("image", 2), 20)  # sample 8, of the first versions
    st.open_store(out).file("depth_m", 1).unlink()  # 4 to 7
    assert made_with("1").built == 5
    assert noted() == {"2": [[9, 10]]}
    assert st.examine(out).problems == []
    assert st.open_store(out).attributes["versions"]["numpy"] == "1"
    for i in range(SAMPLES):
        a, b = st.open_store(out).read_sample(i), st.open_store(undisturbed[0]).read_sample(i)
        assert all(a.layers[name].tobytes() == b.layers[name].tobytes() for name in a.layers)
    with pytest.raises(InputError, match="holds another dataset: height"):
        run(out, spec=make_spec(32, width=32), accept_versions=True)


def test_dry_run_touches_nothing(tmp_path: Path) -> None:
    planned = np.arange(SAMPLES)[:, None] % 2 < [1, 2, 0, 1]  # a column a fault class
    summary = run(tmp_path / "s.zarr", dry_run=True, planned_faults=planned)
    assert not (tmp_path / "s.zarr").exists()
    assert summary.lines()[0].startswith(f"{tmp_path / 's.zarr'}: 18 samples at 3 sites in 5 shards, about ")
    counts = ", ".join(f"{name} {n}" for name, n in zip(make_spec().faults, (9, 18, 0, 9), strict=True))
    assert summary.lines()[1] == f"planned faults: {counts}"
    summary = run(tmp_path / "s.zarr", dry_run=True, estimated_seconds=7200.0)
    assert summary.lines()[1].startswith("estimated time: 2.0 h, ")


def test_a_dry_run_refuses_the_paths_that_a_build_refuses(tmp_path: Path) -> None:
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos/cat.png").touch()
    run(tmp_path / "s.zarr")
    sentence = "is no vbnfault store, so it is left alone; choose another --out"
    refused = {
        Path("/"): "is the root folder",
        tmp_path / "photos": sentence,
        tmp_path / "s.zarr/a.zarr": "lies in the store",
    }
    for out, why in refused.items():
        for dry_run in (True, False):
            with pytest.raises(InputError, match=why):
                run(out, dry_run=dry_run)


def test_one_site_is_no_plural(tmp_path: Path) -> None:
    values = {"path": tmp_path / "s.zarr", "finished": 0, "estimated_bytes": 10, "free_bytes": 100}
    one, two = (bd.Summary(samples=n, shards=n, sites=n, **values).outlook()[0] for n in (1, 2))
    assert ": 1 sample at 1 site in 1 shard, " in one
    assert ": 2 samples at 2 sites in 2 shards, " in two


@pytest.mark.parametrize("workers", [1, 2])
def test_the_work_is_announced_and_stages_are_named(
    workers: int, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Samples, sites, bytes and time come first; a stage of any process is a line where there is no terminal."""
    session = Session(stage="terrain of site", raises=frozenset({5}))
    options = {"workers": workers, "progress": True, "estimated_seconds": 90.0, "samples": 8}
    with pytest.raises(BuildFailed):
        run(tmp_path / "s.zarr", session, **options)
    lines = capsys.readouterr().err.splitlines()
    assert lines[0].startswith(f"{tmp_path / 's.zarr'}: 8 samples at 3 sites in 2 shards, about ")
    assert lines[1].startswith("estimated time: 90 s, ")
    assert sorted(line for line in lines if line.startswith("terrain")) == [
        f"terrain of site {i}" for i in range(8)
    ]
    # what is left of the time is that of the samples left
    with pytest.raises(BuildFailed):
        run(tmp_path / "s.zarr", session, **options)
    lines = capsys.readouterr().err.splitlines()
    assert lines[1].startswith("estimated time: 11 s, ")
    assert [line for line in lines if line.startswith("terrain")] == ["terrain of site 5"]


def test_too_little_room_is_said_before_the_first_sample(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    needed = make_spec().estimated_sample_bytes * SAMPLES
    monkeypatch.setattr(disk.Disk, "free_bytes", lambda _: needed // 2 - SAMPLES)
    with pytest.raises(VbnfaultError, match=r"are needed, but only .*B are free there"):
        run(tmp_path / "s.zarr")
    assert not (tmp_path / "s.zarr").exists()
    monkeypatch.setattr(disk.Disk, "free_bytes", lambda _: needed - 1)
    run(tmp_path / "s.zarr")
    assert "it may not fit" in caplog.text


def test_paths_that_cannot_be_used_are_bad_input(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("x")
    long = tmp_path / ("x" * 300)
    for out in (tmp_path / "file", tmp_path / "file" / "s.zarr", Path("/proc/none/s.zarr"), long, long / "s.zarr"):
        with pytest.raises(InputError, match=str(out)):
            run(out)


def test_two_builds_at_once_are_refused_also_where_the_store_is_replaced(tmp_path: Path) -> None:
    out, log = tmp_path / "s.zarr", tmp_path / "log"
    run(out)
    before = st.digest(out)

    @dataclass
    class Second:
        """Begins another build of the same store from within the first one."""

        refused: str = ""

        def __call__(self) -> Second:
            return self

        def simulate(self, index: int) -> Sample:
            if not self.refused:
                with pytest.raises(VbnfaultError, match="another command is writing") as e:
                    run(out, Session(log=str(log)), overwrite=True)
                self.refused = str(e.value)
            return Session().simulate(index)

    first = Second()
    run(out, first, overwrite=True)
    assert f"process {os.getpid()} on" in first.refused
    assert not log.exists()
    assert st.digest(out) == before
    assert [p.name for p in tmp_path.iterdir()] == ["s.zarr"]


def test_where_a_file_system_has_no_locks_a_file_names_the_owner(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object) -> None:
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr(claims, "_SECONDS_BETWEEN_BEATS", 1e-3)
    monkeypatch.setattr(lock.fcntl, "flock", refuse)
    out, folder = tmp_path / "s.zarr", tmp_path / ".s.zarr.claims"
    run(out)
    assert [p.name for p in tmp_path.iterdir()] == ["s.zarr"]
    with lock.locked(out):
        (own,) = folder.glob("whole.*.json")
        before = own.stat().st_ino
        while os.stat(own).st_ino == before:  # until the next heart-beat
            pass
        with pytest.raises(
            VbnfaultError, match=rf"another command .*\(process {os.getpid()} on .*delete .*json if"
        ):
            run(out)
    other = folder / f"whole.{'0' * 32}.json"
    folder.mkdir()
    other.write_text(json.dumps({"host": "elsewhere", "pid": os.getpid(), "started": 1.0}))
    with pytest.raises(VbnfaultError, match=r"process .* on elsewhere"):
        run(out, overwrite=True)
    # of another host's claim nothing is heard for an hour; one of this host's stands still
    for host, started, held in (("elsewhere", 1.0, False), (platform.node(), psutil.Process().create_time(), True)):
        other.write_text(json.dumps({"host": host, "pid": os.getpid(), "started": started}))
        os.utime(other, (time.time() - 3600,) * 2)
        with pytest.raises(VbnfaultError, match="another command") if held else contextlib.nullcontext():
            run(out)
        folder.mkdir(exist_ok=True)
    for content in ("[]", "3", "[" * 20000, json.dumps({"host": platform.node(), "pid": -1})):  # by a stranger
        other.write_text(content)
        with pytest.raises(VbnfaultError, match="another command is writing to it"):
            run(out)
    # killed on this host: a process that is no more, or another one with its number
    dead = subprocess.Popen([sys.executable, "-c", ""])
    dead.wait()
    for pid in (dead.pid, os.getpid()):
        folder.mkdir(exist_ok=True)
        other.write_text(json.dumps({"host": platform.node(), "pid": pid, "started": 1.0}))
        assert run(out).finished == SAMPLES
        assert not folder.exists()
    folder.mkdir()
    other.write_text("nonsense")
    with pytest.raises(VbnfaultError, match="another command"):
        run(out)


def test_sites_are_worked_through_one_after_another(tmp_path: Path) -> None:
    store = st.create(tmp_path / "s.zarr", make_spec(), 40)
    plan = tasks.Run(store, np.arange(40) // 4 % 3, progress.Progress(40, shown=False))
    order, last = [], None
    while (last := plan.next_task(last)) is not None:
        order.append(plan.lead(last))
    assert order == [0] * 4 + [1] * 3 + [2] * 3
    plan = tasks.Run(store, np.arange(40) // 4 % 3, progress.Progress(40, shown=False))
    first = plan.next_task()
    assert first is not None
    second = plan.next_task(None, [first])
    assert second is not None
    assert plan.lead(second) != plan.lead(first)  # a second worker goes elsewhere


def test_progress_without_a_terminal_is_plain_lines(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(progress, "_SECONDS_BETWEEN_LINES", 0.0)
    run(tmp_path / "s.zarr", Session(), progress=True)
    lines = capsys.readouterr().err.splitlines()
    assert re.match(r".*: 18 samples at 3 sites in 5 shards, about .* free; 0 of them", lines.pop(0))
    assert len(lines) >= SAMPLES
    form = re.compile(r"\d+/18 samples, ([\d.]+ samples/s|\d+ s/sample), \d+ (s|min) left")
    assert all(map(form.fullmatch, lines)), lines


@pytest.mark.parametrize("what", ["", "zarr.json", "image", "image/c", "image/c/1", "done/c", "roll_deg/c/0"])
def test_a_store_that_may_not_be_read_is_not_taken_for_damaged(
    undisturbed: tuple[Path, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, what: str
) -> None:
    out, log = shutil.copytree(undisturbed[0], tmp_path / "s.zarr"), tmp_path / "log"
    times = {p: p.stat().st_mtime_ns for p in out.rglob("*")}
    uses = (st.examine, st.digest, lambda path: run(path, Session(log=str(log))))
    with monkeypatch.context() as patch:
        deny(patch, out / what)
        for use in uses:
            with pytest.raises(VbnfaultError, match=rf"^{out}.*: Permission denied"):
                use(out)
    assert not log.exists()
    assert {p: p.stat().st_mtime_ns for p in out.rglob("*")} == times
    assert sorted(p.name for p in tmp_path.iterdir()) == ["s.zarr"]


@pytest.mark.parametrize("careful", [False, True])
def test_a_sample_is_encoded_while_the_next_one_is_simulated(tmp_path: Path, careful: bool) -> None:
    spec = make_spec()
    store = st.create(tmp_path / "a.zarr", spec, 4)
    events: list[tuple[str, int]] = []

    def simulate(index: int) -> Sample:
        if index == 1:
            raise ValueError("no such view")
        sample = fake_sample(spec, index)
        return dataclasses.replace(sample, layers={}) if index == 2 else sample  # fails when it is encoded

    task = tasks.Task(shard=0, sites=(0,) * len(store.shard(0)), careful=careful)
    tasks.work(simulate, store, task, lambda i, what, _: events.append((what, i)))
    after = [("begun", 0), ("begun", 1), ("failed", 1), ("begun", 2), ("built", 0), ("begun", 3), ("failed", 2)]
    at_once = [("begun", 0), ("built", 0), ("begun", 1), ("failed", 1), ("begun", 2), ("failed", 2), ("begun", 3)]
    assert events == [*(at_once if careful else after), ("built", 3)]
    assert store.done(0) == {0: True, 1: False, 2: False, 3: True}


def test_an_interrupt_keeps_the_sample_that_is_being_encoded(tmp_path: Path) -> None:
    spec = make_spec()
    store = st.create(tmp_path / "a.zarr", spec, 4)
    built: list[int] = []

    def simulate(index: int) -> Sample:
        if index == 2:
            raise KeyboardInterrupt
        return fake_sample(spec, index)

    with pytest.raises(KeyboardInterrupt):
        tasks.work(
            simulate,
            store,
            tasks.Task(shard=0, sites=(0,) * len(store.shard(0))),
            lambda i, what, _: built.append(i) if what == "built" else None,
        )
    assert built == [0]
    assert store.done(0) == {0: True, 1: True, 2: False, 3: False}


def test_the_root_of_the_file_system_has_no_held_lock(monkeypatch: pytest.MonkeyPatch) -> None:
    """It has no name, so its lock is named ..lock; a random command line with `--out /` ended in a traceback."""
    monkeypatch.setattr(os, "listdir", lambda _: ["..lock", "bin"])
    assert list(lock._held_locks(Path("/"))) == []


def test_a_store_without_room_for_its_first_file_leaves_nothing(tmp_path: Path) -> None:
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100, before[1]))
    try:
        with pytest.raises(VbnfaultError, match=r"no store can be created here: File too large"):
            run(tmp_path / "s.zarr")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert list(tmp_path.iterdir()) == []
