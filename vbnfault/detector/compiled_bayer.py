"""Show Bayer mosaics as images with one compiled kernel, for Malvar's method.

Every value takes the steps of `demosaic.demosaic` and `demosaic.bounded_at_edges`, and of `display.levels`, in
the same precision, so that it has the bits that these steps give one after the other
(tests/test_detector_bayer.py). The sums of Malvar's method are exact in single precision for whole numbers of 16
bits, so their order does not matter.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core import buffers
from ..core.llvm import backend
from .compiled import luminance
from .demosaic import HARD_NOISE, HARD_RATIO, LEAST_PX, Mask, Method, colour_sites
from .display import Display
from .mosaic import Pattern

Raw = NDArray[np.uint16]
U8 = NDArray[np.uint8]
Lanes = list[list[Any]]

_MOST_BITS = 15  # of the raw numbers; the 16th marks saturated pixels
_LARGEST = 2**_MOST_BITS - 1
_HALO = 2  # pixels around a tile on which its colours depend


def serves(mosaic: NDArray[Any], pattern: Pattern, method: Method) -> bool:
    """Return whether `image` can show a mosaic [y, x] that is demosaiced by this method."""
    if mosaic.dtype != np.uint16 or not pattern.is_bayer or method != "malvar" or min(mosaic.shape) < LEAST_PX:
        return False
    return int(mosaic.max()) <= _LARGEST


def image(mosaic: Raw, pattern: Pattern, saturated: Raw, display: Display) -> U8:
    """Return R, G, B and the luminance of a Bayer mosaic by Malvar's method, uint8[y, x, 4].

    Parameters
    ----------
    mosaic
        Raw numbers, uint16[y, x], which `serves` accepts.
    pattern
        Its Bayer pattern.
    saturated
        Raw number from which each pixel counts as saturated, uint16[y, x].
    display
        Numbers of the exposure.
    """
    height, width = mosaic.shape
    down, across = -(-height // 2), -(-width // 2)  # tiles
    values, lit = _neighbourhoods(mosaic, mosaic >= saturated, (down, across))
    tile = _Tile(display, pattern)
    # one array for each row of the tiles: several scatters into one array would be as many kernels
    rows = [_pair(*(tile.levels(values, lit, y, x) for x in (0, 1))) for y in (0, 1)]
    dr = backend().dr
    dr.eval(rows)
    dr.sync_thread()
    whole: U8 = buffers.empty((2 * down, 2 * across, 4), np.uint8)
    for y, of_row in enumerate(rows):
        of_tiles = np.array(of_row, copy=False).reshape(down, across + _HALO)[:, :across]
        whole[y::2].reshape(down, across, 8).view(np.uint64)[..., 0] = of_tiles
    return np.ascontiguousarray(whole[:height, :width])


def _neighbourhoods(mosaic: Raw, saturated: Mask, tiles: tuple[int, int]) -> tuple[Lanes, Lanes]:
    """Return the 6 × 6 raw numbers in and around each tile by row and column, twice.

    In the second table, saturated numbers are infinite, since their light has no upper bound. Each row of tiles has
    `_HALO` more lanes than tiles. So the neighbours of all lanes on one side are the same array from another start,
    which a kernel reads in a row: to gather the numbers takes half as long again.
    """
    be = backend()
    dr = be.dr
    down, across = tiles
    words = across + _HALO
    # the highest bit says whether a pixel is saturated; to fetch it on its own would take as long as the rest
    marked = mosaic | saturated.astype(np.uint16) << np.uint16(_MOST_BITS)
    of_parity = _in_words(marked, tiles)
    values: Lanes = []
    lit: Lanes = []
    for dy in range(2 + 2 * _HALO):
        starts = [dy // 2 * words + dx for dx in range(1 + _HALO)]
        in_row = [be.UInt32(of_parity[dy % 2, start : start + down * words]) for start in starts]
        halves = [(word, bit) for word in in_row for bit in (0, 16)]
        values.append([be.Float(be.Int32((word >> bit) & _LARGEST)) for word, bit in halves])
        marks = [(word & (1 << _MOST_BITS + bit)) != 0 for word, bit in halves]
        lit.append([dr.select(mark, be.Float(np.inf), v) for mark, v in zip(marks, values[-1], strict=True)])
    return values, lit


def _pair(low: Any, high: Any) -> Any:
    """Return two words of 32 bits as one of 64."""
    UInt64 = backend().UInt64
    return UInt64(low) | UInt64(high) << 32


def _in_words(array: Raw, tiles: tuple[int, int]) -> NDArray[np.uint32]:
    """Return pairs of neighbouring pixels of the even and of the odd rows as words, uint32[2, n].

    The rows are those of whole tiles with a mirrored halo around them, one after the other. At least `_HALO` words
    that no tile uses follow. Both halves begin at a multiple of 64 bytes, so that frames of a width share a kernel.
    """
    height, width = array.shape
    down, across = (2 * n for n in tiles)
    padded = cv2.copyMakeBorder(
        array, _HALO, _HALO + down - height, _HALO, _HALO + across - width, cv2.BORDER_REFLECT_101
    ).view(np.uint32)
    used = padded.size // 2
    out = buffers.aligned(buffers.empty((2, -(-(used + _HALO) // 16) * 16), np.uint32))
    for parity, words in enumerate(out):
        words[:used].reshape(-1, padded.shape[1])[...] = padded[parity::2]
        words[used:] = 0
    return out


class _Tile:
    """Compute the levels of a tile of 2 × 2 pixels from the 6 × 6 pixels in and around it.

    All numbers of the sensor are device arrays: as literals they would give each exposure a kernel of its own.
    """

    def __init__(self, display: Display, pattern: Pattern) -> None:
        be = backend()
        self._red, self._blue = colour_sites(pattern)
        self._black, self._noise = (
            be.dr.opaque(be.Float, float(np.float32(v))) for v in (display.black_dn, HARD_NOISE * display.noise_dn)
        )
        self._scale = [be.dr.opaque(be.Float64, v) for v in display.scale]

    def levels(self, values: Lanes, lit: Lanes, y: int, x: int) -> Any:
        """Return R, G, B and the luminance of one pixel in a word, R in its lowest byte.

        `values` are the raw numbers by row and column, and `lit` the same with saturated ones infinite.
        """
        be, cy, cx = backend(), y + _HALO, x + _HALO
        dr = be.dr

        def at(dy: int, dx: int) -> Any:
            return values[cy + dy][cx + dx]

        beside, above = (at(0, -1), at(0, 1)), (at(-1, 0), at(1, 0))
        corners = at(-1, -1), at(-1, 1), at(1, -1), at(1, 1)
        middle = at(0, 0)
        far_beside, far_above = at(0, -2) + at(0, 2), at(-2, 0) + at(2, 0)
        sums = [sum(group[1:], group[0]) for group in (beside, above, corners)]
        kernels = {
            "green": (4 * middle + 2 * (sums[0] + sums[1]) - (far_beside + far_above), (*beside, *above)),
            "row": (5 * middle + 4 * sums[0] - sums[2] - far_beside + 0.5 * far_above, beside),
            "column": (5 * middle + 4 * sums[1] - sums[2] - far_above + 0.5 * far_beside, above),
            "across": (6 * middle + 2 * sums[2] - 1.5 * (far_beside + far_above), corners),
        }
        reach = [(dy, dx) for dy in range(-2, 3) for dx in range(-2, 3) if abs(dy * dx) < 4]
        top = _extreme(dr.maximum, [lit[cy + dy][cx + dx] for dy, dx in reach])
        lowest = _extreme(dr.minimum, [at(dy, dx) for dy in (-1, 0, 1) for dx in (-1, 0, 1)])
        maybe = (top - lowest > self._noise) & (top - lowest > lowest - self._black)
        rgb = []
        for k, name in enumerate(self._kernels(y, x)):
            value = middle
            if name is not None:
                eighths, near = kernels[name]
                value = self._bounded(eighths * 0.125, near, top, lit[cy][cx] - self._black, maybe)
            rgb.append(be.Int32(dr.clip(dr.round(be.Float64(value - self._black) * self._scale[k]), 0, 255)))
        red, green, blue = (be.UInt32(level) for level in rgb)
        return red | green << 8 | blue << 16 | luminance(rgb) << 24

    def _kernels(self, y: int, x: int) -> tuple[str | None, str | None, str | None]:
        """Return the kernels of Malvar's for R, G and B at a pixel of the tile; None for its own colour."""
        if (y, x) == self._red:
            return None, "green", "across"
        if (y, x) == self._blue:
            return "across", "green", None
        return ("row", None, "column") if y == self._red[0] else ("column", None, "row")

    def _bounded(self, value: Any, near: tuple[Any, ...], top: Any, own: Any, maybe: Any) -> Any:
        """Return a value within its bounds where an edge is hard, as `demosaic.bounded_at_edges`."""
        dr = backend().dr
        low, high = _extreme(dr.minimum, near), _extreme(dr.maximum, near)
        span, dark = top - low, low - self._black
        ratio = (span > (HARD_RATIO - 1) * dark) | ((value < self._black) & (span > dark))
        hard = maybe & (span > self._noise) & ratio
        dark_side = hard & (HARD_RATIO * own < top - self._black)
        value = dr.select(hard & (value < low), low, value)
        return dr.select(dark_side & (value > high), high, value)


def _extreme(of: Any, values: Any) -> Any:
    """Return the extreme of several values in each lane."""
    first, *others = values
    for value in others:
        first = of(first, value)
    return first
