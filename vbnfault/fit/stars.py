"""Find isolated stars in images of the sky, and measure how widely their light is spread."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

F32 = NDArray[np.float32]
Mask = NDArray[np.bool_]

STAR_PX = 5  # half the side of the part of an image that is taken as that of a star
_APART_PX, _MOST_STARS, _STAR_SIGMAS = 8, 100, 12.0
_FEWEST_STARS = 3
_ONE_PIXEL = (
    0.8  # of the light of 3 x 3 px in the brightest: more is a defect or a hit. Averaging leaves 0.87 of them
)
_LONG = 1.7  # ratio of the axes of a track; that of a faint star's image differs from 1 by its noise
_FINE = 8  # parts of a pixel's side that belong to an aperture or not


def stars(image: F32, top: float, good: Mask | None) -> list[tuple[int, int]]:
    """Return (row, column) of the brightest isolated peaks below `top`, in pixels that are good."""
    sky = image - cv2.blur(cv2.medianBlur(image, 5), (15, 15))
    noise = max(1.4826 * float(np.median(np.abs(sky if good is None else sky[good]))), 0.3)
    peak = (sky == cv2.dilate(sky, np.ones((3, 3)))) & (sky > _STAR_SIGMAS / 2 * noise)
    rows, columns = np.nonzero(peak)
    order = np.argsort(-sky[rows, columns])
    places = np.column_stack([rows, columns])[order]
    out = []
    for place in places[: 10 * _MOST_STARS]:
        row, column = (int(k) for k in place)
        edge = min(row, column, image.shape[0] - 1 - row, image.shape[1] - 1 - column) <= STAR_PX
        near = np.abs(places - place).max(axis=1) <= _APART_PX
        if edge or near.sum() > 1 or image[row, column] > top or sky[row, column] < _STAR_SIGMAS * noise:
            continue
        if good is None or good[row - 1 : row + 2, column - 1 : column + 2].all():
            out.append((row, column))
    return out[:_MOST_STARS]


def encircled_radii(image: F32, light: F32, good: Mask) -> tuple[float, float]:
    """Return the radii in px that hold 50 and 80 % of the light of stars, or NaN where fewer than three show.

    They are those of the image, of which the pixels are a part. Hits of single pixels and tracks are left out.
    The light of each star counts up to 5 px. The median over the stars leaves out what is no star; each counts by
    its light, since noise in 78 px hides where the light of a faint one ends.

    Parameters
    ----------
    image
        float32[y, x], levels from 0 to 255, in which stars are found.
    light
        float32[y, x], what is in proportion to the light.
    good
        bool[y, x], pixels of the sky.
    """
    radii, curves, lights = np.linspace(0, STAR_PX, 41), [], []
    for row, column in stars(image, 250.0, good) if good.any() else []:
        part = light[row - STAR_PX : row + STAR_PX + 1, column - STAR_PX : column + STAR_PX + 1].astype(np.float64)
        if (found := _growth(part, radii)) is not None:
            curves.append(found[0])
            lights.append(found[1])
    if len(curves) < _FEWEST_STARS:
        return float("nan"), float("nan")
    median = np.quantile(curves, 0.5, axis=0, weights=lights, method="inverted_cdf")
    half, most = np.interp((0.5, 0.8), np.maximum.accumulate(median) + 1e-9 * radii, radii)
    return float(half), float(most)


def _growth(part: NDArray[np.float64], radii: NDArray[np.float64]) -> tuple[NDArray[np.float64], float] | None:
    """Return the fraction of a star's light within each radius in px, and its light; None if it is no star."""
    axis = np.arange(-STAR_PX, STAR_PX + 1)
    away = np.hypot(axis, axis[:, None])
    part = part - np.median(part[away > STAR_PX - 1])
    core = np.where(away < 3, np.maximum(part, 0), 0)
    y, x = ((core * along).sum() / core.sum() for along in (axis[:, None], axis))
    down, right = axis[:, None] - y, axis - x
    spread = [float((core * product).sum()) for product in (down**2, right**2, down * right)]
    middle, off = 0.5 * (spread[0] + spread[1]), np.hypot(0.5 * (spread[0] - spread[1]), spread[2])
    near = core[STAR_PX - 1 : STAR_PX + 2, STAR_PX - 1 : STAR_PX + 2]
    if near.max() > _ONE_PIXEL * near.sum() or middle + off > _LONG**2 * (middle - off):
        return None
    fine = (np.arange(len(axis) * _FINE) + 0.5) / _FINE - 0.5 - STAR_PX
    distance = np.hypot(fine - x, fine[:, None] - y)
    light = np.repeat(np.repeat(part, _FINE, 0), _FINE, 1)
    within, _ = np.histogram(distance, radii, weights=light)
    total = float(within.sum())
    return (np.append(0, np.cumsum(within)) / total, float(core.sum())) if total > 0 else None
