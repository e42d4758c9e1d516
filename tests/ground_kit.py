"""What the tests of rounded and of fractured ground share: the ground of a patch, and its relief by wavelength."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from vbnfault.body import Body, Patch, PatchSpec, build_patch, choose_sites, site_at
from vbnfault.body.geometry import vertex_normals
from vbnfault.body.roughness import deviogram, model_roughness


def ground_of(patch: Patch) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices and faces of a patch without its boulders."""
    faces = patch.faces[~patch.face_is_boulder]
    return patch.vertices_L_m[: faces.max() + 1].astype(np.float64), faces


def deviation_over_law(body: Body, patches: Sequence[Patch], baselines_m: Sequence[float]) -> np.ndarray:
    """Return the deviogram at each baseline, as root mean square over the patches, over that of the body's law."""
    rows = []
    for patch in patches:
        points, faces = ground_of(patch)
        normals, distance = vertex_normals(points, faces), np.linalg.norm(points, axis=1)
        row = []
        for baseline in baselines_m:
            near = np.flatnonzero(distance < 20.0 + 6.0 * baseline)[:: 1 if baseline < 8 else 4]
            row.append(deviogram(points[near], normals[near], np.array([baseline]), windows=40)[0])
        rows.append(row)
    law = model_roughness(body.vertices_m, body.faces).deviation_at(np.array(baselines_m))
    return np.asarray(np.sqrt(np.mean(np.square(rows), axis=0)) / law)


def raised_from_two_sites(body: Body, reach_m: float, **spec: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return how far the relief moves the ground that patches of two sites 25 m apart share, float64[2, n, 3] in T.

    The vertices are those of the unroughened meshes that coincide within `reach_m` of the first site (float32 of
    100 m: 0.01 mm). The second array is how far apart the two patches show them, float64[n] in m.
    """
    first = choose_sites(body, 1, seed=7)[0]
    second = site_at(body, 1, first.position_T_m + 25.0 * first.T_from_L[:, 0])
    spec |= {"seed": 7, "min_boulder_m": 1e6}
    rough, flat = (
        [build_patch(body, site, PatchSpec(**spec, relief=relief)) for site in (first, second)]
        for relief in (1.0, 0.0)
    )

    def in_T(patch: Patch) -> np.ndarray:
        return patch.vertices_L_m.astype(np.float64) @ patch.site.T_from_L.T + patch.site.position_T_m

    near = np.flatnonzero(np.linalg.norm(flat[0].vertices_L_m, axis=1) < reach_m)
    apart, twin = cKDTree(in_T(flat[1])).query(in_T(flat[0])[near])
    vertices = near[apart < 1e-3], twin[apart < 1e-3]
    raised = np.stack([(in_T(r) - in_T(f))[v] for r, f, v in zip(rough, flat, vertices, strict=True)])
    return raised, np.linalg.norm(in_T(rough[0])[vertices[0]] - in_T(rough[1])[vertices[1]], axis=1)
