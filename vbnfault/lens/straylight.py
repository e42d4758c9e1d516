"""All light of the Sun that a lens sends astray: ghosts, starburst and veiling glare, in one radiometric unit."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from .first_order import first_order
from .flare import flare_model
from .paraxial import transmittance
from .prescription import Prescription
from .scatter import KNEE, SLOPE, baffle_transmission, veiling_glare
from .starburst import Starburst, starburst
from .trace import forward

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Cleanliness:
    """What scatters: rms `roughness_nm` of every surface with Harvey's knee and slope (at 550 nm), and particles on
    every surface in air by IEST-STD-CC1246 (`level` 0: none)."""

    roughness_nm: float = 1.0
    level: float = 0.0
    knee: float = KNEE
    slope: float = SLOPE


@dataclass(frozen=True, kw_only=True)
class Baffle:
    """A tube in front of the lens; none with length 0."""

    length_mm: float = 0.0
    radius_mm: float = 0.0


@dataclass(frozen=True, kw_only=True, eq=False)
class Straylight:
    """Irradiance on the sensor over the Sun's at the entrance, float32[band, y, x] each."""

    ghosts: F32
    starburst: F32
    glare: F32

    @property
    def total(self) -> F32:
        """The sum of the three."""
        return np.asarray(self.ghosts + self.starburst + self.glare)


def straylight(
    lens: Prescription,
    *,
    model: str,
    wavelength_nm: F64,
    shape: tuple[int, int],
    pitch_mm: float,
    sun_deg: float,
    azimuth_deg: float,
    sun_radius_rad: float,
    sun_xy_mm: tuple[float, float] | None = None,
    cleanliness: Cleanliness | None = None,
    baffle: Baffle | None = None,
    reflections: int = 2,
    coating_loss: float = 0.0,
) -> Straylight:
    """Straylight of a Sun at an angle from the axis and an azimuth (0: +x, right; 90°: +y, down).

    Parameters
    ----------
    lens
        At its final size; its sensor's middle lies on the axis.
    model
        Of the ghosts: 'traced' or 'paraxial'.
    wavelength_nm
        float64[band], nodes of the bands.
    sun_xy_mm
        The Sun's own image; default: f tan θ along the azimuth.
    coating_loss
        Share of the coatings' area that is gone, in [0, 1]: it raises ghosts. What the light straight through loses
        is left to whoever darkens the image by it.

    Raises InputError.
    """
    nodes = tuple(float(v) for v in np.atleast_1d(wavelength_nm))
    made = flare_model(lens, nodes, shape, pitch_mm, sun_radius_rad, model, reflections)
    turn = np.radians(azimuth_deg)
    if sun_xy_mm is None:
        radius = first_order(lens).efl_mm * np.tan(np.radians(sun_deg))
        sun_xy_mm = (float(radius * np.cos(turn)), float(radius * np.sin(turn)))
    lit = 1.0
    if baffle is not None and baffle.length_mm > 0:
        lit = float(
            baffle_transmission(
                sun_deg,
                length_mm=baffle.length_mm,
                radius_mm=baffle.radius_mm,
                entrance_radius_mm=lens.surfaces[0].semi_diameter_mm,
            )
        )
    clean = Cleanliness() if cleanliness is None else cleanliness
    glare = veiling_glare(
        lens,
        sun_deg=sun_deg,
        wavelength_nm=np.array(nodes),
        roughness_nm=clean.roughness_nm,
        cleanliness_level=clean.level,
        L=clean.knee,
        S=clean.slope,
    )
    rays = _starburst(lens, sun_radius_rad).image(sun_xy_mm, np.array(nodes), shape, pitch_mm)
    passed = np.array([transmittance(lens, forward(lens), w) for w in nodes], dtype=np.float32)
    rays *= (lit * passed)[:, None, None].astype(np.float32)
    return Straylight(
        ghosts=made.worn(coating_loss).image(sun_deg, azimuth_deg) * np.float32(lit),
        starburst=rays,
        glare=glare.image(sun_xy_mm, shape, pitch_mm) * np.float32(lit),
    )


@lru_cache(maxsize=4)
def _starburst(lens: Prescription, sun_radius_rad: float) -> Starburst:
    return starburst(lens, sun_radius_rad=sun_radius_rad)
