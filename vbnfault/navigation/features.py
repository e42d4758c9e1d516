"""Detect features, compare those of two images of one view, match those of two views, and track them over many."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from ..core.errors import InputError
from .geometry import CameraView, reprojected
from .images import F64, U8, eight_bit, intensity, same_shape, white_level

# Corners of a frame, and the least distance between two of them in px, as trackers of space flight use.
CORNERS = 500
_CORNER_DISTANCE_PX = 8.0
_CORNER_QUALITY = 0.01
_CORNER_BLOCK_PX = 5
# ORB: as many as in ORB-SLAM2 (Mur-Artal and Tardós 2017) for a frame of this size, and its lower FAST threshold.
ORB_FEATURES = 1000
_ORB_FAST_DN = 7
_ORB_BORDER_PX = 16  # the descriptor's patch has a radius of 15 px
_ORB_LEVELS = 8
_ORB_SCALE = 1.2
_LEAST_SIZE_PX = 2 * _ORB_BORDER_PX + 1
# Two views with their clean twins, whose features several metrics need.
_IMAGES_KEPT = 4

# A feature is found again within this distance (Mikolajczyk and Schmid 2005; Schmid et al. 2000, 1.5 px).
REPEATED_WITHIN_PX = 1.5
# A match is right within this distance of the true reprojection.
RIGHT_WITHIN_PX = 3.0
# Lowe's (2004) ratio of the nearest to the second nearest descriptor.
_RATIO = 0.8


@dataclass(frozen=True, kw_only=True, eq=False)
class Repeatability:
    """Hold how many features of the clean twin are detected again.

    `fraction` in [0, 1] is NaN where the clean twin has no feature, and `reason` says so. `clean`, `image` and
    `repeated` count the features of both images, and the pairs of them.
    """

    fraction: float
    clean: int
    image: int
    repeated: int
    reason: str = ""


@dataclass(frozen=True, kw_only=True, eq=False)
class Matches:
    """Hold matched pixels of two images, float64[n, 2] each, row by row."""

    first_xy: F64
    second_xy: F64

    def __len__(self) -> int:
        return len(self.first_xy)


def corners(image: NDArray[Any], *, white: float | None = None, count: int = CORNERS) -> F64:
    """Return the strongest corners of an image after Shi and Tomasi, float64[n, 2] px, n at most `count`.

    The score is the smaller eigenvalue of Σ ∇I ∇Iᵀ over 5 × 5 px; corners are at least 8 px apart and have at least
    a hundredth of the best score.

    Parameters
    ----------
    image
        The image (`intensity`).
    white
        Signal that counts as 255; default: 255 for uint8, else the largest of the image.
    count
        The most corners.

    Raises
    ------
    InputError
        The array is no image.

    References
    ----------
    Shi and Tomasi (1994), Good Features to Track, CVPR, 593.
    """
    grey = eight_bit(image, white_level(image) if white is None else white)
    return _corners(grey, count)


def _corners(grey: U8, count: int) -> F64:
    """Return `corners` of an 8-bit image."""
    found = cv2.goodFeaturesToTrack(
        grey, count, _CORNER_QUALITY, _CORNER_DISTANCE_PX, blockSize=_CORNER_BLOCK_PX, useHarrisDetector=False
    )
    return np.empty((0, 2)) if found is None else found.reshape(-1, 2).astype(np.float64) + 0.5


def corner_repeatability(
    clean: NDArray[Any], image: NDArray[Any], *, tolerance_px: float = REPEATED_WITHIN_PX
) -> Repeatability:
    """Return the fraction of the clean twin's corners that the image has, too.

    r = (pairs of corners within the tolerance) / (corners of the clean twin). Both images show one view, so that
    the homography of Schmid et al. is the identity. A pair are two corners that are each other's nearest. Schmid et
    al. and Mikolajczyk and Schmid divide by the smaller of both counts, which gives 1 where one corner alone
    survives; here the count is that of the clean twin, so the fraction is what a navigator keeps.

    Parameters
    ----------
    clean, image
        Images of the same size (`intensity`).
    tolerance_px
        Largest distance of a pair in px.

    Raises
    ------
    InputError
        An array is no image, or the sizes differ.

    References
    ----------
    Schmid, Mohr and Bauckhage (2000), Evaluation of Interest Point Detectors, IJCV 37, 151.
    Mikolajczyk and Schmid (2005), A Performance Evaluation of Local Descriptors, IEEE TPAMI 27, 1615.
    """
    before, after = _pair(clean, image)
    return _repeatability(_corners(before, CORNERS), _corners(after, CORNERS), tolerance_px)


def orb_repeatability(
    clean: NDArray[Any], image: NDArray[Any], *, tolerance_px: float = REPEATED_WITHIN_PX
) -> Repeatability:
    """Return the fraction of the clean twin's ORB features that the image has, too.

    As `corner_repeatability`, for oriented FAST corners in a pyramid of eight levels. The tolerance holds on the
    level of a feature, and a pair lies on equal or neighbouring levels.

    Parameters
    ----------
    clean, image
        Images of the same size (`intensity`).
    tolerance_px
        Largest distance of a pair on the finest level, in px.

    Raises
    ------
    InputError
        An array is no image, or the sizes differ.

    References
    ----------
    Rublee et al. (2011), ORB: an Efficient Alternative to SIFT or SURF, ICCV, 2564.
    Mikolajczyk and Schmid (2005), A Performance Evaluation of Local Descriptors, IEEE TPAMI 27, 1615.
    """
    positions = []
    for grey in _pair(clean, image):
        xy, level, _ = _orb(grey)
        # two levels apart are two tolerances apart, so that no such pair counts
        in_scale = np.column_stack([xy / _ORB_SCALE ** level[:, None], 0.7 * tolerance_px * level])
        positions.append(in_scale)
    return _repeatability(positions[0], positions[1], tolerance_px)


def _pair(clean: NDArray[Any], image: NDArray[Any]) -> tuple[U8, U8]:
    """Return two images of one size with 8 bits, on the scale of the clean one."""
    same_shape(intensity(clean, "clean"), intensity(image, "image"), "clean", "image")
    white = white_level(clean)
    return eight_bit(clean, white, "clean"), eight_bit(image, white)


def _repeatability(clean: F64, image: F64, tolerance: float) -> Repeatability:
    """Return the repeatability of positions, float64[n, k] each."""
    if not len(clean):
        return Repeatability(
            fraction=float("nan"), clean=0, image=len(image), repeated=0, reason="the clean twin has no feature"
        )
    repeated = 0
    if len(image):
        to_image, nearest_image = cKDTree(image).query(clean, distance_upper_bound=np.nextafter(tolerance, np.inf))
        _, nearest_clean = cKDTree(clean).query(image)
        near = np.isfinite(to_image)
        back = nearest_clean[np.where(near, nearest_image, 0)]
        repeated = int(np.count_nonzero(near & (back == np.arange(len(clean)))))
    return Repeatability(fraction=repeated / len(clean), clean=len(clean), image=len(image), repeated=repeated)


# --- matches -------------------------------------------------------------------------------------------------


def match(
    first: NDArray[Any],
    second: NDArray[Any],
    *,
    white: float | None = None,
    unused: tuple[NDArray[np.bool_] | None, NDArray[np.bool_] | None] = (None, None),
) -> Matches:
    """Return matched ORB features of two images, which may show different views.

    A match are two descriptors that are each other's nearest by Hamming distance, the distance being at most 0.8
    times that of the second nearest.

    Parameters
    ----------
    first, second
        Images (`intensity`).
    white
        Signal that counts as 255; default: 255 for uint8, else the largest of the first image.
    unused
        Masks of the images, bool[y, x] or None each: no feature is detected in their pixels, so that others count
        among the strongest.

    Raises
    ------
    InputError
        An array is no image, or a mask has another size.

    References
    ----------
    Rublee et al. (2011), ORB: an Efficient Alternative to SIFT or SURF, ICCV, 2564.
    Lowe (2004), Distinctive Image Features from Scale-Invariant Keypoints, IJCV 60, 91.
    """
    level = white_level(first) if white is None else white
    (xy_a, _, a), (xy_b, _, b) = (
        _orb(eight_bit(image, level, name), mask)
        for image, name, mask in ((first, "first", unused[0]), (second, "second", unused[1]))
    )
    nothing = Matches(first_xy=np.empty((0, 2)), second_xy=np.empty((0, 2)))
    if len(a) < 2 or len(b) < 2:
        return nothing
    distance, nearest = cv2.batchDistance(a, b, cv2.CV_32S, normType=cv2.NORM_HAMMING, K=2)
    _, back = cv2.batchDistance(b, a, cv2.CV_32S, normType=cv2.NORM_HAMMING, K=1)
    mutual = back[nearest[:, 0], 0] == np.arange(len(a))
    chosen = mutual & (distance[:, 0] <= _RATIO * distance[:, 1])
    if not chosen.any():
        return nothing
    return Matches(first_xy=xy_a[chosen], second_xy=xy_b[nearest[chosen, 0]])


def _orb(grey: U8, unused: NDArray[np.bool_] | None = None) -> tuple[F64, NDArray[np.int64], U8]:
    """Return positions float64[n, 2], pyramid levels int64[n] and descriptors uint8[n, 32] of ORB features."""
    if unused is not None:
        same_shape(grey, unused, "image", "unused")
    if min(grey.shape) < _LEAST_SIZE_PX:
        return np.empty((0, 2)), np.empty(0, dtype=np.int64), np.empty((0, 32), dtype=np.uint8)
    used = None if unused is None else np.logical_not(unused).tobytes()
    return _orb_of((grey.shape[0], grey.shape[1]), grey.tobytes(), used)


@lru_cache(maxsize=_IMAGES_KEPT)
def _orb_of(shape: tuple[int, int], pixels: bytes, used: bytes | None) -> tuple[F64, NDArray[np.int64], U8]:
    """Return `_orb` of an image's shape, pixels and used pixels, read-only."""
    detector = cv2.ORB_create(
        nfeatures=ORB_FEATURES,
        scaleFactor=_ORB_SCALE,
        nlevels=_ORB_LEVELS,
        edgeThreshold=_ORB_BORDER_PX,
        fastThreshold=_ORB_FAST_DN,
    )
    image, mask = (
        None if data is None else np.frombuffer(data, dtype=np.uint8).reshape(shape) for data in (pixels, used)
    )
    points, descriptors = detector.detectAndCompute(image, mask)
    xy = np.array([point.pt for point in points], dtype=np.float64).reshape(-1, 2) + 0.5
    level = np.array([point.octave for point in points], dtype=np.int64)
    described = np.empty((0, 32), dtype=np.uint8) if descriptors is None else np.asarray(descriptors)
    for array in (xy, level, described):
        array.flags.writeable = False
    return xy, level, described


def right_matches(
    matches: Matches, first: CameraView, second: CameraView, *, tolerance_px: float = RIGHT_WITHIN_PX
) -> NDArray[np.bool_]:
    """Return which matches are right, bool[n]: within the tolerance of the true reprojection.

    A match whose pixel of the first view sees the sky is wrong, since nothing there moves with the body.

    Parameters
    ----------
    matches
        Matched pixels of two views.
    first, second
        The views; `depth_m` of the first is needed.
    tolerance_px
        Largest distance in the second view, in px.

    Raises
    ------
    InputError
        The tolerance is not above 0, or the first view has no depth.
    """
    if not tolerance_px > 0:
        raise InputError(f"tolerance_px = {tolerance_px:g}: must be above 0")
    off = matches.second_xy - reprojected(matches.first_xy, first, second)
    with np.errstate(invalid="ignore"):
        return np.asarray(np.hypot(off[:, 0], off[:, 1]) <= tolerance_px)


def match_precision(
    matches: Matches, first: CameraView, second: CameraView, *, tolerance_px: float = RIGHT_WITHIN_PX
) -> float:
    """Return the fraction of the matches that are right, in [0, 1]; NaN where there is no match.

    precision = (matches within the tolerance of the true reprojection) / (all matches), by depth, pose and the
    stored distortion model. The parameters are those of `right_matches`.

    Raises
    ------
    InputError
        The tolerance is not above 0, or the first view has no depth.

    References
    ----------
    Mikolajczyk and Schmid (2005), A Performance Evaluation of Local Descriptors, IEEE TPAMI 27, 1615, where 1 −
    precision is the abscissa.
    """
    if not len(matches):
        return float("nan")
    return float(right_matches(matches, first, second, tolerance_px=tolerance_px).mean())


def matches_lost(
    clean: Matches,
    faulted: Matches,
    first: CameraView,
    second: CameraView,
    *,
    tolerance_px: float = RIGHT_WITHIN_PX,
) -> float:
    """Return the fraction of the clean twins' right matches that the faulted images lack, in [0, 1].

    lost = 1 − (right matches of the clean twins near whose first pixel the faulted images have a right match, too)
    / (right matches of the clean twins), near being within the tolerance. NaN where the clean twins have no right
    match. The other parameters are those of `right_matches`.

    Raises
    ------
    InputError
        The tolerance is not above 0, or the first view has no depth.
    """
    kept = [
        matches.first_xy[right_matches(matches, first, second, tolerance_px=tolerance_px)]
        for matches in (clean, faulted)
    ]
    if not len(kept[0]):
        return float("nan")
    if not len(kept[1]):
        return 1.0
    distance, _ = cKDTree(kept[1]).query(kept[0])
    return float(np.mean(distance > tolerance_px))


# --- tracks -----------------------------------------------------------------------------------------------------

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
    first = intensity(images[0], "images[0]")
    for k, image in enumerate(images[1:], start=1):
        same_shape(first, intensity(image, f"images[{k}]"), "images[0]", f"images[{k}]")
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
