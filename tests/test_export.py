"""Exports: what other tools read equals the store, and an interrupted export ends as one that was not."""

from __future__ import annotations

import errno
import hashlib
import importlib
import json
import os
import shutil
import tarfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pyarrow.parquet
import pytest
from sequences_kit import sequences
from synthetic import fake_sample, filled, make_spec
from typer.testing import CliRunner

from vbnfault import cli
from vbnfault import store as st
from vbnfault.core import registry
from vbnfault.core.errors import InputError, VbnfaultError
from vbnfault.output.export import Entry, Format, export_store, formats
from vbnfault.output.export.folder import Folder
from vbnfault.output.export.formats import coco, yolo
from vbnfault.output.export.regions import coco_text, flare_discs, instances, polygon, regions, whole

NAMES = ("coco", "exr", "huggingface", "png", "webdataset", "yolo")
SAMPLES = 6


def reader(name: str) -> Any:
    """Return a package of the extra `readers`; skip where it is not installed."""
    return pytest.importorskip(name, reason=f"{name} is in the extra `readers`: pip install '.[readers]'")


def tree(folder: Path) -> dict[str, str]:
    """Return the digest of each file below a folder by name."""
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    return {str(p.relative_to(folder)): hashlib.sha256(p.read_bytes()).hexdigest() for p in files}


@pytest.fixture(scope="module")
def exported(described_store: Path, tmp_path_factory: pytest.TempPathFactory) -> Any:
    """Return what exports the store in a format, once, and returns the folder."""
    made: dict[str, Path] = {}

    def export(name: str) -> Path:
        if name not in made:
            made[name] = tmp_path_factory.mktemp("export") / name
            export_store(described_store, made[name], name, progress=False)
        return made[name]

    return export


@pytest.fixture(scope="module")
def data(described_store: Path) -> Any:
    """Return the store that is exported."""
    return st.open_store(described_store)


def split_of(data: st.Store) -> list[str]:
    return [str(s) for s in data.read("split")]


# --- every format -------------------------------------------------------------------------------------------


def test_the_formats_are_these() -> None:
    assert tuple(formats()) == tuple(sorted([*NAMES, "video"]))  # films need sequences: tests/test_export_video.py


@pytest.mark.parametrize("name", NAMES)
def test_an_export_is_the_same_with_any_number_of_threads(
    name: str, exported: Any, described_store: Path, tmp_path: Path
) -> None:
    summary = export_store(described_store, tmp_path / "again", name, workers=3, progress=False)
    assert summary.written == summary.samples == SAMPLES
    assert tree(tmp_path / "again") == tree(exported(name))
    assert not [path for path in exported(name).rglob("*") if path.name.startswith(".") or ".partial" in path.name]
    again = export_store(described_store, exported(name), name, progress=False)
    assert again.written == 0  # it is complete


@pytest.mark.parametrize("name", NAMES)
def test_the_table_of_samples_has_splits_faults_and_parameters(name: str, exported: Any, data: st.Store) -> None:
    lines = (exported(name) / "samples.jsonl").read_text().splitlines()
    rows = {row["sample"]: row for row in map(json.loads, lines)}
    assert sorted(rows) == list(range(SAMPLES))
    injected, splits = data.read("injected").astype(bool), split_of(data)
    for i, row in rows.items():
        assert row["split"] == splits[i]
        assert row["injected"] == [f for f, on in zip(data.spec.faults, injected[i], strict=True) if on]
        assert row["parameters"] == json.loads(str(data.read("parameters", i, i + 1)[0]))
        assert (exported(name) / row["file"]).is_file()
        assert row["sun_xy_px"] == [None, None]  # NaN is no JSON


@pytest.mark.parametrize("name", NAMES)
def test_the_card_says_what_a_user_must_know(name: str, exported: Any, data: st.Store) -> None:
    card = (exported(name) / "README.md").read_text()
    attributes = data.attributes
    for text in ("CC0-1.0", "A test", "Gallon", attributes["versions"]["zarr"], attributes["scene_hash"]):
        assert text in card
    assert "| patch.facet_m | 12.0 | set |" in card
    assert "| camera.fov_deg | 65.0 | default |" in card
    assert "| faults.dust_on_optics.count | [30, 100] | default |" in card
    rows = [line for line in card.splitlines() if line.startswith("| ")]
    classes = [row.split(" | ")[1] for row in rows if row[2].isdecimal()]
    assert classes == list(data.spec.faults)


@pytest.mark.filterwarnings("ignore:The inplace keyword:DeprecationWarning")  # mlcroissant and pandas
@pytest.mark.parametrize("name", NAMES)
def test_mlcroissant_accepts_the_description_and_reads_the_samples(
    name: str, exported: Any, data: st.Store, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    croissant = reader("mlcroissant")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    described = croissant.Dataset(str(exported(name) / "croissant.json"))
    assert described.metadata.issues.errors == set()
    rows = list(described.records("samples"))
    splits = split_of(data)
    assert {r["samples/sample"]: r["samples/split"].decode() for r in rows} == dict(enumerate(splits))
    if name not in ("exr", "webdataset"):  # which a reader of Croissant cannot open
        images = {r["images/sample"]: np.asarray(r["images/image"]) for r in described.records("images")}
        assert images.keys() == set(range(data.samples))
        for k, image in images.items():
            assert np.array_equal(image, data.read_sample(k, ["image"]).layers["image"][..., :3])
    faults = [row["fault_classes/name"] for row in described.records("fault_classes")]
    assert faults == list(data.spec.faults)


# --- each format in the tool that it is for -------------------------------------------------------------------


def test_png_files_hold_the_stored_numbers(exported: Any, data: st.Store) -> None:
    folder, splits = exported("png"), split_of(data)
    for i in range(data.samples):
        sample = data.read_sample(i)
        at = folder / splits[i]

        def image(name: str, at: Path = at, i: int = i) -> np.ndarray:
            return cv2.imread(str(at / name / f"{i:06d}.png"), cv2.IMREAD_UNCHANGED)

        assert np.array_equal(image("image")[..., ::-1], sample.layers["image"][..., :3])
        assert np.array_equal(image("image_intensity"), sample.layers["image"][..., 3])
        assert np.array_equal(image("semantic"), sample.layers["semantic"])
        for k, fault in enumerate(data.spec.faults):
            assert np.array_equal(image(f"mask/{fault}") == 255, sample.layers["mask"][k])


def test_png_of_the_raw_mosaic_has_16_bits(finished_store: Path, tmp_path: Path) -> None:
    store = st.open_store(finished_store)
    export_store(store, tmp_path / "png", "png", progress=False)
    raw = cv2.imread(str(tmp_path / "png/train/raw/000000.png"), cv2.IMREAD_UNCHANGED)
    assert raw.dtype == np.uint16
    assert np.array_equal(raw, store.read_sample(0).layers["raw"])


def test_png_of_the_defects_has_their_bits(tmp_path: Path) -> None:
    spec, bits = make_spec(8, layers=("defects",)), np.arange(8 * 16, dtype=np.uint8).reshape(8, 16) % 64
    data, sample = st.create(tmp_path / "s.zarr", spec, 1), fake_sample(spec, 0)
    st.write_samples(data, [replace(sample, layers={**sample.layers, "defects": bits})])
    export_store(data, tmp_path / "e", "png", progress=False)
    found = cv2.imread(str(tmp_path / "e" / "train" / "defects" / "000000.png"), cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(found, bits)


def test_pycocotools_reads_instances_that_make_up_the_masks(exported: Any, data: st.Store) -> None:
    tool, masks = reader("pycocotools.coco"), reader("pycocotools.mask")
    splits, instances = split_of(data), 0
    for split in ("train", "val", "test"):
        loaded = tool.COCO(str(exported("coco") / f"annotations/instances_{split}.json"))
        assert loaded.getImgIds() == [i for i, s in enumerate(splits) if s == split]
        assert [c["name"] for c in loaded.loadCats(loaded.getCatIds())] == list(data.spec.faults)
        for i in loaded.getImgIds():
            assert (exported("coco") / "images" / split / loaded.imgs[i]["file_name"]).is_file()
            union = np.zeros((len(data.spec.faults), data.spec.height, data.spec.width), int)
            for note in loaded.loadAnns(loaded.getAnnIds(imgIds=[i])):
                pixels = loaded.annToMask(note)
                union[note["category_id"] - 1] += pixels
                assert note["area"] == pixels.sum() == masks.area(loaded.annToRLE(note))
                assert note["bbox"] == masks.toBbox(loaded.annToRLE(note)).tolist()
                assert note["iscrowd"] == 0
                local = data.spec.faults[note["category_id"] - 1] in (data.spec.localised_faults or ())
                assert cv2.connectedComponents(pixels, connectivity=8)[0] == 2 or not local
                instances += 1
            # every pixel of a mask is in one instance
            assert np.array_equal(union, data.read_sample(i).layers["mask"])
    assert instances > 50


def test_a_mask_in_many_pieces_becomes_one_crowd(
    data: st.Store, described_store: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(coco, "MOST_INSTANCES", 3)
    summary = export_store(described_store, tmp_path / "coco", "coco", progress=False)
    assert any("more than 3 pieces" in line and "iscrowd 1" in line for line in summary.lines())
    notes = [
        (note["image_id"], note)
        for split in ("train", "val", "test")
        for note in json.loads((tmp_path / f"coco/annotations/instances_{split}.json").read_text())["annotations"]
    ]
    crowds = [(i, note) for i, note in notes if note["iscrowd"]]
    assert crowds
    for i, note in crowds:
        same = [n for j, n in notes if (j, n["category_id"]) == (i, note["category_id"])]
        mask = data.read_sample(i).layers["mask"][note["category_id"] - 1]
        assert len(same) == 1
        assert note["area"] == mask.sum()


def test_run_lengths_are_those_of_pycocotools() -> None:
    masks = reader("pycocotools.mask")
    rng = np.random.default_rng(5)
    tried = [np.ones((7, 5), bool), np.eye(9, dtype=bool), np.arange(300 * 200).reshape(300, 200) % 37 < 2]
    tried += [rng.random((13, 17)) < p for p in (0.02, 0.3, 0.9)]
    for mask in [*tried, np.arange(12).reshape(3, 4) < 1, np.arange(12).reshape(3, 4) > 10]:
        wanted = masks.encode(np.asfortranarray(mask.astype(np.uint8)))["counts"].decode()
        assert coco_text(whole(mask).counts) == wanted
        found = regions(mask)
        assert sum(region.area for region in found) == mask.sum()
        for region in found:
            only = np.zeros(mask.shape, np.uint8, order="F")
            x, y, w, h = region.box
            only[y : y + h, x : x + w] = region.inside
            assert coco_text(region.counts) == masks.encode(only)["counts"].decode()


def test_yolo_outlines_and_boxes_give_the_regions_back(exported: Any, data: st.Store) -> None:
    folder, splits = exported("yolo"), split_of(data)
    text = (folder / "data.yaml").read_text()
    assert [line.strip() for line in text.partition("names:\n")[2].splitlines()] == [
        f"{k}: {name}" for k, name in enumerate(data.spec.faults)
    ]
    assert all(f"{split}: images/{split}" in text for split in ("train", "val", "test"))
    size = np.array([data.spec.width, data.spec.height])
    lines = 0
    for i, split in enumerate(splits):
        mask = data.read_sample(i).layers["mask"]
        outlines = (folder / f"labels/{split}/{i:06d}.txt").read_text().splitlines()
        boxes = (folder / f"boxes/{split}/{i:06d}.txt").read_text().splitlines()
        assert (folder / f"images/{split}/{i:06d}.png").is_file()
        drawn = np.zeros(mask.shape, np.uint8)
        for outline, box in zip(outlines, boxes, strict=True):
            k, *numbers = (float(v) for v in outline.split())
            assert len(numbers) >= 6  # at least three vertices
            assert all(0 <= v <= 1 for v in numbers)
            one = np.zeros(mask.shape[1:], np.uint8)
            points = np.reshape(numbers, (-1, 2)) * size
            # Ultralytics' polygon2mask
            cv2.fillPoly(one, [points.astype(np.int32)], 1)
            drawn[int(k)] |= one
            same, cx, cy, w, h = (float(v) for v in box.split())
            rows, columns = np.flatnonzero(one.any(1)), np.flatnonzero(one.any(0))
            wanted = [columns[0], rows[0], np.ptp(columns) + 1, np.ptp(rows) + 1]
            edges = np.array([cx - w / 2, cy - h / 2, w, h]) * np.tile(size, 2)
            assert same == k
            assert edges == pytest.approx(wanted, abs=1e-3)  # of a pixel: six digits of a fraction
            lines += 1
        for k, fault in enumerate(data.spec.faults):
            is_localised = fault in (data.spec.localised_faults or ())
            assert np.array_equal(drawn[k], mask[k] if is_localised else np.zeros_like(mask[k]))
    assert lines > 50


@pytest.mark.parametrize(
    ("pixels", "is_line"),
    [
        ([(2, 3)], True),
        ([(2, 3), (2, 4)], True),
        ([(2, 3), (3, 3), (4, 3)], True),
        ([(2, 3), (3, 4)], False),
        ([(4, 2), (3, 3), (2, 4)], False),
    ],
)
def test_an_outline_of_the_smallest_regions_covers_them_exactly(
    pixels: list[tuple[int, int]], is_line: bool
) -> None:
    mask = np.zeros((8, 9), bool)
    mask[tuple(np.transpose(pixels))] = True
    (region,) = regions(mask)
    drawn = np.zeros(mask.shape, np.uint8)
    cv2.fillPoly(drawn, [polygon(region).astype(np.int32)], 1)
    assert len(polygon(region)) >= 3
    assert np.array_equal(drawn == 1, mask)
    if is_line:  # upright or level: the corners of its box
        x, y, w, h = region.box
        corners = [(x, y), (x + w, y), (x + w, y + h), (x, y + h)]
        np.testing.assert_allclose(polygon(region), corners, atol=2e-3)


@pytest.mark.parametrize("size", [(141, 193), (1024, 1024), (3000, 4096)])
def test_outlines_read_back_as_float32_cover_pixels_and_lines_exactly(size: tuple[int, int]) -> None:
    """Six digits put the corner at 66 of 1024 px on 65.99987, so that a line was two rows wide."""
    spec = st.StoreSpec(height=size[0], width=size[1], faults=(), mask_any_faults=())
    for rows, columns in ((66, slice(0, 141)), (slice(0, 141), 66), (140, 140), (1, 192)):
        mask = np.zeros(size, bool)
        mask[rows, columns] = True
        (region,) = regions(mask)
        numbers = np.array(yolo._outline_line(0, region, spec).split()[1:], np.float32)
        drawn = np.zeros(size, np.uint8)
        cv2.fillPoly(drawn, [(numbers.reshape(-1, 2) * size[::-1]).astype(np.int32)], 1)
        assert np.array_equal(drawn == 1, mask)


def test_one_outline_covers_pieces_and_leaves_holes_out() -> None:
    mask = np.zeros((40, 60), bool)
    mask[[3, 30]] = mask[:, [5, 50]] = True  # a grid of dead lines, which encloses most of the image
    mask[10:20, 20:30] = True  # another piece
    mask[15, 25] = False  # a hole in it
    drawn = np.zeros(mask.shape, np.uint8)
    cv2.fillPoly(drawn, [polygon(whole(mask)).astype(np.int32)], 1)
    bridge = (drawn == 1) & ~mask
    assert (drawn[mask] == 1).all()
    assert bridge.sum() <= 14  # a line between the nearest vertices, (6, 3) and (20, 10)
    assert not bridge[15, 25]


def test_regions_come_in_the_order_of_their_first_pixel_down_the_columns() -> None:
    mask = np.zeros((5, 7), bool)
    mask[0, 5] = mask[3, 1] = True
    assert [region.box for region in regions(mask)] == [(1, 3, 1, 1), (5, 0, 1, 1)]


def test_a_flare_in_pieces_is_one_instance() -> None:
    """Two flares at 0.5 and 2 of the way from the Sun through the centre, a glare on the Sun; all in crumbs."""
    sun, shape = np.array([20.0, 50.0]), (100, 200)
    params = {
        "flares": [{"position": 0.5, "radius": 0.06}, {"position": 2.0, "radius": 0.1}],
        "glare": {"radius": 0.05},
    }
    discs = flare_discs(params, sun, shape)
    assert discs.tolist() == [[60, 50, 12], [180, 50, 20], [20, 50, 10]]
    y, x = np.mgrid[:100, :200] + 0.5
    near = [np.hypot(x - cx, y - cy) < r for cx, cy, r in discs]
    crumbs = (np.arange(100)[:, None] + np.arange(200)) % 3 == 0
    found = regions((near[0] | near[1] | near[2]) & crumbs, discs)
    assert len(regions(near[0] & crumbs)) > 10
    assert [region.area for region in found] == [int((near[k] & crumbs).sum()) for k in (2, 0, 1)]
    assert flare_discs(params, np.array([np.nan, np.nan]), shape).shape == (0, 3)
    assert flare_discs({}, sun, shape).shape == (0, 3)


@pytest.mark.parametrize("drawn", [5, {"flares": 3}, {"flares": [{}]}, {"centre_xy_px": "middle"}])
def test_parameters_of_a_stranger_are_named(drawn: Any, data: st.Store) -> None:
    sample, fault = data.read_sample(0), (data.spec.localised_faults or ("",))[0]
    sample.scalars["sun_xy_px"] = np.array([3.0, 4.0])
    sample.scalars["parameters"] = json.dumps({fault: drawn})
    with pytest.raises(InputError, match=f"sample 0: parameters of {fault} list no flares"):
        list(instances(data.spec, sample, 1))


@pytest.mark.parametrize("name", ["coco", "yolo"])
def test_small_instances_are_left_out(name: str, described_store: Path, data: st.Store, tmp_path: Path) -> None:
    export_store(described_store, tmp_path / "e", name, min_area_px=12, progress=False)
    localised = [k for k, f in enumerate(data.spec.faults) if f in (data.spec.localised_faults or ())]
    masks = [data.read_sample(i).layers["mask"] for i in range(data.samples)]
    areas = [region.area for mask in masks for k in localised for region in regions(mask[k])]
    kept = sum(area >= 12 for area in areas)
    assert 0 < kept < len(areas)
    if name == "yolo":
        lines = [path.read_text().splitlines() for path in (tmp_path / "e/labels").rglob("*.txt")]
        assert sum(map(len, lines)) == kept
    else:
        notes = [json.loads(path.read_text()) for path in (tmp_path / "e/annotations").glob("*.json")]
        of_localised = [a for n in notes for a in n["annotations"] if a["category_id"] - 1 in localised]
        assert sum(not a["iscrowd"] for a in of_localised) == kept
    with pytest.raises(InputError, match="holds another export: min_area_px is 12 there and 1 now"):
        export_store(described_store, tmp_path / "e", name, progress=False)


def test_the_command_passes_masks_and_least_area_on(described_store: Path, tmp_path: Path) -> None:
    arguments = ["export", str(described_store), "--out", str(tmp_path / "e"), "--min-area", "4"]
    refused = CliRunner().invoke(cli.app, [*arguments, "--format", "png"])
    sentence = "--min-area 4: must be a whole number from 1; png has no instances, so it must be 1"
    assert sentence in str(refused.exception)
    assert CliRunner().invoke(cli.app, [*arguments, "--format", "yolo", "--masks", "effect"]).exit_code == 0
    state = json.loads((tmp_path / "e/export.json").read_text())
    assert (state["masks"], state["min_area_px"]) == ("effect", 4)


@pytest.mark.parametrize(
    ("file", "old", "new"),
    [("a.png", "12", "1"), ("a.png", "12", "13"), (".parts/000000.json", "[1]", "[2]")],  # size, a bit, the record
)
def test_a_part_whose_file_or_record_has_changed_is_not_finished(
    file: str, old: str, new: str, tmp_path: Path
) -> None:
    folder = Folder(tmp_path)
    folder.put([("a.png", b"12")])
    folder.write_part(0, {"rows": [1]})
    assert folder.has_part(0)
    (tmp_path / file).write_text((tmp_path / file).read_text().replace(old, new))
    assert not folder.has_part(0)


def test_a_complete_export_with_a_flipped_bit_is_written_again(described_store: Path, tmp_path: Path) -> None:
    export_store(described_store, tmp_path, "png", progress=False)
    before, image = tree(tmp_path), next(tmp_path.glob("*/image/*.png"))
    lines = [line.split("  ") for line in (tmp_path / "SHA256SUMS").read_text().splitlines()]
    own = ("SHA256SUMS", "export.json")
    assert {name: checksum for checksum, name in lines} == {k: v for k, v in before.items() if k not in own}
    content = bytearray(image.read_bytes())
    content[-20] ^= 1
    image.write_bytes(content)
    assert export_store(described_store, tmp_path, "png", progress=False).written == SAMPLES
    assert tree(tmp_path) == before
    assert export_store(described_store, tmp_path, "png", progress=False).written == 0


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # webdataset leaves files open
def test_webdataset_reads_the_tar_files(exported: Any, data: st.Store) -> None:
    tool = reader("webdataset")
    splits, seen = split_of(data), []
    for split in ("train", "val", "test"):
        urls = sorted(str(path) for path in exported("webdataset").glob(f"{split}-*.tar"))
        for item in tool.WebDataset(urls, shardshuffle=False).decode("rgb8"):
            i = int(item["__key__"])
            sample = data.read_sample(i)
            assert splits[i] == split
            assert np.array_equal(item["image.png"], sample.layers["image"][..., :3])
            assert np.array_equal(item["depth_m.npy"], sample.layers["depth_m"])
            assert item["json"]["injected"] == dict(zip(data.spec.faults, sample.scalars["injected"], strict=True))
            for k, fault in enumerate(data.spec.faults):
                assert np.array_equal(item[f"mask.{fault}.png"][..., 0] == 255, sample.layers["mask"][k])
            seen.append(i)
    assert sorted(seen) == list(range(SAMPLES))


def test_datasets_reads_the_parquet_files_with_their_features(
    exported: Any, data: st.Store, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("HF_DATASETS_OFFLINE", "1")
    tool = reader("datasets")
    tool.disable_progress_bars()
    loaded = tool.load_dataset(str(exported("huggingface")), cache_dir=str(tmp_path))
    assert set(loaded) == {"train", "val", "test"}
    features = loaded["train"].features
    assert isinstance(features["image"], tool.Image)
    assert features["faults"].feature.names == list(data.spec.faults)
    splits, seen = split_of(data), []
    for split, table in loaded.items():
        for row in table:
            i = row["sample"]
            sample = data.read_sample(i)
            assert splits[i] == split
            assert np.array_equal(np.asarray(row["image"]), sample.layers["image"][..., :3])
            for k, fault in enumerate(data.spec.faults):
                assert np.array_equal(np.asarray(row[f"mask_{fault}"]) == 255, sample.layers["mask"][k])
            assert row["faults"] == np.flatnonzero(sample.scalars["injected"]).tolist()
            assert row["camera_from_T"] == sample.scalars["camera_from_T"].tolist()
            seen.append(i)
    assert sorted(seen) == list(range(SAMPLES))


def test_rows_of_samples_have_their_times_and_what_their_distortion_means(tmp_path: Path) -> None:
    data = sequences(tmp_path / "s.zarr", distortion_model="undistorting", skew_px=0.25)
    for name in ("huggingface", "webdataset"):
        export_store(data, tmp_path / name, name, progress=False)
    lines = (tmp_path / "huggingface" / "samples.jsonl").read_text().splitlines()
    rows = {row["sample"]: row for row in map(json.loads, lines)}
    tables = map(pyarrow.parquet.read_table, sorted((tmp_path / "huggingface" / "data").iterdir()))
    of_parquet = {row["sample"]: row for table in tables for row in table.to_pylist()}
    of_tar: dict[int, Any] = {}
    for path in (tmp_path / "webdataset").glob("*.tar"):
        with tarfile.open(path) as tar:
            members = [tar.extractfile(name) for name in tar.getnames() if name.endswith(".json")]
            of_tar |= {row["sample"]: row for row in (json.load(member) for member in members if member)}
    assert rows.keys() == of_parquet.keys() == of_tar.keys() == {*range(data.samples)}
    for k, row in rows.items():
        for key in ("sequence", "frame", "time_s", "julian_date", "distortion", "distortion_model", "skew_px"):
            assert of_parquet[k][key] == of_tar[k][key] == row[key]
        assert row["time_s"] == data.read("time_s", k, k + 1)[0]
        assert (row["distortion_model"], row["skew_px"]) == ("undistorting", 0.25)
    plain = tmp_path / "plain"  # a store without sequences and without a calibration
    export_store(filled(tmp_path / "p.zarr"), plain, "huggingface", progress=False)
    row = json.loads((plain / "samples.jsonl").read_text().splitlines()[0])
    assert (row["distortion_model"], row["skew_px"]) == ("opencv", 0.0)


def test_openexr_reads_radiance_by_wavelength_and_truth(exported: Any, data: st.Store) -> None:
    openexr = importlib.import_module("OpenEXR")
    splits = split_of(data)
    for i in (0, SAMPLES - 1):
        sample = data.read_sample(i)
        with openexr.File(str(exported("exr") / splits[i] / f"{i:06d}.exr"), separate_channels=True) as file:
            channels = {name: channel.pixels for name, channel in file.channels().items()}
        for k, band in enumerate(sample.layers["radiance"]):
            assert np.array_equal(channels[f"radiance.{data.spec.wavelength_nm[k]:.1f}nm"], band)
        for k, name in enumerate("RGBI"):
            dn = np.rint(channels[name].astype(np.float32) * 255)
            assert np.array_equal(dn, sample.layers["image"][..., k])
        assert np.array_equal(channels["depth.Z"], sample.layers["depth_m"])
        assert np.array_equal(channels["normal.Y"], sample.layers["normal"][..., 1])
        assert np.array_equal(channels["mask.straylight"] == 1, sample.layers["mask"][2])


def test_the_render_with_its_guard_band_has_an_openexr_file_of_its_own(tmp_path: Path) -> None:
    openexr = importlib.import_module("OpenEXR")
    spec = make_spec(8, layers=("radiance", "scene_radiance"), rendered_shape=(12, 22))
    data, rendered = st.create(tmp_path / "s.zarr", spec, 1), np.arange(3 * 12 * 22).reshape(3, 12, 22)
    sample = fake_sample(spec, 0)
    st.write_samples(
        data, [replace(sample, layers={**sample.layers, "scene_radiance": rendered.astype(np.float16)})]
    )
    export_store(data, tmp_path / "e", "exr", progress=False)
    for ending, layer, shape in (("", "radiance", (8, 16)), ("_scene_radiance", "scene_radiance", (12, 22))):
        with openexr.File(str(tmp_path / "e" / "train" / f"000000{ending}.exr"), separate_channels=True) as file:
            channels = {name: channel.pixels for name, channel in file.channels().items()}
        for k, wavelength in enumerate(spec.wavelength_nm):
            assert channels[f"radiance.{wavelength:.1f}nm"].shape == shape
            np.testing.assert_array_equal(channels[f"radiance.{wavelength:.1f}nm"], data.read(layer)[0, k])


def test_a_new_format_is_one_class(described_store: Path, tmp_path: Path) -> None:
    with registry.undoing_registrations(always=True):

        class Means(Format):
            name, summary, pattern = "means", "The mean of each image.", "*.txt"

            def layers(self, spec: st.StoreSpec) -> tuple[str, ...]:
                return ("image",)

            def files(self, store: st.Store, part: Any, sample: Any) -> Any:
                file = f"{sample.index}.txt"
                return Entry(sample.index, file), [(file, str(sample.layers["image"].mean()).encode())]

        export_store(described_store, tmp_path / "means", "means", progress=False)
    assert len(list((tmp_path / "means").glob("*.txt"))) == SAMPLES
    assert "means" not in formats()


# --- interruptions and bad input ------------------------------------------------------------------------------


def test_a_full_disk_is_one_sentence_and_loses_nothing(
    described_store: Path, exported: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    left, write = [12], os.write

    def filling(file: int, content: Any) -> int:
        left[0] -= 1
        if left[0] < 0:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return write(file, content)

    out = tmp_path / "out"
    with monkeypatch.context() as patch:
        patch.setattr(os, "write", filling)
        with pytest.raises(
            VbnfaultError, match=r"out: No space left on device while writing the export; .*resumes"
        ):
            export_store(described_store, out, "yolo", progress=False)
    before = tree(out)
    assert len(before) > 5
    assert not [name for name in before if name.endswith(".partial")]
    assert export_store(described_store, out, "yolo", progress=False).samples == SAMPLES
    assert tree(out) == tree(exported("yolo"))


def test_a_finished_part_is_not_written_again_unless_a_file_is_missing(
    described_store: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out"

    class Stopping(formats()["png"]):  # type: ignore[misc]
        name = ""

        def finish(self, finished: Any) -> Any:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("vbnfault.output.export.run.formats", lambda: {"png": Stopping})
        with pytest.raises(VbnfaultError):
            export_store(described_store, out, "png", progress=False)
    stamps = {path: path.stat().st_mtime_ns for path in out.glob("*/image/*.png")}
    lost = sorted(stamps)[0]
    lost.unlink()
    summary = export_store(described_store, out, "png", progress=False)
    assert lost.is_file()
    same = [path for path, stamp in stamps.items() if path.exists() and path.stat().st_mtime_ns == stamp]
    assert 0 < summary.written < summary.samples
    assert len(same) == summary.samples - summary.written


def test_what_a_kill_leaves_of_the_first_file_is_removed(
    described_store: Path, exported: Any, tmp_path: Path
) -> None:
    (tmp_path / f"export.json.{'0' * 32}.partial").write_bytes(b"half")
    assert export_store(described_store, tmp_path, "webdataset", progress=False).written == SAMPLES
    assert tree(tmp_path) == tree(exported("webdataset"))


def test_bad_input_is_one_sentence(described_store: Path, tmp_path: Path) -> None:
    def refused(match: str, out: Path = tmp_path / "new", name: str = "png", **more: Any) -> None:
        before = tree(tmp_path)
        with pytest.raises(InputError, match=match):
            export_store(more.pop("store", described_store), out, name, progress=False, **more)
        assert tree(tmp_path) == before  # nothing is written, nothing lost

    refused(r"^format 'pgn': there is no such format \(did you mean png\?\)", name="pgn")
    refused(r"--workers 0: must be a whole number from 1 to 64", workers=0)
    refused(r"--masks 'soft': must be one of footprint, effect", masks="soft")
    refused("--masks effect: png writes every mask of the store by its name; leave it out", masks="effect")
    plain = filled(tmp_path / "plain.zarr", samples=4, layers=())
    sentence = "--masks effect: .*plain.zarr has no layer mask_effect; add it"
    refused(sentence, name="coco", masks="effect", store=plain.path)
    refused("lies in the store", out=described_store / "png")
    refused("no such store", store=tmp_path / "none.zarr")
    photos = tmp_path / "photos"
    photos.mkdir()
    (photos / "cat.png").write_bytes(b"cat")
    (tmp_path / "downloads").mkdir()
    (tmp_path / "downloads/film.partial").touch()
    refused("downloads: holds something else", out=tmp_path / "downloads")
    refused("photos: holds something else than an export of vbnfault, so it is left alone", out=photos)
    (tmp_path / "file").touch()
    refused("file: is a file, not a folder", out=tmp_path / "file")
    half = filled(tmp_path / "half.zarr", samples=4)
    half._write_done(0, {0, 2})
    refused("half.zarr: 2 of 4 samples are finished", store=half.path)


@pytest.mark.parametrize("name", ["coco", "webdataset", "huggingface", "yolo"])
def test_masks_of_the_effect_replace_the_footprints(name: str, described_store: Path, tmp_path: Path) -> None:
    """Two stores in which the two masks are exchanged: the effect of one is the footprint of the other."""
    first, second = (st.open_store(shutil.copytree(described_store, tmp_path / s), "r+") for s in ("a", "b"))
    for index in range(SAMPLES):
        sample = first.read_sample(index)
        footprint, effect = sample.layers["mask"], sample.layers["mask"].copy()
        effect[:, : effect.shape[1] // 2] = False
        for store, one, other in ((first, footprint, effect), (second, effect, footprint)):
            layers = {"mask": one, "mask_effect": other, "mask_any": st.mask_union(store.spec, one)}
            st.write_samples(store, [replace(sample, layers={**sample.layers, **layers})])
    export_store(first, tmp_path / "effect", name, masks="effect", progress=False)
    export_store(second, tmp_path / "footprint", name, progress=False)
    export_store(first, tmp_path / "plain", name, progress=False)
    texts = {"README.md", "croissant.json", "export.json", "SHA256SUMS"}
    effect, footprint, plain = (
        {k: v for k, v in tree(tmp_path / folder).items() if k not in texts}
        for folder in ("effect", "footprint", "plain")
    )
    assert effect == footprint != plain
    assert "- Masks: `effect`" in (tmp_path / "effect/README.md").read_text()
    for folder, rule in (("effect", [st.EFFECT_RULE] * len(second.spec.faults)), ("plain", first.spec.mask_rules)):
        records = json.loads((tmp_path / folder / "croissant.json").read_text())["recordSet"]
        classes = next(record["data"] for record in records if record["name"] == "fault_classes")
        assert [one["fault_classes/rule"] for one in classes] == list(rule)
    assert "- Masks: `footprint`" in (tmp_path / "plain/README.md").read_text()
    with pytest.raises(InputError, match="holds another export: masks is 'effect' there and 'footprint' now"):
        export_store(first, tmp_path / "effect", name, progress=False)


def test_another_store_or_format_does_not_mix_into_an_export(
    described_store: Path, finished_store: Path, exported: Any, tmp_path: Path
) -> None:
    before = tree(exported("png"))
    with pytest.raises(InputError, match="format is 'png' there and 'exr' now"):
        export_store(described_store, exported("png"), "exr", progress=False)
    with pytest.raises(InputError, match="holds another export: samples is 6 there and 10 now"):
        export_store(finished_store, exported("png"), "png", progress=False)
    other = st.open_store(shutil.copytree(described_store, tmp_path / "s.zarr"), "r+")
    changed = other.read_sample(1)
    st.write_samples(other, [replace(changed, layers={**changed.layers, "image": changed.layers["clean"]})])
    with pytest.raises(InputError, match="holds another export: contents_sha256"):
        export_store(other, exported("png"), "png", progress=False)
    assert tree(exported("png")) == before


def test_a_damaged_sample_ends_an_export_until_it_is_repaired(finished_store: Path, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(finished_store, tmp_path / "s.zarr"))
    file = st.open_store(copy).file("mask", 1)
    good = file.read_bytes()
    file.write_bytes(good[:40] + bytes([good[40] ^ 1]) + good[41:])
    with pytest.raises(VbnfaultError, match="build command repairs it"):
        export_store(copy, tmp_path / "out", "coco", progress=False)
    file.write_bytes(good)
    assert export_store(copy, tmp_path / "out", "coco", progress=False).samples == 10
