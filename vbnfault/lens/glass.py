"""Compute the refractive index of optical media by wavelength."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..core.errors import InputError

F64 = NDArray[np.float64]

D_NM, F_NM, C_NM = 587.5618, 486.1327, 656.2725  # Fraunhofer lines: He d, H F and C
RANGE_NM = (250.0, 2500.0)


@dataclass(frozen=True, kw_only=True)
class Glass:
    """Describe a medium by one of three dispersion formulas, λ in micrometres.

    - `cauchy`: n = A + B λ⁻², coefficients (A, B);
    - `sellmeier`: n² = 1 + Σ B_k λ² / (λ² - C_k), coefficients (B₁, B₂, B₃, C₁, C₂, C₃);
    - `polynomial`: n² = c₀ + c₁ λ² + c₂ λ⁻² + c₃ λ⁻⁴ + c₄ λ⁻⁶ + c₅ λ⁻⁸ (Schott before 1992).
    """

    name: str
    formula: str
    coefficients: tuple[float, ...]

    def index(self, wavelength_nm: ArrayLike) -> F64:
        """Return the index relative to air, float64 like `wavelength_nm`."""
        um2 = (np.asarray(wavelength_nm, dtype=np.float64) * 1e-3) ** 2
        c = self.coefficients
        if self.formula == "cauchy":
            return np.asarray(c[0] + c[1] / um2)
        if self.formula == "sellmeier":
            return np.sqrt(1 + sum(b * um2 / (um2 - k) for b, k in zip(c[:3], c[3:], strict=True)))
        return np.sqrt(c[0] + c[1] * um2 + sum(k * um2**-n for n, k in enumerate(c[2:], start=1)))

    @property
    def nd(self) -> float:
        """Return the index at the d line."""
        return float(self.index(D_NM))

    @property
    def vd(self) -> float:
        """Return the Abbe number (nd - 1) / (nF - nC); infinite without dispersion."""
        spread = float(self.index(F_NM) - self.index(C_NM))
        return (self.nd - 1) / spread if spread else float("inf")


AIR = Glass(name="air", formula="cauchy", coefficients=(1.0, 0.0))


def from_abbe(nd: float, vd: float | None) -> Glass:
    """Return a medium by Cauchy's formula from its index and Abbe number at the d line; None: no dispersion."""
    slope = 0.0
    if vd is not None:
        slope = (nd - 1) / vd / ((F_NM * 1e-3) ** -2 - (C_NM * 1e-3) ** -2)
    return Glass(
        name=f"{nd:.5f}" + ("" if vd is None else f"/{vd:.1f}"),
        formula="cauchy",
        coefficients=(nd - slope / (D_NM * 1e-3) ** 2, slope),
    )


def _sellmeier(name: str, *coefficients: float) -> Glass:
    """Return a medium by Sellmeier's formula."""
    return Glass(name=name, formula="sellmeier", coefficients=coefficients)


# Schott's data sheets; fused silica after Malitson 1965, JOSA 55, 1205. G in a name: stabilised against radiation.
_CATALOGUE = (
    _sellmeier("N-BK7", 1.03961212, 0.231792344, 1.01046945, 0.00600069867, 0.0200179144, 103.560653),
    _sellmeier("F2", 1.34533359, 0.209073176, 0.937357162, 0.00997743871, 0.0470450767, 111.886764),
    _sellmeier("SF6", 1.72448482, 0.390104889, 1.04572858, 0.0134871947, 0.0569318095, 118.557185),
    _sellmeier("silica", 0.6961663, 0.4079426, 0.8974794, 0.0684043**2, 0.1162414**2, 9.896161**2),
    Glass(
        name="BK7G18",
        formula="polynomial",
        coefficients=(2.2801838, -0.010066273, 0.010889844, 1.6359759e-4, -5.1283993e-7, 2.6440349e-7),
    ),
)
GLASSES: Mapping[str, Glass] = MappingProxyType({glass.name: glass for glass in _CATALOGUE})


def named(name: str) -> Glass:
    """Return a glass of the catalogue.

    Raises
    ------
    InputError
        The name is unknown; the message lists the known ones.
    """
    if name not in GLASSES:
        raise InputError(f"glass = {name!r}: unknown; known are {', '.join(GLASSES)}")
    return GLASSES[name]


def from_coefficients(formula: str, coefficients: Sequence[float]) -> Glass:
    """Return a medium from a user's own coefficients.

    Raises
    ------
    InputError
        The formula is unknown or takes another number of coefficients.
    """
    counts = {"cauchy": 2, "sellmeier": 6, "polynomial": 6}
    if formula not in counts:
        raise InputError(f"glass.formula = {formula!r}: must be one of {', '.join(counts)}")
    if len(coefficients) != counts[formula]:
        raise InputError(f"glass.coefficients: {formula} takes {counts[formula]} numbers; got {len(coefficients)}")
    return Glass(name=formula, formula=formula, coefficients=tuple(float(c) for c in coefficients))
