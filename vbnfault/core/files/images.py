"""Read and write image files (PNG, TIFF, OpenEXR), and encode linear light as sRGB.

Arrays have their channels in the order R, G, B, alpha.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Mapping, Sequence, Set
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import InputError, VbnfaultError
from .path_checks import real
from .tiff import HEADS as TIFF_HEADS
from .tiff import check_values, tiff_pixels
from .whole_files import replacing, write_whole

if TYPE_CHECKING:
    import OpenEXR

F32 = NDArray[np.float32]

_PNG = b"\x89PNG\r\n\x1a\n"
_PNG_CHANNELS = {b"\0": 1, b"\2": 3, b"\3": 3, b"\4": 2, b"\6": 4}  # by the type of colour in the header
_NEEDED_CHUNKS = frozenset((b"IHDR", b"PLTE", b"tRNS", b"IDAT", b"IEND"))  # by OpenCV
# Channels of OpenCV's order B, G, R, alpha in the order R, G, B, alpha, and back.
_SWAPPED = {3: [2, 1, 0], 4: [2, 1, 0, 3]}


def decoded_image(data: bytes, most_values: int) -> tuple[F32, F32 | None]:
    """Return the colours of a PNG or TIFF file, float32[y, x, 1 or 3], and its alpha, float32[y, x], or None.

    Whole numbers are divided by the largest of their width, so 1 is white; floating-point numbers stay as they are.

    Parameters
    ----------
    data
        The contents of the file.
    most_values
        The most pixels times channels that are decoded: a small file can hold a huge image.

    Raises
    ------
    InputError
        The file is damaged or of another kind, or has too many values. The message goes on from the file's name.
    """
    if data.startswith(TIFF_HEADS):
        return tiff_pixels(data, most_values)
    if not data.startswith(_PNG):
        raise InputError("is not a PNG or TIFF image")
    image = _decoded_png(data, most_values)
    values = image.astype(np.float32) / np.float32(np.iinfo(image.dtype).max)
    colours = values.shape[2] - (values.shape[2] in (2, 4))
    return values[..., :colours], values[..., -1] if values.shape[2] > colours else None


def png_numbers(data: bytes, most_values: int) -> NDArray[Any]:
    """Return the numbers of a PNG file, uint8 or uint16 [y, x, channel], its alpha last.

    A colour that a chunk tRNS calls transparent is a colour as others, and makes no alpha.

    Raises InputError if it is damaged, too large, has a palette or fewer than 8 bits.
    """
    if not data.startswith(_PNG):
        raise InputError("is no PNG file, whatever its name says")
    if data[25:26] == b"\3" or data[24:25] in (b"\1", b"\2", b"\4"):
        raise InputError("is a PNG file with a palette or packed bits; save it as grey or RGB of 8 or 16 bits")
    image = _decoded_png(data, most_values, _NEEDED_CHUNKS - {b"tRNS"})
    # of grey with alpha OpenCV makes R, G, B and alpha
    return np.ascontiguousarray(image[..., [0, 3]] if data[25:26] == b"\4" else image)


def _decoded_png(data: bytes, most_values: int, kinds: Set[bytes] = _NEEDED_CHUNKS) -> NDArray[Any]:
    """Return what OpenCV makes of some chunks of a PNG file, uint8 or uint16 [y, x, channel]. Raises InputError."""
    if len(data) >= 24:
        columns, rows = struct.unpack(">II", data[16:24])
        check_values(rows, columns, _PNG_CHANNELS.get(data[25:26], 1), most_values)
    chunks = _chunks(data, kinds)
    image = cv2.imdecode(np.frombuffer(chunks, np.uint8), cv2.IMREAD_UNCHANGED) if chunks else None
    if image is None:
        raise InputError("is a damaged PNG file")
    return np.atleast_3d(_swapped(image))


def with_png_numbers(data: bytes, numbers: NDArray[Any], text: str) -> bytes:
    """Return a PNG file with other numbers [y, x, channel], the chunks of the former one, and a text chunk."""
    body = _grey_with_alpha(numbers) if numbers.shape[2] == 2 else png(numbers)
    head = body.index(b"IDAT") - 4
    kept, start = [], len(_PNG)
    while start + 12 <= len(data):
        length, kind = struct.unpack_from(">I4s", data, start)
        if kind not in (b"IHDR", b"IDAT", b"IEND"):
            kept.append(data[start : start + 12 + length])
        start += 12 + length
    words = b"vbnfault\0" + text.encode("latin-1", "replace")
    note = struct.pack(">I4s", len(words), b"tEXt") + words + struct.pack(">I", zlib.crc32(b"tEXt" + words))
    return body[:head] + b"".join(kept) + note + body[head:]


def _grey_with_alpha(numbers: NDArray[Any]) -> bytes:
    """Return a PNG file of grey and alpha, uint8 or uint16 [y, x, 2], which OpenCV does not write."""
    height, width, _ = numbers.shape
    rows = numbers.astype(numbers.dtype.newbyteorder(">")).view(np.uint8).reshape(height, -1)
    lines = np.concatenate([np.zeros((height, 1), np.uint8), rows], axis=1)  # each begins with its filter: none
    header = struct.pack(">IIBBBBB", width, height, 8 * numbers.itemsize, 4, 0, 0, 0)
    out = _PNG
    for kind, content in ((b"IHDR", header), (b"IDAT", zlib.compress(lines.tobytes())), (b"IEND", b"")):
        out += struct.pack(">I4s", len(content), kind) + content + struct.pack(">I", zlib.crc32(kind + content))
    return out


def read_exr(path: Path) -> tuple[OpenEXR.File, dict[str, NDArray[Any]]]:
    """Return an OpenEXR file, and the channels of its first part by name, [y, x] each.

    Raises InputError, whose message goes on from the file's name, if it is damaged or has channels of unlike size.
    """
    import OpenEXR

    try:
        file = OpenEXR.File(str(path), separate_channels=True)
        channels = {name: np.asarray(channel.pixels) for name, channel in file.parts[0].channels.items()}
        if len(OpenEXR.File(str(path), header_only=True).parts) > len(file.parts):  # it leaves out what is damaged
            raise ValueError
    except Exception:  # a damaged file fails anywhere in OpenEXR
        raise InputError("is a damaged OpenEXR file") from None
    if not channels or len({array.shape for array in channels.values()}) > 1:
        raise InputError("is an OpenEXR file without channels, or with channels of unlike size")
    return file, channels


def write_exr_like(path: Path, file: OpenEXR.File, channels: Mapping[str, NDArray[Any]], text: str) -> None:
    """Give the first part of a file of `read_exr` other channels and a text, and write it. Raises as `write_exr`.

    A compression that rounds numbers becomes ZIP, so that all other numbers stay as they are.
    """
    import OpenEXR

    for part in file.parts:
        if part.header["compression"].name.startswith(("PXR24", "B44", "DWA")):
            part.header["compression"] = OpenEXR.ZIP_COMPRESSION
    for name, array in channels.items():
        file.parts[0].channels[name].pixels = np.array(array)
    file.parts[0].header["vbnfault"] = text
    _write_exr(path, file)


def _chunks(png: bytes, kinds: Set[bytes]) -> bytes:
    """Return a PNG file with only the chunks of these kinds; b"" if it is damaged.

    OpenCV allocates what a chunk claims to hold, up to 2 GiB, before it finds the file shorter, and libpng writes
    to standard error what it thinks of the other chunks.
    """
    parts, start = [_PNG], len(_PNG)
    while start + 12 <= len(png):
        length, kind = struct.unpack_from(">I4s", png, start)
        chunk = png[start : start + 12 + length]
        start += 12 + length
        if start > len(png) or zlib.crc32(chunk[4:-4]).to_bytes(4, "big") != chunk[-4:]:
            return b""
        if kind in kinds:
            parts.append(chunk)
        if kind == b"IEND":
            return b"".join(parts) if parts[1].startswith(b"\0\0\0\rIHDR") else b""
    return b""


def write_png(path: Path, image: NDArray[Any], *, smallest: bool = False) -> Path:
    """Write an image as PNG and return its path.

    Parameters
    ----------
    image
        uint8 or uint16, [y, x] or [y, x, channel] with the channels R, G, B and, if any, alpha.
    smallest
        Whether to compress as far as possible, which takes longer.

    Raises
    ------
    OSError
        The file cannot be written.
    """
    write_whole(path, png(image, smallest=smallest))
    return path


def png(image: NDArray[Any], *, smallest: bool = False) -> bytes:
    """Return an image as the content of a PNG file, with the parameters of `write_png`."""
    return _encoded(image, ".png", (cv2.IMWRITE_PNG_COMPRESSION, 9) if smallest else ())


def encoded(rgb: NDArray[np.uint8], ending: str, quality: int = 0) -> bytes:
    """Return an RGB image [y, x, 3] as the content of a file of the kind `ending`: `.png`, `.webp` or `.jpg`.

    `quality`: 1 to 100 of a lossy kind. Raises VbnfaultError if OpenCV cannot encode it.
    """
    lossy = {".webp": cv2.IMWRITE_WEBP_QUALITY, ".jpg": cv2.IMWRITE_JPEG_QUALITY}
    return _encoded(rgb, ending, (lossy[ending], quality) if ending in lossy else (cv2.IMWRITE_PNG_COMPRESSION, 4))


def _encoded(image: NDArray[Any], ending: str, options: Sequence[int]) -> bytes:
    """Return an image as the content of a file. Raises VbnfaultError if OpenCV cannot encode it."""
    done, data = cv2.imencode(ending, np.ascontiguousarray(_swapped(image)), options)
    if not done:
        raise VbnfaultError(f"the image cannot be encoded as {ending}")
    return bytes(data.tobytes())


def write_exr(path: Path, channels: Mapping[str, NDArray[Any]]) -> Path:
    """Write named channels, float16, float32 or uint32 [y, x] of one size, to an OpenEXR file; return its path.

    Raises OSError if the file cannot be opened, and VbnfaultError if writing fails later, as on a full disk.
    """
    import OpenEXR

    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    # OpenEXR accepts writeable arrays only
    _write_exr(path, OpenEXR.File(header, {name: array.copy() for name, array in channels.items()}))
    return path


def _write_exr(path: Path, file: OpenEXR.File) -> None:
    """Write an OpenEXR file. Raises as `write_exr`."""
    with replacing(real(path)) as temporary:
        temporary.write_bytes(b"")  # raises OSError with the system's reason; OpenEXR raises RuntimeError
        try:
            file.write(str(temporary))
        except RuntimeError as error:
            raise VbnfaultError(f"{path}: cannot be written: {error}") from None


def srgb8(linear: ArrayLike) -> NDArray[np.uint8]:
    """Return linear light, clipped to [0, 1], as 8-bit sRGB (IEC 61966-2-1), uint8 in the shape of `linear`."""
    from colour.models import eotf_inverse_sRGB  # takes two seconds to import

    encoded = eotf_inverse_sRGB(np.clip(linear, 0, 1))
    return np.asarray(np.rint(255 * encoded), dtype=np.uint8)


def _swapped(image: NDArray[Any]) -> NDArray[Any]:
    """Return the image with R and B exchanged, if it has colours."""
    order = _SWAPPED.get(image.shape[2]) if image.ndim == 3 else None
    return image if order is None else image[..., order]
