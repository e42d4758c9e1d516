"""Compute the refractive index of optical media by wavelength.

A dispersion formula is one function below with `@dispersion`; a glass is one `register` call. Both also work from
outside the package, for example in a module that a scene names in `plugins`. Lens files name registered glasses,
give coefficients of any registered formula, or name glass catalogues in Zemax's format (`zemax`).
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..core.errors import InputError, shown
from ..core.registry import Registry

F64 = NDArray[np.float64]
# Wavelengths in nm, rising, and the internal transmittance of 10 mm at each.
Transmittance = tuple[tuple[float, ...], tuple[float, ...]]
Formula = Callable[[F64, Sequence[float]], F64]

D_NM, F_NM, C_NM = 587.5618, 486.1327, 656.2725  # Fraunhofer lines: He d, H F and C
RANGE_NM = (250.0, 2500.0)
CLEAR: Transmittance = ((D_NM,), (1.0,))
_INDEX_RANGE = (1.0, 5.0)


# --- dispersion formulas --------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Dispersion:
    """Hold a dispersion formula: the numbers of coefficients it may have, and its index from λ² in µm²."""

    counts: tuple[int, ...]
    index: Formula


DISPERSIONS: Registry[Dispersion] = Registry("dispersion formula", __name__, own_modules=False)


def dispersion(name: str, *counts: int) -> Callable[[Formula], Formula]:
    """Register a dispersion formula: a function of λ² in µm² and of the coefficients that returns the index.

    `counts` are the numbers of coefficients that the formula may have. λ² and index are float64[...].

    Raises
    ------
    DeclarationError
        Another formula has the name.
    """

    def registered(index: Formula) -> Formula:
        DISPERSIONS.add(name, Dispersion(counts, index), module=index.__module__, qualname=index.__qualname__)
        return index

    return registered


@dispersion("cauchy", 2)
def _cauchy(um2: F64, c: Sequence[float]) -> F64:
    """Return n = A + B λ⁻²."""
    return np.asarray(c[0] + c[1] / um2)


@dispersion("sellmeier", 6, 8, 10)
def _sellmeier(um2: F64, c: Sequence[float]) -> F64:
    """Return n² = 1 + Σ B_k λ² / (λ² - C_k); coefficients B₁, B₂, …, C₁, C₂, … of three to five terms."""
    half = len(c) // 2
    return np.asarray(np.sqrt(1 + sum(b * um2 / (um2 - k) for b, k in zip(c[:half], c[half:], strict=True))))


@dispersion("polynomial", 6, 8)
def _polynomial(um2: F64, c: Sequence[float]) -> F64:
    """Return n² = c₀ + c₁ λ² + c₂ λ⁻² + c₃ λ⁻⁴ + …, to λ⁻⁸ (Schott before 1992) or λ⁻¹²."""
    return np.asarray(np.sqrt(c[0] + c[1] * um2 + sum(k * um2**-n for n, k in enumerate(c[2:], start=1))))


@dispersion("polynomial_4", 9)
def _polynomial_4(um2: F64, c: Sequence[float]) -> F64:
    """Return n² = c₀ + c₁ λ² + c₂ λ⁴ + c₃ λ⁻² + c₄ λ⁻⁴ + …, to λ⁻¹²."""
    return np.asarray(
        np.sqrt(c[0] + c[1] * um2 + c[2] * um2**2 + sum(k * um2**-n for n, k in enumerate(c[3:], start=1)))
    )


@dispersion("polynomial_6", 8)
def _polynomial_6(um2: F64, c: Sequence[float]) -> F64:
    """Return n² = c₀ + c₁ λ² + c₂ λ⁻² + c₃ λ⁻⁴ + c₄ λ⁻⁶ + c₅ λ⁻⁸ + c₆ λ⁴ + c₇ λ⁶."""
    return np.asarray(np.sqrt(_polynomial(um2, c[:6]) ** 2 + c[6] * um2**2 + c[7] * um2**3))


@dispersion("herzberger", 6)
def _herzberger(um2: F64, c: Sequence[float]) -> F64:
    """Return n = A + B L + C L² + D λ² + E λ⁴ + F λ⁶ with L = 1 / (λ² - 0.028)."""
    pole = 1 / (um2 - 0.028)
    return np.asarray(c[0] + c[1] * pole + c[2] * pole**2 + c[3] * um2 + c[4] * um2**2 + c[5] * um2**3)


@dispersion("conrady", 3)
def _conrady(um2: F64, c: Sequence[float]) -> F64:
    """Return n = A + B / λ + C / λ^3.5."""
    return np.asarray(c[0] + c[1] * um2**-0.5 + c[2] * um2**-1.75)


@dispersion("sellmeier_2", 5)
def _sellmeier_2(um2: F64, c: Sequence[float]) -> F64:
    """Return n² = 1 + A + B₁ λ² / (λ² - λ₁²) + B₂ / (λ² - λ₂²); coefficients A, B₁, λ₁, B₂, λ₂."""
    return np.asarray(np.sqrt(1 + c[0] + c[1] * um2 / (um2 - c[2] ** 2) + c[3] / (um2 - c[4] ** 2)))


@dispersion("sellmeier_4", 5)
def _sellmeier_4(um2: F64, c: Sequence[float]) -> F64:
    """Return n² = A + B λ² / (λ² - C) + D λ² / (λ² - E)."""
    return np.asarray(np.sqrt(c[0] + c[1] * um2 / (um2 - c[2]) + c[3] * um2 / (um2 - c[4])))


@dispersion("handbook_1", 4)
def _handbook_1(um2: F64, c: Sequence[float]) -> F64:
    """Return n² = A + B / (λ² - C) - D λ²."""
    return np.asarray(np.sqrt(c[0] + c[1] / (um2 - c[2]) - c[3] * um2))


@dispersion("handbook_2", 4)
def _handbook_2(um2: F64, c: Sequence[float]) -> F64:
    """Return n² = A + B λ² / (λ² - C) - D λ²."""
    return np.asarray(np.sqrt(c[0] + c[1] * um2 / (um2 - c[2]) - c[3] * um2))


# --- glasses --------------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class Glass:
    """Describe a medium by a dispersion formula.

    Attributes
    ----------
    formula
        Name of a registered formula (`DISPERSIONS`), λ in µm.
    coefficients
        Its coefficients.
    internal_transmittance_10mm
        Internal transmittance of 10 mm, for rows of a prescription that give none of their own.
    """

    name: str
    formula: str
    coefficients: tuple[float, ...]
    internal_transmittance_10mm: Transmittance = CLEAR

    def index(self, wavelength_nm: ArrayLike) -> F64:
        """Return the index relative to air, float64 like `wavelength_nm`."""
        um2 = (np.asarray(wavelength_nm, dtype=np.float64) * 1e-3) ** 2
        return DISPERSIONS[self.formula].index(um2, self.coefficients)

    @property
    def nd(self) -> float:
        """Return the index at the d line."""
        return float(self.index(D_NM))

    @property
    def vd(self) -> float:
        """Return the Abbe number (nd - 1) / (nF - nC); infinite without dispersion."""
        spread = float(self.index(F_NM) - self.index(C_NM))
        return (self.nd - 1) / spread if spread else float("inf")

    def same_index(self, other: Glass) -> bool:
        """Return whether both media have the same index at all wavelengths by formula and coefficients."""
        return (self.formula, self.coefficients) == (other.formula, other.coefficients)


AIR = Glass(name="air", formula="cauchy", coefficients=(1.0, 0.0))

GLASSES: Registry[Glass] = Registry("glass", __name__, own_modules=False)


def register(glass: Glass) -> Glass:
    """Make a glass known by its name to lens files, and return it.

    Raises
    ------
    DeclarationError
        Another glass has the name.
    InputError
        The formula is unknown or takes another number of coefficients, the index is not from 1 to 5 between 400 and
        1000 nm, or the internal transmittance is not from 0 to 1 at rising wavelengths. The glass is then unknown.
    """
    _check_glass(glass)
    # a glass is a value, which does not know its module as a class does
    GLASSES.add(glass.name, glass, module=sys._getframe(1).f_globals["__name__"])
    return glass


def registered(name: str) -> Glass | None:
    """Return a registered glass by its name in any case, since Zemax writes capitals; None for an unknown name."""
    if name in GLASSES:
        return GLASSES[name]
    return next((glass for key, glass in GLASSES.items() if key.upper() == name.upper()), None)


def check_index(glass: Glass, where: str) -> None:
    """Raise InputError, which begins with `where`, unless the index is from 1 to 5 between 400 and 1000 nm."""
    with np.errstate(all="ignore"):  # a formula may divide by 0 or take the root of a negative number
        index = glass.index(np.linspace(400, 1000, 61))
    if not (np.isfinite(index).all() and index.min() >= _INDEX_RANGE[0] and index.max() <= _INDEX_RANGE[1]):
        wrong = index.max() if index.max() > _INDEX_RANGE[1] else index.min()
        raise InputError(f"{where}: its index must be from 1 to 5 between 400 and 1000 nm; got {wrong:g}")


def _check_glass(glass: Glass) -> None:
    """Raise InputError unless a lens file can use a glass."""
    where = f"glass {shown(glass.name)}"
    if not isinstance(glass.name, str) or not glass.name:
        raise InputError(f"{where}: its name must be a text that is not empty")
    if not all(isinstance(c, int | float) for c in glass.coefficients):
        raise InputError(f"{where}: coefficients = {shown(glass.coefficients)}: must be numbers")
    from_coefficients(glass.formula, glass.coefficients)
    check_index(glass, where)
    try:
        nodes, values = (np.asarray(column, dtype=np.float64) for column in glass.internal_transmittance_10mm)
    except (TypeError, ValueError):
        raise InputError(f"{where}: internal_transmittance_10mm: must be wavelengths and values") from None
    if nodes.ndim != 1 or nodes.shape != values.shape or not len(nodes) or not (np.diff(nodes) > 0).all():
        raise InputError(f"{where}: internal_transmittance_10mm: needs rising wavelengths and as many values")
    if not ((values >= 0) & (values <= 1)).all():
        raise InputError(f"{where}: internal_transmittance_10mm = {shown(values.tolist())}: must be from 0 to 1")


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


def from_coefficients(formula: str, coefficients: Sequence[float]) -> Glass:
    """Return a medium from a user's own coefficients.

    Raises
    ------
    InputError
        The formula is unknown or takes another number of coefficients.
    """
    if formula not in DISPERSIONS:
        raise InputError(f"glass.formula = {formula!r}: must be one of {', '.join(DISPERSIONS)}")
    counts = DISPERSIONS[formula].counts
    if len(coefficients) not in counts:
        allowed = " or ".join(map(str, counts))
        raise InputError(f"glass.coefficients: {formula} takes {allowed} numbers; got {len(coefficients)}")
    return Glass(name=formula, formula=formula, coefficients=tuple(float(c) for c in coefficients))


# Schott's data sheets; fused silica after Malitson 1965, JOSA 55, 1205. G in a name: stabilised against radiation.
for _name, _formula, _coefficients in (
    ("N-BK7", "sellmeier", (1.03961212, 0.231792344, 1.01046945, 0.00600069867, 0.0200179144, 103.560653)),
    ("F2", "sellmeier", (1.34533359, 0.209073176, 0.937357162, 0.00997743871, 0.0470450767, 111.886764)),
    ("SF6", "sellmeier", (1.72448482, 0.390104889, 1.04572858, 0.0134871947, 0.0569318095, 118.557185)),
    ("silica", "sellmeier", (0.6961663, 0.4079426, 0.8974794, 0.0684043**2, 0.1162414**2, 9.896161**2)),
    ("BK7G18", "polynomial", (2.2801838, -0.010066273, 0.010889844, 1.6359759e-4, -5.1283993e-7, 2.6440349e-7)),
):
    register(Glass(name=_name, formula=_formula, coefficients=_coefficients))
