"""Read and write image files (PNG, TIFF, OpenEXR), and encode linear light as sRGB.

Arrays have their channels in the order R, G, B, alpha.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from .errors import VbnfaultError
from .path_checks import real
from .whole_files import replacing, write_whole

_PNG = b"\x89PNG\r\n\x1a\n"
# Channels of OpenCV's order B, G, R, alpha in the order R, G, B, alpha, and back.
_SWAPPED = {3: [2, 1, 0], 4: [2, 1, 0, 3]}


def decoded_image(data: bytes) -> NDArray[Any] | None:
    """Return the pixels of a PNG or TIFF file as stored, [y, x] or [y, x, channel]; None for any other data.

    A small file can hold a huge image: compare `image_size_px` with a limit first.
    """
    # OpenCV allocates what a chunk of a PNG claims to hold, up to 2 GiB, before it finds the file shorter
    if not data or (data.startswith(_PNG) and not _holds_its_chunks(data)):
        return None
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error:  # more pixels than OpenCV accepts
        return None
    return None if image is None else _swapped(np.asarray(image))


def image_size_px(data: bytes) -> tuple[int, int]:
    """Return the width and height in the header of a PNG or TIFF file; (0, 0) if the file is neither."""
    if data.startswith(_PNG) and len(data) >= 24:
        width_px, height_px = struct.unpack(">II", data[16:24])
        return width_px, height_px
    if data[:4] not in (b"II*\0", b"MM\0*"):
        return 0, 0
    order = "<" if data[:1] == b"I" else ">"
    try:
        (start,) = struct.unpack_from(f"{order}I", data, 4)
        (count,) = struct.unpack_from(f"{order}H", data, start)
        sides: dict[int, int] = {}
        for k in range(count):
            tag, kind, _ = struct.unpack_from(f"{order}HHI", data, start + 2 + 12 * k)
            (value,) = struct.unpack_from(f"{order}{'H' if kind == 3 else 'I'}", data, start + 10 + 12 * k)
            sides[tag] = value
    except struct.error:  # truncated file
        return 0, 0
    return sides.get(256, 0), sides.get(257, 0)


def _holds_its_chunks(png: bytes) -> bool:
    """Return whether a PNG file has the length that the headers of its chunks claim, as far as its last chunk."""
    start = len(_PNG)
    while start + 12 <= len(png):
        length, kind = struct.unpack_from(">I4s", png, start)
        start += 12 + length
        if kind == b"IEND":
            return start <= len(png)
    return False


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
    options = [cv2.IMWRITE_PNG_COMPRESSION, 9] if smallest else []
    done, data = cv2.imencode(".png", np.ascontiguousarray(_swapped(image)), options)
    if not done:
        raise VbnfaultError(f"{path}: the image cannot be encoded as PNG")
    write_whole(path, data.tobytes())
    return path


def indexed_png(values: NDArray[np.uint8], palette: Sequence[tuple[int, int, int, int]]) -> bytes:
    """Return a PNG file of two bits a pixel: small masks of up to four colours.

    Parameters
    ----------
    values
        Number of the colour of each pixel, 0 to 3, [y, x].
    palette
        Up to four colours as R, G, B, opacity, 0 to 255.
    """
    height, width = values.shape
    padded = np.zeros((height, -(-width // 4) * 4), np.uint8)
    padded[:, :width] = values
    four = padded.reshape(height, -1, 4)
    packed = four[..., 0] << 6 | four[..., 1] << 4 | four[..., 2] << 2 | four[..., 3]
    lines = np.pad(packed, ((0, 0), (1, 0)))  # a line begins with the number of its filter, 0 for none
    chunks = {
        b"IHDR": struct.pack(">IIBBBBB", width, height, 2, 3, 0, 0, 0),
        b"PLTE": bytes(value for colour in palette for value in colour[:3]),
        b"tRNS": bytes(colour[3] for colour in palette),
        b"IDAT": zlib.compress(lines.tobytes(), 9),
        b"IEND": b"",
    }
    parts = [
        struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
        for kind, data in chunks.items()
    ]
    return b"".join([_PNG, *parts])


def encoded(rgb: NDArray[np.uint8], ending: str, quality: int = 0) -> bytes:
    """Return an RGB image [y, x, 3] as the content of a file of the kind `ending`: `.png`, `.webp` or `.jpg`.

    `quality`: 1 to 100 of a lossy kind. Raises VbnfaultError if OpenCV cannot encode it.
    """
    lossy = {".webp": cv2.IMWRITE_WEBP_QUALITY, ".jpg": cv2.IMWRITE_JPEG_QUALITY}
    options = [lossy[ending], quality] if ending in lossy else [cv2.IMWRITE_PNG_COMPRESSION, 4]
    done, data = cv2.imencode(ending, np.ascontiguousarray(_swapped(rgb)), options)
    if not done:
        raise VbnfaultError(f"the image cannot be encoded as {ending}")
    return bytes(data.tobytes())


def write_exr(path: Path, channels: Mapping[str, NDArray[Any]]) -> Path:
    """Write named channels, float16, float32 or uint32 [y, x] of one size, to an OpenEXR file; return its path.

    Raises OSError if the file cannot be opened, and VbnfaultError if writing fails later, as on a full disk.
    """
    import OpenEXR

    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    with replacing(real(path)) as temporary:
        temporary.write_bytes(b"")  # raises OSError with the system's reason; OpenEXR raises RuntimeError
        try:
            # OpenEXR accepts writeable arrays only
            OpenEXR.File(header, {name: array.copy() for name, array in channels.items()}).write(str(temporary))
        except RuntimeError as error:
            raise VbnfaultError(f"{path}: cannot be written: {error}") from None
    return path


def srgb8(linear: ArrayLike) -> NDArray[np.uint8]:
    """Return linear light, clipped to [0, 1], as 8-bit sRGB (IEC 61966-2-1), uint8 in the shape of `linear`."""
    from colour.models import eotf_inverse_sRGB  # takes two seconds to import

    encoded = eotf_inverse_sRGB(np.clip(linear, 0, 1))
    return np.asarray(np.rint(255 * encoded), dtype=np.uint8)


def _swapped(image: NDArray[Any]) -> NDArray[Any]:
    """Return the image with R and B exchanged, if it has colours."""
    order = _SWAPPED.get(image.shape[2]) if image.ndim == 3 else None
    return image if order is None else image[..., order]
