"""The store: schema as xarray sees it, writing, growing and refusing, with other samples' bits kept."""

from __future__ import annotations

import errno
import json
import os
import shutil
import warnings
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray
import zarr
from conftest import recorded_calls, small_scene
from synthetic import FAULTS, LOCALISED, fake_sample, filled, flip, make_spec, repaired

from vbnfault import store as st
from vbnfault.core.errors import InputError, VbnfaultError
from vbnfault.scene.config import parse_scene
from vbnfault.scene.plan import make_plan
from vbnfault.store import codec, disk, shards
from vbnfault.store.codec import crc32c


def test_a_finished_store_verifies_and_reads_back(whole: st.Store) -> None:
    assert st.examine(whole).problems == []
    assert st.problem_samples(whole) == []
    for i in (0, 5, 9):
        want, got = fake_sample(whole.spec, i), whole.read_sample(i)
        assert set(got.layers) == set(whole.spec.pixel_layers)
        for name, array in want.layers.items():
            assert got.layers[name].dtype == array.dtype
            np.testing.assert_array_equal(got.layers[name], array, err_msg=name)
        for name in ("camera_from_T", "T_from_L", "sun_xy_px", "injected"):
            np.testing.assert_array_equal(got.scalars[name], want.scalars[name], err_msg=name)
        assert json.loads(got.scalars["parameters"]) == want.scalars["parameters"]
        np.testing.assert_array_equal(got.layers["mask_any"], want.layers["mask"][:3].any(0))


def test_the_layout_is_the_contract(whole: st.Store) -> None:
    dtypes = {"image": "uint8", "mask": "bool", "raw": "uint16", "depth_m": "float32", "normal": "float16"}
    for name in (*dtypes, "radiance", "clean", "mask_any"):
        array = zarr.open_array(whole.path / name, mode="r")
        assert array.chunks[0] == 1
        assert array.chunks[1:] == array.shape[1:]
        assert array.shards is not None
        assert array.shards[0] == 4
        assert str(array.dtype) == dtypes.get(name, str(array.dtype))
        last = array.compressors[-1].to_dict()
        assert last["name"] == "crc32c" or last["configuration"]["checksum"]
    assert zarr.open_array(whole.path / "mask", mode="r").metadata.dimension_names == ("sample", "fault", "y", "x")
    assert zarr.open_array(whole.path / "crc32c", mode="r").metadata.dimension_names == ("sample", "layer")


def test_xarray_opens_it_without_a_warning_and_shows_axes_units_and_coordinates(whole: st.Store) -> None:
    xarray = pytest.importorskip("xarray")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with xarray.open_zarr(whole.path) as data:
            assert data["image"].dims == ("sample", "y", "x", "channel")
            assert data["image"].attrs["units"] == "count"
            assert data["depth_m"].attrs["units"] == "m"
            assert list(data["channel"].values) == ["R", "G", "B", "I"]
            assert list(data["fault"].values) == list(FAULTS)
            np.testing.assert_array_equal(data["sample"], np.arange(10))
            assert "wavelength_nm" in data.coords
            assert data["wavelength_nm"].dims == ("band",)
            assert data["wavelength_nm"].attrs["units"] == "nm"
            assert data["stratum"].attrs["flag_meanings"] == "sun-facing sun-averted"
            assert data["mask_any"].attrs["faults"] == list(LOCALISED)
            assert data["site"].attrs["names"] == ["site-0", "site-1", "site-2"]
            assert data["exposure_s"].dtype == np.float64  # not taken for a duration
            assert data["mask"].dtype == bool
            image = data["image"].sel(sample=3, channel="I").load()
            np.testing.assert_array_equal(image, fake_sample(whole.spec, 3).layers["image"][..., 3])
            assert json.loads(str(data["proposal"][4].values)) == {"sun_elevation_deg": 0.4}
            assert all(name in data for name in st.SCALARS)


def test_shards_shrink_for_large_images() -> None:
    for size, most in ((1024, 16), (4096, 16), (16384, 1)):
        spec = make_spec(size, width=size, layers=(), shard_samples=0)
        largest = max(spec.layer_bytes(n) for n in spec.pixel_layers)
        assert spec.shard_samples <= most
        assert spec.shard_samples == 1 or spec.shard_samples * largest <= 2**30
    assert make_spec(1024, shard_samples=0).shard_samples == 16
    assert make_spec(24, shard_samples=400).shard_samples == 16


def test_a_shard_that_was_lowered_keeps_to_one_site() -> None:
    """The plan groups samples by site in shards of the wished size, the store lowers that for large frames."""
    for wished, size in ((16, 4), (12, 4), (10, 5), (9, 3), (7, 1), (4, 4)):
        spec = make_spec(3072, width=3072, shard_samples=wished)
        assert spec.shard_samples == size
        assert size * sum(map(spec.layer_bytes, spec.pixel_layers)) <= 2**31
        scene = parse_scene(small_scene(dataset={"samples": 100, "shard_samples": wished}), source="here")
        sites = make_plan(scene, ()).site
        assert len(np.unique(sites)) > 1
        for start in range(0, 100, size):
            assert len(np.unique(sites[start : start + size])) == 1
    lowered = make_spec(3072, width=3072, shard_samples=12)
    assert st.StoreSpec(**lowered.plain()).shard_samples == 4  # as a store that is opened again has it


def test_unknown_layers_and_faults_are_refused() -> None:
    with pytest.raises(InputError, match="without_nothing"):
        make_spec(layers=("without_nothing",))
    with pytest.raises(InputError, match="'smear' is not one of"):
        make_spec(mask_any_faults=("smear",))


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (lambda s: s.layers.pop("clean"), "sample 2: the layer clean is missing"),
        (lambda s: s.layers.update(extra=np.zeros(3)), "holds no layer extra"),
        (
            lambda s: s.layers.update(raw=s.layers["raw"].astype(float)),
            r"raw is float64\[24, 32\], not uint16",
        ),
        (lambda s: s.layers.update(depth_m=s.layers["depth_m"][1:]), r"depth_m is float32\[23, 32\]"),
        (lambda s: s.scalars.pop("exposure_s"), "the scalar exposure_s is missing"),
        (lambda s: s.scalars.update(camera_from_T=np.zeros(3)), "camera_from_T has shape"),
        (lambda s: s.scalars.update(stratum=256), "does not fit uint8"),
    ],
)
def test_a_sample_that_does_not_fit_is_refused(whole: st.Store, change: object, sentence: str) -> None:
    sample = fake_sample(whole.spec, 2)
    change(sample)  # type: ignore[operator]
    with pytest.raises(ValueError, match=sentence):
        st.write_samples(whole, [sample])
    assert st.examine(whole).problems == []


def test_unfinished_samples_are_named_and_the_rest_is_kept(tmp_path: Path) -> None:
    store = st.create(tmp_path / "s.zarr", make_spec(), 10)
    assert st.examine(store).problems == ["samples 0-9 are not built yet"]
    st.write_samples(store, [fake_sample(store.spec, i) for i in (0, 3, 5)])
    assert st.examine(store).problems == ["samples 1-2, 4, 6-9 are not built yet"]
    with pytest.raises(InputError, match="sample 1 is not finished"):
        store.read_sample(1)
    with pytest.raises(InputError, match="the range is 0 to 9"):
        store.read_sample(10)
    st.write_samples(store, [fake_sample(store.spec, i) for i in (9, 1, 2, 4, 6, 8, 7)])
    assert st.examine(store).problems == []
    assert st.digest(store) == st.digest(filled(tmp_path / "t.zarr"))


def test_samples_not_given_keep_their_compressed_bytes(whole: st.Store) -> None:
    chunks = whole.chunk("image", 0)
    st.write_samples(whole, [fake_sample(whole.spec, 2)])
    assert whole.chunk("image", 0) == chunks


def test_a_store_without_fault_classes_works(tmp_path: Path) -> None:
    changes: dict = {"faults": (), "mask_any_faults": (), "layers": ("mask_effect", "depth_m")}
    store = filled(tmp_path / "s.zarr", **changes)
    assert zarr.open_array(store.path / "mask", mode="r").shape == (10, 0, 24, 32)
    assert not (store.path / "mask/c").exists()
    assert st.examine(store).problems == []
    assert st.problem_samples(store) == []
    assert store.read_sample(4).layers["mask"].shape == (0, 24, 32)
    assert st.digest(store) == st.digest(filled(tmp_path / "t.zarr", **changes, shard_samples=3))
    flip(store.file("image", 1), 20)
    assert st.problem_samples(store) == [4]
    store = st.append_samples(store, 3)
    st.write_samples(store, [fake_sample(store.spec, i) for i in (4, 10, 11, 12)])
    assert st.examine(store).problems == []
    xarray = pytest.importorskip("xarray")
    with xarray.open_zarr(store.path) as data:
        assert data["mask"].load().shape == (13, 0, 24, 32)
        assert data["fault"].shape == (0,)


# --- growing, recovering, refusing --------------------------------------------------------------------------


def test_an_interrupted_append_is_reported_and_mended(whole: st.Store, monkeypatch: pytest.MonkeyPatch) -> None:
    """Killed before the spare is written the store is as before, killed after that it is grown."""
    replace = os.replace
    for root_file, samples, sentence in (
        ("spare/zarr.json", 10, "image holds 14 samples, not 10: appending was interrupted"),
        ("zarr.json", 14, "zarr.json is older than spare/zarr.json: a change of the attributes was interrupted"),
    ):

        def kill(partial: Path, path: Path, at: Path = whole.path / root_file) -> None:
            if path == at:
                raise KeyboardInterrupt
            replace(partial, path)

        monkeypatch.setattr(os, "replace", kill)
        with pytest.raises(KeyboardInterrupt):
            st.append_samples(st.open_store(whole.path), 4)
        monkeypatch.undo()
        # a reader may see this state beside a writer that lives, so that opening does not warn: `verify` reports it
        assert st.open_store(whole.path).samples == samples
        assert st.examine(whole.path).problems[0].startswith(sentence)
        store = st.recover(whole.path)
        assert st.problem_samples(store) == list(range(10, samples))


def test_digest_ignores_time_and_layout_and_nothing_else(finished_store: Path, tmp_path: Path) -> None:
    want = st.digest(finished_store)
    attributes = make_spec().attributes
    other = filled(tmp_path / "a.zarr", shard_samples=3, attributes={**attributes, "created": "2031-01-01"})
    assert st.digest(other) == want
    assert st.digest(filled(tmp_path / "b.zarr", attributes={**attributes, "seed": 8})) != want
    sample = fake_sample(other.spec, 4)
    sample.layers["normal"][0, 0, 0] = 1  # type: ignore[index]
    st.write_samples(other, [sample])
    assert st.digest(other) != want


def test_no_store_is_created_within_another(finished_store: Path) -> None:
    for name in ("inner.zarr", "image/c/x.zarr"):
        with pytest.raises(InputError, match=r"x?\.zarr: lies in the store .*, and would be lost with it; choose"):
            st.create(finished_store / name, make_spec(), 4)
        assert not (finished_store / name).exists()


def renamed_once() -> Callable[[Path, Path], None]:
    """A rename that works once, and then fails as on a broken disk."""
    names: list[Path] = []

    def rename(source: Path, target: Path) -> None:
        names.append(source)
        if len(names) > 1:
            raise OSError(errno.EIO, "Input/output error")
        os.replace(source, target)

    return rename


def test_create_leaves_foreign_folders_alone(
    whole: st.Store, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    foreign = tmp_path / "photos"
    foreign.mkdir()
    (foreign / "a.png").write_bytes(b"x")
    for overwrite in (False, True):
        with pytest.raises(InputError, match="is no vbnfault store, so it is left alone"):
            st.create(foreign, make_spec(), 3, overwrite=overwrite)
    assert (foreign / "a.png").exists()
    with pytest.raises(InputError, match="exists already"):
        st.create(whole.path, make_spec(), 3)
    assert st.create(whole.path, make_spec(), 3, overwrite=True).samples == 3
    (tmp_path / "empty").mkdir()
    st.create(tmp_path / "empty", make_spec(), 3)
    # the new store cannot take its place: the old one stays
    digest = st.digest(st.open_store(whole.path))
    with monkeypatch.context() as patch:
        patch.setattr(disk, "rename", renamed_once())
        with pytest.raises(VbnfaultError, match="no store can be created here"):
            st.create(whole.path, make_spec(), 5, overwrite=True)
    assert st.digest(st.open_store(whole.path)) == digest
    assert sorted(p.name for p in tmp_path.iterdir()) == ["empty", "photos", "s.zarr"]
    with pytest.raises(InputError, match="must be at least 1"):
        st.create(tmp_path / "none", make_spec(), 0)


@pytest.mark.parametrize(
    ("version", "sentence"),
    [
        (st.FORMAT_VERSION + 1, f"reads up to {st.FORMAT_VERSION}; install a newer one$"),
        (
            2,
            "earlier vbnfault made it, and this one reads 3; open it with xarray, complete it with vbnfault 0.1",
        ),
        ("2", "is no vbnfault store"),
    ],
)
def test_a_store_of_another_format_is_refused_and_left_as_it_is(
    whole: st.Store, version: object, sentence: str
) -> None:
    whole.update_attributes({"format_version": version})
    before = {p: p.read_bytes() for p in whole.path.rglob("*") if p.is_file()}
    for use in (st.open_store, st.examine, st.digest, st.recover, lambda path: st.append_samples(path, 2)):
        with pytest.raises(InputError, match=sentence):
            use(whole.path)
    assert {p: p.read_bytes() for p in whole.path.rglob("*") if p.is_file()} == before
    with xarray.open_zarr(whole.path) as data:  # as the sentence says
        assert data.sizes["sample"] == whole.samples
    # --overwrite replaces it
    st.create(whole.path, whole.spec, whole.samples, overwrite=True)
    assert st.open_store(whole.path).finished() == 0


def test_a_full_disk_is_one_sentence_and_what_was_done_stays(
    whole: st.Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    before, calls = st.digest(whole), 0
    replace = os.replace

    def full(src: str, dst: str) -> None:
        nonlocal calls
        calls += 1
        if calls > 3:
            raise OSError(errno.ENOSPC, "No space left on device")
        replace(src, dst)

    monkeypatch.setattr(os, "replace", full)
    with pytest.raises(VbnfaultError, match="No space left on device while writing samples 4-7; finished"):
        st.write_samples(whole, [fake_sample(whole.spec, 6)])
    monkeypatch.undo()
    assert not list(whole.path.rglob("*.partial"))
    repaired(whole, [6], before)


# --- shard files for trainers: what is stored, each file opened once, damage in one sentence ----------------------


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
    store = st.open_store(finished_store)
    with pytest.MonkeyPatch.context() as patch:
        ranges = recorded_calls(patch, disk.os, "pread")
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
