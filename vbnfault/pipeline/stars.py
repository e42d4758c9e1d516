"""Add the stars that the exposure of a sample can show."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..camera import Camera
from ..core.quantities import Electrons, Radiance
from ..world import assemble
from ..world.sky import StarRadiance
from .spec import Pose, Rendering, SampleSpec, SceneExposure, SceneLight


def add_stars(spec: SampleSpec, pose: Pose, rendering: Rendering, exposure: SceneExposure) -> SceneExposure:
    """Add the stars that the exposure can show. They are added after metering, so they do not affect it."""
    if rendering.open_sky is None:
        return exposure
    camera, open_sky = exposure.camera, rendering.open_sky

    def starry() -> tuple[SceneLight, Electrons]:
        T_from_L = spec.terrain.site.T_from_L
        T_from_J = assemble.target_attitude(spec.scene, T_from_L @ pose.sun_L)
        J_from_C = T_from_J.T @ T_from_L @ pose.L_from_C
        starless = exposure.light.rendered
        stars = assemble.visible_stars(spec.scene, starless, camera, J_from_C, open_sky, rendering.scene.view)
        if stars is None:
            return exposure.light, exposure.rate
        light = SceneLight(lens=exposure.light.lens, rendered=stars.added_to(starless))
        return light, _rate_with(stars, exposure, light.rendered)

    # read noise and exposure decide which stars are faint enough to be left out
    light, rate = rendering.shared.once("stars", (camera.optics, camera.detector.read_noise_e_rms), starry)
    return replace(exposure, light=light, rate=rate)


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
