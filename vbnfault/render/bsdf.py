"""Reflection of the terrain, per band.

A BSDF gives *terms*, computed per sample, and weights of each term in each band: bands are linear in the terms,
so only the terms are summed over the samples of a pixel. One term is all a Lambert surface needs; a BSDF whose
shape changes with wavelength brings a term a band.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from .runtime import dr


class Lambert:
    """Diffuse reflection: BRDF ρ/π. `reflectance` float64[band] in [0, 1]."""

    def __init__(self, reflectance: NDArray[np.float64]) -> None:
        self.weights = reflectance[None, :] / np.pi

    def terms(self, cos_incidence: Any) -> list[Any]:
        """Per sample, BRDF × cos i = terms · weights in sr⁻¹; 0 where the light comes from below."""
        return [dr.maximum(cos_incidence, 0)]
