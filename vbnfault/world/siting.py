"""Choose sites for the Suns that Sun-facing samples see there.

A Sun below the horizon is seen where the ground falls away towards it. With `plan.unusable_views = "exchange"`
the Suns of a site come from one sector of azimuth (`scene.exchange`). Each site is the best of several random
positions: the one from which most of its Suns are seen, over the shape model, from the positions drawn for them.
"""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..body import Body, Site, Sites, choose_sites
from ..core import frames
from ..scene.config import Scene
from ..scene.plan import Plan
from .ground import shape_model

if TYPE_CHECKING:
    from ..render import TerrainMesh

F64 = NDArray[np.float64]

# Random positions compared for a site. On the packaged shape of 67P, 53 % of the paper's Suns are seen at a random
# site, and 95 % from the best of 64.
_CANDIDATES = 64
_MOST_SUNS = 32  # of a site that are tried, each from all of their camera positions
_START_M = 300.0  # height above the site from which the ground below a camera is looked for


def sites_for_suns(scene: Scene, body: Body, plan: Plan) -> Sites:
    """Return the sites of a plan whose samples keep their Suns. Each is chosen when it is first used."""
    count = scene.dataset.sites
    candidates = choose_sites(body, count * _CANDIDATES, scene.dataset.seed)
    model = cache(lambda: shape_model(body))

    def make(index: int) -> Site:
        suns = plan.suns_of_site(index)
        if not len(suns):
            return candidates[index]
        suns = suns[np.linspace(0, len(suns) - 1, min(len(suns), _MOST_SUNS)).astype(int)]
        drawn = {name: values[suns] for name, values in plan.variables.items()}
        mine = [candidates[index + k * count] for k in range(_CANDIDATES)]
        best = mine[int(np.argmax([suns_seen(scene, model(), site, drawn).sum() for site in mine]))]
        return Site(index=index, position_T_m=best.position_T_m, T_from_L=best.T_from_L)

    return Sites(count, make)


def suns_seen(scene: Scene, model: TerrainMesh, site: Site, drawn: dict[str, F64]) -> NDArray[np.bool_]:
    """Return which Suns are seen at a site, over the shape model `model` in T, bool[position, Sun].

    `drawn` holds the values of n views, float64[n] each, by the names of `plan.VARIABLES`.
    """
    from .. import render

    x, y, height = (drawn[name] for name in ("x_m", "y_m", "height_m"))
    angles = zip(drawn["sun_azimuth_deg"], drawn["sun_elevation_deg"], strict=True)
    suns_T = np.stack([frames.direction_L(*pair) for pair in angles]) @ site.T_from_L.T
    down_T = np.broadcast_to(site.T_from_L[:, 2], (len(x), 3))
    level_T = site.position_T_m + np.column_stack([x, y, np.zeros(len(x))]) @ site.T_from_L.T
    if scene.geometry.height_reference == "local_ground":
        ground_m = _START_M - render.first_hit_m(model, level_T - _START_M * down_T, down_T)
        height = height + np.where(np.isfinite(ground_m), ground_m, 0.0)
    camera_T = level_T - height[:, None] * down_T
    seen = np.isinf(
        render.first_hit_m(model, np.repeat(camera_T, len(suns_T), axis=0), np.tile(suns_T, (len(x), 1)))
    )
    return seen.reshape(len(x), len(suns_T))
