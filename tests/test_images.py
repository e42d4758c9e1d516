"""Image files keep their pixels and the order of their channels; sRGB has its published values."""

from __future__ import annotations

import io
import itertools
import re
import struct
import zlib
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
import tifffile

from vbnfault.core.errors import InputError
from vbnfault.core.files.images import decoded_image, srgb8, write_png


@pytest.mark.parametrize("channels", [0, 3, 4])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_a_png_holds_red_first(channels: int, dtype: type, tmp_path: Path) -> None:
    shape = (5, 7, channels) if channels else (5, 7)
    image = np.random.default_rng(1).integers(0, np.iinfo(dtype).max, shape, dtype=dtype)
    path = write_png(tmp_path / "image.png", image, smallest=dtype is np.uint16)
    colours, alpha = decoded_image(path.read_bytes(), 1000)
    again = colours if alpha is None else np.dstack([colours, alpha])
    np.testing.assert_array_equal(again, np.atleast_3d(image).astype(np.float32) / np.float32(np.iinfo(dtype).max))
    if channels:  # OpenCV shows what the file holds, in its own order
        stored = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        np.testing.assert_array_equal(stored[..., 2], image[..., 0])
        np.testing.assert_array_equal(stored[..., 0], image[..., 2])


def test_a_png_that_claims_more_than_it_holds_is_no_image(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """OpenCV would allocate what a chunk claims to hold, here 1.7 GiB, before it finds the file shorter."""
    good = write_png(tmp_path / "image.png", np.arange(35, dtype=np.uint8).reshape(5, 7)).read_bytes()
    start = good.index(b"IDAT") - 4
    wrong = [
        good[:start] + (0x6CE00183).to_bytes(4, "big") + good[start + 4 :],
        good[:-4],
        good[: good.index(b"IEND") - 4],
        good[: start + 9] + b"x" + good[start + 10 :],
    ]
    profile = b"iCCPx\0\0no profile"  # libpng would complain about it
    chunk = (len(profile) - 4).to_bytes(4, "big") + profile + zlib.crc32(profile).to_bytes(4, "big")
    assert decoded_image(good[:start] + chunk + good[start:] + b"and more", 35)[0].shape == (5, 7, 1)
    decoded: list[bytes] = []
    monkeypatch.setattr(cv2, "imdecode", lambda data, flags: decoded.append(data.tobytes()))
    for data in wrong:
        with pytest.raises(InputError, match="is a damaged PNG file"):
            decoded_image(data, 35)
    with pytest.raises(InputError, match="has 7 x 5 pixels of 1 channel"):
        decoded_image(good, 34)
    for data in (b"", b"no image"):
        with pytest.raises(InputError, match="is not a PNG or TIFF image"):
            decoded_image(data, 35)
    assert decoded == []
    assert capfd.readouterr() == ("", "")


# ------------------------------------------------------------------------------------------------------- TIFF


def tiff(image: Any, **options: Any) -> bytes:
    file = io.BytesIO()
    tifffile.imwrite(file, image, **options)
    return file.getvalue()


def patched(data: bytes, tag: int, value: int) -> bytes:
    """Return a TIFF file with another value of a tag."""
    with tifffile.TiffFile(io.BytesIO(data)) as file:
        place = file.pages[0].tags[tag].valueoffset
    return data[:place] + value.to_bytes(2, "little") + data[place + 2 :]


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.uint32, np.float16, np.float32, np.float64])
@pytest.mark.parametrize("planes", ["contig", "separate"])
def test_tiff_of_every_layout_is_read_right(dtype: type, planes: str) -> None:
    """OpenCV takes separate planes of 16 and 32 bits for one, and knows neither BigTIFF nor all sizes of tiles."""
    white = np.iinfo(dtype).max if np.dtype(dtype).kind == "u" else 1
    image = (np.random.default_rng(1).random((50, 70, 3)) * white).astype(dtype)
    expected = image.astype(np.float64) / white
    given = np.moveaxis(image, -1, 0) if planes == "separate" else image
    layouts: list[dict[str, Any]] = [{"rowsperstrip": 7}, {"tile": (16, 16)}, {"tile": (64, 32)}, {"bigtiff": True}]
    for layout, order, packing in itertools.product(layouts, "<>", (None, "zlib", "lzma")):
        predicted = [{}, {"predictor": 2}] if packing and white != 1 else [{}]  # of the differences along a row
        for more in predicted:
            options = layout | more | {"byteorder": order, "compression": packing, "planarconfig": planes}
            colours, alpha = decoded_image(tiff(given, photometric="rgb", **options), 10500)
            assert alpha is None
            # 2⁻²⁴ of a float32; the values are at most 1
            np.testing.assert_allclose(colours, expected, rtol=0, atol=1e-7, err_msg=str(options))


def test_compressions_beyond_those_of_tifffile_are_unpacked() -> None:
    """Blocks packed otherwise: LZW by OpenCV, PackBits and floating-point differences by hand."""
    image = np.random.default_rng(1).integers(0, 65535, (9, 13, 3), dtype=np.uint16)
    expected = image.astype(np.float32) / np.float32(65535)
    for few in (image, image[..., 0]):
        done, lzw = cv2.imencode(
            ".tiff", few[..., ::-1] if few.ndim == 3 else few, [cv2.IMWRITE_TIFF_COMPRESSION, 5]
        )
        assert done
        np.testing.assert_array_equal(decoded_image(lzw.tobytes(), 351)[0], np.atleast_3d(few) / np.float32(65535))
    short = patched(lzw.tobytes(), 279, len(lzw) // 3)  # a block that ends too early
    with pytest.raises(InputError, match="is a damaged TIFF file"):
        decoded_image(short, 351)

    # PackBits: n - 1 and n bytes as they are, or 257 - n and one byte n times
    runs = [bytes([69]) + image[row].tobytes()[:70] + bytes([7]) + image[row].tobytes()[70:] for row in range(9)]
    packed = tiff(iter([b"".join(runs)]), shape=image.shape, dtype="u2", photometric="rgb", compression=8)
    np.testing.assert_array_equal(decoded_image(patched(packed, 259, 32773), 351)[0], expected)
    packed = tiff(iter([bytes([257 - 60, 9, 257 - 31, 8])]), shape=(7, 13), dtype="u1", compression=8)
    np.testing.assert_array_equal(
        decoded_image(patched(packed, 259, 32773), 91)[0].ravel() * 255, [9] * 60 + [8] * 31
    )

    # TIFF Technical Note 3: of each row the first bytes of all numbers, then the second ones, …, and differences
    values = np.random.default_rng(2).random((8, 12)).astype(">f4")
    planes = values.view(np.uint8).reshape(8, 12, 4).transpose(0, 2, 1).reshape(8, 48)
    steps = np.diff(planes, axis=1, prepend=np.zeros((8, 1), np.uint8))
    blocks = iter([zlib.compress(steps.tobytes())])
    whole = tiff(blocks, shape=(8, 12), dtype="f4", compression=8, extratags=[(65000, "H", 1, 3, True)])
    own, predictor = (struct.pack("<HHIH", tag, 3, 1, 3) for tag in (65000, 317))
    np.testing.assert_array_equal(decoded_image(whole.replace(own, predictor), 96)[0][..., 0], values)


def test_grey_of_tiff_means_what_its_tags_say() -> None:
    grey = np.tile(np.linspace(50, 200, 70), (50, 1)).astype(np.uint8)
    value = grey[..., None] / np.float32(255)
    dark = grey[..., None] < 100
    table = np.random.default_rng(1).integers(0, 65535, (3, 256), dtype=np.uint16)
    cases: list[tuple[bytes, Any]] = [
        (tiff(grey, photometric="miniswhite"), 1 - value),
        (tiff(grey < 100, photometric="minisblack"), dark),
        (tiff(grey < 100, photometric="miniswhite"), ~dark),
        (tiff(grey, photometric="palette", colormap=table), (table.T / 65535)[grey]),
        (tiff(grey, photometric="palette", colormap=table // 256), (table // 256).T[grey] / 255),
        *((tiff(grey.astype(kind)), grey[..., None] / np.iinfo(kind).max) for kind in (np.int16, np.int32)),
        (tiff(grey, imagej=True), value),
        # 12 bits, two numbers in three bytes; 4095 is white
        (
            tiff(iter([bytes([0x12, 0x3F, 0xFF])]), shape=(1, 2), dtype="u2", bitspersample=12),
            [[[0x123 / 4095], [1]]],
        ),
    ]
    # tag 274: what the first row and the first column of the file are in the image
    ways = ("yx", "y-x", "-y-x", "-yx", "xy", "x-y", "-x-y", "-xy")
    for number, way in enumerate(ways, start=1):
        turned = value if way.strip("-").startswith("y") else value.swapaxes(0, 1)
        rows, columns = re.findall("-?[xy]", way)
        turned = turned[:: -1 if "-" in rows else 1, :: -1 if "-" in columns else 1]
        cases.append((tiff(grey, extratags=[(274, "H", 1, number, True)]), turned))
    for data, expected in cases:
        np.testing.assert_allclose(decoded_image(data, 50_000)[0], expected, rtol=0, atol=1e-7)


def test_smaller_copies_and_alpha_of_a_tiff() -> None:
    grey = np.arange(3500, dtype=np.uint16).reshape(50, 70)
    file = io.BytesIO()
    with tifffile.TiffWriter(file) as writer:
        writer.write(grey, subifds=1)
        writer.write(grey[::2, ::2], subfiletype=1)
        writer.write(grey[::4, ::4], subfiletype=1)
    np.testing.assert_array_equal(decoded_image(file.getvalue(), 3500)[0][..., 0], grey / np.float32(65535))
    colour = np.random.default_rng(1).integers(0, 255, (5, 7, 4), dtype=np.uint8)
    plain, times_alpha = (tiff(colour, photometric="rgb", extrasamples=k) for k in ("unassalpha", "assocalpha"))
    for data, over in ((plain, 1), (times_alpha, colour[..., 3:] / 255)):
        colours, alpha = decoded_image(data, 140)
        np.testing.assert_allclose(colours, colour[..., :3] / 255 / over, rtol=1e-6)
        np.testing.assert_allclose(alpha, colour[..., 3] / 255, rtol=1e-6)


def test_other_tiff_is_refused_in_a_sentence(capfd: pytest.CaptureFixture[str]) -> None:
    grey = np.full((50, 70), 50, np.uint8)
    several = np.stack([grey, grey])
    done, by_jpeg = cv2.imencode(".tiff", grey, [cv2.IMWRITE_TIFF_COMPRESSION, 7])
    assert done
    scale = '<GDALMetadata><Item name="SCALE" sample="0" role="scale">0.1</Item></GDALMetadata>'
    good = tiff(grey)
    predictor = [struct.pack("<HHIH", tag, 3, 1, 2) for tag in (65000, 317)]
    cases: list[tuple[bytes, str]] = [
        (tiff(np.stack([grey] * 4, axis=-1), photometric="separated"), "colours of the kind SEPARATED"),
        (tiff(np.stack([grey] * 5, axis=-1), photometric="minisblack", planarconfig="contig"), "with 5 bands"),
        (tiff(grey.astype(np.complex64)), "no real numbers"),
        (tiff(several, photometric="minisblack"), "of several images"),
        (tiff(several, photometric="minisblack", truncate=True), "of several images"),
        (tiff(several, imagej=True), "of several images"),
        (tiff(np.stack([grey] * 16), volumetric=True, photometric="minisblack"), "of several images"),
        (by_jpeg.tobytes(), "the compression JPEG; must be none, LZW, PackBits, deflate or LZMA"),
        (tiff(grey, extratags=[(42113, "s", 0, "50", True)]), "marks 3500 of its values as missing"),
        (tiff(grey, extratags=[(42112, "s", 0, scale, True)]), "a scale or an offset"),
        (tiff(grey, extratags=[(65000, "H", 1, 2, True)]).replace(*predictor), "differences along its rows"),
        (good[:-9], "ends before its last pixel"),
        (good[:20], "damaged TIFF"),
        (tiff(iter([zlib.compress(bytes(3000))]), shape=(50, 70), dtype="u1", compression=8), "damaged TIFF"),
    ]
    for data, words in cases:
        with pytest.raises(InputError, match=rf"^is a (damaged )?TIFF file.*|{words}") as caught:
            decoded_image(data, 50_000)
        assert words in str(caught.value)
    with pytest.raises(InputError, match=r"has 70 x 50 pixels of 1 channel.*at most 3499"):
        decoded_image(good, 3499)
    assert capfd.readouterr() == ("", "")


def test_a_small_tiff_of_much_data_takes_no_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    """A block of deflate that holds a gigabyte is unpacked to the bytes of its pixels only."""
    sizes: list[int] = []

    class Counted:
        def decompress(self, data: bytes, size: int) -> bytes:
            sizes.append(size)
            return zlib.decompressobj().decompress(data, size)

    block = zlib.compress(bytes(10_000_000))
    monkeypatch.setattr("vbnfault.core.files.tiff.zlib", SimpleNamespace(decompressobj=Counted))
    decoded_image(tiff(iter([block]), shape=(50, 70), dtype="u1", compression=8), 3500)
    assert sizes == [3500]


def test_srgb_has_the_values_of_its_standard() -> None:
    # IEC 61966-2-1: 12.92 L up to 0.0031308, then 1.055 L^(1/2.4) - 0.055; 0.5 is encoded as 0.7354 of white
    np.testing.assert_array_equal(
        srgb8([-1.0, 0.0, 0.001, 0.5, 1.0, 2.0]), [0, 0, round(255 * 0.01292), 188, 255, 255]
    )
    assert srgb8(np.zeros((2, 3), np.float32)).shape == (2, 3)
