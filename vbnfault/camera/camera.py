"""Define the camera: lens, detector, sensor architecture, readout direction and exposure, frozen together."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core import spectra
from ..core.quantities import Electrons, Irradiance, Radiance
from ..core.sundisc import Projection
from ..detector import Detector, MosaicDetector
from ..lens import Lens
from ..lens.adapt import Change


@dataclass(frozen=True, kw_only=True)
class Camera:
    """Hold a camera in the state in which it takes one image.

    `architecture` and `readout_direction` (`core.quantities` names their values) are drawn once per
    sample, and broken pixels and broken lines share them. `exposure_s` is above 0. `gain`, at least 1, is the
    factor on the detector's own gain in DN/e, which the detector holds already.

    `lens_changes` are changes of the prescription that faults trace; a lens of the camera that has surfaces is
    already changed. Only sensitivity studies use them.
    """

    lens: Lens
    detector: Detector
    architecture: str = "full_frame_ccd"
    readout_direction: str = "right"
    exposure_s: float = 1e-3
    gain: float = 1.0
    lens_changes: tuple[Change, ...] = ()

    @property
    def optics(self) -> tuple[Any, ...]:
        """Return all that the expected electrons depend on: cameras with equal values have equal electrons."""
        return self.lens, self.exposure_s, self.detector.optics_key

    def expose(self, radiance: Radiance, exposure_s: float) -> Electrons:
        """Return the electrons expected from a radiance; `Electrons.past_rims` holds those of the Sun's disc."""

        def electrons(on_sensor: Irradiance) -> Electrons:
            return self.detector.electrons_expected(on_sensor, exposure_s)

        if radiance.sun is None:
            return electrons(self.lens.image(radiance))
        # the rounding errors of the Sun's radiance may be as large as the radiance of the scene
        sunless = np.maximum(radiance.array - radiance.sun, 0)
        scene = replace(radiance, array=sunless, sun=None, disc=None)
        sun = replace(radiance, array=radiance.sun, sun=None, fine=None)
        of_scene = electrons(self.lens.image(scene))
        direct = electrons(self.lens.image_of_sun(sun, self.detector.pixel_pitch_um))
        return replace(of_scene, past_rims=direct.array)

    def electron_rates(self, wavelength_nm: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return electrons per second and pixel for 1 W m⁻² before the lens's losses, float64[channel, n]."""
        return self.detector.electron_rates(wavelength_nm) * self.lens.transmittance(wavelength_nm)

    def electron_rate_weights(self, wavelength_nm: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the same for 1 W m⁻² nm⁻¹ in each band, float64[channel, band]."""
        passed = self.lens.transmittance(spectra.fine_nodes_nm(wavelength_nm))
        weights = self.detector.electron_rate_weights(wavelength_nm, passed).astype(np.float64)
        return weights * spectra.band_means(passed, wavelength_nm)

    @property
    def width_px(self) -> int:
        """Return the number of columns of the image."""
        return self.detector.width_px

    @property
    def height_px(self) -> int:
        """Return the number of rows of the image."""
        return self.detector.height_px

    @property
    def is_ccd(self) -> bool:
        """Return whether the sensor is a CCD of any architecture."""
        return self.architecture != "cmos"

    @property
    def is_monochrome(self) -> bool:
        """Return whether no pixel has a colour filter: R, G, B and I of an image are then the same."""
        return self.detector.channels == ("W",)

    @property
    def focal_length_px(self) -> float:
        """Return the focal length in pixels, for the image near the axis: the OpenCV intrinsics fx = fy."""
        return self.lens.focal_length_mm * 1e3 / self.detector.pixel_pitch_um

    @property
    def intrinsics(self) -> NDArray[np.float64]:
        """Return fx, fy, cx, cy in pixels, float64[4]. Pixel centres lie at +0.5.

        The axis is in the middle, except in a calibrated camera.
        """
        if self.lens.calibration is not None:
            return self.lens.calibration.intrinsics
        f = self.focal_length_px
        return np.array([f, f, self.width_px / 2, self.height_px / 2])

    @property
    def fov_deg(self) -> float:
        """Return the full field of view across the width in degrees, without the distortion of a prescription."""
        if self.lens.calibration is not None:
            return self.lens.calibration.fov_deg
        return float(np.degrees(2 * np.arctan(self.width_px / 2 / self.focal_length_px)))

    def project(self, direction_C: NDArray[np.float64]) -> NDArray[np.float64] | None:
        """Return pixel x and y of a direction in C, float64[2]; None where it points sideways or backwards."""
        x, y, z = direction_C
        calibration = self.lens.calibration
        if calibration is not None:
            ahead = z > calibration.least_z * np.linalg.norm(direction_C)
            return calibration.pixel_of(direction_C) if ahead else None
        if z <= 1e-9:
            return None
        fx, fy, cx, cy = self.intrinsics
        slope = np.hypot(x, y) / z
        stretch = float(self.lens.distorted(slope) / slope) if slope > 1e-9 else 1.0
        return np.array([cx + fx * x / z * stretch, cy + fy * y / z * stretch])

    @property
    def projection(self) -> Projection:
        """Return the map of directions to pixels: by chief rays at the d line, of a calibration, or rectilinear."""
        return self.lens.projection(self.intrinsics)

    @property
    def seen_directions(self) -> NDArray[np.float64]:
        """Return vectors in C along the directions that the pixel centres see, float64[y, x, 3].

        They are unit vectors of a calibrated camera, and have z = 1 otherwise.
        """
        return _seen_directions(self.lens, tuple(self.intrinsics.tolist()), self.width_px, self.height_px)

    @property
    def mosaic(self) -> MosaicDetector:
        """Return the detector, for what only one with a colour mosaic can do.

        Raises
        ------
        TypeError
            The detector has no colour mosaic.
        """
        if self.detector.mosaic is None:
            raise TypeError(f"detector {self.detector.name!r} has no colour mosaic")
        return self.detector.mosaic


@lru_cache(maxsize=2)
def _seen_directions(
    lens: Lens, intrinsics: tuple[float, ...], width_px: int, height_px: int
) -> NDArray[np.float64]:
    """Return `Camera.seen_directions`, read-only. All samples of a camera share them."""
    projection = lens.projection(np.array(intrinsics))
    out = projection.directions_at(np.arange(width_px) + 0.5, np.arange(height_px) + 0.5)
    out.flags.writeable = False
    return out


def focal_length_mm(fov_deg: float, width_px: int, pixel_pitch_um: float) -> float:
    """Return the focal length in mm that gives a full field of view across the width of the sensor."""
    return width_px * pixel_pitch_um * 1e-3 / 2 / float(np.tan(np.radians(fov_deg) / 2))
