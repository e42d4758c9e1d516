"""Measure how far a fault moves the limb, the body's lit edge against the sky, and the centre of brightness."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates, spline_filter
from scipy.spatial import cKDTree

from ..core.errors import InputError
from .images import F32, F64, intensity, same_shape

# Steps along a normal in px. A parabola through three samples of the gradient of a blurred edge is then true to
# 0.01 px.
_STEP_PX = 0.25
# Blur of the gradient's kernel in px: the noise of a pixel falls to a sixth, and an edge stays within 1.5 px.
_SIGMA_PX = 1.0
# Blur of the mask whose gradient is the normal: it evens out the steps of a mask on a grid.
_NORMAL_SIGMA_PX = 3.0
# A gradient counts as an edge from this multiple of the deviation of the sky's gradients on: 5 σ in the some fifty
# independent samples of a normal is exceeded by chance on one normal in 30,000.
_NOISE_FACTOR = 5.0
# ... and in the clean twin from this fraction of the limb's strong gradients on, which leaves out the dark limb.
_LIT_FRACTION = 0.1
# The first gradient of this fraction of the strongest on the normal, coming from the sky, is the limb.
_FIRST_FRACTION = 0.5
# The clean edge is the limb's if it lies as near to the mask's edge as this. The mask's own pixels are off by 1 px.
_NEAR_PX = 2.5
_MOST_NORMALS = 2000
_LEAST_NORMALS = 8
_ALIGNMENTS = 4
_LEAST_SPREAD = 0.02  # mean square of the normals' smaller component; an arc of 28 degrees has less
_SKY_FRACTION = 0.25  # of a normal, its outer end: there only sky, whose noise is measured


@dataclass(frozen=True, kw_only=True, eq=False)
class LimbError:
    """Hold the error of the limb's position along its normals.

    Attributes
    ----------
    rms_px
        Root mean square of the edges' displacements along the normals, √(Σ (e_image − e_clean)² / N) for the
        positions e of the N edges that both images show. For a whole circle that moves by s > 0 it is s/√2. NaN
        where `reason` says why there is none.
    median_px
        Median of their absolute values.
    shift_px
        float64[2]: x and y of the common displacement, by least squares over the normals. NaN where the normals
        are too much alike to tell it.
    lost_fraction
        Fraction of the clean twin's edges that the image does not show.
    xy, normals, displacements_px
        float64[n, 2], float64[n, 2], float64[n]: the edges of the clean twin that both images show, the unit
        normals towards the sky, and the displacements along them, positive towards the sky.
    reason
        Why there is no error; "": there is one.
    """

    rms_px: float = float("nan")
    median_px: float = float("nan")
    shift_px: F64 = field(default_factory=lambda: np.full(2, np.nan))
    lost_fraction: float = float("nan")
    xy: F64 = field(default_factory=lambda: np.empty((0, 2)))
    normals: F64 = field(default_factory=lambda: np.empty((0, 2)))
    displacements_px: F64 = field(default_factory=lambda: np.empty(0))
    reason: str = ""


def limb_error(
    clean: NDArray[Any],
    image: NDArray[Any],
    body: NDArray[np.bool_],
    *,
    sky: NDArray[np.bool_] | None = None,
    search_px: float = 8.0,
) -> LimbError:
    """Return how far the lit limb of the image lies from that of its clean twin, in px along the limb's normals.

    The true mask gives pixels of the limb and their normals. Along each normal, coming from the sky, the edge is
    the first maximum of the intensity's gradient (by a Gaussian of 1 px) that reaches half of the strongest one. A
    parabola gives its sub-pixel position.

    Parameters
    ----------
    clean, image
        Images of the same size (`intensity`).
    body
        bool[y, x]: pixels that truly show the body.
    sky
        bool[y, x]: pixels that truly show the sky; default: all others. Pixels that show something else, such as
        the Sun or the spacecraft, belong to neither.
    search_px
        Half the length of a normal: the largest error that can be measured, from 3 to 64 px.

    Returns
    -------
    LimbError
        With NaN and a reason where the frame holds no limb, or where one of the images does not show it.

    Raises
    ------
    InputError
        An array is no image, the sizes differ, or `search_px` is out of range.

    References
    ----------
    Christian (2017), Accurate Planetary Limb Localization for Image-Based Spacecraft Navigation, J. Spacecraft
    Rockets 54, 708.
    Mortari, D'Souza and Zanetti (2016), Image Processing of Illuminated Ellipsoid, J. Spacecraft Rockets 53, 448.
    """
    if not 3 <= search_px <= 64:
        raise InputError(f"search_px = {search_px:g}: must be from 3 to 64 px")
    before, after = intensity(clean, "clean"), intensity(image, "image")
    same_shape(before, after, "clean", "image")
    body, sky = _masks(before, body, sky)
    xy, normals = limb_normals(body, sky, margin_px=search_px + 3 * _SIGMA_PX)
    if len(xy) < _LEAST_NORMALS:
        return LimbError(reason="no limb is in the frame: it shows no edge between body and sky")
    xy, normals, clean_edge_px = _lit_edges(before, xy, normals, search_px)
    if len(xy) < _LEAST_NORMALS:
        return LimbError(reason="the clean twin shows no lit limb")
    edge_px, strength, noise = _edges(after, xy, normals, search_px)
    kept = strength > _NOISE_FACTOR * noise
    lost = 1 - np.count_nonzero(kept) / len(kept)
    if np.count_nonzero(kept) < _LEAST_NORMALS:
        return LimbError(lost_fraction=lost, reason="the image shows no limb where the clean twin has it")
    xy, normals = xy[kept] + clean_edge_px[kept, None] * normals[kept], normals[kept]
    return _summarised(xy, normals, (edge_px - clean_edge_px)[kept], lost)


def _masks(
    image: F32, body: NDArray[np.bool_], sky: NDArray[np.bool_] | None
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Return the masks of body and sky, by default all that is not body. Raises InputError if a size differs."""
    body = np.asarray(body, dtype=bool)
    sky = ~body if sky is None else np.asarray(sky, dtype=bool)
    same_shape(image, body, "clean", "body")
    same_shape(image, sky, "clean", "sky")
    return body, sky


def _summarised(clean_xy: F64, normals: F64, displacements_px: F64, lost_fraction: float) -> LimbError:
    """Return the error of displacements along the normals from edges of the clean twin."""
    return LimbError(
        rms_px=float(np.sqrt(np.mean(displacements_px**2))),
        median_px=float(np.median(np.abs(displacements_px))),
        shift_px=_common_shift(clean_xy, normals, clean_xy + displacements_px[:, None] * normals),
        lost_fraction=lost_fraction,
        xy=clean_xy,
        normals=normals,
        displacements_px=displacements_px,
    )


def limb_normals(body: NDArray[np.bool_], sky: NDArray[np.bool_], *, margin_px: float = 0.0) -> tuple[F64, F64]:
    """Return pixels of the body next to the sky, and the limb's unit normals there, towards the sky.

    Parameters
    ----------
    body, sky
        bool[y, x] each.
    margin_px
        Pixels closer to the frame's edge are left out.

    Returns
    -------
    float64[n, 2], float64[n, 2]
        Centres of at most 2000 pixels, evenly taken, and the normals.
    """
    beside = cv2.dilate(sky.astype(np.uint8), np.ones((3, 3), np.uint8)).astype(bool)
    row, column = np.nonzero(body & beside)
    height, width = body.shape
    inside = (column >= margin_px) & (column < width - margin_px) & (row >= margin_px) & (row < height - margin_px)
    row, column = row[inside], column[inside]
    every = -(-len(row) // _MOST_NORMALS) if len(row) else 1
    row, column = row[::every], column[::every]
    if not len(row):
        return np.empty((0, 2)), np.empty((0, 2))
    smooth = cv2.GaussianBlur(body.astype(np.float32), (0, 0), _NORMAL_SIGMA_PX)
    gradient = np.column_stack([_difference(smooth, row, column, 0, 1), _difference(smooth, row, column, 1, 0)])
    length = np.hypot(gradient[:, 0], gradient[:, 1])
    # a thin ridge of ground, or of sky, has no side: its gradient vanishes
    straight = length > 0.25 / (_NORMAL_SIGMA_PX * np.sqrt(2 * np.pi))
    centres = np.column_stack([column, row])[straight] + 0.5
    return centres, -gradient[straight] / length[straight, None]


def _difference(smooth: F32, row: NDArray[np.int64], column: NDArray[np.int64], dy: int, dx: int) -> F64:
    """Return the central difference of an image along y or x at some pixels, float64[n]."""
    height, width = smooth.shape
    ahead = smooth[np.minimum(row + dy, height - 1), np.minimum(column + dx, width - 1)]
    behind = smooth[np.maximum(row - dy, 0), np.maximum(column - dx, 0)]
    return (ahead - behind).astype(np.float64) / 2


def _edges(image: F32, xy: F64, normals: F64, search_px: float) -> tuple[F64, F64, float]:
    """Return the positions of the edges along the normals, their gradients, and the noise of the sky's gradients.

    The noise is a standard deviation. A position float64[n] in px counts from `xy` towards the sky. The gradient is
    the fall of the intensity per px.
    """
    along = np.arange(-round(search_px / _STEP_PX), round(search_px / _STEP_PX) + 1) * _STEP_PX
    # the part of the image around the limb is enough, and costs less
    reach = int(np.ceil(search_px + 6 * _SIGMA_PX))
    low = np.maximum(np.floor(xy.min(axis=0)).astype(int) - reach, 0)
    high = np.ceil(xy.max(axis=0)).astype(int) + reach
    part = cv2.GaussianBlur(image[low[1] : high[1], low[0] : high[0]], (0, 0), _SIGMA_PX)
    at = xy[:, None, :] + along[:, None] * normals[:, None, :] - 0.5 - low
    splines = spline_filter(part, order=3, output=np.float32, mode="nearest")
    profile = map_coordinates(splines, [at[..., 1], at[..., 0]], order=3, mode="nearest", prefilter=False)
    fall = -np.gradient(profile.astype(np.float64), _STEP_PX, axis=1)
    strongest = fall.max(axis=1)
    k = _first_maximum(fall, _FIRST_FRACTION * strongest)
    n = np.arange(len(k))
    before, here, after = fall[n, k - 1], fall[n, k], fall[n, k + 1]
    bend = before - 2 * here + after
    with np.errstate(invalid="ignore", divide="ignore"):
        offset = np.where(bend < 0, (before - after) / (2 * bend), 0.0)
    positions = along[k] + np.clip(offset, -1, 1) * _STEP_PX
    sky = fall[:, -int(_SKY_FRACTION * len(along)) :]
    noise = 1.4826 * float(np.median(np.abs(sky - np.median(sky, axis=1, keepdims=True))))
    return positions, here, noise


def _lit_edges(clean: F32, xy: F64, normals: F64, search_px: float) -> tuple[F64, F64, F64]:
    """Return where the clean twin shows a lit limb: pixels [n, 2], normals [n, 2], offsets of its edges, px [n]."""
    positions, strength, noise = _edges(clean, xy, normals, search_px)
    strong = float(np.percentile(strength, 95))
    lit = (strength > max(_NOISE_FACTOR * noise, _LIT_FRACTION * strong)) & (np.abs(positions) <= _NEAR_PX)
    return xy[lit], normals[lit], positions[lit]


def _first_maximum(fall: F64, least: F64) -> NDArray[np.int64]:
    """Return the index of the first local maximum from `least` on, coming from the sky, int64[normal]."""
    inner = fall[:, 1:-1]
    peak = (inner >= fall[:, :-2]) & (inner >= fall[:, 2:]) & (inner >= least[:, None])
    from_the_sky = np.argmax(peak[:, ::-1], axis=1)
    k = peak.shape[1] - from_the_sky
    # a normal without an inner maximum rises to its end: it has no edge within reach
    return np.where(peak.any(axis=1), k, fall.shape[1] // 2)


def _common_shift(clean_xy: F64, normals: F64, moved_xy: F64) -> F64:
    """Return the shift that brings the moved edges nearest to the line of the clean ones, float64[2] px.

    It is NaN where it is not unique. The line is that of the tangents at the nearest clean edges, so that a curved
    limb causes no bias of the order of shift² / radius (point-to-line ICP, Chen and Medioni 1992).
    """
    shift, tree = np.zeros(2), cKDTree(clean_xy)
    for _ in range(_ALIGNMENTS):
        _, nearest = tree.query(moved_xy - shift)
        across = normals[nearest]
        normal_matrix = across.T @ across
        # of a straight limb only one component shows: then the smaller eigenvalue vanishes
        if np.linalg.eigvalsh(normal_matrix)[0] < _LEAST_SPREAD * len(normals):
            return np.full(2, np.nan)
        off = np.sum(across * (moved_xy - shift - clean_xy[nearest]), axis=1)
        shift = shift + np.linalg.solve(normal_matrix, across.T @ off)
    return shift


# --- the centre of brightness -----------------------------------------------------------------------------------

# The threshold as a fraction of the image's bright level, and the percentile that is this level. Up to 0.1 % of
# defective pixels do not move the level.
_THRESHOLD_FRACTION = 0.1
_BRIGHT_PERCENTILE = 99.9


@dataclass(frozen=True, kw_only=True, eq=False)
class CentroidShift:
    """Hold the shift of the centre of brightness.

    `distance_px` is its length and `shift_px` float64[2] its x and y, faulted image minus clean twin; both are NaN
    where `reason` says why there is none.
    """

    distance_px: float
    shift_px: F64 = field(default_factory=lambda: np.full(2, np.nan))
    reason: str = ""


def centroid_shift(clean: NDArray[Any], image: NDArray[Any]) -> CentroidShift:
    """Return how far the centre of brightness of the image lies from that of its clean twin, in px.

    The centre is the first moment of the signal above a threshold,

        c = Σ max(I − τ, 0) (x, y) / Σ max(I − τ, 0),

    as optical navigation computes it of a distant body, before a correction for the phase angle. The threshold τ is
    a tenth of the 99.9th percentile of the image itself, as a navigator without the clean twin would set it. The
    signal is counted from τ, so that a shift by a fraction of a pixel moves no pixel suddenly in or out.

    Where the body fills the frame, the metric is the shift of the centre of brightness of the ground; it then says
    more about gradients of brightness than about a direction.

    Parameters
    ----------
    clean, image
        Images of the same size (`intensity`).

    Raises
    ------
    InputError
        An array is no image, or the sizes differ.

    References
    ----------
    Owen (2011), Methods of Optical Navigation, AAS 11-215.
    Christian and Lightsey (2012), Onboard Image-Processing Algorithm for a Spacecraft Optical Navigation Sensor
    System, Journal of Spacecraft and Rockets 49, 337.
    """
    before, after = intensity(clean, "clean"), intensity(image, "image")
    same_shape(before, after, "clean", "image")
    centres = _centre_of_brightness(before), _centre_of_brightness(after)
    for centre, name in zip(centres, ("clean twin", "image"), strict=True):
        if centre is None:
            return CentroidShift(distance_px=float("nan"), reason=f"the {name} has no signal above its threshold")
    assert centres[0] is not None
    assert centres[1] is not None
    shift = centres[1] - centres[0]
    return CentroidShift(distance_px=float(np.hypot(*shift)), shift_px=shift)


def _centre_of_brightness(image: F32) -> F64 | None:
    """Return x and y of the centre of brightness, float64[2] px; None where no pixel is above the threshold."""
    # the percentile of every second row and column of a large image is that of the image
    step = 2 if min(image.shape) >= 256 else 1
    threshold = _THRESHOLD_FRACTION * max(float(np.percentile(image[::step, ::step], _BRIGHT_PERCENTILE)), 0.0)
    signal = np.maximum(image - np.float32(threshold), 0)
    columns, lines = signal.sum(axis=0, dtype=np.float64), signal.sum(axis=1, dtype=np.float64)
    total = float(columns.sum())
    if total <= 0:
        return None
    x, y = np.arange(image.shape[1]) + 0.5, np.arange(image.shape[0]) + 0.5
    return np.array([columns @ x, lines @ y]) / total
