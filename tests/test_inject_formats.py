"""Faults in images of planetary archives, in the frames of a film, and in noise-free images of other renderers."""

from __future__ import annotations

import json
import shutil
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import av
import numpy as np
import pytest

import vbnfault
from vbnfault.core.errors import InputError, VbnfaultError
from vbnfault.core.files.images import read_exr, write_exr, write_png
from vbnfault.core.registry import forget
from vbnfault.detector.three_colour import ThreeColourDetector
from vbnfault.inject.batch import inject_files
from vbnfault.inject.files import read_image
from vbnfault.inject.films import assemble, unpack
from vbnfault.scene.config import load_scene

SCENE = {"plan.faulty_fraction": 1.0, "camera.exposure_s": 0.01}

# --- planetary archives -------------------------------------------------------------------------------------------

# Samples of PDS3 (standards reference, appendix C) with their numpy type, and the same of PDS4
PDS3_SAMPLES = {
    **{f"{order}_{sign}INTEGER": (mark, letter) for order, mark in (("MSB", ">"), ("LSB", "<"))
       for sign, letter in (("", "i"), ("UNSIGNED_", "u"))},
    "IEEE_REAL": (">", "f"),
    "PC_REAL": ("<", "f"),
}  # fmt: skip
PDS3 = [(name, *kind, size) for name, kind in PDS3_SAMPLES.items() for size in (1, 2, 4, 8)]
PDS3 = [row for row in PDS3 if (row[2] == "f") == (row[3] == 8) or row[3] == 4]
PDS4 = {
    "UnsignedByte": "u1",
    "SignedByte": "i1",
    **{f"{sign}{order}{bits}": f"{mark}{letter}{size}"
       for sign, letter in (("Signed", "i"), ("Unsigned", "u"))
       for order, mark in (("MSB", ">"), ("LSB", "<")) for bits, size in ((2, 2), (4, 4))},
    **{f"IEEE754{order}{name}": f"{mark}f{size}"
       for order, mark in (("MSB", ">"), ("LSB", "<")) for name, size in (("Single", 4), ("Double", 8))},
}  # fmt: skip


def _stored(dtype: np.dtype[Any]) -> np.ndarray:
    """Return an image of 20 x 24 pixels, with the signs and the high bytes that its type has."""
    low, high = (-120, 120) if dtype.kind == "i" else (0, 250)
    scale = 1 if dtype.itemsize == 1 else 129 if dtype.kind != "f" else 0.37
    numbers = np.random.default_rng(2).integers(low, high, (20, 24)) * scale
    return numbers.astype(dtype)


def pds3_file(path: Path, stored: np.ndarray, kind: str, *, attached: bool = True, more: str = "") -> int:
    """Write an image with a label of PDS3, 6 bytes before and 4 behind each line; return where its lines begin."""
    size = stored.dtype.itemsize
    before, after = 2 * size, size
    record, lines = before + stored.shape[1] * size + after, len(stored)
    pad = -(-2048 // record)
    label = "\r\n".join(
        [
            "PDS_VERSION_ID = PDS3", "RECORD_TYPE = FIXED_LENGTH", f"RECORD_BYTES = {record}",
            f"FILE_RECORDS = {lines + pad if attached else lines}",
            f"^IMAGE = {pad + 1}" if attached else f'^IMAGE = ("{path.name}", 1)',
            'INSTRUMENT_NAME = "NAVIGATION CAMERA"', "OBJECT = IMAGE", f" LINES = {lines}",
            f" LINE_SAMPLES = {stored.shape[1]}", f" SAMPLE_TYPE = {kind}", f" SAMPLE_BITS = {8 * size}",
            f" LINE_PREFIX_BYTES = {before}", f" LINE_SUFFIX_BYTES = {after}", more, "END_OBJECT = IMAGE", "END",
            "",
        ]
    ).encode()  # fmt: skip
    rows = b"".join(b"p" * before + row.tobytes() + b"s" * after for row in stored)
    head = label.ljust(pad * record) if attached else b""
    path.write_bytes(head + rows)
    if not attached:
        path.with_suffix(".lbl").write_bytes(label)
    return len(head) + before


def pds4_file(path: Path, stored: np.ndarray, kind: str, more: str = "") -> int:
    """Write an image with a label of PDS4, after a header of 32 bytes; return where it begins."""
    rows, columns = stored.shape
    axes = "".join(
        f"<Axis_Array><axis_name>{name}</axis_name><elements>{n}</elements>"
        f"<sequence_number>{k}</sequence_number></Axis_Array>"
        for k, (name, n) in enumerate((("Line", rows), ("Sample", columns)), 1)
    )
    path.write_bytes(b"h" * 32 + stored.tobytes() + b"after")
    path.with_suffix(".xml").write_text(
        '<?xml version="1.0" encoding="UTF-8"?>'
        '<Product_Observational xmlns="http://pds.nasa.gov/pds4/pds/v1"><Identification_Area>'
        "<logical_identifier>urn:nasa:pds:a:b:c</logical_identifier><version_id>1.0</version_id>"
        "<title>t</title><information_model_version>1.19.0.0</information_model_version>"
        "<product_class>Product_Observational</product_class></Identification_Area>"
        f"<File_Area_Observational><File><file_name>{path.name}</file_name></File>"
        "<Array_2D_Image><local_identifier>image</local_identifier>"
        '<offset unit="byte">32</offset><axes>2</axes>'
        "<axis_index_order>Last Index Fastest</axis_index_order>"
        f"<Element_Array><data_type>{kind}</data_type></Element_Array>{axes}{more}</Array_2D_Image>"
        "</File_Area_Observational></Product_Observational>"
    )
    return 32


def _changed_back(path: Path, out: Path, stored: np.ndarray, begin: int, line_bytes: int) -> np.ndarray:
    """Write other numbers, check that all bytes outside the pixels are as before, and return the numbers."""
    image = read_image(path)
    np.testing.assert_array_equal(image.numbers, stored)
    assert image.numbers.dtype == stored.dtype.newbyteorder("=")
    numbers = image.numbers.copy()
    numbers[3:9, 5:11] = numbers[3:9, 5:11] // 2 + 1
    out.mkdir()
    image.write(out / path.name, numbers, "faults")
    expected = bytearray(path.read_bytes())
    for y, row in enumerate(numbers.astype(stored.dtype)):  # by hand, without any reader
        at = begin + y * line_bytes
        expected[at : at + row.nbytes] = row.tobytes()
    assert (out / path.name).read_bytes() == bytes(expected)
    return numbers


@pytest.mark.parametrize("attached", [True, False])
@pytest.mark.parametrize(("kind", "order", "letter", "size"), PDS3)
def test_pds3_keeps_every_byte_but_the_pixels(
    kind: str, order: str, letter: str, size: int, attached: bool, tmp_path: Path
) -> None:
    import pdr

    stored = _stored(np.dtype(f"{order}{letter}{size}"))
    path = tmp_path / "frame.img"
    begin = pds3_file(path, stored, kind, attached=attached)
    numbers = _changed_back(path, tmp_path / "out", stored, begin, 27 * size)
    label = tmp_path / "out" / ("frame.img" if attached else "frame.lbl")
    np.testing.assert_array_equal(pdr.read(str(label))["IMAGE"], numbers)
    if not attached:
        assert label.read_bytes() == (tmp_path / "frame.lbl").read_bytes()


@pytest.mark.parametrize(("kind", "dtype"), PDS4.items())
def test_pds4_keeps_every_byte_but_the_pixels(kind: str, dtype: str, tmp_path: Path) -> None:
    import pdr  # reads PDS4 by its own copy of pds4_tools, through other calls

    stored = _stored(np.dtype(dtype))
    path = tmp_path / "frame.dat"
    begin = pds4_file(path, stored, kind)
    numbers = _changed_back(path, tmp_path / "out", stored, begin, stored[0].nbytes)
    label = tmp_path / "out" / "frame.xml"
    np.testing.assert_array_equal(pdr.read(str(label))["image"], numbers)
    assert label.read_bytes() == (tmp_path / "frame.xml").read_bytes()


def test_pixels_that_a_label_calls_missing_stay_so(tmp_path: Path) -> None:
    stored = _stored(np.dtype(">i2"))
    stored[4, 6:9] = -32768
    pds3_file(tmp_path / "a.img", stored, "MSB_INTEGER", more=" MISSING_CONSTANT = -32768")
    constants = "<Special_Constants><missing_constant>-32768</missing_constant></Special_Constants>"
    pds4_file(tmp_path / "b.img", stored, "SignedMSB2", constants)
    for name in ("a.img", "b.img"):
        image = read_image(tmp_path / name)
        assert (image.numbers[4, 6:9] == 0).all()
        image.write(tmp_path / f"out_{name}", image.numbers + np.int16(1), "")
        again = (tmp_path / f"out_{name}").read_bytes()
        assert again.count(stored[4, 6:9].tobytes()) == 1


def test_a_batch_of_an_archive_keeps_its_names_and_follows_its_labels(tmp_path: Path) -> None:
    folder = tmp_path / "in"
    folder.mkdir()
    flat = np.full((64, 96), 9000, ">u2")
    pds3_file(folder / "a.img", flat, "MSB_UNSIGNED_INTEGER", attached=False)
    pds4_file(folder / "b.img", flat, "UnsignedMSB2")
    pds3_file(folder / "c.img", flat, "MSB_UNSIGNED_INTEGER")
    batch = inject_files([folder], load_scene("quickstart", SCENE), tmp_path / "out", progress=False)
    assert batch.names == ("a.img", "b.img", "c.img")
    assert {p.name for p in (tmp_path / "out").iterdir() if p.is_file()} == {p.name for p in folder.iterdir()}
    for k, name in enumerate(batch.names):
        assert batch.is_finished(k)
        assert (read_image(tmp_path / "out" / name).numbers != flat).any()
    label = folder / "a.lbl"
    label.write_bytes(label.read_bytes().replace(b"NAVIGATION", b"CALIBRATED"))
    assert [batch.is_finished(k) for k in range(3)] == [False, True, True]


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        (b"LINES = 20", b"LINES = 90", "ends before its last pixel"),
        (b"LINE_SAMPLES = 24", b"LINE_SAMPLES = 99999999", "pixels times channels must be at most"),
        (
            b"MSB_INTEGER\r\n SAMPLE_BITS = 16",
            b"VAX_REAL\r\n SAMPLE_BITS = 32",
            "type VAX_REAL of 32 bits; must be",
        ),
        (b"SAMPLE_BITS = 16", b"SAMPLE_BITS = 12", "of 12 bits; must be integers or IEEE reals"),
        (b"OBJECT = IMAGE", b"OBJECT = TABLE", "frame.lbl"),
        (b"LINES = 20", b"LINES = 20\r\n BANDS = 3", "has an image of 3 bands"),
        (b"LINES = 20", b'LINES = 20\r\n ENCODING_TYPE = "HUFFMAN"', "compressed, HUFFMAN"),
        (b"frame.img", b"other.img", "has no IMAGE in the label frame.lbl"),
        (b"SAMPLE_TYPE", b"SAMPLE_SORT", "label frame.lbl: 'SAMPLE_TYPE' is missing or unknown"),
    ],
)
def test_unusable_labels(old: bytes, new: bytes, sentence: str, tmp_path: Path) -> None:
    path = tmp_path / "frame.img"
    pds3_file(path, _stored(np.dtype(">i2")), "MSB_INTEGER", attached=False)
    label = path.with_suffix(".lbl")
    assert old in label.read_bytes()
    label.write_bytes(label.read_bytes().replace(old, new))
    with pytest.raises(InputError, match=rf"frame\.img: .*({sentence})"):
        read_image(path)


def test_unusable_archives(tmp_path: Path) -> None:
    (tmp_path / "a.img").write_bytes(b"no label at all" * 9)
    (tmp_path / "b.img").write_bytes(b"h" * 99)
    (tmp_path / "b.xml").write_text("<Product_Observational>")
    for name, sentence in (("a.img", "has no IMAGE in the label a.img"), ("b.img", "label b.xml")):
        with pytest.raises(InputError, match=rf"{name}: .*{sentence}"):
            read_image(tmp_path / name)


# --- films --------------------------------------------------------------------------------------------------------


def film_file(path: Path, codec: str, pixels: str, frames: int = 6, rate: int = 12) -> np.ndarray:
    """Write a film of noise that moves, and return its frames as RGB of 8 bits."""
    noise = np.random.default_rng(3).integers(20, 200, (64, 96 + frames, 3), np.uint8)
    images = np.array([np.ascontiguousarray(noise[:, k : k + 96]) for k in range(frames)])
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=rate)
        stream.width, stream.height, stream.pix_fmt = 96, 64, pixels
        for image in images:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
        container.mux(stream.encode())
    return images


def _read(path: Path, pixels: str) -> tuple[np.ndarray, Fraction | None]:
    """Return the frames of a film and its rate."""
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        return np.array([f.to_ndarray(format=pixels) for f in container.decode(stream)]), stream.average_rate


@pytest.mark.parametrize(
    ("name", "codec", "given", "read", "dtype"),
    [
        ("colour.mp4", "mpeg4", "yuv420p", "rgb24", np.uint8),
        ("lossless.avi", "ffv1", "bgr0", "rgb24", np.uint8),
        ("grey.mov", "mjpeg", "yuvj420p", "rgb24", np.uint8),
        ("grey.avi", "ffv1", "gray", "gray", np.uint8),
        ("deep.mkv", "ffv1", "gray16le", "gray16le", np.uint16),
        ("deep_colour.mkv", "ffv1", "gbrp16le", "rgb48le", np.uint16),
    ],
)
def test_frames_go_through_ffv1_without_loss(
    name: str, codec: str, given: str, read: str, dtype: Any, tmp_path: Path
) -> None:
    images = film_file(tmp_path / name, codec, given)
    film = unpack(tmp_path / name, tmp_path / "frames", 10**6)
    assert (film.frames, Fraction(film.rate), film.ended) == (6, 12, "")
    first = read_image(tmp_path / "frames" / "000001.png").numbers
    assert first.dtype == dtype
    if name == "lossless.avi":
        np.testing.assert_array_equal(first, images[0])
    before = _read(tmp_path / name, read)[0]
    assemble(tmp_path / "frames", tmp_path / "again.mkv", film)
    after, rate = _read(tmp_path / "again.mkv", read)
    np.testing.assert_array_equal(after, before)
    assert rate == 12
    data = (tmp_path / "again.mkv").read_bytes()
    assemble(tmp_path / "frames", tmp_path / "again.mkv", film)
    assert (tmp_path / "again.mkv").read_bytes() == data


def test_a_film_of_a_grey_camera_has_grey_frames_whatever_its_codec(tmp_path: Path) -> None:
    images = np.random.default_rng(3).integers(20, 200, (4, 64, 96), np.uint8).repeat(8, 1)[:, :64]
    with av.open(str(tmp_path / "grey.mp4"), "w") as container:
        stream = container.add_stream("mpeg4", rate=5)
        stream.width, stream.height, stream.pix_fmt = 96, 64, "yuv420p"
        for image in images:
            container.mux(
                stream.encode(av.VideoFrame.from_ndarray(image, format="gray").reformat(format="yuv420p"))
            )
        container.mux(stream.encode())
    unpack(tmp_path / "grey.mp4", tmp_path / "frames", 10**6)
    assert {read_image(path).numbers.shape for path in (tmp_path / "frames").glob("*.png")} == {(64, 96)}


def _results(folder: Path) -> dict[str, bytes]:
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and "dataset.zarr" not in path.parts
    }


def test_a_film_becomes_images_with_masks_and_a_film(tmp_path: Path) -> None:
    (tmp_path / "in").mkdir()
    film_file(tmp_path / "in" / "film.mp4", "mpeg4", "yuv420p")
    scene, out = load_scene("quickstart", SCENE), tmp_path / "out"
    batch = inject_files([tmp_path / "in"], scene, out, sun=(60.0, 20.0), progress=False)
    assert batch.names == tuple(f"film/{k:06d}.png" for k in range(1, 7))
    faulty, rate = _read(out / "film.mkv", "rgb24")
    assert rate == 12
    before = _read(tmp_path / "in" / "film.mp4", "rgb24")[0]
    masks, drawn = [], {}
    for k, name in enumerate(batch.names):
        np.testing.assert_array_equal(faulty[k], read_image(out / name).numbers)
        masks.append(read_image(out / "masks" / f"{name}_any.png").numbers > 0)
        label = json.loads((out / "labels" / f"{name}.json").read_text())
        assert label["number"] == k
        assert label["injected"]
        drawn = {**label["parameters"], **drawn}
        assert label["parameters"].items() <= drawn.items()  # dust and defects stay through a film
    assert (faulty != before).any(axis=(1, 2, 3)).all()
    expected = _results(out)
    inject_files([tmp_path / "in"], scene, tmp_path / "two", sun=(60.0, 20.0), workers=2, progress=False)
    assert _results(tmp_path / "two") == expected
    inject_files([tmp_path / "in"], scene, tmp_path / "two", sun=(60.0, 20.0), labels="zarr", progress=False)
    assert not vbnfault.verify(tmp_path / "two" / "dataset.zarr").problems
    assert (tmp_path / "two" / "film.mkv").read_bytes() == expected["film.mkv"]
    # what an interruption left over is kept, and what it lacks is made
    changed = out / "film" / "000002.png"
    at = changed.stat().st_mtime_ns
    for lost in ("film.mkv", "labels/film/000005.png.json", "film/000006.png"):
        (out / lost).unlink()
    inject_files([tmp_path / "in"], scene, out, sun=(60.0, 20.0), progress=False)
    assert _results(out) == expected
    assert changed.stat().st_mtime_ns == at


def test_a_damaged_image_holds_no_film_back_and_hides_none_that_ends_early(tmp_path: Path) -> None:
    (tmp_path / "in").mkdir()
    for name in ("whole.mkv", "cut.mkv"):
        film_file(tmp_path / "in" / name, "ffv1", "bgr0")
    data = (tmp_path / "in" / "cut.mkv").read_bytes()
    (tmp_path / "in" / "cut.mkv").write_bytes(data[: int(0.6 * len(data))])
    (tmp_path / "in" / "z.png").write_bytes(b"\x89PNG\r\n\x1a\n")
    with pytest.raises(VbnfaultError, match=r"z\.png: is .*cut\.mkv: frame"):
        inject_files([tmp_path / "in"], load_scene("quickstart", SCENE), tmp_path / "out", progress=False)
    assert {path.name for path in (tmp_path / "out").glob("*.mkv")} == {"whole.mkv", "cut.mkv"}


@pytest.mark.parametrize(
    ("name", "codec", "pixels", "left"),
    [
        ("film.mkv", "ffv1", "bgr0", 0.6),
        ("film.avi", "mjpeg", "yuvj420p", 0.5),
        ("film.mkv", "mpeg4", "yuv420p", 0.9),
    ],
)
def test_a_film_that_ends_early_is_made_as_far_as_it_goes(
    name: str, codec: str, pixels: str, left: float, tmp_path: Path
) -> None:
    whole, film = tmp_path / f"whole_{name}", tmp_path / name
    film_file(whole, codec, pixels, frames=12)
    data = whole.read_bytes()
    film.write_bytes(data[: int(left * len(data))])
    with pytest.raises(VbnfaultError, match=rf"{name}: frame \d+ (is|cannot).*; what comes before it is made") as e:
        inject_files([film], load_scene("quickstart", SCENE), tmp_path / "out", progress=False)
    assert not isinstance(e.value, InputError)  # exit status 1: the others are made
    made = len(list((tmp_path / "out" / "film").iterdir()))
    assert 0 < made < 12
    assert f"frame {made + 1} " in str(e.value)
    faulty = _read(tmp_path / "out" / "film.mkv", "rgb24")[0]
    assert len(faulty) == made
    frames = _read(whole, "rgb24")[0]
    for k in range(made):  # frames before the end are those of the whole film
        np.testing.assert_array_equal(
            read_image(tmp_path / "out" / "frames" / "film" / f"{k + 1:06d}.png").numbers, frames[k]
        )


def test_unusable_films(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scene, path = load_scene("quickstart", SCENE), tmp_path / "a.mp4"
    write_png(tmp_path / "image.png", np.full((64, 96), 90, np.uint8))
    film_file(tmp_path / "b.mp4", "mpeg4", "yuv420p")
    for content, sentence in (
        (b"", "film file is empty"),
        (b"#EXTM3U\n#EXTINF:1\n/etc/hostname\n", "a.mp4: frame 1 cannot be decoded"),
        ((tmp_path / "b.mp4").read_bytes()[:900], "a.mp4: frame 1 cannot be decoded"),
    ):
        path.write_bytes(content)
        with pytest.raises(InputError, match=sentence):
            inject_files([path], scene, tmp_path / "out", progress=False)
        with pytest.raises(VbnfaultError, match=sentence):
            inject_files([path, tmp_path / "image.png"], scene, tmp_path / "out", progress=False)
        assert (tmp_path / "out" / "image.png").is_file()
        shutil.rmtree(tmp_path / "out")
    shutil.copy(tmp_path / "b.mp4", tmp_path / "b.mov")
    with pytest.raises(InputError, match=r"000001\.png: is named twice"):
        inject_files([tmp_path / "b.mp4", tmp_path / "b.mov"], scene, tmp_path / "out", progress=False)
    with pytest.raises(InputError, match="at most 1000"):
        unpack(tmp_path / "b.mp4", tmp_path / "frames", 1000)
    for name in ("av", "pdr", "pds4_tools"):
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(InputError, match=r"vbnfault\[video\]"):
        unpack(tmp_path / "b.mp4", tmp_path / "frames", 10**6)
    pds3_file(tmp_path / "a.img", np.zeros((20, 24), ">i2"), "MSB_INTEGER")
    pds4_file(tmp_path / "b.img", np.zeros((20, 24), ">i2"), "SignedMSB2")
    for name in ("a.img", "b.img"):
        with pytest.raises(InputError, match=r"vbnfault\[pds\]"):
            read_image(tmp_path / name)


# --- renders without noise ----------------------------------------------------------------------------------------

CAMERA = {"fov_deg": 20.0, "full_well_e": 13500.0, "read_noise_e_rms": 13.0, "exposure_s": 0.01}


@pytest.fixture
def dim() -> Iterator[None]:
    """Define a fault that takes half of the light away."""

    @dataclass(frozen=True, kw_only=True)
    class Dim(vbnfault.Fault):
        fault, model, default, step, after = "test_dim", "simple", True, "electrons", "dust_on_optics"

        def apply(self, quantity: Any, params: Any, context: Any) -> Any:
            return quantity.with_array(quantity.array * np.float32(0.5))

    yield
    forget(__file__)


@pytest.mark.usefixtures("dim")
@pytest.mark.parametrize(("dtype", "white"), [(np.float32, 2.0), (np.uint16, 60000)])
def test_the_camera_adds_the_noise_of_light_and_readout_to_a_render(dtype: Any, white: float) -> None:
    """Of a flat of λ electrons the variance is λ + σ², and of half of its light λ / 2 + σ².

    The variance of n values is χ² with a relative standard deviation of √(2 / n), and the mean is normal with
    √(variance / n); the bounds are four such. Whole numbers add 1/12 DN², which is 0.004 e².
    """
    render = np.full((256, 256, 3), 0.6 * white, dtype)
    keys = {"noise_free": True, "white_dn": white, "black_dn": 0.0}
    result = vbnfault.inject(render, {"test_dim": {}}, camera=CAMERA, seed=3, image_keys=keys)
    assert result.image.dtype == result.clean.dtype == dtype
    detector = ThreeColourDetector(full_well_e=13500.0, read_noise_e_rms=13.0)
    for channel, white_e in enumerate(detector.white_e.tolist()):
        for image, part in ((result.clean, 0.6), (result.image, 0.3)):
            electrons = image[..., channel].astype(np.float64) / white * white_e
            mean, variance = part * white_e, part * white_e + 13.0**2
            assert electrons.mean() == pytest.approx(mean, abs=4 * np.sqrt(variance / electrons.size))
            assert electrons.var() == pytest.approx(variance, rel=4 * np.sqrt(2 / electrons.size))
    colours = result.clean.reshape(-1, 3).astype(np.float64)
    assert np.abs(np.corrcoef(colours.T) - np.eye(3)).max() < 4 / np.sqrt(len(colours))


def test_a_render_saturates_at_white_and_differs_from_its_twin_in_the_masks_only() -> None:
    render = np.full((96, 128), 0.3, np.float32)
    render[:8] = 40.0
    render[80:] = 0.0  # where the readout's noise is below black
    keys = {"noise_free": True}
    given = {"broken_pixels": {"model": "texture"}}
    images = [vbnfault.inject(render, given, camera=CAMERA, seed=s, image_keys=keys) for s in (2, 2, 3)]
    result = images[0]
    assert (result.clean[:8] == 1).all()
    assert result.image.max() <= 1
    assert result.unrecoverable[:8].all()
    assert not result.unrecoverable[8:].any()
    np.testing.assert_array_equal(result.image[~result.masks[0]], result.clean[~result.masks[0]])
    np.testing.assert_array_equal(images[1].image, result.image)
    assert (images[2].clean[8:] != result.clean[8:]).mean() > 0.9
    assert (result.clean[80:] < 0).mean() == pytest.approx(0.5, abs=4 * 0.5 / np.sqrt(16 * 128))
    np.testing.assert_array_equal(vbnfault.inject(render, given, camera=CAMERA).clean, render)


def test_layers_and_depth_of_a_render_reach_the_store(tmp_path: Path) -> None:
    """Blender names channels by layer and pass, and gives 1e10 where no surface is."""
    depth = np.full((64, 96), 1e10, np.float32)
    depth[20:, :] = 55.5
    light = {
        f"ViewLayer.Combined.{c}": np.full((64, 96), v, np.float32)
        for c, v in zip("RGB", (0.2, 0.3, 0.4), strict=True)
    }
    folder = tmp_path / "in"
    folder.mkdir()
    write_exr(folder / "a.exr", {**light, "ViewLayer.Depth.Z": depth, "ViewLayer.Combined.A": depth * 0 + 1})
    write_png(folder / "b.png", np.full((64, 96, 3), 90, np.uint8))
    scene = load_scene("quickstart", {**SCENE, "image.noise_free": True})
    inject_files([folder], scene, tmp_path / "out", labels="zarr", progress=False)
    assert not vbnfault.verify(tmp_path / "out" / "dataset.zarr").problems
    data = vbnfault.open_dataset(tmp_path / "out" / "dataset.zarr")
    np.testing.assert_array_equal(data["depth_m"][0], np.where(depth > 1e9, np.inf, depth))
    assert np.isnan(data["depth_m"][1]).all()
    _, written = read_exr(tmp_path / "out" / "a.exr")
    np.testing.assert_array_equal(written["ViewLayer.Depth.Z"], depth)
    twin = read_image(tmp_path / "out" / "clean" / "a.exr").numbers
    np.testing.assert_array_equal(data["clean"][0, ..., :3], np.rint(np.clip(twin * 255, 0, 255)))
    assert 0 < twin[..., 1].std() < 0.05


def test_an_image_for_which_the_memory_does_not_suffice_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_png(tmp_path / "large.png", np.full((100, 200), 90, np.uint8))
    monkeypatch.setattr("psutil.virtual_memory", lambda: SimpleNamespace(available=10**6))
    with pytest.raises(
        VbnfaultError, match=r"large\.png: has 200 x 100 pixels, which need 2\.8 MB .* 1 MB are free"
    ):
        inject_files([tmp_path / "large.png"], load_scene("quickstart", SCENE), tmp_path / "out", progress=False)
