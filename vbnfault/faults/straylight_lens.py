"""Simulate straylight by physics: ghosts, starburst and veiling glare of a lens with a known prescription.

There are two models, which differ only in the ghosts. For each path of two reflections (or also of four, if
`reflections` is 4), `traced` traces exact rays (Hullin et al. 2011), and `paraxial` draws the paraxial image of
the stop (Lee & Eisemann 2013). The light is added as irradiance on the sensor, in proportion to the Sun's
irradiance at the camera.

With `sources = "scene"` the sunlit body, the spacecraft and everything else that is rendered are sources too, each
part of them like a small Sun (`lens.straylight.scene`). Their light is linear in the rendered radiance, so that it
needs no second render. The fault then acts without a Sun in view. A user's own image has no radiance, so there the
scattered light of the scene returns as a veil, as with `sources = "sun"`.

The image loses the light that becomes straylight (`lens.straylight`). Starburst, glare and veil of the Sun are
subtracted from the Sun's direct image. The image of the scene loses the fraction that is scattered, which returns
as a veil over the whole frame.

Rays that reach the sensor have passed the pupil and all rims. Both models therefore add their light to the light
past the rims (`quantities.Electrons.past_rims`), which the lens's own rims do not vignette again. If the image does
not separate the Sun's direct image from the scene, the rule for the scene applies to all light.

The parameters of a sample list the ghosts in the frame, the brightest first, at most 24. Each is described as if it
were the only ghost: `pair` (the reflecting rows of the prescription), `flux_fraction`, `peak_irradiance_fraction`,
`x_px`, `y_px`, `rms_radius_px`. Ghosts become brighter if another fault has worn the coatings.
"""

from __future__ import annotations

import pickle
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core import spectra
from ..core.quantities import Electrons, Radiance
from ..core.spectra import Bands
from ..lens import Prescription
from ..lens.image_frame import ImageFrame
from ..lens.straylight.ghosts import Ghost
from ..lens.straylight.particles import CLEANLINESS_LIMITS
from ..lens.straylight.scatter import ROUGHNESS_NM_LIMITS, Cleanliness
from ..lens.straylight.scene import PointSources, RenderGrid, SceneInLens, in_channels, surrounding_grids
from ..lens.straylight.scene_convolution import starburst_of_source, wing_fraction
from ..lens.straylight.settings import Baffle, DirectPath, GhostSettings, SensorGrid, StraylightSettings, SunSource
from ..lens.straylight.total import (
    FINE_SPIKES,
    GhostSource,
    Once,
    SunInLens,
    SunStraylight,
    anew,
    scene_veil_fraction,
    veil_per_px,
)
from .context import FaultContext, Params
from .contract import LensFault, mask_level
from .fields import Interval, Severity, bounds, choice, flag, number
from .planes import intensity_dn, reaches, sums, times

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]

_MOST_GHOSTS = 24
_LEAST_SUN_RAD = 1e-5


@dataclass(frozen=True, kw_only=True, eq=False)
class AddedLight:
    """Hold what straylight adds to an image and takes from it.

    Attributes
    ----------
    added
        float32[y, x, channel]: straylight in electrons.
    direct_left
        float64[channel]: remaining fraction of the Sun's direct image.
    scene_lost
        float64[channel]: fraction of the scene's image that becomes straylight.
    scene_added
        Whether `added` contains the straylight of the scene.
    source, of_sun
        The Sun's light in the lens, and what of it is in `added`; None if no Sun is in front of the camera.
    """

    added: F32
    direct_left: F64
    scene_lost: F64
    scene_added: bool
    source: SunInLens | None = None
    of_sun: SunStraylight | None = None


@dataclass(frozen=True, kw_only=True)
class _LensStraylight(LensFault):
    """Add ghosts, starburst and veiling glare of the Sun, and the veil of the scene; base of both models."""

    fault = "straylight"
    step = "electrons"
    needs_sun = True
    packaged_images = "textures"
    informed = True  # of the coating loss
    severity = Severity(key="veil_fraction", low=1e-4, high=0.5)
    effect_mask = True
    soft_layer = "straylight_added"

    coating: str = choice(
        "as_prescribed",
        ("as_prescribed", "none", "mgf2", "v", "bbar"),
        doc="of every surface between glass and air; as_prescribed: the lens's own",
    )
    roughness_nm: Interval = bounds(
        0.2, 1.0, limits=ROUGHNESS_NM_LIMITS, unit="nm", doc="rms roughness of the surfaces"
    )
    cleanliness_level: Interval = bounds(
        20, 100, limits=CLEANLINESS_LIMITS, doc="of particles on the surfaces, IEST-STD-CC1246; 0: none"
    )
    veil_fraction: Interval = bounds(
        0.005,
        0.02,
        limits=(0, 0.5),
        doc="fraction of the light that mount, barrel and edges scatter over the sensor: their veiling glare index "
        "(ISO 9358)",
    )
    sources: str = choice(
        "sun",
        ("sun", "scene"),
        doc="of ghosts and glare: the Sun alone, or the whole rendered scene and the Sun where it is in view",
    )
    scene_diffraction: bool = flag(
        False,
        doc="whether the stop diffracts light of the scene, too, beyond the point spread of the lens; a measured "
        "camera.point_spread includes it; needs sources = 'scene'",
    )
    reflections: int = number(2, limits=(2, 4), integer=True, doc="of the ghosts: 2, or 4 for those of four too")
    baffle_length_mm: float = number(0.0, limits=(0, 1e4), unit="mm", doc="of a tube in front of the lens")
    baffle_radius_mm: float = number(0.0, limits=(0, 1e4), unit="mm", doc="of that tube")
    mask_level_dn: float = mask_level()

    @classmethod
    def needs_sun_with(cls, table: Mapping[str, Any]) -> bool:
        """Return whether the Sun is the only source."""
        return table.get("sources", "sun") == "sun"

    def __post_init__(self) -> None:
        """Check every field."""
        super().__post_init__()
        object.__setattr__(self, "lit_by_surroundings", self.sources == "scene")

    def validate(self) -> None:
        """Raise ValueError if `reflections` is neither 2 nor 4, or a baffle has no radius."""
        super().validate()
        if self.reflections not in (2, 4):
            raise ValueError(f"reflections = {self.reflections}: must be 2 or 4")
        if self.scene_diffraction and self.sources != "scene":
            raise ValueError("scene_diffraction: needs sources = 'scene'")
        if self.baffle_length_mm and not self.baffle_radius_mm:
            raise ValueError("baffle_length_mm: needs baffle_radius_mm")

    def prescription(self, frame: ImageFrame) -> Prescription:
        """Return the lens with its coating."""
        return frame.prescription(self.lens, self.coating)

    def draw(self, context: FaultContext, rng: np.random.Generator) -> Params:
        """Return lens, coating, roughness, cleanliness, veil, baffle, mask level and the ghosts in the frame."""
        params = self.draw_state(context, rng)
        params["ghosts"] = self._ghosts(params, context)
        return params

    def draw_state(self, context: FaultContext, rng: np.random.Generator) -> Params:
        """Return the parameters of `draw` without the list of ghosts, which only describes them."""
        params: Params = {
            "lens": self.lens,
            "coating": self.coating,
            "roughness_nm": self.roughness_nm.uniform(rng),
            "cleanliness_level": self.cleanliness_level.uniform(rng),
            "veil_fraction": self.veil_fraction.uniform(rng),
            "reflections": int(self.reflections),
            "baffle_mm": [float(self.baffle_length_mm), float(self.baffle_radius_mm)],
            "mask_level_dn": float(self.mask_level_dn),
        }
        if self.sources != "sun":  # so that the stored parameters of other scenes stay as they are
            params["sources"] = self.sources
        if self.scene_diffraction:
            params["scene_diffraction"] = True
        return params

    def on_light(self, light: Electrons, params: Params, context: FaultContext) -> Electrons:
        """Return the light less what straylight takes of it, with straylight added to the light past the rims."""
        straylight = context.once(self._light, params)
        if straylight is None:
            return light
        past = straylight.added
        if not straylight.scene_added:
            veil = sums(light.array) * straylight.scene_lost
            plane = _in_frame(veil_per_px(_sensor_grid(context).shape, context.camera.focal_length_px), context)
            past = past + cv2.merge([plane * level for level in veil.astype(np.float32)]).reshape(past.shape)
        if light.past_rims is not None:
            past = times(light.past_rims, straylight.direct_left) + past
        return replace(light, array=times(light.array, 1 - straylight.scene_lost), past_rims=past)

    def apply(self, quantity: Any, params: Params, context: FaultContext) -> Any:
        """Return the expected electrons plus straylight, minus the light that straylight is taken from."""
        return self.on_light(quantity, params, context).merged

    def footprint(self, params: Params, context: FaultContext) -> NDArray[np.bool_]:
        """Return the pixels where any channel gains at least `mask_level_dn` of straylight, bool[y, x]."""
        light = context.once(self._light, params)
        if light is None:
            return np.zeros(context.shape, dtype=bool)
        white = context.camera.detector.white_e
        return reaches(light.added, white * np.float32(params["mask_level_dn"] / 255))

    def soft(self, params: Params, context: FaultContext) -> F32:
        """Return the intensity of the straylight, float32[y, x] in DN of 255."""
        light = context.once(self._light, params)
        return np.zeros(context.shape, np.float32) if light is None else intensity_dn(light.added, context.camera)

    def _light(self, params: Params, context: FaultContext) -> AddedLight | None:
        """Return the straylight of a sample; samples of a view with the same lens in the same state share it."""
        state = pickle.dumps((self, params)), context.camera, context.sun_visible_fraction, context.coating_loss
        make = partial(self.added_light, params, context, _of_view(context))
        return context.of_view.once("straylight", state, make)

    def added_light(
        self, params: Params, context: FaultContext, once: Once, *, spikes: tuple[int, int] = FINE_SPIKES
    ) -> AddedLight | None:
        """Return the straylight; None if there is no Sun in front of the camera and no light of the scene."""
        scene, source = self.scene_light(params, context), self.sun_in_lens(params, context)
        if source is None and scene is None:
            return None
        lost = self.scene_lost(params, context)
        if source is None:
            assert scene is not None
            return AddedLight(added=scene, direct_left=1 - lost, scene_lost=lost, scene_added=True)
        source = replace(source, spikes=spikes)
        of_sun = source.straylight(channel_bands(context)[1] * context.sun_visible, once)
        planes = _in_frame(of_sun.total(context.camera.exposure_s), context)
        added = cv2.merge(list(planes)).reshape(*context.shape, len(planes))
        return AddedLight(
            added=added if scene is None else added + scene,
            direct_left=of_sun.direct_fraction,
            scene_lost=lost,
            scene_added=scene is not None,
            source=source,
            of_sun=of_sun,
        )

    def scene_light(self, params: Params, context: FaultContext) -> F32 | None:
        """Return the straylight of the rendered scene, electrons float32[y, x, channel]; None if there is none."""
        radiance, camera = context.radiance, context.camera
        if params.get("sources") != "scene" or radiance is None:
            return None
        array, nodes = _without_sun(radiance), radiance.wavelength_nm
        render = RenderGrid(shape=(int(array.shape[1]), int(array.shape[2])), focal_px=camera.focal_length_px)
        rates = camera.detector.electron_rates(spectra.fine_nodes_nm(nodes)) * camera.exposure_s
        bands, of_nodes, weights = in_channels(rates, nodes)
        in_lens = SceneInLens(
            lens=context.frame.prescription(params["lens"], params["coating"]),
            bands=bands,
            of_nodes=of_nodes,
            sensor=_sensor_grid(context),
            render=render,
            around=surrounding_grids(render)[: len(context.surroundings)],
            image=camera.lens,
            settings=self._settings(params, context),
            passed=camera.lens.transmittance(bands.wavelength_nm),
            diffraction=_diffracts(params, context),
        )
        around = [_without_sun(one) for one in context.surroundings]
        total = in_lens.straylight(array, weights, around, _far_points(context, in_lens.reach)).total
        return np.ascontiguousarray(total.transpose(1, 2, 0))

    def sun_in_lens(self, params: Params, context: FaultContext) -> SunInLens | None:
        """Return the Sun's light in the lens; its bands are the channels. None if no Sun is before the camera."""
        sun = _sun(context)
        if sun is None:
            return None
        theta, azimuth = sun
        camera, sensor, bands = context.camera, _sensor_grid(context), channel_bands(context)[0]
        assert context.sun_xy_px is not None
        x, y = (np.asarray(context.sun_xy_px) - _axis_px(context)) * sensor.pitch_mm
        area_mm2, axial_mm2 = camera.lens.pupil_area_mm2([np.tan(np.radians(theta)), 0.0])
        return SunInLens(
            lens=context.frame.prescription(params["lens"], params["coating"]),
            bands=bands,
            sensor=sensor,
            sun=SunSource(
                angle_deg=theta,
                azimuth_deg=azimuth,
                radius_rad=_sun_radius_rad(context),
                image_xy_mm=(float(x), float(y)),
            ),
            settings=self._settings(params, context),
            path=DirectPath(
                transmittance=camera.lens.transmittance(bands.wavelength_nm),
                admitted_mm2=float(area_mm2 * np.cos(np.radians(theta))),
                beam_fraction=float(area_mm2 / axial_mm2),
            ),
        )

    def _settings(self, params: Params, context: FaultContext) -> StraylightSettings:
        """Return the state of the lens."""
        return StraylightSettings(
            ghosts=GhostSettings(model=self.model, reflections=params["reflections"]),
            cleanliness=Cleanliness(roughness_nm=params["roughness_nm"], level=params["cleanliness_level"]),
            baffle=Baffle(length_mm=params["baffle_mm"][0], radius_mm=params["baffle_mm"][1]),
            coating_loss=context.coating_loss,
            veil_fraction=params["veil_fraction"],
        )

    def scene_lost(self, params: Params, context: FaultContext) -> F64:
        """Return the fraction of the scene's image that becomes straylight, float64[channel]."""
        settings = self._settings(params, context)
        lost = scene_veil_fraction(
            context.frame.prescription(params["lens"], params["coating"]),
            _bands_behind_lens(context),
            cleanliness=settings.cleanliness,
            veil_fraction=settings.veil_fraction,
        )
        if _diffracts(params, context):
            lost = 1 - (1 - lost) * (1 - self._diffracted(params, context))
        return lost

    def _diffracted(self, params: Params, context: FaultContext) -> F64:
        """Return the fraction of the scene's light that the stop diffracts far enough, float64[channel]."""
        lens, bands = context.frame.prescription(params["lens"], params["coating"]), _bands_behind_lens(context)
        burst = starburst_of_source(lens, bands, 1 / context.camera.focal_length_px)
        return wing_fraction(burst, bands, _sensor_grid(context))

    def _ghosts(self, params: Params, context: FaultContext) -> list[dict[str, Any]]:
        """Return the brightest ghosts in the frame as plain data."""
        source = self.sun_in_lens(params, context)
        if source is None:
            return []
        pitch_mm, (axis_x, axis_y) = source.sensor.pitch_mm, _axis_px(context).tolist()
        once = anew if context.coating_loss else _of_view(context)  # each sample has its own loss of coatings
        return [
            {
                "pair": list(g.pair),
                "flux_fraction": g.flux_fraction,
                "peak_irradiance_fraction": g.peak_irradiance_fraction,
                "x_px": g.centroid_mm[0] / pitch_mm + axis_x,
                "y_px": g.centroid_mm[1] / pitch_mm + axis_y,
                "rms_radius_px": g.rms_radius_mm / pitch_mm,
            }
            for g in once(_brightest, source.of_ghosts)
        ]


def _brightest(source: GhostSource) -> list[Ghost]:
    """Return the ghosts in the frame with the highest peaks, at most `_MOST_GHOSTS`, the brightest first."""
    ghosts = source.model.ghosts(*source.sun, most=_MOST_GHOSTS)
    return sorted(ghosts, key=lambda g: -g.peak_irradiance_fraction)


def _of_view(context: FaultContext) -> Once:
    """Return what remembers the results that the samples of a view share, by function and arguments."""

    def once(function: Callable[..., Any], *arguments: Any) -> Any:
        return context.of_view.once(function.__qualname__, arguments, partial(function, *arguments))

    return once


def _diffracts(params: Params, context: FaultContext) -> bool:
    """Return whether the stop diffracts light of the scene; a measured point spread already contains its wings."""
    lens = context.camera.lens
    measured = lens.real is None and lens.blurs
    return bool(params.get("scene_diffraction", False)) and context.radiance is not None and not measured


@dataclass(frozen=True, kw_only=True)
class TracedStraylight(_LensStraylight):
    """Add ghosts computed by exact rays, starburst and veiling glare."""

    model = "traced"


@dataclass(frozen=True, kw_only=True)
class ParaxialStraylight(_LensStraylight):
    """Add ghosts of paraxial rays, starburst and veiling glare."""

    model = "paraxial"


def _sun(context: FaultContext) -> tuple[float, float] | None:
    """Return the Sun's angle from the axis and its azimuth in the image, in degrees; None if it gives no light."""
    if context.sun_xy_px is None or context.sun_visible_fraction == 0:
        return None
    direction = context.sun_before_camera
    if direction is None:
        return None
    theta = float(np.degrees(np.arctan2(np.hypot(direction[0], direction[1]), direction[2])))
    return (theta, float(np.degrees(np.arctan2(direction[1], direction[0])))) if theta < 89.9 else None


def _without_sun(radiance: Radiance) -> F32:
    """Return the radiance without the Sun's disc, float32[band, y, x]."""
    return radiance.array if radiance.sun is None else np.maximum(radiance.array - radiance.sun, 0)


def _far_points(context: FaultContext, reach: float) -> list[tuple[PointSources, F32]]:
    """Return the bright bodies out of the frame as points with their irradiances, float32[band, point].

    A body with its middle in the frame is no source, since its image is not drawn. `reach` is the tangent of the
    field angle up to which sources count.
    """
    camera = context.camera
    half = np.array([camera.width_px, camera.height_px]) / 2 / camera.focal_length_px
    out = []
    for source in context.far_sources:
        x, y, z = source.direction_C
        if not source.irradiance_W_m2_nm.any() or (z > 0 and (np.abs([x, y]) < half * z).all()):
            continue
        points, fraction = PointSources.of_disc(
            source.direction_C, source.angular_radius_rad, camera.focal_length_px, reach
        )
        if points.x:
            irradiance = np.repeat(source.irradiance_W_m2_nm[:, None] * fraction, len(points.x), axis=1)
            out.append((points, irradiance.astype(np.float32)))
    return out


def _sensor_grid(context: FaultContext) -> SensorGrid:
    """Return the pixels of the camera, with those that a frame around its axis has more than a calibrated one."""
    height, width = (size + abs(more) for size, more in zip(context.shape, _past_frame(context), strict=True))
    return SensorGrid(shape=(height, width), pitch_mm=context.camera.detector.pixel_pitch_um * 1e-3)


def _past_frame(context: FaultContext) -> tuple[int, int]:
    """Return how many rows and columns a frame around the axis has more: below and to the right, or if negative
    above and to the left.

    The axis of a calibrated camera is its principal point, to half a pixel; that of others is in the middle.
    """
    cx, cy = context.camera.intrinsics[2:]
    rows, columns = (
        int(np.clip(round(2 * float(c) - size), -size, size))
        for c, size in zip((cy, cx), context.shape, strict=True)
    )
    return rows, columns


def _axis_px(context: FaultContext) -> F64:
    """Return the position of the lens's axis in the frame, float64[2] in px."""
    (height, width), (rows, columns) = context.shape, _past_frame(context)
    return np.array([(width + columns) / 2, (height + rows) / 2])


def _in_frame(planes: F32, context: FaultContext) -> F32:
    """Return the part of planes on `_sensor_grid`, float32[..., y, x], that lies in the frame."""
    (height, width), (rows, columns) = context.shape, _past_frame(context)
    top, left = max(-rows, 0), max(-columns, 0)
    return planes[..., top : top + height, left : left + width]


def channel_bands(context: FaultContext) -> tuple[Bands, F64]:
    """Return the bands in which the channels sense sunlight, and its electrons per second, float64[channel]."""
    nodes, irradiance = context.sunlight
    nm = spectra.fine_nodes_nm(nodes)
    spectrum = context.camera.detector.electron_rates(nm) * spectra.sunlike(irradiance, nodes)
    return Bands.of(nm, spectrum), np.asarray(np.trapezoid(spectrum, nm, axis=1))


def _bands_behind_lens(context: FaultContext) -> Bands:
    """Return the bands in which the channels sense the sunlight that the lens transmits.

    The scene and the Sun's image both have its spectrum.
    """
    bands, _ = channel_bands(context)
    return bands.behind(context.camera.lens.transmittance(bands.wavelength_nm))


def _sun_radius_rad(context: FaultContext) -> float:
    """Return the angular radius of the Sun; if it is unknown, that at 1 AU."""
    radius_rad = context.sun_angular_radius_rad
    return spectra.sun_angular_radius_rad(1.0) if radius_rad is None else max(float(radius_rad), _LEAST_SUN_RAD)
