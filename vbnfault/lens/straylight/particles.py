"""Compute how particles on a surface scatter light: their number by the standard's law, and Mie's series."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import j1

from ...core.files.array_files import ArrayFiles, code_hash
from ..coating import reflect_transmit
from ..glass import D_NM, RANGE_NM

F64 = NDArray[np.float64]
C128 = NDArray[np.complex128]

# Beyond this level dust covers all of a surface, so the models are not valid.
CLEANLINESS_LIMITS = (0.0, 1000.0)

# Assumed. Estimates for mineral dusts are n from 1.5 to 1.7 and k from 1e-5 to 1e-3 (Amsterdam-Granada Light
# Scattering Database, Muñoz et al. 2012, JQSRT 113, 565).
DUST_INDEX = 1.53 + 0.0005j

_CC1246_SLOPE = 0.926
_CC1246_AREA_UM2 = 0.1e12  # 0.1 m²
_SMALLEST_UM = 1.0  # smallest diameter of the standard's distribution
_MIE_LARGEST = 500.0  # size parameter above which diffraction and geometrical optics are used
_TABLES = ArrayFiles(kind="mie", content="table of dust's scattering")
_BIN = 0.01  # width of bins in ln(size parameter)
_ANGLES = 321


def particle_count(level: float, diameter_um: ArrayLike) -> F64:
    """Return the number of particles larger than a diameter on 0.1 m² (IEST-STD-CC1246); 0 below level 1.

    The result is float64 like `diameter_um`.
    """
    log = np.log10(np.asarray(diameter_um, dtype=np.float64))
    if level < 1:
        return np.zeros(log.shape)
    return np.asarray(10 ** (_CC1246_SLOPE * (np.log10(level) ** 2 - log**2)))


def scattered_intensity(size_parameter: ArrayLike, cosine: ArrayLike, *, index: complex = DUST_INDEX) -> F64:
    """Return k² dσ/dΩ of spheres for unpolarised light, float64[size, angle].

    Up to a size parameter π D/λ of 500, the result is Mie's series. For larger spheres, the result is the sum of
    Fraunhofer diffraction, the rays reflected outside and the rays refracted twice, without interference. Up to
    70°, this sum is within 8 % of the mean of Mie's series over sizes; at 90° the sum is a fifth below this mean.
    """
    x, mu = np.atleast_1d(np.asarray(size_parameter, float)), np.atleast_1d(np.asarray(cosine, float))
    small = x <= _MIE_LARGEST
    intensity_of = np.empty((len(x), len(mu)))
    intensity_of[small] = _mie(x[small], mu, index)
    intensity_of[~small] = _large(x[~small], mu, index)
    return intensity_of


def _mie(x: F64, mu: F64, index: complex) -> F64:
    """Return the intensity by Mie's series, as one matrix product (Bohren & Huffman 1983, chapter 4)."""
    if not len(x):
        return np.empty((0, len(mu)))
    a, b = _coefficients(x, index)
    orders = a.shape[1]
    pi, tau = np.zeros((2, orders + 1, len(mu)))
    pi[1] = 1
    for n in range(1, orders + 1):
        if n > 1:
            pi[n] = ((2 * n - 1) * mu * pi[n - 1] - n * pi[n - 2]) / (n - 1)
        tau[n] = n * mu * pi[n] - (n + 1) * pi[n - 1]
    order = np.arange(1, orders + 1)
    a, b = ((2 * order + 1) / (order * (order + 1)) * c for c in (a, b))
    plus = (a + b) @ (pi + tau)[1:]
    minus = (a - b) @ (pi - tau)[1:]
    # S1 and S2 are half the sum and half the difference of the two
    return (np.abs(plus) ** 2 + np.abs(minus) ** 2) / 4


def _coefficients(x: F64, index: complex) -> tuple[C128, C128]:
    """Return the coefficients a and b of Mie's series, complex128[size, order - 1]; 0 beyond Wiscombe's last order.

    They follow from the Riccati-Bessel functions ψ and χ of x and from ψ'/ψ of x and of `index` x (Bohren & Huffman
    1983, eq. 4.88). Each recurrence runs in its stable direction: χ upwards, ψ'/ψ downwards. ψ follows from both by
    the Wronskian ψ'χ - ψχ' = 1. Up to x = 500 the error is below 1e-13.
    """
    last = np.floor(x + 4.05 * np.cbrt(x) + 2)  # Wiscombe 1980, Applied Optics 19, 1505
    orders = int(last.max())
    n = np.arange(1, orders + 1)[:, None]

    def logarithmic_derivative(z: NDArray[Any]) -> NDArray[Any]:
        value = np.zeros((orders + 1, len(x)), z.dtype)
        for k in range(orders + 16 + int(np.abs(z).max()), 0, -1):
            value[min(k - 1, orders)] = k / z - 1 / (value[min(k, orders)] + k / z)
        return value[1:]

    chi = np.empty((orders + 1, len(x)))
    chi[0], before = np.cos(x), -np.sin(x)
    with np.errstate(over="ignore", invalid="ignore"):  # of small spheres beyond their last order
        for k in range(orders):
            chi[k + 1], before = (2 * k + 1) / x * chi[k] - before, chi[k]
        inside, outside = logarithmic_derivative(index * x), logarithmic_derivative(x) + n / x
        psi = 1 / (outside * chi[1:] - chi[:-1])
        psi_before = outside * psi
        xi, xi_before = psi - 1j * chi[1:], psi_before - 1j * chi[:-1]
        a, b = (
            np.where(n <= last, (factor * psi - psi_before) / (factor * xi - xi_before), 0).T
            for factor in (inside / index + n / x, inside * index + n / x)
        )
    return a, b


def _large(x: F64, mu: F64, index: complex) -> F64:
    """Return the intensity of large spheres by diffraction and geometrical optics."""
    n, size = index.real, x[:, None]
    sine = np.sqrt(np.maximum(1 - mu * mu, 0))
    # the edge adds to extinction, which widens the diffracting disc (Nussenzveig & Wiscombe 1980, PRL 45, 1490)
    disc = size * np.sqrt(1 + 0.9962 * size ** (-2 / 3))
    across = disc * np.maximum(sine, 1e-12)
    diffracted = np.where(mu > 0, disc**4 * (j1(across) / across) ** 2, 0)
    # the ray reflected outside turns by π - 2i, the ray refracted twice by 2(i - r)
    rs, rp, _, _ = reflect_transmit((), 1.0, n, np.maximum(np.sqrt((1 - mu) / 2), 1e-9), D_NM)
    reflected = (rs + rp) / 8
    half, turn = np.arccos(mu) / 2, np.maximum(np.arccos(mu), 1e-6)
    i = np.arctan2(n * np.sin(turn / 2), n * np.cos(half) - 1)
    passes = (n * np.cos(half) > 1) & (i < np.pi / 2)
    i = np.where(passes, i, 0.5)
    r = np.arcsin(np.sin(i) / n)
    _, _, ts, tp = reflect_transmit((), 1.0, n, np.cos(i), D_NM)
    spread = np.sin(i) * np.cos(i) / (np.sin(turn) * 2 * (1 - np.cos(i) / (n * np.cos(r))))
    refracted = np.where(passes, (ts**2 + tp**2) / 2 * spread, 0)
    return np.asarray(diffracted + size**2 * (reflected + refracted * np.exp(-4 * size * index.imag * np.cos(r))))


@lru_cache(maxsize=1)
def _intensities() -> tuple[F64, F64, F64]:
    """Return the intensity at all sizes and forward angles.

    The result is the bin edges of the size parameter, the angles in rad, and the table float64[bin, angle]. One
    table serves all wavelengths, because the index is a constant. It takes a second and is kept on disk.
    """
    largest = np.pi * 1e3 * 1000.0 / RANGE_NM[0]
    edges = np.exp(np.arange(0.0, np.log(largest) + _BIN, _BIN))
    angles = np.geomspace(1e-5, np.pi / 2, _ANGLES)

    def computed() -> dict[str, F64]:
        return {"intensity": scattered_intensity(np.sqrt(edges[1:] * edges[:-1]), np.cos(angles))}

    here = Path(__file__)
    code = code_hash([here, here.parents[1] / "coating.py"])
    table = _TABLES.kept(code, computed)["intensity"]
    for array in (edges, angles, table):
        array.setflags(write=False)
    return edges, angles, table


@lru_cache(maxsize=256)
def _dust(level: float, wavelength_nm: float) -> tuple[F64, float]:
    """Return the intensity of a dusty surface over its irradiance, float64[angle] in 1/sr, and an integral.

    The integral is that of the intensity over the forward hemisphere.
    """
    edges, angles, table = _intensities()
    wavelength_um = 1e-3 * wavelength_nm
    diameters = np.clip(edges * wavelength_um / np.pi, _SMALLEST_UM, max(level, _SMALLEST_UM))
    bins = -np.diff(particle_count(level, diameters)) / _CC1246_AREA_UM2
    intensity = bins @ table / (2 * np.pi / wavelength_um) ** 2
    intensity.setflags(write=False)
    scattered = np.trapezoid(2 * np.pi * np.sin(angles) * angles * intensity, x=np.log(angles))
    return intensity, float(scattered)


def particle_bsdf(cleanliness_level: float, wavelength_nm: float, beta: ArrayLike) -> F64:
    """Return the forward scatter of particles on a surface, in 1/sr, float64 like `beta`; 0 for β of 1 or more.

    Particles are spheres with the sizes of IEST-STD-CC1246, from 1 µm to `cleanliness_level` µm. The light
    falls on them along the normal, and each particle scatters independently of the others.
    """
    level = float(cleanliness_level)
    intensity, _ = _dust(level, float(wavelength_nm))
    b = np.abs(np.asarray(beta, dtype=np.float64))
    if level <= _SMALLEST_UM:
        return np.zeros(b.shape)
    angles = _intensities()[1]
    angle = np.arcsin(np.clip(b, np.sin(angles[0]), 1))
    scattered = np.exp(np.interp(np.log(angle), np.log(angles), np.log(intensity)))
    # radiance is intensity over cosine; beyond 84° a mean cosine of the outermost ring conserves the flux
    cosine = np.where(b * b < 0.99, np.sqrt(np.maximum(1 - b * b, 0)), 0.05)
    return np.where(b < 1, scattered / cosine, 0.0)


def particle_scatter_fraction(cleanliness_level: float, wavelength_nm: float) -> float:
    """Return the fraction of light that the particles of `particle_bsdf` scatter forwards."""
    return _dust(float(cleanliness_level), float(wavelength_nm))[1]
