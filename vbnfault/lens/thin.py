"""The ideal thin lens: a rectilinear image, no distortion, no ghosts, finite depth of field."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..quantities import Irradiance, Radiance


@dataclass(frozen=True, kw_only=True)
class ThinLens:
    """A thin lens; `focus_distance_m` is the object distance in focus (inf: focused at infinity)."""

    focal_length_mm: float
    f_number: float
    transmission: float = 1.0
    focus_distance_m: float = float("inf")

    @property
    def figures(self) -> dict[str, str | float]:
        """What the lens is: name, focal length, f-number, transmission; `summary` says so."""
        return {
            "name": "thin lens",
            "efl_mm": self.focal_length_mm,
            "f_number": self.f_number,
            "transmission": self.transmission,
            "summary": f"thin lens of {self.focal_length_mm:.4g} mm, f/{self.f_number:.3g}",
        }

    @property
    def aperture_radius_m(self) -> float:
        """Radius of the entrance pupil, f / 2N, in metres."""
        return self.focal_length_mm * 1e-3 / (2 * self.f_number)

    def image(self, radiance: Radiance) -> Irradiance:
        """Irradiance on the sensor plane, E = π T L / (4 N²), per band.

        No cos⁴ falls here: in the nominal camera the paper renders without, and vignetting is a fault of its
        own (physics.md 6 warns of counting it twice).
        """
        factor = np.float32(np.pi * self.transmission / (4 * self.f_number**2))
        return Irradiance(array=radiance.array * factor, wavelength_nm=radiance.wavelength_nm)
