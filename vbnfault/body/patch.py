"""Build the terrain: the whole body as one closed mesh, refined and roughened around a site, with boulders on it.

The facets of the global model are tens of metres wide. A camera within a hundred metres of the ground needs relief
down to its pixels. Three steps provide it:

1. `refine` splits the edges near the site until they meet a target length. New points lie on the curved surface
   that the model's points and normals suggest.
2. `relief` adds heights along the normal. Their spectrum continues that of the model below its facets.
3. `boulders` sets boulders, which are closed meshes of their own, partly into the ground.

The fields of the relief are functions of body-fixed position and seed, so that neighbouring sites see the same
ground.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..core.errors import InputError
from . import boulders as rocks
from .noise import Float32
from .refine import EdgeLimit, affordable, refine
from .relief import LONGEST_EDGES, add_relief
from .roughness import Roughness, mean_edge_m
from .shape import Int32, vertex_normals
from .sites import Site

if TYPE_CHECKING:
    from . import Body

_GROUND_SHARE = 0.66  # fraction of the triangles; the rest is left to the boulders
_BOULDER_STREAM = 0xB0D


@dataclass(frozen=True, kw_only=True, eq=False)
class Patch:
    """Hold the body's surface as built for one site.

    Attributes
    ----------
    site
        The site, which is the origin of the coordinates.
    vertices_L_m
        float32[n, 3], metres from the site, L axes (x north, y east, z down).
    faces
        int32[m, 3], outward winding: first the body, one closed surface, then the boulders, each closed.
    face_is_boulder
        bool[m].
    face_is_flat
        bool[m]: the face is shaded with its own normal (small boulders); the others are smooth.
    dust
        float32[n] in [0, 1] at each vertex: 1 where dust covers the ground, 0 on bare ground and boulders.
    boulder_diameter_m, boulder_position_L_m
        float32[k] largest diameter, and float32[k, 3] centre of each boulder.
    boulder_smallest_m
        float32[k]: smallest diameter for which the size law was drawn at the boulder's position.
    facet_m, radius_m
        Mean edge length of the ground within this distance of the site. Beyond, it grows as the distance to the
        power `GROWTH_POWER`.
    """

    site: Site
    vertices_L_m: Float32
    faces: Int32
    face_is_boulder: NDArray[np.bool_]
    face_is_flat: NDArray[np.bool_]
    dust: Float32
    boulder_diameter_m: Float32
    boulder_position_L_m: Float32
    boulder_smallest_m: Float32
    facet_m: float
    radius_m: float

    @property
    def triangles(self) -> int:
        """Return the number of triangles."""
        return len(self.faces)


def build_patch(
    body: Body,
    site: Site,
    *,
    seed: int,
    facet_m: float = 0.12,
    radius_m: float = 20.0,
    relief: float = 1.0,
    min_boulder_m: float = 0.25,
    max_triangles: int = 1_600_000,
    boulder_index: float = rocks.INDEX,
    boulders_per_km2: float = rocks.PER_KM2,
    craters_per_km2: float = 60.0,
    hurst: float | None = None,
) -> Patch:
    """Build the terrain around a site; the result is deterministic in body, site, seed and the other parameters.

    Parameters
    ----------
    seed
        Non-negative integer.
    facet_m
        Mean edge length within `radius_m` of the site, 0.05 to 1e6 m. Beyond, it grows as the distance to the power
        1.1 until it reaches the facets of the global model. It is increased if the ground alone would take more
        than 66 % of `max_triangles`.
    radius_m
        Radius around the site within which facets have that size, 1 to 1e8 m.
    relief
        Factor on the heights added to the model, 0 to 10; 0 leaves the interpolated model.
    min_boulder_m
        Diameter of the smallest boulder near the site, 0.05 to 1e6 m. It grows with the distance beyond 20 m, and
        where boulders would cover the ground.
    max_triangles
        Upper bound, at least twice the number of the model's faces. To keep it, the smallest boulders (in angle)
        are left out.
    boulder_index, boulders_per_km2
        The cumulative size law N(>= D) = boulders_per_km2 · (D / 7 m)^-boulder_index over the whole patch, with an
        index of 0.5 to 6 and a density of 0 to 1e5. Defaults: 67P (Pajola et al. 2015).
    craters_per_km2
        Number of pits and craters with a diameter of at least 10 m, 0 to 600. Diameters are 3 to 48 m with a
        cumulative index of 2.
    hurst
        Exponent of the roughness below the model's facets, 0.3 to 1.2. None: the exponent measured on the model.

    Raises
    ------
    InputError
        A parameter is out of its range.
    """
    for key, value, low, high in (
        ("facet_m", facet_m, 0.05, 1e6),
        ("radius_m", radius_m, 1.0, 1e8),
        ("relief", relief, 0.0, 10.0),
        ("min_boulder_m", min_boulder_m, 0.05, 1e6),
        ("boulder_index", boulder_index, 0.5, 6.0),
        ("boulders_per_km2", boulders_per_km2, 0.0, 1e5),
        ("craters_per_km2", craters_per_km2, 0.0, 600.0),
        ("hurst", 0.5 if hurst is None else hurst, 0.3, 1.2),
        ("seed", seed, 0, 2**63),
    ):
        if not low <= value <= high:
            raise InputError(f"patch: {key} must be from {low} to {high}; got {value}.")
    if max_triangles < 2 * len(body.faces):
        raise InputError(
            f"patch: max_triangles must be at least twice the model's {len(body.faces)} faces; got {max_triangles}."
        )

    model = (body.vertices_m - site.position_T_m, vertex_normals(body.vertices_m, body.faces), body.faces)
    limit = affordable(EdgeLimit(facet_m, radius_m), model, int(_GROUND_SHARE * max_triangles))
    points, normals, faces = refine(*model, limit)
    facet = limit.facet_at(points)
    measured, edge = _roughness(body)
    law = (
        measured
        if hurst is None
        else Roughness(deviation_m=measured.deviation_m, baseline_m=measured.baseline_m, hurst=hurst)
    )
    ground = add_relief(
        body,
        site,
        (points, normals, faces),
        facet,
        seed=seed,
        scale=relief,
        roughness=law,
        longest_m=LONGEST_EDGES * edge,
        craters_per_km2=craters_per_km2,
    )
    place = points + site.position_T_m
    points = points + ground.height_m[:, None] * normals
    points = np.einsum("ni,ij->nj", points, site.T_from_L)

    rng = np.random.Generator(np.random.Philox(np.random.SeedSequence((seed, _BOULDER_STREAM, site.index))))
    stones = rocks.add_boulders(
        points,
        faces,
        facet,
        ground.dust,
        ground.talus,
        place,
        rng=rng,
        seed=seed,
        min_boulder_m=min_boulder_m,
        per_km2=boulders_per_km2,
        index=boulder_index,
        budget=max_triangles - len(faces),
    )
    all_faces = np.concatenate([faces, stones.faces + np.int32(len(points))])
    return Patch(
        site=site,
        vertices_L_m=np.concatenate([points, stones.vertices_m]).astype(np.float32),
        faces=all_faces.astype(np.int32),
        face_is_boulder=np.arange(len(all_faces)) >= len(faces),
        face_is_flat=np.concatenate([np.zeros(len(faces), dtype=bool), stones.flat]),
        dust=np.concatenate([ground.dust, np.zeros(len(stones.vertices_m), dtype=np.float32)]),
        boulder_diameter_m=stones.diameter_m.astype(np.float32),
        boulder_position_L_m=stones.position_m.astype(np.float32),
        boulder_smallest_m=stones.smallest_m.astype(np.float32),
        facet_m=limit.facet_m,
        radius_m=limit.radius_m,
    )


@lru_cache(maxsize=4)
def _roughness(body: Body) -> tuple[Roughness, float]:
    """Return the model's roughness law and mean edge, computed once per body and not once per site."""
    return body.roughness, mean_edge_m(body.vertices_m, body.faces)
