"""Provide band nodes, the Sun's spectrum and limb darkening, reflectances, sensor responses and constants.

The film records spectral radiance at *band nodes*. The ratio of radiance to sunlight is assumed to be linear
between two nodes, so that a sensor response R becomes the weights

    W[c, b] = ∫ R_c(λ) S(λ) h_b(λ) dλ / S_b,      S_b = ∫ S h_b dλ / ∫ h_b dλ,

where h_b is the hat function of node b and S the solar spectrum. The weights are exact for every reflectance that
is linear between nodes, whatever lines S has, and they add no spectral noise. All integrals use a 1 nm grid.

Behind a lens, S is the sunlight that its coatings and glass transmit. `Bands` are the weights of the wavelengths
where not nodes but a sensor's channels count, as for straylight.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import NDArray

from .files.resources import data_dir

PLANCK_J_S = 6.62607015e-34  # SI, exact
LIGHT_SPEED_M_S = 299792458.0  # SI, exact
AU_M = 149597870700.0  # IAU 2012, exact
SUN_RADIUS_M = 695_700e3  # IAU 2015 resolution B3
GRAVITATION_SI = 6.67430e-11  # CODATA 2018

F64 = NDArray[np.float64]

# Geometric albedo of 67P per filter: Fornasier et al. 2015 (A&A 583, A30), disc-integrated Hapke fit.
ALBEDO_67P_WAVELENGTH_NM = np.array([325.0, 480.0, 535.0, 649.0, 700.0, 743.0, 882.0, 989.0])
ALBEDO_67P_GEOMETRIC = np.array([0.0316, 0.0554, 0.0589, 0.0677, 0.0720, 0.0766, 0.0780, 0.0820])

# Named reflectances of the scene file: wavelength nodes in nm, and Lambert reflectance. The geometric albedo of 67P
# serves as Lambert reflectance (3/2 of it would keep the disc-integrated flux of a sphere at zero phase). Automatic
# exposure removes the level, so only the colour counts, until the scene selects Hapke's model.
REFLECTANCES: dict[str, tuple[F64, F64]] = {
    "67p": (ALBEDO_67P_WAVELENGTH_NM, ALBEDO_67P_GEOMETRIC),
}


def band_nodes_nm(minimum_nm: float, maximum_nm: float, bands: int) -> F64:
    """Return equally spaced band nodes, float64[bands], with both ends; a single node is the middle."""
    if bands == 1:
        return np.array([(minimum_nm + maximum_nm) / 2])
    return np.linspace(minimum_nm, maximum_nm, bands)


def fine_nodes_nm(nodes_nm: F64) -> F64:
    """Return the wavelengths of the grid for integrals over the bands, float64[n], about 1 nm apart."""
    if len(nodes_nm) == 1:  # one band covers 300 nm around its node
        lo, hi = nodes_nm[0] - 150.0, nodes_nm[0] + 150.0
    else:
        lo, hi = nodes_nm[0], nodes_nm[-1]
    return np.linspace(lo, hi, max(2, round(hi - lo)) + 1)


def hat_weights(nodes_nm: F64, fine_nm: F64) -> F64:
    """Return the hat functions of the nodes, float64[band, n]; a single band has a constant 1."""
    if len(nodes_nm) == 1:
        return np.ones((1, len(fine_nm)))
    return np.stack([np.interp(fine_nm, nodes_nm, row) for row in np.eye(len(nodes_nm))])


def band_means(values: F64, nodes_nm: F64) -> F64:
    """Return the means over sunlight in every band, ∫ v S h_b dλ / ∫ S h_b dλ, of values on `fine_nodes_nm`."""
    return np.asarray(_sunlit_hats(tuple(nodes_nm.tolist())) @ values)


@lru_cache(maxsize=16)
def _sunlit_hats(nodes: tuple[float, ...]) -> F64:
    """Return the weights of the fine wavelengths in each band under sunlight, float64[band, n], with the sum 1."""
    fine = fine_nodes_nm(np.array(nodes))
    weights = hat_weights(np.array(nodes), fine) * solar_irradiance_W_m2_nm(fine) * _steps(fine)
    return np.asarray(weights / weights.sum(axis=1, keepdims=True))


def _steps(nm: F64) -> F64:
    """Return the weights of the trapezoidal rule on an even grid, float64[n]; that of a single wavelength is 1."""
    steps = np.full(len(nm), nm[1] - nm[0] if len(nm) > 1 else 2.0)
    steps[[0, -1]] /= 2
    return steps


def sunlike(irradiance: F64, nodes_nm: F64) -> F64:
    """Return a spectrum at `fine_nodes_nm`, float64[n], from its values in the bands.

    Its ratio to sunlight is linear between the nodes.
    """
    fine = fine_nodes_nm(nodes_nm)
    ratio = irradiance / solar_band_irradiance_W_m2_nm(nodes_nm, 1.0)
    return np.asarray(ratio @ hat_weights(nodes_nm, fine) * solar_irradiance_W_m2_nm(fine))


# Nodes of a spectrum for what varies slowly. With 5 instead of 8, the ghosts of the packaged lenses with the
# coating `bbar` change by up to 2 % in a colour.
_SMOOTH_NODES = 8


@dataclass(frozen=True, kw_only=True)
class Bands:
    """Hold the weights of wavelengths in bands: the value in a band is the weighted mean over the wavelengths.

    Attributes
    ----------
    nm
        Wavelengths, rising, about 1 nm apart; or a single one.
    weight
        Weights of the wavelengths in each band, with the sum 1.
    """

    nm: tuple[float, ...]
    weight: tuple[tuple[float, ...], ...]

    @classmethod
    def of(cls, nm: F64, spectra: F64) -> Bands:
        """Return bands of spectra float64[band, n] at `nm`; a dark band has the same weight everywhere."""
        weight = spectra * _steps(nm)
        total = weight.sum(axis=1, keepdims=True)
        weight = np.where(total > 0, weight / np.where(total > 0, total, 1), 1 / len(nm))
        return cls(nm=tuple(nm.tolist()), weight=tuple(map(tuple, weight.tolist())))

    @classmethod
    def sunlit(cls, nodes_nm: F64) -> Bands:
        """Return the bands of nodes under sunlight; a single node is one wavelength."""
        if len(nodes_nm) == 1:
            return cls.lines(nodes_nm[0])
        fine = fine_nodes_nm(nodes_nm)
        return cls.of(fine, hat_weights(nodes_nm, fine) * solar_irradiance_W_m2_nm(fine))

    @classmethod
    def sunlight(cls, minimum_nm: float, maximum_nm: float) -> Bands:
        """Return one band with the Sun's spectrum between two wavelengths; if they are the same, this line."""
        if minimum_nm == maximum_nm:
            return cls.lines(minimum_nm)
        nm = fine_nodes_nm(np.array([minimum_nm, maximum_nm]))
        return cls.of(nm, solar_irradiance_W_m2_nm(nm)[None])

    @classmethod
    def lines(cls, *wavelength_nm: float) -> Bands:
        """Return bands of a single wavelength each; the wavelengths rise."""
        weight = np.eye(len(wavelength_nm)).tolist()
        return cls(nm=tuple(map(float, wavelength_nm)), weight=tuple(map(tuple, weight)))

    def __len__(self) -> int:
        """Return the number of bands."""
        return len(self.weight)

    @cached_property
    def wavelength_nm(self) -> F64:
        """Return the wavelengths, float64[n]."""
        return np.array(self.nm)

    @cached_property
    def weights(self) -> F64:
        """Return the weights, float64[band, n]."""
        return np.array(self.weight)

    @cached_property
    def nodes_nm(self) -> F64:
        """Return the wavelengths between which whatever varies slowly with wavelength is linear, float64[node]."""
        if len(self.nm) <= _SMOOTH_NODES:
            return self.wavelength_nm
        return np.linspace(self.nm[0], self.nm[-1], _SMOOTH_NODES)

    def sampled_nm(self, step_nm: float) -> F64:
        """Return an even grid of wavelengths at most `step_nm` apart, float64[n]."""
        if len(self.nm) <= _SMOOTH_NODES:
            return self.wavelength_nm
        return np.linspace(
            self.nm[0], self.nm[-1], max(_SMOOTH_NODES, int(np.ceil((self.nm[-1] - self.nm[0]) / step_nm)) + 1)
        )

    def mean(self, values: F64) -> F64:
        """Return the means of values float64[n] in all bands, float64[band]."""
        return np.asarray(self.weights @ values)

    def smooth_mean(self, values: F64) -> F64:
        """Return the means float64[band, ...] of what varies slowly, from its values at the nodes."""
        return np.asarray(np.tensordot(self.weights @ hat_weights(self.nodes_nm, self.wavelength_nm).T, values, 1))

    def behind(self, transmittance: F64) -> Bands:
        """Return the bands behind a filter with a transmittance float64[n]."""
        return Bands.of(self.wavelength_nm, self.weights * transmittance / _steps(self.wavelength_nm))


def _packaged_table(name: str) -> F64:
    """Return the rows of a packaged table, float64[n, column]; the first column is the wavelength in nm.

    colour-science has the same responses, but it takes two seconds to import. tests/test_spectra.py compares them.
    """
    return np.loadtxt(data_dir("catalogues") / f"{name}.csv", delimiter=",", skiprows=1)


@lru_cache(maxsize=1)
def _solar_spectrum() -> tuple[F64, F64]:
    """Return wavelengths in nm and the Sun's irradiance at 1 au in W m⁻² nm⁻¹; the table covers 280 to 4000 nm."""
    wavelength, irradiance = _packaged_table("solar_spectrum").T
    return wavelength, irradiance


def solar_irradiance_W_m2_nm(wavelength_nm: F64, distance_au: float = 1.0) -> F64:
    """Return the extraterrestrial solar spectral irradiance, W m⁻² nm⁻¹, float64.

    The spectrum is TSIS-1 HSRS (Coddington et al. 2023, Earth and Space Science 10, e2022EA002637; to 0.3 % from
    460 nm on, 1.3 % below), whose total is the solar constant of 1361 W/m² (Kopp & Lean 2011, Geophys. Res. Lett.
    38, L01706). The irradiance scales with the inverse square of the distance.
    """
    wavelength, irradiance = _solar_spectrum()
    return np.interp(wavelength_nm, wavelength, irradiance) / distance_au**2


@lru_cache(maxsize=16)
def _band_irradiance(nodes: tuple[float, ...]) -> F64:
    """Return S_b of the module docstring at 1 au, W m⁻² nm⁻¹, float64[band]."""
    nodes_nm = np.array(nodes)
    fine = fine_nodes_nm(nodes_nm)
    hats = hat_weights(nodes_nm, fine)
    sun = solar_irradiance_W_m2_nm(fine)
    return np.asarray(np.trapezoid(hats * sun, fine, axis=1) / np.trapezoid(hats, fine, axis=1))


def solar_band_irradiance_W_m2_nm(nodes_nm: F64, distance_au: float) -> F64:
    """Return S_b of the module docstring, the hat-weighted mean solar irradiance per band node, W m⁻² nm⁻¹."""
    return _band_irradiance(tuple(float(v) for v in nodes_nm)) / distance_au**2


def sun_angular_radius_rad(distance_au: float) -> float:
    """Return the angular radius of the solar disc, asin(R☉ / r)."""
    return float(np.arcsin(SUN_RADIUS_M / (distance_au * AU_M)))


# Limb darkening I(μ)/I(1) = Σ A_k μᵏ: Neckel & Labs 1994, Solar Physics 153, 91, table 1
_LIMB_NM_AND_A = np.array(
    [
        (401.970, 0.12323, 1.08648, -0.43974, 0.45912, -0.32759, 0.09850),
        (427.930, 0.14249, 1.28796, -1.19564, 1.68603, -1.36658, 0.44572),
        (443.885, 0.16220, 1.24893, -0.92165, 0.89978, -0.50148, 0.11220),
        (457.345, 0.16604, 1.38544, -1.52275, 2.00232, -1.45969, 0.42864),
        (477.427, 0.19571, 1.30551, -1.25845, 1.50626, -1.05472, 0.30570),
        (492.905, 0.20924, 1.30798, -1.20411, 1.21505, -0.67196, 0.14381),
        (519.930, 0.23695, 1.29927, -1.28034, 1.37760, -0.85054, 0.21706),
        (541.760, 0.26073, 1.27428, -1.30352, 1.47085, -0.96618, 0.26384),
        (559.950, 0.26892, 1.34319, -1.58427, 1.91271, -1.31350, 0.37295),
        (579.880, 0.28392, 1.36896, -1.75998, 2.22154, -1.56074, 0.44630),
        (610.975, 0.30854, 1.36620, -1.83572, 2.33221, -1.63082, 0.45959),
        (640.970, 0.33644, 1.30590, -1.79238, 2.45040, -1.89979, 0.59943),
        (669.400, 0.34685, 1.37539, -2.04425, 2.70493, -1.94290, 0.55999),
        (700.875, 0.37885, 1.25553, -1.70908, 2.19647, -1.59554, 0.47378),
        (748.710, 0.40627, 1.22842, -1.67877, 2.05535, -1.39972, 0.38845),
        (811.760, 0.42977, 1.25182, -1.85164, 2.31949, -1.59101, 0.44155),
        (869.600, 0.45396, 1.25101, -2.02958, 2.75410, -2.02287, 0.59338),
        (948.850, 0.47855, 1.19813, -1.86296, 2.36939, -1.64367, 0.46056),
    ]
)


def limb_darkening(wavelength_nm: F64) -> F64:
    """Return the coefficients c_k, float64[band, 6], of Σ c_k μᵏ, the Sun's radiance over the mean of its disc.

    μ is the cosine of the angle to the local vertical, √(1 - ρ²) at a fraction ρ of the disc's radius. The
    coefficients are linear between the tabulated wavelengths (402 to 949 nm) and constant beyond them.
    """
    nodes, a = _LIMB_NM_AND_A[:, 0], _LIMB_NM_AND_A[:, 1:]
    a = a / a.sum(axis=1, keepdims=True)  # the sums of the table are 1 to five digits only
    coefficients = np.column_stack([np.interp(wavelength_nm, nodes, column) for column in a.T])
    mean = coefficients @ (2 / (np.arange(6) + 2))  # μᵏ has the mean 2 / (k + 2) over the disc
    return np.asarray(coefficients / mean[:, None])


def reflectance(spec: str | float | Mapping[str, tuple[float, ...]], wavelength_nm: F64) -> F64:
    """Return the Lambert reflectance at `wavelength_nm`, float64[n].

    `spec` is a name of `REFLECTANCES`, a grey value, or a table with `wavelength_nm` and `value`. A table is
    interpolated linearly and is constant beyond its ends.
    """
    if isinstance(spec, str):
        nodes, values = REFLECTANCES[spec]
    elif isinstance(spec, Mapping):
        nodes, values = np.asarray(spec["wavelength_nm"], float), np.asarray(spec["value"], float)
    else:
        return np.full(len(wavelength_nm), float(spec))
    return np.interp(wavelength_nm, nodes, values)


@lru_cache(maxsize=8)
def _response_table(name: str) -> tuple[F64, F64]:
    """Return wavelengths in nm float64[n] and the relative responses of R, G, B float64[n, 3], each with peak 1."""
    table = _packaged_table(f"response_{name}")
    return table[:, 0], table[:, 1:]


# Relative colour responses measured by NPL (unit peak per channel): vbnfault/catalogues/SOURCES.md.
RESPONSES = ("nikon_5100", "sigma_sd_merrill")

FLAT = "flat"  # no filters: every channel has the peak efficiency at all wavelengths


def response(name: str, wavelength_nm: F64, quantum_efficiency_peak: float) -> F64:
    """Return the QE of R, G, B at `wavelength_nm`, float64[3, n], from 0 to `quantum_efficiency_peak`."""
    if name == FLAT:
        return np.full((3, len(wavelength_nm)), quantum_efficiency_peak)
    nodes, values = _response_table(name)
    return quantum_efficiency_peak * np.stack(
        [np.interp(wavelength_nm, nodes, column, left=0.0, right=0.0) for column in values.T]
    )


def electron_weights(efficiency: Callable[[F64], F64], nodes_nm: F64, transmittance: F64 | None = None) -> F64:
    """Return weights float64[channel, band] in electrons nm / J: electrons = weights · energy per band in J / nm.

    The weights are ∫ QE(λ) S(λ) h_b(λ) λ/(hc) dλ / S_b with the symbols of the module docstring. `efficiency`
    returns QE, float64[channel, n], at wavelengths in nm. `transmittance` float64[n] at `fine_nodes_nm` is that of
    the lens before the sensor: S is then the sunlight behind it, and S_b its mean.
    """
    fine = fine_nodes_nm(nodes_nm)
    hats = hat_weights(nodes_nm, fine)
    sun = solar_irradiance_W_m2_nm(fine)
    if transmittance is not None:
        sun = sun * np.maximum(transmittance, 1e-12)  # a dark band has no light, and any weight
    mean = np.trapezoid(hats * sun, fine, axis=1) / np.trapezoid(hats, fine, axis=1)
    integrand = (efficiency(fine) * per_joule(fine))[:, None, :] * (hats * sun)[None]
    return np.asarray(np.trapezoid(integrand, fine, axis=2) / mean)


def per_joule(wavelength_nm: F64) -> F64:
    """Return the photons in a joule of light, float64 like `wavelength_nm`."""
    return wavelength_nm * 1e-9 / (PLANCK_J_S * LIGHT_SPEED_M_S)
