"""Add up all light of a scene."""

from __future__ import annotations

from dataclasses import replace

from ..core.fine_light import FineLight
from ..core.quantities import Radiance, Truth
from .bounces import indirect
from .description import RenderInput
from .facets import thin_parts
from .layers import truth
from .light import direct
from .surface import TerrainMesh
from .unresolved import close_up


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
