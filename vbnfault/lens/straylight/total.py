"""Add up all straylight of the Sun in one radiometric unit: ghosts, starburst, glare and veil.

Energy. A lens admits the flux P = E☉ T A cos θ of the Sun, where T is its transmittance along the axis and A the
area of the beam that passes. The light that the stop diffracts (starburst), that surfaces scatter (glare), and that
mount, barrel and edges scatter (veil) is part of P. It is subtracted from the direct image:

    direct image = P - starburst - glare - veil,

each on the whole sensor plane, inside and outside the frame. Ghosts are part of the light that surfaces reflect,
which T already excludes. Only where the image path has lost less than the ghosts contain (a thin lens without
losses), the rest of the ghosts is subtracted from the direct image too.

An extended scene follows the same rule where its effect is visible: the image loses the fraction that surfaces,
mount, barrel and edges scatter, and all of it returns as a veil. Diffraction and ghosts of the scene stay in its
image: the point spread contains the diffraction, and neighbouring light outshines the ghosts.

Veil. The walls behind the lens, lit by the transmitted light, act as a small Lambertian source on the axis at a
focal length from the sensor (assumed):

    E(x, y) = v · Φ / (π f²) · cos⁴θ(x, y),

for a flux Φ that enters; ∫ E dA = v Φ over the unbounded plane. Under a uniform sky the fraction v is then the
veiling glare index in the middle that this veil alone gives (ISO 9358:1994): the sky's flux is π L A T and the
irradiance of its image L A T / f². That standard's index of photographic lenses lies between about 0.5 and 5 %.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from ..gaussian import first_order
from ..prescription import Prescription
from ..thin import cos4_map
from .irradiance import flare_model
from .paraxial import axial_transmittance
from .scatter import KNEE, SLOPE, baffle_transmission, scattered_fraction, veiling_glare
from .starburst import Starburst, starburst

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]

VEIL_FRACTION = 0.01  # assumed: a lens with blackened edges and a baffled barrel (ISO 9358 indices of 0.5 to 5 %)


@dataclass(frozen=True, kw_only=True)
class Cleanliness:
    """Describe what scatters on the surfaces of a lens.

    Attributes
    ----------
    roughness_nm
        Rms roughness of every surface.
    level
        Particles on every surface in air, as a level of IEST-STD-CC1246; 0: none.
    knee, slope
        Harvey's knee (at 550 nm) and slope of the scatter by roughness.
    """

    roughness_nm: float = 1.0
    level: float = 0.0
    knee: float = KNEE
    slope: float = SLOPE


@dataclass(frozen=True, kw_only=True)
class Baffle:
    """Describe a tube in front of the lens; length 0 means none."""

    length_mm: float = 0.0
    radius_mm: float = 0.0


@dataclass(frozen=True, kw_only=True, eq=False)
class Straylight:
    """Hold the Sun's straylight on a sensor, and what it takes from the direct image.

    Attributes
    ----------
    ghosts, starburst, glare, veil
        Irradiance on the sensor over the Sun's at the entrance, float32[band, y, x] each.
    direct_fraction
        float64[band] in [0, 1]: fraction that remains of the Sun's direct image.
    beyond_mm2
        float64[band]: flux of starburst, glare and veil on the sensor plane outside the frame, over the Sun's
        irradiance at the entrance.
    """

    ghosts: F32
    starburst: F32
    glare: F32
    veil: F32
    direct_fraction: F64
    beyond_mm2: F64

    @property
    def total(self) -> F32:
        """Return the sum of ghosts, starburst, glare and veil."""
        return np.asarray(self.ghosts + self.starburst + self.glare + self.veil)


def straylight(
    lens: Prescription,
    *,
    model: str,
    wavelength_nm: F64,
    shape: tuple[int, int],
    pitch_mm: float,
    sun_deg: float,
    azimuth_deg: float,
    sun_radius_rad: float,
    sun_xy_mm: tuple[float, float] | None = None,
    cleanliness: Cleanliness | None = None,
    baffle: Baffle | None = None,
    reflections: int = 2,
    coating_loss: float = 0.0,
    veil_fraction: float = VEIL_FRACTION,
    transmittance: F64 | None = None,
    admitted_mm2: float | None = None,
    beam_fraction: float = 1.0,
) -> Straylight:
    """Return the straylight of a Sun at an angle from the axis and an azimuth (0: +x, right; 90°: +y, down).

    Parameters
    ----------
    lens
        At its final size; the sensor's middle lies on the axis.
    model
        Of the ghosts: 'traced' or 'paraxial'.
    wavelength_nm
        float64[band], nodes of the bands.
    shape, pitch_mm
        (height, width) of the sensor in pixels, and their pitch.
    sun_xy_mm
        Position of the Sun's direct image; default: f tan θ along the azimuth.
    reflections
        2, or 4 to include ghosts of four reflections.
    coating_loss
        Fraction of the coatings' area that is gone, in [0, 1]; it raises ghosts. The loss of transmitted light is
        not applied here, but by whoever darkens the image.
    veil_fraction
        Fraction v of the light that mount, barrel and edges scatter onto the sensor plane, in [0, 1].
    transmittance
        float64[band], T of the path that forms the direct image; default: that of `lens` along the axis.
    admitted_mm2
        A cos θ of the same path; default: the paraxial entrance pupil times cos θ.
    beam_fraction
        A over its value on the axis: the fraction of the stop that the Sun lights past the rims.

    Raises
    ------
    InputError
        A value is out of range.
    """
    nodes = tuple(float(v) for v in np.atleast_1d(wavelength_nm))
    optics = first_order(lens)
    made = flare_model(lens, nodes, shape, pitch_mm, sun_radius_rad, model, reflections)
    turn = np.radians(azimuth_deg)
    if sun_xy_mm is None:
        radius = optics.efl_mm * np.tan(np.radians(sun_deg))
        sun_xy_mm = (float(radius * np.cos(turn)), float(radius * np.sin(turn)))
    lit = 1.0
    if baffle is not None and baffle.length_mm > 0:
        lit = float(
            baffle_transmission(
                sun_deg,
                length_mm=baffle.length_mm,
                radius_mm=baffle.radius_mm,
                # a tube narrower than the lens is itself the entrance
                entrance_radius_mm=min(lens.surfaces[0].semi_diameter_mm, baffle.radius_mm),
            )
        )
    own = axial_transmittance(lens, nodes)
    passed = own if transmittance is None else np.broadcast_to(transmittance, own.shape)
    pupil_mm2 = float(np.pi / 4 * optics.entrance_pupil_diameter_mm**2 * np.cos(np.radians(sun_deg)))
    admitted = pupil_mm2 if admitted_mm2 is None else float(admitted_mm2)
    cos4 = cos4_map(shape, optics.efl_mm / pitch_mm)

    burst = _starburst(lens, sun_radius_rad)
    # diffraction scales with the light that passes the stop, and cannot exceed it
    rays, rays_beyond = (
        burst.image(sun_xy_mm, np.array(nodes), shape, pitch_mm),
        burst.beyond_mm2(sun_xy_mm, np.array(nodes), shape, pitch_mm),
    )
    diffracted = (_flux_mm2(rays, pitch_mm) + rays_beyond) / pupil_mm2
    gain = lit * passed * beam_fraction / np.maximum(diffracted, 1)
    rays *= gain[:, None, None].astype(np.float32)
    rays_beyond = rays_beyond * gain

    clean = Cleanliness() if cleanliness is None else cleanliness
    scattering = veiling_glare(
        lens,
        sun_deg=sun_deg,
        wavelength_nm=np.array(nodes),
        roughness_nm=clean.roughness_nm,
        cleanliness_level=clean.level,
        L=clean.knee,
        S=clean.slope,
    )
    # each surface scatters only the light that the others have left (`kept_of_single`)
    gain = lit * passed / own * scattering.kept_of_single
    glare = scattering.image(sun_xy_mm, shape, pitch_mm)
    glare *= gain[:, None, None].astype(np.float32) * cos4
    glare_beyond = scattering.beyond_mm2(sun_xy_mm, shape, pitch_mm) * gain

    entering = lit * passed * pupil_mm2 * veil_fraction
    shape_per_mm2 = cos4 * np.float32(1 / (np.pi * optics.efl_mm**2))
    veil = np.asarray(entering[:, None, None].astype(np.float32) * shape_per_mm2)
    veil_beyond = entering * (1 - float(shape_per_mm2.sum(dtype=np.float64)) * pitch_mm**2)

    ghosts = made.worn(coating_loss).image(sun_deg, azimuth_deg) * np.float32(lit)
    direct = passed * admitted
    # light that the image path has lost feeds the ghosts; the direct light supplies the rest
    unpaid = np.maximum(_flux_mm2(ghosts, pitch_mm) - (1 - passed) * admitted, 0)
    beyond = rays_beyond + glare_beyond + veil_beyond
    taken = sum(_flux_mm2(layer, pitch_mm) for layer in (rays, glare, veil)) + beyond + unpaid
    with np.errstate(divide="ignore", invalid="ignore"):
        left = np.where(direct > 0, 1 - taken / direct, 1.0)
    return Straylight(
        ghosts=ghosts,
        starburst=rays,
        glare=glare,
        veil=veil,
        direct_fraction=np.clip(left, 0, 1),
        beyond_mm2=beyond,
    )


def scene_veil_fraction(
    lens: Prescription, wavelength_nm: F64, *, cleanliness: Cleanliness, veil_fraction: float
) -> F64:
    """Return the fraction of an extended scene's light that leaves its image for the veil, float64[band].

    Surfaces scatter the first part of it; mount, barrel and edges scatter `veil_fraction` of the rest.
    """
    scattered = scattered_fraction(
        lens,
        wavelength_nm,
        roughness_nm=cleanliness.roughness_nm,
        cleanliness_level=cleanliness.level,
        L=cleanliness.knee,
        S=cleanliness.slope,
    )
    return np.asarray(1 - (1 - scattered) * (1 - veil_fraction))


def veil_of(flux: F64, shape: tuple[int, int], focal_length_px: float) -> F32:
    """Return the veil of a flux that leaves the image, float32[y, x, channel] per pixel.

    `flux` is float64[channel] in any unit. The veil's sum over the unbounded plane is the flux; the part outside
    the frame is lost to the walls.
    """
    per_px = cos4_map(shape, focal_length_px) * np.float32(1 / (np.pi * focal_length_px**2))
    return np.asarray(per_px[..., None] * flux.astype(np.float32))


def _flux_mm2(irradiance: F32, pitch_mm: float) -> F64:
    """Return the flux of an irradiance, float64[band]."""
    return np.asarray(irradiance.sum(axis=(1, 2), dtype=np.float64) * pitch_mm**2)


@lru_cache(maxsize=4)
def _starburst(lens: Prescription, sun_radius_rad: float) -> Starburst:
    """Return the starburst of a lens; it is cached with its tables."""
    return starburst(lens, sun_radius_rad=sun_radius_rad)
