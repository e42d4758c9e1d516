"""Reflection of the terrain, per band."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from .runtime import dr, mi


class Lambert:
    """Diffuse reflection: BRDF ρ/π. `reflectance` float64[band] in [0, 1]."""

    def __init__(self, reflectance: NDArray[np.float64]) -> None:
        self._brdf = [dr.opaque(mi.Float, float(r) / np.pi) for r in reflectance]

    def evaluate(self, cos_incidence: Any) -> list[Any]:
        """BRDF × cos i per band, in sr⁻¹; 0 where the light comes from below."""
        cosine = dr.maximum(cos_incidence, 0)
        return [cosine * brdf for brdf in self._brdf]
