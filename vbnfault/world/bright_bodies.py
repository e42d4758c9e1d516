"""Compute the light of bright bodies beside the target: planets at the date, and bodies that a scene declares.

They are sources of straylight only (`lens.straylight.scene`), as long as they are out of the frame: the image of a
planet in the frame is not drawn.

A planet's position follows from Keplerian elements (Standish, "Keplerian elements for approximate positions of the
major planets", JPL, table 1), whose errors from 1800 to 2050 are below 0.2° as seen from the Sun. Its brightness
follows from its V magnitude at 1 au from Sun and observer at full phase, V(1, 0) (Mallama & Hilton 2018, Astronomy
and Computing 25, 10), and from the phase law of a Lambert sphere. That law is assumed, since the published phase
curves of the outer planets end at the angles seen from Earth. Saturn is without its rings. All planets have the
Sun's colour (assumed).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..core.frames import J2000_JD, Orbit, unit
from ..core.spectra import AU_M
from ..scene.surroundings import BrightBodyTable

F64 = NDArray[np.float64]

_V_OF_THE_SUN = -26.76  # at 1 au (Willmer 2018, ApJS 236, 47, table 3)
_DAYS_PER_CENTURY = 36525.0


@dataclass(frozen=True, kw_only=True)
class _Planet:
    """Hold elements at J2000, their rates per century, V(1, 0) and mean radius.

    The elements are the semi-major axis in au, the eccentricity, and in degrees inclination, mean longitude, and
    the longitudes of perihelion and of the ascending node (ecliptic and equinox J2000).
    """

    elements: tuple[float, ...]
    rates: tuple[float, ...]
    magnitude_V: float
    radius_km: float

    def position_J_au(self, julian_date: float) -> F64:
        """Return the heliocentric position, float64[3]."""
        centuries = (julian_date - J2000_JD) / _DAYS_PER_CENTURY
        a, e, inclination, longitude, perihelion, node = (
            value + rate * centuries for value, rate in zip(self.elements, self.rates, strict=True)
        )
        motion = (self.rates[3] - self.rates[4]) / _DAYS_PER_CENTURY  # of the mean anomaly
        anomaly = (longitude - perihelion + 180) % 360 - 180
        return Orbit(
            eccentricity=e,
            perihelion_au=a * (1 - e),
            inclination_deg=inclination,
            node_deg=node,
            argument_deg=perihelion - node,
            perihelion_jd=julian_date - anomaly / motion,
            mean_motion_deg_day=motion,
        ).position_J_au(julian_date)


# Mean radii: JPL, planetary physical parameters. The Earth stands at the barycentre of Earth and Moon.
PLANETS = {
    "mercury": _Planet(
        elements=(0.38709927, 0.20563593, 7.00497902, 252.25032350, 77.45779628, 48.33076593),
        rates=(0.00000037, 0.00001906, -0.00594749, 149472.67411175, 0.16047689, -0.12534081),
        magnitude_V=-0.613,
        radius_km=2439.4,
    ),
    "venus": _Planet(
        elements=(0.72333566, 0.00677672, 3.39467605, 181.97909950, 131.60246718, 76.67984255),
        rates=(0.00000390, -0.00004107, -0.00078890, 58517.81538729, 0.00268329, -0.27769418),
        magnitude_V=-4.384,
        radius_km=6051.8,
    ),
    "earth": _Planet(
        elements=(1.00000261, 0.01671123, -0.00001531, 100.46457166, 102.93768193, 0.0),
        rates=(0.00000562, -0.00004392, -0.01294668, 35999.37244981, 0.32327364, 0.0),
        magnitude_V=-3.99,
        radius_km=6371.0,
    ),
    "mars": _Planet(
        elements=(1.52371034, 0.09339410, 1.84969142, -4.55343205, -23.94362959, 49.55953891),
        rates=(0.00001847, 0.00007882, -0.00813131, 19140.30268499, 0.44441088, -0.29257343),
        magnitude_V=-1.601,
        radius_km=3389.5,
    ),
    "jupiter": _Planet(
        elements=(5.20288700, 0.04838624, 1.30439695, 34.39644051, 14.72847983, 100.47390909),
        rates=(-0.00011607, -0.00013253, -0.00183714, 3034.74612775, 0.21252668, 0.20469106),
        magnitude_V=-9.395,
        radius_km=69911.0,
    ),
    "saturn": _Planet(
        elements=(9.53667594, 0.05386179, 2.48599187, 49.95424423, 92.59887831, 113.66242448),
        rates=(-0.00125060, -0.00050991, 0.00193609, 1222.49362201, -0.41897216, -0.28867794),
        magnitude_V=-8.95,
        radius_km=58232.0,
    ),
}


@dataclass(frozen=True, kw_only=True, eq=False)
class BrightBody:
    """Describe a body as the target sees it.

    Attributes
    ----------
    direction_J
        float64[3]: unit vector towards it.
    angular_radius_rad
        Angular radius of its disc.
    of_sunlight
        Its irradiance over that of the Sun at 1 au.
    """

    direction_J: F64
    angular_radius_rad: float
    of_sunlight: float


def lambert_phase(phase_rad: float) -> float:
    """Return the brightness of a Lambert sphere over that at full phase: (sin α + (π - α) cos α) / π."""
    return float((np.sin(phase_rad) + (np.pi - phase_rad) * np.cos(phase_rad)) / np.pi)


def planet(name: str, julian_date: float, sun_J_au: F64) -> BrightBody:
    """Return a planet as seen from a target whose Sun stands at `sun_J_au`, float64[3] in au."""
    data = PLANETS[name]
    from_sun = data.position_J_au(julian_date)
    towards = from_sun + sun_J_au
    distance, own = float(np.linalg.norm(towards)), float(np.linalg.norm(from_sun))
    phase = float(np.arccos(np.clip(unit(from_sun) @ unit(towards), -1, 1)))
    magnitude = data.magnitude_V + 5 * np.log10(own * distance)
    return BrightBody(
        direction_J=towards / distance,
        angular_radius_rad=float(np.arcsin(min(data.radius_km * 1e3 / (distance * AU_M), 1.0))),
        of_sunlight=float(10 ** (-0.4 * (magnitude - _V_OF_THE_SUN))) * lambert_phase(phase),
    )


def bright_bodies(
    tables: tuple[BrightBodyTable, ...], julian_date: float, sun_J_au: F64, sun_distance_au: float
) -> tuple[BrightBody, ...]:
    """Return the bodies of a scene at a date; `sun_distance_au` is the target's distance in the scene."""
    out = []
    for table in tables:
        if table.planet:
            out.append(planet(table.planet, julian_date, sun_J_au))
            continue
        ra, dec = np.radians([table.right_ascension_deg or 0.0, table.declination_deg or 0.0])
        out.append(
            BrightBody(
                direction_J=np.array([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)]),
                angular_radius_rad=float(np.radians(table.angular_radius_deg)),
                of_sunlight=(table.of_sunlight or 0.0) / sun_distance_au**2,
            )
        )
    return tuple(out)
