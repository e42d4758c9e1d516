"""Reading samples from shard files for trainers: what is stored, each file opened once, damage in one sentence."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from synthetic import fake_sample, filled, flip

from vbnfault import store as st
from vbnfault.core.errors import VbnfaultError
from vbnfault.store import codec, disk, shards
from vbnfault.store.codec import crc32c

LAYERS = ("image", "mask", "depth_m")


def decoded(reader: st.ShardReader, fetched: st.FetchedSample, name: str) -> np.ndarray:
    spec = reader.store.spec
    out = np.empty(spec.shape(spec.pixel_layers[name]), spec.pixel_layers[name].dtype)
    reader.decode(fetched, name, out)
    return out


@pytest.mark.parametrize("chosen", [[4], [5, 7], [7, 4, 6, 5], [8, 9]])
def test_layers_are_those_that_were_written(finished_store: Path, chosen: list[int]) -> None:
    store = st.open_store(finished_store)
    reader = st.ShardReader(store, LAYERS)
    fetched = reader.fetch(chosen[0] // 4, chosen)
    assert list(fetched) == chosen
    for i in chosen:
        written = fake_sample(store.spec, i).layers
        assert fetched[i].size == sum(map(len, fetched[i].chunks.values())) > 0
        for name in LAYERS:
            assert np.array_equal(decoded(reader, fetched[i], name), written[name])


def test_small_chunks_are_decoded_again_unless_they_are_empty(finished_store: Path) -> None:
    store = st.open_store(finished_store)
    reader = st.ShardReader(store, ["mask"])
    fetched = reader.fetch(1, [4, 5, 6, 7])
    assert max(sample.size for sample in fetched.values()) < shards._SMALL_CHUNK
    for _ in range(3):
        for i, sample in fetched.items():
            assert np.array_equal(decoded(reader, sample, "mask"), fake_sample(store.spec, i).layers["mask"])


def test_equal_chunks_are_held_once() -> None:
    a, b, c = (bytes([k]) * n for k, n in ((1, 4000), (2, 4000), (3, 5000)))
    chunks = {0: a, 1: b, 3: bytes(bytearray(a)), 4: c, 5: b, 6: b"few", 7: b"few"}
    data = codec.join_shard(chunks, 9)
    assert codec.split_shard(data, 9) == chunks
    assert len(data) == len(a) + len(b) + len(c) + 2 * len(b"few") + codec.index_size(9)
    # the file does not depend on whether the chunks are one object
    assert data == codec.join_shard({i: bytes(bytearray(chunk)) for i, chunk in chunks.items()}, 9)


def test_each_file_is_opened_once_and_only_the_bytes_wanted_are_read(
    finished_store: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = st.open_store(finished_store)
    whole = {name: store.chunk(name, 1) for name in LAYERS}
    reads: list[tuple[str, int]] = []
    real = disk.Disk.read_parts

    def counting(files: disk.Disk, name: str, *given: Any) -> Any:
        parts = real(files, name, *given)
        reads.append((name.split("/")[0], sum(len(data) for _, data in parts)))
        return parts

    monkeypatch.setattr(disk.Disk, "read_parts", counting)
    fetched = st.ShardReader(store, LAYERS).fetch(1, [5, 6])
    assert [name for name, _ in reads] == list(LAYERS)
    assert [size for _, size in reads] == [len(whole[name][5]) + len(whole[name][6]) for name in LAYERS]
    assert fetched[6].chunks == {name: whole[name][6] for name in LAYERS}


def test_chunks_that_touch_are_read_at_once(finished_store: Path) -> None:
    store, ranges = st.open_store(finished_store), []
    real = disk.os.pread

    def counting(file: int, length: int, start: int) -> bytes:
        ranges.append((start, length))
        return real(file, length, start)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(disk.os, "pread", counting)
        store.chunk("image", 0, [0, 1, 3])
    assert len(ranges) == 3  # the index, 0 with 1, and 3
    assert ranges[1][1] == sum(len(store.chunk("image", 0)[i]) for i in (0, 1))


@pytest.mark.parametrize(
    ("damage", "says"),
    [
        (lambda file: flip(file, 40), r"clean of sample 4 (cannot be decoded|does not match its stored crc32c)"),
        (
            lambda file: flip(file, -20),
            "clean of samples 4-7 cannot be read, the shard file clean/c/1/0/0/0 is damaged or missing",
        ),
        (
            lambda file: shutil.copy(Path(str(file).replace("clean", "image")), file),
            "clean of sample 4 does not match its stored crc32c",
        ),
    ],
)
def test_damage_is_told_in_one_sentence(whole: st.Store, damage: Callable[[Path], object], says: str) -> None:
    damage(whole.file("clean", 1))
    reader = st.ShardReader(whole, ["clean"])
    with pytest.raises(VbnfaultError, match=rf"^{whole.path}: {says}.*; the build command repairs it$"):
        decoded(reader, reader.fetch(1, [4])[4], "clean")


def test_a_layer_is_compared_again_only_where_its_chunk_or_checksum_is_another(
    finished_store: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = st.open_store(finished_store)
    reader = st.ShardReader(store, ["image"])
    compared: list[int] = []
    monkeypatch.setattr(shards, "crc32c", lambda array: compared.append(crc32c(array)) or compared[-1])
    fetched = reader.fetch(1, [4, 5])
    for _ in range(3):
        for sample in fetched.values():
            decoded(reader, sample, "image")
    assert compared == [sample.crc32c["image"] for sample in fetched.values()]
    out = np.empty_like(decoded(reader, fetched[4], "image"))
    other_chunk = replace(fetched[4], chunks=fetched[5].chunks)
    other_checksum = replace(fetched[4], crc32c={"image": fetched[5].crc32c["image"]})
    for k, changed in enumerate((other_chunk, other_checksum), 3):
        assert reader._decode(changed, "image", out) == "does not match its stored crc32c"
        assert len(compared) == k


def test_a_sample_that_is_rewritten_meanwhile_is_read_again(tmp_path: Path) -> None:
    store = filled(tmp_path / "s.zarr", 4)
    reader = st.ShardReader(store, ["raw"])
    stale = reader.fetch(0, [2])[2]
    stale.chunks["raw"] = stale.chunks["raw"][:-3]
    assert np.array_equal(decoded(reader, stale, "raw"), fake_sample(store.spec, 2).layers["raw"])
