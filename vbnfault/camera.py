"""The camera: lens, detector, sensor architecture, readout direction and exposure, frozen together."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .detector import Detector
from .lens import ThinLens

ARCHITECTURES = ("full_frame_ccd", "frame_transfer_ccd", "interline_ccd", "cmos")
READOUT_DIRECTIONS = ("up", "down", "left", "right")


@dataclass(frozen=True, kw_only=True)
class Camera:
    """One camera as it takes one picture.

    `architecture` and `readout_direction` (one of the module's tuples) are drawn once per sample and shared by
    broken pixels and broken lines. `exposure_s` > 0.
    """

    lens: ThinLens
    detector: Detector
    architecture: str = "full_frame_ccd"
    readout_direction: str = "right"
    exposure_s: float = 1e-3

    @property
    def width_px(self) -> int:
        return self.detector.width_px

    @property
    def height_px(self) -> int:
        return self.detector.height_px

    @property
    def is_ccd(self) -> bool:
        return self.architecture != "cmos"

    @property
    def focal_length_px(self) -> float:
        """Focal length in pixels: the OpenCV intrinsics fx = fy."""
        return self.lens.focal_length_mm * 1e3 / self.detector.pixel_pitch_um

    @property
    def intrinsics(self) -> NDArray[np.float64]:
        """fx, fy, cx, cy in pixels, float64[4]; pixel centres lie at +0.5, the axis at the frame's middle."""
        f = self.focal_length_px
        return np.array([f, f, self.width_px / 2, self.height_px / 2])

    @property
    def fov_deg(self) -> float:
        """Full field of view across the width, degrees."""
        return float(np.degrees(2 * np.arctan(self.width_px / 2 / self.focal_length_px)))

    def project(self, direction_C: NDArray[np.float64]) -> NDArray[np.float64] | None:
        """Pixel x, y (float64[2]) of a direction in C; None where it points behind the camera."""
        x, y, z = direction_C
        if z <= 1e-9:
            return None
        fx, fy, cx, cy = self.intrinsics
        return np.array([cx + fx * x / z, cy + fy * y / z])


def focal_length_mm(fov_deg: float, width_px: int, pixel_pitch_um: float) -> float:
    """Focal length that gives the full field of view across the width of the sensor."""
    return width_px * pixel_pitch_um * 1e-3 / 2 / float(np.tan(np.radians(fov_deg) / 2))
