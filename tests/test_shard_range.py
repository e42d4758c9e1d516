"""Ranges of shards made by several commands, into one store or into several that are merged: one digest."""

from __future__ import annotations

import dataclasses
import errno
import json
import os
import platform
import re
import shutil
import signal
from pathlib import Path

import numpy as np
import pytest
from synthetic import SAMPLES, Session, fake_sample, flip, make_spec, run
from tools import victim
from tools.kills import forked
from typer.testing import CliRunner

from vbnfault import cli
from vbnfault import store as st
from vbnfault.core.errors import InputError, VbnfaultError
from vbnfault.core.process import environment
from vbnfault.core.process.interrupts import Interrupted
from vbnfault.core.quantities import Sample
from vbnfault.dataset import lock
from vbnfault.dataset.merge import MergeSummary, join_stores, merge_stores
from vbnfault.dataset.tasks import BuildFailed
from vbnfault.store import disk

SHARDS = 5


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("whole") / "s.zarr"
    run(out)
    return out


@pytest.fixture(scope="module")
def parts_once(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("parts")
    run(folder / "a.zarr", shard_range=range(2))
    run(folder / "b.zarr", shard_range=range(2, SHARDS))
    return folder


@pytest.fixture
def parts(parts_once: Path, tmp_path: Path) -> list[Path]:
    """Stores of the shards 0:2 and 2:5."""
    return [Path(shutil.copytree(parts_once / name, tmp_path / name)) for name in ("a.zarr", "b.zarr")]


def merge(stores: list[Path], out: Path, **options: bool) -> MergeSummary:
    return join_stores(stores, out, progress=False, **options)


def remake(store: Path, index: int, **attributes: object) -> None:
    """Replace a sample of a store by another one."""
    sample = fake_sample(make_spec(), index)
    st.write_samples(store, [dataclasses.replace(sample, scalars={**sample.scalars, **attributes})])


@dataclasses.dataclass
class Guest:
    """Runs another command at its first sample, when its own command holds its locks."""

    action: object

    def __call__(self) -> Guest:
        return self

    def simulate(self, index: int) -> Sample:
        action, self.action = self.action, None
        if action:
            action()  # type: ignore[operator]
        return Session().simulate(index)


def test_ranges_at_work_at_once_make_one_store(tmp_path: Path, whole: Path) -> None:
    out = tmp_path / "s.zarr"

    def others() -> None:
        (out / "left.partial").touch()  # of a command at work
        for part in (range(1, 3), range(1), range(SHARDS)):
            with pytest.raises(VbnfaultError, match=r"another command is writing shards 0:2 of it \(process"):
                run(out, shard_range=part) if part != range(1) else run(out)
        summary = run(out, shard_range=range(2, SHARDS))
        assert (summary.samples, summary.built, summary.shards) == (10, 10, 3)
        assert summary.digest is None
        assert (out / "left.partial").exists()  # a range does not repair while others write

    with lock.locked(out), pytest.raises(VbnfaultError, match="another command is writing to it"):
        run(out, shard_range=range(2))
    summary = run(out, Guest(others), shard_range=range(2))
    assert "shards 0:2" in summary.lines()[0]
    assert "8 samples at" in summary.outlook()[0]
    assert [p.name for p in tmp_path.iterdir()] == ["s.zarr"]
    assert run(out).built == 0
    assert not (out / "left.partial").exists()
    assert st.digest(out) == st.digest(whole)
    with pytest.raises(InputError, match=r"--shard-range 4:6: the dataset has 5 shards; .* B <= 5"):
        run(out, shard_range=range(4, 6))


def test_ranges_without_locks_of_the_file_system(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, whole: Path
) -> None:
    def refuse(*_: object) -> None:
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr(lock.fcntl, "flock", refuse)
    out = tmp_path / "s.zarr"

    def others() -> None:
        with pytest.raises(VbnfaultError, match=r"shards 0:2 of it .*\.json if it has ended"):
            run(out, shard_range=range(1, 3))
        run(out, shard_range=range(2, SHARDS))

    killed = {"host": platform.node(), "pid": 1, "started": 0}
    (tmp_path / ".s.zarr.claims").mkdir()
    (tmp_path / f".s.zarr.claims/shards-0-4.{'0' * 32}.json").write_text(json.dumps(killed))
    run(out, Guest(others), shard_range=range(2))
    assert [p.name for p in tmp_path.iterdir()] == ["s.zarr"]
    assert st.digest(out) == st.digest(whole)


def test_a_range_cannot_extend_a_store_while_another_range_is_written(tmp_path: Path) -> None:
    out = tmp_path / "s.zarr"

    def others() -> None:
        with pytest.raises(VbnfaultError, match="no samples or versions can be added now"):
            run(out, samples=24, blocks=(SAMPLES, 6), shard_range=range(3, 5))

    run(out, Guest(others), shard_range=range(2))
    assert run(out, samples=24, blocks=(SAMPLES, 6), shard_range=range(5, 6)).built == 4


@pytest.mark.parametrize("text", ["3", "a:b", "1:", "-1:2", "1:2:3", "1:99999999999999"])
def test_the_command_checks_the_text_of_a_range(text: str, tmp_path: Path) -> None:
    given = ["build", "quickstart", "--out", str(tmp_path / "x"), "--dry-run", "--shard-range", text]
    shown = CliRunner().invoke(cli.app, given)
    assert "must be A:B, whole numbers with 0 <= A < B, such as 0:4" in str(shown.exception)


# --- merge ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("move", [False, True])
def test_merged_stores_have_the_digest_of_one_build(
    tmp_path: Path, parts: list[Path], whole: Path, move: bool
) -> None:
    out = tmp_path / "m.zarr"
    summary = merge(parts, out, move=move)
    assert (summary.finished, summary.before, [*summary.taken.values()]) == (SAMPLES, 0, [8, 10])
    assert summary.digest == st.digest(whole)
    assert st.examine(out).problems == []
    assert [st.open_store(part).finished() for part in parts] == ([0, 0] if move else [8, 10])
    assert merge(parts, out, move=move).before == SAMPLES
    assert run(out).built == 0
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.zarr", "b.zarr", "m.zarr"]


def test_one_of_the_stores_may_get_the_samples(parts: list[Path], whole: Path) -> None:
    assert merge(parts, parts[1]).digest == st.digest(whole)
    assert merge(parts[:1], parts[1]).before == SAMPLES
    (parts[0].parent / "link").symlink_to(parts[0])  # another name of the same store
    for same in (parts[0], parts[0].parent / "link"):
        with pytest.raises(InputError, match="there is nothing to merge"):
            merge([same], parts[0])


def lacking(path: Path, *numbers: int, shards: range = range(SHARDS)) -> Path:
    """Make a store that lacks some samples."""
    with pytest.raises(BuildFailed):
        run(path, Session(raises=frozenset(numbers)), shard_range=shards)
    return path


def test_a_sample_of_several_stores_is_taken_once(tmp_path: Path, whole: Path) -> None:
    """Of a shard of which two stores hold some samples each, and one of them both."""
    first, second = lacking(tmp_path / "a.zarr", 0), lacking(tmp_path / "b.zarr", 2)
    summary = merge([first, second], tmp_path / "m.zarr")
    assert [*summary.taken.values()] == [17, 1]
    assert st.digest(tmp_path / "m.zarr") == st.digest(whole)


def test_a_sample_that_nobody_has_built_is_missing_and_not_damaged(tmp_path: Path) -> None:
    first, second = (lacking(tmp_path / name, 9, 10) for name in ("a.zarr", "b.zarr"))
    assert merge([first, second], tmp_path / "m.zarr").missing == (9, 10)


def test_a_store_that_gets_samples_is_compared_and_locked_like_the_others(
    tmp_path: Path, parts: list[Path]
) -> None:
    out = tmp_path / "m.zarr"
    st.create(out, make_spec(attributes={**st.open_store(parts[0]).attributes, "seed": 8}), SAMPLES)
    with pytest.raises(InputError, match=r"a\.zarr: holds another dataset than .*m\.zarr: seed is 7 here and 8 th"):
        merge(parts, out)
    shutil.rmtree(out)
    with lock.locked(out), pytest.raises(VbnfaultError, match=r"m\.zarr: another command is writing to it"):
        merge(parts, out)
    merge(parts, out)
    remake(out, 5, tries=3)
    with pytest.raises(InputError, match="sample 5 differs"):
        merge(parts, out)


def test_shards_that_move_are_not_copied(tmp_path: Path, parts: list[Path]) -> None:
    files = [st.open_store(part).file("image", n) for part, n in zip(parts, (1, 4), strict=True)]
    before = [file.stat().st_ino for file in files]
    merge(parts, tmp_path / "m.zarr", move=True)
    moved = st.open_store(tmp_path / "m.zarr")
    assert [moved.file("image", n).stat().st_ino for n in (1, 4)] == before


def test_what_a_killed_removal_left_is_removed_and_what_cannot_be_read_is_kept(
    tmp_path: Path, parts: list[Path]
) -> None:
    out, sound = tmp_path / "m.zarr", Path(shutil.copytree(parts[0], tmp_path / "c.zarr"))
    damaged = st.open_store(parts[0])
    flip(damaged.file("done", 0), -3)
    damaged.file("done", 1).unlink()  # the first file that goes
    merge([*parts, sound], out, move=True)
    assert st.examine(out).problems == []
    assert damaged.file("image", 0).exists()
    assert not damaged.file("image", 1).exists()


def test_ctrl_c_ends_a_merge_after_the_shard_in_work(
    tmp_path: Path, parts: list[Path], whole: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    copy = st.Store.copy_shard

    def interrupted(store: st.Store, number: int, *rest: object, **more: object) -> None:
        if number == 1:
            signal.raise_signal(signal.SIGINT)
        copy(store, number, *rest, **more)  # type: ignore[arg-type]

    monkeypatch.setattr(st.Store, "copy_shard", interrupted)
    out = tmp_path / "m.zarr"
    with pytest.raises(Interrupted, match="merged samples stay, and the same command resumes") as stopped:
        merge(parts, out)
    assert stopped.value.exit_code == 130
    assert st.open_store(out).finished() == 8
    monkeypatch.undo()
    assert merge(parts, out).digest == st.digest(whole)


def test_samples_that_no_store_holds_are_named(tmp_path: Path, parts: list[Path]) -> None:
    summary = merge(parts[1:], tmp_path / "m.zarr")
    assert summary.digest is None
    assert summary.lines()[-1].startswith("samples 0-7 are in none of the stores")
    assert run(tmp_path / "m.zarr").built == 8


def test_stores_that_differ_in_free_texts_are_joined(tmp_path: Path, parts: list[Path], whole: Path) -> None:
    attributes = st.open_store(parts[1]).attributes
    scene = {**attributes["scene"], "description": "another text"}
    st.open_store(parts[1], "r+").update_attributes({"scene": scene, "scene_hash": "abd"})
    assert merge(parts, tmp_path / "m.zarr").digest == st.digest(whole)


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"seed": 8}, "seed is 8 here and 7 there"),
        ({"scene": {}}, "scene.body.name is absent here and '67P' there"),
        ({"versions": {"numpy": "1"}}, r"versions.numpy is '1' here and absent there"),
        ({"blocks": [20]}, r"blocks is \[20\] here and \[18\] there"),
    ],
)
def test_stores_of_another_dataset_are_refused(
    tmp_path: Path, parts: list[Path], changes: dict, sentence: str
) -> None:
    other = tmp_path / "c.zarr"
    attributes = {**st.open_store(parts[0]).attributes, **changes}
    st.create(other, make_spec(attributes=attributes), sum(attributes["blocks"]))
    with pytest.raises(InputError, match=rf"c\.zarr: holds another dataset than .*a\.zarr: {sentence}"):
        merge([*parts, other], tmp_path / "m.zarr")
    assert not (tmp_path / "m.zarr").exists()


def test_a_source_is_locked_only_if_its_shards_move(tmp_path: Path, parts: list[Path]) -> None:
    with lock.locked(parts[1]):
        with pytest.raises(VbnfaultError, match=r"b\.zarr: another command is writing to it"):
            merge(parts, tmp_path / "m.zarr", move=True)
        assert merge(parts, tmp_path / "n.zarr").finished == SAMPLES
    assert [st.open_store(part).finished() for part in parts] == [8, 10]


def test_a_complete_store_gets_its_card(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, parts: list[Path]) -> None:
    written: list[Path] = []
    monkeypatch.setattr("vbnfault.dataset.card.write_card", written.append)
    merge_stores(parts[:1], tmp_path / "m.zarr", progress=False)
    assert written == []
    merge_stores(parts, tmp_path / "m.zarr", progress=False)
    assert written == [tmp_path / "m.zarr"]


def test_a_sample_that_differs_between_stores_is_refused(tmp_path: Path, parts: list[Path]) -> None:
    merge(parts[:1], parts[1])
    remake(parts[1], 5, tries=3)
    before = [st.digest(part) for part in parts]
    with pytest.raises(InputError, match=r"b\.zarr: sample 5 differs from that in .*a\.zarr in scalars"):
        merge(parts, tmp_path / "m.zarr")
    assert not (tmp_path / "m.zarr").exists()
    assert [st.digest(part) for part in parts] == before


def test_a_damaged_sample_is_taken_from_another_store_or_reported(
    tmp_path: Path, parts: list[Path], whole: Path
) -> None:
    out = tmp_path / "m.zarr"
    flip(st.open_store(parts[0]).file("image", 1), 40)
    with pytest.raises(VbnfaultError, match=r"1 samples \(4\) are damaged in every .*a\.zarr: sample 4: im"):
        merge(parts, out, move=True)
    assert [i for i, done in st.open_store(parts[0]).done(1).items() if done] == [4, 5, 6, 7]  # nothing is lost
    assert [i for i, done in st.open_store(out).done(1).items() if done] == [5, 6, 7]
    sound = tmp_path / "c.zarr"
    run(sound, shard_range=range(1, 2))
    assert merge([*parts, sound], out, move=True).digest == st.digest(whole)


def test_a_sample_that_is_damaged_everywhere_does_not_count_as_done(tmp_path: Path, parts: list[Path]) -> None:
    out = tmp_path / "m.zarr"
    merge(parts[:1], out)
    for path in (out, parts[0]):
        flip(st.open_store(path).file("image", 1), 40)
    st.open_store(out, "r+")._write_done(1, {4, 5, 6})
    with pytest.raises(VbnfaultError, match=r"1 samples \(4\) are damaged in every"):
        merge(parts[:1], out)
    assert [i for i, done in st.open_store(out).done(1).items() if done] == [5, 6, 7]


def test_versions_of_samples_are_joined(tmp_path: Path, parts: list[Path]) -> None:
    for part, samples in zip(parts, ([2, 9], [16, 17]), strict=True):
        entries = [{"versions": {"v": "2"}, "samples": [samples]}]
        st.open_store(part, "r+").update_attributes({"versions_of_samples": entries})
    merge(parts, tmp_path / "m.zarr")
    made = st.open_store(tmp_path / "m.zarr").attributes["versions_of_samples"]
    assert made == [{"versions": {"v": "2"}, "samples": [[2, 7], [16, 17]]}]
    merge(parts[:1], tmp_path / "n.zarr")
    made = st.open_store(tmp_path / "n.zarr").attributes["versions_of_samples"]
    assert made == [{"versions": {"v": "2"}, "samples": [[2, 7]]}]


def test_versions_are_those_of_the_store_that_a_sample_is_taken_from(tmp_path: Path, parts: list[Path]) -> None:
    """The first that holds it; what the store held before stays."""
    again = Path(shutil.copytree(parts[0], tmp_path / "c.zarr"))
    entries = [{"versions": {"v": "2"}, "samples": [[2, 7]]}]
    st.open_store(again, "r+").update_attributes({"versions_of_samples": entries})
    merge([parts[0], again], tmp_path / "m.zarr")
    merge(parts[:1], tmp_path / "n.zarr")
    merge([again], tmp_path / "n.zarr")
    for name in ("m.zarr", "n.zarr"):
        assert "versions_of_samples" not in st.open_store(tmp_path / name).attributes


@pytest.mark.parametrize("move", [False, True])
def test_a_killed_merge_is_resumed(tmp_path: Path, parts: list[Path], whole: Path, move: bool) -> None:
    out = tmp_path / "m.zarr"
    rng = np.random.default_rng(5)
    ended = []
    for _ in range(4):
        step = victim.step("write", count=int(rng.integers(20, 900)), torn=True)

        def disturbed(step: dict = step) -> str | None:
            victim.follow([step])
            return merge(parts, out, move=move).digest

        ended.append(forked(disturbed)[0])
        held = [st.open_store(path).finished() for path in (*parts, *([out] if st.is_store(out) else []))]
        assert sum(held) >= SAMPLES
    assert -9 in ended
    assert merge(parts, out, move=move).digest == st.digest(whole)
    assert not [*out.rglob("*.partial"), *tmp_path.glob(".*")]


def test_a_shard_that_is_linked_again_leaves_no_temporary_file(tmp_path: Path) -> None:
    """As after a kill between the files of a shard and `done`: both names are already those of one file."""
    (tmp_path / "a").write_bytes(b"data")
    for _ in range(2):
        disk.write(tmp_path, [("b", tmp_path / "a")])
        assert sorted(path.name for path in tmp_path.iterdir()) == ["a", "b"]
    assert (tmp_path / "a").samefile(tmp_path / "b")


# --- processor cores --------------------------------------------------------------------------------------


def test_threads_follow_affinity_and_quota(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(environment, "_quota_of_cores", lambda: np.inf)
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {3, 5, 7}, raising=False)
    assert environment.usable_cores() == 3
    monkeypatch.setattr(environment, "_quota_of_cores", lambda: 1.5)
    assert environment.usable_cores() == 2
    monkeypatch.delattr(os, "sched_getaffinity")
    monkeypatch.setattr(os, "cpu_count", lambda: None)
    assert environment.usable_cores() == 1
    monkeypatch.undo()
    for name, text in {"a/b": "max 100000", "a": "250000 100000", "": "nonsense"}.items():
        (tmp_path / name).mkdir(parents=True, exist_ok=True)
        (tmp_path / name / "cpu.max").write_text(text)
    (tmp_path / "cgroup").write_text("3:cpu:/x\n0::/a/b\n")
    assert environment._quota_of_cores(tmp_path, tmp_path / "cgroup") == 2.5
    assert environment._quota_of_cores(tmp_path, tmp_path / "none") == np.inf


def test_the_command_merges(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, parts: list[Path]) -> None:
    monkeypatch.setattr("vbnfault.dataset.card.write_card", lambda path: [path])
    shown = CliRunner().invoke(cli.app, ["merge", *map(str, parts), "--out", str(tmp_path / "m"), "--move"])
    assert shown.exit_code == 0
    assert re.search(r"18 of 18 samples, 0 of them merged before\n8 samples moved .*\n.*\ndigest ", shown.output)


def test_samples_of_one_shard_in_two_stores_are_joined(tmp_path: Path, parts: list[Path], whole: Path) -> None:
    lacks = [{1, 2}, {0, 3}]
    for part, numbers in zip(parts, lacks, strict=True):
        shutil.rmtree(part)
        with pytest.raises(BuildFailed):
            run(part, Session(raises=frozenset(numbers)))
    summary = merge(parts, tmp_path / "m.zarr", move=True)
    assert summary.digest == st.digest(whole) == st.digest(tmp_path / "m.zarr")
    assert [*summary.taken.values()] == [16, 2]


def test_a_store_by_another_name_is_the_same_store(tmp_path: Path, parts: list[Path]) -> None:
    (tmp_path / "link").symlink_to(parts[0])
    with pytest.raises(InputError, match="there is nothing to merge"):
        merge([tmp_path / "link"], parts[0])
