"""Read a frame of raw numbers, as a camera's converter gave them, from a PNG, TIFF or FITS file."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError, in_file
from . import user_files
from .images import decoded_image
from .tiff import HEADS as TIFF_HEADS
from .tiff import check_values, tiff_white

_FITS = (".fits", ".fit", ".fts")
FRAME_TYPES = (".png", ".tif", ".tiff", *_FITS)
_MOST_VALUES = 400_000_000
_PNG_BITS = 24  # place of the bits of a number in the header
_FITS_BLOCK, _FITS_CARD = 2880, 80
_FITS_TYPES = {8: "u1", 16: ">i2", 32: ">i4", 64: ">i8", -32: ">f4", -64: ">f8"}


def read_frame(path: Path) -> tuple[NDArray[Any], dict[str, float]]:
    """Return the raw numbers of a file, [y, x] in DN: uint8, uint16 or, where they are not whole, float32.

    The second result holds `exposure_s` and `temperature_K` where a FITS header says them (EXPTIME, CCD-TEMP).
    Raises InputError for a damaged file, colours, several axes, and numbers that are not finite.
    """
    data = user_files.read_input(path, "data", types=FRAME_TYPES)
    with in_file(str(path)):
        if path.suffix.lower() in _FITS:
            image, header = _fits(data)
        else:
            image, header = _numbers(data), {}
        if not np.isfinite(image).all():
            y, x = np.argwhere(~np.isfinite(image))[0]
            raise InputError(f"holds {image[y, x]} at x = {x}, y = {y}; must hold finite numbers")
    return image, header


def _numbers(data: bytes) -> NDArray[Any]:
    """Return the raw numbers of a PNG or TIFF file of one channel, [y, x].

    Floating-point images stay as they are. Raises InputError for an image with colours.
    """
    values = decoded_image(data, _MOST_VALUES)[0]
    if values.shape[2] > 1 and (values != values[..., :1]).any():
        raise InputError("has colours; must hold the raw numbers of a mosaic, or grey ones")
    grey = values[..., 0]
    # the width, never the numbers: all numbers of a saturated frame of 16 bits are steps of 8 bits
    if data.startswith(TIFF_HEADS):
        white = tiff_white(data, _MOST_VALUES)
    else:
        white = 65535 if data[_PNG_BITS] == 16 else 255  # fewer bits are decoded to 8
    if not white:
        return grey
    whole = np.rint(grey * np.float32(white))
    if whole.min() >= 0 and whole.max() <= 65535:
        return whole.astype(np.uint8 if white <= 255 else np.uint16)
    return whole


def _fits(data: bytes) -> tuple[NDArray[Any], dict[str, float]]:
    """Return the numbers of the first image of a FITS file (FITS standard 4.0), and exposure and temperature.

    Raises InputError for what is no plain image of two axes.
    """
    cards: dict[str, str] = {}
    end = 0
    while "END" not in cards:
        block = data[end : end + _FITS_BLOCK]
        end += _FITS_BLOCK
        if len(block) < _FITS_BLOCK or not data.startswith(b"SIMPLE  ="):
            raise InputError("is no FITS file with an image in its first part")
        for start in range(0, _FITS_BLOCK, _FITS_CARD):
            key, _, value = block[start : start + _FITS_CARD].decode("latin-1").partition("=")
            cards.setdefault(key[:8].strip(), value.partition("/")[0].strip())
    cards = {"BSCALE": "1", "BZERO": "0", **cards}

    def number(key: str, kind: type[float] = float) -> Any:
        try:
            return kind(cards[key].replace("D", "E"))
        except ValueError:
            raise InputError(f"{key} = {cards[key]}: must be a number") from None

    try:
        bits, axes, columns, rows = (number(key, int) for key in ("BITPIX", "NAXIS", "NAXIS1", "NAXIS2"))
    except KeyError:
        raise InputError("is no FITS file with an image in its first part") from None
    known = {
        name: number(key) + more
        for key, name, more in (("EXPTIME", "exposure_s", 0.0), ("CCD-TEMP", "temperature_K", 273.15))
        if key in cards
    }
    if bits not in _FITS_TYPES:
        raise InputError(f"BITPIX = {bits}: must be one of {', '.join(map(str, _FITS_TYPES))}")
    if axes != 2:
        raise InputError(f"has an image of {axes} axes; must have two, as raw frames have")
    check_values(rows, columns, 1, _MOST_VALUES)
    kind = np.dtype(_FITS_TYPES[bits])
    if len(data) < end + rows * columns * kind.itemsize:
        raise InputError("is a damaged FITS file: it ends within its image")
    image = np.frombuffer(data, kind, rows * columns, end).reshape(rows, columns)
    image = image * number("BSCALE") + number("BZERO")
    whole = np.rint(image)
    if (image == whole).all() and whole.min() >= 0 and whole.max() <= 65535:
        return whole.astype(np.uint16), known
    return image.astype(np.float32), known
