"""Stores that live long: their codecs, copies with other codecs, and variables that explain themselves."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import matplotlib
import numpy as np
import pytest
import xarray
from conftest import Called
from numcodecs import blosc
from synthetic import FAULTS, filled, make_spec

from vbnfault import dataset
from vbnfault import store as st
from vbnfault.core.errors import InputError, VbnfaultError
from vbnfault.store import codec
from vbnfault.store.arrays import LAYERS, SCALARS, ZSTD
from vbnfault.store.compressors import compressor, fitting

# Words of UDUNITS that the store uses; udunits 2.2.28 parses each of them.
UNITS = {"1", "count", "m", "nm", "s", "d", "au", "degree", "W m-2 sr-1 nm-1"}


@pytest.fixture
def plain(tmp_path: Path) -> st.Store:
    """A store whose layers have another codec than those of new stores."""
    return filled(tmp_path / "s.zarr", samples=5, codecs=dict.fromkeys(make_spec().pixel_layers, "zstd 3"))


# --- copies of a store with other codecs --------------------------------------------------------------------


def test_a_copy_has_the_codecs_of_new_stores_and_leaves_the_source(plain: st.Store, tmp_path: Path) -> None:
    before = {p: p.read_bytes() for p in plain.path.rglob("*") if p.is_file()}
    (tmp_path / "new.zarr").mkdir()  # an empty folder may be used
    store = dataset.migrate_store(plain.path, tmp_path / "new.zarr", progress=False)
    assert {p: p.read_bytes() for p in plain.path.rglob("*") if p.is_file()} == before
    assert store.spec.codecs == {name: row.codec for name, row in store.spec.pixel_layers.items()}
    assert st.examine(store).problems == []
    assert st.digest(store) == st.digest(plain)
    with xarray.open_zarr(plain.path) as source, xarray.open_zarr(store.path) as data:
        for name in source.data_vars:
            np.testing.assert_array_equal(data[name].values, source[name].values)


def test_unfinished_and_damaged_samples_are_not_copied(plain: st.Store, tmp_path: Path) -> None:
    st.append_samples(plain.path, 4)
    chunk = plain.chunk("image", 0)[0]  # sound in itself, but of another sample
    shard = codec.join_shard({0: chunk, 1: chunk}, plain.spec.shard_samples)
    plain.file("image", 0).write_bytes(shard)
    with pytest.raises(VbnfaultError, match="sample 1: image in image/c/0/0/0/0 does not match its stored crc32c"):
        dataset.migrate_store(plain.path, tmp_path / "new.zarr", progress=False)
    assert "samples 1-3" in st.examine(tmp_path / "new.zarr").problems[0]


def test_stores_of_other_codecs_are_merged(plain: st.Store, tmp_path: Path) -> None:
    """A shard that both have begun holds chunks of one codec afterwards."""
    other, want = tmp_path / "b.zarr", st.digest(plain)
    st.create(other, make_spec(), 5)
    st.write_samples(other, [plain.read_sample(i) for i in (0, 4)])
    summary = dataset.merge_stores([other, plain.path], tmp_path / "m.zarr", progress=False)
    assert summary.digest == want
    assert summary.taken == {str(other): 2, str(plain.path): 3}
    assert st.open_store(tmp_path / "m.zarr").spec.codecs == make_spec().codecs
    assert st.examine(tmp_path / "m.zarr").problems == []


def test_the_command_says_what_it_did_and_refuses_in_one_sentence(
    plain: st.Store, tmp_path: Path, call: Callable[..., Called]
) -> None:
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos/a.png").write_bytes(b"x")
    old = plain.path
    for arguments, sentence in (
        ((old, "--out", tmp_path / "photos"), "photos: exists and is no vbnfault store, so it is left alone"),
        ((old, "--out", old / "sub.zarr"), "lies in the store"),
        ((old, "--out", old), "nothing to merge"),
        ((tmp_path / "none.zarr",), "no such store"),
    ):
        refused = call("migrate", *arguments)
        assert (refused.code, sentence in refused.said) == (2, True)
    st.append_samples(old, 1)
    copied = call("migrate", old, "--out", tmp_path / "new.zarr").out.splitlines()[-1]
    assert copied == f"{tmp_path / 'new.zarr'}: 6 samples, 5 finished, format 3"
    assert call("migrate", old).out == f"{old}: 6 samples, 5 finished, format 3\n"


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
    figure, axes = plt.subplots(figsize=(2, 2))
    image.sel(channel="R").plot.imshow(ax=axes, **grey)
    figure.canvas.draw()
    box = axes.get_window_extent()
    drawn = np.asarray(figure.canvas.buffer_rgba())[..., 0]
    x, height = int(box.x0 + box.width / 2), drawn.shape[0]
    upper, lower = (drawn[int(height - (box.y0 + f * box.height)), x] for f in (0.75, 0.25))
    plt.close(figure)
    assert (upper, lower) == (255, 0)
