"""The camera: lens, detector, sensor architecture, readout direction and exposure, frozen together."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.quantities import Electrons, Irradiance, Radiance
from ..core.sundisc import Pinhole, Projection
from ..detector import Detector, MosaicDetector
from ..lens import RealLens, ThinLens

ARCHITECTURES = ("full_frame_ccd", "frame_transfer_ccd", "interline_ccd", "cmos")
READOUT_DIRECTIONS = ("up", "down", "left", "right")


@dataclass(frozen=True, kw_only=True)
class Camera:
    """One camera as it takes one picture.

    `architecture` and `readout_direction` (one of the module's tuples) are drawn once per sample and shared by
    broken pixels and broken lines. `exposure_s` > 0.
    """

    lens: ThinLens | RealLens
    detector: Detector | MosaicDetector
    architecture: str = "full_frame_ccd"
    readout_direction: str = "right"
    exposure_s: float = 1e-3

    @property
    def optics(self) -> tuple[Any, ...]:
        """What the electrons expected in its pixels depend on: cameras that share it share them."""
        return self.lens, self.exposure_s, self.detector.optics_key

    def expose(self, radiance: Radiance, exposure_s: float) -> Electrons:
        """Return the electrons expected of a radiance: the scene's, and past the rims those of the Sun's disc."""

        def electrons(on_sensor: Irradiance) -> Electrons:
            return self.detector.electrons_expected(on_sensor, exposure_s)

        if radiance.sun is None:
            return electrons(self.lens.image(radiance))
        # the Sun's own rounding errors are as bright as the scene
        scene = replace(radiance, array=np.maximum(radiance.array - radiance.sun, 0), sun=None, disc=None)
        sun = replace(radiance, array=radiance.sun, sun=None)
        found = electrons(self.lens.image(scene))
        direct = electrons(self.lens.image_of_sun(sun, self.detector.pixel_pitch_um))
        return replace(found, past_rims=direct.array)

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
        """Focal length in pixels, of the image near the axis: the OpenCV intrinsics fx = fy."""
        return self.lens.focal_length_mm * 1e3 / self.detector.pixel_pitch_um

    @property
    def intrinsics(self) -> NDArray[np.float64]:
        """fx, fy, cx, cy in pixels, float64[4]; pixel centres lie at +0.5, the axis at the frame's middle."""
        f = self.focal_length_px
        return np.array([f, f, self.width_px / 2, self.height_px / 2])

    @property
    def fov_deg(self) -> float:
        """Full field of view across the width, degrees, distortion left out."""
        return float(np.degrees(2 * np.arctan(self.width_px / 2 / self.focal_length_px)))

    def project(self, direction_C: NDArray[np.float64]) -> NDArray[np.float64] | None:
        """Pixel x, y (float64[2]) of a direction in C; None where it points behind the camera."""
        x, y, z = direction_C
        if z <= 1e-9:
            return None
        fx, fy, cx, cy = self.intrinsics
        if isinstance(self.lens, RealLens):
            slope = np.hypot(x, y) / z
            stretch = float(self.lens.distorted(slope) / slope) if slope > 1e-9 else 1.0
            return np.array([cx + fx * x / z * stretch, cy + fy * y / z * stretch])
        return np.array([cx + fx * x / z, cy + fy * y / z])

    @property
    def projection(self) -> Projection:
        """Where the pixels look: by chief rays at the d line, or as a rectilinear camera."""
        return self.lens.projection() if isinstance(self.lens, RealLens) else Pinhole(self.intrinsics)

    @property
    def seen_slopes(self) -> NDArray[np.float64]:
        """Tangents x/z and y/z of the directions in C that the pixels' centres see, float64[y, x, 2]."""
        if isinstance(self.lens, RealLens):
            return self.lens.seen_slopes
        return self.projection.slopes_at(np.arange(self.width_px) + 0.5, np.arange(self.height_px) + 0.5)

    @property
    def lens_name(self) -> str:
        return self.lens.name if isinstance(self.lens, RealLens) else "thin lens"

    @property
    def distortion(self) -> NDArray[np.float64]:
        """OpenCV's k1, k2, p1, p2, k3, k4, k5, k6, float64[8]; zeros for a thin lens."""
        return np.array(self.lens.distortion) if isinstance(self.lens, RealLens) else np.zeros(8)

    @property
    def distortion_residual_px(self) -> tuple[float, float]:
        """How far those lie from the lens's chief rays over the lit frame: root mean square and largest."""
        return self.lens.distortion_residual_px if isinstance(self.lens, RealLens) else (0.0, 0.0)

    @property
    def guard_px(self) -> tuple[int, int]:
        """Pixels of a render beyond either side of the frame, in x and in y, that its lens draws on."""
        return self.lens.guard_px if isinstance(self.lens, RealLens) else (0, 0)


def focal_length_mm(fov_deg: float, width_px: int, pixel_pitch_um: float) -> float:
    """Focal length that gives the full field of view across the width of the sensor."""
    return width_px * pixel_pitch_um * 1e-3 / 2 / float(np.tan(np.radians(fov_deg) / 2))
