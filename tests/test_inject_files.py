"""Images of files: what stays of each kind, batches and stores of them, and bad input."""

from __future__ import annotations

import json
import shutil
import signal
import struct
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
import pytest
import tifffile
from astropy.io import fits
from PIL import Image, ImageCms
from test_inject import CAMERA, SMALL
from typer.testing import CliRunner

import vbnfault
from vbnfault.cli import app
from vbnfault.core.errors import InputError, VbnfaultError
from vbnfault.core.files import images as image_files
from vbnfault.core.files.images import write_exr, write_png
from vbnfault.inject.batch import inject_files
from vbnfault.inject.files import read_image
from vbnfault.scene.config import Scene, load_scene, parse_scene

# --- files --------------------------------------------------------------------------------------------------------

GREY = np.random.default_rng(5).integers(0, 60000, (70, 90), np.uint16)
COLOURS = np.random.default_rng(6).integers(0, 250, (70, 90, 3), np.uint8)


def _fits_file(path: Path, array: np.ndarray, **cards: Any) -> None:
    part = fits.PrimaryHDU(array)
    for key, value in cards.items():
        part.header[key] = value
    part.writeto(path, overwrite=True)


def _image_files(folder: Path) -> dict[str, Path]:
    """Write an image of every kind, and return the files by name."""
    folder.mkdir(parents=True, exist_ok=True)
    tag = [(65000, "s", 0, "own tag", True)]
    tifffile.imwrite(folder / "strips.tif", GREY, description="mine", resolution=(72, 72), extratags=tag)
    tifffile.imwrite(folder / "none.tif", GREY, description=None, metadata=None, bigtiff=True, extratags=tag)
    tifffile.imwrite(folder / "tiles.tif", GREY, tile=(32, 32), compression="zlib", predictor=True, extratags=tag)
    tifffile.imwrite(folder / "big.tif", COLOURS, bigtiff=True, photometric="rgb", byteorder=">", extratags=tag)
    planes = np.moveaxis(COLOURS, -1, 0)
    tifffile.imwrite(folder / "planes.tif", planes, photometric="rgb", planarconfig="separate", extratags=tag)
    tifffile.imwrite(folder / "reversed.tif", GREY, extratags=[*tag, (269, "H", 1, 2, True)])
    data = (
        folder / "reversed.tif"
    ).read_bytes()  # FillOrder, which tifffile does not write, comes from another tag
    number, fill_order = (struct.pack("<HHIH", key, 3, 1, 2) for key in (269, 266))
    (folder / "reversed.tif").write_bytes(data.replace(number, fill_order))
    write_png(folder / "alpha.png", np.dstack([COLOURS, COLOURS[..., :1]]))
    write_png(folder / "grey.png", GREY)
    Image.fromarray(COLOURS).save(folder / "transparent.png", transparency=tuple(COLOURS[0, 0].tolist()))
    _fits_file(folder / "unsigned.fits", GREY, OBSERVER="me")
    _fits_file(folder / "blank.fits", (GREY // 2).astype(np.int16), BLANK=int(GREY[3, 3] // 2), OBSERVER="me")
    _fits_file(folder / "floats.fits", GREY.astype(np.float32), OBSERVER="me")
    np.save(folder / "array.npy", GREY)
    write_exr(
        folder / "rgb.exr",
        {c: np.ascontiguousarray(COLOURS[..., k] / np.float32(255)) for k, c in enumerate("RGB")}
        | {"Z": np.ones((70, 90), np.float32)},
    )
    return {path.name: path for path in sorted(folder.iterdir())}


def test_files_keep_their_kind_and_what_is_written_is_read_back(tmp_path: Path) -> None:
    for name, path in _image_files(tmp_path / "in").items():
        image = read_image(path)
        numbers = image.numbers.copy()
        numbers[10:20, 10:20] = (numbers[10:20, 10:20] / 2).astype(numbers.dtype)
        out = tmp_path / name
        image.write(out, numbers, "faults")
        np.testing.assert_array_equal(read_image(out).numbers, numbers, err_msg=name)


def test_other_programs_read_the_files_with_their_metadata(tmp_path: Path) -> None:
    files = _image_files(tmp_path / "in")
    for name in ("strips.tif", "none.tif", "tiles.tif", "big.tif", "planes.tif", "reversed.tif"):
        image = read_image(files[name])
        image.write(tmp_path / name, image.numbers, "faults")
        with tifffile.TiffFile(tmp_path / name) as before, tifffile.TiffFile(files[name]) as after:
            np.testing.assert_array_equal(before.asarray(), after.asarray())
            tags = [{t.code: t.value for t in f.pages[0].tags} for f in (before, after)]
        assert tags[0][270] == {"none.tif": "faults"}.get(name, tags[0][270])
        # compression, order of bits, the offsets of the blocks, and a description where there was none
        where = {259, 266, 273, 279, 317, 324, 325} | ({270} - tags[1].keys())
        assert {k: v for k, v in tags[0].items() if k not in where} == {
            k: v for k, v in tags[1].items() if k not in where
        }
    for name in ("unsigned.fits", "blank.fits", "floats.fits"):
        image = read_image(files[name])
        numbers = image.numbers.copy()
        numbers[0, 0] = numbers[0, 0] + 1
        image.write(tmp_path / name, numbers, "faults by vbnfault: dust")
        before, after = fits.getdata(files[name]), fits.getdata(tmp_path / name)
        assert after.dtype == before.dtype
        assert after[0, 0] == before[0, 0] + 1
        np.testing.assert_array_equal(after.ravel()[1:], before.ravel()[1:])
        header = fits.getheader(tmp_path / name)
        assert header["OBSERVER"] == "me"
        assert "dust" in str(header["HISTORY"])
    data = files["grey.png"].read_bytes()
    profile = b"\x00\x00\x00\x04gAMA\x00\x00\xb1\x8f\x0b\xfca\x05"
    at = data.index(b"IDAT") - 4
    files["grey.png"].write_bytes(data[:at] + profile + data[at:])
    image = read_image(files["grey.png"])
    image.write(tmp_path / "grey.png", image.numbers, "faults")
    assert profile in (tmp_path / "grey.png").read_bytes()
    assert b"vbnfault\0faults" in (tmp_path / "grey.png").read_bytes()
    image = read_image(files["transparent.png"])
    image.write(tmp_path / "transparent.png", image.numbers, "faults")
    before, after = (Image.open(folder / "transparent.png") for folder in (tmp_path / "in", tmp_path))
    assert (after.mode, after.info["transparency"]) == ("RGB", before.info["transparency"])
    np.testing.assert_array_equal(after, before)


@pytest.mark.parametrize(
    ("part", "cards"),
    [
        (fits.PrimaryHDU(COLOURS[..., 0]), {"BZERO": 128}),
        (fits.ImageHDU(GREY.astype(np.uint8)), {"OBS>RVER": "me"}),
        (fits.CompImageHDU(np.where(GREY < 900, np.nan, GREY / 7).astype(np.float32)), {}),
        (fits.CompImageHDU(GREY.astype(np.int32), compression_type="HCOMPRESS_1", hcomp_scale=30), {}),
    ],
    ids=["offset of bytes", "illegal key", "rounded floats", "rounded whole numbers"],
)
def test_fits_keeps_pixels_that_are_not_changed_and_valid_checksums(
    part: Any, cards: dict[str, Any], tmp_path: Path
) -> None:
    path, out = tmp_path / "a.fits", tmp_path / "out.fits"
    parts = [part] if isinstance(part, fits.PrimaryHDU) else [fits.PrimaryHDU(), part]
    for key, value in cards.items():
        part.header[key.replace(">", "E")] = value
    fits.HDUList(parts).writeto(path, checksum=True)
    for key in cards:
        path.write_bytes(path.read_bytes().replace(key.replace(">", "E").encode(), key.encode()))
    image, before = read_image(path), fits.getdata(path)
    np.testing.assert_array_equal(image.numbers, np.nan_to_num(before))
    numbers = image.numbers.copy()
    numbers[3, 4] += 1
    before[3, 4] = numbers[3, 4]
    image.write(out, numbers, "faults")
    with fits.open(out, checksum="OBS>RVER" not in cards) as file:  # astropy warns of wrong checksums
        np.testing.assert_array_equal(file[len(parts) - 1].data, before)
    for key in cards:
        assert key.encode() in out.read_bytes()


@pytest.mark.parametrize("compression", ["PIZ", "PXR24", "B44", "DWAB"])
def test_exr_keeps_pixels_that_are_not_changed_the_crop_and_the_other_parts(
    compression: str, tmp_path: Path
) -> None:
    kind = np.float32 if compression == "PXR24" else np.float16  # what the compression rounds
    values = np.random.default_rng(4).random((64, 64)).astype(kind)
    window = {
        "dataWindow": tuple(np.array(xy, np.int32) for xy in ((10, 20), (73, 83))),
        "displayWindow": tuple(np.array(xy, np.int32) for xy in ((0, 0), (199, 199))),
    }
    header = {
        "type": OpenEXR.scanlineimage,
        "compression": getattr(OpenEXR, f"{compression}_COMPRESSION"),
        **window,
    }
    parts = [OpenEXR.Part(dict(header), {channel: values}, channel) for channel in ("Y", "Z")]
    path, out = tmp_path / "a.exr", tmp_path / "out.exr"
    OpenEXR.File(parts).write(str(path))
    image = read_image(path)
    numbers = image.numbers.copy()
    numbers[3, 4] = 2
    image.write(out, numbers, "faults")
    before, after = (OpenEXR.File(str(name), separate_channels=True).parts for name in (path, out))
    np.testing.assert_array_equal(after[0].channels["Y"].pixels, numbers)
    np.testing.assert_array_equal(after[1].channels["Z"].pixels, before[1].channels["Z"].pixels)
    for key in window:
        np.testing.assert_array_equal(after[0].header[key], window[key])
    assert after[0].header["vbnfault"] == "faults"
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(InputError, match=r"a\.exr: is a damaged OpenEXR file"):
        read_image(path)
    assert after[0].header["compression"].name == f"{'PIZ' if compression == 'PIZ' else 'ZIP'}_COMPRESSION"


def _told_by_exiftool(path: Path) -> dict[str, Any]:
    """Return what exiftool reads in a file, by group and tag, without what belongs to the file and the blocks."""
    run = subprocess.run(
        ["exiftool", "-j", "-n", "-a", "-G1", "-b", "-all", "-validate", "-warning", str(path)],
        capture_output=True,
        check=True,
        text=True,
    )
    groups = ("SourceFile", "ExifTool", "System", "File", "Composite")
    blocks = ("StripOffsets", "StripByteCounts", "Compression", "Predictor")
    tags = json.loads(run.stdout)[0]
    return {k: v for k, v in tags.items() if k.split(":")[0] not in groups and k.split(":")[-1] not in blocks}


@pytest.mark.skipif(shutil.which("exiftool") is None, reason="exiftool is not installed")
@pytest.mark.parametrize("name", ["a.png", "a.tif"])
def test_metadata_that_exiftool_wrote_is_read_by_exiftool(name: str, tmp_path: Path) -> None:
    (tmp_path / "in").mkdir()
    path = tmp_path / "in" / name
    image = np.random.default_rng(5).integers(40, 200, (64, 96, 3), np.uint8)
    if name.endswith("png"):
        write_png(path, image)
    else:
        tifffile.imwrite(path, image, photometric="rgb", rowsperstrip=10, metadata=None)
    (tmp_path / "a.icc").write_bytes(ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes())
    tags = {
        "EXIF:Make": "Maker",
        "EXIF:Model": "Camera",
        "EXIF:ExposureTime": 0.0125,
        "EXIF:FNumber": 5.6,
        "EXIF:DateTimeOriginal": "2026:01:02 03:04:05",
        "EXIF:GPSLatitude": 48.5,
        "EXIF:GPSLatitudeRef": "N",
        "XMP-dc:Title": "Größe",
        "XMP-xmp:Rating": 4,
    }
    words = [f"-{key}={value}" for key, value in tags.items()]
    subprocess.run(
        ["exiftool", "-q", "-n", "-overwrite_original", *words, f"-ICC_Profile<={tmp_path / 'a.icc'}", str(path)],
        check=True,
    )
    before = _told_by_exiftool(path)
    assert {"IFD0:Make", "ExifIFD:ExposureTime", "GPS:GPSLatitude", "XMP-dc:Title"} <= before.keys()
    assert any(key.startswith("ICC") for key in before)
    dust = {"title": "dust", "faults": {"dust_on_optics": {}}, "plan": {"faulty_fraction": 1.0}, "camera": CAMERA}
    inject_files([path], Scene.model_validate(dust), tmp_path / "out", progress=False)
    after = _told_by_exiftool(tmp_path / "out" / name)
    assert {key: after.get(key) for key in before} == before
    assert (
        after["PNG:Vbnfault" if name == "a.png" else "IFD0:ImageDescription"]
        == "faults by vbnfault: dust_on_optics"
    )
    assert (read_image(tmp_path / "out" / name).numbers != image).any()


# --- batches ------------------------------------------------------------------------------------------------------

BATCH = {
    "plan.faulty_fraction": 1.0,
    "camera.exposure_s": 0.01,
    **{k: v for k, v in SMALL.items() if v is not None},
}


def _pictures(folder: Path, count: int) -> Path:
    folder.mkdir()
    rng = np.random.default_rng(9)
    for k in range(count):
        write_png(folder / f"{k:02d}.png", (rng.random((64, 96)) * 120 + 40).astype(np.uint8))
    return folder


def _contents(folder: Path) -> dict[str, bytes]:
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and "dataset.zarr" not in path.parts
    }


def test_a_batch_has_the_same_bytes_with_any_number_of_workers_and_after_a_kill(tmp_path: Path) -> None:
    pictures, scene = _pictures(tmp_path / "in", 6), load_scene("quickstart", BATCH)
    inject_files([pictures], scene, tmp_path / "one", progress=False)
    expected = _contents(tmp_path / "one")
    assert sum(name.endswith(".json") for name in expected) == 6
    inject_files([pictures], scene, tmp_path / "two", workers=2, progress=False)
    assert _contents(tmp_path / "two") == expected
    code = (
        "import sys; from pathlib import Path; from vbnfault.inject.batch import inject_files;"
        "from vbnfault.scene.config import load_scene; import json;"
        "inject_files([Path(sys.argv[1])], load_scene('quickstart', json.loads(sys.argv[3])), Path(sys.argv[2]),"
        "progress=False)"
    )
    killed = tmp_path / "killed"
    process = subprocess.Popen([sys.executable, "-c", code, str(pictures), str(killed), json.dumps(BATCH)])
    while process.poll() is None and len(list(killed.glob("labels/*.json"))) < 2:
        time.sleep(0.01)
    process.send_signal(signal.SIGKILL)
    process.wait()
    inject_files([pictures], scene, killed, progress=False)
    assert _contents(killed) == expected


def test_a_store_of_images_is_verified_exported_and_read_as_any_other(tmp_path: Path) -> None:
    pictures, scene = _pictures(tmp_path / "in", 6), load_scene("quickstart", BATCH)
    batch = inject_files([pictures], scene, tmp_path / "out", labels="zarr", sun=(60.0, 20.0), progress=False)
    path = tmp_path / "out" / "dataset.zarr"
    report = vbnfault.verify(path)
    assert not report.problems
    data = vbnfault.open_dataset(path)
    assert data["name"].values.tolist() == list(batch.names)
    for k, name in enumerate(batch.names):
        np.testing.assert_array_equal(data["image"][k, :, :, 3], read_image(tmp_path / "out" / name).numbers)
        label = json.loads((tmp_path / "out" / "labels" / f"{name}.json").read_text())
        injected = data["fault"].values[data["injected"][k].values].tolist()
        assert sorted(label["injected"]) == sorted(injected)
    assert data["injected"].values.any(axis=0).all()
    assert np.isnan(data["camera_position_T_m"].values).all()
    vbnfault.export(path, tmp_path / "exported", "png")
    assert list((tmp_path / "exported").rglob("*.png"))
    inject_files([pictures], scene, tmp_path / "out", labels="zarr", sun=(60.0, 20.0), progress=False)
    assert vbnfault.verify(path).digest == report.digest


def test_results_below_the_images_are_no_images_of_the_next_run(tmp_path: Path) -> None:
    pictures, scene = _pictures(tmp_path / "in", 2), load_scene("quickstart", BATCH)
    for _ in range(2):
        assert inject_files([pictures], scene, pictures / "out", progress=False).names == ("00.png", "01.png")


def test_results_lie_below_their_folder_for_images_of_a_folder_beside(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene, first = load_scene("quickstart", BATCH), _pictures(tmp_path / "a", 1)
    monkeypatch.chdir(_pictures(tmp_path / "b", 2))
    before = (first / "00.png").read_bytes()
    batch = inject_files(["../a/00.png", "01.png"], scene, Path("../out"), progress=False)
    assert batch.names == ("a/00.png", "b/01.png")
    assert (first / "00.png").read_bytes() == before
    assert (tmp_path / "out" / "a" / "00.png").is_file()


def test_images_are_made_again_when_a_file_that_the_scene_names_changed(tmp_path: Path) -> None:
    pictures, curve = _pictures(tmp_path / "in", 1), tmp_path / "curve.csv"
    keys = {"image.response": "table", "image.response_file": str(curve)}
    found = []
    for middle in (0.2, 0.6, 0.2):
        curve.write_text(f"0,0\n0.5,{middle}\n1,1\n")
        inject_files([pictures], load_scene("quickstart", BATCH | keys), tmp_path / "out", progress=False)
        found.append((tmp_path / "out" / "00.png").read_bytes())
    assert found[0] == found[2] != found[1]


def test_a_batch_goes_on_past_a_damaged_image_and_names_it(tmp_path: Path) -> None:
    pictures = _pictures(tmp_path / "in", 3)
    (pictures / "01.png").write_bytes((pictures / "01.png").read_bytes()[:200])
    with pytest.raises(
        VbnfaultError, match=r"image 1 of 3 failed, the first with: .*01\.png: is (a damaged|no) PNG"
    ):
        inject_files([pictures], load_scene("quickstart", BATCH), tmp_path / "out", progress=False)
    assert [path.name for path in sorted((tmp_path / "out").glob("*.png"))] == ["00.png", "02.png"]


def test_the_command_says_what_it_assumed_and_where_the_images_are(tmp_path: Path) -> None:
    pictures = _pictures(tmp_path / "in", 2)
    arguments = ["inject", str(pictures / "*.png"), "--scene", "quickstart", "--out", str(tmp_path / "out")]
    arguments += [v for key, value in BATCH.items() for v in ("--set", f"{key}={json.dumps(value)}")]
    result = CliRunner().invoke(app, [*arguments, "--sun", "60,20", "--seed", "3"])
    assert result.exit_code == 0, result.output
    assert "image.white_dn = 255: assumed" in result.output
    assert f"2 images: {tmp_path / 'out'}" in result.output
    assert json.loads((tmp_path / "out/labels/00.png.json").read_text())["seed"] == 3


@pytest.mark.parametrize("labels", ["png", "zarr"])
def test_images_of_a_sequence_share_the_state_of_the_instrument(labels: str, tmp_path: Path) -> None:
    pictures, scene = _pictures(tmp_path / "in", 3), tmp_path / "dust.toml"
    scene.write_text('title = "dust"\n[camera]\nexposure_s = 0.01\nfov_deg = 30.0\n[faults.dust_on_optics]\n')
    grains = {}
    for option in ([], ["--sequence"]):
        out = tmp_path / f"out{len(option)}"
        arguments = ["inject", str(pictures), "--scene", str(scene), "--out", str(out), "--labels", labels, *option]
        result = CliRunner().invoke(app, arguments)
        assert result.exit_code == 0, result.output
        told = [json.loads(path.read_text())["parameters"] for path in sorted(out.glob("labels/*.json"))]
        grains[len(option)] = [one["dust_on_optics"] for one in told]
    assert len(grains[0]) == 3
    assert grains[0][0] != grains[0][1] != grains[0][2]
    assert grains[1] == [grains[0][0]] * 3  # the first image has the same in both


def test_images_of_a_sequence_carry_the_same_faults(tmp_path: Path) -> None:
    pictures, scene = _pictures(tmp_path / "in", 6), tmp_path / "some.toml"
    scene.write_text(
        'title = "some"\n[camera]\nexposure_s = 0.01\nfov_deg = 30.0\n[faults.dust_on_optics]\n'
        "[faults.broken_lines]\n"
        "[plan]\nclasses_per_sample = [1, 1]\nfaulty_fraction = 0.5\n"
    )
    commanded = {}
    for option in ([], ["--sequence"]):
        out = tmp_path / f"out{len(option)}"
        arguments = ["inject", str(pictures), "--scene", str(scene), "--out", str(out), "--labels", "zarr", *option]
        result = CliRunner().invoke(app, arguments)
        assert result.exit_code == 0, result.output
        assert vbnfault.verify(out / "dataset.zarr").problems == []
        with vbnfault.open_dataset(out / "dataset.zarr") as data:
            proposals = [json.loads(text) for text in data["proposal"].values]
        commanded[len(option)] = {tuple(one["injected"]) for one in proposals}
    assert len(commanded[0]) == 3  # none, and each of the two
    assert len(commanded[1]) == 1


# --- bad input ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("image", "sentence"),
    [
        (np.zeros((1, 1), np.uint8), "1 x 1 pixels: must have at least 16 x 16"),
        (np.zeros((0, 0), np.uint8), r"image of shape \[0, 0\]"),
        (np.zeros((64, 64, 5), np.uint8), "with 1, 3 or 4 channels"),
        (np.zeros((64, 64), complex), "image of complex128"),
        (np.full((64, 64), np.nan), "4096 values that are NaN or infinite"),
    ],
)
def test_unusable_arrays(image: np.ndarray, sentence: str) -> None:
    with pytest.raises(InputError, match=sentence):
        vbnfault.inject(image, {"dust_on_optics": {}}, camera=CAMERA)


@pytest.mark.parametrize(
    ("name", "content", "sentence"),
    [
        ("a.png", b"", "image file is empty"),
        ("b.png", b"\x89PNG", "is no PNG file"),
        ("b.png", b"\x89PNG\r\n\x1a\nIHDR", "is a damaged PNG"),
        ("a.tif", b"II*\0", "is a damaged TIFF"),
        ("a.fits", b"SIMPLE", "is a damaged FITS|without an image"),
        ("a.exr", b"v/1\x01", "is a damaged OpenEXR"),
        ("a.npy", b"\x93NUMPY", "is no array of numpy"),
        ("b.npy", b"\x93NUMPY\x01\0\x05\0{'a':", "is no array of numpy"),
        ("a.bmp", b"BM", "must end with one of"),
    ],
)
def test_unusable_files(tmp_path: Path, name: str, content: bytes, sentence: str) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError, match=rf"{name}: .*({sentence})"):
        read_image(tmp_path / name)


def test_packed_bits_are_refused_since_they_would_be_written_as_whole_bytes(tmp_path: Path) -> None:
    rows = iter([bytes(20 * 32 * 12 // 8)])
    tifffile.imwrite(tmp_path / "packed.tif", rows, shape=(20, 32), dtype=np.uint16, bitspersample=12)
    with pytest.raises(InputError, match=r"packed.tif: .*packed bits; save it as plain grey"):
        read_image(tmp_path / "packed.tif")


@pytest.mark.parametrize(
    ("keys", "sentence"),
    [
        ({"white_dn": 5.0, "black_dn": 10.0}, "image.white_dn = 5: must be above image.black_dn = 10"),
        ({"response": "table", "response_file": "missing.csv"}, "image.response_file: missing.csv: .* not found"),
        ({"response": "table"}, "image.response_file: is missing; response = 'table' needs a CSV file"),
        ({"sun": "auto"}, "no round region of saturated pixels"),
        ({"sun": (float("nan"), 1.0)}, "image.sun"),
    ],
)
def test_unusable_descriptions_of_an_image(keys: dict[str, Any], sentence: str) -> None:
    with pytest.raises((InputError, ValueError), match=sentence):
        vbnfault.inject(np.full((64, 64), 90, np.uint8), {"dust_on_optics": {}}, camera=CAMERA, image_keys=keys)


def test_a_direction_of_the_sun_with_a_word_in_it_is_named() -> None:
    with pytest.raises(InputError, match=r"image\.sun\[2\] = 'a': must be a number"):
        load_scene("quickstart", {"image.sun": [1.0, 2.0, "a"]})


def test_a_response_that_falls_is_refused(tmp_path: Path) -> None:
    (tmp_path / "curve.csv").write_text("0,0\n0.5,0.7\n1,0.6\n")
    keys = {"response": "table", "response_file": str(tmp_path / "curve.csv")}
    with pytest.raises(InputError, match="both columns must rise"):
        vbnfault.inject(np.full((64, 64), 90, np.uint8), {"dust_on_optics": {}}, camera=CAMERA, image_keys=keys)


def test_unusable_batches(tmp_path: Path) -> None:
    pictures, scene = _pictures(tmp_path / "in", 2), load_scene("quickstart", BATCH | {"image.noise_free": True})
    _pictures(tmp_path / "clean", 1)
    (tmp_path / "empty").mkdir()
    (tmp_path / "link").symlink_to("in")
    for images, out, labels, sentence in (
        ([tmp_path / "empty"], "out", "png", "holds no image"),
        ([str(tmp_path / "none*.png")], "out", "png", "matches no file"),
        ([pictures, pictures / "00.png"], "out", "png", "is named twice"),
        ([pictures], "in", "png", "holds the images, which would be replaced"),
        ([pictures], "in/../in", "png", "holds the images, which would be replaced"),
        ([pictures / "00.png"], "link", "png", "holds the images, which would be replaced"),
        ([tmp_path / "clean" / "00.png"], ".", "png", "holds the images, which would be replaced"),
    ):
        with pytest.raises(InputError, match=sentence):
            inject_files(images, scene, tmp_path / out, labels=labels, progress=False)


def test_a_store_keeps_what_fits_and_names_the_rest(tmp_path: Path) -> None:
    """The first image that can be read sets the size; damaged ones and others are named, and the rest is made."""
    pictures, scene = _pictures(tmp_path / "in", 3), load_scene("quickstart", BATCH)
    (pictures / "00.png").write_bytes(b"no image")
    write_png(pictures / "large.png", np.zeros((80, 96), np.uint8))
    with pytest.raises(
        VbnfaultError, match=r"2 samples \(0, 3\) failed, the first with: .*00.png: is no PNG"
    ) as failed:
        inject_files([pictures], scene, tmp_path / "out", labels="zarr", progress=False)
    assert failed.value.exit_code == 1
    assert sorted(path.name for path in (tmp_path / "out/labels").iterdir()) == ["01.png.json", "02.png.json"]


@pytest.mark.parametrize("workers", [1, 2])
def test_a_calibration_without_a_size_is_that_of_the_first_image_of_a_batch(tmp_path: Path, workers: int) -> None:
    pictures = _pictures(tmp_path / "in", 2)
    write_png(pictures / "small.png", np.full((32, 48), 90, np.uint8))
    camera = {"calibration": {"fx": 100.0, "cx": 47.5, "cy": 31.5}, "exposure_s": 0.01}
    scene = parse_scene({"title": "own", "camera": camera, "faults": {"vignetting": {}}}, source="own")
    with pytest.raises(VbnfaultError, match=r"small.png: camera.calibration: is of an image of 96 x 64 px, and"):
        inject_files([pictures], scene, tmp_path / "out", workers=workers, progress=False)
    made = sorted(path.name for path in (tmp_path / "out" / "labels").iterdir())
    assert made == ["00.png.json", "01.png.json"]


def test_a_store_of_images_keeps_the_focal_length(tmp_path: Path) -> None:
    camera = {"focal_length_mm": 50.0, "exposure_s": 0.01}  # pixels of 5.5 um
    scene = parse_scene({"title": "own", "camera": camera, "faults": {"vignetting": {}}}, source="own")
    inject_files([_pictures(tmp_path / "in", 1)], scene, tmp_path / "out", labels="zarr", progress=False)
    data = vbnfault.open_dataset(tmp_path / "out" / "dataset.zarr")
    np.testing.assert_allclose(data["intrinsics"][0, :2], 50.0 / 5.5e-3)
    assert data.attrs["scene"]["camera"]["fov_deg"] == pytest.approx(np.degrees(2 * np.arctan(48 * 5.5e-3 / 50)))
    assert not vbnfault.verify(tmp_path / "out" / "dataset.zarr").problems
    assert data.attrs["licence"] == ""  # the images have one of their own


def test_a_scene_without_a_plan_commands_every_class_in_every_image_and_says_what_came_of_it(
    tmp_path: Path,
) -> None:
    pictures = _pictures(tmp_path / "in", 4)
    tables = {"title": "own", "camera": CAMERA, "faults": {"dust_on_optics": {}, "straylight": {}}}
    batch = inject_files([pictures], Scene.model_validate(tables), tmp_path / "out", progress=False)
    report = batch.report()
    assert "dust_on_optics: in 4 of 4 images" in report
    why = "4 without: it needs the Sun before the camera; give its position: image.sun, --sun or sun="
    assert f"straylight: in 0 of 4 images; {why}" in report
    traced = {**tables, "faults": {"straylight": {"model": "traced"}}}  # at 10 ms, the Sun's veil is white
    white = inject_files([pictures], Scene.model_validate(traced), tmp_path / "b", sun=(40.0, 20.0), progress=False)
    assert white.report()[-1].startswith("100% of the pixels are white, and 0% were before")


def test_grey_png_with_alpha_keeps_both(tmp_path: Path) -> None:
    """Written and read back by Pillow, which knows such images."""
    rng = np.random.default_rng(3)
    both = rng.integers(1, 200, (64, 96, 2), dtype=np.uint8)
    (tmp_path / "in").mkdir()
    Image.fromarray(both, "LA").save(tmp_path / "in/a.png")
    camera = {"detector": "rosetta_navcam", "fov_deg": 20.0, "exposure_s": 0.1}
    tables = {"title": "own", "camera": camera, "faults": {"dust_on_optics": {}}}
    inject_files([tmp_path / "in"], Scene.model_validate(tables), tmp_path / "out", progress=False)
    after = Image.open(tmp_path / "out/a.png")
    assert after.mode == "LA"
    np.testing.assert_array_equal(np.asarray(after)[..., 1], both[..., 1])
    assert (np.asarray(after)[..., 0] != both[..., 0]).any()
    deep = np.dstack([both[..., 0].astype(np.uint16) * 257, both[..., 1].astype(np.uint16) * 257])
    png = image_files.with_png_numbers(image_files._grey_with_alpha(deep), deep, "text")
    np.testing.assert_array_equal(image_files.png_numbers(png, 10**6), deep)


def test_mistakes_are_named_in_a_sentence(tmp_path: Path) -> None:
    image = np.full((64, 96), 90, np.uint8)
    (tmp_path / "text.png").write_text("no image")
    for call, sentence in (
        (lambda: vbnfault.inject(image, {}), r"\[faults\] names no class"),
        (lambda: vbnfault.inject(None, {"dust_on_optics": {}}), "is None and no array; was the file read?"),
        (lambda: vbnfault.inject(image, {"dust": {}}), "dust.*dust_on_optics"),
        (
            lambda: vbnfault.inject(image, {"dust_on_optics": {}}, image_keys={"white_dn": 4095}),
            "white_dn = 4095: must be at most 255, the largest number of this image",
        ),
        (
            lambda: vbnfault.inject(image, {"dust_on_optics": {}}, image_keys={"white_dn": 4, "black_dn": 9}),
            "white_dn = 4: must be above image.black_dn = 9",
        ),
        (lambda: read_image(tmp_path / "text.png"), "is no PNG file, whatever its name says"),
        (lambda: read_image(tmp_path / "a.jpg"), "save it as PNG or TIFF"),
    ):
        with pytest.raises(InputError, match=sentence):
            call()


def test_masks_of_an_earlier_run_go_with_their_faults(tmp_path: Path) -> None:
    pictures, out = _pictures(tmp_path / "in", 2), tmp_path / "out"
    for classes in (("dust_on_optics", "vignetting"), ("vignetting",)):
        tables = {"title": "own", "camera": CAMERA, "faults": {name: {} for name in classes}}
        inject_files([pictures], Scene.model_validate(tables), out, progress=False)
        names = {path.name.partition(".png_")[2] for path in (out / "masks").iterdir()}
        assert names == {f"{name}.png" for name in (*classes, "any")}
