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

from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ...core.memory import release_unused
from ...core.spectra import Bands
from ..paraxial import paraxial_properties
from ..prescription import Prescription
from ..thin import cos4_map
from .irradiance import FlareModel, flare_model
from .paraxial import axial_transmittance
from .pyramid import Pyramid, in_layers, scaled
from .scatter import (
    Cleanliness,
    VeilingGlare,
    baffle_transmission,
    hood_transmission,
    scattered_fraction,
    veiling_glare,
)
from .settings import DEFAULT, Baffle, DirectPath, SensorGrid, StraylightSettings, SunSource
from .starburst import Starburst, StarburstFrame, starburst

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]


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


@dataclass(frozen=True, kw_only=True, eq=False)
class Burst:
    """Hold a starburst.

    Attributes
    ----------
    planes
        Irradiance times the rates of `SunlightInLens.in_channels`, float32[band, y, x], read-only.
    flux_mm2, beyond_mm2
        float64[band]: flux inside and outside the frame, over the Sun's irradiance at the entrance.
    """

    planes: F32
    flux_mm2: F64
    beyond_mm2: F64


@dataclass(frozen=True, kw_only=True, eq=False)
class ClearLight:
    """Hold the straylight of a lens without scatter: its ghosts and its starburst.

    Attributes
    ----------
    planes
        Sum of both times the rates of `SunlightInLens.in_channels`, float32[band, y, x], read-only.
    ghosts_mm2, starburst_mm2
        float64[band]: flux of each in the frame, over the Sun's irradiance at the entrance.
    beyond_mm2
        float64[band]: flux of the starburst outside the frame.
    """

    planes: F32
    ghosts_mm2: F64
    starburst_mm2: F64
    beyond_mm2: F64


def _lit_fraction(lens: Prescription, baffle: Baffle, sun_deg: float) -> float:
    """Return the fraction of the lens's entrance that the Sun lights through a baffle."""
    if baffle.length_mm <= 0:
        return 1.0
    return float(
        baffle_transmission(
            sun_deg,
            length_mm=baffle.length_mm,
            radius_mm=baffle.radius_mm,
            # a tube narrower than the lens is itself the entrance
            entrance_radius_mm=min(lens.surfaces[0].semi_diameter_mm, baffle.radius_mm),
        )
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class SunlightInLens:
    """Hold the Sun's light in a lens, and compute what of it becomes ghosts, starburst, glare and veil.

    `starburst`, `glare` and `veil` return the irradiance on the sensor, float32[band, y, x], and the flux beyond
    the frame, float64[band] in mm², both over the Sun's irradiance at the entrance.

    A study evaluates many lenses that differ in few parameters. For it, `ghost_levels`, `starburst_layers`,
    `glare_samples` and `glare_light` compute the parts that take time. Each depends on its `…_key` alone; the rest
    of this class is cheap.

    Attributes
    ----------
    own, passed
        float64[band]: transmittance of the lens along its axis, and of the path of the direct image.
    behind
        The bands of the light that has taken this path.
    admitted_mm2, beam_fraction
        As in `DirectPath`.
    past_baffle, past_hood
        Fraction of the entrance that the Sun lights through the baffle, and past the lens's own hood.
    pupil_mm2
        Area of the paraxial entrance pupil across the Sun's direction.
    """

    lens: Prescription
    bands: Bands
    sensor: SensorGrid
    sun: SunSource
    settings: StraylightSettings
    own: F64
    passed: F64
    behind: Bands
    admitted_mm2: float
    beam_fraction: float
    past_baffle: float
    past_hood: float
    pupil_mm2: float

    @classmethod
    def of(
        cls,
        lens: Prescription,
        *,
        bands: Bands,
        sensor: SensorGrid,
        sun: SunSource,
        settings: StraylightSettings = DEFAULT,
        path: DirectPath | None = None,
    ) -> SunlightInLens:
        """Return the Sun's light in a lens.

        Parameters
        ----------
        lens
            At its final size.
        bands
            Bands of the results, in the light before the lens.
        path
            Path that forms the direct image; default: the lens along its axis, with its paraxial entrance pupil.

        Raises
        ------
        InputError
            A value is out of range.
        """
        diameter_mm = paraxial_properties(lens).entrance_pupil_diameter_mm
        pupil_mm2 = float(np.pi / 4 * diameter_mm**2 * np.cos(np.radians(sun.angle_deg)))
        own = axial_transmittance(lens, bands.wavelength_nm)
        path = DirectPath(transmittance=own, admitted_mm2=pupil_mm2) if path is None else path
        return cls(
            lens=lens,
            bands=bands,
            sensor=sensor,
            sun=sun,
            settings=settings,
            own=bands.mean(own),
            passed=bands.mean(path.transmittance),
            behind=bands.behind(path.transmittance),
            admitted_mm2=path.admitted_mm2,
            beam_fraction=path.beam_fraction,
            past_baffle=_lit_fraction(lens, settings.baffle, sun.angle_deg),
            past_hood=float(hood_transmission(lens, np.tan(np.radians(sun.angle_deg)))),
            pupil_mm2=pupil_mm2,
        )

    def total(self) -> Straylight:
        """Return all straylight, and what it takes from the direct image."""
        pitch_mm = self.sensor.pitch_mm
        burst, burst_beyond = self.starburst()
        glare, glare_beyond = self.glare()
        veil, veil_beyond = self.veil()
        ghosts = self._ghosts()
        beyond = burst_beyond + glare_beyond + veil_beyond
        taken = sum(_flux_mm2(layer, pitch_mm) for layer in (burst, glare, veil)) + beyond
        return Straylight(
            ghosts=ghosts,
            starburst=burst,
            glare=glare,
            veil=veil,
            direct_fraction=self.direct_fraction(_flux_mm2(ghosts, pitch_mm), taken),
            beyond_mm2=beyond,
        )

    def in_channels(
        self, rates: F64, clear: ClearLight, samples: GlareSamples, exposure_s: float = 1.0
    ) -> tuple[F32, F64]:
        """Return all straylight in the channels of a sensor, float32[band, y, x], and the kept direct fraction.

        The values are those of `total`, but for rounding.

        Parameters
        ----------
        rates
            float64[band]: what a second of the Sun's irradiance gives in the channel of each band.
        clear
            Result of `clear_light` for these rates.
        samples
            Result of `glare_samples`.
        exposure_s
            Exposure.
        """
        table, glare_beyond, kept_of_single = self.glare_light()
        gain = self.glare_gain(kept_of_single)
        entering, per_mm2 = self._veil_on_axis()
        # on the sensor glare and veil have the same factor, cos⁴
        scattered = table * gain[:, None].astype(np.float32) + (entering * per_mm2)[:, None].astype(np.float32)
        planes = samples.planes(scattered * rates[:, None] * exposure_s, (clear.planes, exposure_s))
        taken = (samples.flux_mm2(table) + glare_beyond) * gain + entering
        taken = taken + clear.starburst_mm2 + clear.beyond_mm2
        return planes, self.direct_fraction(clear.ghosts_mm2, taken)

    @property
    def clear_key(self) -> tuple[Any, ...]:
        """Return all that `clear_light` depends on beside the rates."""
        return *self.ghost_key, self.past_baffle, *self.burst_key

    def clear_light(self, rates: F64, burst: Burst | None = None) -> ClearLight:
        """Return ghosts and starburst, which roughness, dust and veil do not change.

        `rates` are as in `in_channels`. `burst` is the result of `burst` for the same rates, if it is known.
        """
        frame_bytes = 4 * len(self.bands.nodes_nm) * self.sensor.shape[0] * self.sensor.shape[1]
        release_unused(9 * frame_bytes)  # the sums of all levels take 90 MB, the cells 200 MB
        planes = self._ghosts()
        # what the drawing took, before the other parts and the signals of the sample's faults take as much
        release_unused(9 * frame_bytes)
        ghosts_mm2 = _flux_mm2(planes, self.sensor.pitch_mm)
        scaled(planes, rates)
        burst = self.burst(rates) if burst is None else burst
        planes += burst.planes
        planes.flags.writeable = False
        return ClearLight(
            planes=planes, ghosts_mm2=ghosts_mm2, starburst_mm2=burst.flux_mm2, beyond_mm2=burst.beyond_mm2
        )

    def burst(self, rates: F64) -> Burst:
        """Return the starburst, times rates as in `in_channels`."""
        image, beyond = self.starburst()
        flux = _flux_mm2(image, self.sensor.pitch_mm)
        scaled(image, rates).flags.writeable = False
        return Burst(planes=image, flux_mm2=flux, beyond_mm2=beyond)

    @property
    def lit(self) -> float:
        """Return the fraction of the entrance that the Sun lights; rays of ghosts meet the hood themselves."""
        return min(self.past_baffle, self.past_hood)

    @property
    def _efl_mm(self) -> float:
        """Return the focal length."""
        return paraxial_properties(self.lens).efl_mm

    @property
    def _cos4(self) -> F32:
        """Return cos⁴ of the field angle of every pixel."""
        return cos4_map(self.sensor.shape, self._efl_mm / self.sensor.pitch_mm)

    @property
    def _sun_xy_mm(self) -> tuple[float, float]:
        """Return the position of the direct image."""
        return self.sun.xy_mm(self._efl_mm)

    # --- ghosts

    @property
    def ghost_key(self) -> tuple[Any, ...]:
        """Return all that `ghost_levels` depends on."""
        sun, settings = self.sun, self.settings
        return (
            *(self.lens, self.bands, self.sensor, settings.ghosts, settings.coating_loss),
            *(sun.angle_deg, sun.azimuth_deg, sun.radius_rad),
        )

    def ghost_model(self) -> FlareModel:
        """Return the model of the ghosts."""
        model = flare_model(self.lens, self.bands, self.sensor, self.sun.radius_rad, self.settings.ghosts)
        return model.worn(self.settings.coating_loss)

    def _ghosts(self) -> F32:
        """Return the irradiance of the ghosts, float32[band, y, x]."""
        ghosts = self.ghost_model().image(self.sun.angle_deg, self.sun.azimuth_deg)
        ghosts *= np.float32(self.past_baffle)
        return ghosts

    def ghost_levels(self) -> Pyramid:
        """Return the irradiance of the ghosts where the Sun lights the whole entrance."""
        return self.ghost_model().levels(self.sun.angle_deg, self.sun.azimuth_deg)

    # --- starburst

    @property
    def starburst_key(self) -> tuple[Any, ...]:
        """Return all that `starburst_layers` depends on."""
        lens = self.lens
        stop, optics = lens.surfaces[lens.stop], paraxial_properties(lens)
        outline = stop.semi_diameter_mm, stop.blades, stop.blade_rounding, stop.rotation_deg
        pupil = optics.efl_mm, optics.entrance_pupil_diameter_mm
        return *outline, *pupil, self.sun.radius_rad, self._sun_xy_mm, self.behind, self.sensor

    @property
    def _starburst_frame(self) -> StarburstFrame:
        """Return where and in which bands the starburst is computed."""
        return StarburstFrame(sun_xy_mm=self._sun_xy_mm, bands=self.behind, sensor=self.sensor)

    def starburst_layers(self) -> Diffraction:
        """Return the diffracted light of a lens with a transmission of 1.

        Its tables are coarser than those of `starburst`: in a frame of 1024 pixels the spikes in the corner are a
        pixel wider.
        """
        burst, frame = _coarse_starburst(self.lens, self.sun.radius_rad), self._starburst_frame
        layers, mix = burst.layers(frame)
        return Diffraction(
            layers=layers,
            mix=mix,
            flux_mm2=mix @ _flux_mm2(layers, self.sensor.pitch_mm),
            beyond_mm2=burst.beyond_mm2(frame),
        )

    def starburst_gain(self, flux_mm2: F64) -> F64:
        """Return the factor on diffracted light whose flux on the whole plane is `flux_mm2`, float64[band]."""
        # diffraction scales with the light that passes the stop, and cannot exceed it
        return np.asarray(self.lit * self.passed * self.beam_fraction / np.maximum(flux_mm2 / self.pupil_mm2, 1))

    @property
    def burst_key(self) -> tuple[Any, ...]:
        """Return all that `starburst` depends on."""
        where = self.lens, self.behind, self.sensor, self.sun.radius_rad, self._sun_xy_mm
        return *where, tuple(self.passed.tolist()), self.lit, self.beam_fraction, self.pupil_mm2

    def starburst(self) -> tuple[F32, F64]:
        """Return what the stop diffracts."""
        burst, frame = _starburst(self.lens, self.sun.radius_rad), self._starburst_frame
        image, beyond = burst.image(frame), burst.beyond_mm2(frame)
        gain = self.starburst_gain(_flux_mm2(image, self.sensor.pitch_mm) + beyond)
        image *= gain[:, None, None].astype(np.float32)
        return image, beyond * gain

    # --- glare

    @property
    def glare_samples_key(self) -> tuple[Any, ...]:
        """Return all that `glare_samples` depends on."""
        return self._efl_mm, self._sun_xy_mm, self.sensor

    def glare_samples(self) -> GlareSamples:
        """Return the step of the glare's table at each pixel; roughness and dust do not change it."""
        index = self._scattering.samples(self._sun_xy_mm, self.sensor.shape, self.sensor.pitch_mm)
        cos4 = self._cos4
        area = np.bincount(index.ravel(), weights=cos4.ravel()).astype(np.float64) * self.sensor.pitch_mm**2
        return GlareSamples(index=index.astype(np.int32), cos4=cos4, area_mm2=area)

    @property
    def glare_key(self) -> tuple[Any, ...]:
        """Return all that `glare_light` depends on."""
        # neither the blades of the stop nor the sensor's reflectance change what surfaces scatter
        surfaces = list(self.lens.surfaces)
        stop = self.lens.stop
        surfaces[stop] = replace(surfaces[stop], blades=0, blade_rounding=0.0, rotation_deg=0.0)
        lens = replace(self.lens, surfaces=tuple(surfaces), sensor_reflectance=0.0)
        return lens, self.bands, self.sensor, self.sun.angle_deg, self._sun_xy_mm, self.settings.cleanliness

    def glare_light(self) -> tuple[F32, F64, F64]:
        """Return the irradiance at the steps of `glare_samples`, its flux beyond the frame, and its kept fraction.

        The arrays are float32[band, step], float64[band] in mm², and float64[band].
        """
        scattering = self._scattering
        beyond = scattering.beyond_mm2(self._sun_xy_mm, self.sensor.shape, self.sensor.pitch_mm)
        return scattering.table, beyond, scattering.kept_of_single

    def glare_gain(self, kept_of_single: F64) -> F64:
        """Return the factor on the scattered light, float64[band]."""
        # each surface scatters only the light that the others have left (`kept_of_single`)
        return np.asarray(self.lit * self.passed / self.own * kept_of_single)

    def glare(self) -> tuple[F32, F64]:
        """Return what the surfaces scatter."""
        scattering, where = self._scattering, self._sun_xy_mm
        gain = self.glare_gain(scattering.kept_of_single)
        image = scattering.image(where, self.sensor.shape, self.sensor.pitch_mm)
        cos4, by_band = self._cos4, gain.astype(np.float32)

        def weaken(band: int) -> None:
            image[band] *= by_band[band] * cos4

        in_layers(weaken, len(image))
        return image, scattering.beyond_mm2(where, self.sensor.shape, self.sensor.pitch_mm) * gain

    @cached_property
    def _scattering(self) -> VeilingGlare:
        """Return the scatter of the surfaces."""
        return veiling_glare(
            self.lens,
            sun_deg=self.sun.angle_deg,
            wavelength_nm=self.bands,
            cleanliness=self.settings.cleanliness,
        )

    # --- veil and direct image

    def veil(self) -> tuple[F32, F64]:
        """Return what mount, barrel and edges scatter."""
        entering, per_mm2 = self.veil_light()
        image = np.asarray(entering[:, None, None].astype(np.float32) * per_mm2)
        return image, entering * (1 - float(per_mm2.sum(dtype=np.float64)) * self.sensor.pitch_mm**2)

    def veil_light(self) -> tuple[F64, F32]:
        """Return the flux of the veil, float64[band] in mm², and its distribution, float32[y, x] in 1/mm²."""
        entering, per_mm2 = self._veil_on_axis()
        return entering, self._cos4 * np.float32(per_mm2)

    def _veil_on_axis(self) -> tuple[F64, float]:
        """Return the flux of the veil, float64[band] in mm², and the fraction of it that a mm² on the axis gets."""
        return self.lit * self.passed * self.pupil_mm2 * self.settings.veil_fraction, 1 / (np.pi * self._efl_mm**2)

    def direct_fraction(self, ghosts_mm2: F64, taken_mm2: F64) -> F64:
        """Return the fraction of the Sun's direct image that remains, float64[band].

        `ghosts_mm2` is the flux of the ghosts, `taken_mm2` that of starburst, glare and veil on the whole plane.
        """
        direct = self.passed * self.admitted_mm2
        # light that the image path has lost feeds the ghosts; the direct light supplies the rest
        unpaid = np.maximum(ghosts_mm2 - (1 - self.passed) * self.admitted_mm2, 0)
        with np.errstate(divide="ignore", invalid="ignore"):
            left = np.where(direct > 0, 1 - (taken_mm2 + unpaid) / direct, 1.0)
        return np.clip(left, 0, 1)


@dataclass(frozen=True, kw_only=True, eq=False)
class Diffraction:
    """Hold the starburst of a lens with a transmission of 1, over the Sun's irradiance at the entrance.

    The image of a band is the sum of `layers` float32[layer, y, x] with the weights `mix` float64[band, layer].
    `flux_mm2` and `beyond_mm2` float64[band] are its flux inside and outside the frame.
    """

    layers: F32
    mix: F64
    flux_mm2: F64
    beyond_mm2: F64

    def planes(self, rates: F64) -> F32:
        """Return the images of the bands times rates float64[band], float32[band, y, x]."""
        return np.asarray(np.tensordot((rates[:, None] * self.mix).astype(np.float32), self.layers, 1))


@dataclass(frozen=True, kw_only=True, eq=False)
class GlareSamples:
    """Hold how the glare's table is laid out on the sensor.

    Attributes
    ----------
    index
        int32[y, x]: step of the table at each pixel.
    cos4
        float32[y, x], a factor on the light of the table.
    area_mm2
        float64[step]: pixels' area times `cos4` for each step.
    """

    index: NDArray[np.int32]
    cos4: F32
    area_mm2: F64

    def flux_mm2(self, table: F32) -> F64:
        """Return the flux in the frame of a table float32[band, step], float64[band]."""
        # not a product of BLAS, whose bits may depend on the number of threads
        return np.einsum("bs,s->b", table[:, : len(self.area_mm2)].astype(np.float64), self.area_mm2)

    def planes(self, table: NDArray[np.floating], more: tuple[F32, float] | None = None) -> F32:
        """Return the images of a table [band, step], float32[band, y, x].

        `more` are planes of the shape of the result, and a factor; their product is added.
        """
        channels = table.astype(np.float32)
        index = self.index.astype(np.intp)  # numpy would convert it for every channel
        out = np.empty((len(channels), *index.shape), np.float32)

        def take(channel: int) -> None:
            plane = out[channel]
            np.take(channels[channel], index, out=plane, mode="clip")
            np.multiply(plane, self.cos4, out=plane)
            if more is not None:
                cv2.scaleAdd(more[0][channel], more[1], plane, dst=plane)

        in_layers(take, len(out))
        return out


def scene_veil_fraction(lens: Prescription, bands: Bands, *, cleanliness: Cleanliness, veil_fraction: float) -> F64:
    """Return the fraction of an extended scene's light that leaves its image for the veil, float64[band].

    Surfaces scatter the first part of it; mount, barrel and edges scatter `veil_fraction` of the rest.
    """
    scattered = scattered_fraction(lens, bands, cleanliness=cleanliness)
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


@lru_cache(maxsize=4)
def _starburst(lens: Prescription, sun_radius_rad: float) -> Starburst:
    """Return the starburst of a lens; it is cached with its tables."""
    return starburst(lens, sun_radius_rad=sun_radius_rad)


@lru_cache(maxsize=2)
def _coarse_starburst(lens: Prescription, sun_radius_rad: float) -> Starburst:
    """Return the starburst of a lens with tables that take a third of the time."""
    return starburst(lens, sun_radius_rad=sun_radius_rad, radii=160, angles=2048)
