"""Describe what straylight depends on: the Sun, the sensor, the lens's state, and the path of the direct image."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..prescription import Prescription
from .scatter import POLISHED, Cleanliness, baffle_transmission

F64 = NDArray[np.float64]

VEIL_FRACTION = 0.01  # assumed: a lens with blackened edges and a baffled barrel (ISO 9358 indices of 0.5 to 5 %)
RAYS_ACROSS = 37  # rays across a ghost


@dataclass(frozen=True, kw_only=True)
class SunSource:
    """Describe the Sun as the lens sees it.

    Attributes
    ----------
    angle_deg, azimuth_deg
        Angle from the axis, from 0 to below 90, and azimuth (0: +x, right; 90°: +y, down).
    radius_rad
        Angular radius of the disc; 0 is a point.
    image_xy_mm
        Position of the direct image on the sensor plane; None: f tan θ along the azimuth.
    """

    angle_deg: float
    azimuth_deg: float = 0.0
    radius_rad: float = 0.0
    image_xy_mm: tuple[float, float] | None = None

    def xy_mm(self, efl_mm: float) -> tuple[float, float]:
        """Return the position of the direct image on the sensor plane behind a lens of this focal length."""
        if self.image_xy_mm is not None:
            return self.image_xy_mm
        turn, radius = np.radians(self.azimuth_deg), efl_mm * np.tan(np.radians(self.angle_deg))
        return float(radius * np.cos(turn)), float(radius * np.sin(turn))


@dataclass(frozen=True, kw_only=True)
class SensorGrid:
    """Describe a sensor whose middle lies on the axis: (height, width) in pixels, and their pitch."""

    shape: tuple[int, int]
    pitch_mm: float


@dataclass(frozen=True, kw_only=True)
class GhostSettings:
    """Describe how ghosts are computed.

    Attributes
    ----------
    model
        'traced' (exact rays) or 'paraxial' (paraxial rays).
    reflections
        2, or 4 to include ghosts of four reflections.
    diffraction
        Whether edges show Fresnel's fringes.
    across
        Rays along either side of a typical ghost. Its light converges with their number: to some 1 % with the
        default, and to some 4 % for ghosts that are strongly spread.
    """

    model: str = "traced"
    reflections: int = 2
    diffraction: bool = True
    across: int = RAYS_ACROSS


TRACED = GhostSettings()


@dataclass(frozen=True, kw_only=True)
class Baffle:
    """Describe a tube in front of the lens; length 0 means none."""

    length_mm: float = 0.0
    radius_mm: float = 0.0

    def lit_fraction(self, lens: Prescription, slope: ArrayLike) -> F64:
        """Return the fraction of a lens's entrance that sources light through the tube, float64 like their `slope`.

        A tube narrower than the lens is itself the entrance.
        """
        if self.length_mm <= 0:
            return np.ones(np.shape(slope))
        return baffle_transmission(
            np.degrees(np.arctan(slope)),
            length_mm=self.length_mm,
            radius_mm=self.radius_mm,
            entrance_radius_mm=min(lens.surfaces[0].semi_diameter_mm, self.radius_mm),
        )


NO_BAFFLE = Baffle()


@dataclass(frozen=True, kw_only=True)
class StraylightSettings:
    """Describe the state of a lens and of what surrounds it.

    Attributes
    ----------
    ghosts
        How ghosts are computed.
    cleanliness
        What scatters on the surfaces.
    baffle
        Tube in front of the lens.
    coating_loss
        Fraction of the coatings' area that is gone, in [0, 1]; it raises ghosts. The loss of transmitted light is
        not applied here, but by whoever darkens the image.
    veil_fraction
        Fraction v of the light that mount, barrel and edges scatter onto the sensor plane, in [0, 1].
    """

    ghosts: GhostSettings = TRACED
    cleanliness: Cleanliness = POLISHED
    baffle: Baffle = NO_BAFFLE
    coating_loss: float = 0.0
    veil_fraction: float = VEIL_FRACTION


DEFAULT = StraylightSettings()


@dataclass(frozen=True, kw_only=True, eq=False)
class DirectPath:
    """Describe the path that forms the direct image, where it is not that of the lens with the straylight.

    Attributes
    ----------
    transmittance
        float64[n], T of the path at `spectra.Bands.wavelength_nm`.
    admitted_mm2
        A cos θ: the area of the beam that passes, across the Sun's direction.
    beam_fraction
        A over its value on the axis: the fraction of the stop that the Sun lights past the rims.
    """

    transmittance: F64
    admitted_mm2: float
    beam_fraction: float = 1.0
