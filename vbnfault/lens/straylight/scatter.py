"""Compute veiling glare, and the fraction of the lens that a source lights through a baffle.

Veiling glare is the light of a far bright source that rough and dusty lens surfaces scatter. The scatter of one
surface is a BSDF over β, the distance between two directions in direction cosines in air. A surface roughness of
spatial frequency f turns light by β = λ f in every medium. The integral of the BSDF over the disc β < 1 is the
fraction of the light that the surface scatters forwards: the total integrated scatter (TIS).
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import erf, exprel, j1

from ...core.array_files import ArrayFiles, code_hash
from ...core.errors import InputError
from ...core.spectra import Bands
from ..coating import reflect_transmit
from ..footprint import disc_overlap
from ..glass import D_NM, RANGE_NM
from ..paraxial import paraxial_properties
from ..prescription import Prescription
from ..rays import forward
from ..thin import beyond_frame
from .paraxial import along, axial_transmittance, mirrors
from .pyramid import in_layers

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
C128 = NDArray[np.complex128]

REFERENCE_NM = 550.0  # wavelength at which roughness and the Harvey knee are quoted
# Outside these limits the models are not valid: a surface is not optically smooth, or dust covers all of it.
ROUGHNESS_NM_LIMITS = (0.0, 50.0)
CLEANLINESS_LIMITS = (0.0, 1000.0)
ROUGHNESS_NM, KNEE, SLOPE = 1.0, 0.01, -1.5  # assumed: a good polish, and usual values for its scatter

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
_LOOKUP = 1 << 16
_OFFSETS: F64 = np.geomspace(1e-6, 2.0, 1025)
_STEEPEST_DEG = 89.9
_DISC = 65  # points across a beam
_AROUND = 360  # azimuths about the source, for the flux outside the frame


@dataclass(frozen=True, kw_only=True)
class Cleanliness:
    """Describe what scatters on the surfaces of a lens.

    Attributes
    ----------
    roughness_nm
        Rms roughness of every surface.
    level
        Level of IEST-STD-CC1246 of the particles on every surface next to air; 0 means no particles.
    knee, slope
        Knee (at 550 nm) and slope of the scatter by roughness, as in `Harvey`.
    """

    roughness_nm: float = ROUGHNESS_NM
    level: float = 0.0
    knee: float = KNEE
    slope: float = SLOPE


POLISHED = Cleanliness()


def _check(name: str, value: ArrayLike, low: float, high: float) -> F64:
    """Return a value as float64. Raises InputError if any part of the value is out of range."""
    array = np.asarray(value, dtype=np.float64)
    wrong = ~((array >= low) & (array <= high))
    if wrong.any():
        raise InputError(f"{name} = {array[wrong].flat[0]:g}: must be from {low:g} to {high:g}")
    return array


# --- roughness --------------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class Harvey:
    """Model the scatter of a polished surface: BSDF = b0 [1 + (β/L)²]^(S/2), per steradian (Harvey 1976).

    Attributes
    ----------
    b0
        BSDF in the direction of the unscattered light, in 1/sr.
    L
        Value of β at which the BSDF begins to fall, about 1e-4 to 1e-2.
    S
        Slope of log BSDF over log β beyond L, about -0.5 to -2.5.
    """

    b0: float
    L: float
    S: float

    @classmethod
    def of_roughness(
        cls,
        *,
        roughness_nm: float,
        index_step: float,
        wavelength_nm: float = REFERENCE_NM,
        L: float = KNEE,
        S: float = SLOPE,
    ) -> Harvey:
        """Return the model with TIS = (2π Δn σ/λ)², where σ is the rms roughness of spatial frequencies up to 1/λ.

        `index_step` is Δn; for a mirror Δn is 2.

        Raises
        ------
        InputError
            The roughness is outside 0 to 50 nm, L outside 1e-5 to 1, or S outside -4 to 0.
        """
        sigma = float(_check("roughness_nm", roughness_nm, *ROUGHNESS_NM_LIMITS))
        L, S = float(_check("L", L, 1e-5, 1.0)), float(_check("S", S, -4.0, 0.0))
        total = (2 * np.pi * index_step * sigma / wavelength_nm) ** 2
        return cls(b0=float(total / cls(b0=1.0, L=L, S=S).tis), L=L, S=S)

    def bsdf(self, beta: ArrayLike) -> F64:
        """Return the BSDF in 1/sr, float64 like `beta`; for β of 1 or more, the BSDF is 0."""
        b = np.abs(np.asarray(beta, dtype=np.float64))
        return np.where(b < 1, self.b0 * (1 + (b / self.L) ** 2) ** (self.S / 2), 0.0)

    @property
    def tis(self) -> float:
        """Return the fraction of light scattered.

        The fraction is 2π b0 L²/(S+2) [(1+L⁻²)^((S+2)/2) - 1]. For S = -2 the fraction is π b0 L² ln(1+L⁻²).
        """
        wide = np.log1p(self.L**-2)
        return float(np.pi * self.b0 * self.L**2 * wide * exprel((self.S / 2 + 1) * wide))

    def at(self, wavelength_nm: float, *, known_at_nm: float = REFERENCE_NM) -> Harvey:
        """Return the model of the same surface at another wavelength: L ∝ λ, b0 ∝ λ⁻⁴, and S does not change.

        The change of the refractive index is not included. The BSDF of a smooth surface is (2π Δn)² λ⁻⁴ PSD(β/λ),
        and the PSD does not depend on λ (generalised Harvey-Shack theory: Krywonos, Harvey & Choi 2011, JOSA A 28,
        1121). Hence TIS ∝ λ⁻² σ², where σ is the roughness up to the frequency 1/λ. If S is well below -2, TIS is
        proportional to λ⁻²; if S is above -2, TIS is nearly proportional to λ^-(4+S).
        """
        ratio = wavelength_nm / known_at_nm
        return Harvey(b0=self.b0 / ratio**4, L=self.L * ratio, S=self.S)


# --- particles --------------------------------------------------------------------------------------------------


def particle_count(level: float, diameter_um: ArrayLike) -> F64:
    """Return the number of particles larger than a diameter on 0.1 m² (IEST-STD-CC1246); 0 below level 1.

    The result is float64 like `diameter_um`.
    """
    log = np.log10(np.asarray(diameter_um, dtype=np.float64))
    if level < 1:
        return np.zeros(log.shape)
    return np.asarray(10 ** (_CC1246_SLOPE * (np.log10(level) ** 2 - log**2)))


def obscured_fraction(cleanliness_level: float) -> float:
    """Return the fraction of a surface that spheres of the standard's sizes cover.

    The sizes run from 1 µm to `cleanliness_level` in µm; 0.1 m² has one particle larger than this level.
    """
    level = float(_check("cleanliness_level", cleanliness_level, *CLEANLINESS_LIMITS))
    if level <= _SMALLEST_UM:
        return 0.0
    # ∫ π/4 D² (-dN/dD) dD with N = exp(c (U² - u²)), u = ln D: integrate by parts, then complete the square
    c, top = _CC1246_SLOPE / np.log(10), np.log(level)
    root = np.sqrt(c)
    inner = np.sqrt(np.pi) / (2 * root) * np.exp(1 / c + c * top**2)
    inner *= erf(root * (top - 1 / c)) + erf(1 / root)
    covered = np.exp(c * top**2) - np.exp(2 * top) + 2 * inner
    return float(np.pi / 4 * covered / _CC1246_AREA_UM2)


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


@lru_cache(maxsize=4)
def _intensities(index: complex) -> tuple[F64, F64, F64]:
    """Return the intensity at all sizes and forward angles.

    The result is the bin edges of the size parameter, the angles in rad, and the table float64[bin, angle]. One
    table serves all wavelengths, because the index is a constant. It takes a second and is kept on disk.
    """
    largest = np.pi * 1e3 * 1000.0 / RANGE_NM[0]
    edges = np.exp(np.arange(0.0, np.log(largest) + _BIN, _BIN))
    angles = np.geomspace(1e-5, np.pi / 2, _ANGLES)

    def computed() -> dict[str, F64]:
        return {"intensity": scattered_intensity(np.sqrt(edges[1:] * edges[:-1]), np.cos(angles), index=index)}

    here = Path(__file__)
    code = code_hash([here, here.parents[1] / "coating.py"])
    key = hashlib.sha256(json.dumps([code, index.real, index.imag]).encode()).hexdigest()
    table = _TABLES.kept(key, computed)["intensity"]
    for array in (edges, angles, table):
        array.setflags(write=False)
    return edges, angles, table


@lru_cache(maxsize=256)
def _dust(level: float, wavelength_nm: float, index: complex) -> tuple[F64, float]:
    """Return the intensity of a dusty surface over its irradiance, float64[angle] in 1/sr, and an integral.

    The integral is that of the intensity over the forward hemisphere.
    """
    edges, angles, table = _intensities(index)
    wavelength_um = 1e-3 * wavelength_nm
    diameters = np.clip(edges * wavelength_um / np.pi, _SMALLEST_UM, max(level, _SMALLEST_UM))
    bins = -np.diff(particle_count(level, diameters)) / _CC1246_AREA_UM2
    intensity = bins @ table / (2 * np.pi / wavelength_um) ** 2
    intensity.setflags(write=False)
    scattered = np.trapezoid(2 * np.pi * np.sin(angles) * angles * intensity, x=np.log(angles))
    return intensity, float(scattered)


def particle_bsdf(
    cleanliness_level: float, wavelength_nm: float, beta: ArrayLike, *, index: complex = DUST_INDEX
) -> F64:
    """Return the forward scatter of particles on a surface, in 1/sr, float64 like `beta`; 0 for β of 1 or more.

    Particles are spheres with the sizes of IEST-STD-CC1246, from 1 µm to `cleanliness_level` µm. The light
    falls on them along the normal, and each particle scatters independently of the others.

    Raises
    ------
    InputError
        The level is outside 0 (clean) to 1000, or the wavelength outside 250 to 2500 nm.
    """
    level = float(_check("cleanliness_level", cleanliness_level, *CLEANLINESS_LIMITS))
    intensity, _ = _dust(level, float(_check("wavelength_nm", wavelength_nm, *RANGE_NM)), index)
    b = np.abs(np.asarray(beta, dtype=np.float64))
    if level <= _SMALLEST_UM:
        return np.zeros(b.shape)
    angles = _intensities(index)[1]
    angle = np.arcsin(np.clip(b, np.sin(angles[0]), 1))
    scattered = np.exp(np.interp(np.log(angle), np.log(angles), np.log(intensity)))
    # radiance is intensity over cosine; beyond 84° a mean cosine of the outermost ring conserves the flux
    cosine = np.where(b * b < 0.99, np.sqrt(np.maximum(1 - b * b, 0)), 0.05)
    return np.where(b < 1, scattered / cosine, 0.0)


def particle_scatter_fraction(
    cleanliness_level: float, wavelength_nm: float, *, index: complex = DUST_INDEX
) -> float:
    """Return the fraction of light that the particles of `particle_bsdf` scatter forwards."""
    level = float(_check("cleanliness_level", cleanliness_level, *CLEANLINESS_LIMITS))
    return _dust(level, float(_check("wavelength_nm", wavelength_nm, *RANGE_NM)), index)[1]


# --- a lens -----------------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True, eq=False)
class VeilingGlare:
    """Hold the scattered light of a far source on a sensor.

    Attributes
    ----------
    offset
        float64[sample], rising: distance between the directions of source and pixel, in direction cosines. Near the
        axis, this is the distance on the sensor from the source's image, over the focal length.
    irradiance
        float64[band, sample]: irradiance on the sensor over the source's irradiance at the entrance. The latter is
        measured perpendicular to the rays.
    efl_mm
        Focal length, which converts positions on the sensor to directions.
    glare_total_fraction
        float64[band], Σ TIS of all surfaces. If this sum is small, it is the scattered fraction of the transmitted
        light; for larger sums see `kept_of_single`.
    """

    offset: F64
    irradiance: F64
    efl_mm: float
    glare_total_fraction: F64

    @cached_property
    def _lookup(self) -> tuple[float, float, F32]:
        """Return start and step of ln(offset²), and the irradiance at these steps.

        The step of 4e-4 is too small to be visible in an image.
        """
        steps = np.linspace(2 * np.log(self.offset[0]), 2 * np.log(self.offset[-1]), _LOOKUP)
        rows = [np.interp(steps, 2 * np.log(self.offset), row) for row in self.irradiance]
        return steps[0], float(steps[1] - steps[0]), np.array(rows, dtype=np.float32)

    def image(self, sun_xy_mm: tuple[float, float], shape: tuple[int, int], pitch_mm: float) -> F32:
        """Return the irradiance of the glare over the source's at the entrance, float32[band, y, x].

        The middle of the frame lies on the axis; x points to the right, y down. `sun_xy_mm` is the position of the
        source's image, which may lie outside the frame. At this position the glare is finite but has no meaning,
        because the direct image is much brighter. The result does not include the cos⁴ of a pixel's field angle.
        """
        index = self.samples(sun_xy_mm, shape, pitch_mm)
        table = self.table
        out = np.empty((len(table), *shape), dtype=np.float32)
        in_layers(lambda band: np.take(table[band], index, out=out[band], mode="clip"), len(table))
        return out

    @property
    def table(self) -> F32:
        """Return the irradiance at the steps to which `samples` refers, float32[band, step]."""
        return self._lookup[2]

    def samples(self, sun_xy_mm: tuple[float, float], shape: tuple[int, int], pitch_mm: float) -> NDArray[np.intp]:
        """Return the step of `table` at each pixel of a frame, [y, x]; it depends on the focal length alone."""
        start, step, _ = self._lookup
        height, width = shape
        x = ((np.arange(width) - (width - 1) / 2) * pitch_mm / self.efl_mm).astype(np.float32)
        y = ((np.arange(height) - (height - 1) / 2) * pitch_mm / self.efl_mm).astype(np.float32)[:, None]
        sun = np.asarray(sun_xy_mm, dtype=np.float64) / self.efl_mm
        sine = (sun / np.sqrt(1 + sun @ sun)).astype(np.float32)
        per_length = 1 / np.sqrt(1 + x * x + y * y)
        position = (x * per_length - sine[0]) ** 2
        position += (y * per_length - sine[1]) ** 2
        np.log(np.maximum(position, np.float32(self.offset[0] ** 2), out=position), out=position)
        position -= np.float32(start)
        position *= np.float32(1 / step)
        position += np.float32(0.5)
        return np.clip(position.astype(np.intp), 0, _LOOKUP - 1)

    @property
    def kept_of_single(self) -> F64:
        """Return the factor (1 - e^-Σ) / Σ, float64[band].

        The factor converts the sum of single scatterings, Σ, to the light that all scatterings remove from the
        beam.
        """
        return np.asarray(exprel(-self.glare_total_fraction))

    def beyond_mm2(self, sun_xy_mm: tuple[float, float], shape: tuple[int, int], pitch_mm: float) -> F64:
        """Return the flux on the sensor plane outside the frame, float64[band] in mm².

        The flux is divided by the source's irradiance at the entrance. The flux includes the cos⁴ of the field
        angle, which `image` omits.
        """
        slope = tuple(float(v) / self.efl_mm for v in sun_xy_mm)
        half_slope = (shape[1] / 2 * pitch_mm / self.efl_mm, shape[0] / 2 * pitch_mm / self.efl_mm)
        missing = _missing(slope, tuple(self.offset.tolist()), half_slope)
        # E dA = E(β) cos⁴θ dA = E(β) f² d²β
        rings = 2 * np.pi * (self.efl_mm * self.offset) ** 2 * missing
        return np.asarray(np.trapezoid(self.irradiance * rings, x=np.log(self.offset), axis=1))


@lru_cache(maxsize=4)
def _missing(slope: tuple[float, ...], offset: tuple[float, ...], half_slope: tuple[float, float]) -> F64:
    """Return the fraction of each ring around a source's image that lies outside the frame, float64[sample].

    It does not depend on the state of the surfaces, so the samples of a view share the cached result.
    """
    angle = np.linspace(0, 2 * np.pi, _AROUND, endpoint=False, dtype=np.float64)
    missing = beyond_frame(slope, np.array(offset), angle, half_slope).mean(axis=1)
    missing.flags.writeable = False
    return missing


@dataclass(frozen=True, kw_only=True)
class _Surfaces:
    """Hold the scatter of a lens's surfaces at one wavelength.

    `stretch` is a_ent / a_j: the radius of the axial beam at the entrance over its radius at surface j.
    """

    scale: float  # π NA²
    stretch: F64
    roughness: tuple[Harvey, ...]
    dusty: NDArray[np.bool_]
    level: float
    wavelength_nm: float

    def irradiance(self, offset: F64, lit: F64) -> F64:
        """Return the irradiance on the sensor over the source's at the entrance and over T, float64[sample].

        `lit` [surface, sample] is the lit fraction of each beam. Surface j scatters the radiance E_ent T
        (a_ent/a_j)² BSDF. This radiance fills the cone of the image, hence the factor π NA². From Lagrange's
        invariant n_j a_j θ = NA r follows β = NA r / a_j, and with NA = a_ent / f, β = (a_ent/a_j) r / f. (Form of
        Peterson 2004, Proc. SPIE 5178, 184.)
        """
        total = np.zeros(offset.shape)
        for k, (stretch, part) in enumerate(zip(self.stretch, lit, strict=True)):
            total += part * stretch**2 * self._bsdf_at(k, offset)
        return self.scale * total

    def of_each(self, offset: F64) -> F64:
        """Return `irradiance` of every surface alone where the whole beam is lit, float64[surface, sample]."""
        out = [self.scale * stretch**2 * self._bsdf_at(k, offset) for k, stretch in enumerate(self.stretch)]
        return np.array(out).reshape(len(out), len(offset))

    def _bsdf(self, surface: int, beta: F64) -> F64:
        """Return the BSDF of a surface, float64[sample] in 1/sr."""
        bsdf = self.roughness[surface].bsdf(beta)
        return bsdf + particle_bsdf(self.level, self.wavelength_nm, beta) if self.dusty[surface] else bsdf

    def _bsdf_at(self, surface: int, offset: F64) -> F64:
        """Return the BSDF of a surface that brings its light to an offset, float64[sample] in 1/sr."""
        bsdf = self._bsdf(surface, self.stretch[surface] * offset)
        return bsdf if self._gathered[surface] == 1 else np.where(offset < 1, self._gathered[surface] * bsdf, 0)

    @cached_property
    def _gathered(self) -> F64:
        """Return all light of each surface over that with offsets below 1, float64[surface].

        Where the beam is wider than at the entrance, as in the middle of a retrofocus lens, the paraxial formula
        gives offsets up to a_j/a_ent. The lens images such light at up to 57°, but no two directions in front of it
        are so far apart. It is spread like the rest, so that all scattered light arrives.
        """

        def within(surface: int, most: float) -> float:
            beta = np.geomspace(1e-6, most * (1 - 1e-9), _OFFSETS.size)
            return float(np.trapezoid(beta**2 * self._bsdf(surface, beta), x=np.log(beta)))

        out = np.ones(len(self.stretch))
        for k in np.flatnonzero(self.stretch < 1):
            inner = within(int(k), float(self.stretch[k]))
            out[k] = within(int(k), 1.0) / inner if inner else 1.0
        return out

    @property
    def tis(self) -> float:
        """Return the sum of the TIS of all surfaces."""
        dust = particle_scatter_fraction(self.level, self.wavelength_nm) if self.dusty.any() else 0.0
        return sum(harvey.tis for harvey in self.roughness) + dust * int(self.dusty.sum())


@lru_cache(maxsize=64)
def _surfaces(lens: Prescription, wavelength_nm: float, cleanliness: Cleanliness) -> _Surfaces:
    """Return the scatter of a lens's surfaces at a wavelength."""
    level = float(_check("cleanliness_level", cleanliness.level, *CLEANLINESS_LIMITS))
    figures, path = paraxial_properties(lens, wavelength_nm), forward(lens)
    rows = list(mirrors(lens))
    index = lens.indices(wavelength_nm)
    marginal = np.abs(along(lens, path, wavelength_nm)[1][rows, 0, 0])
    aperture = figures.entrance_pupil_diameter_mm / (2 * figures.efl_mm)
    return _Surfaces(
        scale=float(np.pi * aperture**2),
        stretch=1 / np.maximum(marginal, 1e-6),
        roughness=tuple(
            Harvey.of_roughness(
                roughness_nm=cleanliness.roughness_nm,
                index_step=float(index[k + 1] - index[k]),
                L=cleanliness.knee,
                S=cleanliness.slope,
            ).at(wavelength_nm)
            for k in rows
        ),
        # cemented surfaces have no dust
        dusty=np.array([level > 0 and 1.0 in (index[k], index[k + 1]) for k in rows]),
        level=level,
        wavelength_nm=wavelength_nm,
    )


@lru_cache(maxsize=4)
def _lit(lens: Prescription, sun_deg: float) -> F64:
    """Return the fraction of the beam that a source at an angle lights, float64[surface] by scattering surface.

    The samples of a view share the cached result.

    The fraction is a paraxial estimate of the light that passes all rims up to the surface. At a surface before
    the stop, the beam is the part of the surface that the middle of the sensor receives light from. Behind the
    stop, the sensor receives light from the whole beam.
    """
    _, met = along(lens, forward(lens))
    height, slope = met[:, 0, 0], met[:, 0, 1]
    radius = paraxial_properties(lens).entrance_pupil_diameter_mm / 2
    # only the stop limits the axial beam; the paraxial beam is larger than the real beam, so widen rims it would
    # touch
    rims = np.maximum([s.semi_diameter_mm for s in lens.surfaces], radius * np.abs(height))
    side = (np.arange(_DISC) + 0.5) / _DISC * 2 - 1
    disc = np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2)
    disc = disc[np.einsum("nc,nc->n", disc, disc) <= 1]
    lean = np.array([np.tan(np.radians(sun_deg)), 0.0])
    fractions = []
    for row in mirrors(lens):
        k = min(row, lens.stop)
        entrance = radius * disc - slope[k] / height[k] * lean
        reached = height[: row + 1, None, None] * entrance + slope[: row + 1, None, None] * lean
        inside = np.einsum("knc,knc->kn", reached, reached) <= rims[: row + 1, None] ** 2 * (1 + 1e-9)
        fractions.append(inside.all(axis=0).mean())
    out = np.array(fractions)
    out.flags.writeable = False
    return out


@lru_cache(maxsize=8)
def _lit_at(lens: Prescription, slopes: tuple[float, ...]) -> F64:
    """Return cos θ times the fraction of the beam that sources light, float64[angle, surface]; it is cached."""
    angle = np.arctan(slopes)
    return np.stack([np.cos(a) * _lit(lens, float(np.degrees(a))) for a in angle])


def _surfaces_of_bands(
    lens: Prescription, wavelength_nm: ArrayLike | Bands, cleanliness: Cleanliness
) -> list[_Surfaces]:
    """Return the scatter of a lens's surfaces at each wavelength, or at the nodes of bands."""
    nodes = wavelength_nm.nodes_nm if isinstance(wavelength_nm, Bands) else wavelength_nm
    return [
        _surfaces(lens, float(nm), cleanliness) for nm in np.atleast_1d(_check("wavelength_nm", nodes, *RANGE_NM))
    ]


def _passed(lens: Prescription, wavelength_nm: ArrayLike | Bands, scattered: F64) -> F64:
    """Return the scattered light behind the lens, float64[band, ...]; `scattered` are its values over T.

    Scatter varies slowly with wavelength, T as fast as coatings do.
    """
    if not isinstance(wavelength_nm, Bands):
        return (axial_transmittance(lens, wavelength_nm) * scattered.T).T
    transmitted = axial_transmittance(lens, wavelength_nm.wavelength_nm)
    return (wavelength_nm.mean(transmitted) * wavelength_nm.behind(transmitted).smooth_mean(scattered).T).T


def veiling_glare(
    lens: Prescription, *, sun_deg: float, wavelength_nm: ArrayLike | Bands, cleanliness: Cleanliness = POLISHED
) -> VeilingGlare:
    """Return the light of a far point source that a lens's surfaces scatter onto the sensor.

    Parameters
    ----------
    sun_deg
        Angle of the source from the axis, 0 to 89.9.
    wavelength_nm
        float64[band], or bands.
    cleanliness
        What scatters on the surfaces.
    """
    bands = _surfaces_of_bands(lens, wavelength_nm, cleanliness)
    angle = float(_check("sun_deg", sun_deg, 0.0, _STEEPEST_DEG))
    lit = np.cos(np.radians(angle)) * _lit(lens, angle)[:, None]
    return VeilingGlare(
        offset=_OFFSETS,
        irradiance=_passed(lens, wavelength_nm, np.stack([band.irradiance(_OFFSETS, lit) for band in bands])),
        efl_mm=paraxial_properties(lens).efl_mm,
        glare_total_fraction=-np.log1p(-scattered_fraction(lens, wavelength_nm, cleanliness=cleanliness)),
    )


def glare_kernels(
    lens: Prescription, slope: F64, *, wavelength_nm: ArrayLike | Bands, cleanliness: Cleanliness = POLISHED
) -> tuple[F64, F64]:
    """Return the glare of far point sources at many field angles.

    Parameters
    ----------
    slope
        float64[angle]: tangents of the field angles.
    wavelength_nm, cleanliness
        As in `veiling_glare`.

    Returns
    -------
    offset : float64[sample]
    irradiance : float64[band, angle, sample]
        As in `VeilingGlare`; the cos⁴ of a pixel's field angle is not included.
    """
    lit = _lit_at(lens, tuple(np.asarray(slope, dtype=np.float64).tolist()))
    bands = _surfaces_of_bands(lens, wavelength_nm, cleanliness)
    kernels = np.stack([np.einsum("aj,js->as", lit, band.of_each(_OFFSETS)) for band in bands])
    return _OFFSETS, _passed(lens, wavelength_nm, kernels)


def scattered_fraction(
    lens: Prescription, wavelength_nm: ArrayLike | Bands, *, cleanliness: Cleanliness = POLISHED
) -> F64:
    """Return the fraction of the transmitted light that a lens's surfaces scatter, 1 - exp(-Σ TIS), float64[band].

    Parameters as in `veiling_glare`.
    """
    single = np.array([band.tis for band in _surfaces_of_bands(lens, wavelength_nm, cleanliness)])
    fraction = -np.expm1(-single)
    return wavelength_nm.smooth_mean(fraction) if isinstance(wavelength_nm, Bands) else fraction


def point_source_transmittance(
    lens: Prescription, sun_deg: ArrayLike, *, wavelength_nm: ArrayLike, cleanliness: Cleanliness = POLISHED
) -> F64:
    """Return scattered irradiance in the middle of the sensor over a far source's at the entrance.

    The result is float64[band, angle]. Angles lie inside or outside the field, 0 to 89.9°. Outside the
    field, only surfaces that the source's rays still reach contribute. Ghosts, mount and baffle are not included.
    The parameters are those of `veiling_glare`.
    """
    angles = np.atleast_1d(_check("sun_deg", sun_deg, 0.0, _STEEPEST_DEG))
    lit = np.stack([np.cos(np.radians(a)) * _lit(lens, float(a)) for a in angles], axis=1)
    bands = _surfaces_of_bands(lens, wavelength_nm, cleanliness)
    scattered = np.stack([band.irradiance(np.sin(np.radians(angles)), lit) for band in bands])
    return _passed(lens, wavelength_nm, scattered)


# --- a baffle ---------------------------------------------------------------------------------------------------


def hood_transmission(lens: Prescription, slope: ArrayLike) -> F64:
    """Return the fraction of the lens's first rim that far sources light past its hood, float64 like `slope`.

    `slope` is the tangent of the field angle. The fraction is the overlap of two circles: the rim, and the hood's
    edge, whose shadow is shifted by length × slope. Beyond the cutoff, where the shift is the sum of both radii, it
    is 0. Without a hood it is 1.
    """
    shift = np.abs(np.asarray(slope, dtype=np.float64))
    if lens.hood is None:
        return np.ones(shift.shape)
    small = lens.surfaces[0].semi_diameter_mm
    overlap = disc_overlap(lens.hood.length_mm * shift, small, lens.hood.radius_mm)
    return np.clip(overlap / (np.pi * small**2), 0.0, 1.0)


def baffle_transmission(
    sun_deg: ArrayLike,
    *,
    length_mm: float = 0.0,
    radius_mm: float = np.inf,
    entrance_radius_mm: float,
    vane_attenuation: float = 1e-6,
) -> F64:
    """Return the fraction of a lens's entrance that a far source lights through a tube in front of the lens.

    The fraction is the overlap of the entrance with the tube's mouth, which is shifted by length × tan(angle). The
    fraction is never below `vane_attenuation`. The default, 1e-6, is assumed; good two-stage baffles reach 1e-9
    (Haghshenas & Johari 2014, Proc. SPIE 9264, 92641R). A length of 0 means no baffle. The result is float64 like
    `sun_deg`.

    Raises
    ------
    InputError
        The tube is narrower than the entrance.
    """
    angle = _check("sun_deg", sun_deg, 0.0, 180.0)
    length = float(_check("length_mm", length_mm, 0.0, 1e6))
    small = float(_check("entrance_radius_mm", entrance_radius_mm, 1e-6, 1e6))
    large = float(_check("radius_mm", radius_mm, small, np.inf))
    least = float(_check("vane_attenuation", vane_attenuation, 0.0, 1.0))
    if length == 0 or np.isinf(large):
        return np.ones(angle.shape)
    area = disc_overlap(length * np.tan(np.radians(np.minimum(angle, 90.0))), small, large)
    return np.clip(area / (np.pi * small**2), least, 1.0)
