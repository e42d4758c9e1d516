"""What the tests of rounded and of fractured ground share: the ground of a patch, and its relief by wavelength."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from vbnfault.body import Body, Patch
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
