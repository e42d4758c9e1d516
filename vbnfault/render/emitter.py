"""The Sun as a disc of finite angular size and true spectral irradiance."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..scene import Sunlight
from .runtime import dr, mi
from .sampling import opaque_vector


class SunDisc:
    """Directions on the disc, and whether a ray looks at it. Works with offsets from the centre direction:
    the cosine of a quarter of a degree has three significant bits left in float32."""

    def __init__(self, sun: Sunlight) -> None:
        z = sun.direction_L / np.linalg.norm(sun.direction_L)
        x = np.cross(z, np.eye(3)[np.argmin(np.abs(z))])
        x /= np.linalg.norm(x)
        self.direction = opaque_vector(mi.Vector3f, z)
        self._x = opaque_vector(mi.Vector3f, x)
        self._y = opaque_vector(mi.Vector3f, np.cross(z, x))
        self._tangent = dr.opaque(mi.Float, np.tan(sun.angular_radius_rad))
        self._chord2 = dr.opaque(mi.Float, (2 * np.sin(sun.angular_radius_rad / 2)) ** 2)

    def towards(self, p: Any) -> Any:
        """Unit direction towards the point of the disc at `p` on the unit disc."""
        return dr.normalize(self.direction + self._tangent * (p.x * self._x + p.y * self._y))

    def contains(self, direction: Any) -> Any:
        """Whether a unit direction looks at the disc."""
        return dr.squared_norm(direction - self.direction) < self._chord2
