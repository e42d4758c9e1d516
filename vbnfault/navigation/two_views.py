"""Recover the motion of a camera between two views from matched features, and compare it with the truth."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.errors import InputError
from .features import Matches
from .geometry import CameraView, relative_motion, rotation_angle_deg
from .images import F64

# An inlier lies as near to its epipolar line as this, in px.
_INLIER_PX = 1.0
_CONFIDENCE = 0.999
# Five points determine an essential matrix; fewer than this many matches leave nothing to tell inliers by.
_LEAST_MATCHES = 8
# Directions of translation need a baseline: this fraction of the ground's median depth moves a feature by about a
# tenth of a pixel at a focal length of 1000 px.
_LEAST_BASELINE = 1e-4
_REFINEMENTS = 10
_ROUNDS = 3  # of choosing inliers anew
_DEVIATIONS = 4.0  # medians of the inliers' distances: 2.7 standard deviations
# Sums of squares nearer to 1 than this ratio count as equal.
_EQUAL = 0.99
# ... and are never less than for this fraction of a pixel.
_EXACT = 1e-3
# Translation over the distance of a plane below which the homography is a rotation.
_NO_MOTION = 1e-6
# A homography of fewer of the matches says nothing about the motion.
_PLANE_FRACTION = 0.3


@dataclass(frozen=True, kw_only=True, eq=False)
class RelativePose:
    """Hold the motion between two views, up to scale.

    `rotation` float64[3, 3] is second_from_first, `direction` float64[3] the unit translation t of x₂ = R x₁ + t,
    and `inliers` bool[match] the matches that agree with them. Where `reason` says why there is no pose, the
    numbers are NaN.
    """

    rotation: F64 = field(default_factory=lambda: np.full((3, 3), np.nan))
    direction: F64 = field(default_factory=lambda: np.full(3, np.nan))
    inliers: NDArray[np.bool_] = field(default_factory=lambda: np.empty(0, dtype=bool))
    reason: str = ""


@dataclass(frozen=True, kw_only=True)
class RelativePoseError:
    """Hold the errors of a relative pose in degrees, in [0, 180]; NaN where `reason` says why there is none."""

    rotation_deg: float
    translation_deg: float
    reason: str = ""


def relative_pose(matches: Matches, first: CameraView, second: CameraView) -> RelativePose:
    """Return rotation and direction of translation between two views from their matches alone.

    The essential matrix E = [t]× R, x₂ᵀ E x₁ = 0, is that of five points with the most inliers. RANSAC of a fixed
    seed finds it, so that equal matches give equal poses. Of its four decompositions the code takes the one that
    puts most points before both cameras, and refines it over the inliers by the Sampson distances. On plane ground
    two motions fit, and on nearly plane ground almost so. The two motions of the homography therefore compete with
    that of the essential matrix by the sum of squared distances, cut at 1 px. Of motions that fit equally well,
    within 1 %, the one that turns least is taken.

    Parameters
    ----------
    matches
        Matched pixels of the views.
    first, second
        The views, of which only `intrinsics` and `distortion` are used.

    Returns
    -------
    RelativePose
        With NaN and a reason where fewer than eight matches, or no consistent ones, are given.

    References
    ----------
    Nistér (2004), An Efficient Solution to the Five-Point Relative Pose Problem, IEEE TPAMI 26, 756.
    Fischler and Bolles (1981), Random Sample Consensus, Communications of the ACM 24, 381.
    Faugeras and Lustman (1988), Motion and Structure from Motion in a Piecewise Planar Environment, International
    Journal of Pattern Recognition and Artificial Intelligence 2, 485.
    Hartley and Zisserman (2004), Multiple View Geometry in Computer Vision, sections 9.6 and 11.4.3.
    """
    if len(matches.first_xy) != len(matches.second_xy):
        raise InputError(
            f"matches: {len(matches.first_xy)} and {len(matches.second_xy)} pixels: must be equally many"
        )
    if len(matches) < _LEAST_MATCHES:
        return RelativePose(reason=f"{len(matches)} matches, and a pose needs {_LEAST_MATCHES}")
    a, b = first.slopes(matches.first_xy), second.slopes(matches.second_xy)
    if not (np.isfinite(a).all() and np.isfinite(b).all()):
        raise InputError(
            "matches: some pixels lie farther from the centre than the distortion of their view reaches"
        )
    inlier = _INLIER_PX / float(np.mean([first.intrinsics[:2], second.intrinsics[:2]]))
    motions, distances = [], []
    for candidate in _candidates(a, b, inlier):
        rotation, direction, distance = _refined_on_inliers(*candidate, a, b, inlier)
        motions.append((rotation, direction))
        distances.append(np.minimum(distance, inlier))
    if not motions or max(np.count_nonzero(d < inlier) for d in distances) < _LEAST_MATCHES:
        return RelativePose(reason="no motion agrees with eight of the matches")
    # wrong matches fit no motion, and would make all sums alike
    fits_some = (np.array(distances) < inlier).any(axis=0)
    cost = (np.array(distances)[:, fits_some] ** 2 + (_EXACT * inlier) ** 2).sum(axis=1)
    turn = [
        rotation_angle_deg(rotation) if c * _EQUAL <= cost.min() else np.inf
        for (rotation, _), c in zip(motions, cost, strict=True)
    ]
    best = int(np.argmin(turn))
    rotation, direction = motions[best]
    return RelativePose(rotation=rotation, direction=direction, inliers=distances[best] < inlier)


def _candidates(a: F64, b: F64, inlier: float) -> Iterator[tuple[F64, F64, NDArray[np.bool_]]]:
    """Return motions that agree with many matches, and the matches, bool[n], over which to refine each.

    The first is that of the essential matrix of five points. On ground that is nearly plane a second motion fits
    about as well; both are among the decompositions of the homography (Faugeras and Lustman 1988).
    """
    cv2.setRNGSeed(0)  # the samples of RANSAC
    essential, chosen = cv2.findEssentialMat(a, b, np.eye(3), method=cv2.RANSAC, prob=_CONFIDENCE, threshold=inlier)
    near = np.zeros(len(a), dtype=bool) if chosen is None else chosen.ravel().astype(bool)
    if essential is not None and essential.shape[0] >= 3 and near.any():
        count, rotation, direction, _ = cv2.recoverPose(essential[:3], a, b, np.eye(3), mask=chosen.copy())
        if count:
            yield rotation, direction.ravel(), near
    homography, on_plane = cv2.findHomography(a, b, cv2.RANSAC, 3 * inlier, maxIters=500, confidence=_CONFIDENCE)
    if homography is None or on_plane.sum() < _PLANE_FRACTION * len(a):
        return
    plane = on_plane.ravel().astype(bool)
    _, rotations, translations, normals = cv2.decomposeHomographyMat(homography, np.eye(3))
    points = _homogeneous(a[plane])
    for rotation, translation, normal in zip(rotations, translations, normals, strict=True):
        length = float(np.linalg.norm(translation))
        if length < _NO_MOTION:  # the camera only turns: any direction fits
            yield rotation, np.array([0.0, 0.0, 1.0]), plane
        elif np.mean(points @ normal > 0) > 0.5:  # the plane lies before the camera where its points are seen
            yield rotation, translation.ravel() / length, plane


def relative_pose_error(matches: Matches, first: CameraView, second: CameraView) -> RelativePoseError:
    """Return the errors of the relative pose that the matches give against the true one.

    rotation error = angle of R R*ᵀ;  translation error = angle between t and t*, * being the truth. The direction
    of translation has no error where the true baseline is below 1e-4 of the ground's median depth.

    Parameters
    ----------
    matches
        Matched pixels of the views.
    first, second
        The views, with their true poses.

    References
    ----------
    Nistér (2004), An Efficient Solution to the Five-Point Relative Pose Problem, IEEE TPAMI 26, 756.
    """
    estimate = relative_pose(matches, first, second)
    if estimate.reason:
        return RelativePoseError(rotation_deg=float("nan"), translation_deg=float("nan"), reason=estimate.reason)
    rotation, translation = relative_motion(first, second)
    turned = rotation_angle_deg(estimate.rotation @ rotation.T)
    length = float(np.linalg.norm(translation))
    if length <= _LEAST_BASELINE * _median_depth_m(first):
        return RelativePoseError(
            rotation_deg=turned, translation_deg=float("nan"), reason="the camera does not move between the views"
        )
    along = translation / length
    sine, cosine = np.linalg.norm(np.cross(estimate.direction, along)), estimate.direction @ along
    return RelativePoseError(rotation_deg=turned, translation_deg=float(np.degrees(np.arctan2(sine, cosine))))


def _median_depth_m(view: CameraView) -> float:
    """Return the median depth of the ground in m; 1 where the view has none."""
    if view.depth_m is None:
        return 1.0
    depth = np.asarray(view.depth_m)[::4, ::4]
    depth = depth[np.isfinite(depth)]
    return float(np.median(depth)) if len(depth) else 1.0


def _refined_on_inliers(
    rotation: F64, direction: F64, near: NDArray[np.bool_], a: F64, b: F64, inlier: float
) -> tuple[F64, F64, F64]:
    """Return a motion refined over its inliers, which are chosen anew, and the matches' distances, float64[n]."""
    for _ in range(_ROUNDS):
        rotation, direction = _refined(rotation, direction, a[near], b[near])
        distance = np.abs(_sampson(rotation, direction, _homogeneous(a), _homogeneous(b)))
        near = distance <= inlier
        # wrong matches that lie near their epipolar line by chance are farther from it than the right ones
        middle = float(np.median(distance[near])) if near.any() else 0.0
        near &= distance <= max(_EXACT * inlier, _DEVIATIONS * middle)
    return rotation, direction, distance


def _refined(rotation: F64, direction: F64, a: F64, b: F64) -> tuple[F64, F64]:
    """Return the motion near a given one with the least sum of squared Sampson distances of the matches.

    Gauss and Newton's steps in the five parameters: a small rotation, and two components of the direction.
    """
    first, second = _homogeneous(a), _homogeneous(b)
    step = 1e-7
    best = _sampson(rotation, direction, first, second)
    for _ in range(_REFINEMENTS):
        tangents = np.linalg.svd(direction[None])[2][1:]
        columns = []
        for k in range(5):
            small = np.zeros(5)
            small[k] = step
            columns.append((_sampson(*_moved(rotation, direction, tangents, small), first, second) - best) / step)
        change: F64 = np.asarray(np.linalg.lstsq(np.column_stack(columns), -best, rcond=None)[0], dtype=np.float64)
        moved = _moved(rotation, direction, tangents, change)
        residual = _sampson(*moved, first, second)
        gain = float(best @ best - residual @ residual)
        if not gain > 0:
            break
        done = gain < 1e-9 * float(best @ best)
        (rotation, direction), best = moved, residual
        if done:
            break
    return rotation, direction


def _homogeneous(slopes: F64) -> F64:
    """Return the vectors (x/z, y/z, 1), float64[n, 3]."""
    return np.column_stack([slopes, np.ones(len(slopes))])


def _moved(rotation: F64, direction: F64, tangents: F64, change: F64) -> tuple[F64, F64]:
    """Return a motion changed by a small rotation vector and two components along tangents of the direction."""
    turned = cv2.Rodrigues(np.ascontiguousarray(change[:3]))[0] @ rotation
    along = direction + change[3:] @ tangents
    return turned, along / np.linalg.norm(along)


def _sampson(rotation: F64, direction: F64, first: F64, second: F64) -> F64:
    """Return the signed Sampson distances of matches in focal lengths, float64[n] (Hartley and Zisserman, 11.9)."""
    x, y, z = direction
    essential = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ rotation
    lines_in_second, lines_in_first = first @ essential.T, second @ essential
    value = np.sum(second * lines_in_second, axis=1)
    square = (lines_in_second[:, :2] ** 2).sum(axis=1) + (lines_in_first[:, :2] ** 2).sum(axis=1)
    return np.asarray(value / np.sqrt(np.maximum(square, 1e-300)))
