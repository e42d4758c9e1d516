"""Find the direction towards the Sun that a user gives, or that an image shows."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from ..camera import Camera
from ..core import spectra
from ..core.errors import InputError
from .picture import Picture

F64 = NDArray[np.float64]

# A disc of saturated pixels is the Sun if it fills this fraction of the circle of its width, and is at least this
# many times as wide as the Sun. How much wider its glare is, nobody knows.
_ROUND, _NARROWEST = 0.6, 0.5


def sun_direction(
    given: str | Sequence[float], camera: Camera, distance_au: float, picture: Picture | None
) -> F64 | None:
    """Return the unit vector towards the Sun in the camera frame C, float64[3]; None without a Sun.

    Raises InputError if "auto" finds no saturated disc, or a direction is none.
    """
    if isinstance(given, str):
        if given == "none":
            return None
        if given != "auto":
            raise InputError(f"image.sun = {given!r}: must be 'auto', 'none', a position or a direction")
        if picture is None:
            raise InputError("image.sun = 'auto': finds the Sun in an image only; give its position")
        given = _saturated_disc(picture, camera, distance_au).tolist()
    try:
        vector = np.asarray(given, dtype=np.float64)
    except (TypeError, ValueError):
        vector = np.zeros(0)
    if vector.shape not in ((2,), (3,)) or not np.isfinite(vector).all() or not (len(vector) == 2 or vector.any()):
        raise InputError(f"image.sun = {given!r}: must be x and y in pixels, or a direction, as numbers")
    if len(vector) == 2:
        vector = camera.projection.directions_at(vector[:1], vector[1:]).ravel()
    vector = vector / np.abs(vector).max()  # the square of a tiny or huge number is none
    return np.asarray(vector / np.linalg.norm(vector))


def _saturated_disc(picture: Picture, camera: Camera, distance_au: float) -> F64:
    """Return the pixel position of the centre of the largest round region of saturated pixels, float64[2]."""
    numbers, white = picture.numbers, picture.response.white_dn
    highest = np.iinfo(numbers.dtype).max if numbers.dtype.kind in "ui" else np.inf
    saturated = numbers >= min(white, highest)
    if saturated.ndim == 3:
        saturated = np.all(saturated[..., :3], axis=2)
    count, _, stats, centres = cv2.connectedComponentsWithStats(saturated.astype(np.uint8))
    widest = np.maximum(stats[1:, cv2.CC_STAT_WIDTH], stats[1:, cv2.CC_STAT_HEIGHT]).astype(float)
    area = stats[1:, cv2.CC_STAT_AREA]
    diameter_px = 2 * spectra.sun_angular_radius_rad(distance_au) * camera.focal_length_px
    disc = (area > _ROUND * np.pi / 4 * widest**2) & (widest >= max(2.0, _NARROWEST * diameter_px))
    if count < 2 or not disc.any():
        raise InputError(
            "image.sun = 'auto': the image has no round region of saturated pixels as wide as the Sun; give its "
            "position"
        )
    return np.asarray(centres[1:][np.argmax(np.where(disc, area, 0))] + 0.5)
