"""Compute veiling glare, and the fraction of the lens that a source lights through a baffle.

Veiling glare is the light of a far bright source that rough and dusty lens surfaces scatter. The scatter of one
surface is a BSDF over β, the distance between two directions in direction cosines in air. A surface roughness of
spatial frequency f turns light by β = λ f in every medium. The integral of the BSDF over the disc β < 1 is the
fraction of the light that the surface scatters forwards: the total integrated scatter (TIS).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import exprel

from ...core.spectra import Bands
from ..beams import disc_overlap
from ..paraxial import along, mirrors, paraxial_properties
from ..prescription import Prescription
from ..rays import axial_transmittance, forward
from ..thin import beyond_frame, cos4_map
from .particles import particle_bsdf, particle_scatter_fraction

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
C128 = NDArray[np.complex128]

REFERENCE_NM = 550.0  # wavelength at which roughness and the Harvey knee are quoted
# Outside these limits the model is not valid: the surface is not optically smooth.
ROUGHNESS_NM_LIMITS = (0.0, 50.0)
ROUGHNESS_NM, KNEE, SLOPE = 1.0, 0.01, -1.5  # assumed: a good polish, and usual values for its scatter

_OFFSETS: F64 = np.geomspace(1e-6, 2.0, 1025)
_LOOKUP = 1 << 16
# values of ln(offset²), too close together to be visible in an image
_STEPS: F64 = np.linspace(2 * np.log(_OFFSETS[0]), 2 * np.log(_OFFSETS[-1]), _LOOKUP)
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
        """
        total = (2 * np.pi * index_step * roughness_nm / wavelength_nm) ** 2
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

    def at(self, wavelength_nm: float) -> Harvey:
        """Return the model at another wavelength than `REFERENCE_NM`: L ∝ λ, b0 ∝ λ⁻⁴, and S does not change.

        The change of the refractive index is not included. The BSDF of a smooth surface is (2π Δn)² λ⁻⁴ PSD(β/λ),
        and the PSD does not depend on λ (generalised Harvey-Shack theory: Krywonos, Harvey & Choi 2011, JOSA A 28,
        1121). Hence TIS ∝ λ⁻² σ², where σ is the roughness up to the frequency 1/λ. If S is well below -2, TIS is
        proportional to λ⁻²; if S is above -2, TIS is nearly proportional to λ^-(4+S).
        """
        ratio = wavelength_nm / REFERENCE_NM
        return Harvey(b0=self.b0 / ratio**4, L=self.L * ratio, S=self.S)


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
    def table(self) -> F32:
        """Return the irradiance at the steps of a `GlareLayout`, float32[band, step]."""
        rows = [np.interp(_STEPS, 2 * np.log(self.offset), row) for row in self.irradiance]
        return np.array(rows, dtype=np.float32)

    @property
    def kept_of_single(self) -> F64:
        """Return the factor (1 - e^-Σ) / Σ, float64[band].

        The factor converts the sum of single scatterings, Σ, to the light that all scatterings remove from the
        beam.
        """
        return np.asarray(exprel(-self.glare_total_fraction))

    def beyond_mm2(self, layout: GlareLayout) -> F64:
        """Return the flux on the sensor plane outside the frame, float64[band] in mm².

        The flux is divided by the source's irradiance at the entrance. The flux includes the cos⁴ of the field
        angle, which `table` omits.
        """
        shape, pitch_mm = layout.shape, layout.pitch_mm
        slope = tuple(float(v) / self.efl_mm for v in layout.sun_xy_mm)
        half_slope = (shape[1] / 2 * pitch_mm / self.efl_mm, shape[0] / 2 * pitch_mm / self.efl_mm)
        missing = _missing(slope, tuple(self.offset.tolist()), half_slope)
        # E dA = E(β) cos⁴θ dA = E(β) f² d²β
        rings = 2 * np.pi * (self.efl_mm * self.offset) ** 2 * missing
        return np.asarray(np.trapezoid(self.irradiance * rings, x=np.log(self.offset), axis=1))


@dataclass(frozen=True)
class GlareLayout:
    """Describe how the table of a source's glare is laid out on the sensor; roughness and dust do not change it.

    The middle of the frame lies on the axis; x points to the right, y down. `sun_xy_mm` is the position of the
    source's image, which may lie outside the frame. At this position the glare is finite but has no meaning,
    because the direct image is much brighter.
    """

    efl_mm: float
    sun_xy_mm: tuple[float, float]
    shape: tuple[int, int]
    pitch_mm: float

    @cached_property
    def steps(self) -> NDArray[np.int32]:
        """Return the step of the table at each pixel, int32[y, x]."""
        start, step = _STEPS[0], float(_STEPS[1] - _STEPS[0])
        height, width = self.shape
        x = ((np.arange(width) - (width - 1) / 2) * self.pitch_mm / self.efl_mm).astype(np.float32)
        y = ((np.arange(height) - (height - 1) / 2) * self.pitch_mm / self.efl_mm).astype(np.float32)[:, None]
        sun = np.asarray(self.sun_xy_mm, dtype=np.float64) / self.efl_mm
        sine = (sun / np.sqrt(1 + sun @ sun)).astype(np.float32)
        per_length = 1 / np.sqrt(1 + x * x + y * y)
        position = (x * per_length - sine[0]) ** 2
        position += (y * per_length - sine[1]) ** 2
        np.log(np.maximum(position, np.float32(_OFFSETS[0] ** 2), out=position), out=position)
        position -= np.float32(start)
        position *= np.float32(1 / step)
        position += np.float32(0.5)
        return np.clip(position.astype(np.int32), 0, _LOOKUP - 1)

    @property
    def cos4(self) -> F32:
        """Return cos⁴ of the field angle of every pixel, float32[y, x], a factor on the light of the table."""
        return cos4_map(self.shape, self.efl_mm / self.pitch_mm)

    @cached_property
    def area_mm2(self) -> F64:
        """Return the pixels' area times `cos4` for each step, float64[step]."""
        return np.bincount(self.steps.ravel(), weights=self.cos4.ravel()).astype(np.float64) * self.pitch_mm**2

    def flux_mm2(self, table: F32) -> F64:
        """Return the flux in the frame of a table float32[band, step], float64[band]."""
        # not a product of BLAS, whose bits may depend on the number of threads
        return np.einsum("bs,s->b", table[:, : len(self.area_mm2)].astype(np.float64), self.area_mm2)


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
            beta, log_beta = _up_to(most)
            return float(np.trapezoid(beta**2 * self._bsdf(surface, beta), x=log_beta))

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


@lru_cache(maxsize=256)
def _up_to(most: float) -> tuple[F64, F64]:
    """Return values of β from 1e-6 to just below `most` and their logarithms, float64[sample]."""
    beta = np.geomspace(1e-6, most * (1 - 1e-9), _OFFSETS.size)
    return beta, np.log(beta)


@lru_cache(maxsize=64)
def _surfaces(lens: Prescription, wavelength_nm: float, cleanliness: Cleanliness) -> _Surfaces:
    """Return the scatter of a lens's surfaces at a wavelength."""
    level = float(cleanliness.level)
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


def _surfaces_of_bands(lens: Prescription, bands: Bands, cleanliness: Cleanliness) -> list[_Surfaces]:
    """Return the scatter of a lens's surfaces at the nodes of bands."""
    return [_surfaces(lens, nm, cleanliness) for nm in bands.nodes_nm.tolist()]


def _passed(lens: Prescription, bands: Bands, scattered: F64) -> F64:
    """Return the scattered light behind the lens, float64[band, ...]; `scattered` are its values over T.

    Scatter varies slowly with wavelength, T as fast as coatings do.
    """
    transmitted = axial_transmittance(lens, bands.wavelength_nm)
    return (bands.mean(transmitted) * bands.behind(transmitted).smooth_mean(scattered).T).T


def veiling_glare(
    lens: Prescription, bands: Bands, *, sun_deg: float, cleanliness: Cleanliness = POLISHED
) -> VeilingGlare:
    """Return the light of a far point source, 0 to 89.9° from the axis, that a lens's surfaces scatter.

    `cleanliness` is what scatters on the surfaces.
    """
    lit = np.cos(np.radians(sun_deg)) * _lit(lens, sun_deg)[:, None]
    of_nodes = [at.irradiance(_OFFSETS, lit) for at in _surfaces_of_bands(lens, bands, cleanliness)]
    return VeilingGlare(
        offset=_OFFSETS,
        irradiance=_passed(lens, bands, np.stack(of_nodes)),
        efl_mm=paraxial_properties(lens).efl_mm,
        glare_total_fraction=-np.log1p(-scattered_fraction(lens, bands, cleanliness)),
    )


def glare_kernels(lens: Prescription, bands: Bands, slope: F64, cleanliness: Cleanliness) -> tuple[F64, F64]:
    """Return the glare of far point sources at many field angles, whose tangents are `slope` float64[angle].

    Returns
    -------
    offset : float64[sample]
    irradiance : float64[band, angle, sample]
        As in `VeilingGlare`; the cos⁴ of a pixel's field angle is not included.
    """
    lit = _lit_at(lens, tuple(np.asarray(slope, dtype=np.float64).tolist()))
    of_nodes = [at.of_each(_OFFSETS) for at in _surfaces_of_bands(lens, bands, cleanliness)]
    return _OFFSETS, _passed(lens, bands, np.stack([np.einsum("aj,js->as", lit, each) for each in of_nodes]))


def scattered_fraction(lens: Prescription, bands: Bands, cleanliness: Cleanliness = POLISHED) -> F64:
    """Return the fraction of the transmitted light that surfaces scatter, 1 - exp(-Σ TIS), float64[band]."""
    single = np.array([at.tis for at in _surfaces_of_bands(lens, bands, cleanliness)])
    return bands.smooth_mean(-np.expm1(-single))


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
    `sun_deg`. A tube is at least as wide as the entrance.
    """
    angle, small = np.asarray(sun_deg, dtype=np.float64), entrance_radius_mm
    if length_mm == 0 or np.isinf(radius_mm):
        return np.ones(angle.shape)
    area = disc_overlap(length_mm * np.tan(np.radians(np.minimum(angle, 90.0))), small, radius_mm)
    return np.clip(area / (np.pi * small**2), vane_attenuation, 1.0)
