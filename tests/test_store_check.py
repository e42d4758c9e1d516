"""The check of a store: damage of every kind, contradictory labels and wrong metadata are found and mended."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import zarr
from synthetic import FAULTS, fake_sample, filled, flip, repaired

from vbnfault import store as st
from vbnfault.core.errors import InputError, VbnfaultError
from vbnfault.core.quantities import Sample
from vbnfault.store import codec
from vbnfault.store.attributes import check_attributes

# --- damage ---------------------------------------------------------------------------------------------------


Damage = Callable[[st.Store], object]


def rejoined(name: str, number: int, index: int, of: int | None) -> Damage:
    """The chunk of one sample in the place of another one's, or none in its place."""

    def damage(store: st.Store) -> None:
        chunks = store.chunk(name, number)
        chunk, first = chunks.pop(index), 4 * number
        if of is not None:
            assert chunks[of] != chunk
            chunks[index] = chunks[of]
        store.file(name, number).write_bytes(codec.join_shard({i - first: c for i, c in chunks.items()}, 4))

    return damage


def missing(name: str) -> Damage:
    return lambda store: store.file(name, 1).unlink()


def truncated(keep: int) -> Damage:
    def damage(store: st.Store) -> None:
        file = store.file("without_straylight", 2)
        file.write_bytes(file.read_bytes()[:keep])

    return damage


def flipped(name: str, number: int) -> Damage:
    return lambda store: flip(store.file(name, number), store.file(name, number).stat().st_size // 2)


@pytest.mark.parametrize(
    ("damage", "sentence", "concerned"),
    [
        (
            lambda store: flip(store.file("image", 1), 20),
            "sample 4: image cannot be decoded, its chunk in image/c/1/0/0/0",
            [4],
        ),
        # sound in itself, but of another sample
        (rejoined("raw", 0, 1, of=2), "sample 1: raw in raw/c/0/0/0 does not match its stored crc32c", [1]),
        # it reads as zeros
        (rejoined("mask", 1, 6, of=None), "sample 6: mask has no chunk in mask/c/1/0/0/0", [6]),
        (
            lambda store: zarr.open_array(store.path / "exposure_s", mode="r+").set_basic_selection(5, 2.0),
            "sample 5: its scalars do not match their crc32c",
            [5],
        ),
        *(
            (missing(name), f"{name} of samples 4-7: .*{name}/c/1", [4, 5, 6, 7])
            for name in ("clean", "tries", "parameters", "crc32c", "done")
        ),
        *(
            (
                truncated(keep),
                "without_straylight of samples 8-9: the shard file without_straylight/c/2/0/0/0",
                [8, 9],
            )
            for keep in (0, 40, -1, -70)
        ),
        *(
            (flipped(name, number), f"({name}|samples).*{name}", concerned)
            for name in ("sun_direction_T", "parameters", "crc32c", "done")
            for number, concerned in ((0, [0, 1, 2, 3]), (2, [8, 9]))
        ),
    ],
)
def test_damage_is_found_and_mended(whole: st.Store, damage: Damage, sentence: str, concerned: list[int]) -> None:
    before = st.digest(whole)
    damage(whole)
    assert any(re.match(sentence, problem) for problem in st.examine(whole).problems)
    repaired(whole, concerned, before)


def test_every_flipped_byte_of_a_shard_is_found(whole: st.Store) -> None:
    file = whole.file("mask", 2)
    good = file.read_bytes()
    for position in range(0, len(good), 7):
        flip(file, position)
        assert st.examine_shard(whole, 2).problems, position
        file.write_bytes(good)
    assert st.examine_shard(whole, 2).problems == []


@pytest.mark.parametrize("name", ["image", "mask", "tries", "exposure_s", "parameters"])
def test_a_missing_file_is_not_read_as_zeros(whole: st.Store, name: str) -> None:
    whole.file(name, 1).unlink()
    file = re.escape(whole.file_name(name, 1))
    with pytest.raises(VbnfaultError, match=rf"{name} of samples 5-6 cannot be read: the file {file} is missing"):
        whole.read(name, 5, 7)
    whole.read(name, 0, 4)
    whole.file("done", 1).unlink()  # now the samples are as if they had never been built
    whole.read(name, 5, 7)


# --- labels -------------------------------------------------------------------------------------------------


def relabelled(whole: st.Store, index: int, **changes: object) -> list[str]:
    """Problems after a sample was written again, whole, with other labels."""
    sample = fake_sample(whole.spec, index)
    for name, value in changes.items():
        (sample.scalars if name in st.SCALARS else sample.layers)[name] = value  # type: ignore[index]
    st.write_samples(whole, [sample])
    return st.examine(whole).problems


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
    decoded: list[str] = []
    real = st.Store.decoded
    monkeypatch.setattr(
        st.Store, "decoded", lambda store, name, chunk: (decoded.append(name), real(store, name, chunk))[1]
    )
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
    assert report.counts.missing_text() == f"planned, but without effect and not injected: {FAULTS[off]} 1"
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
    (sentence,) = st.examine(whole, expected=lambda i, _: {"injected": commanded[i]}, exact=True).problems
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

    assert st.examine(whole, expected=plan).problems == []
    (sentence,) = st.examine(whole, expected=lambda i, _: plan(i) | ({"site": 2} if i == 3 else {})).problems
    assert sentence == "sample 3: site = 1 is not as planned (2)"
    (sentence,) = st.examine(whole, expected=lambda i, _: plan(i) | ({"proposal": "{}"} if i == 3 else {})).problems
    assert sentence.startswith('sample 3: proposal = {"sun_elevation_deg": 0.3} is not as planned')


def test_a_fault_that_was_not_commanded_is_found(whole: st.Store) -> None:
    """The sample is labelled soundly in itself, its checksums are right: the plan alone says that it is wrong."""
    commanded = {i: fake_sample(whole.spec, i).scalars["injected"] for i in range(10)}
    commanded[4] = np.ones(4, bool)  # what had no effect is not injected, and that is no problem
    assert st.examine(whole, expected=lambda i, _: {"injected": commanded[i]}).problems == []
    sample = fake_sample(whole.spec, 1)
    off = int(np.flatnonzero(~commanded[1])[0])
    injected, mask = commanded[1].copy(), sample.layers["mask"].copy()
    injected[off] = mask[off, 3, 3] = True
    changes = {"injected": injected, "mask": mask, "mask_effect": mask, "mask_any": mask[:3].any(0)}
    parameters = {**sample.scalars["parameters"], FAULTS[off]: {"amplitude": 0.1}}
    assert relabelled(whole, 1, **changes, parameters=parameters) == []
    (sentence,) = st.examine(whole, expected=lambda i, _: {"injected": commanded[i]}).problems
    assert sentence == f"sample 1: {FAULTS[off]} is injected, but the plan does not command it"


def test_a_joint_mask_any_may_hold_more_than_the_masks_but_not_less(tmp_path: Path) -> None:
    store = filled(tmp_path / "s.zarr", mask_any_joint=True)
    assert st.examine(store).problems == []
    index = next(i for i in range(store.samples) if fake_sample(store.spec, i).layers["mask"][:3].any())
    union = fake_sample(store.spec, index).layers["mask"][:3].any(0)
    more, less = union.copy(), union & False
    more[0] = True
    assert relabelled(store, index, mask_any=more) == []
    (sentence,) = relabelled(store, index, mask_any=less)
    assert sentence.startswith(f"sample {index}: mask_any does not hold the masks of ")
    # as it is read again, also by its description; a store of version 0.2 has the union alone
    assert st.open_store(store.path).spec.mask_any_joint
    assert "together" in str(zarr.open_array(store.path / "mask_any").attrs["rule"])


# --- coordinates, attributes and metadata -------------------------------------------------------------------


def test_wrong_coordinates_and_attributes_are_found_and_mended(whole: st.Store) -> None:
    before = st.digest(whole)
    for name, position, value in (
        ("fault", 1, "smear"),
        ("x", 3, 0.0),
        ("sample", 5, 6),
    ):
        good = zarr.open_array(whole.path / name, mode="r+")[:]
        zarr.open_array(whole.path / name, mode="r+")[position] = value
        (sentence,) = st.examine(whole.path).problems
        assert sentence.startswith(f"array {name}: its value {position} is {value}, not ")
        st.recover(whole.path)
        assert st.examine(whole.path).problems == []
        np.testing.assert_array_equal(zarr.open_array(whole.path / name, mode="r")[:], good)
    for name, key, wrong in (("mask_any", "faults", ["vignetting"]), ("depth_m", "units", "km")):
        zarr.open_array(whole.path / name, mode="r+").update_attributes({key: wrong})
        (sentence,) = st.examine(whole.path).problems
        assert sentence.startswith(f"array {name}: its attribute {key} = {wrong}, not ")
        st.recover(whole.path)
    assert st.problem_samples(whole.path) == []
    assert st.examine(whole.path).problems == []
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
    assert st.examine(whole.path).problems == [said]
    assert st.problem_samples(whole.path) == []
    st.recover(whole.path)
    assert json.loads(file.read_text()) == json.loads(good)
    assert st.examine(whole.path).problems == []
    assert st.digest(whole.path) == before


@pytest.mark.parametrize("where", ["array key", "attribute", "foreign entry", "root key"])
def test_long_names_in_metadata_are_cut_in_the_sentence(whole: st.Store, where: str) -> None:
    """A damaged name may be as long as the file; a sentence of many screens cannot be read."""
    name = "[" * 5000
    file = whole.path / ("depth_m/zarr.json" if where in ("array key", "attribute") else "zarr.json")
    document = json.loads(file.read_text())
    if where == "attribute":
        document["attributes"][name] = 1
    elif where == "foreign entry":
        document["consolidated_metadata"]["metadata"][name] = {}
    else:
        document[name] = 1
    file.write_text(json.dumps(document))
    (sentence,) = st.examine(whole.path).problems
    assert "[[[" in sentence
    assert len(sentence) < 400


def test_long_names_in_root_attributes_are_cut_in_the_sentence() -> None:
    with pytest.raises(InputError, match=r"scene\.faults\.x+") as raised:
        check_attributes({"scene": {"faults": {"x" * 5000: 3}}})
    assert len(str(raised.value)) < 400


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
        (sentence,) = st.examine(whole.path).problems
        assert sentence.startswith(f"array {name} {what}")
        store = st.recover(whole.path)
        lost = damage == "folder" and name in store.spec.arrays
        repaired(store, list(range(10)) if lost else [], before)


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
    assert st.examine(whole).problems == [before_sentence]


def test_a_missing_chunk_is_found_although_it_reads_as_zeros(whole: st.Store) -> None:
    before = st.digest(whole)
    chunks = whole.chunk("mask", 1)
    del chunks[6]
    whole.file("mask", 1).write_bytes(codec.join_shard({i - 4: c for i, c in chunks.items()}, 4))
    assert not whole.read("mask", 6, 7).any()
    assert st.examine(whole).problems == ["sample 6: mask has no chunk in mask/c/1/0/0/0"]
    repaired(whole, [6], before)
