"""Read the pixels of a TIFF file of any layout: strips or tiles, colours together or by plane, TIFF or BigTIFF.

`tifffile` reads the tags. It cannot unpack LZW and the floating-point predictor without `imagecodecs`, a package of
80 MB. So blocks are unpacked here, by libraries that vbnfault needs anyway, and never to more bytes than a block
has pixels for. What would have to be guessed is refused in a sentence.
"""

from __future__ import annotations

import io
import itertools
import logging
import lzma
import re
import struct
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..errors import InputError

if TYPE_CHECKING:
    from tifffile import TiffFile, TiffPage

F32 = NDArray[np.float32]
Bytes = NDArray[np.uint8]

HEADS = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")
_WHITE_IS_0, _GREY, _RGB, _PALETTE = 0, 1, 2, 3
_NONE, _LZW, _DEFLATE, _PACKBITS, _LZMA = 1, 5, (8, 32946), 32773, 34925
_ASSOCIATED_ALPHA, _ALPHA = 1, 2
_GDAL_METADATA, _GDAL_NODATA = 42112, 42113
_MOST_PAGES = 64  # looked at: an image and its smaller copies are fewer


def tiff_pixels(data: bytes, most_values: int) -> tuple[F32, F32 | None]:
    """Return the colours of a TIFF file, float32[y, x, 1 or 3], and its alpha, float32[y, x], or None.

    Whole numbers are divided by the largest of their width, so 1 is white; floating-point numbers stay as they are.

    Raises
    ------
    InputError
        The file is damaged, has more than `most_values` values, or holds no single image of grey or RGB.
    """
    with _usable_page(data, most_values) as page:
        return _colours(_samples(page, data, most_values), page)


def tiff_numbers(data: bytes, most_values: int) -> NDArray[Any]:
    """Return the numbers of a TIFF file as stored, [y, x, sample] of 8 to 64 bits.

    Raises InputError as `tiff_pixels`, and for a palette, inverted grey and packed bits.
    """
    with _usable_page(data, most_values) as page:
        if page.photometric in (_WHITE_IS_0, _PALETTE) or page.bitspersample not in (8, 16, 32, 64):
            raise InputError(
                "is a TIFF file with a palette, inverted grey or packed bits; save it as plain grey or RGB"
            )
        return _samples(page, data, most_values)


def tiff_white(data: bytes, most_values: int) -> int:
    """Return the largest number of a TIFF file's width, which `tiff_pixels` makes 1, or 0 for floating-point ones.

    A palette counts as one of 8 bits. Raises InputError as `tiff_pixels`.
    """
    with _usable_page(data, most_values) as page:
        if page.photometric == _PALETTE:
            return 255
        return 0 if page.sampleformat == 3 else _largest(page)


@contextmanager
def _usable_page(data: bytes, most_values: int) -> Iterator[TiffPage]:
    """Open a file for a block that reads its only page. Raises InputError as `tiff_pixels`, also of the block."""
    import tifffile  # takes 0.1 s to import

    try:
        with _without_log_lines(), tifffile.TiffFile(io.BytesIO(data)) as file:
            page = _only_page(file)
            check_values(page.imagelength, page.imagewidth, page.samplesperpixel, most_values)
            _check_kind(page)
            yield page
    except InputError:
        raise
    except Exception:  # a damaged file fails anywhere in tifffile, with errors of any type
        raise InputError("is a damaged TIFF file") from None


def with_numbers(data: bytes, numbers: NDArray[Any], text: str) -> bytes:
    """Return a TIFF file with other numbers, [y, x, sample] in the data type of the former ones.

    The new blocks are appended without compression, and the tags that say where and how they lie are overwritten,
    so that all other tags stay as they are. `text` becomes the tag 270, ImageDescription, if the file has none.
    """
    import tifffile

    stream = io.BytesIO(data)
    with _without_log_lines(), tifffile.TiffFile(stream, mode="r+") as file:
        page, offsets, counts = _only_page(file), [], []
        kind = numbers.dtype.newbyteorder(file.byteorder)
        stream.seek(0, io.SEEK_END)
        for place, shape in _blocks(page):
            block, part = np.zeros(shape, kind), numbers[place]
            block[: part.shape[0], : part.shape[1]] = part
            stream.seek(stream.tell() % 2, io.SEEK_CUR)  # blocks start at even offsets
            offsets.append(stream.tell())
            counts.append(stream.write(block.tobytes()))
        where, sizes = (324, 325) if page.is_tiled else (273, 279)
        for tag, value in ((where, tuple(offsets)), (sizes, tuple(counts)), (259, 1), (266, 1), (317, 1)):
            if tag in page.tags:
                page.tags[tag].overwrite(value[0] if isinstance(value, tuple) and len(value) == 1 else value)
        if 270 not in page.tags:
            _describe(stream, page, text)
        elif not str(page.tags[270].value).strip():
            page.tags[270].overwrite(text)
    return stream.getvalue()


def _describe(stream: io.BytesIO, page: TiffPage, text: str) -> None:
    """Append the directory of a page with the tag 270, ImageDescription, and write its new offset over the old."""
    order, big = page.parent.byteorder, page.parent.is_bigtiff
    number, offset = (f"{order}Q", f"{order}Q") if big else (f"{order}H", f"{order}I")
    head, inline = struct.calcsize(number), struct.calcsize(offset)
    entry = 4 + 2 * inline

    def value(kind: str, position: int) -> int:
        return int(struct.unpack_from(kind, stream.getbuffer(), position)[0])

    def append(data: bytes) -> int:
        stream.seek(0, io.SEEK_END)
        position = stream.seek(stream.tell() % 2, io.SEEK_CUR)  # everything begins at an even offset
        stream.write(data)
        return position

    count = value(number, page.offset)
    start, stop = page.offset + head, page.offset + head + count * entry
    directory = stream.getvalue()[start : stop + inline]
    words = text.encode("ascii", "replace") + b"\0"
    field = words.ljust(inline, b"\0") if len(words) <= inline else struct.pack(offset, append(words))
    tag = struct.pack(f"{order}HH{offset[1]}", 270, 2, len(words)) + field
    tags = [directory[k : k + entry] for k in range(0, count * entry, entry)] + [tag]
    tags.sort(key=lambda data: int(struct.unpack_from(f"{order}H", data)[0]))
    moved = append(struct.pack(number, count + 1) + b"".join(tags) + directory[-inline:])
    position = 8 if big else 4
    while value(offset, position) != page.offset:  # of the directories before this one
        before = value(offset, position)
        position = before + head + value(number, before) * entry
    struct.pack_into(offset, stream.getbuffer(), position, moved)


def check_values(rows: int, columns: int, channels: int, most_values: int) -> None:
    """Raise InputError for an image without pixels, or with too many of them to decode."""
    if not 0 < rows * columns * channels <= most_values:
        raise InputError(
            f"has {columns} x {rows} pixels of {channels} channel(s); pixels times channels must be at most "
            f"{most_values}"
        )


@contextmanager
def _without_log_lines() -> Iterator[None]:
    """Keep tifffile and OpenCV from writing to standard error about a file that is refused in a sentence."""
    logger, level = logging.getLogger("tifffile"), cv2.utils.logging.getLogLevel()
    before, logger.disabled = logger.disabled, True
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        yield
    finally:
        logger.disabled = before
        cv2.utils.logging.setLogLevel(level)


def _only_page(file: TiffFile) -> TiffPage:
    """Return the page of the image; smaller copies do not count. Raises InputError for several images."""
    every: list[Any] = list(itertools.islice(file.pages, _MOST_PAGES))
    pages = [page for page in every if not page.subfiletype & 1]
    if any(page.subfiletype & 4 for page in pages):
        raise InputError("is a TIFF file with a mask of missing pixels; fill them and save it without the mask")
    # ImageJ and tifffile name further pages in a text only
    several = len(pages) > 1 or ((file.is_imagej or file.is_shaped) and file.series[0].size != pages[0].size)
    if several or pages[0].imagedepth != 1:
        raise InputError("is a TIFF file of several images; save the one that is meant alone")
    return pages[0]  # type: ignore[no-any-return]


def _check_kind(page: TiffPage) -> None:
    """Raise InputError where the numbers of a page are no grey or RGB, or where their meaning would be a guess."""
    extra = page.samplesperpixel - _colour_count(page)
    widths = {*np.ravel(page.tags.valueof(258, 1))}, {*np.ravel(page.tags.valueof(339, 1))}
    is_grey_and_more = page.photometric != _RGB and extra and not (extra == 1 and _has_alpha(page))
    wrong = None
    if page.photometric not in (_WHITE_IS_0, _GREY, _RGB, _PALETTE):
        wrong = f"colours of the kind {_name(page.photometric)} (SEPARATED is CMYK); must be grey or RGB"
    elif page.compression not in (_NONE, _LZW, *_DEFLATE, _PACKBITS, _LZMA):
        wrong = f"the compression {_name(page.compression)}; must be none, LZW, PackBits, deflate or LZMA"
    elif page.sampleformat not in (1, 2, 3) or max(map(len, widths)) > 1:
        wrong = "samples that are no real numbers of one kind and width"
    elif page.photometric in (_WHITE_IS_0, _PALETTE) and page.sampleformat != 1:
        wrong = "inverted or indexed values that are signed or no whole numbers"
    elif page.fillorder != 1 and page.compression != _NONE:
        wrong = "packed bits in reverse order; save it with deflate"
    elif page.predictor != 1 and page.compression in (_NONE, _PACKBITS):  # libtiff does not undo them
        wrong = "differences along its rows, which its compression does not know; save it with deflate"
    elif extra < 0 or is_grey_and_more:
        wrong = f"{page.samplesperpixel} bands that it does not call red, green and blue; say so in it, or save one"
    elif re.search('role="(scale|offset)"', str(page.tags.valueof(_GDAL_METADATA, ""))):
        wrong = "a scale or an offset of its values in a tag of GDAL; apply it with gdal_translate -unscale"
    if wrong:
        raise InputError(f"is a TIFF file with {wrong}")


def _colour_count(page: TiffPage) -> int:
    """Return how many of a pixel's samples are its colour."""
    return 3 if page.photometric == _RGB else 1


def _has_alpha(page: TiffPage) -> bool:
    """Return whether the sample behind the colours is alpha."""
    return page.extrasamples[:1] in ((_ASSOCIATED_ALPHA,), (_ALPHA,))


def _name(value: Any) -> str:
    """Return the name of a photometric interpretation or a compression, or its number."""
    return getattr(value, "name", str(value))


def _blocks(page: TiffPage) -> Iterator[tuple[tuple[slice, slice, slice], tuple[int, int, int]]]:
    """Yield the place of each block in a page's numbers [y, x, sample], and its own shape, which may be larger."""
    height, width, every = page.imagelength, page.imagewidth, page.samplesperpixel
    together = every if page.planarconfig == 1 else 1  # samples of one block
    tall, wide = (page.tilelength, page.tilewidth) if page.is_tiled else (min(page.rowsperstrip, height), width)
    for plane in range(0, every, together):
        for top in range(0, height, tall):
            rows = tall if page.is_tiled else min(tall, height - top)
            for left in range(0, width, wide):
                place = slice(top, top + rows), slice(left, left + wide), slice(plane, plane + together)
                yield place, (rows, wide, together)


def _samples(page: TiffPage, data: bytes, most_values: int) -> NDArray[Any]:
    """Return the numbers of a page as stored, [y, x, sample]. Raises InputError."""
    _, (tall, wide, together) = next(_blocks(page))
    check_values(tall, wide, together, most_values)
    row_bytes = -(-wide * together * page.bitspersample // 8)
    out = np.zeros((page.imagelength, page.imagewidth, page.samplesperpixel), page.dtype)
    # other numbers of offsets than of blocks raise an error, which stands for a damaged file
    blocks = zip(_blocks(page), page.dataoffsets, page.databytecounts, strict=True)
    for (place, (rows, _, _)), offset, count in blocks:
        if count == 0:
            raise InputError("is a TIFF file without data in some of its blocks; save it with all of them")
        block = _unpacked(page, data[offset : offset + count], rows, row_bytes, count)
        part = out[place]
        part[...] = _unpredicted(page, block, wide, together)[: part.shape[0], : part.shape[1]]
    if _GDAL_NODATA in page.tags:
        missing = int(np.count_nonzero(out == np.float64(page.tags[_GDAL_NODATA].value)))
        if missing:
            raise InputError(f"is a TIFF file that marks {missing} of its values as missing; fill them")
    return out


def _unpacked(page: TiffPage, block: bytes, rows: int, row_bytes: int, count: int) -> Bytes:
    """Return the bytes of a block, uint8[row, byte]. Raises an error for one that does not hold them all."""
    size, kind = rows * row_bytes, page.compression
    if len(block) < count:
        raise InputError("is a TIFF file that ends before its last pixel")
    if kind in (_LZW, _PACKBITS):
        return _by_opencv(block, kind, rows, row_bytes)
    if kind in _DEFLATE:
        block = zlib.decompressobj().decompress(block, size)
    elif kind == _LZMA:
        block = lzma.LZMADecompressor().decompress(block, size)
    values = np.frombuffer(block, np.uint8, size)
    if page.fillorder != 1:
        values = np.packbits(np.unpackbits(values, bitorder="little"))
    return values.reshape(rows, row_bytes)


def _by_opencv(block: bytes, kind: int, rows: int, row_bytes: int) -> Bytes:
    """Return an unpacked block, uint8[row, byte], by giving it to OpenCV as a whole file of grey."""
    wide = 2 - row_bytes % 2  # bytes of a grey value: OpenCV reports too few data for two, but not for one
    tags = {
        256: row_bytes // wide,
        257: rows,
        258: 8 * wide,
        259: kind,
        262: 1,
        273: 0,
        277: 1,
        278: rows,
        279: len(block),
    }
    tags[273] = 8 + 2 + 12 * len(tags) + 4
    head = struct.pack("<2sHIH", b"II", 42, 8, len(tags))
    head += b"".join(struct.pack("<HHII", tag, 4, 1, value) for tag, value in tags.items()) + bytes(4)
    image = cv2.imdecode(np.frombuffer(head + block, np.uint8), cv2.IMREAD_UNCHANGED)
    return np.ascontiguousarray(image).view(np.uint8).reshape(rows, row_bytes)


def _unpredicted(page: TiffPage, block: Bytes, wide: int, together: int) -> NDArray[Any]:
    """Return a block's numbers, [y, x, sample], from its bytes [y, byte], which may be differences along a row."""
    bits, kind = page.bitspersample, {1: "u", 2: "i", 3: "f"}[page.sampleformat]
    rows, order = len(block), page.parent.byteorder
    if (
        page.predictor == 3 and kind == "f"
    ):  # of floating-point numbers: differences of bytes, the first byte of all numbers first
        steps = block.reshape(rows, -1, together).cumsum(axis=1, dtype=np.uint8)
        planes = steps.reshape(rows, bits // 8, wide * together)
        values = np.ascontiguousarray(np.moveaxis(planes, 1, -1)).view(f">f{bits // 8}")
        return values.reshape(rows, wide, together)
    if bits in (8, 16, 32, 64):
        values = block.view(f"{order}{'u' if page.predictor == 2 else kind}{bits // 8}")
    elif kind == "u" and bits < 32:  # packed without gaps, the highest bit first
        ones = np.unpackbits(block, axis=1)[:, : wide * together * bits].reshape(rows, -1, bits)
        values = ones @ (1 << np.arange(bits - 1, -1, -1, dtype=np.uint32))
    else:
        raise InputError(f"is a TIFF file with samples of {bits} bits; must be 8, 16, 32 or 64")
    values = values.reshape(rows, wide, together)
    if page.predictor == 2:
        values = values.astype(values.dtype.newbyteorder("=")).cumsum(axis=1, dtype=f"u{values.itemsize}")
        values &= np.uint64(2**bits - 1).astype(values.dtype)
        values = values if kind == "u" else values.view(f"{kind}{values.itemsize}")
    elif page.predictor != 1:
        raise InputError(f"is a TIFF file with the predictor {page.predictor}; must be 1, 2 or 3")
    return values


def _largest(page: TiffPage) -> int:
    """Return the largest number of a page's width and kind; 1 for floating-point numbers."""
    return {1: 2**page.bitspersample - 1, 2: 2 ** (page.bitspersample - 1) - 1, 3: 1}[page.sampleformat]


def _colours(samples: NDArray[Any], page: TiffPage) -> tuple[F32, F32 | None]:
    """Return the colours of a page, float32[y, x, 1 or 3], and its alpha, from its numbers [y, x, sample]."""
    places = (page.tags.valueof(274, 1) - 1) % 8  # 0: the first row is the top and the first column the left
    if places >= 4:
        samples = samples.swapaxes(0, 1)
    samples = samples[:: -1 if places % 4 in (2, 3) else 1, :: -1 if places % 4 in (1, 2) else 1]
    if page.photometric == _PALETTE:
        table = np.asarray(page.colormap)
        full = 255 if table.max() < 256 else 65535  # some programs write 8 bits, as libtiff notices too
        return (table[:, samples[..., 0]].transpose(1, 2, 0) / np.float32(full)).astype(np.float32), None
    values = samples.astype(np.float32) / np.float32(_largest(page))
    if page.photometric == _WHITE_IS_0:
        values[..., 0] = 1 - values[..., 0]
    count = _colour_count(page)
    colours = values[..., :count]
    if not _has_alpha(page):
        return colours, None
    alpha = values[..., count]
    if page.extrasamples[0] == _ASSOCIATED_ALPHA:  # the colours are multiplied by alpha
        colours = np.divide(colours, alpha[..., None], out=np.zeros_like(colours), where=alpha[..., None] > 0)
    return colours, alpha
