"""Set the exposure of a sample, fixed or metered on its sunlit ground, and add the stars that it can show."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import reduce

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ..camera import Camera
from ..core.quantities import BODY, Electrons, Radiance, Truth
from ..reflectance import radiance_factor
from ..render.description import RenderInput, View
from ..scene.config import Scene
from ..world import assemble, ephemeris
from ..world.sky import StarRadiance
from .spec import Pose, Rendering, SampleSpec, SceneExposure, SceneLight

Direction = tuple[float, float, float]
F64 = NDArray[np.float64]

# The metered exposure stays within these factors of the exposure for a facet lit at 45 degrees. So a small area of
# grazing light does not make the whole frame noisy. Dark ground at zero phase is up to nine times as bright as that
# facet; where this asks for a shorter exposure than the lower factor allows, it is allowed.
_METERING_RANGE = (0.25, 8.0)
_STAR_STEPS_PER_PX, _MOST_STAR_STEPS = 2.0, 1024  # of a camera that turns
_NEAR_FRAME_DEG = 10.0  # from a corner: nearer, the Sun's veil limits the exposure
_AT_45_DEG = ((0.0, 0.5**0.5, 0.5**0.5), (0.5**0.5, 0.0, 0.5**0.5))  # towards the Sun and the camera: 60° of phase
_AT_ZERO_PHASE = ((0.0, 0.0, 1.0), (0.0, 0.0, 1.0))


def meter(spec: SampleSpec, rendering: Rendering, earlier_s: float | None = None) -> SceneExposure:
    """Set the exposure: fixed, or metered on the noise-free, fault-free frame. All twins share it.

    `earlier_s` is what the metering of an earlier frame gave: this frame takes it within its own limits.
    """
    metered_s, rate = _metered_light(spec, rendering)
    seconds = (metered_s if earlier_s is None else earlier_s) * exposure_factor(spec)
    settings = limited(spec.scene, rendering.scene).camera
    if settings.exposure_s == "auto":
        seconds = float(np.clip(seconds, settings.exposure_min_s, settings.exposure_max_s))
    camera = replace(spec.camera, exposure_s=seconds)
    return SceneExposure(camera=camera, light=rendering.light, rate=rate, metered_s=metered_s)


def _metered_light(spec: SampleSpec, rendering: Rendering) -> tuple[float, Electrons]:
    """Return the exposure in s, and the electrons expected after one second.

    Both depend on the optics of the camera only, so the samples of a view with equal optics share them.
    """
    camera = spec.camera

    def metered() -> tuple[float, Electrons]:
        rate = camera.expose(rendering.light.rendered, 1.0)
        return exposure_s(limited(spec.scene, rendering.scene), camera, rendering.truth, rate.merged), rate

    return rendering.shared.once("metered light", camera.optics, metered)


def limited(scene: Scene, rendered: RenderInput) -> Scene:
    """Return a scene with the longest exposure of a view: shorter where the Sun is in the frame or near it."""
    towards_sun_s, view = scene.camera.exposure_max_towards_sun_s, rendered.view
    corner_deg = math.degrees(view.corner_rad)
    away_deg = math.degrees(math.acos(np.clip(view.L_from_C[:, 2] @ rendered.sun.direction_L, -1, 1)))
    if towards_sun_s is None or away_deg > corner_deg + _NEAR_FRAME_DEG:
        return scene
    longest_s = max(towards_sun_s, scene.camera.exposure_min_s)
    camera = scene.camera.model_copy(update={"exposure_max_s": min(longest_s, scene.camera.exposure_max_s)})
    return scene.model_copy(update={"camera": camera})


def exposure_factor(spec: SampleSpec) -> float:
    """Return the factor by which the exposure of a sample is longer, drawn from `camera.exposure_stops`."""
    low, high = spec.scene.camera.exposure_stops
    return float(2 ** (low + (high - low) * spec.rng("meter", "stops").random())) if low or high else 1.0


def exposure_s(scene: Scene, camera: Camera, truth: Truth, rate: Electrons) -> float:
    """Return the fixed or the metered exposure in s; `rate` are the electrons expected after one second."""
    fixed = scene.camera.exposure_s
    return metered_exposure_s(scene, camera, truth, rate) if fixed == "auto" else float(fixed)


def reference_exposure_s(scene: Scene, camera: Camera) -> float:
    """Return the exposure in s that puts ground whose normal is 45 degrees from the Sun at the metering level."""
    return _exposure_of_facet_s(scene, camera, *_AT_45_DEG)


def _exposure_of_facet_s(scene: Scene, camera: Camera, sun: Direction, view: Direction) -> float:
    """Return the exposure in s that puts a facet of the ground at the metering level.

    `sun` and `view` are the directions towards the Sun and the camera; the normal of the facet is z.
    """
    reflected = radiance_factor(assemble.ground_reflectance(scene), sun, view)[:, 0] / np.pi
    sunlight = ephemeris.sunlight(scene, np.array([0.0, 0.0, -1.0]))  # the direction does not matter
    facet = (reflected * sunlight.irradiance_W_m2_nm).astype(np.float32).reshape(-1, 1, 1)
    wavelength = ephemeris.wavelengths_nm(scene)
    per_second = rate_on_axis(camera, Radiance(array=facet, wavelength_nm=wavelength))
    facet_brightness = float(_brightness(per_second.array, per_second.white_e).max())
    return float(scene.camera.metering_level / max(facet_brightness, 1e-30))


def metered_exposure_s(scene: Scene, camera: Camera, truth: Truth, rate: Electrons) -> float:
    """Return the exposure in s that puts a percentile of the sunlit ground at the metering level, within limits."""
    # every second row and column is enough for a percentile
    body = truth.semantic[::2, ::2] == BODY
    return _metered_s(scene, camera, _brightness(rate.array[::2, ::2], rate.white_e)[body])


def foreseen_exposure_s(scene: Scene, camera: Camera, truth: Truth, view: View, radiance: Radiance) -> float:
    """Return `exposure_s` before the lens has imaged a radiance, with an error of a few percent.

    Each pixel takes the radiance that its chief ray meets. The lens's point spread and lateral colour are left out.
    """
    fixed = scene.camera.exposure_s
    if fixed != "auto":
        return float(fixed)
    position = view.pixel_map.pixel_of(camera.seen_directions[::2, ::2])
    column = np.clip(position[..., 0].astype(np.intp), 0, view.width_px - 1)
    row = np.clip(position[..., 1].astype(np.intp), 0, view.height_px - 1)
    body = truth.semantic[::2, ::2] == BODY
    seen = radiance.array.reshape(len(radiance.array), -1)[:, (row * view.width_px + column)[body]]
    rate = rate_on_axis(camera, Radiance(array=seen[:, None], wavelength_nm=radiance.wavelength_nm))
    brightness = _brightness(rate.array, rate.white_e)[0]
    if camera.lens.real is not None:
        y, x = (
            np.abs(np.arange(0, n, 2) + 0.5 - n / 2) / camera.focal_length_px
            for n in (camera.height_px, camera.width_px)
        )
        brightness = brightness * camera.lens.real.relative_illumination(np.hypot(x[None, :], y[:, None])[body])
    return _metered_s(scene, camera, brightness)


def _metered_s(scene: Scene, camera: Camera, brightness: NDArray[np.float32]) -> float:
    """Return the metered exposure in s from the brightness of ground after one second, float32[pixel]."""
    settings = scene.camera
    reference = reference_exposure_s(scene, camera)
    brightness = brightness[brightness > 0.02 / reference]  # sunlit: above a fiftieth of the reference facet
    exposure = reference
    if len(brightness) >= 64:
        metered = settings.metering_level / float(np.percentile(brightness, settings.metering_percentile))
        low, high = _METERING_RANGE
        shortest = min(low * reference, _exposure_of_facet_s(scene, camera, *_AT_ZERO_PHASE))
        exposure = float(np.clip(metered, shortest, high * reference))
    return float(np.clip(exposure, settings.exposure_min_s, settings.exposure_max_s))


def rate_on_axis(camera: Camera, radiance: Radiance) -> Electrons:
    """Return the electrons expected after one second of radiance of any shape, as if all of it were on the axis."""
    return camera.detector.electrons_expected(camera.lens.on_axis(radiance), 1.0)


def _brightness(electrons: NDArray[np.float32], white_e: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the greatest of a pixel's channels as a fraction of white, float32[y, x]."""
    return np.asarray(reduce(np.maximum, np.moveaxis(electrons / white_e, -1, 0)))


# --- stars --------------------------------------------------------------------------------------------------


def add_stars(spec: SampleSpec, pose: Pose, rendering: Rendering, exposure: SceneExposure) -> SceneExposure:
    """Add the stars that the exposure can show. They are added after metering, so they do not affect it."""
    if rendering.open_sky is None:
        return exposure
    camera, open_sky = exposure.camera, rendering.open_sky

    def starry() -> tuple[SceneLight, Electrons]:
        T_from_L = spec.terrain.site.T_from_L
        T_from_J = ephemeris.target_attitude(spec.scene, T_from_L @ pose.sun_L)
        J_from_C = T_from_J.T @ T_from_L @ pose.L_from_C
        starless = exposure.light.rendered
        view = rendering.scene.view
        rate_C_rad_s = _sky_rate_C_rad_s(spec, view)
        turned = [J_from_C @ turn for turn in _sky_turns(rate_C_rad_s, view, camera.exposure_s)]
        lines = None
        if view.motion is not None and view.motion.line_s.any():
            lines = view.motion.line_s[:, None] * rate_C_rad_s
        stars = assemble.visible_stars(spec.scene, starless, camera, turned, open_sky, view, lines)
        if stars is None:
            return exposure.light, exposure.rate
        light = SceneLight(lens=exposure.light.lens, rendered=stars.added_to(starless))
        return light, _rate_with(stars, exposure, light.rendered)

    # read noise and exposure decide which stars are faint enough to be left out
    light, rate = rendering.shared.once("stars", (camera.optics, camera.detector.read_noise_e_rms), starry)
    return replace(exposure, light=light, rate=rate)


def _sky_rate_C_rad_s(spec: SampleSpec, view: View) -> F64:
    """Return how the camera turns against the stars, float64[3] in C; the body itself turns about +z of T."""
    if view.motion is None or spec.flown is None:
        return np.zeros(3)
    spin_T = np.array([0, 0, 2 * np.pi / spec.terrain.body.rotation_period_s])
    return view.motion.rate_C_rad_s + spec.flown.T_from_C.T @ spin_T


def _sky_turns(rate_C_rad_s: F64, view: View, exposure_s: float) -> list[F64]:
    """Return the camera's axes at times of an exposure against the stars, float64[3, 3], in those of its middle."""
    px = float(np.linalg.norm(rate_C_rad_s)) * exposure_s * max(view.intrinsics[:2])
    count = min(int(np.ceil(_STAR_STEPS_PER_PX * px)) + 1, _MOST_STAR_STEPS)
    times_s = ((np.arange(count) + 0.5) / count - 0.5) * exposure_s
    return list(Rotation.from_rotvec(times_s[:, None] * rate_C_rad_s).as_matrix())


def _rate_with(stars: StarRadiance, exposure: SceneExposure, starry: Radiance) -> Electrons:
    """Return the electrons expected after one second of a radiance that contains the stars."""
    camera: Camera = exposure.camera
    if camera.lens.real is None:
        return camera.expose(starry, 1.0)
    # a lens with surfaces spreads light over few pixels, so that most of the stars' own image is dark and quick
    array = np.zeros(starry.array.shape, np.float32)  # pages that stay empty take no memory
    array[:, stars.rows, stars.columns] = stars.radiance
    own = camera.expose(Radiance(array=array, wavelength_nm=starry.wavelength_nm), 1.0)
    return replace(exposure.rate, array=exposure.rate.array + own.array)
