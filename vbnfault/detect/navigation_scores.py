"""Measure what predicted masks buy navigation: its errors without a mask, with the predicted one and with the true.

The metrics are those of `vbnfault.navigation`. A mask is applied as a navigator would: no feature is detected in a
masked pixel, and an edge that was measured in one is left out. The masks are unions over the classes of the store's
`mask_any`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .. import navigation
from ..core.quantities import BODY, SKY
from ..store import StoreSpec
from .scores import Bootstrap

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]
Mask = NDArray[np.bool_]

VARIANTS = ("without", "predicted", "true")  # which mask is applied
MOST_PAIRS = 64
_LEAST_EDGES = 8
_RIGHT_WITHIN_PX = 3.0  # as `navigation.right_matches`
_NO_POSE_DEG = 180.0  # the error of a pair without a pose: the greatest there is
_LEAST_OVERLAP = 0.5  # of the first view's pixels of the ground; ORB matches few of less
_SUN_WITHIN_DEG = 10.0  # shadows that move more are other features
_TURN_WITHIN_DEG = 45.0
_CANDIDATES = 6
_GRID = 16  # points along each side of the frame that measure the overlap


def frame_errors(
    clean: NDArray[np.uint8], image: NDArray[np.uint8], semantic: NDArray[np.uint8] | None, masks: Sequence[Mask]
) -> F64:
    """Return what masks change in one frame, float64[variant, 3].

    The columns are the limb's RMS error in px, the number of wrong matches and that of all. Matches are those of
    the clean twin and the image, which show one view: right ones lie within 3 px of their place. The limb's error
    is nan where a variant leaves fewer than 8 edges, or the frame shows no limb.

    Parameters
    ----------
    clean, image
        uint8[y, x, 4] each.
    semantic
        uint8[y, x], or None if the store has none.
    masks
        bool[y, x] of each variant: pixels that the navigator does not use.
    """
    out = np.full((len(masks), 3), np.nan)
    if semantic is not None:
        limb = navigation.limb_error(clean, image, semantic == BODY, sky=semantic == SKY)
        if not limb.reason:
            measured = limb.xy + limb.displacements_px[:, None] * limb.normals
            for row, mask in zip(out, masks, strict=True):
                moved_px = limb.displacements_px[~_inside(mask, measured)]
                row[0] = np.sqrt(np.mean(moved_px**2)) if len(moved_px) >= _LEAST_EDGES else np.nan
    for row, mask in zip(out, masks, strict=True):
        matches = navigation.match(clean, image, unused=(None, mask))
        moved_px = np.linalg.norm(matches.first_xy - matches.second_xy, axis=1)
        row[1:] = np.count_nonzero(moved_px > _RIGHT_WITHIN_PX), len(matches)
    return out


def _inside(mask: Mask, xy: F64) -> Mask:
    """Return whether positions lie in a mask, bool[n]."""
    height, width = mask.shape
    column, row = np.floor(xy).astype(np.int64).T
    return np.asarray(mask[np.clip(row, 0, height - 1), np.clip(column, 0, width - 1)])


def frame_summary(errors: F64, bootstrap: Bootstrap, reason: str = "") -> dict[str, Any]:
    """Return the figures of frames for `score.json`.

    Parameters
    ----------
    errors
        `frame_errors` of all samples, float64[sample, variant, 3], nan for those without a fault.
    bootstrap
        Resamples of the views of these samples.
    reason
        Why there is no limb; "": it follows from the values.
    """
    compared = np.isfinite(errors[..., 0]).all(axis=1)  # the same frames with every mask
    counts = np.nan_to_num(errors[..., 1:])
    right = counts[..., 1] - counts[..., 0]
    limb: dict[str, Any] = {"frames": int(compared.sum())}
    matches: dict[str, Any] = {"frames": int(np.isfinite(errors[:, 0, 1]).sum())}
    shown = np.isfinite(errors[:, 0, 0])
    for k, variant in enumerate(VARIANTS):
        limb[variant] = {
            "median": bootstrap.median(np.where(compared, errors[:, k, 0], np.nan)).plain(),
            "hidden_fraction": bootstrap.fraction(shown & ~np.isfinite(errors[:, k, 0]), shown).plain(),
        }
        matches[variant] = {
            "wrong_fraction": bootstrap.fraction(counts[:, k, 0], counts[:, k, 1]).plain(),
            "right_fraction_of_unmasked": bootstrap.fraction(right[:, k], right[:, 0]).plain(),
        }
    if not compared.any():
        limb["reason"] = reason or "no frame with a fault shows a lit limb that each mask leaves"
    return {"limb_rms_px": limb, "matches": matches}


# --- pairs of views -----------------------------------------------------------------------------------------------


def view_of(spec: StoreSpec, scalars: Mapping[str, NDArray[Any]], k: int, depth_m: Any) -> navigation.CameraView:
    """Return how the camera saw the sample in row `k` of some scalars."""
    return navigation.CameraView(
        intrinsics=scalars["intrinsics"][k],
        distortion=scalars["distortion"][k],
        model=spec.distortion_model or "opencv",
        valid_to_deg=spec.distortion_valid_to_deg,
        skew_px=spec.skew_px,
        camera_from_T=scalars["camera_from_T"][k],
        camera_position_T_m=scalars["camera_position_T_m"][k],
        depth_m=None if depth_m is None else np.where(np.isfinite(depth_m), depth_m, np.inf),
    )


def candidate_pairs(columns: Mapping[str, NDArray[Any]]) -> list[tuple[int, list[int]]]:
    """Return faulty samples, and for each the nearest others that may see the same ground, as rows of `columns`.

    Both are of one site, their Suns are within 10 degrees and their attitudes within 45 degrees, and they are not
    at one place.
    """
    position, attitude = columns["camera_position_T_m"], columns["camera_from_T"]
    sun, site = columns["sun_direction_T"], columns["site"]
    known = np.isfinite(np.concatenate([position, attitude, sun], axis=1)).all(axis=1)
    pairs = []
    for i in np.flatnonzero(known & columns["injected"].any(axis=1)).tolist():
        distance = np.linalg.norm(position - position[i], axis=1)
        with np.errstate(invalid="ignore"):
            turned = 2 * np.degrees(np.arccos(np.clip(np.abs(attitude @ attitude[i]), 0, 1)))
            sun_moved = np.degrees(np.arccos(np.clip(sun @ sun[i], -1, 1)))
            fits = known & (site == site[i]) & (distance > 0)
            fits &= (turned <= _TURN_WITHIN_DEG) & (sun_moved <= _SUN_WITHIN_DEG)
        others = np.flatnonzero(fits)
        if len(others):
            pairs.append((i, others[np.argsort(distance[others], kind="stable")][:_CANDIDATES].tolist()))
    return pairs


def sees_the_same(first: navigation.CameraView, second: navigation.CameraView, shape: tuple[int, int]) -> bool:
    """Return whether half of the first view's pixels of the ground or more lie in the second view's frame."""
    height, width = shape
    x, y = np.meshgrid((np.arange(_GRID) + 0.5) * width / _GRID, (np.arange(_GRID) + 0.5) * height / _GRID)
    xy = np.column_stack([x.ravel(), y.ravel()])
    ground = np.isfinite(first.depth_at(xy))
    with np.errstate(invalid="ignore"):
        moved = navigation.reprojected(xy, first, second)
        inside = np.all((moved >= 0) & (moved < (width, height)), axis=1)
    return bool(ground.sum() >= _GRID and np.mean(inside[ground]) >= _LEAST_OVERLAP)


def pair_errors(
    views: Sequence[navigation.CameraView],
    images: Sequence[NDArray[np.uint8]],
    cleans: Sequence[NDArray[np.uint8]],
    masks: Sequence[Sequence[Mask]],
) -> F64 | None:
    """Return errors of the relative pose of two views, float64[4, 2]; None if the clean twins give no pose.

    The rows are the variants, then the clean twins; the columns rotation and translation in degrees. A variant
    without a pose counts as 180 degrees. The error of the translation is nan where the camera does not move.

    Parameters
    ----------
    views, images, cleans
        Of both samples.
    masks
        The masks of each variant, of both samples.
    """
    truth = _pose_error(navigation.match(cleans[0], cleans[1]), views)
    if not np.isfinite(truth[0]):
        return None
    rows = []
    for first, second in masks:
        found = _pose_error(navigation.match(images[0], images[1], unused=(first, second)), views)
        rows.append(np.where(np.isfinite(found) | ~np.isfinite(truth), found, _NO_POSE_DEG))
    return np.array([*rows, truth])


def _pose_error(matches: navigation.Matches, views: Sequence[navigation.CameraView]) -> F64:
    """Return errors of rotation and translation in degrees, float64[2]."""
    slopes = np.column_stack([views[0].slopes(matches.first_xy), views[1].slopes(matches.second_xy)])
    known = np.isfinite(slopes).all(axis=1)  # pixels within the reach of the distortion
    kept = navigation.Matches(first_xy=matches.first_xy[known], second_xy=matches.second_xy[known])
    error = navigation.relative_pose_error(kept, *views)
    return np.array([error.rotation_deg, error.translation_deg])


def pair_summary(errors: F64, bootstrap: Bootstrap | None, reason: str) -> dict[str, Any]:
    """Return the medians over pairs for `score.json`: rotation and translation of each variant and of clean twins.

    Parameters
    ----------
    errors
        `pair_errors` of the pairs, float64[pair, 4, 2].
    bootstrap
        Resamples of the views of the pairs' first samples; None without a pair.
    reason
        Why there is no pair.
    """
    if bootstrap is None or not len(errors):
        return {"pairs": 0, "reason": reason}
    out: dict[str, Any] = {"pairs": len(errors)}
    for k, variant in enumerate((*VARIANTS, "clean")):
        out[variant] = {
            f"{name}_deg": bootstrap.median(errors[:, k, j]).plain()
            for j, name in enumerate(("rotation", "translation"))
        } | {
            "without_pose_fraction": bootstrap.fraction(
                errors[:, k, 0] >= _NO_POSE_DEG, np.ones(len(errors))
            ).plain()
        }
    return out
