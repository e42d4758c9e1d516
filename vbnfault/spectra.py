"""Wavelengths, the Sun's spectrum, reflectances, sensor responses, constants.

The film records spectral radiance at *band nodes*. Between two nodes the ratio of radiance to sunlight is
taken as linear, so a sensor response R becomes the weights

    W[c, b] = ∫ R_c(λ) S(λ) h_b(λ) dλ / S_b,      S_b = ∫ S h_b dλ / ∫ h_b dλ,

h_b being the hat function of node b: exact for every reflectance that is linear between nodes, whatever the
lines of the solar spectrum S, and free of spectral noise. Sources are integrated on a 1 nm grid.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

PLANCK_J_S = 6.62607015e-34  # SI, exact
LIGHT_SPEED_M_S = 299792458.0  # SI, exact
AU_M = 149597870700.0  # IAU 2012, exact
SUN_RADIUS_M = 695_700e3  # IAU 2015 resolution B3
GRAVITATION_SI = 6.67430e-11  # CODATA 2018

F64 = NDArray[np.float64]

# Geometric albedo of 67P per filter: Fornasier et al. 2015 (A&A 583, A30), disk-integrated Hapke fit.
ALBEDO_67P_WAVELENGTH_NM = np.array([325.0, 480.0, 535.0, 649.0, 700.0, 743.0, 882.0, 989.0])
ALBEDO_67P_GEOMETRIC = np.array([0.0316, 0.0554, 0.0589, 0.0677, 0.0720, 0.0766, 0.0780, 0.0820])

# Named reflectances of the scene file: wavelength nodes in nm, and Lambert reflectance. A geometric albedo
# stands in as Lambert reflectance (2/3 of it would keep the disk-integrated flux of a sphere at zero phase);
# automatic exposure makes the level immaterial, the colour is what counts until the Hapke surface is chosen.
REFLECTANCES: dict[str, tuple[F64, F64]] = {
    "67p": (ALBEDO_67P_WAVELENGTH_NM, ALBEDO_67P_GEOMETRIC),
}


def band_nodes_nm(minimum_nm: float, maximum_nm: float, bands: int) -> F64:
    """Equally spaced band nodes, float64[bands], both ends included; one band sits in the middle."""
    if bands == 1:
        return np.array([(minimum_nm + maximum_nm) / 2])
    return np.linspace(minimum_nm, maximum_nm, bands)


def _fine_nm(nodes_nm: F64) -> F64:
    if len(nodes_nm) == 1:  # one band stands for the visible range around it
        lo, hi = nodes_nm[0] - 150.0, nodes_nm[0] + 150.0
    else:
        lo, hi = nodes_nm[0], nodes_nm[-1]
    return np.linspace(lo, hi, max(2, round(hi - lo)) + 1)


def _hats(nodes_nm: F64, fine_nm: F64) -> F64:
    if len(nodes_nm) == 1:
        return np.ones((1, len(fine_nm)))
    return np.stack([np.interp(fine_nm, nodes_nm, row) for row in np.eye(len(nodes_nm))])


@lru_cache(maxsize=1)
def _astm_g173() -> tuple[F64, F64]:
    # colour-science carries the extraterrestrial column of ASTM G173-03, in W m-2 nm-1
    from colour.plotting.datasets.astm_g_173 import DATA_ASTMG173_ETR as table

    return np.array(list(table.keys())), np.array(list(table.values()))


def solar_irradiance_W_m2_nm(wavelength_nm: F64, distance_au: float = 1.0) -> F64:
    """Extraterrestrial solar spectral irradiance (ASTM G173-03), W m⁻² nm⁻¹, float64 like `wavelength_nm`.

    Defined from 280 to 4000 nm; scales with the inverse square of the distance.
    """
    wavelength, irradiance = _astm_g173()
    return np.interp(wavelength_nm, wavelength, irradiance) / distance_au**2


@lru_cache(maxsize=16)
def _band_irradiance(nodes: tuple[float, ...]) -> F64:
    nodes_nm = np.array(nodes)
    fine = _fine_nm(nodes_nm)
    hats = _hats(nodes_nm, fine)
    sun = solar_irradiance_W_m2_nm(fine)
    return np.asarray(np.trapezoid(hats * sun, fine, axis=1) / np.trapezoid(hats, fine, axis=1))


def solar_band_irradiance_W_m2_nm(nodes_nm: F64, distance_au: float) -> F64:
    """S_b of the module's docstring: hat-weighted mean solar irradiance per band node, W m⁻² nm⁻¹."""
    return _band_irradiance(tuple(float(v) for v in nodes_nm)) / distance_au**2


def sun_angular_radius_rad(distance_au: float) -> float:
    """Angular radius of the solar disc, asin(R☉ / r)."""
    return float(np.arcsin(SUN_RADIUS_M / (distance_au * AU_M)))


def reflectance(spec: str | float | Mapping[str, tuple[float, ...]], wavelength_nm: F64) -> F64:
    """Lambert reflectance at `wavelength_nm`, float64: a name of `REFLECTANCES`, a grey value, or a table
    with `wavelength_nm` and `value`, interpolated linearly and held constant beyond its ends."""
    if isinstance(spec, str):
        nodes, values = REFLECTANCES[spec]
    elif isinstance(spec, Mapping):
        nodes, values = np.asarray(spec["wavelength_nm"], float), np.asarray(spec["value"], float)
    else:
        return np.full(len(wavelength_nm), float(spec))
    return np.interp(wavelength_nm, nodes, values)


@lru_cache(maxsize=8)
def _response_table(name: str) -> tuple[F64, F64]:
    """Relative response of R, G, B: wavelength_nm float64[n], value float64[n, 3] with peak 1."""
    from colour.characterisation.datasets.cameras.dslr.sensitivities import (
        MSDS_CAMERA_SENSITIVITIES_DSLR as table,
    )

    sensitivities = table[name]
    return np.asarray(sensitivities.wavelengths), np.asarray(sensitivities.values)


# Relative colour responses measured by NPL, as colour-science ships them (unit peak per channel).
RESPONSES = {"nikon_5100": "Nikon 5100 (NPL)", "sigma_sd_merrill": "Sigma SDMerill (NPL)"}


def response(name: str, wavelength_nm: F64, quantum_efficiency_peak: float) -> F64:
    """Quantum efficiency of R, G, B at `wavelength_nm`, float64[3, n], in [0, quantum_efficiency_peak]."""
    nodes, values = _response_table(RESPONSES[name])
    return quantum_efficiency_peak * np.stack(
        [np.interp(wavelength_nm, nodes, column, left=0.0, right=0.0) for column in values.T]
    )


def band_weights(name: str, quantum_efficiency_peak: float, nodes_nm: F64) -> F64:
    """Weights float64[3, band], in electrons nm / J: electrons = weights · energy per band (J m⁻² nm⁻¹ × m²).

    ∫ QE(λ) S(λ) h_b(λ) λ/(hc) dλ / S_b of the module's docstring.
    """
    fine = _fine_nm(nodes_nm)
    hats = _hats(nodes_nm, fine)
    sun = solar_irradiance_W_m2_nm(fine)
    per_photon = fine * 1e-9 / (PLANCK_J_S * LIGHT_SPEED_M_S)
    efficiency = response(name, fine, quantum_efficiency_peak)
    mean = np.trapezoid(hats * sun, fine, axis=1) / np.trapezoid(hats, fine, axis=1)
    integrand = efficiency[:, None, :] * (hats * sun * per_photon)[None]
    return np.asarray(np.trapezoid(integrand, fine, axis=2) / mean)
