"""Compute with the planes of an image, for the hooks of fault models."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import fft

from ..camera import Camera
from ..core.quantities import LUMINANCE
from ..lens.image_frame import ImageFrame
from .context import FaultContext
from .fields import Interval

F32 = NDArray[np.float32]

_CELLS = 256  # cells along the longer side of a frame, on which scattered light is computed


def times(array: F32, factor: NDArray[Any]) -> F32:
    """Return planes float32[y, x, channel] times a factor for each channel [channel] or for each pixel [y, x]."""
    factor = np.asarray(factor, dtype=np.float32)
    if factor.ndim == 1:
        return by_channel(np.multiply, array, factor)
    return array * (cv2.merge([factor] * array.shape[2]) if array.shape[2] > 1 else factor).reshape(array.shape)


def by_channel(function: Callable[[F32, F32], F32], array: F32, values: F32) -> F32:
    """Return a ufunc of float32[y, x, channel] and a value of each channel, in rows: 5 times as fast as pixels."""
    height, width, _ = array.shape
    return function(array.reshape(height, -1), np.tile(values, width)).reshape(array.shape)


def sums(array: F32) -> NDArray[np.float64]:
    """Return the sum of each channel of float32[y, x, channel], float64[channel]."""
    if array.shape[2] > 4:  # OpenCV's scalars have four numbers
        return np.asarray(array.sum(axis=(0, 1), dtype=np.float64))
    return np.array(cv2.sumElems(array)[: array.shape[2]])


def reaches(array: F32, level: F32) -> NDArray[np.bool_]:
    """Return where any channel of float32[y, x, channel] is at least its level, float32[channel]; bool[y, x]."""
    return np.asarray((array >= level).any(axis=2))


def intensity_dn(electrons: NDArray[np.float32], camera: Camera) -> NDArray[np.float32]:
    """Return the intensity of electrons float32[y, x, channel], as float32[y, x] in DN of 255.

    The scale is linear, 255 is white, and nothing is clipped. If the camera has pixels without a colour filter (W),
    the intensity is their signal. Otherwise it is the luminance of R, G and B.
    """
    channels, white_e = camera.detector.channels, np.asarray(camera.detector.white_e, dtype=np.float32)
    if "W" in channels:
        weights = np.array([channel == "W" for channel in channels], dtype=np.float32)
    else:
        luminance = dict(zip("RGB", LUMINANCE, strict=True))
        weights = np.array([luminance.get(channel, 0) for channel in channels], dtype=np.float32)
        weights /= weights.sum()
    return np.asarray(electrons @ (weights * 255 / white_e), dtype=np.float32)


def scale_by_intensity(
    rgbi: NDArray[np.uint8], intensity: NDArray[np.float32], *, monochrome: bool = False
) -> NDArray[np.uint8]:
    """Return RGBI uint8[..., 4] with I set to `intensity` (0-255) and RGB scaled by the same ratio.

    Where I is the luminance of R, G and B, the ratio is that of the luminances before they are rounded: 1 DN of I
    may stand for 0.5 to 1.5. Where I was 0, R, G and B become the new I. Values that overflow are clipped in each
    channel. With `monochrome`, R, G and B always become the new I: scaled by the ratio, they could be rounded to
    another number.
    """
    if monochrome:
        level = np.clip(np.rint(intensity), 0, 255).astype(np.uint8)
        return np.repeat(level[..., None], 4, axis=-1)
    before = rgbi[..., 3]
    dark = before == 0
    exact = sum((rgbi[..., k] * np.float32(LUMINANCE[k]) for k in range(3)), np.float32(0))
    exact = np.where(np.abs(exact - before) <= 0.5, exact, before)
    ratio = (exact + (intensity - before)) / np.maximum(exact, np.float32(0.5))
    out = np.empty_like(rgbi)
    for channel in range(4):
        value = intensity.copy() if channel == 3 else rgbi[..., channel] * ratio
        np.copyto(value, intensity, where=dark)
        np.rint(value, out=value)
        out[..., channel] = np.clip(value, 0, 255, out=value)
    return out


def draw_shift(size_px: Interval, context: FaultContext, rng: np.random.Generator) -> list[int]:
    """Return a displacement in x and y of a drawn size, in px of a 1024 px wide image, and any direction.

    With a mosaic it is a multiple of the tile, so that every pixel keeps its colour.
    """
    size, turn = size_px.uniform(rng) * context.scale, rng.uniform(0, 2 * math.pi)
    mosaic = context.camera.detector.mosaic
    rows, columns = (1, 1) if mosaic is None else np.shape(mosaic.sensor.pattern.tile)
    return [round(size * math.cos(turn) / columns) * columns, round(size * math.sin(turn) / rows) * rows]


def displaced(array: F32, dx: int, dy: int) -> F32:
    """Return an image [y, x, …] that is moved to the right and down by whole pixels, mirrored beyond its edges."""
    height, width = array.shape[:2]
    rows, columns = (
        np.abs((np.arange(size) - by + size - 1) % (2 * size - 2) - (size - 1))
        for size, by in ((height, dy), (width, dx))
    )
    return array[rows[:, None], columns]


def cell_px(frame: ImageFrame) -> int:
    """Return the side in px of the cells on which scattered light is computed."""
    return max(1, round(max(frame.width_px, frame.height_px) / _CELLS))


def strewn(
    array: F32,
    white_e: F32,
    waves: Callable[[tuple[int, int]], NDArray[np.complex64]],
    step: int,
    passes: NDArray[np.float32],
) -> F32:
    """Return the light float32[y, x, channel] after a convolution with a wide kernel, in cells of `step` px.

    `waves` returns the Fourier transform of the kernel on a periodic grid of cells of a shape; `passes` is the
    fraction of the scattered light that arrives, float32[1] or float32[channel]. Around the frame, the light is
    taken to be its mirror image, clipped to white.
    """
    height, width, channels = array.shape
    rows, columns = -(-height // step), -(-width // step)
    below, right = rows * step - height, columns * step - width
    whole = cv2.copyMakeBorder(array, 0, below, 0, right, cv2.BORDER_REPLICATE) if below or right else array
    cells = cv2.resize(whole, (columns, rows), interpolation=cv2.INTER_AREA).reshape(rows, columns, channels)
    # the grid has twice the size of the frame, so no two cells of the frame meet across its periodic edge
    shape = (fft.next_fast_len(2 * rows, real=True), fft.next_fast_len(2 * columns, real=True))
    top, left = (shape[0] - rows) // 2, (shape[1] - columns) // 2
    around = cv2.copyMakeBorder(
        np.minimum(cells, white_e),
        top,
        shape[0] - rows - top,
        left,
        shape[1] - columns - left,
        cv2.BORDER_REFLECT,
    ).reshape(*shape, channels)
    around[top : top + rows, left : left + columns] = cells
    planes = np.ascontiguousarray(np.moveaxis(around, -1, 0))
    spread = fft.irfft2(fft.rfft2(planes) * waves(shape), s=shape)
    inner = np.moveaxis(spread[:, top - 1 : top + rows + 1, left - 1 : left + columns + 1], 0, -1)
    inner = np.maximum(np.ascontiguousarray(inner), np.float32(0)) * passes
    if step == 1:
        return inner[1:-1, 1:-1]
    finer = np.empty(((rows + 2) * step, (columns + 2) * step, channels), np.float32)
    cv2.resize(inner, finer.shape[1::-1], dst=finer, interpolation=cv2.INTER_LINEAR)
    return finer[step : step + height, step : step + width]
