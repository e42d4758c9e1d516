"""Stores that live long: the format before is read, verified, completed and migrated; variables explain themselves.

`data/format_2.tar.xz` is a store of five samples of 24 × 20 px that vbnfault 0.2.0 wrote in format 2, before there
was a format 3.
"""

from __future__ import annotations

import os
import re
import shutil
import sys
import tarfile
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import pytest
import xarray
from numcodecs import blosc
from synthetic import FAULTS, filled, make_spec

from vbnfault import cli, dataset
from vbnfault import store as st
from vbnfault.core.errors import InputError, VbnfaultError
from vbnfault.store import codec
from vbnfault.store.arrays import LAYERS, SCALARS, ZSTD
from vbnfault.store.compressors import compressor, fitting
from vbnfault.store.group import read_document
from vbnfault.store.layout import DOCUMENT, array_documents, canonical

ARCHIVE = Path(__file__).parent / "data/format_2.tar.xz"
DIGEST = "468bab942be0b4c0e06552400f7276f83006761008906e5ceee7b09ab791a3f4"  # as vbnfault 0.2.0 printed it
MAGIC_OF_ZSTD = bytes.fromhex("28b52ffd")
# Words of UDUNITS that the store uses; udunits 2.2.28 parses each of them.
UNITS = {"1", "count", "m", "nm", "s", "d", "au", "degree", "W m-2 sr-1 nm-1"}


@pytest.fixture(scope="module")
def archived(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A store of format 2, which no test changes."""
    folder = tmp_path_factory.mktemp("format_2")
    with tarfile.open(ARCHIVE) as archive:
        # Python 3.11.2, that of Debian 12, knows no filters; Python 3.12 warns without one
        archive.extractall(folder / "old.zarr", **({"filter": "data"} if hasattr(tarfile, "data_filter") else {}))
    return folder / "old.zarr"


@pytest.fixture
def old(archived: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(archived, tmp_path / "s.zarr"))


def contents(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def run(monkeypatch: pytest.MonkeyPatch, *arguments: object) -> int:
    monkeypatch.setattr(sys, "argv", ["vbnfault", *map(str, arguments)])
    try:
        cli.main()
    except SystemExit as stop:
        return int(stop.code or 0)
    return 0


# --- before a migration -------------------------------------------------------------------------------------


def test_a_store_of_the_format_before_is_read_and_verified(archived: Path) -> None:
    store = st.open_store(archived)
    assert store.spec.format_version == 2
    assert set(store.spec.codecs.values()) == {ZSTD}
    report = dataset.verify(archived)
    assert (report.problems, report.digest) == ([], DIGEST)
    assert st.digest(archived) == DIGEST
    with xarray.open_zarr(archived) as data:
        for name, layer in store.read_sample(3).layers.items():
            np.testing.assert_array_equal(data[name][3].values, layer)


def test_the_schema_still_describes_each_document_of_it(archived: Path) -> None:
    store = st.open_store(archived)
    documents = array_documents(store.spec.members(store.samples))
    assert documents.keys() == {p.parent.name for p in archived.glob(f"*/{DOCUMENT}")} - {"spare"}
    for name, document in documents.items():
        assert canonical(read_document(store.files, f"{name}/{DOCUMENT}")) == canonical(document), name


def test_a_store_of_the_format_before_is_completed_with_its_own_codec(old: Path) -> None:
    store = st.open_store(old, "r+")
    sample, kept = store.read_sample(2), store.chunk("image", 1)
    st.append_samples(old, 2)
    st.recover(old)
    store = st.open_store(old, "r+")
    st.write_samples(store, [sample])
    assert store.spec.format_version == 2
    assert store.chunk("image", 1) == kept  # the same codec gives the same bytes
    for name in store.spec.pixel_layers:
        assert all(chunk.startswith(MAGIC_OF_ZSTD) for chunk in store.chunk(name, 1).values())
    assert st.verify(old) == ["samples 5-6 are not built yet"]


# --- migration ----------------------------------------------------------------------------------------------


def test_a_migration_changes_metadata_alone(old: Path, archived: Path) -> None:
    before = contents(old)
    with xarray.open_zarr(archived) as data:
        expected = data.load()
    assert dataset.migrate_store(old).spec.format_version == st.FORMAT_VERSION
    report = dataset.verify(old)
    assert (report.problems, report.digest) == ([], DIGEST)
    after = contents(old)
    changed = {name for name in after if after[name] != before.get(name)}
    assert not before.keys() - after.keys()
    assert {name for name in changed if "/c/" in name} == {"y/c/0", "row/c/0"}
    with xarray.open_zarr(old) as data:
        assert set(data.coords) == {*expected.coords, "row"}
        for name in expected.variables:
            if name != "y":
                np.testing.assert_array_equal(data[name].values, expected[name].values)
        np.testing.assert_array_equal(data["row"].values, expected["y"].values)
    again = contents(old)
    dataset.migrate_store(old)
    assert contents(old) == again


def test_a_copy_has_the_codecs_of_new_stores_and_leaves_the_source(old: Path, tmp_path: Path) -> None:
    before = contents(old)
    (tmp_path / "new.zarr").mkdir()  # an empty folder may be used
    copied: list[int] = []
    store = dataset.migrate_store(old, tmp_path / "new.zarr", progress=copied.append)
    assert copied == [2, 2, 1]
    assert contents(old) == before
    assert store.spec.codecs == {name: row.codec for name, row in store.spec.pixel_layers.items()}
    report = dataset.verify(store.path)
    assert (report.problems, report.digest) == ([], DIGEST)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["new.zarr", "s.zarr"]
    with xarray.open_zarr(old) as source, xarray.open_zarr(store.path) as data:
        for name in source.data_vars:
            np.testing.assert_array_equal(data[name].values, source[name].values)


def test_unfinished_samples_stay_unfinished_in_a_copy(old: Path, tmp_path: Path) -> None:
    store = st.append_samples(old, 4)
    copy = dataset.migrate_store(old, tmp_path / "new.zarr")
    assert st.verify(copy) == st.verify(store) == ["samples 5-8 are not built yet"]


def killed_after(monkeypatch: pytest.MonkeyPatch, operations: int, action: Any) -> bool:
    """Run an action that is killed at a file operation; return whether it was."""
    left = [operations]

    def counted(name: str) -> Any:
        real = getattr(os, name)

        def call(*args: Any, **keywords: Any) -> Any:
            left[0] -= 1
            if left[0] < 0:
                raise KeyboardInterrupt
            return real(*args, **keywords)

        return call

    with monkeypatch.context() as patch:
        for name in ("replace", "mkdir"):
            patch.setattr(os, name, counted(name))
        try:
            action()
        except KeyboardInterrupt:
            return True
    return False


@pytest.mark.parametrize("kind", ["in place", "copy"])
def test_a_killed_migration_is_continued_by_the_same_call(
    kind: str, archived: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    kills, operations = 0, 0
    while True:
        source, target = tmp_path / f"{operations}.zarr", tmp_path / f"{operations}-new.zarr"
        shutil.copytree(archived, source)
        store = st.open_store(source)
        made = source if kind == "in place" else target

        def action(source: Path = source, target: Path = target, store: st.Store = store) -> None:
            if kind == "in place":
                st.migrate(source)
            else:
                st.migrate_copy(store, target)

        was_killed = killed_after(monkeypatch, operations, action)
        assert st.digest(source) == DIGEST
        if was_killed:
            assert kind == "in place" or not target.exists()
            action()
        assert st.verify(made) == []
        assert st.digest(made) == DIGEST
        assert st.open_store(made).spec.format_version == 3
        assert not list(made.rglob("*.partial"))
        kills += was_killed
        if not was_killed:
            break
        shutil.rmtree(source)
        operations += 1 if operations < 3 else 83  # the first ones, and then some of the hundreds
    assert kills >= 4
    assert not list(tmp_path.glob(".*"))


def test_a_copy_begun_from_another_state_of_the_source_is_begun_anew(
    old: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    target = tmp_path / "new.zarr"
    assert killed_after(monkeypatch, 250, lambda: st.migrate_copy(st.open_store(old), target))
    grown = st.append_samples(old, 1)
    assert st.migrate_copy(grown, target).samples == 6


def _with_anothers_chunk(store: st.Store) -> None:
    """Give sample 1 the image of sample 0, whose chunk is sound in itself."""
    chunk = store.chunk("image", 0)[0]
    store.file("image", 0).write_bytes(codec.join_shard({0: chunk, 1: chunk}, store.spec.shard_samples))


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (lambda s: s.file("raw", 1).unlink(), r"raw/c/1/0/0 is missing; the build command repairs it"),
        (lambda s: s.file("image", 0).write_bytes(b"x" * 99), r"image/c/0/0/0/0 is damaged: truncated"),
        (_with_anothers_chunk, "sample 1: image in image/c/0/0/0/0 does not match its stored crc32c; the build"),
    ],
)
def test_a_damaged_store_is_not_copied(old: Path, tmp_path: Path, change: Any, sentence: str) -> None:
    change(st.open_store(old))
    with pytest.raises(VbnfaultError, match=sentence):
        dataset.migrate_store(old, tmp_path / "new.zarr")
    assert not (tmp_path / "new.zarr").exists()


def test_the_command_says_what_it_did_and_refuses_in_one_sentence(
    old: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos/a.png").write_bytes(b"x")
    for arguments, sentence in (
        ((tmp_path / "photos",), "is no vbnfault store"),
        ((old, "--out", tmp_path / "photos"), "photos: exists already, so it is left alone; choose another --out"),
        ((old, "--out", old / "sub.zarr"), "lies in the store that is migrated; choose another --out"),
        ((tmp_path / "none.zarr",), "no such store"),
    ):
        assert run(monkeypatch, "migrate", *arguments) == 2
        said = capsys.readouterr().err.splitlines()
        assert len(said) == 1
        assert sentence in said[0]
    assert run(monkeypatch, "migrate", old, "--out", tmp_path / "new.zarr") == 0
    assert capsys.readouterr().out.splitlines()[-1] == f"{tmp_path / 'new.zarr'}: 5 samples, format 3, was 2"
    assert run(monkeypatch, "migrate", old) == 0
    assert capsys.readouterr().out == f"{old}: 5 samples, format 3, was 2\n"
    assert run(monkeypatch, "migrate", old) == 0
    assert capsys.readouterr().out == f"{old}: 5 samples, format 3, was 3\n"
    shutil.rmtree(old / "done" / "c")
    assert run(monkeypatch, "migrate", old) == 0
    assert capsys.readouterr().out == f"{old}: 5 samples, 0 finished, format 3, was 3\n"


# --- codecs -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "name",
    [ZSTD, "zstd 9", "blosc zstd 1 bitshuffle 1", "blosc zstd 3 shuffle 6", "blosc zstd 1 bitshuffle 1 1024"],
)
def test_a_codec_returns_what_it_was_given_and_notices_damage(name: str) -> None:
    data = np.random.default_rng(1).integers(0, 9, 6 * 500, dtype=np.uint8)
    codec = compressor(name)
    coded = codec.encode(data)
    assert codec.decode(coded, data.size).tobytes() == data.tobytes()
    assert codec.encode(data) == coded
    assert blosc.get_mutex() is None  # else multiprocessing reports a leak when a worker is killed
    for position in (0, 3, 9, len(coded) // 2, len(coded) - 1):
        damaged = bytearray(coded)
        damaged[position] ^= 0x10
        with pytest.raises(ValueError):  # noqa: PT011 - the words are those of the libraries
            codec.decode(bytes(damaged), data.size)
    with pytest.raises(ValueError):  # noqa: PT011
        codec.decode(coded[:2], data.size)
    with pytest.raises(ValueError, match="at most"):
        codec.decode(coded, data.size - 1)


def test_a_codec_that_does_not_exist_is_refused() -> None:
    with pytest.raises(InputError, match="codec = 'jpeg 3': must be 'zstd LEVEL' or"):
        make_spec(codecs={"image": "jpeg 3"})
    assert fitting("blosc zstd 1 bitshuffle 1", 2**31) == ZSTD  # Blosc takes less than 2 GiB
    assert fitting("blosc zstd 1 bitshuffle 1", 2**20) == "blosc zstd 1 bitshuffle 1"


def test_the_digest_does_not_depend_on_format_and_codecs(finished_store: Path, tmp_path: Path) -> None:
    want = st.digest(finished_store)
    assert st.digest(filled(tmp_path / "2.zarr", format_version=2)) == want
    codecs = dict.fromkeys(make_spec().pixel_layers, "zstd 3")
    assert st.digest(filled(tmp_path / "z.zarr", codecs=codecs)) == want


def test_zarr_itself_writes_the_codecs_of_the_documents(tmp_path: Path) -> None:
    """So that any reader of Zarr v3 finds what it knows."""
    import zarr

    store = filled(tmp_path / "s.zarr", samples=1)
    for name in ("image", "depth_m", "normal", "raw"):
        array = zarr.open_array(store.path / name, mode="r")
        same = zarr.create_array(
            tmp_path / f"{name}.zarr",
            shape=array.shape,
            dtype=array.dtype,
            chunks=array.chunks,
            shards=array.shards,
            compressors=array.compressors,
        )
        assert same.metadata.codecs == array.metadata.codecs
        assert {codec.__class__.__name__ for codec in array.compressors} == {"BloscCodec", "Crc32cCodec"}


# --- what a variable says of itself -------------------------------------------------------------------------


def everything() -> st.StoreSpec:
    """A spec with every layer, of packaged faults and of one of a plug-in."""
    faults = (*FAULTS, "glint")
    soft = ("dust_opacity", "", "straylight_added", "vignetting_factor", "glint_opacity")
    layers = (*LAYERS, *(f"without_{fault}" for fault in faults), *filter(None, soft))
    optional = tuple(name for name in layers if name not in st.REQUIRED_LAYERS)
    more = {"sample_names": ("a", "b"), "mask_any_faults": (), "rendered_shape": (28, 36)}
    return make_spec(faults=faults, layers=optional, soft_layers=soft, **more)


def test_every_variable_has_a_name_a_unit_and_a_description() -> None:
    members = everything().members(2)
    assert members.keys() >= {*LAYERS, *SCALARS, "without_glint", "glint_opacity", "name", "row", "crc32c", "done"}
    for name, member in members.items():
        said = member.attributes
        assert said["units"] in UNITS, name
        assert re.fullmatch(r"\S.*", said["long_name"]), name
        assert re.fullmatch(r"[A-Z0-9a-z].{10,}\.", said["description"]), name
        assert said["description"] != said["long_name"], name


def test_xarray_draws_images_upright(finished_store: Path) -> None:
    """The first row of the array is drawn at the top of the figure, without any option."""
    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    with xarray.open_zarr(finished_store) as data:
        image = data["image"][0].load()
        image.values[:] = 0
        image.values[:12] = 255  # the upper half is white
        np.testing.assert_array_equal(data["row"], -data["y"])
        assert data["y"].attrs["axis"] == "Y"
    grey = {"vmin": 0, "vmax": 255, "cmap": "gray", "add_colorbar": False}
    draws = {
        "plot": lambda axes: image.sel(channel="R").plot(ax=axes, **grey),
        "imshow": lambda axes: image.sel(channel="R").plot.imshow(ax=axes, **grey),
        "colour": lambda axes: image.sel(channel=["R", "G", "B"]).plot.imshow(ax=axes),
    }
    for name, draw in draws.items():
        figure, axes = plt.subplots(figsize=(2, 2))
        draw(axes)
        figure.canvas.draw()
        box = axes.get_window_extent()
        drawn = np.asarray(figure.canvas.buffer_rgba())[..., 0]
        x, height = int(box.x0 + box.width / 2), drawn.shape[0]
        upper, lower = (drawn[int(height - (box.y0 + f * box.height)), x] for f in (0.75, 0.25))
        plt.close(figure)
        assert (upper, lower) == (255, 0), name


def test_stores_of_other_codecs_are_merged_after_a_migration(old: Path, tmp_path: Path) -> None:
    new = dataset.migrate_store(old, tmp_path / "new.zarr").path
    with pytest.raises(
        InputError, match=r"new\.zarr: has another format or other codecs than .*s\.zarr; make a copy"
    ):
        dataset.merge_stores([old, new], tmp_path / "m.zarr", progress=False)
    for store, out in ((old, "old-merged.zarr"), (new, "new-merged.zarr")):
        assert dataset.merge_stores([store], tmp_path / out, progress=False).digest == DIGEST
        assert dataset.verify(tmp_path / out).problems == []
        assert st.open_store(tmp_path / out).spec.codecs == st.open_store(store).spec.codecs
