"""Add up all light of a scene."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..core.quantities import FineLight, Radiance, Truth
from ..reflectance.disc import Lambert
from .bounces import indirect
from .description import RenderInput, Sunlight, View
from .layers import truth
from .light import direct
from .surface import TerrainMesh
from .unresolved import close_up, thin_parts


def radiance(
    surface: TerrainMesh, scene: RenderInput, guide: Truth | None = None, body: FineLight | None = None
) -> Radiance:
    """Return the radiance per band at the camera, box-filtered over each pixel.

    `guide` is the `truth` of the view, which light between surfaces needs; it is computed if it is not given.
    `body` is the light of a body of few pixels, if the scene does not show the ground.
    """
    near = close_up(surface, scene.view) if scene.shows_ground else None
    if near is not None:
        body, scene = near.light(radiance(near.ground, near.seen_in(scene))), replace(scene, shows_ground=False)
    image = direct(surface, scene)
    if scene.bounces:
        guide = truth(surface, scene.view, scene.sun) if guide is None else guide
        image = image.with_array(image.array + indirect(surface, scene, guide))
    parts = thin_parts(surface, scene)
    fine = body if parts is None else parts.joined(body)
    return image if fine is None else replace(image, array=fine.added_to(image.array), fine=fine)


def self_test() -> str:
    """Render a Lambert square that faces the Sun and return a sentence that compares its radiance with ρE/π."""
    square = np.array([[-9, -9, 0], [9, -9, 0], [9, 9, 0], [-9, 9, 0]], dtype=np.float32)
    faces = np.array([[0, 2, 1], [0, 3, 2]], dtype=np.int32)
    up = np.array([0.0, 0.0, -1.0])
    sun = Sunlight(direction_L=up, angular_radius_rad=0.005, irradiance_W_m2_nm=np.array([1.5]))
    view = View(
        position_L_m=5 * up,
        L_from_C=np.eye(3),
        intrinsics=np.array([16.0, 16, 8, 8]),
        width_px=16,
        height_px=16,
    )
    scene = RenderInput(
        view=view,
        sun=sun,
        wavelength_nm=np.array([550.0]),
        reflectance=Lambert().at(np.array([550.0]), np.array([0.06])),
        samples_per_pixel=4,
        key=0,
    )
    got = float(radiance(TerrainMesh(square, faces, np.ones(2, dtype=bool)), scene).array.mean())
    want = 0.06 * 1.5 / np.pi
    verdict = "as it should be" if abs(got / want - 1) < 1e-3 else "WRONG"
    return f"radiance {got:.6f} W m-2 sr-1 nm-1, expected {want:.6f}: {verdict}"
