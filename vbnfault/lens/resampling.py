"""Resample the render of a pinhole camera to the image that a lens with rotational symmetry makes.

A pixel needs two numbers that depend on its distance from the axis alone: how far to stretch its position, and the
solid angle from which it receives light. Both are tabulated over the squared distance, in equal steps.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]

STEPS = 65536  # nodes of the tables over squared radius
_STRIP_PX = 64
_MIDWAY: F32 = np.array([[-1 / 16, 9 / 16, 9 / 16, -1 / 16]], dtype=np.float32)


@dataclass(frozen=True, kw_only=True, eq=False)
class RadialTables:
    """Tabulate the two numbers of a pixel per band, float32[band, step], by its squared distance from the axis.

    `stretch` is the tangent of the field angle divided by the image height in units of the focal length.
    `solid_angle_sr` is irradiance divided by radiance.
    """

    stretch: F32
    solid_angle_sr: F32


def table_distances(reach_px: float) -> F64:
    """Return the distances from the axis in pixels at which the tables have their nodes, float64[step]."""
    # the first node lies slightly off the axis, to avoid a division by 0
    square = np.maximum(np.arange(STEPS), 1e-3) / (STEPS - 1)
    return np.asarray(np.sqrt(square) * reach_px)


@dataclass(frozen=True, kw_only=True, eq=False)
class Resampling:
    """Map the pixels of an image to those of a render with the same centre and focal length.

    `steps` uint16[y, x] is the node of the tables for each pixel of the image. `render_shape` is (height, width).
    """

    steps: NDArray[np.uint16]
    render_shape: tuple[int, int]

    @classmethod
    def of(cls, shape: tuple[int, int], *, render_shape: tuple[int, int], reach_px: float) -> Resampling:
        """Return the map for an image of (height, width) pixels whose corners are `reach_px` from the axis."""
        y, x = (np.arange(n) + 0.5 - n / 2 for n in shape)
        square = x[None, :] ** 2 + y[:, None] ** 2
        steps = np.asarray(np.rint(square * ((STEPS - 1) / reach_px**2)), dtype=np.uint16)
        return cls(steps=steps, render_shape=render_shape)

    def resampled(self, band: F32, stretch: F32, solid_angle_sr: F32 | None) -> F32:
        """Return a band of a render on the grid of the image, float32[y, x].

        `stretch` and `solid_angle_sr`, float32[step], are rows of `RadialTables`. Without the latter the result is
        radiance. Work goes strip by strip so that intermediate arrays stay in the processor's cache.
        """
        height, width = self.steps.shape
        render_height, render_width = self.render_shape
        out = np.empty((height, width), dtype=np.float32)
        # coordinates on the grid of half the pitch, where linear interpolation blurs little
        x = 2 * np.arange(width, dtype=np.float32) + np.float32(1 - width)
        y = 2 * np.arange(height, dtype=np.float32) + np.float32(1 - height)
        for start in range(0, height, _STRIP_PX):
            rows = slice(start, start + _STRIP_PX)
            steps = self.steps[rows]
            row = np.take(stretch, steps, mode="clip")
            column = row * x
            column += np.float32(render_width - 1)
            row *= y[rows, None]
            row += np.float32(render_height - 1)
            top = int(np.clip(row.min() // 2 - 1, 0, len(band) - 2))
            bottom = int(np.clip(row.max() // 2 + 3, top + 2, len(band)))
            row -= np.float32(2 * top)
            if not band[top:bottom].any():  # most strips of the Sun's image are dark
                out[rows] = 0
                continue
            source = finer(band[top:bottom])
            light = cv2.remap(source, column, row, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
            if solid_angle_sr is not None:
                light *= np.take(solid_angle_sr, steps, mode="clip")
            out[rows] = light
        return out


def finer(band: F32) -> F32:
    """Return a band on a grid of half the pitch, float32[2 y - 1, 2 x - 1].

    The given pixels stay. Values between them are cubic (Keys 1981, IEEE ASSP 29, 1153), but limited to the range
    of the two neighbours, so that no ripples appear around the Sun.
    """
    height, width = band.shape
    out = np.empty((2 * height - 1, 2 * width - 1), dtype=np.float32)
    out[::2, ::2] = band
    out[::2, 1::2] = _between(band, _MIDWAY)
    out[1::2] = _between(np.ascontiguousarray(out[::2]), _MIDWAY.T)
    return out


def _between(band: F32, kernel: F32) -> F32:
    """Return the midpoints between neighbours along the axis of a four-tap kernel."""
    height, width = band.shape
    across = kernel.shape[0] == 1
    before, behind = (band[:, :-1], band[:, 1:]) if across else (band[:-1], band[1:])
    middle = cv2.filter2D(
        band, cv2.CV_32F, kernel, anchor=(1, 0) if across else (0, 1), borderType=cv2.BORDER_REPLICATE
    )[: height - (not across), : width - across]
    return np.asarray(cv2.min(cv2.max(middle, cv2.min(before, behind)), cv2.max(before, behind)))
