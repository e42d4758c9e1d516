"""Six calibrations of unlike kinds, and OpenCV's own projection through them."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from vbnfault.core.calibration import Calibration

F64 = NDArray[np.float64]

_FRAME = {"width_px": 96, "height_px": 80}
# The coefficients are those of a machine-vision lens of 62° (Brown), a wide lens of 110° (rational), a telescope of
# 5° with strong terms, a mount with prism and tilt, a fisheye of 120° and one of 180° across.
SIX: dict[str, Calibration] = {
    "brown": Calibration.of_centres(
        **_FRAME, fx=80.0, fy=80.7, cx=49.1, cy=37.3, coefficients=(-0.28, 0.1, 1e-3, -7e-4, -0.02)
    ),
    "rational": Calibration.of_centres(
        **_FRAME, fx=40.0, fy=40.0, cx=46.0, cy=41.0, coefficients=(0.5, 0.1, 1e-3, -7e-4, 0.002, 0.85, 0.2, 0.01)
    ),
    "telescope": Calibration.of_centres(
        **_FRAME, fx=1100.0, fy=1100.0, cx=47.5, cy=39.5, coefficients=(-2.0, 50.0, 1e-3, -7e-4)
    ),
    "tilted prism": Calibration.of_centres(
        **_FRAME,
        fx=85.0,
        fy=85.0,
        cx=47.5,
        cy=39.5,
        coefficients=(-0.2, 0.05, 1e-3, -7e-4, 0, 0, 0, 0, 1e-2, -2e-3, -1e-2, 1e-3, 0.02, -0.03),
    ),
    "fisheye": Calibration.of_centres(
        model="fisheye",
        **_FRAME,
        fx=46.0,
        fy=45.5,
        cx=48.3,
        cy=38.9,
        skew=0.4,
        coefficients=(0.02, -0.004, 0.001, -0.0002),
    ),
    "fisheye of 180": Calibration(
        model="fisheye",
        width_px=96,
        height_px=96,
        fx=48 / (np.pi / 2 * 1.01),  # the circle of 180° lies within the frame
        fy=48 / (np.pi / 2 * 1.01),
        cx=48.0,
        cy=48.0,
        coefficients=(0.004, -0.0002),
    ),
}


def opencv_pixels(calibration: Calibration, points_C: F64) -> F64:
    """Return where OpenCV projects points before the camera, float64[n, 2], in vbnfault's pixels."""
    c, nothing = calibration, np.zeros(3)
    matrix = c.opencv_matrix
    if c.model == "fisheye":
        coefficients = np.array(c.coefficients)
        seen, _ = cv2.fisheye.projectPoints(
            points_C[:, None], nothing, nothing, matrix, coefficients, alpha=c.skew / c.fx
        )
    else:
        seen, _ = cv2.projectPoints(points_C, nothing, nothing, matrix, np.array(c.coefficients))
    return np.asarray(seen[:, 0] + 0.5)
