"""Measure what faults of a camera cost vision-based navigation, on images, camera models and true poses alone.

Each metric compares a clean twin with the faulted image of the same view, or the images of a few views of one site
with their true poses. `limb_error` and `centroid_shift` measure directions, `corner_repeatability` and
`orb_repeatability` the detection of features, `match_precision`, `matches_lost`, `relative_pose_error` and
`feature_lifetime` what follows from them. Images are uint8, uint16 or float; pixel coordinates count from the top
left corner, centres at +0.5.
"""

from .directions import CentroidShift, LimbError, centroid_shift, limb_error
from .features import (
    FeatureLifetime,
    Matches,
    Repeatability,
    corner_repeatability,
    corners,
    feature_lifetime,
    match,
    match_precision,
    matches_lost,
    orb_repeatability,
    right_matches,
)
from .geometry import CameraView, relative_motion, reprojected
from .relative_pose import RelativePose, RelativePoseError, relative_pose, relative_pose_error

__all__ = [
    "CameraView",
    "CentroidShift",
    "FeatureLifetime",
    "LimbError",
    "Matches",
    "RelativePose",
    "RelativePoseError",
    "Repeatability",
    "centroid_shift",
    "corner_repeatability",
    "corners",
    "feature_lifetime",
    "limb_error",
    "match",
    "match_precision",
    "matches_lost",
    "orb_repeatability",
    "relative_motion",
    "relative_pose",
    "relative_pose_error",
    "reprojected",
    "right_matches",
]
