"""Add up all light of a scene."""

from __future__ import annotations

from dataclasses import replace

from ..core.quantities import Radiance, Truth
from .bounces import indirect
from .description import RenderInput
from .layers import truth
from .light import direct
from .surface import TerrainMesh
from .unresolved import close_up


def radiance(surface: TerrainMesh, scene: RenderInput, guide: Truth | None = None) -> Radiance:
    """Return the radiance per band at the camera, box-filtered over each pixel.

    `guide` is the `truth` of the view, which light between surfaces needs; it is computed if it is not given.
    """
    near = close_up(surface, scene.view) if scene.shows_ground else None
    if near is not None:
        body = near.light(radiance(near.ground, near.seen_in(scene)))
        image = radiance(surface, replace(scene, shows_ground=False), guide)
        return replace(image, array=body.added_to(image.array), fine=body)
    image = direct(surface, scene)
    if not scene.bounces:
        return image
    guide = truth(surface, scene.view, scene.sun) if guide is None else guide
    return image.with_array(image.array + indirect(surface, scene, guide))
