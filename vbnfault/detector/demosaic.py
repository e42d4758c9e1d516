"""Convert a mosaic to full R, G and B planes, and correct the defects that on-board software corrects first.

All methods return values in the unit of the mosaic and never clip. A Bayer mosaic is mirrored about its
outermost pixels (… c b a b c …). This keeps the order of the filters, so a flat field stays flat at the border.
Normalised convolution needs no mirror: it uses only the pixels inside the mosaic.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.errors import InputError
from .mosaic import Pattern, channel_of, plane_of

F32 = NDArray[np.float32]
Mask = NDArray[np.bool_]

Method = Literal["bilinear", "malvar", "menon"]

_MIRROR = cv2.BORDER_REFLECT_101

# Both are even, so that every block begins with the same filters.
_ROWS_PER_BLOCK = 64
_HALO_PX = {"bilinear": 2, "malvar": 2, "menon": 8}

# A hard edge spans more standard deviations of the noise than this and more than this to one.
HARD_NOISE, HARD_RATIO = 16.0, 8.0

# Bilinear: weights with which a pixel contributes to the neighbours in its own plane (Losson, Macaire & Yang 2010,
# Advances in Imaging and Electron Physics 162, doi 10.1016/S1076-5670(10)62005-8).
# Those of red and blue are [½ 1 ½]ᵀ [½ 1 ½].
BILINEAR_GREEN = np.array([[0, 1, 0], [1, 4, 1], [0, 1, 0]], dtype=np.float32) / 4
_TENT = np.array([0.5, 1, 0.5], dtype=np.float32)

# Malvar, He & Cutler 2004, ICASSP, doi 10.1109/ICASSP.2004.1326587, figure 2. All kernels are symmetric.
MALVAR_GREEN = np.array(
    [[0, 0, -1, 0, 0], [0, 0, 2, 0, 0], [-1, 2, 4, 2, -1], [0, 0, 2, 0, 0], [0, 0, -1, 0, 0]], dtype=np.float32
) / np.float32(8)
# red (or blue) at the green pixels of the rows that hold it; the transpose serves the columns that hold it
MALVAR_ALONG_ROW = np.array(
    [[0, 0, 0.5, 0, 0], [0, -1, 0, -1, 0], [-1, 4, 5, 4, -1], [0, -1, 0, -1, 0], [0, 0, 0.5, 0, 0]],
    dtype=np.float32,
) / np.float32(8)
# red at blue and blue at red
MALVAR_ACROSS = np.array(
    [[0, 0, -1.5, 0, 0], [0, 2, 0, 2, 0], [-1.5, 0, 6, 0, -1.5], [0, 2, 0, 2, 0], [0, 0, -1.5, 0, 0]],
    dtype=np.float32,
) / np.float32(8)

# Number of bad pixels that are corrected together, which limits the memory for their neighbours.
_PIXELS_AT_ONCE = 4096

_SUM = np.ones((1, 3), dtype=np.float32)

# Menon 2007: weights that sum colour differences two pixels apart around a pixel, as the roughness of a direction.
_ROUGHNESS = np.array(
    [[1, 0, 1, 0, 0], [0, 1, 0, 0, 0], [3, 0, 3, 0, 0], [0, 1, 0, 0, 0], [1, 0, 1, 0, 0]], dtype=np.float32
)


def demosaic(raw: NDArray[Any], pattern: Pattern, method: Method = "bilinear") -> F32:
    """Return full-resolution R, G, B, float32[y, x, 3], in the unit of the mosaic.

    A monochrome mosaic gives R = G = B. W and NIR pixels do not contribute to R, G, B: see `interpolate`. Measured
    values are not changed. Sums of 16 bit integers are exact in float32, so rounding does not affect Menon's choice
    of direction for raw DN.

    Parameters
    ----------
    raw
        Mosaic [y, x] of any real dtype, at least 6 × 6 pixels.
    pattern
        Its colour filter array.
    method
        `malvar` (Malvar, He & Cutler 2004) and `menon` (DDFAPD: Menon, Andriani & Calvagno 2007, IEEE Trans. Image
        Process. 16, 132, doi 10.1109/TIP.2006.884928, with its refining step) need a Bayer pattern. `bilinear`
        works with all patterns, and is used for those that are no Bayer pattern.
    """
    signal = np.ascontiguousarray(raw, dtype=np.float32)
    if pattern.is_bayer:
        return _in_blocks(
            {"bilinear": _bilinear, "malvar": _malvar, "menon": _menon}[method], signal, pattern, method
        )
    if pattern.channels == ("W",):
        return cv2.merge([signal] * 3)
    return cv2.merge([_normalised(signal, pattern, colour) for colour in "RGB"])


def bounded_at_edges(
    rgb: F32,
    raw: NDArray[Any],
    pattern: Pattern,
    method: Method,
    *,
    black: float,
    noise: float,
    clipped: Mask | None = None,
) -> F32:
    """Return demosaiced planes in which no hard or clipped edge leaves a rim on its dark side.

    The kernels of Malvar and Menon have negative weights and take all colours to rise by the same amount. Beside an
    edge of 10,000:1 they turn the dark side negative by a quarter of the bright one. Where pixels are clipped,
    colours do not rise alike, and the rim reaches 190 DN of 255. There a value stays within its own colour's
    measured values within one pixel: never below the least, and on the dark side of the edge never above the
    greatest.

    `_bound` says where an edge is hard. Elsewhere values stay as published: a bound there would change the noise.

    Parameters
    ----------
    rgb
        float32[y, x, 3], from `demosaic` of `raw` with `method`; changed in place.
    raw
        The mosaic [y, x], in the same unit.
    pattern, method
        As in `demosaic`.
    black, noise
        Black level of `raw`, and standard deviation of its noise in the dark, in the unit of `raw`.
    clipped
        bool[y, x], pixels of `raw` that are saturated; None: no pixel.

    Returns
    -------
    F32
        `rgb`. The correction depends on pixels within the method's `footprint` only.
    """
    if method == "bilinear" or not pattern.is_bayer:
        return rgb
    signal = np.ascontiguousarray(raw, dtype=np.float32)
    bright = signal
    if clipped is not None and clipped.any():
        bright = np.where(clipped, np.float32(np.inf), signal)
    halo = _HALO_PX[method]
    measured = cv2.copyMakeBorder(signal, halo, halo, halo, halo, _MIRROR)
    brightest = measured if bright is signal else cv2.copyMakeBorder(bright, halo, halo, halo, halo, _MIRROR)

    for start in range(0, len(signal), _ROWS_PER_BLOCK):
        block = rgb[start : start + _ROWS_PER_BLOCK]
        rows = slice(start, start + len(block) + 2 * halo)
        _bound(block, measured[rows], brightest[rows], pattern, method, black=black, noise=noise)
    return rgb


def _bound(
    block: F32, measured: F32, brightest: F32, pattern: Pattern, method: Method, *, black: float, noise: float
) -> None:
    """Keep the values of a block of rows, float32[y, x, 3], within their bounds beside hard edges, in place.

    `measured` and `brightest` are the mosaic with a halo around the block; in `brightest`, clipped pixels are
    infinite. An edge is hard where the pixels of the method's `footprint` span more than noise can (16 standard
    deviations) and more than 8:1 above black, or 2:1 where the value is below black. A clipped pixel may have any
    brightness, so an edge beside it is always hard.
    """
    halo = _HALO_PX[method]
    inner = np.s_[halo:-halo, halo:-halo]
    top = cv2.dilate(brightest, _support(method))[inner]
    lowest = cv2.erode(measured, np.ones((3, 3), np.uint8))[inner]
    # the few pixels where an edge may be hard for one of the colours, whose own darkest pixel is no darker
    span, ratio = top - lowest, 1 if block.min() < black else HARD_RATIO - 1
    y, x = np.nonzero((span > HARD_NOISE * noise) & (span > ratio * (lowest - black)))
    if not y.size:
        return
    least, greatest = (_malvar(measured, pattern, extreme=extreme) for extreme in (cv2.erode, cv2.dilate))
    top, own = top[y, x], brightest[inner][y, x] - black
    for k in range(3):
        value, low, high = block[y, x, k], least[k][inner][y, x], greatest[k][inner][y, x]
        span, dark = top - low, low - black
        ratio = (span > (HARD_RATIO - 1) * dark) | ((value < black) & (span > dark))
        hard = (span > HARD_NOISE * noise) & ratio
        dark_side = hard & (HARD_RATIO * own < top - black)
        value = np.where(hard & (value < low), low, value)
        block[y, x, k] = np.where(dark_side & (value > high), high, value)


def interpolate(raw: NDArray[Any], pattern: Pattern, channel: str) -> F32:
    """Return one channel of a mosaic [y, x] at every pixel by bilinear interpolation, float32[y, x].

    The W channel of an RGBW mosaic is its intensity.
    """
    return _normalised(np.ascontiguousarray(raw, dtype=np.float32), pattern, channel)


def footprint(mask: Mask, pattern: Pattern, method: Method = "bilinear") -> Mask:
    """Return the pixels whose R, G, B (or W, NIR) may depend on the mosaic pixels in `mask`, bool[y, x].

    `mask` is bool[y, x]. For bilinear interpolation, which is linear, the result is exact: the support of its
    kernels. The methods of Malvar and Menon, with `bounded_at_edges`, choose by the signal. For them the result is
    the union over all choices, up to 2 and 8 pixels away; a single image shows a part of this.
    """
    if pattern.channels == ("W",):
        return mask.copy()
    ones = np.ascontiguousarray(mask, dtype=np.float32)
    if method != "bilinear" and pattern.is_bayer:
        return cv2.dilate(np.ascontiguousarray(mask, dtype=np.uint8), _support(method)).view(np.bool_)
    touched = demosaic(ones, pattern, method)
    out = cv2.transform(touched, _SUM).reshape(mask.shape) > 0
    for channel in set(pattern.channels) - set("RGB"):
        out |= interpolate(ones, pattern, channel) > 0
    return out


def correct_defects(raw: NDArray[Any], bad: Mask, pattern: Pattern) -> NDArray[Any]:
    """Return a mosaic whose bad pixels are replaced by their good neighbours, as on-board software does.

    Each bad pixel takes the median of its good neighbours of the same channel. Neighbours lie within one
    tile (Bayer: 5 × 5 pixels, so 8 neighbours for red or blue and 12 for green; RGBW: 9 × 9; monochrome: 3 × 3). If
    none is good, the search goes four times as far. If none is good there either, the pixel is not changed.
    Integers round half to even.

    Parameters
    ----------
    raw
        Mosaic [y, x].
    bad
        Bad pixels, bool[y, x].
    pattern
        Colour filter array.

    Returns
    -------
    NDArray
        A new array with the shape and dtype of `raw`.
    """
    out = raw.copy()
    whole = np.issubdtype(raw.dtype, np.integer)
    channels = channel_of(pattern, (raw.shape[0], raw.shape[1]))
    pixels = np.argwhere(bad)
    for reach in (max(pattern.shape), 4 * max(pattern.shape)):
        near = (
            _in_reach(~bad, channels, reach)[pixels[:, 0], pixels[:, 1]]
            if len(pixels) > _PIXELS_AT_ONCE
            else slice(None)
        )
        later = []
        for group in np.array_split(pixels[near], len(pixels[near]) // _PIXELS_AT_ONCE + 1):
            value, has_neighbours = _from_neighbours(raw, bad, channels, group, reach)
            y, x = group[has_neighbours].T
            out[y, x] = np.rint(value[has_neighbours]) if whole else value[has_neighbours]
            later.append(group[~has_neighbours])
        pixels = np.concatenate([pixels[~near] if isinstance(near, np.ndarray) else pixels[:0], *later])
    return out


def mended_from(changed: Mask, bad: Mask, pattern: Pattern) -> Mask:
    """Return the pixels of `bad` that `correct_defects` replaces with values from `changed`; all are bool[y, x]."""
    channels = channel_of(pattern, (bad.shape[0], bad.shape[1]))
    near, far = max(pattern.shape), 4 * max(pattern.shape)
    alone = ~_in_reach(~bad, channels, near)
    source = changed & ~bad
    return bad & (_in_reach(source, channels, near) | (alone & _in_reach(source, channels, far)))


def _in_reach(good: Mask, channels: NDArray[np.uint8], reach: int) -> Mask:
    """Return whether a good pixel of a pixel's own channel lies within `reach` rows and columns, bool[y, x]."""
    out = np.zeros(good.shape, dtype=np.bool_)
    square = np.ones((2 * reach + 1, 2 * reach + 1), dtype=np.uint8)
    for channel in range(int(channels.max()) + 1):
        own = channels == channel
        out |= own & cv2.dilate((good & own).view(np.uint8), square).view(np.bool_)
    return out


def _from_neighbours(
    raw: NDArray[Any], bad: Mask, channels: NDArray[np.uint8], pixels: NDArray[np.intp], reach: int
) -> tuple[NDArray[np.float64], Mask]:
    """Return the median of the good neighbours of each pixel `at` [n, 2], and whether there are any."""
    offset = np.arange(-reach, reach + 1)
    dy, dx = (d.ravel() for d in np.meshgrid(offset, offset, indexing="ij"))
    y, x = pixels[:, :1] + dy, pixels[:, 1:] + dx
    inside = (y >= 0) & (y < raw.shape[0]) & (x >= 0) & (x < raw.shape[1])
    y, x = np.where(inside, y, 0), np.where(inside, x, 0)
    good = inside & ~bad[y, x] & (channels[y, x] == channels[pixels[:, 0], pixels[:, 1]][:, None])
    count = good.sum(axis=1)
    divisor = np.maximum(count, 1)
    values = np.where(good, raw[y, x], np.inf)
    values.sort(axis=1)  # values that are not good are infinite and go last
    row = np.arange(len(pixels))
    return (values[row, (divisor - 1) // 2] + values[row, divisor // 2]) / 2, count > 0


def _in_blocks(step: Callable[[F32, Pattern], Sequence[F32]], raw: F32, pattern: Pattern, method: Method) -> F32:
    """Return R, G, B, float32[y, x, 3], computed in blocks of rows with a mirrored halo.

    Blocks fit the cache.
    """
    halo = _HALO_PX[method]
    padded = cv2.copyMakeBorder(raw, halo, halo, halo, halo, _MIRROR)
    out = np.empty((*raw.shape, 3), dtype=np.float32)

    for start in range(0, len(raw), _ROWS_PER_BLOCK):
        block = out[start : start + _ROWS_PER_BLOCK]
        planes = step(padded[start : start + len(block) + 2 * halo], pattern)
        cv2.merge([plane[halo:-halo, halo:-halo] for plane in planes], block)
    return out


# -------------------------------------------------------------------------------------------------- bilinear


def _bilinear(raw: F32, pattern: Pattern) -> list[F32]:
    """Return R, G, B of a Bayer mosaic by bilinear interpolation."""
    red, green, blue = (plane_of(raw, pattern, colour) for colour in "RGB")
    return [
        cv2.sepFilter2D(red, -1, _TENT, _TENT),
        cv2.filter2D(green, -1, BILINEAR_GREEN),
        cv2.sepFilter2D(blue, -1, _TENT, _TENT),
    ]


def _normalised(raw: F32, pattern: Pattern, channel: str) -> F32:
    """Return one channel at every pixel by normalised convolution, float32[y, x]; measured values are kept."""
    plane = plane_of(raw, pattern, channel)
    reach, scale = _normaliser(pattern, raw.shape, pattern.index(channel))
    if reach == 0:
        return plane
    tent = _tent(reach)
    out = cv2.sepFilter2D(plane, -1, tent, tent, borderType=cv2.BORDER_CONSTANT)
    out *= scale
    return plane_of(raw, pattern, channel, out)


def _tent(reach: int) -> F32:
    return (1 - np.abs(np.arange(1 - reach, reach)) / reach).astype(np.float32)


@lru_cache(maxsize=8)  # each entry is as large as an image
def _normaliser(pattern: Pattern, shape: tuple[int, ...], index: int) -> tuple[int, F32]:
    """Return the half-width of the tent and the reciprocal of its weights for normalised convolution.

    The tent is the narrowest that reaches every pixel from the pixels of the channel; half-width 0 means that the
    channel is everywhere. Source: Knutsson & Westin 1993.
    """
    mask = (channel_of(pattern, (shape[0], shape[1])) == index).astype(np.float32)
    if mask.all():
        return 0, mask
    if not mask.any():
        raise InputError(
            f"the mosaic has shape {shape}, but must hold the {pattern.shape} tile of '{pattern.name}'"
        )
    reach = 2
    while True:
        tent = _tent(reach)
        weight = cv2.sepFilter2D(mask, -1, tent, tent, borderType=cv2.BORDER_CONSTANT)
        if weight.min() > 1e-3:
            break
        reach += 1
    weight = np.reciprocal(weight)
    weight.flags.writeable = False
    return reach, weight


# --------------------------------------------------------------------------------------------- Bayer: Malvar


def colour_sites(pattern: Pattern) -> tuple[tuple[int, int], tuple[int, int]]:
    """Return row and column of the tile's red pixel and of its blue one."""
    flat = [pattern.channels[i] for row in pattern.tile for i in row]
    red, blue = flat.index("R"), flat.index("B")
    return (red // 2, red % 2), (blue // 2, blue % 2)


def _beside(kernel: F32) -> NDArray[np.uint8]:
    """Return which pixels within one of the centre hold the colour that a kernel of Malvar's gives, uint8[3, 3]."""
    # the weights of the pixel's own colour are negative there: it counts by its differences
    near = (kernel[1:4, 1:4] > 0).astype(np.uint8)
    near[1, 1] = 0
    return near


def _malvar(raw: F32, pattern: Pattern, *, extreme: Callable[..., F32] | None = None) -> list[F32]:
    """Return R, G, B at every pixel, each with the kernel that Malvar's method uses there.

    With `extreme`, `cv2.erode` or `cv2.dilate`, they are not the method's weighted sums, but the least or greatest
    values of the kernel's colour that are measured within one pixel.
    """

    def filtered(kernel: F32) -> F32:
        return cv2.filter2D(raw, -1, kernel) if extreme is None else extreme(raw, _beside(kernel))

    (ry, rx), (by, bx) = colour_sites(pattern)
    red_rows, red_columns = slice(ry, None, 2), slice(rx, None, 2)
    blue_rows, blue_columns = slice(by, None, 2), slice(bx, None, 2)
    green = filtered(MALVAR_GREEN)
    for rows, columns in ((red_rows, blue_columns), (blue_rows, red_columns)):
        green[rows, columns] = raw[rows, columns]
    # each plane starts with the values for the green pixels of one kind of row; then the three other kinds of
    # pixels are written into it
    along_row = filtered(MALVAR_ALONG_ROW)
    along_column = filtered(np.ascontiguousarray(MALVAR_ALONG_ROW.T))
    across = filtered(MALVAR_ACROSS)
    red, blue = along_row, along_column
    red_at_blue_row_green = along_column[blue_rows, red_columns].copy()
    blue[blue_rows, red_columns] = along_row[blue_rows, red_columns]
    red[blue_rows, red_columns] = red_at_blue_row_green
    red[red_rows, red_columns] = raw[red_rows, red_columns]
    red[blue_rows, blue_columns] = across[blue_rows, blue_columns]
    blue[blue_rows, blue_columns] = raw[blue_rows, blue_columns]
    blue[red_rows, red_columns] = across[red_rows, red_columns]
    return [red, green, blue]


# ---------------------------------------------------------------------------------------------- Bayer: Menon


def _row(*weights: float) -> F32:
    return np.array([weights], dtype=np.float32)


_BESIDE = _row(0.5, 0, 0.5)
_THIRDS = _row(1 / 3, 1 / 3, 1 / 3)
_TWO_APART = _row(0, 0, 1, 0, -1)
# raw minus green, which is interpolated from green neighbours and the curvature of the pixel's own colour (eq. 1)
_COLOUR_DIFFERENCE = _row(0.25, -0.5, 0.5, -0.5, 0.25)


def _along_row(array: F32, kernel: F32) -> F32:
    """Return an array filtered with a kernel as it is written, for the direction of the rows."""
    return cv2.filter2D(array, -1, kernel)


def _along_column(array: F32, kernel: F32) -> F32:
    """Return an array filtered with the transposed kernel."""
    return cv2.filter2D(array, -1, np.ascontiguousarray(kernel.T))


def _roughness(difference: F32, along: Callable[[F32, F32], F32]) -> F32:
    """Return how much colour differences vary along one direction around each pixel."""
    step = along(difference, _TWO_APART)
    np.abs(step, out=step)
    return along(step, _ROUGHNESS)


def _menon(raw: F32, pattern: Pattern) -> list[F32]:
    """Return R, G, B by Menon's method, which interpolates colour differences.

    K is red minus green at red pixels and blue minus green at blue pixels; L is red minus blue. The method
    interpolates along the direction in which K varies less.
    """
    (ry, rx), (by, bx) = colour_sites(pattern)
    red, blue = (slice(ry, None, 2), slice(rx, None, 2)), (slice(by, None, 2), slice(bx, None, 2))
    # green pixels of the red rows and of the blue rows
    green_r, green_b = (red[0], blue[1]), (blue[0], red[1])

    def clear_green(array: F32) -> F32:
        array[green_r] = 0
        array[green_b] = 0
        return array

    k_row, k_column = (clear_green(along(raw, _COLOUR_DIFFERENCE)) for along in (_along_row, _along_column))
    rough_row, rough_column = (
        _roughness(k, along) for k, along in ((k_row, _along_row), (k_column, _along_column))
    )
    take_row = cv2.compare(rough_column, rough_row, cv2.CMP_GE)

    def chosen(row: F32, column: F32) -> F32:
        return cv2.copyTo(row, take_row, column)  # into `column`

    def beside(k: F32) -> tuple[F32, F32]:
        return _along_row(k, _BESIDE), _along_column(k, _BESIDE)

    def red_minus_blue(row: F32, column: F32) -> F32:
        # at a green pixel of a red row, red pixels are neighbours along the row and blue ones along the column
        out = np.zeros_like(raw)
        np.subtract(row[green_r], column[green_r], out=out[green_r])
        np.subtract(column[green_b], row[green_b], out=out[green_b])
        return out

    k = chosen(k_row, k_column)
    row, column = beside(k)
    between = red_minus_blue(row, column)
    l_first = chosen(*beside(between))  # at red and blue pixels

    # refining step: green from the mean of three colour differences along the chosen direction
    for full in (row, column):
        full[red], full[blue] = k[red], k[blue]
    k = clear_green(chosen(_along_row(row, _THIRDS), _along_column(column, _THIRDS)))
    green = raw - k
    row, column = beside(k)
    l_all = red_minus_blue(row, column)
    l_all[red], l_all[blue] = l_first[red], l_first[blue]
    l_all = chosen(_along_row(l_all, _THIRDS), _along_column(l_all, _THIRDS))

    out_red, out_blue = np.empty_like(raw), np.empty_like(raw)
    out_red[red], out_blue[blue] = raw[red], raw[blue]
    np.add(raw[blue], l_all[blue], out=out_red[blue])
    np.subtract(raw[red], l_all[red], out=out_blue[red])
    for sites, of_red, of_blue in ((green_r, row, column), (green_b, column, row)):
        np.add(raw[sites], of_red[sites], out=out_red[sites])
        np.add(raw[sites], of_blue[sites], out=out_blue[sites])
    return [out_red, green, out_blue]


@lru_cache(maxsize=2)
def _support(method: Method) -> NDArray[np.uint8]:
    """Return which pixels around one may change its colours, uint8[y, x].

    Malvar: 5 × 5 pixels without their corners. The kernels use fewer of them; the others show that a colour is
    clipped on the bright side of an edge where the kernel itself meets only a colour that is not. Menon: green
    depends on the decision, which uses 9 × 5 and 5 × 9 pixels. The refined colour differences depend on green along
    an axis by up to 2 pixels. Red and blue depend on those within 2 steps.
    """
    if method == "malvar":
        support = np.ones((5, 5), dtype=np.uint8)
        support[::4, ::4] = 0
    else:
        support = np.zeros((17, 17), dtype=np.uint8)
        support[8, 8] = 1
        cross = np.array([[0, 1, 0], [1, 1, 1], [0, 1, 0]], dtype=np.uint8)
        axes = np.zeros((5, 5), dtype=np.uint8)
        axes[2, :] = axes[:, 2] = 1
        decision = np.zeros((9, 9), dtype=np.uint8)
        decision[2:7, :] = decision[:, 2:7] = 1
        for element in (cross, cross, axes, decision):
            support = cv2.dilate(support, element, borderValue=0)
    support.flags.writeable = False
    return support
