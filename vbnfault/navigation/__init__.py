"""Measure what faults of a camera cost vision-based navigation, on images, camera models and true poses alone.

Each metric compares a clean twin with the faulted image of the same view, or the images of a few views of one site
with their true poses. `limb_error` and `centroid_shift` measure directions, `corner_repeatability` and
`orb_repeatability` the detection of features, `match_precision`, `matches_lost`, `relative_pose_error` and
`feature_lifetime` what follows from them. Images are uint8, uint16 or float; pixel coordinates count from the top
left corner, centres at +0.5.

Each public name, listed in `__init__.pyi`, loads its module when it is first used.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
