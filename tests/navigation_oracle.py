"""Own images with a known truth, for the tests of the metrics of navigation: a lit disc, and textured ground."""

from __future__ import annotations

from functools import cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from vbnfault.navigation import CameraView

F64 = NDArray[np.float64]

SIZE_PX = 256
FOCAL_PX = 250.0
INTRINSICS = np.array([FOCAL_PX, FOCAL_PX, SIZE_PX / 2, SIZE_PX / 2])
# ground n · X = 100 m; relief makes the essential matrix unique, which plane ground does not
_NORMAL, _DISTANCE_M = np.array([0.25, -0.15, 1.0]), 100.0
_TEXELS_PER_M = 5.0


def disc(centre: F64, radius: float, *, size: int = 160, lit: str = "all") -> tuple[F64, NDArray[np.bool_]]:
    """Return a disc of peak 1, float64[y, x], and its mask; each pixel is the mean of 6 × 6 points.

    `lit` is "all", or "left" for Lambert's law with the Sun to the left.
    """
    n = 6
    y, x = (np.mgrid[0 : size * n, 0 : size * n] + 0.5) / n
    u, v = (x - centre[0]) / radius, (y - centre[1]) / radius
    height = np.sqrt(np.clip(1 - u * u - v * v, 0, None))
    shade = height**0.3 if lit == "all" else np.clip(0.6 * height - 0.8 * u, 0, None)
    inside = u * u + v * v <= 1
    mean = np.where(inside, shade, 0).reshape(size, n, size, n).mean(axis=(1, 3))
    return mean, inside.reshape(size, n, size, n).mean(axis=(1, 3)) > 0.5


@cache
def texture(size: int = 1024, seed: int = 0) -> NDArray[np.float32]:
    """Return noise with detail at scales of 1 to 20 px, from 40 to 210."""
    rng = np.random.default_rng(seed)
    out = np.zeros((size, size), np.float32)
    for sigma in (1.2, 3.0, 8.0, 20.0):
        layer = cv2.GaussianBlur(rng.normal(size=(size, size)).astype(np.float32), (0, 0), sigma)
        out += np.float32(sigma**0.6) * layer / np.ptp(layer)
    return np.asarray(40 + 170 * (out - out.min()) / np.ptp(out), dtype=np.float32)


def ground(
    camera_from_T: F64, position_T_m: F64, *, relief_m: float = 0.0, distortion: Any = None, seed: int = 0
) -> tuple[NDArray[np.uint8], CameraView]:
    """Return an image uint8[y, x] of textured ground, by rays through the pixel centres, and its view."""
    model = {} if distortion is None else {"distortion": np.asarray(distortion)}
    pose = {"camera_from_T": camera_from_T, "camera_position_T_m": position_T_m}
    view = CameraView(intrinsics=INTRINSICS, **pose, **model)
    centres = np.arange(SIZE_PX) + 0.5
    x, y = np.meshgrid(centres, centres)
    slopes = view.slopes(np.column_stack([x.ravel(), y.ravel()]))
    rays = np.column_stack([slopes, np.ones(len(slopes))]) @ camera_from_T
    depth = (_DISTANCE_M - position_T_m @ _NORMAL) / (rays @ _NORMAL)
    points = position_T_m + rays * depth[:, None]
    for _ in range(15 if relief_m else 0):  # the slopes of the relief are below 1, so the iteration converges
        height = relief_m * np.sin(points[:, 0] / 9) * np.cos(points[:, 1] / 7)
        depth = (_DISTANCE_M + height - position_T_m @ _NORMAL) / (rays @ _NORMAL)
        points = position_T_m + rays * depth[:, None]
    texels = texture(seed=seed)
    at = points[:, 1::-1].T * _TEXELS_PER_M + len(texels) / 2 - 0.5
    image = map_coordinates(texels, at, order=3, mode="reflect").reshape(SIZE_PX, SIZE_PX)
    seen = CameraView(intrinsics=INTRINSICS, depth_m=depth.reshape(SIZE_PX, SIZE_PX), **pose, **model)
    return np.clip(np.rint(image), 0, 255).astype(np.uint8), seen
