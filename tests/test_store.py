"""The store: schema as xarray sees it, damage of every kind found, rewriting that keeps other bits."""

from __future__ import annotations

import errno
import json
import os
import re
import shutil
import warnings
from pathlib import Path

import numpy as np
import pytest
import xarray
import zarr
from conftest import small_scene

from vbnfault import store as st
from vbnfault.core.errors import InputError, VbnfaultError
from vbnfault.core.quantities import Sample
from vbnfault.scene.config import parse_scene
from vbnfault.scene.plan import make_plan
from vbnfault.store import check, codec

FAULTS = ("dust_on_optics", "broken_pixels", "straylight", "vignetting")
LOCALISED = FAULTS[:3]


def make_spec(size: int = 24, **changes: object) -> st.StoreSpec:
    """A small spec with every kind of optional layer; 4 samples a shard."""
    values: dict = {
        "height": size,
        "width": size + 8,
        "faults": FAULTS,
        "mask_any_faults": LOCALISED,
        "wavelength_nm": (450.0, 550.0, 650.0),
        "layers": ("without_straylight", "mask_effect", "raw", "depth_m", "normal", "semantic", "radiance"),
        "site_names": ("site-0", "site-1", "site-2"),
        "lens_names": ("thin",),
        "detector_names": ("a", "b"),
        "shard_samples": 4,
        "attributes": {"scene": {"body": {"name": "67P"}, "samples": 10}, "scene_hash": "abc", "seed": 7},
    }
    return st.StoreSpec(**{**values, **changes})


def fake_sample(spec: st.StoreSpec, index: int, site: int | None = None) -> Sample:
    """A deterministic sample that satisfies every rule of labelling."""
    rng = np.random.default_rng([11, index])
    h, w = spec.height, spec.width
    injected = rng.random(len(spec.faults)) < 0.6
    y, x = np.mgrid[:h, :w] / h
    shade = np.clip(140 * (y > 0.4) * (0.6 + 0.4 * np.sin(7 * x + index)), 0, 255)
    clean = np.clip(shade[..., None] + rng.normal(8, 2, (h, w, 4)), 0, 255).astype(np.uint8)
    image, mask = clean.copy(), np.zeros((len(spec.faults), h, w), bool)
    for k, fault in enumerate(spec.faults):
        if injected[k]:
            cx, cy, r = rng.uniform(0.2, 0.8, 3)
            mask[k] = np.hypot(x - cx, y - cy) < r / 4 if fault in LOCALISED else True
            image[mask[k]] = np.clip(image[mask[k]] * (0.5, 0.2, 2.0, 0.8)[k], 0, 255).astype(np.uint8)
    layers = {
        "image": image,
        "clean": clean,
        "mask": mask,
        "without_straylight": clean if dict(zip(spec.faults, injected, strict=True)).get("straylight") else image,
        "mask_effect": mask,
        "raw": rng.integers(0, 4096, (h, w), dtype=np.uint16),
        "depth_m": np.where(y > 0.4, 100 / (y + 0.1), np.inf).astype(np.float32),
        "normal": np.zeros((h, w, 3), np.float16),
        "semantic": (y > 0.4).astype(np.uint8),
        "radiance": rng.random((3, h, w)).astype(np.float16),
    }
    scalars: dict = {}
    for name, row in st.SCALARS.items():
        scalars[name] = rng.standard_normal(spec.shape(row)) if row.dtype == "float64" else 0
    site = index // 3 % 3 if site is None else site
    scalars |= {
        "injected": injected,
        "sun_xy_px": (np.nan, np.nan),
        "tries": 1,
        "stratum": index % 2,
        "site": site,
        "split": st.SPLITS[site % 3],
        "resolved": True,
        "parameters": {
            f: {"amplitude": 0.5, "x": index} for f, on in zip(spec.faults, injected, strict=True) if on
        },
        "proposal": json.dumps({"sun_elevation_deg": index / 10}),
    }
    wanted = (*spec.pixel_layers, "mask")
    return Sample(index=index, layers={k: v for k, v in layers.items() if k in wanted}, scalars=scalars)


def filled(path: Path, samples: int = 10, **changes: object) -> st.Store:
    """A finished store."""
    store = st.create(path, make_spec(**changes), samples)
    st.write_samples(store, [fake_sample(store.spec, i) for i in range(samples)])
    return store


@pytest.fixture(scope="module")
def template(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("store") / "template.zarr"
    filled(path)
    return path


@pytest.fixture
def whole(template: Path, tmp_path: Path) -> st.Store:
    """A copy of a finished store of 10 samples in 3 shards, to be damaged."""
    return st.open_store(shutil.copytree(template, tmp_path / "s.zarr"), "r+")


def test_a_finished_store_verifies_and_reads_back(whole: st.Store) -> None:
    assert st.verify(whole) == []
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
        assert all(c.to_dict()["configuration"]["checksum"] for c in array.compressors)
    assert whole.array("mask").metadata.dimension_names == ("sample", "fault", "y", "x")
    assert whole.array("crc32c").metadata.dimension_names == ("sample", "layer")


def test_xarray_opens_it_without_a_warning_and_shows_axes_units_and_coordinates(whole: st.Store) -> None:
    xarray = pytest.importorskip("xarray")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with xarray.open_zarr(whole.path) as data:
            assert data["image"].dims == ("sample", "y", "x", "channel")
            assert data["image"].attrs["units"] == "DN"
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
    assert st.verify(whole) == []


# --- damage -----------------------------------------------------------------------------------------------


def flip(file: Path, position: int) -> None:
    data = bytearray(file.read_bytes())
    data[position] ^= 0x10
    file.write_bytes(bytes(data))


def repaired(store: st.Store, damaged: list[int], before: str) -> None:
    """Exactly `damaged` is reported; building those again restores the digest, touching no other sample."""
    assert st.problem_samples(store) == damaged
    st.write_samples(store, [fake_sample(store.spec, i) for i in damaged])
    assert st.verify(store) == []
    assert st.digest(store) == before


def test_a_flipped_byte_of_a_chunk_concerns_one_sample(whole: st.Store) -> None:
    before = st.digest(whole)
    flip(whole.file("image", 1), 20)  # within the first chunk of the shard
    (sentence,) = st.verify(whole)
    assert re.match(r"sample 4: image cannot be decoded, its chunk in image/c/1/0/0/0", sentence)
    repaired(whole, [4], before)


def test_every_flipped_byte_of_a_shard_is_found(whole: st.Store) -> None:
    file = whole.file("mask", 2)
    good = file.read_bytes()
    for position in range(0, len(good), 7):
        flip(file, position)
        assert st.check_shard(whole, 2), position
        file.write_bytes(good)
    assert st.check_shard(whole, 2) == []


def test_damage_that_decodes_is_found_by_the_stored_checksum(whole: st.Store) -> None:
    """Another sample's chunk in this one's place is sound in itself."""
    chunks = whole.chunk("depth_m", 0)
    other = st.encode(
        whole.spec,
        Sample(
            index=1,
            layers={**fake_sample(whole.spec, 1).layers, "depth_m": np.ones((24, 32), np.float32)},
            scalars=fake_sample(whole.spec, 1).scalars,
        ),
    )
    whole.file("depth_m", 0).write_bytes(codec.join_shard({**chunks, 1: other.chunks["depth_m"]}, 4))
    before_sentence = "sample 1: depth_m in depth_m/c/0/0/0 does not match its stored crc32c"
    assert st.verify(whole) == [before_sentence]


def test_a_missing_chunk_is_found_although_it_reads_as_zeros(whole: st.Store) -> None:
    before = st.digest(whole)
    chunks = whole.chunk("mask", 1)
    del chunks[6]
    whole.file("mask", 1).write_bytes(codec.join_shard({i - 4: c for i, c in chunks.items()}, 4))
    assert not whole.read("mask", 6, 7).any()
    assert st.verify(whole) == ["sample 6: mask has no chunk in mask/c/1/0/0/0"]
    repaired(whole, [6], before)


@pytest.mark.parametrize("name", ["clean", "mask_any", "tries", "parameters", "injected", "crc32c", "done"])
def test_a_missing_file_concerns_its_shard(whole: st.Store, name: str) -> None:
    before = st.digest(whole)
    whole.file(name, 1).unlink()
    sentences = st.verify(whole)
    assert any(f"{name} of samples 4-7" in s and f"{name}/c/1" in s for s in sentences)
    repaired(whole, [4, 5, 6, 7], before)


@pytest.mark.parametrize("keep", [0, 1, 40, -1, -70])
def test_a_truncated_shard_is_found_and_rebuilt(whole: st.Store, keep: int) -> None:
    before = st.digest(whole)
    file = whole.file("without_straylight", 2)
    file.write_bytes(file.read_bytes()[:keep])
    (sentence,) = st.verify(whole)
    assert sentence.startswith("without_straylight of samples 8-9: the shard file without_straylight/c/2/0/0/0")
    repaired(whole, [8, 9], before)


@pytest.mark.parametrize("name", ["sun_direction_T", "parameters", "crc32c", "done", "split"])
def test_a_flipped_byte_of_a_scalar_chunk_is_found(whole: st.Store, name: str) -> None:
    before = st.digest(whole)
    for number, concerned in ((0, [0, 1, 2, 3]), (2, [8, 9])):
        file = whole.file(name, number)
        flip(file, len(file.read_bytes()) // 2)
        assert any(s.startswith((name, "samples")) and name in s for s in st.verify(whole))
        repaired(whole, concerned, before)


def test_a_scalar_changed_behind_its_checksum_is_found(whole: st.Store) -> None:
    whole.array("exposure_s")[5] = 2.0
    assert st.verify(whole) == ["sample 5: its scalars do not match their crc32c"]


def test_unfinished_samples_are_named_and_the_rest_is_kept(tmp_path: Path) -> None:
    store = st.create(tmp_path / "s.zarr", make_spec(), 10)
    assert st.verify(store) == ["samples 0-9 are not built yet"]
    st.write_samples(store, [fake_sample(store.spec, i) for i in (0, 3, 5)])
    assert st.verify(store) == ["samples 1-2, 4, 6-9 are not built yet"]
    with pytest.raises(InputError, match="sample 1 is not finished"):
        store.read_sample(1)
    with pytest.raises(InputError, match="the range is 0 to 9"):
        store.read_sample(10)
    st.write_samples(store, [fake_sample(store.spec, i) for i in (9, 1, 2, 4, 6, 8, 7)])
    assert st.verify(store) == []
    assert st.digest(store) == st.digest(filled(tmp_path / "t.zarr"))


def test_samples_not_given_keep_their_compressed_bytes(whole: st.Store) -> None:
    chunks = whole.chunk("image", 0)
    st.write_samples(whole, [fake_sample(whole.spec, 2)])
    assert whole.chunk("image", 0) == chunks


def test_the_order_is_done_last(whole: st.Store, monkeypatch: pytest.MonkeyPatch) -> None:
    """A kill between any two writes leaves no unfinished sample marked as done."""
    written: list[str] = []
    replace = os.replace

    def note(partial: Path, path: Path) -> None:
        replace(partial, path)
        name = path.relative_to(whole.path).parts[0]
        written.append(f"done={whole.column(name, 1).tolist()}" if name == "done" else name)

    monkeypatch.setattr(os, "replace", note)
    st.write_samples(whole, [fake_sample(whole.spec, 5)])
    assert written[0] == "done=[1, 0, 1, 1]"
    assert written[-1] == "done=[1, 1, 1, 1]"
    assert set(written[1:-1]) == {*whole.spec.pixel_layers, *st.SCALARS, "crc32c"}


# --- labels -----------------------------------------------------------------------------------------------


def relabelled(whole: st.Store, index: int, **changes: object) -> list[str]:
    """Problems after a sample was written again, whole, with other labels."""
    sample = fake_sample(whole.spec, index)
    for name, value in changes.items():
        (sample.scalars if name in st.SCALARS else sample.layers)[name] = value  # type: ignore[index]
    st.write_samples(whole, [sample])
    return st.verify(whole)


def test_labels_that_contradict_each_other_are_found(whole: st.Store) -> None:
    sample = fake_sample(whole.spec, 1)
    on = int(np.flatnonzero(sample.scalars["injected"][:3])[0])
    off = int(np.flatnonzero(~sample.scalars["injected"])[0])
    mask = sample.layers["mask"].copy()
    mask[off, 3, 3] = True
    any_of = mask[:3].any(0)
    assert f"sample 1: mask of {FAULTS[off]} is not empty" in relabelled(whole, 1, mask=mask, mask_any=any_of)[0]
    mask = sample.layers["mask"].copy()
    mask[on] = False
    assert f"sample 1: mask of {FAULTS[on]} is empty" in relabelled(whole, 1, mask=mask)[0]
    any_of = sample.layers["mask"].any(0) ^ True
    assert "sample 1: mask_any is not the union" in relabelled(whole, 1, mask_any=any_of)[0]
    (sentence,) = relabelled(whole, 1, parameters={**sample.scalars["parameters"], FAULTS[off]: {"a": 1}})
    assert sentence == f"sample 1: {FAULTS[off]} has parameters, although not marked in injected"
    fewer = {k: v for k, v in sample.scalars["parameters"].items() if k != FAULTS[on]}
    (sentence,) = relabelled(whole, 1, parameters=fewer)
    assert sentence == f"sample 1: {FAULTS[on]} has no parameters, although marked in injected"
    (sentence,) = relabelled(whole, 1, split="test")
    assert sentence == "sample 1: split = test, but sample 0 of the same site site-0 has train"
    assert relabelled(whole, 1) == []


def test_pictures_and_effects_that_contradict_the_labels_are_found(whole: st.Store) -> None:
    """`injected` is what the pixels hold: a picture or an effect that says otherwise is a problem."""
    sample = next(s for i in range(10) if not (s := fake_sample(whole.spec, i)).scalars["injected"][2])
    i, off = sample.index, sample.scalars["injected"].argmin()
    on = sample.scalars["injected"].argmax()
    wrong = sample.layers["without_straylight"].copy()
    wrong[2, 3, 1] ^= 1
    (sentence,) = relabelled(whole, i, without_straylight=wrong)
    assert sentence == f"sample {i}: without_straylight differs from image, although straylight is not injected"
    effect = sample.layers["mask_effect"].copy()
    effect[off, 3, 3] = True
    (sentence,) = relabelled(whole, i, mask_effect=effect)
    assert sentence == f"sample {i}: mask_effect of {FAULTS[off]} is not empty, although it is not injected"
    effect = sample.layers["mask_effect"].copy()
    effect[on] = False
    (sentence,) = relabelled(whole, i, mask_effect=effect)
    assert sentence == f"sample {i}: mask_effect of {FAULTS[on]} is empty, although it is injected"
    none = {name: np.zeros_like(sample.layers[name]) for name in ("mask", "mask_effect")}
    nothing = {**none, "injected": np.zeros(4, bool), "parameters": {}, "without_straylight": wrong, "image": wrong}
    (sentence,) = relabelled(whole, i, **nothing, clean=sample.layers["image"])
    assert sentence == f"sample {i}: image differs from clean, although no fault is injected"
    assert relabelled(whole, i, **nothing, clean=wrong) == []


def test_one_pass_gives_problems_digest_and_counts(whole: st.Store, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each chunk is decompressed once, for checksums, labels and digest together."""
    decoded: list[int] = []
    decompress = check.decompress
    monkeypatch.setattr(check, "decompress", lambda data: (decoded.append(1), decompress(data))[1])
    commanded = np.array([fake_sample(whole.spec, i).scalars["injected"] for i in range(10)])
    realised = commanded.sum(axis=0)
    i, off = (int(n[0]) for n in np.nonzero(~commanded))
    commanded[i, off] = True
    told: list[int] = []
    report = st.examine(whole, expected=lambda i, _: {"injected": commanded[i]}, progress=told.append)
    assert len(decoded) == 10 * len(whole.spec.pixel_layers)
    assert told == [4, 4, 2]
    assert report.problems == []
    assert report.digest == st.digest(whole)
    assert [report.counts.realised(f) for f in FAULTS] == realised.tolist()
    assert [report.counts.planned(f) for f in FAULTS] == commanded.sum(axis=0).tolist()
    assert report.counts.missing == {FAULTS[off]: 1}
    # sites of three samples take the splits in turn
    splits = [("train", "val", "test")[i // 3 % 3] for i in range(10)]
    assert report.counts.samples == {s: splits.count(s) for s in splits}
    for split in report.counts.samples:
        rows = [k for k, s in enumerate(splits) if s == split]
        for k, fault in enumerate(FAULTS):
            assert report.counts.planned(fault, split) == commanded[rows, k].sum()
    row = next(line for line in report.counts.lines() if line.startswith(FAULTS[off]))
    here = commanded[[k for k, s in enumerate(splits) if s == splits[i]], off].sum()
    assert f"{here - 1} of {here}" in row
    (sentence,) = st.verify(whole, expected=lambda i, _: {"injected": commanded[i]}, exact=True)
    assert sentence == f"sample {i}: {FAULTS[off]} is not injected, although the plan commands it"


def test_an_unfinished_or_damaged_store_has_no_digest_in_its_report(whole: st.Store) -> None:
    want = st.digest(whole)
    added = st.append_samples(whole, 1)
    assert st.examine(added).digest is None
    assert st.digest(added) != want  # of what is there
    flip(added.file("image", 1), 20)
    assert st.examine(added).digest is None
    with pytest.raises(VbnfaultError, match=r"sample \d+: image .*; the build command mends it"):
        st.digest(added)


def test_verify_compares_with_the_plan(whole: st.Store) -> None:
    def plan(i: int, tries: int = 0) -> dict:
        scalars = fake_sample(whole.spec, i).scalars
        return {name: scalars[name] for name in ("site", "proposal", "sun_xy_px", "julian_date", "injected")}

    assert st.verify(whole, expected=plan) == []
    (sentence,) = st.verify(whole, expected=lambda i, _: plan(i) | ({"site": 2} if i == 3 else {}))
    assert sentence == "sample 3: site = 1 is not as planned (2)"
    (sentence,) = st.verify(whole, expected=lambda i, _: plan(i) | ({"proposal": "{}"} if i == 3 else {}))
    assert sentence.startswith('sample 3: proposal = {"sun_elevation_deg": 0.3} is not as planned')


def test_a_fault_that_was_not_commanded_is_found(whole: st.Store) -> None:
    """The sample is labelled soundly in itself, its checksums are right: the plan alone says that it is wrong."""
    commanded = {i: fake_sample(whole.spec, i).scalars["injected"] for i in range(10)}
    commanded[4] = np.ones(4, bool)  # what had no effect is not injected, and that is no problem
    assert st.verify(whole, expected=lambda i, _: {"injected": commanded[i]}) == []
    sample = fake_sample(whole.spec, 1)
    off = int(np.flatnonzero(~commanded[1])[0])
    injected, mask = commanded[1].copy(), sample.layers["mask"].copy()
    injected[off] = mask[off, 3, 3] = True
    changes = {"injected": injected, "mask": mask, "mask_effect": mask, "mask_any": mask[:3].any(0)}
    parameters = {**sample.scalars["parameters"], FAULTS[off]: {"amplitude": 0.1}}
    assert relabelled(whole, 1, **changes, parameters=parameters) == []
    (sentence,) = st.verify(whole, expected=lambda i, _: {"injected": commanded[i]})
    assert sentence == f"sample 1: {FAULTS[off]} is injected, but the plan does not command it"


# --- growing, recovering, refusing ------------------------------------------------------------------------


def test_append_keeps_earlier_bits_also_in_the_shard_it_shares(whole: st.Store) -> None:
    old = [whole.read_sample(i) for i in range(10)]
    store = st.append_samples(whole, 5, {"blocks": [10, 5]})
    assert (store.samples, store.shards) == (15, 4)
    assert store.attributes["blocks"] == [10, 5]
    assert st.problem_samples(store) == [10, 11, 12, 13, 14]
    st.write_samples(store, [fake_sample(store.spec, i) for i in range(10, 15)])
    assert st.verify(store) == []
    for sample in old:
        again = store.read_sample(sample.index)
        for name, array in sample.layers.items():
            assert again.layers[name].tobytes() == array.tobytes()
        for name, value in sample.scalars.items():
            np.testing.assert_array_equal(again.scalars[name], value)
    np.testing.assert_array_equal(store.array("sample")[:], np.arange(15))


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
        with warnings.catch_warnings(record=True) as told:
            warnings.simplefilter("always")
            assert st.open_store(whole.path).samples == samples
            assert st.verify(whole.path)[0].startswith(sentence)
        assert bool(told) is (samples == 14)
        store = st.recover(whole.path)
        assert st.problem_samples(store) == list(range(10, samples))


def test_recover_removes_leftovers_of_a_killed_process(whole: st.Store) -> None:
    before = st.digest(whole)
    leftovers = [
        whole.path / "image/c/0/0/0/0.1f.partial",
        whole.path / "done/c/0.2f.partial",
        whole.path / "zarr.3f.partial",
    ]
    for file in leftovers:
        file.write_bytes(b"half")
    st.recover(whole.path)
    assert not any(f.exists() for f in leftovers)
    assert st.digest(whole.path) == before


def test_digest_ignores_time_and_layout_and_nothing_else(template: Path, tmp_path: Path) -> None:
    want = st.digest(template)
    attributes = make_spec().attributes
    other = filled(tmp_path / "a.zarr", shard_samples=3, attributes={**attributes, "created": "2031-01-01"})
    assert st.digest(other) == want
    assert st.digest(filled(tmp_path / "b.zarr", attributes={**attributes, "seed": 8})) != want
    sample = fake_sample(other.spec, 4)
    sample.layers["normal"][0, 0, 0] = 1  # type: ignore[index]
    st.write_samples(other, [sample])
    assert st.digest(other) != want


def test_create_leaves_foreign_folders_alone(whole: st.Store, tmp_path: Path) -> None:
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
    assert sorted(p.name for p in tmp_path.iterdir()) == ["empty", "photos", "s.zarr"]
    with pytest.raises(InputError, match="must be at least 1"):
        st.create(tmp_path / "none", make_spec(), 0)


def test_paths_that_hold_no_store_are_one_sentence(tmp_path: Path, whole: st.Store) -> None:
    with pytest.raises(InputError, match="no such store"):
        st.open_store(tmp_path / "nowhere")
    (tmp_path / "file").write_text("x")
    with pytest.raises(InputError, match="is no vbnfault store"):
        st.open_store(tmp_path / "file")
    zarr.open_group(tmp_path / "other.zarr", mode="w", zarr_format=3)
    with pytest.raises(InputError, match="is no vbnfault store"):
        st.verify(tmp_path / "other.zarr")
    with pytest.raises(InputError, match=r"nothing can be created here: .*file is a file, not a folder"):
        st.create(tmp_path / "file" / "s.zarr", make_spec(), 3)


@pytest.mark.parametrize(
    ("version", "sentence"),
    [
        (st.FORMAT_VERSION + 1, f"reads {st.FORMAT_VERSION}; install a newer one$"),
        (
            1,
            "of vbnfault 0.1: .*earlier.*; open it with xarray, complete it with vbnfault 0.1, or",
        ),
        (0, "is no vbnfault store"),
        ("2", "is no vbnfault store"),
        (True, "is no vbnfault store"),
        (None, "is no vbnfault store"),
    ],
)
def test_a_store_of_another_format_is_refused_and_left_as_it_is(
    whole: st.Store, version: object, sentence: str
) -> None:
    whole.update_attributes({"format_version": version})
    before = {p: p.read_bytes() for p in whole.path.rglob("*") if p.is_file()}
    for use in (st.open_store, st.verify, st.digest, st.recover, lambda path: st.append_samples(path, 2)):
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


# --- arrays, coordinates and attributes -------------------------------------------------------------------


def test_a_store_without_fault_classes_works(tmp_path: Path) -> None:
    changes: dict = {"faults": (), "mask_any_faults": (), "layers": ("mask_effect", "depth_m")}
    store = filled(tmp_path / "s.zarr", **changes)
    assert store.array("mask").shape == (10, 0, 24, 32)
    assert not (store.path / "mask/c").exists()
    assert st.verify(store) == []
    assert st.problem_samples(store) == []
    assert store.read_sample(4).layers["mask"].shape == (0, 24, 32)
    assert st.digest(store) == st.digest(filled(tmp_path / "t.zarr", **changes, shard_samples=3))
    flip(store.file("image", 1), 20)
    assert st.problem_samples(store) == [4]
    store = st.append_samples(store, 3)
    st.write_samples(store, [fake_sample(store.spec, i) for i in (4, 10, 11, 12)])
    assert st.verify(store) == []
    xarray = pytest.importorskip("xarray")
    with xarray.open_zarr(store.path) as data:
        assert data["mask"].load().shape == (13, 0, 24, 32)
        assert data["fault"].shape == (0,)


def test_wrong_coordinates_and_attributes_are_found_and_mended(whole: st.Store) -> None:
    before = st.digest(whole)
    for name, position, value in (
        ("fault", 1, "smear"),
        ("channel", 0, "I"),
        ("wavelength_nm", 2, 700.0),
        ("x", 3, 0.0),
        ("layer", 0, "raw"),
        ("sample", 5, 6),
    ):
        good = whole.array(name)[:]
        whole.array(name)[position] = value
        (sentence,) = st.verify(whole.path)
        assert sentence.startswith(f"array {name}: its value {position} is {value}, not ")
        st.recover(whole.path)
        assert st.verify(whole.path) == []
        np.testing.assert_array_equal(st.open_store(whole.path).array(name)[:], good)
    for name, key, wrong in (
        ("mask_any", "faults", ["vignetting"]),
        ("stratum", "flag_meanings", "a b"),
        ("site", "names", []),
        ("depth_m", "units", "km"),
    ):
        whole.array(name).update_attributes({key: wrong})
        (sentence,) = st.verify(whole.path)
        assert sentence.startswith(f"array {name}: its attribute {key} = {wrong}, not ")
        st.recover(whole.path)
    file = whole.path / "mask/zarr.json"
    meta = json.loads(file.read_text())
    file.write_text(json.dumps({**meta, "dimension_names": ["sample", "fault", "x", "y"]}))
    (sentence,) = st.verify(whole.path)
    assert sentence.startswith("array mask: its dimension_names = ")
    assert st.problem_samples(st.recover(whole.path)) == []
    assert st.verify(whole.path) == []
    assert st.digest(whole.path) == before


@pytest.mark.parametrize("damage", ["changed", "absent entry", "foreign entry", "absent", "nonsense"])
def test_consolidated_metadata_that_differ_are_found_and_mended(whole: st.Store, damage: str) -> None:
    """xarray and zarr look there first, and would show what the arrays' own metadata do not say."""
    before, file = st.digest(whole), whole.path / "zarr.json"
    good = file.read_text()
    root = json.loads(good)
    entries = root["consolidated_metadata"]["metadata"]
    if damage == "changed":
        entries["depth_m"]["attributes"]["units"] = "km"
        said = "array depth_m: the consolidated metadata in zarr.json differ from depth_m/zarr.json"
    elif damage == "absent entry":
        del entries["mask"]
        said = "array mask: the consolidated metadata in zarr.json differ from mask/zarr.json"
    elif damage == "foreign entry":
        entries["smear"] = entries["mask"]
        said = "array smear: the consolidated metadata in zarr.json differ from smear/zarr.json"
    else:
        root["consolidated_metadata"] = None if damage == "absent" else {"metadata": [3]}
        said = "zarr.json holds no consolidated metadata"
    file.write_text(json.dumps(root))
    assert st.verify(whole.path) == [said]
    assert st.problem_samples(whole.path) == []
    st.recover(whole.path)
    assert json.loads(file.read_text()) == json.loads(good)
    assert st.verify(whole.path) == []
    assert st.digest(whole.path) == before


@pytest.mark.parametrize("name", ["mask", "done", "parameters", "sample", "fault", "wavelength_nm"])
def test_a_missing_array_is_one_sentence_and_made_again(whole: st.Store, name: str) -> None:
    before = st.digest(whole)
    for damage in ("folder", "zarr.json", "unparsable"):
        file = whole.path / name / "zarr.json"
        if damage == "folder":
            shutil.rmtree(file.parent)
        elif damage == "zarr.json":
            file.unlink()
        else:
            file.write_text("{")
        what = "cannot be opened" if damage == "unparsable" else "is missing"
        (sentence,) = st.verify(whole.path)
        assert sentence.startswith(f"array {name} {what}")
        with pytest.raises(VbnfaultError, match=f"array {name} {what}"):
            st.open_store(whole.path).array(name)
        store = st.recover(whole.path)
        lost = damage == "folder" and name in store.spec.arrays
        repaired(store, list(range(10)) if lost else [], before)
