"""Measure for how many views of one site a feature can be tracked."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.errors import InputError
from .features import CORNERS, RIGHT_WITHIN_PX, corners
from .geometry import CameraView
from .images import F64, eight_bit, intensity, same_shape, white_level

# Lucas and Kanade's window, and pyramid levels for displacements of up to about a quarter of the frame.
_WINDOW_PX = 21
_LEVELS = 5
_LEAST_LEVEL_PX = 32  # the coarsest level is not narrower


@dataclass(frozen=True, kw_only=True, eq=False)
class FeatureLifetime:
    """Hold for how many views features are tracked.

    `mean_views` is the mean of `views` int64[feature]; NaN where `reason` says why there is none. A corner on the
    sky has no point of the ground, so its lifetime is 0.
    """

    mean_views: float
    views: NDArray[np.int64] = field(default_factory=lambda: np.empty(0, dtype=np.int64))
    reason: str = ""


def feature_lifetime(
    images: Sequence[NDArray[Any]],
    views: Sequence[CameraView],
    *,
    white: float | None = None,
    tolerance_px: float = RIGHT_WITHIN_PX,
) -> FeatureLifetime:
    """Return for how many consecutive views the corners of the first one are tracked rightly.

    Corners of the first image (`corners`) are tracked from image to image by the method of Lucas and Kanade in a
    pyramid. A feature lives as long as its track lies within the frame and within the tolerance of the true
    reprojection of its point of the ground. The metric is the mean number of views, the first included.

    Parameters
    ----------
    images
        Images of one size (`intensity`) in the order of the flight.
    views
        Their views; `depth_m` of the first is needed.
    white
        Signal that counts as 255; default: 255 for uint8, else the largest of the first image.
    tolerance_px
        Largest distance in px.

    Returns
    -------
    FeatureLifetime
        From 0 to the number of images.

    Raises
    ------
    InputError
        An array is no image, sizes or numbers differ, or the first view has no depth.

    References
    ----------
    Lucas and Kanade (1981), An Iterative Image Registration Technique, IJCAI, 674.
    Bouguet (2001), Pyramidal Implementation of the Affine Lucas Kanade Feature Tracker, Intel.
    Shi and Tomasi (1994), Good Features to Track, CVPR, 593.
    """
    if not len(images) or len(images) != len(views):
        raise InputError(f"images: {len(images)}, views: {len(views)}: must be equally many, at least 1")
    _check_sizes(images)
    level = white_level(images[0]) if white is None else white
    track = corners(images[0], white=level, count=CORNERS)
    if not len(track):
        return FeatureLifetime(mean_views=float("nan"), reason="the first image has no corner")
    points_T_m = views[0].points_T_m(track)
    alive = np.isfinite(points_T_m).all(axis=1)
    lifetime = alive.astype(np.int64)
    before = eight_bit(images[0], level)
    for image, view in zip(images[1:], views[1:], strict=True):
        if not alive.any():
            break
        after = eight_bit(image, level)
        track, tracked = _tracked(before, after, track)
        alive = alive & tracked & _is_right(track, view.project(points_T_m), after.shape, tolerance_px)
        lifetime = lifetime + alive.astype(np.int64)
        before = after
    return FeatureLifetime(mean_views=float(lifetime.mean()), views=np.asarray(lifetime))


def _check_sizes(images: Sequence[NDArray[Any]]) -> None:
    """Raise InputError if an array is no image, or if the sizes differ."""
    first = intensity(images[0], "images[0]")
    for k, image in enumerate(images[1:], start=1):
        same_shape(first, intensity(image, f"images[{k}]"), "images[0]", f"images[{k}]")


def _is_right(xy: F64, true_xy: F64, shape: tuple[int, ...], tolerance_px: float) -> NDArray[np.bool_]:
    """Return whether positions lie within the frame and the tolerance of the true ones, bool[n]."""
    with np.errstate(invalid="ignore"):
        off = xy - true_xy
        near = np.hypot(off[:, 0], off[:, 1]) <= tolerance_px
    return near & (xy >= 0).all(axis=1) & (xy[:, 0] < shape[1]) & (xy[:, 1] < shape[0])


def _tracked(before: NDArray[np.uint8], after: NDArray[np.uint8], xy: F64) -> tuple[F64, NDArray[np.bool_]]:
    """Return where features of one image lie in the next, float64[n, 2], and whether they were tracked, bool[n]."""
    smallest = min(before.shape)
    levels = int(np.clip(np.log2(smallest / _LEAST_LEVEL_PX) if smallest else 0, 0, _LEVELS))
    start = (xy - 0.5).astype(np.float32).reshape(-1, 1, 2)
    end, status, _ = cv2.calcOpticalFlowPyrLK(
        before, after, start, start.copy(), winSize=(_WINDOW_PX, _WINDOW_PX), maxLevel=levels
    )
    return end.reshape(-1, 2).astype(np.float64) + 0.5, status.ravel().astype(bool)
