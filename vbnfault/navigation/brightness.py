"""Measure how far a fault moves the centre of brightness of an image."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .images import F32, F64, intensity, same_shape

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
