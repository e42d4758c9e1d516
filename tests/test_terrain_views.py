"""Terrain from 200 random views: closed from wherever the camera is, no look behind the ground."""

from __future__ import annotations

import numpy as np
import pytest
from conftest import small_scene

from vbnfault import render
from vbnfault.core import frames
from vbnfault.pipeline import Session
from vbnfault.pipeline.spec import Terrain
from vbnfault.render.description import View
from vbnfault.render.runtime import dr
from vbnfault.render.sampling import Optics
from vbnfault.scene import config

VIEWS, SIDE = 200, 48


@pytest.fixture(scope="module")
def terrain() -> tuple[Terrain, np.ndarray]:
    """A patch whose facets grow from 2 m to the model's own, and the geometric normals of its facets."""
    table = small_scene(patch={"facet_m": 2.0, "radius_m": 30.0, "min_boulder_m": 2.0})
    session = Session(config.parse_scene(table, source="test"))
    patch = session.patch(session.sites[1])
    a, b, c = (patch.vertices_L_m[patch.faces[:, k]].astype(np.float64) for k in range(3))
    normal = np.cross(b - a, c - a)
    return session.terrain(1), normal / np.maximum(np.linalg.norm(normal, axis=1), 1e-30)[:, None]


def test_no_ray_ever_sees_the_inside(terrain: tuple[Terrain, np.ndarray]) -> None:
    ground, normals = terrain
    rng = np.random.default_rng(7)
    x, y = rng.uniform(-150, 150, size=(2, VIEWS))
    height = render.ground_height_m(ground.surface, x, y, 500.0) + rng.uniform(0.5, 100, VIEWS)
    position = np.column_stack([x, y, -height])
    clear = render.is_clear(ground.surface, position, 0.5)
    f = SIDE / 2 / np.tan(np.radians(32.5))
    seen = behind = 0
    for k in np.flatnonzero(clear):
        down = frames.direction_L(0, -90)
        axes = frames.L_from_C(down, *rng.uniform(-120, 120, 2), rng.uniform(0, 360))
        view = View(
            position_L_m=position[k],
            L_from_C=axes,
            intrinsics=np.array([f, f, SIDE / 2, SIDE / 2]),
            width_px=SIDE,
            height_px=SIDE,
        )
        rays = Optics(view).centre_rays()
        found = ground.surface.scene.ray_intersect_preliminary(rays, coherent=True)
        dr.eval(found, rays)
        valid = found.is_valid().numpy().astype(bool)
        away = np.array(rays.d).reshape(3, -1).T[valid]
        facing = np.einsum("ni,ni->n", normals[found.prim_index.numpy()[valid]], away)
        seen += valid.sum()
        # a facet seen edge-on within float32 rounding may fall on either side
        behind += np.count_nonzero(facing > 1e-4)
    assert clear.sum() > 0.8 * VIEWS
    assert seen > 50_000
    assert behind == 0
