"""Build the terrain: the whole body as one closed mesh, refined and roughened around a site, with boulders on it.

The facets of the global model are tens of metres wide. A camera within a hundred metres of the ground needs relief
down to its pixels. Three steps provide it:

1. `refine` splits the edges near the site until they meet a target length. New points lie on the curved surface
   that the model's points and normals suggest.
2. `relief` adds heights along the normal. Their spectrum continues that of the model below its facets.
3. `boulders` sets boulders, which are closed meshes of their own, partly into the ground.

The fields of the relief are functions of body-fixed position and seed, so that neighbouring sites see the same
ground. Built patches are kept on disk (`core.files.array_files`), because to build one takes many seconds.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.errors import InputError
from ..core.files.array_files import ArrayFiles, code_hash
from ..core.process import activity
from . import scarps
from .body import Body
from .boulders import GroundMesh, add_boulders
from .geometry import Float64, Int32, mean_edge_m, vertex_normals
from .noise import Float32
from .refine import GROWTH_POWER, EdgeLimit, affordable, refine
from .relief import LONGEST_EDGES, add_relief
from .sites import Site
from .spec import PatchSpec

_GROUND_FRACTION = 0.66  # fraction of the triangles; the rest is left to the boulders
_BOULDER_STREAM = 0xB0D

Surface = tuple[Float64, Float64, Int32]  # points, unit normals, faces


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
        float32[n] in [0, 1] at each vertex: 1 where dust covers the ground, 0 on bare ground and boulders. With
        `regolith`: how far the albedo departs from its mean, -1 to 1.5 in units of `albedo_contrast`.
    boulder_diameter_m, boulder_position_L_m
        float32[k] largest diameter, and float32[k, 3] centre of each boulder.
    boulder_smallest_m
        float32[k]: smallest diameter for which the size law was drawn at the boulder's position.
    boulders_drawn
        Number of boulders that the size law gave; only k of them fitted into `max_triangles`.
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
    boulders_drawn: int
    facet_m: float
    radius_m: float

    @property
    def triangles(self) -> int:
        """Return the number of triangles."""
        return len(self.faces)


def build_patch(body: Body, site: Site, spec: PatchSpec) -> Patch:
    """Build the terrain around a site; the result is deterministic in body, site and spec.

    Raises InputError if the spec allows fewer triangles than twice the model's faces.
    """
    if spec.max_triangles < 2 * len(body.faces):
        raise InputError(
            f"max_triangles = {spec.max_triangles}: must be at least twice the model's {len(body.faces)} faces"
        )
    model = (body.vertices_m - site.position_T_m, vertex_normals(body.vertices_m, body.faces), body.faces)
    with ThreadPoolExecutor(1) as aside:  # to measure a body for its first patch takes nearly a second
        measured = aside.submit(lambda: (body.roughness, mean_edge_m(body.vertices_m, body.faces)))
        limit = affordable(
            EdgeLimit(spec.facet_m, spec.radius_m), model, int(_GROUND_FRACTION * spec.max_triangles)
        )
        points, normals, faces = refine(*_with_scarps(body, site, model, limit, spec), limit)
        law, edge = measured.result()
    facet = limit.facet_at(points)
    ground = add_relief(
        body,
        site,
        (points, normals, faces),
        facet,
        spec,
        roughness=law.at_least(spec.roughness).with_hurst(spec.hurst),
        longest_m=LONGEST_EDGES * edge,
    )
    place_T_m = points + site.position_T_m
    points = points + ground.height_m[:, None] * normals
    points = np.einsum("ni,ij->nj", points, site.T_from_L)
    stones = add_boulders(
        GroundMesh(
            points=points, faces=faces, facet_m=facet, dust=ground.dust, talus=ground.talus, place_T_m=place_T_m
        ),
        spec,
        rng=np.random.Generator(np.random.Philox(np.random.SeedSequence((spec.seed, _BOULDER_STREAM, site.index)))),
        budget=spec.max_triangles - len(faces),
    )
    all_faces = np.concatenate([faces, stones.faces + np.int32(len(points))])
    return Patch(
        site=site,
        vertices_L_m=np.concatenate([points, stones.vertices_m]).astype(np.float32),
        faces=all_faces.astype(np.int32),
        face_is_boulder=np.arange(len(all_faces)) >= len(faces),
        face_is_flat=np.concatenate([np.zeros(len(faces), dtype=bool), stones.flat]),
        dust=np.concatenate([ground.dust, stones.shade]),
        boulder_diameter_m=stones.diameter_m.astype(np.float32),
        boulder_position_L_m=stones.position_m.astype(np.float32),
        boulder_smallest_m=stones.smallest_m.astype(np.float32),
        boulders_drawn=stones.drawn,
        facet_m=limit.facet_m,
        radius_m=limit.radius_m,
    )


def _with_scarps(body: Body, site: Site, model: Surface, limit: EdgeLimit, spec: PatchSpec) -> Surface:
    """Return points, normals and faces of the model, refined as far as its scarps need, with `spec.scarps`."""
    edge_m = mean_edge_m(body.vertices_m, body.faces)
    finest_m = scarps.FINEST * edge_m
    if not spec.scarps or spec.regolith is not None or limit.facet_m > scarps.COARSEST * edge_m:
        return model
    if limit.facet_m < finest_m:
        # the same facets where they are coarser than this
        limit = EdgeLimit(finest_m, limit.radius_m * (finest_m / limit.facet_m) ** (1 / GROWTH_POWER))
    points, normals, faces = refine(*model, limit)
    place_T_m = points + site.position_T_m
    where = scarps.form(body, place_T_m)
    raised = scarps.gathered(points, faces, where, scarps.wander(place_T_m, edge_m, spec.seed), edge_m)
    return points + (spec.scarps * raised)[:, None] * where.up, normals, faces


# --- patches on disk --------------------------------------------------------------------------------------------

PATCHES = ArrayFiles(kind="patch", content="terrain")
_GROUND = ("fields", "noise", "relief", "fractured", "regolith", "roughness", "scarps")
_SOURCES = (*_GROUND, "body", "refine", "boulders", "patch", "gravity", "geometry")
_ARRAYS = tuple(name for name in Patch.__dataclass_fields__ if name != "site")


def cached_patch(body: Body, site: Site, spec: PatchSpec) -> Patch:
    """Return what `build_patch` returns for the same arguments, from disk if it was built before.

    The patch is the same bit for bit in both cases. Raises what `build_patch` raises, and InputError if
    $VBNFAULT_CACHE_GIB is unusable.
    """

    def build() -> dict[str, Any]:
        activity.begin(f"terrain of site {site.index} (new patch)")
        return arrays_of(build_patch(body, site, spec))

    return Patch(site=site, **PATCHES.kept(patch_key(body, site, spec), build))


def arrays_of(patch: Patch) -> dict[str, Any]:
    """Return the arrays and numbers of a patch that its file holds."""
    return {name: getattr(patch, name) for name in _ARRAYS}


def patch_key(body: Body, site: Site, spec: PatchSpec) -> str:
    """Return the sha256 (hex) of all that determines a patch."""
    content = {
        "code": _code_hash(),
        "body": [body.content_hash, body.density_kg_m3, body.rotation_period_s],
        "site": [site.index, site.position_T_m.tolist(), site.T_from_L.tolist()],
        "spec": dataclasses.asdict(spec),
    }
    text = json.dumps(content, sort_keys=True, default=lambda table: table.model_dump())
    return hashlib.sha256(text.encode()).hexdigest()


@lru_cache(maxsize=1)
def _code_hash() -> str:
    """Return the sha256 (hex) of the terrain sources, the library versions and the platform."""
    return code_hash([Path(__file__).with_name(f"{name}.py") for name in _SOURCES])
