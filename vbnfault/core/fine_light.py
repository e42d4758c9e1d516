"""Hold light whose position is known more finely than pixels, such as that of a body smaller than a pixel."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True, eq=False)
class FineLight:
    """Hold points of light, and what they add to the pixels of a render.

    Attributes
    ----------
    slopes
        float64[point, 2]: tangents x/z and y/z in C.
    power
        float32[band, point]: radiance times projected solid angle, the irradiance on a plane across the boresight.
    rows, columns
        Window of the render's pixels that holds all of the light.
    mean
        float32[band, y, x]: radiance of the points averaged over each pixel of the window.
    """

    slopes: F64
    power: F32
    rows: slice
    columns: slice
    mean: F32

    @classmethod
    def of(cls, *, slopes: F64, area_px: F64, radiance: F32, intrinsics: F64, shape: tuple[int, int]) -> FineLight:
        """Return the light of points in a pinhole's frame of (height, width) pixels.

        Parameters
        ----------
        slopes
            float64[point, 2]: tangents in C. Points beyond the frame are kept for the lens.
        area_px
            float64[point]: area of each point in pixels.
        radiance
            float32[band, point].
        intrinsics
            fx, fy, cx and cy in pixels.
        """
        light = radiance * area_px.astype(np.float32)
        # cos⁴θ / (fx fy) is the projected solid angle of a pixel
        solid_sr = 1 / (intrinsics[0] * intrinsics[1] * (1 + (slopes**2).sum(axis=1)) ** 2)
        power = light * solid_sr.astype(np.float32)
        pixels = slopes * intrinsics[:2] + intrinsics[2:]
        column, row = np.floor(pixels).astype(np.int64).T
        inside = (column >= 0) & (column < shape[1]) & (row >= 0) & (row < shape[0])
        column, row, values = column[inside], row[inside], light[:, inside]
        rows, columns = ((int(v.min()), int(v.max()) + 1) if len(v) else (0, 1) for v in (row, column))
        height, width = rows[1] - rows[0], columns[1] - columns[0]
        index = (row - rows[0]) * width + column - columns[0]
        mean = np.stack([np.bincount(index, band, height * width) for band in values])
        return cls(
            slopes=slopes,
            power=power,
            rows=slice(*rows),
            columns=slice(*columns),
            mean=mean.reshape(-1, height, width).astype(np.float32),
        )

    def joined(self, other: FineLight | None) -> FineLight:
        """Return the light of both."""
        if other is None:
            return self
        rows, columns = (
            slice(min(a.start, b.start), max(a.stop, b.stop))
            for a, b in ((self.rows, other.rows), (self.columns, other.columns))
        )
        mean = np.zeros((len(self.mean), rows.stop - rows.start, columns.stop - columns.start), np.float32)
        for part in (self, other):
            top, left = part.rows.start - rows.start, part.columns.start - columns.start
            mean[:, top : top + part.mean.shape[1], left : left + part.mean.shape[2]] += part.mean
        return FineLight(
            slopes=np.concatenate([self.slopes, other.slopes]),
            power=np.concatenate([self.power, other.power], axis=1),
            rows=rows,
            columns=columns,
            mean=mean,
        )

    def scaled(self, factor: float) -> FineLight:
        """Return the light multiplied by a factor."""
        return replace(self, power=self.power * np.float32(factor), mean=self.mean * np.float32(factor))

    def added_to(self, array: F32) -> F32:
        """Return a render, float32[band, y, x], with this light."""
        out = array.copy()
        out[:, self.rows, self.columns] += self.mean
        return out

    def removed_from(self, array: F32) -> F32:
        """Return a render, float32[band, y, x], without this light, which it contains."""
        out = array.copy()
        window = out[:, self.rows, self.columns]
        np.maximum(window - self.mean, 0, out=window)
        return out


def splat(pixels: F64, weights: F64, shape: tuple[int, int]) -> F32:
    """Return weights, float64[point], on the four pixels around each position x, y, float32[height, width].

    Sum and centroid of the weights are kept, also from one pixel to the next.
    """
    first = np.floor(pixels - 0.5).astype(np.int64)
    x, y = (pixels - 0.5 - first).T
    out = np.zeros(shape[0] * shape[1])
    for right, across in ((0, 1 - x), (1, x)):
        for down, along in ((0, 1 - y), (1, y)):
            column, row = first[:, 0] + right, first[:, 1] + down
            inside = (column >= 0) & (column < shape[1]) & (row >= 0) & (row < shape[0])
            index = (row * shape[1] + column)[inside]
            out += np.bincount(index, (weights * across * along)[inside], len(out))
    return out.reshape(shape).astype(np.float32)
