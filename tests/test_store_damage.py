"""Stores under damage, failing disks and kills: what is wrong is found, and the same command mends it."""

from __future__ import annotations

import errno
import json
import os
import re
import shutil
import threading
import warnings
from collections.abc import Callable
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zarr
from tools import damage
from tools.damage import SAMPLES, mend, sample, spec

from vbnfault import store as st
from vbnfault.core.errors import InputError, VbnfaultError
from vbnfault.core.files.whole_files import remove
from vbnfault.store import disk
from vbnfault.store.metadata import metadata_problems

pytestmark = pytest.mark.expects_warnings  # of what is damaged


@pytest.fixture(scope="module")
def template(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """A finished store, and its digest."""
    path = tmp_path_factory.mktemp("damage") / "s.zarr"
    st.create(path, spec(), SAMPLES)
    st.write_samples(path, [sample(i) for i in range(SAMPLES)])
    assert st.examine(path).problems == []
    return path, st.digest(path)


@pytest.fixture
def store(template: tuple[Path, str], tmp_path: Path) -> Path:
    return shutil.copytree(template[0], tmp_path / "s.zarr", symlinks=True)


# --- flips, metadata, what is in the way ------------------------------------------------------------------


def test_random_flips_are_found_and_mended_or_harmless(tmp_path: Path) -> None:
    """2,000 of them: python -m tests.tools.damage."""
    outcomes = damage.damage(12, 5, tmp_path)
    assert outcomes.total() == 12
    assert set(outcomes) <= {"found and mended", "harmless"}


def rewrite(file: Path, change: Callable[[dict], None]) -> None:
    document = json.loads(file.read_text())
    change(document)
    file.write_text(json.dumps(document))


@pytest.mark.parametrize("key", ["node_type", "zarr_format", "attributes of another name"])
def test_the_spare_is_checked_outside_its_attributes_too(store: Path, template: tuple[Path, str], key: str) -> None:
    """The checksum covers the attributes only; a flipped bit in `node_type` was found by random damage."""
    rewrite(store / "spare/zarr.json", lambda document: document.update({key: "gro5p"}))
    assert any(problem.startswith("spare/zarr.json is damaged") for problem in st.examine(store).problems)
    st.recover(store)
    assert st.examine(store).problems == []
    assert st.digest(store) == template[1]


@pytest.mark.parametrize("name", ["zarr.json", "spare/zarr.json"])
@pytest.mark.parametrize("how", ["another value", "another key", "cut", "gone", "folder", "no utf-8", "list"])
def test_either_root_may_be_lost(
    store: Path, template: tuple[Path, str], name: str, how: str, caplog: pytest.LogCaptureFixture
) -> None:
    """Nothing but the checksum tells a changed licence or seed from the right one."""
    file, good = store / name, json.loads((store / name).read_text())
    attributes = st.open_store(store).attributes
    if how == "another value":
        rewrite(file, lambda d: d["attributes"].update(seed=8))
    elif how == "another key":
        rewrite(file, lambda d: d["attributes"].update(sced=d["attributes"].pop("seed")))
    elif how == "gone":
        file.unlink()
    elif how == "folder":
        file.unlink()
        (file / "inside").mkdir(parents=True)
    else:
        file.write_bytes({"cut": file.read_bytes()[:-9], "no utf-8": b"\xff\xfe{}", "list": b"[]"}[how])
    opened = st.open_store(store)
    assert re.search(f"{name} is (damaged|missing); .* the build command mends it", caplog.text)
    assert (opened.attributes, opened.samples) == (attributes, SAMPLES)
    assert any(problem.startswith(f"{name} is ") for problem in st.examine(store).problems)
    st.recover(store)
    assert json.loads(file.read_text()) == good
    assert st.examine(store).problems == []
    assert st.digest(store) == template[1]


def test_both_roots_lost_is_one_sentence(store: Path) -> None:
    for name in ("zarr.json", "spare/zarr.json"):
        rewrite(store / name, lambda d: d["attributes"].update(seed=8))
    with pytest.raises(InputError, match=r"zarr.json and its copy spare/zarr.json are both damaged"):
        st.examine(store)
    with pytest.raises(InputError, match="is left alone"):
        st.create(store, spec(), SAMPLES, overwrite=True)


def test_a_store_without_checksum_is_read_and_gets_one(store: Path, template: tuple[Path, str]) -> None:
    """As stores were before there were checksums."""
    shutil.rmtree(store / "spare")
    rewrite(store / "zarr.json", lambda d: d["attributes"].pop("attributes_sha256"))
    assert st.examine(store).problems == ["zarr.json has no checksum and no spare copy"]
    st.recover(store)
    assert st.examine(store).problems == []
    assert st.digest(store) == template[1]


@pytest.mark.parametrize("name", ["image", "parameters"])
def test_any_key_of_an_array_that_differs_is_found_and_mended(store: Path, name: str) -> None:
    """Changed, taken away or added: codecs, fill values, long names, whatever a key says."""
    file = store / name / "zarr.json"
    good = json.loads(file.read_text())
    wrong: list[tuple[str, Any]] = [(key, None) for key in good]
    wrong += [(key, "nonsense") for key in good]
    wrong += [("attributes", {**good["attributes"], "long_name": "another"}), ("extra", 1)]
    wrong += [("codecs", good["codecs"][::-1]), ("codecs", good["codecs"][:-1]), ("fill_value", 1)]
    for key, value in wrong:
        document = {k: v for k, v in good.items() if k != key} | ({} if value is None else {key: value})
        if document == good:
            continue
        file.write_text(json.dumps(document))
        assert any(name in problem for problem in metadata_problems(st.open_store(store))[0]), (key, value)
        st.recover(store)
        assert json.loads(file.read_text()) == good, (key, value)
    assert st.examine(store).problems == []


def test_the_documents_are_those_that_zarr_writes(store: Path) -> None:
    """They are made without zarr: what zarr reads from them, it writes again as it was."""
    prototype = zarr.core.buffer.default_buffer_prototype()
    for name in st.open_store(store).spec.members(SAMPLES):
        (again,) = zarr.open_array(store / name, mode="r").metadata.to_buffer_dict(prototype).values()
        assert json.loads(again.to_bytes()) == json.loads((store / name / "zarr.json").read_text())
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # zarr warns of what it does not know in a group
        consolidated = dict(zarr.open_group(store, mode="r").members())
        own = dict(zarr.open_group(store, mode="r", use_consolidated=False).members())
    assert own.keys() - consolidated.keys() == {"spare"}


def folder(path: Path) -> None:
    (path / "inside").mkdir(parents=True)


def link(path: Path) -> None:
    path.with_name("elsewhere").write_bytes(b"x")
    path.symlink_to("elsewhere")


def loop(path: Path) -> None:
    path.symlink_to(path.name)


def file(path: Path) -> None:
    path.write_bytes(b"x")


FILES = ("image/c/1/0/0/0", "mask/zarr.json", "done/c/1", "crc32c/c/1/0", "x/c/0", "sample/zarr.json")
FOLDERS = ("image", "image/c", "image/c/1", "done", "x/c", "spare")


@pytest.mark.parametrize(
    ("place", "name"),
    [*product((folder, link, loop, os.mkfifo), FILES), *product((file, loop), FOLDERS)],
)
def test_whatever_else_has_the_name_of_a_file_or_folder_makes_way(
    store: Path, template: tuple[Path, str], place: Callable[[Path], None], name: str
) -> None:
    remove(store / name)
    place(store / name)
    assert any(name.split("/")[0] in problem for problem in st.examine(store).problems)
    mend(store)
    assert st.examine(store).problems == []
    assert st.digest(store) == template[1]
    assert (store / name).is_file() == (name in FILES)
    assert not (store / name).is_symlink()


# --- a disk that fails at its n-th operation --------------------------------------------------------------


@pytest.mark.parametrize("command", damage.COMMANDS)
def test_a_disk_that_fails_at_any_operation_loses_nothing(tmp_path: Path, command: Callable[[Path], None]) -> None:
    """All operations: python -m tests.tools.damage --operations."""
    count = damage.operations(command, tmp_path / "count")
    assert count > 40
    chosen = np.random.default_rng(3).choice(count, 4, replace=False).tolist()
    for k, number in enumerate(chosen):
        code = (errno.EIO, errno.ENOSPC, errno.EACCES)[k % 3]
        assert damage.fails_at(number, code, command, tmp_path / str(k)) == "", number


def test_short_writes_are_continued(
    tmp_path: Path, template: tuple[Path, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    damage.replace_system(monkeypatch, damage.FailingSystem(short=True))
    store = st.create(tmp_path / "s.zarr", spec(), SAMPLES)
    st.write_samples(store, [sample(i) for i in range(SAMPLES)])
    monkeypatch.undo()
    assert st.digest(tmp_path / "s.zarr") == template[1]


def test_data_are_on_the_device_before_done_is(store: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In the order of the calls: every file is flushed before it gets its name, every folder before `done`."""
    calls: list[tuple[str, str]] = []
    paths: dict[int, str] = {}

    class Noted(damage.FailingSystem):
        def noted(self, name: str, arguments: tuple[Any, ...], result: Any) -> None:
            if name == "open":
                paths[result] = str(arguments[0])
            if name == "fsync":
                calls.append((name, paths[arguments[0]]))
            if name == "replace":
                calls.append((name, str(arguments[1])))

    damage.replace_system(monkeypatch, Noted())
    st.write_samples(store, [sample(2), sample(3)])
    done = str(store / "done" / "c" / "1")
    renamed = [path for name, path in calls if name == "replace"]
    assert [renamed[0], renamed[-1]] == [done, done]  # taken back first, given last
    assert renamed.count(done) == 2
    data = renamed[1:-1]
    assert len(data) == len(st.open_store(store).spec.arrays) - 1
    first, last = (calls.index(("replace", data[k])) for k in (0, -1))
    given = next(k for k in range(last, len(calls)) if calls[k][1].startswith(f"{done}."))
    assert calls[given][0] == "fsync"
    flushed_before = [path for name, path in calls[:first] if name == "fsync"]
    for path in data:
        assert any(flushed.startswith(f"{path}.") for flushed in flushed_before), path
        assert ("fsync", str(Path(path).parent)) in calls[last:given], path
    assert calls[-1] == ("fsync", str(Path(done).parent))


# --- files that are something else ---------------------------------------------------------------------------


@pytest.mark.parametrize("file", ["image/c/0/0/0/0", "exposure_s/c/0", "mask/c", "injected"])
def test_a_link_in_a_files_place_is_not_followed(store: Path, tmp_path: Path, file: str) -> None:
    """zarr would follow it, at worst to a device without end; here the link leads to the right content."""
    assert st.open_store(store).read_sample(0).index == 0
    shutil.move(store / file, tmp_path / "moved")
    (store / file).symlink_to(tmp_path / "moved")
    with pytest.raises(VbnfaultError, match=file.split("/")[0]):
        st.open_store(store).read_sample(0)


# --- readers beside a writer ------------------------------------------------------------------------------


def test_readers_beside_a_writer_never_see_a_wrong_sample_that_is_done(store: Path) -> None:
    """A sample is written over and over, with other content, then the store grows: what is read is one or the
    other, as its checksums say, or refused as unfinished."""
    wanted = {i: {name: a.tobytes() for name, a in sample(i).layers.items()} for i in range(SAMPLES)}
    other = sample(2)
    other.layers["depth_m"] = other.layers["depth_m"] + np.float32(1)
    either = {wanted[2]["depth_m"], other.layers["depth_m"].tobytes()}
    reads, wrong, stop = [0, 0], [], threading.Event()

    def reader() -> None:
        while not stop.is_set() or reads[0] < 20:
            opened = st.open_store(store)
            for i in (2, 3):
                try:
                    got = opened.read_sample(i)
                except InputError:  # not finished just now
                    reads[1] += 1
                    continue
                except VbnfaultError as error:
                    wrong.append(str(error))
                    continue
                reads[0] += 1
                if i == 3 and {n: a.tobytes() for n, a in got.layers.items() if n in wanted[3]} != wanted[3]:
                    wrong.append("sample 3 changed")
                if i == 2 and got.layers["depth_m"].tobytes() not in either:
                    wrong.append("sample 2 is neither")

    readers = [threading.Thread(target=reader) for _ in range(2)]
    for thread in readers:
        thread.start()
    try:
        for k in range(12):
            st.write_samples(store, [other if k % 2 == 0 else sample(2)])
        grown = st.append_samples(store, 1, {"blocks": [SAMPLES, 1]})
        st.write_samples(grown, [sample(SAMPLES)])
    finally:
        stop.set()
        for thread in readers:
            thread.join()
    assert wrong == []


@pytest.mark.parametrize("times", [1, 2, 3])
def test_a_file_replaced_between_its_index_and_a_chunk_is_read_again(
    store: Path, monkeypatch: pytest.MonkeyPatch, times: int
) -> None:
    """A sample whose layer cannot be decoded is read again; three times in a row count as damage."""
    wanted = {name: layer.tobytes() for name, layer in sample(3).layers.items()}
    opened, get, reads = st.open_store(store), disk.Disk.read_parts, []
    file = opened.file("depth_m", 1)
    whole = file.read_bytes()

    def replace_and_get(files: disk.Disk, name: str, *given: Any) -> Any:
        if name.startswith("depth_m/c/"):
            reads.append(name)
            file.write_bytes(whole[::-1] if len(reads) <= times else whole)
        return get(files, name, *given)

    monkeypatch.setattr(disk.Disk, "read_parts", replace_and_get)
    if times == 3:
        with pytest.raises(VbnfaultError, match="depth_m of sample 3 cannot be read"):
            opened.read_sample(3)
    else:
        got = opened.read_sample(3).layers
        assert {name: got[name].tobytes() for name in wanted} == wanted
    assert len(reads) == min(3, times + 1)


def test_a_reader_in_the_middle_of_a_change_of_the_attributes_sees_no_damage(
    store: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """At each of the renames that change the attributes, and between the reads of a reader, opening warns of
    nothing and gives the attributes from before or from after."""
    seen = []
    replace = os.replace
    document = st.group.read_document

    def look(source: str, target: str) -> None:
        seen.append(st.open_store(store).attributes.get("note"))
        replace(source, target)
        seen.append(st.open_store(store).attributes.get("note"))

    changes = iter(("one", "two"))

    def change_between(*file: Any) -> Any:
        found = document(*file)
        note = next(changes, None)
        if note is not None:
            with monkeypatch.context() as plain:
                plain.setattr(st.group, "read_document", document)
                st.open_store(store, "r+").update_attributes({"note": note})
        return found

    with monkeypatch.context() as patched:
        patched.setattr(disk.os, "replace", look)
        st.open_store(store, "r+").update_attributes({"note": "zero"})
    assert seen == [None, "zero", "zero", "zero"]
    monkeypatch.setattr(st.group, "read_document", change_between)
    assert st.open_store(store).attributes["note"] == "one"  # the root from before, the spare of the first change
    assert st.open_store(store).attributes["note"] == "two"
    assert not caplog.records


# --- creating ---------------------------------------------------------------------------------------------


def test_create_removes_only_what_its_own_killed_predecessors_left(tmp_path: Path) -> None:
    """Names with wildcards match no others; a link with the name of a leftover goes, not what it names."""
    name = "s[1]*?.zarr"
    others = [tmp_path / f".s1xy.zarr.{kind}.partial" for kind in ("new", "old")]
    for folder_ in (*others, tmp_path / f".{name}.new.partial"):
        (folder_ / "image").mkdir(parents=True)
    (tmp_path / f".{name}.old.partial").symlink_to(others[0])
    st.create(tmp_path / name, spec(), SAMPLES)
    st.create(tmp_path / name, spec(), SAMPLES, overwrite=True)
    assert sorted(tmp_path.iterdir()) == sorted([*others, tmp_path / name])
    assert all((folder_ / "image").is_dir() for folder_ in others)
    mend(tmp_path / name)
    assert st.examine(tmp_path / name).problems == []


# --- cost -------------------------------------------------------------------------------------------------


def test_a_store_of_a_million_empty_samples_costs_no_file_a_shard(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """To create, open, recover, count and verify it takes as many operations of the disk as a small one, but for
    the chunks of one coordinate."""

    def operations(path: Path, samples: int) -> int:
        system = damage.FailingSystem()
        with monkeypatch.context() as patch:
            damage.replace_system(patch, system)
            store = st.create(path, spec(), samples)
            assert st.recover(path).finished() == 0
            assert st.examine(store).problems == [f"samples 0-{samples - 1} are not built yet"]
        return system.count

    few = operations(tmp_path / "few.zarr", SAMPLES)
    many = operations(tmp_path / "many.zarr", 1_000_000)
    # 16 chunks of the coordinate `sample`, each written once and read twice, in 30 operations at most
    assert many - few <= 16 * 30
