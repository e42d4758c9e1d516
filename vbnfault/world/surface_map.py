"""Read a map of a body's albedo and prepare it for filtered look-ups.

A map is an image of the whole body: columns are planetocentric longitudes that increase to the east, rows are
planetocentric latitudes (equirectangular projection) or their sines (cylindrical equal-area projection) from the
north pole (top) to the south pole. The latter is resampled to the former.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.errors import InputError, under_key
from ..core.files import file_contents, user_files
from ..core.files.images import decoded_image
from ..scene.target import AlbedoMapTable

Float32 = NDArray[np.float32]

TYPES = (".png", ".tif", ".tiff")
_LEAST_ROWS = 4
_MOST_VALUES = 2**27  # pixels times channels: 512 MiB in memory


@dataclass(frozen=True, kw_only=True, eq=False)
class SurfaceMap:
    """Hold factors on the albedo at decreasing resolution.

    Attributes
    ----------
    levels
        Each float32[row, column, channel], of one channel or of R, G, B. The first has the resolution of the file,
        each other half of the one before it, rounded up. Every level has one row more at each pole: its value
        there.
    left_longitude_deg
        East longitude of the left edge of the first column.
    """

    levels: tuple[Float32, ...]
    left_longitude_deg: float


@file_contents.cached_with_contents(maxsize=2)
def load_albedo_map(table: AlbedoMapTable) -> SurfaceMap:
    """Return the map that a scene names. Raises InputError."""
    return _prepared(table, _factors(table))


def _factors(table: AlbedoMapTable) -> Float32:
    """Return the factors on the albedo, float32[row, column, channel], without filtering."""
    path = table.file
    with under_key("body.albedo_map.file"):
        data = user_files.read_input(path, "texture", types=TYPES)
    try:
        values, _ = decoded_image(data, _MOST_VALUES)
    except InputError as error:
        raise InputError(f"body.albedo_map.file = {path!r}: {error}") from None
    rows, columns, channels = values.shape
    is_equal_area = table.projection == "cylindrical_equal_area"
    if is_equal_area and (columns % 2 or columns < 2 * _LEAST_ROWS or rows < _LEAST_ROWS):
        raise InputError(
            f"body.albedo_map.file = {path!r}: has {columns} x {rows} pixels; a map with projection = "
            f"'cylindrical_equal_area' has an even number of columns, at least {2 * _LEAST_ROWS}, and at least "
            f"{_LEAST_ROWS} rows"
        )
    if not is_equal_area and (columns != 2 * rows or rows < _LEAST_ROWS):
        raise InputError(
            f"body.albedo_map.file = {path!r}: has {columns} x {rows} pixels; a map of the whole body has twice as "
            f"many columns as rows, and at least {_LEAST_ROWS} rows"
        )
    if not np.isfinite(values).all() or values.min() < 0:
        raise InputError(f"body.albedo_map.file = {path!r}: has values that are negative or not finite")
    if (
        channels == 3
        and np.array_equal(values[..., 0], values[..., 1])
        and np.array_equal(values[..., 0], values[..., 2])
    ):
        values = values[..., :1]
    if table.encoding == "srgb":
        from colour.models import eotf_sRGB  # takes two seconds to import

        values = eotf_sRGB(values).astype(np.float32)
    if is_equal_area:
        rows = columns // 2
        if rows * columns * channels > _MOST_VALUES:
            raise InputError(
                f"body.albedo_map.file = {path!r}: has {columns} x {rows} pixels of {channels} channel(s); pixels "
                f"times channels must be at most {_MOST_VALUES}"
            )
        values = _with_equal_latitudes(values)
    neutral = table.neutral
    if neutral == "mean":  # over the area, and over the channels, so that a map keeps its colour
        latitude = (0.5 - (np.arange(rows) + 0.5) / rows) * np.pi
        neutral = float(np.average(values.mean(axis=(1, 2)), weights=np.cos(latitude)))
        if neutral <= 0:
            raise InputError(f"body.albedo_map.file = {path!r}: is black; give body.albedo_map.neutral")
    return np.asarray(values / neutral, dtype=np.float32)


def _with_equal_latitudes(values: Float32) -> Float32:
    """Return a map with rows at equal steps of the latitude from one with rows at equal steps of its sine.

    It has half as many rows as columns. Each row is the mean of the old ones over its range of sines, so that area
    times value is kept.
    """
    old, columns, channels = values.shape
    # the integral from the top down to each border between rows, linear within a row
    total = np.zeros((old + 1, columns * channels))
    np.cumsum(values.reshape(old, -1), axis=0, out=total[1:])
    borders = (1 - np.cos(np.linspace(0, np.pi, columns // 2 + 1))) / 2 * old
    low = np.minimum(borders.astype(int), old - 1)
    part = (borders - low)[:, None]
    at_borders = total[low] * (1 - part) + total[low + 1] * part
    means = np.diff(at_borders, axis=0) / np.diff(borders)[:, None]
    return means.reshape(columns // 2, columns, channels).astype(np.float32)


def _prepared(table: AlbedoMapTable, factors: Float32) -> SurfaceMap:
    """Return the map with its levels of resolution."""
    factors = _even_at_the_poles(factors)
    levels = [_with_poles(factors)]
    while len(factors) >= 2 * _LEAST_ROWS:
        factors = _halved(factors)
        levels.append(_with_poles(factors))
    return SurfaceMap(levels=tuple(levels), left_longitude_deg=table.left_longitude_deg)


def _halved(factors: Float32) -> Float32:
    """Return the map with half as many rows and columns, rounded up; each value is the mean over its area."""
    if len(factors) % 2 == 0:
        return 0.25 * (factors[::2, ::2] + factors[1::2, ::2] + factors[::2, 1::2] + factors[1::2, 1::2])
    rows = (len(factors) + 1) // 2
    return cv2.resize(factors, (2 * rows, rows), interpolation=cv2.INTER_AREA).reshape(rows, 2 * rows, -1)


def _even_at_the_poles(factors: Float32) -> Float32:
    """Return the map averaged along each row over the width, in columns, of a pixel at the equator.

    Columns converge towards the poles. Without this average, a pixel of the image there would pick one of many.
    """
    rows, columns = factors.shape[:2]
    latitude = (0.5 - (np.arange(rows) + 0.5) / rows) * np.pi
    widths = np.minimum(np.floor(1 / np.cos(latitude)), columns).astype(int)
    out = factors.copy()
    for row in np.flatnonzero(widths > 1):
        half = min(widths[row] // 2, columns // 2 - 1)
        around = np.concatenate([factors[row, -half:], factors[row], factors[row, :half]])[None]
        mean = cv2.blur(around, (2 * half + 1, 1)).reshape(1, columns + 2 * half, -1)
        out[row] = mean[0, half : half + columns]
    return out


def _with_poles(factors: Float32) -> Float32:
    """Return the map with a row for each pole, which has the mean of the row beside it."""
    ends = [np.broadcast_to(factors[k].mean(axis=0), factors[k].shape) for k in (0, -1)]
    return np.concatenate([ends[0][None], factors, ends[1][None]]).astype(np.float32)
