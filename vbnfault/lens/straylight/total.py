"""Add up all straylight of the Sun in one radiometric unit: ghosts, starburst, glare and veil.

Energy. A lens admits the flux P = E☉ T A cos θ of the Sun, where T is its transmittance along the axis and A the
area of the beam that passes. The light that the stop diffracts (starburst), that surfaces scatter (glare), and that
mount, barrel and edges scatter (veil) is part of P. It is subtracted from the direct image:

    direct image = P - starburst - glare - veil,

each on the whole sensor plane, inside and outside the frame. Ghosts are part of the light that surfaces reflect,
which T already excludes. Only where the image path has lost less than the ghosts contain (a thin lens without
losses), the rest of the ghosts is subtracted from the direct image too. Where the image path loses more than the
lens whose ghosts are traced, a filter before the lens takes the rest, from the ghosts as well.

An extended scene follows the same rule where its effect is visible: the image loses the fraction that surfaces,
mount, barrel and edges scatter, and all of it returns as a veil. Diffraction and ghosts of the scene stay in its
image: within some pixels the point spread contains the diffraction, and neighbouring light outshines the ghosts.
`scene` computes both farther away; what the stop then diffracts beyond the point spread, the image loses too.

Spectrum. All results are means over bands (`spectra.Bands`), such as those of a sensor's channels in sunlight.
Coatings, glasses and bands count at every nanometre, geometry and scatter are linear between a few wavelengths.

Veil. The walls behind the lens, lit by the transmitted light, act as a small Lambertian source on the axis at a
focal length from the sensor (assumed):

    E(x, y) = v · Φ / (π f²) · cos⁴θ(x, y),

for a flux Φ that enters; ∫ E dA = v Φ over the unbounded plane. Under a uniform sky the fraction v is then the
veiling glare index in the middle that this veil alone gives (ISO 9358:1994): the sky's flux is π L A T and the
irradiance of its image L A T / f². That standard's index of photographic lenses lies between about 0.5 and 5 %.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ...core.spectra import Bands
from ..paraxial import paraxial_properties
from ..prescription import Prescription
from ..rays import axial_transmittance
from ..thin import cos4_map
from .irradiance import FlareModel, flare_model
from .pyramid import in_layers, scaled
from .scatter import Cleanliness, GlareLayout, hood_transmission, scattered_fraction, veiling_glare
from .settings import DEFAULT, DirectPath, GhostSettings, SensorGrid, StraylightSettings, SunSource
from .starburst import Starburst, StarburstFrame
from .starburst import starburst as starburst_of

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
# Calls a function with hashable arguments, or returns what the same call returned before.
Once = Callable[..., Any]

# Radii and angles of the starburst's table. The coarse one takes a third of the time; in a frame of 1024 pixels its
# spikes in the corner are a pixel wider.
FINE_SPIKES, COARSE_SPIKES = (224, 4096), (160, 2048)


def anew(function: Callable[..., Any], *arguments: Any) -> Any:
    """Return `function(*arguments)`: the `Once` that keeps nothing."""
    return function(*arguments)


@dataclass(frozen=True, kw_only=True, eq=False)
class SpreadLight:
    """Hold light that is spread over the sensor.

    Attributes
    ----------
    planes
        Irradiance over the Sun's at the entrance, float32[band, y, x], read-only.
    beyond_mm2
        float64[band]: flux outside the frame, over the same irradiance.
    flux_mm2
        float64[band]: flux in the frame.
    """

    planes: F32
    beyond_mm2: F64
    flux_mm2: F64

    @classmethod
    def of(cls, planes: F32, beyond_mm2: F64, sensor: SensorGrid) -> SpreadLight:
        """Return light with its flux in the frame."""
        planes.flags.writeable = False
        return cls(planes=planes, beyond_mm2=beyond_mm2, flux_mm2=_flux_mm2(planes, sensor.pitch_mm))


# --- the parts that take time, each a function of what it depends on ---------------------------------------------


@dataclass(frozen=True, kw_only=True)
class GhostSource:
    """Hold all on which ghosts depend; `sun` are the Sun's angle and azimuth in degrees."""

    lens: Prescription
    bands: Bands
    sensor: SensorGrid
    settings: GhostSettings
    coating_loss: float
    sun: tuple[float, float]
    sun_radius_rad: float

    @property
    def model(self) -> FlareModel:
        """Return the model that draws the ghosts."""
        model = flare_model(self.lens, self.bands, self.sensor, self.sun_radius_rad, self.settings)
        return model.worn(self.coating_loss)


def ghosts(source: GhostSource) -> SpreadLight:
    """Return the ghosts."""
    planes = source.model.image(*source.sun)
    return SpreadLight.of(planes, np.zeros(len(source.bands)), source.sensor)


def starburst(burst: Starburst, frame: StarburstFrame, passed: tuple[float, ...], pupil_mm2: float) -> SpreadLight:
    """Return what the stop diffracts of the fraction `passed` of the light in each band."""
    planes, beyond = burst.image(frame), burst.beyond_mm2(frame)
    # diffraction scales with the light that passes the stop, and cannot exceed it
    whole_mm2 = _flux_mm2(planes, frame.sensor.pitch_mm) + beyond
    gain = np.array(passed) / np.maximum(whole_mm2 / pupil_mm2, 1)
    return SpreadLight.of(scaled(planes, gain), beyond * gain, frame.sensor)


def glare(
    lens: Prescription, bands: Bands, cleanliness: Cleanliness, sun_deg: float, layout: GlareLayout
) -> tuple[F32, F64, F64]:
    """Return what surfaces scatter at the steps of a layout, its flux beyond the frame, and a factor.

    The arrays are float32[band, step], float64[band] in mm², and float64[band]: `VeilingGlare.kept_of_single`.
    """
    scattering = veiling_glare(lens, bands, sun_deg=sun_deg, cleanliness=cleanliness)
    return scattering.table, scattering.beyond_mm2(layout), scattering.kept_of_single


# --- their sum ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True, eq=False)
class SunStraylight:
    """Hold the Sun's straylight on a sensor, and what it takes from the direct image.

    Attributes
    ----------
    ghosts, starburst
        The light over the Sun's irradiance at the entrance.
    ghost_gain
        float64[band]: fraction of the ghosts that a baffle leaves, and a filter before the lens.
    layout, glare, veil
        Steps of the scattered light on the sensor, what surfaces scatter, float32[band, step], and the veil on the
        axis, float32[band]. On the sensor both have the factor cos⁴.
    glare_beyond_mm2
        float64[band]: flux of the glare on the sensor plane outside the frame.
    rates
        float64[band]: what a second of the Sun's irradiance gives in the channel of each band.
    direct_fraction
        float64[band] in [0, 1]: fraction that remains of the Sun's direct image.
    """

    ghosts: SpreadLight
    starburst: SpreadLight
    ghost_gain: F64
    layout: GlareLayout
    glare: F32
    veil: F32
    glare_beyond_mm2: F64
    rates: F64
    direct_fraction: F64

    def total(self, exposure_s: float = 1.0) -> F32:
        """Return the sum of all parts in an exposure, float32[band, y, x]."""
        ghost_rates = (self.rates * self.ghost_gain).astype(np.float32)
        rates = self.rates.astype(np.float32)
        scattered = (self.glare + self.veil[:, None]) * self.rates[:, None] * exposure_s
        index, cos4 = self.layout.steps.astype(np.intp), self.layout.cos4  # numpy would convert it for every band
        out = np.empty((len(rates), *index.shape), np.float32)

        def add_up(band: int) -> None:
            plane = out[band]
            np.take(scattered[band].astype(np.float32), index, out=plane, mode="clip")
            np.multiply(plane, cos4, out=plane)
            clear = self.ghosts.planes[band] * ghost_rates[band]
            clear += self.starburst.planes[band] * rates[band]
            cv2.scaleAdd(clear, exposure_s, plane, dst=plane)

        in_layers(add_up, len(out))
        return out

    def parts(self) -> dict[str, F32]:
        """Return ghosts, starburst, glare and veil in a second, float32[band, y, x] each."""
        by_band, cos4 = self.rates[:, None, None].astype(np.float32), self.layout.cos4
        return {
            "ghosts": self.ghosts.planes * (by_band * self.ghost_gain[:, None, None].astype(np.float32)),
            "starburst": self.starburst.planes * by_band,
            "glare": self.glare[:, self.layout.steps] * cos4 * by_band,
            "veil": self.veil[:, None, None] * cos4 * by_band,
        }

    @property
    def flux_mm2(self) -> dict[str, F64]:
        """Return the flux of ghosts, starburst and glare in the frame in a second, float64[band] each."""
        return {
            "ghosts": self.ghosts.flux_mm2 * self.ghost_gain * self.rates,
            "starburst": self.starburst.flux_mm2 * self.rates,
            "glare": self.layout.flux_mm2(self.glare) * self.rates,
        }


@dataclass(frozen=True, kw_only=True)
class SunInLens:
    """Describe the Sun's light in a lens, and compute what of it becomes ghosts, starburst, glare and veil.

    Attributes
    ----------
    lens
        At its final size.
    bands
        Bands of the results, in the light before the lens.
    path
        Path that forms the direct image; default: the lens along its axis, with its paraxial entrance pupil.
    spikes
        Radii and angles of the starburst's table.
    """

    lens: Prescription
    bands: Bands
    sensor: SensorGrid
    sun: SunSource
    settings: StraylightSettings = DEFAULT
    path: DirectPath | None = None
    spikes: tuple[int, int] = FINE_SPIKES

    @property
    def of_ghosts(self) -> GhostSource:
        """Return all on which ghosts depend where the Sun lights the whole entrance."""
        sun, settings = self.sun, self.settings
        return GhostSource(
            lens=self.lens,
            bands=self.bands,
            sensor=self.sensor,
            settings=settings.ghosts,
            coating_loss=settings.coating_loss,
            sun=(sun.angle_deg, sun.azimuth_deg),
            sun_radius_rad=sun.radius_rad,
        )

    def straylight(self, rates: F64 | None = None, once: Once = anew) -> SunStraylight:
        """Return all straylight, and what it takes from the direct image.

        Parameters
        ----------
        rates
            float64[band]: what a second of the Sun's irradiance gives in the channel of each band; default: 1.
        once
            Remembers parts that other samples or evaluations need too.
        """
        lens, bands, sensor, sun, settings = self.lens, self.bands, self.sensor, self.sun, self.settings
        optics = paraxial_properties(lens)
        efl_mm, cosine = optics.efl_mm, np.cos(np.radians(sun.angle_deg))
        pupil_mm2 = float(np.pi / 4 * optics.entrance_pupil_diameter_mm**2 * cosine)
        own = axial_transmittance(lens, bands.wavelength_nm)
        path = self.path or DirectPath(transmittance=own, admitted_mm2=pupil_mm2)
        passed = bands.mean(path.transmittance)
        slope = np.tan(np.radians(sun.angle_deg))
        past_baffle = float(settings.baffle.lit_fraction(lens, slope))
        # fraction of the entrance that the Sun lights; rays of ghosts meet the hood themselves
        lit = min(past_baffle, float(hood_transmission(lens, slope)))

        # each sample has its own loss of coatings
        ghosts_ = (anew if settings.coating_loss else once)(ghosts, self.of_ghosts)
        frame = StarburstFrame(sun_xy_mm=sun.xy_mm(efl_mm), bands=bands.behind(path.transmittance), sensor=sensor)
        burst = starburst_of(lens, sun_radius_rad=sun.radius_rad, table=self.spikes)
        in_burst = tuple((lit * passed * path.beam_fraction).tolist())
        starburst_ = once(starburst, burst, frame, in_burst, pupil_mm2)
        layout = once(GlareLayout, efl_mm, frame.sun_xy_mm, sensor.shape, sensor.pitch_mm)
        table, beyond, kept_of_single = once(
            glare, _scattering(lens), bands, settings.cleanliness, sun.angle_deg, layout
        )
        glare_gain = lit * passed / bands.mean(own) * kept_of_single
        ghost_gain = past_baffle * np.minimum(passed / bands.mean(own), 1)
        veil_mm2 = lit * passed * pupil_mm2 * settings.veil_fraction
        taken = (layout.flux_mm2(table) + beyond) * glare_gain + veil_mm2
        taken = taken + starburst_.flux_mm2 + starburst_.beyond_mm2
        return SunStraylight(
            ghosts=ghosts_,
            starburst=starburst_,
            ghost_gain=ghost_gain,
            layout=layout,
            glare=table * glare_gain[:, None].astype(np.float32),
            veil=(veil_mm2 * (1 / (np.pi * efl_mm**2))).astype(np.float32),
            glare_beyond_mm2=beyond * glare_gain,
            rates=np.ones(len(bands)) if rates is None else rates,
            direct_fraction=_direct_fraction(passed, path.admitted_mm2, ghosts_.flux_mm2 * ghost_gain, taken),
        )


def _scattering(lens: Prescription) -> Prescription:
    """Return the lens as far as its surfaces scatter: without the stop's blades and the sensor's reflectance."""
    surfaces = list(lens.surfaces)
    surfaces[lens.stop] = replace(surfaces[lens.stop], blades=0, blade_rounding=0.0, rotation_deg=0.0)
    return replace(lens, surfaces=tuple(surfaces), sensor_reflectance=0.0)


def _direct_fraction(passed: F64, admitted_mm2: float, ghosts_mm2: F64, taken_mm2: F64) -> F64:
    """Return the fraction of the Sun's direct image that remains, float64[band].

    `ghosts_mm2` is the flux of the ghosts, `taken_mm2` that of starburst, glare and veil on the whole plane.
    """
    direct = passed * admitted_mm2
    # light that the image path has lost feeds the ghosts; the direct light supplies the rest
    unpaid = np.maximum(ghosts_mm2 - (1 - passed) * admitted_mm2, 0)
    with np.errstate(divide="ignore", invalid="ignore"):
        left = np.where(direct > 0, 1 - (taken_mm2 + unpaid) / direct, 1.0)
    return np.clip(left, 0, 1)


def scene_veil_fraction(lens: Prescription, bands: Bands, *, cleanliness: Cleanliness, veil_fraction: float) -> F64:
    """Return the fraction of an extended scene's light that leaves its image for the veil, float64[band].

    Surfaces scatter the first part of it; mount, barrel and edges scatter `veil_fraction` of the rest.
    """
    scattered = scattered_fraction(lens, bands, cleanliness)
    return np.asarray(1 - (1 - scattered) * (1 - veil_fraction))


def veil_per_px(shape: tuple[int, int], focal_length_px: float) -> F32:
    """Return the fraction of a flux leaving the image that its veil brings to each pixel, float32[y, x].

    Its sum over the unbounded plane is 1; the part outside the frame is lost to the walls.
    """
    return np.asarray(cos4_map(shape, focal_length_px) * np.float32(1 / (np.pi * focal_length_px**2)))


def _flux_mm2(irradiance: F32, pitch_mm: float) -> F64:
    """Return the flux of an irradiance, float64[band]."""
    sums = in_layers(lambda band: irradiance[band].sum(dtype=np.float64), len(irradiance))
    return np.array(sums) * pitch_mm**2
