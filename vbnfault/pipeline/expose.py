"""Compute the light on the sensor before any fault: render a sample and set its exposure.

Both belong together: the number of samples per pixel depends on the sensor's noise at the metered exposure.
"""

from __future__ import annotations

from dataclasses import replace
from functools import reduce

import cv2
import numpy as np
from numpy.typing import NDArray

from ..camera import Camera
from ..core.quantities import BODY, SKY, Electrons, Radiance, Truth
from ..faults import FaultContext
from ..reflectance import radiance_factor
from ..render.description import RenderInput, View
from ..scene.config import Scene
from ..world import assemble
from .spec import Frame

F64 = NDArray[np.float64]

# The metered exposure stays within these factors of the exposure for a facet lit at 45 degrees. So a small area of
# grazing light does not make the whole frame noisy.
_METERING_RANGE = (0.25, 8.0)
# Fraction of the full well above which a pixel counts as lit when sampling noise is measured.
_LIT = 0.01
# Fraction of the lit pixels that may keep more sampling noise than the scene allows.
_FEW = 0.01
_ANGLE_LAYERS = {"incidence_deg", "emission_deg", "phase_deg", "albedo"}


# --- render ------------------------------------------------------------------------------------------------


def describe(frame: Frame) -> RenderInput:
    """Return the sample as the renderer's input."""
    spec, camera = frame.spec, frame.camera
    scene = spec.scene
    guard_x, guard_y = camera.lens.guard_px
    view = View(
        position_L_m=frame.pose.position_L_m,
        L_from_C=frame.pose.L_from_C,
        intrinsics=camera.intrinsics + np.array([0, 0, guard_x, guard_y]),
        width_px=camera.width_px + 2 * guard_x,
        height_px=camera.height_px + 2 * guard_y,
        aperture_radius_m=camera.lens.aperture_radius_m,
        focus_distance_m=camera.lens.focus_distance_m,
    )
    wavelength = assemble.wavelengths_nm(scene)
    return RenderInput(
        view=view,
        sun=frame.sunlight,
        wavelength_nm=wavelength,
        reflectance=assemble.ground_reflectance(scene),
        dust_contrast=assemble.dust_contrast(scene),
        bounces=scene.render.bounces,
        samples_per_pixel=scene.render.samples_per_pixel,
        key=int(spec.rng("render", "jitter").integers(2**32)),
    )


def render_frame(frame: Frame) -> None:
    """Render the radiance of every band, and the truth layers.

    The renderer has pinhole cameras only. With a lens prescription, `frame.rendered` is its output with a guard
    band. `frame.radiance` is the same light on the grid of the image: distorted, but without losses or blur. Truth
    follows the chief rays of the pixel centres.
    """
    from .. import render

    spec, i = frame.spec, frame.spec.index
    frame.camera = assemble.base_camera(
        spec.scene,
        architecture=int(spec.plan.architecture[i]),
        readout_direction=int(spec.plan.readout_direction[i]),
        individual=int(spec.plan.individual[i]),
    )
    frame.sunlight = assemble.sunlight(spec.scene, frame.pose.sun_L)
    frame.samples_per_pixel = float(spec.scene.render.samples_per_pixel)
    scene = describe(frame)
    surface = spec.terrain.surface
    angles = bool(_ANGLE_LAYERS & set(spec.scene.dataset.layers))
    guide: Truth | None
    if frame.camera.lens.resamples:
        camera = frame.camera
        frame.truth = render.truth(
            surface,
            scene.view,
            scene.sun,
            angles=angles,
            slopes=camera.seen_slopes,
            projection=camera.projection,
        )
        # light between surfaces and stars need truth on the render's own grid
        needed = scene.bounces or spec.scene.sky.stars != "off"
        guide = render.truth(surface, scene.view, scene.sun) if needed else None
        frame.open_sky = None if guide is None else guide.semantic == SKY
    else:
        frame.truth = guide = render.truth(surface, scene.view, scene.sun, angles=angles)
    if spec.scene.render.noise_fraction is None:
        _keep(frame, render.radiance(surface, scene, guide))
    else:
        _render_to_the_noise(frame, scene, guide, spec.scene.render.noise_fraction)


def _keep(frame: Frame, radiance: Radiance) -> None:
    """Store the rendered radiance on the lens's grid, and the same radiance on the image's grid."""
    lens = frame.camera.lens
    if lens.resamples:
        frame.rendered, radiance = radiance, lens.on_frame(radiance)
    frame.radiance = radiance


def _render_to_the_noise(frame: Frame, scene: RenderInput, guide: Truth | None, fraction: float) -> None:
    """Render with more samples where sampling noise would show: above `fraction` of the sensor's own noise.

    The error of a pixel comes from two halves of its samples, averaged over 3×3 pixels. Pixels with a large error
    are rendered again with four times as many samples. This is repeated until at most 1 % of the lit pixels are
    left, or the scene's limit is reached. All of it follows from scene and sample, so the result does not depend on
    how a build runs.
    """
    from .. import render

    surface, settings = frame.spec.terrain.surface, frame.spec.scene.render
    lens_and_sensor = green_per_second(frame)
    found, halves = render.direct(surface, scene, lens_and_sensor)
    array = found.array.copy()
    once_more = (
        np.zeros_like(array) if guide is None or not scene.bounces else render.indirect(surface, scene, guide)
    )
    whole = found.with_array(array + once_more)
    exposure = _exposure_s(frame, _rate(frame, whole).merged)
    error_e = np.abs(halves) * exposure
    signal_e = np.einsum("b,byx->yx", lens_and_sensor * exposure, whole.array)
    detector = frame.camera.detector
    sensor_e2 = signal_e + detector.dark_current_e_s * exposure + detector.read_noise_e_rms**2
    # dark pixels and saturated pixels do not show this noise; saturated pixels still count as lit
    lit = signal_e > _LIT * detector.full_well_e
    shows = lit & (signal_e - 4 * error_e < detector.full_well_e)
    worth = cv2.dilate(shows.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    spent = np.full(error_e.shape, scene.samples_per_pixel, dtype=np.int32)
    while True:
        # scale the variance of the nine pixels to the number of samples of the central one: along an edge the
        # variance falls as this number^-3/2
        each = np.where(worth, error_e**2 / sensor_e2, 0) * spent**1.5
        share = np.sqrt(np.maximum(cv2.blur(each, (3, 3)), 0) / spent**1.5)
        noisy = (share > fraction) & worth & (4 * spent <= settings.max_samples_per_pixel)
        share[~shows] = 0
        if np.count_nonzero(share[lit] > fraction) <= _FEW * np.count_nonzero(lit) or not noisy.any():
            break
        for samples in np.unique(spent[noisy]):
            chosen = np.flatnonzero(noisy & (spent == samples)).astype(np.uint32)
            # draw new samples: the first ones selected the pixel, so keeping them would be a bias
            key = (scene.key + 4 * int(samples)) & 0xFFFFFFFF
            again = replace(scene, samples_per_pixel=4 * int(samples), key=key)
            more, halves = render.direct(surface, again, lens_and_sensor, chosen)
            array.reshape(len(array), -1)[:, chosen] = more.array[:, 0]
            error_e.ravel()[chosen] = np.abs(halves[0]) * exposure
        spent[noisy] *= 4
    # the Sun's own part depends on no rays, so the first one holds
    _keep(frame, replace(found, array=array + once_more))
    frame.samples_per_pixel = float(spent.mean())
    frame.noise_fraction_p99 = float(np.percentile(share[lit], 99)) if lit.any() else 0.0


def green_per_second(frame: Frame) -> F64:
    """Return electrons per second of the green pixels for unit radiance in each band, float64[band]."""
    nodes = assemble.wavelengths_nm(frame.spec.scene)
    unit = Radiance(array=np.eye(len(nodes), dtype=np.float32)[:, :, None], wavelength_nm=nodes)
    return np.asarray(_rate_on_axis(frame.camera, unit).array[:, 0, 1], dtype=np.float64)


# --- meter -------------------------------------------------------------------------------------------------


def meter(frame: Frame) -> None:
    """Set the exposure: fixed, or metered once on the noise-free, fault-free frame. All twins share it.

    This stage also adds the stars and makes the context of the faults.
    """
    _expose(frame)
    frame.camera = replace(frame.camera, exposure_s=_exposure_s(frame, frame.rate))
    _add_stars(frame)
    direction_C = frame.pose.L_from_C.T @ frame.pose.sun_L
    frame.context = FaultContext(
        camera=frame.camera,
        sun_xy_px=frame.camera.project(direction_C),
        sun_direction_C=direction_C,
        sun_irradiance_W_m2_nm=frame.sunlight.irradiance_W_m2_nm,
        wavelength_nm=frame.radiance.wavelength_nm,
        sun_angular_radius_rad=frame.sunlight.angular_radius_rad,
        sun_visible_fraction=frame.pose.sun_visible_fraction,
    )


def _exposure_s(frame: Frame, rate: Electrons) -> float:
    """Return the fixed or the metered exposure in s."""
    fixed = frame.spec.scene.camera.exposure_s
    return _metered_exposure_s(frame, rate) if fixed == "auto" else float(fixed)


def _add_stars(frame: Frame) -> None:
    """Add the stars. This comes after metering, so that stars do not affect the exposure."""
    scene, truth = frame.spec.scene, frame.truth
    if scene.sky.stars == "off":
        return
    T_from_L = frame.spec.terrain.site.T_from_L
    T_from_J = assemble.target_attitude(scene, T_from_L @ frame.pose.sun_L)
    J_from_C = T_from_J.T @ T_from_L @ frame.pose.L_from_C
    before = frame.imaged
    if frame.open_sky is None:
        starry = assemble.with_stars(scene, before, frame.camera, J_from_C, truth.semantic == SKY)
    else:
        starry = assemble.with_stars(scene, before, frame.camera, J_from_C, frame.open_sky, describe(frame).view)
    if starry is not before:
        _keep(frame, starry)
        _expose(frame)


def reference_exposure_s(scene: Scene, camera: Camera) -> float:
    """Return the exposure in s that puts ground whose normal is 45 degrees from the Sun at the metering level."""
    half = np.sqrt(0.5)
    lit = radiance_factor(assemble.ground_reflectance(scene), [0, half, half], [half, 0, half])[:, 0] / np.pi
    sunlight = assemble.sunlight(scene, np.array([0.0, 0.0, -1.0]))  # the direction does not matter
    facet = (lit * sunlight.irradiance_W_m2_nm).astype(np.float32).reshape(-1, 1, 1)
    wavelength = assemble.wavelengths_nm(scene)
    per_second = _rate_on_axis(camera, Radiance(array=facet, wavelength_nm=wavelength))
    facet_brightness = float(_brightness(per_second.array, per_second.white_e).max())
    return float(scene.camera.metering_level / max(facet_brightness, 1e-30))


def _metered_exposure_s(frame: Frame, rate: Electrons) -> float:
    """Return the exposure in s that puts a percentile of the sunlit ground at the metering level, within limits."""
    settings = frame.spec.scene.camera
    reference = reference_exposure_s(frame.spec.scene, frame.camera)
    # every second row and column is enough for a percentile
    body = frame.truth.semantic[::2, ::2] == BODY
    shown = _brightness(rate.array[::2, ::2], rate.white_e)[body]
    shown = shown[shown > 0.02 / reference]  # sunlit: above a fiftieth of the reference facet
    exposure = reference
    if len(shown) >= 64:
        metered = settings.metering_level / float(np.percentile(shown, settings.metering_percentile))
        low, high = _METERING_RANGE
        exposure = float(np.clip(metered, low * reference, high * reference))
    return float(np.clip(exposure, settings.exposure_min_s, settings.exposure_max_s))


def _brightness(electrons: NDArray[np.float32], white_e: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the greatest of a pixel's channels as a fraction of white, float32[y, x]."""
    return np.asarray(reduce(np.maximum, np.moveaxis(electrons / white_e, -1, 0)))


def _expose(frame: Frame) -> None:
    """Store the electrons expected after one second of the imaged radiance, merged and with the Sun's apart."""
    found = _rate(frame, frame.imaged)
    frame.rate, frame.rate_apart = found.merged, None if found.past_rims is None else found


def _rate(frame: Frame, radiance: Radiance) -> Electrons:
    """Return the electrons expected after one second."""
    return frame.camera.expose(radiance, 1.0)


def _rate_on_axis(camera: Camera, radiance: Radiance) -> Electrons:
    """Return the electrons expected after one second of radiance of any shape, as if all of it were on the axis."""
    return camera.detector.electrons_expected(camera.lens.on_axis(radiance), 1.0)
