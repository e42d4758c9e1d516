"""Define Hapke's reflectance with the parameter sets of 67P, and its evaluation in the bands of a scene."""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import Field, model_validator

from ..core.tables import Table
from .contract import LEAST_COSINE, BandReflectance, Reflectance, Triple, tan_half_phase

F64 = NDArray[np.float64]

_TINY = 1e-30
_MOST_ROWS = 10_000


@dataclass(frozen=True, kw_only=True, eq=False)
class Hapke:
    """Model the reflectance after Hapke, with opposition surges, roughness and porosity.

    The sources are Hapke 2002, Icarus 157, 523, and Hapke 2012, Theory of Reflectance and Emittance Spectroscopy,
    2nd ed., chapters 9 and 12. Each parameter is float64[band]:

    - `single_scattering_albedo` w in [0, 1]
    - `asymmetry` g in (-1, 1) of the Henyey-Greenstein function; a negative g scatters back
    - `shadow_hiding_amplitude` B0 >= 0 and `shadow_hiding_width` h_s > 0 (dimensionless, not an angle)
    - `coherent_amplitude` B_C0 >= 0 and `coherent_width` h_c > 0
    - `roughness_deg` mean slope angle, 0 to 60, of the relief that is smaller than a pixel
    - `porosity_factor` K >= 1
    """

    single_scattering_albedo: F64
    asymmetry: F64
    shadow_hiding_amplitude: F64
    shadow_hiding_width: F64
    coherent_amplitude: F64
    coherent_width: F64
    roughness_deg: F64
    porosity_factor: F64

    @property
    def terms(self) -> int:
        """Return the number of terms: one per band, since the shape changes with wavelength."""
        return len(self.single_scattering_albedo)

    @cached_property
    def weights(self) -> F64:
        """Return the identity, float64[band, band]: each term is the reflectance of its own band."""
        return np.eye(self.terms)

    def evaluate(self, m: Any, light: Triple, view: Triple) -> list[Any]:
        """Return r per band; it is 0 where the light comes from below the surface."""
        lit = light[2] > 0
        light = (light[0], light[1], m.maximum(light[2], _TINY))
        view = (view[0], view[1], m.maximum(view[2], LEAST_COSINE))
        half = tan_half_phase(m, light, view)
        cos_phase = light[0] * view[0] + light[1] * view[1] + light[2] * view[2]
        shared: dict[tuple[float, float], tuple[Any, ...]] = {}
        out = []
        for band in range(self.terms):
            p = {f.name: float(getattr(self, f.name)[band]) for f in fields(self)}
            k = p["porosity_factor"]
            key = p["roughness_deg"], k
            if key not in shared:
                mu0, mu, shadowing = _rough(m, light, view, np.radians(p["roughness_deg"]))
                seeliger = m.select(lit, shadowing * (mu0 / (mu0 + mu)) * (k / (4 * np.pi)), 0)
                shared[key] = seeliger, *(_chandrasekhar_parts(m, m.maximum(c / k, _TINY)) for c in (mu0, mu))
            seeliger, *parts = shared[key]
            w = p["single_scattering_albedo"]
            # The function of single scattering is `above` / `below`, and that of multiple scattering is
            # 1 / `inverse` - 1. Their sum is computed as one quotient, because divisions are slow.
            above, below = _henyey_greenstein(m, p["asymmetry"], cos_phase)
            if p["shadow_hiding_amplitude"]:  # 1 + B0 h / (h + tan(α/2))
                h = p["shadow_hiding_width"]
                above, below = above * (half + h * (1 + p["shadow_hiding_amplitude"])), below * (half + h)
            inverse = _inverse_chandrasekhar(w, *parts[0]) * _inverse_chandrasekhar(w, *parts[1])
            value = w * seeliger * ((above * inverse + below * (1 - inverse)) / (below * inverse))
            if p["coherent_amplitude"]:
                value = value * (1 + p["coherent_amplitude"] * _coherent(m, half / p["coherent_width"]))
            out.append(value)
        return out


# --- parts of the models ------------------------------------------------------------------------------------


def _henyey_greenstein(m: Any, g: float, cos_phase: Any) -> tuple[float, Any]:
    """Return numerator and denominator of P(α) = (1 - g²) / (1 + 2 g cos α + g²)^(3/2)."""
    base = 1 + g * g + 2 * g * cos_phase
    return 1 - g * g, base * m.sqrt(base)


def _chandrasekhar_parts(m: Any, x: Any) -> tuple[Any, Any]:
    """Return x/2 · L and x - x² L with L = ln((1 + x) / x); 1 / H(x) is linear in these two functions of x."""
    scaled = x * m.log((1 + x) / x)
    return 0.5 * scaled, x - x * scaled


def _inverse_chandrasekhar(w: float, first: Any, second: Any) -> Any:
    """Return 1 / H(x) = 1 - w x [r0 + (1/2 - r0 x) ln((1 + x) / x)] (Hapke 2002, eq. 13).

    `first` and `second` are the results of `_chandrasekhar_parts`.
    """
    gamma = np.sqrt(1 - w)
    r0 = float((1 - gamma) / (1 + gamma))
    return 1 - w * first - w * r0 * second


def _coherent(m: Any, z: Any) -> Any:
    """Return the coherent-backscatter surge [1 + (1 - e^-z) / z] / [2 (1 + z)²] (Hapke 2002, eq. 32)."""
    # a series for small z, where 1 - e^-z loses its digits
    mean = m.select(z < 1e-2, 1 - z * (0.5 - z * (1 / 6)), (1 - m.exp(-z)) / m.maximum(z, 1e-2))
    return (1 + mean) / (2 * (1 + z) * (1 + z))


def _rough(m: Any, light: Triple, view: Triple, theta: float) -> tuple[Any, Any, Any]:
    """Return the effective cosines and the shadowing S of a rough surface (Hapke 1984, Icarus 59, 41)."""
    mu0, mu = light[2], view[2]
    if theta == 0:
        return mu0, mu, 1.0
    tan, cot = float(np.tan(theta)), float(1 / np.tan(theta))
    chi = float(1 / np.sqrt(1 + np.pi * tan * tan))
    sin_i = m.sqrt(light[0] * light[0] + light[1] * light[1])
    sin_e = m.sqrt(view[0] * view[0] + view[1] * view[1])
    # Azimuth ψ between the two directions from their tangent vectors; where one vanishes, ψ has no effect below.
    lx, ly = (light[k] / m.maximum(sin_i, 1e-15) for k in (0, 1))
    vx, vy = (view[k] / m.maximum(sin_e, 1e-15) for k in (0, 1))
    sin2 = 0.25 * ((lx - vx) * (lx - vx) + (ly - vy) * (ly - vy))
    cos2 = 0.25 * ((lx + vx) * (lx + vx) + (ly + vy) * (ly + vy))
    tan_half = m.sqrt(sin2 / m.maximum(cos2, 1e-15))
    psi_fraction = m.atan(tan_half) * (2 / np.pi)
    cos_psi = cos2 - sin2
    f = m.exp(-2 * tan_half)

    def averages(cos: Any, sin: Any) -> tuple[Any, Any, Any]:
        c = m.minimum(cot * cos / m.maximum(sin, 1e-15), 1e6)
        e1, e2 = m.exp(-2 / np.pi * c), m.exp(-1 / np.pi * c * c)
        return e1, e2, chi * (cos + sin * tan * e2 / (2 - e1))

    e1_i, e2_i, eta_i = averages(mu0, sin_i)
    e1_e, e2_e, eta_e = averages(mu, sin_e)
    high = mu0 >= mu  # i <= e
    e1_far, e1_near = m.select(high, e1_e, e1_i), m.select(high, e1_i, e1_e)
    e2_far, e2_near = m.select(high, e2_e, e2_i), m.select(high, e2_i, e2_e)
    scale = tan / (2 - e1_far - psi_fraction * e1_near)
    near = (cos_psi * e2_far + sin2 * e2_near) * scale  # for the direction nearer to the normal
    far = (e2_far - sin2 * e2_near) * scale
    mu0_e = chi * (mu0 + sin_i * m.select(high, near, far))
    mu_e = chi * (mu + sin_e * m.select(high, far, near))
    nearest = m.select(high, mu0 / eta_i, mu / eta_e)
    shadowing = (mu_e / eta_e) * (mu0 / eta_i) * chi / (1 - f + f * chi * nearest)
    return mu0_e, mu_e, shadowing


# --- parameters ---------------------------------------------------------------------------------------------

COLUMNS = tuple(f.name for f in fields(Hapke))
# w, g, B0, h_s, B_C0, h_c, roughness, K at each wavelength
HAPKE_TABLES: dict[str, tuple[tuple[float, ...], ...]] = {
    # disc-integrated, per filter (Fornasier et al. 2015, A&A 583, A30, table 3)
    "67p_fornasier2015": (
        (325.0, 0.028, -0.35, 1.83, 0.029, 0.0, 1.0, 15.0, 1.0),
        (480.0, 0.035, -0.43, 1.91, 0.021, 0.0, 1.0, 15.0, 1.0),
        (535.0, 0.037, -0.42, 1.95, 0.023, 0.0, 1.0, 15.0, 1.0),
        (649.0, 0.045, -0.41, 1.97, 0.026, 0.0, 1.0, 15.0, 1.0),
        (700.0, 0.050, -0.38, 2.22, 0.027, 0.0, 1.0, 15.0, 1.0),
        (743.0, 0.053, -0.40, 1.96, 0.023, 0.0, 1.0, 15.0, 1.0),
        (882.0, 0.052, -0.40, 2.08, 0.027, 0.0, 1.0, 15.0, 1.0),
        (989.0, 0.066, -0.35, 2.07, 0.032, 0.0, 1.0, 15.0, 1.0),
    ),
    # disc-resolved at 649 nm (the same paper, table 4); at other wavelengths w follows the disc-integrated albedo
    "67p_hapke2002": ((649.0, 0.042, -0.37, 2.5, 0.079, 0.188, 0.017, 15.0, 1.0),),
    "67p_hapke2012": ((649.0, 0.034, -0.42, 2.25, 0.061, 0.0, 1.0, 28.0, 1.20),),
}


def hapke_at(wavelength_nm: ArrayLike, table: str | tuple[tuple[float, ...], ...] = "67p_fornasier2015") -> Hapke:
    """Return Hapke's parameters at wavelengths float64[band] in nm.

    They are interpolated linearly and are constant beyond the ends of the table. `table` names one of
    `HAPKE_TABLES` or gives rows (wavelength in nm, then the columns of `Hapke` in order). The single-wavelength
    sets of 67P scale w as the geometric albedo of the disc-integrated table, since the other parameters of that
    table vary with wavelength, too: w alone rises twice as much to 989 nm as the albedo.

    Raises
    ------
    KeyError
        No table has this name.
    """
    nodes_nm = np.asarray(wavelength_nm, dtype=np.float64)
    rows = np.array(HAPKE_TABLES[table] if isinstance(table, str) else table, dtype=np.float64)
    rows = rows[np.argsort(rows[:, 0])]
    columns = {name: np.interp(nodes_nm, rows[:, 0], rows[:, k]) for k, name in enumerate(COLUMNS, start=1)}
    if isinstance(table, str) and len(rows) == 1:
        spectrum_nm = np.array(HAPKE_TABLES["67p_fornasier2015"])[:, 0]
        albedo = geometric_albedo(hapke_at(spectrum_nm))
        here, there = (np.interp(x, spectrum_nm, albedo) for x in (nodes_nm, rows[0, 0]))
        columns["single_scattering_albedo"] = columns["single_scattering_albedo"] * here / there
    return Hapke(**columns)


def geometric_albedo(model: Hapke) -> F64:
    """Return the geometric albedo A_geo of a smooth sphere, float64[band] (Hapke 2012, eq. 11.34 with K = 1).

    A_geo = r0/2 + r0²/6 + (w/8) [(1 + B0) P(0) - 1]. The published tables list it too, so it checks them. A
    roughness of 15° lowers it by less than 1 %.
    """
    w, g = model.single_scattering_albedo, model.asymmetry
    gamma = np.sqrt(1 - w)
    r0 = (1 - gamma) / (1 + gamma)
    p0 = (1 - g * g) / (1 + g) ** 3
    return np.asarray(r0 / 2 + r0**2 / 6 + w / 8 * ((1 + model.shadow_hiding_amplitude) * p0 - 1))


# --- the table of the scene file ------------------------------------------------------------------------------


class HapkeRow(Table):
    """Give Hapke's parameters at one wavelength (Hapke 2002, 2012)."""

    wavelength_nm: float = Field(gt=0, le=1e5, description="at which these parameters hold")
    single_scattering_albedo: float = Field(ge=0, le=1, description="w")
    asymmetry: float = Field(gt=-1, lt=1, description="g of Henyey-Greenstein; negative scatters back")
    shadow_hiding_amplitude: float = Field(0.0, ge=0, le=100, description="B0")
    shadow_hiding_width: float = Field(1.0, gt=0, le=100, description="h_s, dimensionless: not an angle")
    coherent_amplitude: float = Field(0.0, ge=0, le=100, description="B_C0")
    coherent_width: float = Field(1.0, gt=0, le=100, description="h_c")
    roughness_deg: float = Field(0.0, ge=0, le=60, description="mean slope below a pixel")
    porosity_factor: float = Field(1.0, ge=1, le=10, description="K")


class HapkeReflectance(Reflectance):
    """Reflect after Hapke, by a named set of parameters or by the rows of a table."""

    model: Literal["hapke"] = "hapke"
    parameters: str = Field("67p_fornasier2015", description="a named set of Hapke's parameters")
    hapke: tuple[HapkeRow, ...] | None = Field(
        None,
        min_length=1,
        max_length=_MOST_ROWS,
        description="Hapke's parameters at wavelengths of one's own, in place of a named set",
    )

    scales_reflectance: ClassVar[bool] = False

    @model_validator(mode="after")
    def _known(self) -> HapkeReflectance:
        if self.parameters not in HAPKE_TABLES:
            known = ", ".join(HAPKE_TABLES)
            raise ValueError(f"parameters = {self.parameters!r}: must be one of {known}")
        return self

    def at(self, wavelength_nm: F64, reflectance: F64) -> BandReflectance:
        """Return Hapke's model with the parameters of the bands; `reflectance` has no effect."""
        if self.hapke is None:
            return hapke_at(wavelength_nm, self.parameters)
        rows = tuple((row.wavelength_nm, *(getattr(row, name) for name in COLUMNS)) for row in self.hapke)
        return hapke_at(wavelength_nm, rows)

    @property
    def keys_of_67p(self) -> tuple[str, ...]:
        """Return the key of the named set, which is always one of 67P."""
        return () if self.hapke else ("parameters",)
