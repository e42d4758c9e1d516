"""Describe lenses by prescriptions (tables of surfaces), and change their scale or coatings.

`prescription_file` reads them from files and writes them.

Surfaces are counted from 0 at the front; the stop is a row like any other. Light travels towards +z, from the front
to the sensor. A surface's vertex is its point on the axis.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import Field

from ..core.tables import table_class
from .coating import DESIGN_NM, Layer, design
from .glass import AIR, CLEAR, D_NM, Glass, Transmittance

F64 = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Surface:
    """Describe one row of a prescription: a surface of revolution and the medium behind it.

    Attributes
    ----------
    radius_mm
        Radius of curvature at the vertex; positive where the centre lies behind the surface, inf for a plane.
    thickness_mm
        Distance from this vertex to the next.
    medium
        Medium behind the surface.
    semi_diameter_mm
        Radius of the rim: a ray that meets the surface farther from the axis is lost.
    coating
        Layers of the coating, in the order in which light from the front meets them.
    stop
        Whether the surface is the aperture stop. The stop only blocks rays; it does not refract.
    conic
        Conic constant: 0 is a sphere, -1 a paraboloid.
    aspheric_mm
        Coefficients of r⁴, r⁶, … of the sag, in mm to the power -3, -5, …
    internal_transmittance_10mm
        Internal transmittance of 10 mm of `medium`: wavelengths in nm, and transmitted fractions. It is
        interpolated linearly and constant outside the table.
    blades, blade_rounding, rotation_deg
        Shape of the stop. 0 blades make it round. Otherwise it is a polygon whose corners lie at
        `semi_diameter_mm`, the first corner at `rotation_deg` from +x. `blade_rounding`, 0 to 1, bulges the edges
        towards the circle.
    """

    radius_mm: float
    thickness_mm: float
    medium: Glass
    semi_diameter_mm: float
    coating: tuple[Layer, ...] = ()
    stop: bool = False
    conic: float = 0.0
    aspheric_mm: tuple[float, ...] = ()
    internal_transmittance_10mm: Transmittance = CLEAR
    blades: int = 0
    blade_rounding: float = 0.0
    rotation_deg: float = 0.0

    @property
    def curvature_per_mm(self) -> float:
        """Return 1 / radius; 0 for a plane."""
        return 0.0 if math.isinf(self.radius_mm) else 1.0 / self.radius_mm

    def sag_mm(self, height_mm: F64 | float) -> F64:
        """Return how far the surface lies behind its vertex at a distance from the axis; nan beyond its edge."""
        r2 = np.asarray(height_mm, dtype=np.float64) ** 2
        c = self.curvature_per_mm
        with np.errstate(invalid="ignore"):
            sag = c * r2 / (1 + np.sqrt(1 - (1 + self.conic) * c * c * r2))
        for k, a in enumerate(self.aspheric_mm):
            sag = sag + a * r2 ** (k + 2)
        return np.asarray(sag)

    def reach_mm(self, slope: F64) -> F64:
        """Return the largest distance from the axis, in the plane of the vertex, of a ray that meets the surface.

        `slope` is the ray's dx/dz, at least 0.
        """
        return np.asarray(self.semi_diameter_mm + np.abs(self.sag_mm(self.semi_diameter_mm)) * slope)

    def absorption_per_mm(self, wavelength_nm: ArrayLike) -> F64:
        """Return the absorption coefficient of the medium behind the surface, in 1 / mm, like `wavelength_nm`."""
        fraction = np.interp(np.asarray(wavelength_nm, dtype=np.float64), *self.internal_transmittance_10mm)
        return np.asarray(-np.log(np.maximum(fraction, 1e-30)) / 10)

    def rim_mm(self, angle_rad: F64 | float) -> F64:
        """Return the distance of the rim from the axis in directions measured from +x towards +y.

        It is `semi_diameter_mm` in every direction, except for a stop with blades.
        """
        angle = np.asarray(angle_rad, dtype=np.float64)
        if not self.blades:
            return np.full(angle.shape, self.semi_diameter_mm)
        half = np.pi / self.blades
        beside = np.mod(angle - np.radians(self.rotation_deg), 2 * half) - half
        edge = np.cos(half) / np.cos(beside)
        return np.asarray(self.semi_diameter_mm * (edge + (1 - edge) * self.blade_rounding))


@table_class()
class Hood:
    """Describe a hood before the lens, which keeps light from the side out of it; its edge is round.

    Its wall between this edge and the lens may be a cylinder or a cone, and is black.
    """

    length_mm: float = Field(gt=0, le=1e6, description="distance of its edge before the first vertex")
    radius_mm: float = Field(
        gt=0, le=1e6, description="radius of its edge, at least that of the first surface's rim"
    )


@dataclass(frozen=True, kw_only=True)
class Prescription:
    """Describe a lens by its surfaces, front to back, with air in front and behind.

    The sensor stands at the paraxial focus for the d line. The thickness of the last row does not move it.

    Attributes
    ----------
    sensor_reflectance
        Fraction of the light that the sensor reflects, the same at all angles.
    scale
        Factor by which the lens was scaled since it was read.
    hood
        What stands before the lens; None: nothing.
    """

    name: str
    source: str
    surfaces: tuple[Surface, ...]
    sensor_reflectance: float = 0.0
    scale: float = 1.0
    hood: Hood | None = None

    @property
    def stop(self) -> int:
        """Return the row of the stop."""
        return next(k for k, s in enumerate(self.surfaces) if s.stop)

    @property
    def vertices_mm(self) -> F64:
        """Return the distance of each vertex behind the first vertex, float64[row]."""
        return np.concatenate([[0.0], np.cumsum([s.thickness_mm for s in self.surfaces[:-1]])])

    @property
    def film_nm(self) -> float:
        """Return the optical thickness of the thickest coating, 0 without any."""
        return max(sum(layer.n * layer.thickness_nm for layer in s.coating) for s in self.surfaces)

    @property
    def spectral_step_nm(self) -> float:
        """Return the distance of wavelengths that resolve the light of ghosts, for interpolation by a spline.

        There are 12 of them in a fringe of the thickest coating, and they are 2 to 8 nm apart. A glass that absorbs
        may have edges, for which they are 2 nm apart.
        """
        if any(s.internal_transmittance_10mm != CLEAR for s in self.surfaces):
            return 2.0
        return float(np.clip(400.0**2 / (2 * max(self.film_nm, 1.0)) / 12, 2.0, 8.0))

    def indices(self, wavelength_nm: float = D_NM) -> F64:
        """Return the indices of all media, float64[row + 1]: before the first row, then behind each row."""
        return np.array([1.0, *(float(s.medium.index(wavelength_nm)) for s in self.surfaces)])

    def scaled(self, factor: float) -> Prescription:
        """Return the lens with every length of its drawing multiplied by a factor.

        These lengths are radii, thicknesses (of elements, gaps and plates), rims, stop, hood and aspheric
        coefficients.

        Some properties keep their physical size: the layers of coatings in nm and therefore their reflectance,
        roughness in nm, grains of dust in µm, the number of particles per area at a cleanliness level, and the
        absorption of the glass per mm. A larger lens therefore absorbs more. Field angles, f-numbers and the paths
        of ghosts in units of the focal length do not change.
        """
        surfaces = tuple(
            replace(
                s,
                radius_mm=s.radius_mm * factor,
                thickness_mm=s.thickness_mm * factor,
                semi_diameter_mm=s.semi_diameter_mm * factor,
                aspheric_mm=tuple(a * factor ** -(2 * k + 3) for k, a in enumerate(s.aspheric_mm)),
            )
            for s in self.surfaces
        )
        hood = self.hood and Hood(length_mm=self.hood.length_mm * factor, radius_mm=self.hood.radius_mm * factor)
        return replace(self, surfaces=surfaces, scale=self.scale * factor, hood=hood)

    def with_round_stop(self) -> Prescription:
        """Return the lens with a round stop of the same area, for models with rotational symmetry."""
        rim = self.surfaces[self.stop]
        if not rim.blades:
            return self
        turn = np.linspace(0, 2 * np.pi, 3600, endpoint=False)
        radius = float(np.sqrt(np.mean(rim.rim_mm(turn) ** 2)))
        surfaces = list(self.surfaces)
        surfaces[self.stop] = replace(rim, semi_diameter_mm=radius, blades=0)
        return replace(self, surfaces=tuple(surfaces))

    def coated(self, name: str) -> Prescription:
        """Return the lens with a named coating on every surface between glass and air. Raises InputError."""
        media = (AIR, *(s.medium for s in self.surfaces))
        surfaces = []
        for front, surface in zip(media, self.surfaces, strict=False):
            bare = front.nd == surface.medium.nd or 1.0 not in (front.nd, surface.medium.nd)
            films = () if bare else facing_air(name, front, surface.medium)
            surfaces.append(replace(surface, coating=films))
        return replace(self, surfaces=tuple(surfaces))


def facing_air(name: str, front: Glass, back: Glass) -> tuple[Layer, ...]:
    """Return a named coating in the order in which light from the front meets it.

    Its outer layer lies on the side of the air.
    """
    films = design(name, float(max(front.index(DESIGN_NM), back.index(DESIGN_NM))))
    return films if front.nd == 1.0 else films[::-1]
