"""Render the view of a sample: the radiance of every band, and the truth layers."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.quantities import SKY, Radiance, Truth
from ..render.description import RenderInput, View
from ..world import assemble
from .coma import add_coma
from .exposure import exposure_s, rate_on_axis
from .spec import Pose, Rendering, SampleSpec, SceneLight

F64 = NDArray[np.float64]

# Fraction of the full well above which a pixel counts as lit when sampling noise is measured.
_LIT_FRACTION = 0.01
# Fraction of the lit pixels that may keep more sampling noise than the scene allows.
_NOISY_FRACTION = 0.01
_ANGLE_LAYERS = {"incidence_deg", "emission_deg", "phase_deg", "albedo"}


def describe(spec: SampleSpec, pose: Pose) -> RenderInput:
    """Return the view of a sample as the renderer's input."""
    scene, camera = spec.scene, spec.camera
    guard_x, guard_y = camera.lens.guard_px
    view = View(
        position_L_m=pose.position_L_m,
        L_from_C=pose.L_from_C,
        intrinsics=camera.intrinsics + np.array([0, 0, guard_x, guard_y]),
        width_px=camera.width_px + 2 * guard_x,
        height_px=camera.height_px + 2 * guard_y,
        aperture_radius_m=camera.lens.aperture_radius_m,
        focus_distance_m=camera.lens.focus_distance_m,
    )
    return RenderInput(
        view=view,
        sun=assemble.sunlight(scene, pose.sun_L),
        wavelength_nm=assemble.wavelengths_nm(scene),
        reflectance=assemble.ground_reflectance(scene),
        dust_contrast=assemble.dust_contrast(scene),
        bounces=scene.render.bounces,
        samples_per_pixel=scene.render.samples_per_pixel,
        key=int(spec.rng("render", "jitter").integers(2**32)),
    )


def render_view(spec: SampleSpec, pose: Pose) -> Rendering:
    """Render the radiance of every band, and the truth layers.

    The renderer has pinhole cameras only. With a lens prescription it therefore renders a guard band around the
    image. Truth follows the chief rays of the pixel centres.
    """
    from .. import render

    camera, scene, surface = spec.camera, describe(spec, pose), spec.terrain.surface
    angles = bool(_ANGLE_LAYERS & set(spec.scene.dataset.layers))
    stars = spec.scene.sky.stars != "off"
    has_coma = spec.scene.coma is not None
    guide: Truth | None  # truth on the grid of the render, which bounces, stars and a coma need
    if camera.lens.resamples:
        truth = render.truth(
            surface,
            scene.view,
            scene.sun,
            angles=angles,
            slopes=camera.seen_slopes,
            projection=camera.projection,
        )
        needed = scene.bounces or stars or has_coma
        guide = render.truth(surface, scene.view, scene.sun) if needed else None
    else:
        truth = guide = render.truth(surface, scene.view, scene.sun, angles=angles)
    if spec.scene.render.noise_fraction is None:
        sampled = SampledRadiance(
            radiance=render.radiance(surface, scene, guide), samples_per_pixel=float(scene.samples_per_pixel)
        )
    else:
        sampled = sample_to_noise(spec, scene, truth, guide, spec.scene.render.noise_fraction)
    rendered = sampled.radiance
    if has_coma and guide is not None:
        rendered = add_coma(spec, pose, scene, guide, rendered)
    return Rendering(
        scene=scene,
        light=SceneLight(lens=camera.lens, rendered=rendered),
        truth=truth,
        open_sky=guide.semantic == SKY if stars and guide is not None else None,
        samples_per_pixel=sampled.samples_per_pixel,
        noise_fraction_p99=sampled.noise_fraction_p99,
    )


# --- number of samples from the noise ------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True, eq=False)
class SampledRadiance:
    """Hold a rendered radiance with its number of samples and its noise, as in `Rendering`."""

    radiance: Radiance
    samples_per_pixel: float
    noise_fraction_p99: float = float("nan")


def sample_to_noise(
    spec: SampleSpec, scene: RenderInput, truth: Truth, guide: Truth | None, fraction: float
) -> SampledRadiance:
    """Render with more samples where sampling noise would show: above `fraction` of the sensor's own noise.

    The error of a pixel comes from two halves of its samples, averaged over 3×3 pixels. Pixels with a large error
    are rendered again with four times as many samples. This is repeated until at most 1 % of the lit pixels are
    left, or the scene's limit is reached. All of it follows from scene and sample, so the result does not depend on
    how a build runs.
    """
    from .. import render

    camera, surface, settings = spec.camera, spec.terrain.surface, spec.scene.render
    electron_rate = green_per_second(spec)
    first, halves = render.direct(surface, scene, electron_rate)
    array = first.array.copy()
    indirect = (
        np.zeros_like(array) if guide is None or not scene.bounces else render.indirect(surface, scene, guide)
    )
    whole = first.with_array(array + indirect)
    exposure = exposure_s(spec.scene, camera, truth, camera.expose(whole, 1.0).merged)
    error_e = np.abs(halves) * exposure
    signal_e = np.einsum("b,byx->yx", electron_rate * exposure, whole.array)
    detector = camera.detector
    sensor_variance_e2 = signal_e + detector.dark_current_e_s * exposure + detector.read_noise_e_rms**2
    # dark pixels and saturated pixels do not show this noise; saturated pixels still count as lit
    lit = signal_e > _LIT_FRACTION * detector.full_well_e
    shows = lit & (signal_e - 4 * error_e < detector.full_well_e)
    near = cv2.dilate(shows.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    samples = np.full(error_e.shape, scene.samples_per_pixel, dtype=np.int32)
    while True:
        # scale the variance of the nine pixels to the number of samples of the central one: along an edge the
        # variance falls as this number^-3/2
        variance = np.where(near, error_e**2 / sensor_variance_e2, 0) * samples**1.5
        noise = np.sqrt(np.maximum(cv2.blur(variance, (3, 3)), 0) / samples**1.5)
        noisy = (noise > fraction) & near & (4 * samples <= settings.max_samples_per_pixel)
        noise[~shows] = 0
        few = np.count_nonzero(noise[lit] > fraction) <= _NOISY_FRACTION * np.count_nonzero(lit)
        if few or not noisy.any():
            break
        for count in np.unique(samples[noisy]):
            chosen = np.flatnonzero(noisy & (samples == count)).astype(np.uint32)
            # draw new samples: the first ones selected the pixel, so keeping them would be a bias
            key = (scene.key + 4 * int(count)) & 0xFFFFFFFF
            again = replace(scene, samples_per_pixel=4 * int(count), key=key)
            more, halves = render.direct(surface, again, electron_rate, chosen, first)
            array.reshape(len(array), -1)[:, chosen] = more.array[:, 0]
            error_e.ravel()[chosen] = np.abs(halves[0]) * exposure
        samples[noisy] *= 4
    return SampledRadiance(
        # the Sun's own part depends on no rays, so the first one holds
        radiance=replace(first, array=array + indirect),
        samples_per_pixel=float(samples.mean()),
        noise_fraction_p99=float(np.percentile(noise[lit], 99)) if lit.any() else 0.0,
    )


def green_per_second(spec: SampleSpec) -> F64:
    """Return electrons per second of the green pixels for unit radiance in each band, float64[band]."""
    nodes = assemble.wavelengths_nm(spec.scene)
    unit = Radiance(array=np.eye(len(nodes), dtype=np.float32)[:, :, None], wavelength_nm=nodes)
    return np.asarray(rate_on_axis(spec.camera, unit).array[:, 0, 1], dtype=np.float64)
