"""Look at single flight images, align two of them, and compare silhouette, texture and sky.

`flight_replay.py` says what each figure means and how the images come about.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, stats

import vbnfault
from vbnfault.core.files import user_files

F32 = NDArray[np.float32]
Mask = NDArray[np.bool_]

LIT = 0.12
_BRIGHT_PERCENTILE = 99.0
_BODY_LEVEL = 0.3  # of the brightest pixels: surely the body, to begin with
_OCTAVES_PX = ((2, 4), (4, 8), (8, 16), (16, 32), (32, 64))
_GLOW_RADII = ((0.05, 0.5), (0.5, 1.0), (1.0, 2.0), (2.0, 3.0))
_TRACK_SIGMAS = 6.0
# Lit parts belong to the body if they have this fraction of all lit pixels, or lie as near to the largest part as
# this, in radii of a disc of its area.
_LARGE_PART, _NEAR_BODY = 0.02, 0.4
_SMEAR = 0.1  # of the brightness: columns whose sky differs by more are smeared
_ALIGNED_SIGMA_PX = 1.5  # blur before the similarity is searched: finer texture is random
_MOST_TURN_RAD, _MOST_SCALE = 0.035, 0.02  # errors of pose that are mended
_CLIPPED = 0.5  # of the sky at 0: such a frame tells nothing of its background


@dataclass(frozen=True, kw_only=True, eq=False)
class Look:
    """Hold an image with its background and brightness, and what follows from them.

    `level` float32[y, x] is the brightness, 0 in the background and 1 at the 99th percentile of the lit body; `lit`
    bool[y, x] the lit silhouette, `sky` bool[y, x] what lies well outside it.
    """

    image: F32
    background: float
    bright: float
    level: F32
    lit: Mask
    sky: Mask

    @property
    def clipped(self) -> bool:
        """Return whether most of the sky is 0."""
        return bool((self.image[self.sky] == 0).mean() > _CLIPPED)


def look(image: NDArray[Any]) -> Look:
    """Return an image's brightness, lit silhouette and sky."""
    image = np.asarray(image, dtype=np.float32)
    body = image > _BODY_LEVEL * np.percentile(image, 99.5)
    far = ndimage.distance_transform_edt(~body) > 0.1 * np.sqrt(body.sum())
    background = float(np.median(image[far])) if far.any() else 0.0
    bright = float(np.percentile(image[body], _BRIGHT_PERCENTILE)) if body.any() else 1.0
    level = (image - _column_background(image, far, background, bright)) / max(bright - background, 1e-6)
    # spots of the sky are no body: keep what is large, or near the largest part
    labels, count = ndimage.label(ndimage.median_filter(level, 3) > LIT)
    sizes = np.bincount(labels.ravel(), minlength=count + 1)
    sizes[0] = 0
    away = ndimage.distance_transform_edt(labels != np.argmax(sizes))
    near = ndimage.minimum(away, labels, np.arange(count + 1)) < _NEAR_BODY * np.sqrt(sizes.max() / np.pi)
    kept = (sizes >= _LARGE_PART * sizes.sum()) | near
    kept[0] = False
    lit = (level > LIT) & ndimage.binary_dilation(kept[labels], iterations=2)
    sky = ndimage.distance_transform_edt(~lit) > max(3.0, 0.05 * np.sqrt(lit.sum() / np.pi))
    return Look(image=image, background=background, bright=bright, level=level, lit=lit, sky=sky)


def _column_background(image: F32, sky: Mask, background: float, bright: float) -> F32:
    """Return the background of each column, float32[x]: the same for all, unless smear or lost columns show."""
    with np.errstate(all="ignore"), warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # of columns without sky
        columns = np.nanmedian(np.where(sky, image, np.nan), axis=0)
    columns = np.where(np.isfinite(columns), columns, background)
    smeared = np.abs(columns - background).max() > _SMEAR * (bright - background)
    return np.asarray(columns if smeared else np.full_like(columns, background), dtype=np.float32)


def shift_between(real: Look, rendered: Look, *, search_px: int) -> tuple[float, float]:
    """Return the shift (x, y) in px that moves the rendered image onto the real one, to a tenth of a pixel.

    It maximises the correlation of brightness, which is 0 outside the lit silhouettes. The silhouettes alone give
    a shift up to a pixel off: in them the terminator, which depends on relief, counts as much as the limb.
    """
    a, b = (ndimage.gaussian_filter(np.clip(one.level, 0, 1) * one.lit, 1.0) for one in (real, rendered))
    product = np.fft.rfft2(a) * np.conj(np.fft.rfft2(b))
    correlation = np.fft.irfft2(product, a.shape)
    correlation = np.roll(correlation, (search_px, search_px), (0, 1))[: 2 * search_px + 1, : 2 * search_px + 1]
    y, x = np.unravel_index(np.argmax(correlation), correlation.shape)
    fine = [0.0, 0.0]
    for axis, (k, line) in enumerate(((x, correlation[y]), (y, correlation[:, x]))):
        if 0 < k < len(line) - 1:
            low, middle, high = (float(line[k + d]) for d in (-1, 0, 1))
            fine[axis] = 0.5 * (low - high) / min(low - 2 * middle + high, -1e-12)
    return float(x - search_px + fine[0]), float(y - search_px + fine[1])


def similarity_between(real: Look, rendered: Look, shift_xy: tuple[float, float]) -> NDArray[np.float64]:
    """Return the similarity float64[2, 3] that moves points (x, y) of the rendered image onto the real one.

    The affine map that correlates their brightness best (Evangelidis & Psarakis 2008, IEEE TPAMI 30, 1858) is
    searched near a shift; the similarity has its centre, its angle and its scale. Without convergence, and beyond
    `_MOST_TURN_RAD` and `_MOST_SCALE`, the shift alone is returned.
    """
    a, b = (cv2.GaussianBlur(np.clip(one.level, 0, 1.2), (0, 0), _ALIGNED_SIGMA_PX) for one in (real, rendered))
    start = np.array([[1, 0, -shift_xy[0]], [0, 1, -shift_xy[1]]], dtype=np.float32)
    stop = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 100, 1e-5)
    plain = np.array([[1, 0, shift_xy[0]], [0, 1, shift_xy[1]]], dtype=np.float64)
    try:
        _, back = cv2.findTransformECC(a, b, start, cv2.MOTION_AFFINE, stop, None, 5)
    except cv2.error:  # no convergence
        return plain
    affine = cv2.invertAffineTransform(back.astype(np.float64))
    scale = float(np.sqrt(max(np.linalg.det(affine[:, :2]), 1e-9)))
    turn = float(np.arctan2(affine[1, 0] - affine[0, 1], affine[0, 0] + affine[1, 1]))
    if abs(turn) > _MOST_TURN_RAD or abs(scale - 1) > _MOST_SCALE:
        return plain
    middle = 0.5 * np.array(real.level.shape[::-1]) - 0.5
    turned = scale * np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    onto = affine[:, :2] @ middle + affine[:, 2]
    return np.column_stack([turned, onto - turned @ middle])


def shifted(image: NDArray[Any], shift_xy: tuple[int, int]) -> NDArray[Any]:
    """Return an image moved by whole pixels, continued beyond its edges by its mirror image."""
    x, y = shift_xy
    border = max(abs(x), abs(y))
    padded = np.pad(image, border, mode="symmetric")
    height, width = image.shape
    return np.asarray(padded[border - y : border - y + height, border - x : border - x + width])


def limb_px(a: Mask, b: Mask, sun_xy: NDArray[np.float64]) -> float:
    """Return the median distance between the bright limbs of two lit silhouettes, both ways, in px.

    The bright limb is the edge whose outward normal lies within 45° of the Sun's direction in the image.
    """
    edges = []
    for lit in (a, b):
        whole = ndimage.binary_fill_holes(lit)
        gradient = [
            -ndimage.gaussian_filter(whole.astype(np.float32), 3.0, order=order) for order in ((0, 1), (1, 0))
        ]
        length = np.hypot(*gradient)
        towards = (gradient[0] * sun_xy[0] + gradient[1] * sun_xy[1]) / np.maximum(length, 1e-9)
        edge = whole & ~ndimage.binary_erosion(whole, border_value=1)
        edges.append(edge & (towards > 0.5**0.5))
    if not edges[0].any() or not edges[1].any():
        return float("nan")
    far = [ndimage.distance_transform_edt(~edge) for edge in edges]
    return float(np.median(np.concatenate([far[1][edges[0]], far[0][edges[1]]])))


def octave_variances(level: F32, inside: Mask) -> dict[str, float]:
    """Return the variance of brightness over its mean, inside a mask, in octaves of wavelength.

    Octaves are differences of Gaussians that see the pixels of the mask only.
    """

    def smooth(sigma: float) -> NDArray[np.float64]:
        weight = ndimage.gaussian_filter(inside.astype(np.float64), sigma)
        return np.asarray(
            ndimage.gaussian_filter(np.where(inside, level, 0.0).astype(np.float64), sigma)
            / np.maximum(weight, 1e-9)
        )

    mean = float(level[inside].mean()) if inside.any() else 1.0
    out = {}
    for short, long in _OCTAVES_PX:
        # a Gaussian of deviation s passes half the amplitude at the wavelength 2 π s / sqrt(2 ln 2)
        low, high = (length * np.sqrt(2 * np.log(2)) / (2 * np.pi) for length in (short, long))
        band = (smooth(low) - smooth(high))[inside] / mean
        out[f"power_{short}_{long}"] = float(band.var()) if band.size else float("nan")
    return out


def sky_figures(one: Look, around: Mask) -> dict[str, float]:
    """Return background, glow, noise, column texture and tracks of the sky outside `around`, see the module."""
    scale = max(one.bright - one.background, 1e-6)
    radius_px = float(np.sqrt(around.sum() / np.pi))
    away = ndimage.distance_transform_edt(~around) / max(radius_px, 1.0)
    sky = one.sky & (away > 0.05)
    image = one.image
    residual = image - ndimage.median_filter(image, 5)
    ordinary = np.abs(residual[sky]) < 4 * max(float(np.std(residual[sky])), 1e-6)
    noise = float(np.std(residual[sky][ordinary]))
    out = {"sky": one.background / max(one.bright, 1e-6)}
    for low, high in _GLOW_RADII:
        ring = sky & (away > low) & (away <= high)
        out[f"glow_{high:g}"] = (
            float(image[ring].mean()) / max(one.bright, 1e-6) if ring.sum() > 100 else float("nan")
        )
    out["noise"] = noise / scale
    with np.errstate(all="ignore"):
        columns = np.array(
            [image[sky[:, k], k].mean() if sky[:, k].sum() > 20 else np.nan for k in range(image.shape[1])]
        )
    known = np.isfinite(columns)
    texture = columns[known] - ndimage.median_filter(columns[known], 31)
    deviation = texture - np.median(texture)
    out["column"] = float(1.4826 * np.median(np.abs(deviation))) / scale if known.any() else float("nan")
    spots, _ = ndimage.label((residual > _TRACK_SIGMAS * max(noise, 0.5)) & sky, np.ones((3, 3)))
    out["tracks"] = float((np.bincount(spots.ravel())[1:] >= 2).sum())
    return out


def compare(real: Look, rendered: Look, sun_xy: NDArray[np.float64]) -> dict[str, float]:
    """Return all figures of one aligned pair; those of the sky as `NAME real` and `NAME rendered`."""
    both, either = real.lit & rendered.lit, real.lit | rendered.lit
    inside = ndimage.binary_erosion(both, iterations=3)
    out = {
        "iou": float(both.sum() / max(either.sum(), 1)),
        "limb_px": limb_px(real.lit, rendered.lit, sun_xy),
        "rank": float(stats.spearmanr(real.level[both], rendered.level[both]).statistic),
    }
    spectra = [octave_variances(one.level, inside) for one in (real, rendered)]
    out |= {name: spectra[1][name] / max(spectra[0][name], 1e-12) for name in spectra[0]}
    for which, one in (("real", real), ("rendered", rendered)):
        unusable = real.clipped
        out |= {
            f"{name} {which}": float("nan") if unusable and name != "tracks" else value
            for name, value in sky_figures(one, either).items()
        }
    return out


def summary(figures: Sequence[Mapping[str, float]]) -> dict[str, tuple[float, float]]:
    """Return median and worst 5 % of each figure: the 5th percentile, or the 95th where less is better."""
    out = {}
    for name in figures[0]:
        values = np.array([one[name] for one in figures])
        values = values[np.isfinite(values)]
        worst = 5 if name in ("iou", "rank") else 95
        out[name] = (
            (float(np.median(values)), float(np.percentile(values, worst))) if len(values) else (np.nan, np.nan)
        )
    return out


def reduced(frame: NDArray[np.uint8], width_px: int) -> NDArray[np.uint8]:
    """Return a frame at another width, by the means of areas."""
    height_px = round(frame.shape[0] * width_px / frame.shape[1])
    return np.asarray(cv2.resize(frame, (width_px, height_px), interpolation=cv2.INTER_AREA), dtype=np.uint8)


def read_frame(folder: Path, name: str) -> NDArray[np.uint8]:
    """Return a real frame, uint8[y, x]. Raises InputError."""
    path = folder / f"{name}.png"
    data = user_files.read_input(path, "texture", types=(".png",))
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE)
    if image is None:
        raise vbnfault.InputError(f"{path}: is no PNG image")
    return np.asarray(image, dtype=np.uint8)
