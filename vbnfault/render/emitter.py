"""Model the Sun as a limb-darkened disc with its true angular size and spectral irradiance."""

from __future__ import annotations

from typing import Any

import numpy as np

from .description import Sunlight
from .runtime import dr, mi
from .sampling import opaque_vector


class SunDisc:
    """Compute directions towards points of the disc.

    Directions are offsets from the direction of the centre. In float32, the cosine of a quarter of a degree would
    keep only a few significant bits of its difference from 1.
    """

    def __init__(self, sun: Sunlight) -> None:
        z = sun.direction_L / np.linalg.norm(sun.direction_L)
        x = np.cross(z, np.eye(3)[np.argmin(np.abs(z))])
        x /= np.linalg.norm(x)
        self.direction = opaque_vector(mi.Vector3f, z)
        self._x = opaque_vector(mi.Vector3f, x)
        self._y = opaque_vector(mi.Vector3f, np.cross(z, x))
        self._tangent = dr.opaque(mi.Float, np.tan(sun.angular_radius_rad))

    def towards(self, p: Any) -> Any:
        """Return the unit direction towards the point of the disc at `p` on the unit disc."""
        return dr.normalize(self.direction + self._tangent * (p.x * self._x + p.y * self._y))


def mu(p: Any) -> Any:
    """Return the cosine of the angle to the Sun's local vertical at a point of the unit disc."""
    return dr.sqrt(dr.maximum(1 - dr.squared_norm(p), 0))


class Limb:
    """Represent limb darkening by few terms: Σ_k weights[k, b] · term_k(μ).

    This sum is the radiance of band b over its mean on the disc. The profiles of neighbouring bands are nearly
    multiples of one another, so a singular value decomposition keeps only the components above 1e-4 of the largest.
    """

    def __init__(self, sun: Sunlight) -> None:
        bands = len(sun.irradiance_W_m2_nm)
        self.coefficients, self.weights = np.ones((1, 1)), np.ones((1, bands))
        self.profiles = sun.limb_darkening
        if sun.limb_darkening is not None:
            grid = np.linspace(0, 1, 256)[None, :] ** np.arange(6)[:, None]
            u, s, _ = np.linalg.svd(sun.limb_darkening @ grid, full_matrices=False)
            kept = max(1, int(np.sum(s > 1e-4 * s[0])))
            self.coefficients, self.weights = u[:, :kept].T @ sun.limb_darkening, u[:, :kept].T

    def terms(self, mu: Any) -> list[Any]:
        """Return the terms at μ."""
        return [polynomial(c, mu) for c in self.coefficients]


def polynomial(coefficients: np.ndarray, x: Any) -> Any:
    """Return Σ c_k xᵏ by Horner's rule; the coefficients are runtime values, not constants of the kernel."""
    total = dr.opaque(mi.Float, float(coefficients[-1]))
    for c in coefficients[-2::-1]:
        total = dr.fma(total, x, dr.opaque(mi.Float, float(c)))
    return total
