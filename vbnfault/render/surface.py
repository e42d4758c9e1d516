"""The terrain as the renderer sees it: one triangle mesh, its normals, precise shadow origins.

Mitsuba moves the origin of a shadow ray by 9e-5 · (1 + max|p|): 0.22 m at 2.5 km, more than a stone. Here the
hit is taken along the ray and moved off the facet by a few units of float32 resolution at its own distance, and
the facet's data come from tables instead of a virtual call: faster, and contact shadows survive.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from .runtime import dr, mi

# Float32 resolves 2⁻²³ of a coordinate; hit distance, ray direction and vertex rounding each err by about one
# unit, so eight of them clear the facet without visibly moving the shadow (1 mm at 1 km).
_OFFSET = 8 * 2.0**-23


class Surface:
    """A triangle mesh in L. `vertices_m` float32[n, 3], `faces` int32[m, 3], `flat` bool[m]: facets shaded with
    their own normal, such as boulders; the others with normals interpolated from their vertices."""

    def __init__(self, vertices_m: NDArray[np.float32], faces: NDArray[np.int32], flat: NDArray[np.bool_]) -> None:
        mesh = mi.Mesh("terrain", len(vertices_m), len(faces))
        parameters = mi.traverse(mesh)
        parameters["vertex_positions"] = mi.Float(np.ascontiguousarray(vertices_m, np.float32).ravel())
        parameters["faces"] = mi.UInt32(np.ascontiguousarray(faces, np.uint32).ravel())
        parameters.update()
        self.scene = mi.load_dict({"type": "scene", "terrain": mesh})
        corner, facet = _normals(vertices_m, faces, flat)
        self._facet_normal = mi.Float(facet.ravel())
        self._corner_normals = mi.Float(corner.ravel())
        dr.eval(self._facet_normal, self._corner_normals)

    def intersect(self, rays: Any) -> Hit:
        """Closest hits."""
        return Hit(self, rays, self.scene.ray_intersect_preliminary(rays, coherent=True))

    def occluded(self, rays: Any, active: Any) -> Any:
        """Whether anything lies along the rays."""
        return self.scene.ray_test(rays, active)


class Hit:
    """Closest hits of a wavefront; properties are only traced into the kernel when they are used."""

    def __init__(self, surface: Surface, rays: Any, found: Any) -> None:
        self._surface, self._rays, self._found = surface, rays, found
        self.valid = found.is_valid()
        self.distance_m = found.t

    @property
    def facet_normal(self) -> Any:
        """Unit outward normal of the facet."""
        return dr.gather(mi.Normal3f, self._surface._facet_normal, self._found.prim_index, self.valid)

    @property
    def shading_normal(self) -> Any:
        """Unit normal, interpolated over the facet unless it is shaded flat."""
        b1, b2 = self._found.prim_uv.x, self._found.prim_uv.y
        first = self._found.prim_index * 3
        n = [
            dr.gather(mi.Normal3f, self._surface._corner_normals, first + corner, self.valid)
            for corner in range(3)
        ]
        return dr.normalize(n[0] * (1 - b1 - b2) + n[1] * b1 + n[2] * b2)

    def shadow_rays(self, direction: Any, facet_normal: Any) -> Any:
        """Rays from the hits, lifted off their facets on the outer side."""
        point = self._rays(self.distance_m)
        reach = dr.maximum(dr.max(dr.abs(point)), dr.max(dr.abs(self._rays.o)))
        offset = _OFFSET * (reach + self.distance_m) + 1e-6
        return mi.Ray3f(point + facet_normal * offset, direction)


def _normals(
    vertices: NDArray[np.float32], faces: NDArray[np.int32], flat: NDArray[np.bool_]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Corner normals float32[m, 3, 3] and facet normals float32[m, 3], unit length."""
    a, b, c = (vertices[faces[:, i]].astype(np.float64) for i in range(3))
    area = np.cross(b - a, c - a)
    facet = area / np.maximum(np.linalg.norm(area, axis=1, keepdims=True), 1e-300)
    # vertex normals weighted by area, flat facets left out
    weighted = np.where(flat[:, None], 0.0, area)
    vertex = np.stack(
        [
            np.bincount(faces.ravel(), np.repeat(weighted[:, k], 3), minlength=len(vertices))
            for k in range(3)
        ],
        axis=1,
    )
    vertex /= np.maximum(np.linalg.norm(vertex, axis=1, keepdims=True), 1e-300)
    corner = np.where(flat[:, None, None], facet[:, None, :], vertex[faces])
    return corner.astype(np.float32), facet.astype(np.float32)
