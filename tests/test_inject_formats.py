"""Faults in images of planetary archives, in the frames of a film, and in noise-free images of other renderers."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from vbnfault.core.errors import InputError
from vbnfault.inject.batch import inject_files
from vbnfault.inject.files import read_image
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


def _pds3(path: Path, stored: np.ndarray, kind: str, *, attached: bool = True, more: str = "") -> int:
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


def _pds4(path: Path, stored: np.ndarray, kind: str, more: str = "") -> int:
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
    begin = _pds3(path, stored, kind, attached=attached)
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
    begin = _pds4(path, stored, kind)
    numbers = _changed_back(path, tmp_path / "out", stored, begin, stored[0].nbytes)
    label = tmp_path / "out" / "frame.xml"
    np.testing.assert_array_equal(pdr.read(str(label))["image"], numbers)
    assert label.read_bytes() == (tmp_path / "frame.xml").read_bytes()


def test_pixels_that_a_label_calls_missing_stay_so(tmp_path: Path) -> None:
    stored = _stored(np.dtype(">i2"))
    stored[4, 6:9] = -32768
    _pds3(tmp_path / "a.img", stored, "MSB_INTEGER", more=" MISSING_CONSTANT = -32768")
    constants = "<Special_Constants><missing_constant>-32768</missing_constant></Special_Constants>"
    _pds4(tmp_path / "b.img", stored, "SignedMSB2", constants)
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
    _pds3(folder / "a.img", flat, "MSB_UNSIGNED_INTEGER", attached=False)
    _pds4(folder / "b.img", flat, "UnsignedMSB2")
    _pds3(folder / "c.img", flat, "MSB_UNSIGNED_INTEGER")
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
        (b"SAMPLE_TYPE", b"SAMPLE_SORT", "frame.lbl: .*SAMPLE_TYPE"),
    ],
)
def test_unusable_labels(old: bytes, new: bytes, sentence: str, tmp_path: Path) -> None:
    path = tmp_path / "frame.img"
    _pds3(path, _stored(np.dtype(">i2")), "MSB_INTEGER", attached=False)
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
