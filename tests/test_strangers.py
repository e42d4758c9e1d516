"""Links in the place of what vbnfault makes, and stores that a stranger may have made.

Nothing that a command removes or truncates is reached through a link, and no store makes a command write beside its
output, take memory without end, or show a traceback. `python -m tests.tools.fuzz --kinds stranger` tries many more.
"""

from __future__ import annotations

import copy
import dataclasses
import os
import random
import resource
import shutil
import struct
import subprocess
import sys
import tarfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from synthetic import filled, make_spec
from test_bad_stores import Call
from test_export import tree
from tools import fuzz, fuzz_cases, fuzz_stores

from vbnfault import store as st
from vbnfault.core.errors import InputError, VbnfaultError
from vbnfault.core.files.whole_files import own_folder, remove, replacing, write_whole
from vbnfault.store import codec, compressors, disk, layout


@pytest.fixture
def home(tmp_path: Path) -> Path:
    """A folder that no command may touch."""
    (tmp_path / "home/docs").mkdir(parents=True)
    (tmp_path / "home/docs/thesis.txt").write_text("precious")
    (tmp_path / "home/0.partial").write_text("precious")
    return tmp_path / "home"


# --- links ----------------------------------------------------------------------------------------------------


def _lock(sound: Path, here: Path) -> list[object]:
    (here / ".m.zarr.lock").symlink_to(here / "home/docs/thesis.txt")
    return ["merge", sound, "--out", here / "m.zarr"]


def _lock_of_an_export(sound: Path, here: Path) -> list[object]:
    (here / ".e.lock").symlink_to(here / "home/docs/thesis.txt")
    return ["export", sound, "--format", "yolo", "--out", here / "e"]


def _lock_that_is_a_pipe(sound: Path, here: Path) -> list[object]:
    os.mkfifo(here / ".m.zarr.lock")
    return ["merge", sound, "--out", here / "m.zarr"]


def _overwrite(sound: Path, here: Path) -> list[object]:
    shutil.copytree(sound, here / "home/real.zarr")
    (here / "m.zarr").symlink_to(here / "home/real.zarr")
    return ["build", "quickstart", "--out", here / "m.zarr", "--overwrite", "--samples", 1]


def _loop(sound: Path, here: Path) -> list[object]:
    (here / "a").symlink_to("b")
    (here / "b").symlink_to("a")
    return ["merge", sound, "--out", here / "a"]


@pytest.mark.parametrize(
    ("make", "sentence"),
    [
        (_lock, ".m.zarr.lock: has the name of a lock, but is a link or a pipe; remove it"),
        (_lock_of_an_export, ".e.lock: has the name of a lock, but is a link or a pipe; remove it"),
        (_lock_that_is_a_pipe, ".m.zarr.lock: has the name of a lock, but is a link or a pipe; remove it"),
        (_overwrite, "m.zarr: is a link, in whose place nothing is created"),
        (_loop, "a: is a link, in whose place nothing is created"),
    ],
)
def test_a_link_in_the_place_of_what_a_command_makes_is_not_followed(
    make: Callable[[Path, Path], list[object]],
    sentence: str,
    described_store: Path,
    tmp_path: Path,
    home: Path,
    call: Call,
) -> None:
    arguments = make(described_store, tmp_path)
    before = tree(home)
    refused = call(*arguments)
    assert (refused.code, sentence in refused.said) == (2, True)
    assert tree(home) == before


@pytest.mark.parametrize("name", [".parts", "images", "images/train", "samples.jsonl", "README.md"])
def test_a_second_export_replaces_links_but_not_what_they_name(
    name: str, described_store: Path, tmp_path: Path, home: Path, call: Call
) -> None:
    out, arguments = tmp_path / "e", ["export", described_store, "--format", "yolo", "--out", tmp_path / "e"]
    assert call(*arguments).code == 0
    wanted, before = tree(out), tree(home)
    remove(out / name)
    (out / name).symlink_to(home / "docs/thesis.txt" if "." in name[1:] else home)
    state = (out / "export.json").read_text().replace('"complete": true', '"complete": false')
    (out / "export.json").write_text(state)
    assert call(*arguments).code == 0
    assert tree(out) == wanted
    assert tree(home) == before


@pytest.mark.parametrize("name", ["normal/c", "image", "done", "exposure_s/c"])
def test_a_folder_link_in_a_store_is_neither_read_nor_written_through(
    name: str, described_store: Path, tmp_path: Path, home: Path
) -> None:
    store = shutil.copytree(described_store, tmp_path / "s.zarr")
    (store / name).rename(home / "moved")
    (store / name).symlink_to(home / "moved")
    before = tree(home)
    assert any(name.split("/")[0] in problem for problem in st.examine(store).problems)
    opened = st.recover(store)
    opened.remove_shard(0)
    opened.files.write([(f"{name}/0/0/0/0", b"new")])
    assert tree(home) == before
    assert not (store / name).is_symlink()


def test_the_functions_that_remove_and_replace_follow_no_link(tmp_path: Path, home: Path) -> None:
    before = tree(home)
    for name in ("a", "b", "c"):
        (tmp_path / name).symlink_to(home)
    remove(tmp_path / "a")
    with replacing(tmp_path / "b") as temporary:
        temporary.mkdir()
    (own_folder(tmp_path / "c") / "new").write_text("new")
    assert not (tmp_path / "a").exists()
    assert tree(home) == before
    (tmp_path / "mine.txt").symlink_to(home / "docs/thesis.txt")  # a path that a user names for a file
    write_whole(tmp_path / "mine.txt", "new")
    assert (home / "docs/thesis.txt").read_text() == "new"


# --- paths of options -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(("folder", "code"), [("full", 1), ("none", 2), ("file", 2)])
def test_a_path_that_cannot_be_used_is_a_mistake_and_a_full_disk_ends_a_run(
    folder: str, code: int, described_store: Path, tmp_path: Path, call: Call
) -> None:
    (tmp_path / "file").touch()
    (tmp_path / "full").mkdir()
    for command, ending in (("preview", "png"), ("report", "html")):
        (tmp_path / f"full/x.{ending}").symlink_to("/dev/full")
        assert call(command, described_store, "--out", tmp_path / folder / f"x.{ending}").code == code


def test_few_open_files_are_enough_for_a_store(tmp_path: Path) -> None:
    program = "import synthetic, sys; from pathlib import Path; synthetic.filled(Path(sys.argv[1]), 2)"
    limit = f"ulimit -n 64 && exec {sys.executable} -c '{program}' {tmp_path / 's.zarr'}"
    there = {**os.environ, "PYTHONPATH": os.pathsep.join([*sys.path])}
    subprocess.run(["bash", "-c", limit], env=there, check=True)
    assert st.examine(tmp_path / "s.zarr").problems == []


# --- names ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["", "A", "a" * 129, "/pwned", "a\0b", "a\nnames:\n  9: evil", "../../../pwned"])
def test_a_class_that_is_no_name_is_refused(name: str, described_store: Path, tmp_path: Path) -> None:
    store = shutil.copytree(described_store, tmp_path / "s.zarr")
    attributes = copy.deepcopy(st.open_store(store).root_attributes)
    attributes["store"]["faults"][3] = name
    fuzz_stores._write(store, attributes)
    with pytest.raises(InputError, match=r"s\.zarr: is no vbnfault store: .*store\.faults = "):
        st.open_store(store)


def test_names_are_refused_where_a_store_is_created_too(tmp_path: Path) -> None:
    wrong: dict[str, dict[str, Any]] = {
        "store.faults": {"faults": ("../a",), "mask_any_faults": (), "layers": ()},
        "store.soft_layers = '../a'": {"soft_layers": ("../a", "", "", "")},
        "store.soft_layers = 'image': must end in opacity": {"soft_layers": ("image", "", "", "")},
        "store.site_names": {"site_names": ("a\nb",)},
        "title": {"attributes": {"title": "a\n---\n"}},
        "licence": {"attributes": {"licence": ["MIT"]}},
    }
    for key, changes in wrong.items():
        with pytest.raises(InputError, match=key.replace(".", r"\.")):
            st.create(tmp_path / "s.zarr", make_spec(**changes), 4)
    with pytest.raises(InputError, match=r"store\.faults: must be at most 1024 different names"):
        st.create(tmp_path / "s.zarr", make_spec(faults=("a", "a"), mask_any_faults=(), layers=()), 4)
    with pytest.raises(InputError, match="samples = 10000001: must be a whole number from 0 to 10000000"):
        st.create(tmp_path / "s.zarr", make_spec(), 10_000_001)
    assert not [*tmp_path.iterdir()]


def test_a_split_that_is_a_path_is_damage(described_store: Path, tmp_path: Path, call: Call) -> None:
    store = st.open_store(shutil.copytree(described_store, tmp_path / "s.zarr"))
    for name, split in (("png", "/pwned"), ("yolo", "../pwned"), ("webdataset", "other"), ("exr", "")):
        text = np.array([split and f"{tmp_path}{split}", "train"], dtype=object)
        store.file("split", 1).write_bytes(layout.encode_values(text))
        out = tmp_path / name
        refused = call("export", store.path, "--format", name, "--out", out)
        assert (refused.code, "a split is none of train, val, test" in refused.said) == (1, True)
    assert not (tmp_path / "pwned").exists()


# --- sizes ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("claimed", [None, 1 << 20, 100, 0, 6 << 30])
@pytest.mark.parametrize("frames", [1, 3])
def test_a_chunk_takes_no_more_memory_than_its_array(claimed: int | None, frames: int) -> None:
    """1 MiB of zeros in the place of 100 bytes, whatever the header says; a frame of 100 bytes is what fits."""
    codec_ = compressors.compressor(compressors.ZSTD)
    bomb = fuzz_stores.zeros(1 << 20, claimed) * frames
    for read in (lambda: codec_.decode(bomb, 100), lambda: codec_.decode_into(bomb, np.zeros(100, np.uint8))):
        with pytest.raises(ValueError):  # noqa: PT011 - some words are those of the library
            read()
    assert codec_.decode(fuzz_stores.zeros(100, 100), 100).tobytes() == bytes(100)
    for name in ("zstd 1", "blosc zstd 1 shuffle 2"):  # what the writer makes says how large it is, in any width
        for size in (2, 254, 256, 70_000, 1 << 20):
            chunk = compressors.compressor(name).encode(np.arange(size, dtype=np.uint8))
            assert compressors.compressor(name).decode(chunk, size).size == size
            assert len(chunk) <= compressors.most_compressed(size)
    noise = np.random.default_rng(1).integers(0, 256, 1 << 20, dtype=np.uint8)
    for name in ("zstd 1", "blosc zstd 1 shuffle 2", "blosc zstd 1 bitshuffle 2 1048576"):
        assert len(compressors.compressor(name).encode(noise)) <= compressors.most_compressed(noise.size)


@pytest.mark.expects_warnings  # of what is too large
@pytest.mark.parametrize(
    "file", ["image/c/1/0/0/0", "zarr.json", "spare/zarr.json", "split/c/1", "x/c/0", "done/c/1"]
)
def test_a_file_that_is_too_large_is_not_read(
    file: str, described_store: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """No call of `os.read` gets bytes of a sparse file of 6 GB."""
    store = shutil.copytree(described_store, tmp_path / "s.zarr")
    os.truncate(store / file, 6 << 30)
    most, real = [0], os.read

    def reading(handle: int, size: int) -> bytes:
        data = real(handle, size)
        most.append(len(data))
        return data

    monkeypatch.setattr(disk.os, "read", reading)
    problems = st.examine(store).problems
    assert any(file.split("/")[0] in problem for problem in problems)
    assert max(most) < 10 << 20


def test_a_chunk_whose_index_names_too_many_bytes_is_damage(described_store: Path, tmp_path: Path) -> None:
    store = st.open_store(shutil.copytree(described_store, tmp_path / "s.zarr"))
    file, size = store.file("image", 0), store.spec.shard_samples
    data = bytearray(bytes(1 << 20) + file.read_bytes())
    table = np.frombuffer(bytes(data[-16 * size - 4 : -4]), "<u8").copy()
    table[1] = 1 << 20
    index = codec.google_crc32c.value(table.tobytes())
    data[-16 * size - 4 :] = table.tobytes() + struct.pack("<I", index)
    file.write_bytes(bytes(data))
    with pytest.raises(VbnfaultError, match="names a chunk of more than"):
        store.read_sample(0)


def test_a_document_of_too_many_values_is_not_parsed(described_store: Path, tmp_path: Path) -> None:
    store = shutil.copytree(described_store, tmp_path / "s.zarr")
    (store / "image/zarr.json").write_bytes(b'{"a": [' + b"[]," * 4_000_000 + b"0]}")
    (problem,) = st.examine(store).problems
    assert "image/zarr.json is damaged" in problem


@pytest.mark.parametrize("text", ["[", "[]", "7", '{"a":' * 99 + "1" + "}" * 99, "x"])
def test_parameters_of_a_stranger_are_one_sentence(text: str) -> None:
    with pytest.raises(ValueError, match=r"JSON|nested|Expecting"):
        st.drawn_table(text)
    assert st.drawn_table('{"a": ' + "9" * 400 + "}") == {"a": float("inf")}


# --- the fuzz itself ------------------------------------------------------------------------------------------


def test_strangers_stores_fail_no_command(
    described_store: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Some cases of each way; the process itself may hold what earlier tests took."""
    shutil.copytree(described_store, tmp_path / "seed.zarr")
    (tmp_path / "seed.toml").write_text('title = "seed"\n')
    seeds: Any = object.__new__(fuzz.Seeds)
    seeds.folder, seeds.store = tmp_path, tmp_path / "seed.zarr"
    monkeypatch.setattr(fuzz, "CASES", {"stranger": fuzz_cases.CASES["stranger"]})
    monkeypatch.setattr(fuzz, "MEMORY_BYTES", 1 << 50)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    results = [fuzz.attempt(seeds, "suite", number) for number in range(10)]
    assert [(r["number"], r["problem"], r["text"]) for r in results if r["problem"]] == []
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 1 << 20  # KiB: under 1 GiB


def test_the_fuzz_notices_what_is_written_beside_the_output(tmp_path: Path) -> None:
    here = tmp_path / "case"
    (here / "out/e").mkdir(parents=True)
    arguments = ["export", "s", "--out", str(here / "out/e")]
    before = fuzz_stores.state(here, arguments)
    assert fuzz_stores.escaped(here, arguments) == ""
    with tarfile.open(here / "out/e/train.tar", "w") as tar:
        tar.addfile(tarfile.TarInfo("../a"))
    assert "members outside" in fuzz_stores.escaped(here, arguments)
    (here / "out/pwned").touch()
    assert "beside the output" in fuzz_stores.escaped(here, arguments)
    (here / "mine.txt").write_text("x")
    assert fuzz_stores.state(here, arguments) != before
    sound = filled(tmp_path / "sound.zarr", 2)
    bad = tmp_path / "bad.zarr"
    fuzz_stores.made_by_a_stranger(sound.path, bad, random.Random(1), here)
    assert tree(bad) != tree(sound.path)
    assert dataclasses.is_dataclass(sound.spec)
