"""Describe colour filter arrays: which filter lies over which pixel.

A pattern is a small tile of channel indices. The tile repeats from pixel (0, 0) at the top left. "W" is a pixel
without a colour filter; a monochrome sensor has only W pixels.
"""

from __future__ import annotations

from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from ..core.errors import InputError, shown
from ..core.tables import table_class

F32 = NDArray[np.float32]
Mask = NDArray[np.bool_]


@table_class()
class Pattern:
    """Describe a colour filter array: a tile of channels that repeats over the sensor."""

    name: str = Field(description="name of the pattern")
    channels: tuple[str, ...] = Field(
        min_length=1, description="names of its channels: W alone, or R, G and B among them"
    )
    tile: tuple[tuple[Annotated[int, Field(ge=0)], ...], ...] = Field(
        min_length=1, description="rows of the tile; each pixel holds the index of its channel in channels"
    )

    def __post_init__(self) -> None:
        """Raise ValueError unless the tile is rectangular and holds the index of every channel."""
        tile = [list(row) for row in self.tile]
        if len({len(row) for row in self.tile}) != 1 or not self.tile[0]:
            raise ValueError(f"tile = {tile}: must have rows of one length")
        if {i for row in self.tile for i in row} != set(range(len(self.channels))):
            raise ValueError(
                f"tile = {tile}: must hold every index 0 to {len(self.channels) - 1} of the channels "
                f"{', '.join(self.channels)}"
            )

    @property
    def shape(self) -> tuple[int, int]:
        """Return the number of rows and columns of the tile."""
        return len(self.tile), len(self.tile[0])

    @property
    def is_bayer(self) -> bool:
        """Return whether two green pixels lie on one diagonal of a 2 × 2 tile, red and blue on the other."""
        name = "".join(self.channels[i] for row in self.tile for i in row)
        return self.shape == (2, 2) and name in BAYER

    def index(self, channel: str) -> int:
        """Return the index of a channel by its name."""
        return self.channels.index(channel)


def _pattern(name: str, channels: str, *rows: str) -> Pattern:
    names = tuple(channels.split())
    tile = tuple(tuple(names.index(cell) for cell in row.split()) for row in rows)
    return Pattern(name=name, channels=names, tile=tile)


BAYER = ("RGGB", "BGGR", "GRBG", "GBRG")

# RGBW is Kodak's TrueSense sparse array (Compton & Hamilton, US 2007/0024931): half of the pixels are W, in a
# chequerboard; green lies on one diagonal, blue and red share the other. RGB+NIR is RGGB with the second green
# replaced by a pixel that passes the near infrared only.
PATTERNS: dict[str, Pattern] = {
    **{f.lower(): _pattern(f.lower(), "R G B", f"{f[0]} {f[1]}", f"{f[2]} {f[3]}") for f in BAYER},
    "rgbw": _pattern("rgbw", "R G B W", "W B W G", "B W G W", "W G W R", "G W R W"),
    "rgb_nir": _pattern("rgb_nir", "R G B NIR", "R G", "NIR B"),
    "mono": _pattern("mono", "W", "W"),
}


def pattern(name: str) -> Pattern:
    """Return the colour filter array with this name in `PATTERNS`; case does not matter.

    Raises InputError for an unknown name.
    """
    if name.lower() not in PATTERNS:
        raise InputError(f"pattern = {shown(name)}: must be one of {', '.join(PATTERNS)}")
    return PATTERNS[name.lower()]


def channel_of(pattern: Pattern, shape: tuple[int, int]) -> NDArray[np.uint8]:
    """Return the channel index of each pixel of a (height, width) sensor, uint8[y, x]."""
    rows, columns = (np.arange(n) % size for n, size in zip(shape, pattern.shape, strict=True))
    return np.asarray(pattern.tile, dtype=np.uint8)[rows[:, None], columns]


def sample(planes: F32, pattern: Pattern) -> F32:
    """Return the mosaic float32[y, x] that takes each pixel from the plane of its own channel.

    `planes` float32[y, x, channel] has full resolution, any unit, and the order of `pattern.channels`.
    """
    out = np.empty(planes.shape[:2], np.float32)
    rows, columns = pattern.shape
    for y in range(rows):
        for x in range(columns):
            out[y::rows, x::columns] = planes[y::rows, x::columns, pattern.tile[y][x]]
    return out


def plane_of(raw: NDArray[Any], pattern: Pattern, channel: str, others: F32 | None = None) -> F32:
    """Return one channel of a mosaic [y, x] as float32[y, x]; pixels of other channels keep `others`, or are 0."""
    out = np.zeros(raw.shape, dtype=np.float32) if others is None else others
    index = pattern.index(channel)
    rows, columns = pattern.shape
    for y in range(rows):
        for x in range(columns):
            if pattern.tile[y][x] == index:
                out[y::rows, x::columns] = raw[y::rows, x::columns]
    return out
