"""Add the stars that the exposure of a sample can show."""

from __future__ import annotations

from dataclasses import replace

from ..world import assemble
from .spec import Pose, Rendering, SampleSpec, SceneExposure, SceneLight


def add_stars(spec: SampleSpec, pose: Pose, rendering: Rendering, exposure: SceneExposure) -> SceneExposure:
    """Add the stars that the exposure can show. They are added after metering, so they do not affect it."""
    if rendering.open_sky is None:
        return exposure
    T_from_L = spec.terrain.site.T_from_L
    T_from_J = assemble.target_attitude(spec.scene, T_from_L @ pose.sun_L)
    J_from_C = T_from_J.T @ T_from_L @ pose.L_from_C
    starless = exposure.light.rendered
    starry = assemble.with_stars(
        spec.scene, starless, exposure.camera, J_from_C, rendering.open_sky, rendering.scene.view
    )
    if starry is starless:
        return exposure
    light = SceneLight(lens=exposure.light.lens, rendered=starry)
    return replace(exposure, light=light, rate=exposure.camera.expose(starry, 1.0))
