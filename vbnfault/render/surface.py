"""The terrain as the renderer sees it: one triangle mesh, its normals, precise shadow origins.

Mitsuba moves the origin of a shadow ray by 9e-5 · (1 + max|p|): 0.22 m at 2.5 km, more than a stone. Here the
hit is taken along the ray and moved off the facet by a few units of float32 resolution at its own distance, and
the facet's data come from tables instead of a virtual call: faster, and contact shadows survive.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .description import View
from .detail import Detail, FineRelief
from .mesh import mesh_scene
from .runtime import dr, mi
from .vehicle import Vehicle, World

# Float32 resolves 2⁻²³ of a coordinate; hit distance, ray direction and vertex rounding each err by about one
# unit, so eight of them clear the facet without visibly moving the shadow (1 mm at 1 km).
_OFFSET = 8 * 2.0**-23
_RUN = 64  # facets in a box that tells how far they can be
# By which the 21 bits of a number are spread out to every third bit: shift, and the bits that are kept.
_SPREAD = (
    (32, 0x1F00000000FFFF),
    (16, 0x1F0000FF0000FF),
    (8, 0x100F00F00F00F00F),
    (4, 0x10C30C30C30C30C3),
    (2, 0x1249249249249249),
)

# Of a normal that faces the viewer: half precision, as truth is stored, moves a cosine by up to √3 · 2⁻¹².
_LEAST_COSINE = 2.0**-11


class TerrainMesh:
    """A triangle mesh in L. `vertices_m` float32[n, 3], `faces` int32[m, 3], `flat` bool[m]: facets shaded with
    their own normal, such as boulders; the others with normals interpolated from their vertices. `dust` float32[n]
    in [0, 1]: how far each vertex is covered (default: none is). `vehicle`: the spacecraft with the camera.
    `fine`: relief finer than the facets."""

    def __init__(
        self,
        vertices_m: NDArray[np.float32],
        faces: NDArray[np.int32],
        flat: NDArray[np.bool_],
        dust: NDArray[np.float32] | None = None,
        vehicle: Vehicle | None = None,
        fine: FineRelief | None = None,
    ) -> None:
        vertices_m, faces = np.asarray(vertices_m, dtype=np.float32), np.asarray(faces, dtype=np.int32)
        with ThreadPoolExecutor(1) as aside:  # the tree's last steps keep one core busy
            normals = aside.submit(_vertex_normals, vertices_m, faces, flat)
            self.scene = mesh_scene("terrain", vertices_m, faces)
        self._corners = _corner_records(vertices_m, faces, flat, normals.result())
        self._dust = mi.Float(0.0 if dust is None else np.ascontiguousarray(_with_a_fourth(dust[faces])).ravel())
        dr.eval(self._corners, self._dust)
        self.vehicle, self.fine = vehicle, fine
        self._vertices_m, self._faces = vertices_m, faces

    def corners_m(self, facets: NDArray[np.intp]) -> NDArray[np.float64]:
        """Return the corners of facets, float64[facet, corner, 3] in L."""
        return self._vertices_m[self._faces[facets]].astype(np.float64)

    def facets_near(self, position_L_m: NDArray[np.float64], reach_m: float) -> NDArray[np.intp]:
        """Return the indices of all facets within `reach_m` of a position, among others: those of every run of
        facets whose box reaches there."""
        order, low, high = self._boxes_m
        away = np.maximum(np.maximum(low - position_L_m, position_L_m - high), 0)
        runs = np.flatnonzero(np.einsum("ri,ri->r", away, away) <= reach_m**2)
        places = (runs[:, None] * _RUN + np.arange(_RUN)).ravel()
        return order[places[places < len(order)]]

    @cached_property
    def _boxes_m(self) -> tuple[NDArray[np.intp], NDArray[np.float64], NDArray[np.float64]]:
        """The facets in an order in which neighbours follow one another, and lower and upper corners of the boxes
        about runs of `_RUN` of them, float64[run, 3] each."""
        order = np.argsort(_morton(self._vertices_m[self._faces[:, 0]]), kind="stable")
        starts = np.arange(0, len(order), _RUN)
        corners = [self._vertices_m[self._faces[order, k]] for k in range(3)]
        low = np.minimum.reduceat(np.minimum.reduce(corners), starts)
        high = np.maximum.reduceat(np.maximum.reduce(corners), starts)
        return order, low.astype(np.float64), high.astype(np.float64)

    def seen_from(self, view: View) -> TerrainMesh | World:
        """What a camera sees: the terrain, and its own spacecraft if there is one."""
        return self if self.vehicle is None else World(self, self.vehicle, view)

    def intersect(self, rays: Any, active: Any = True, *, coherent: bool = True) -> Hit:
        """Closest hits; `coherent` where neighbours run alike."""
        return self.hit(rays, self.trace(rays, active, coherent=coherent))

    def trace(self, rays: Any, active: Any = True, *, coherent: bool = True) -> tuple[Any, ...]:
        """What `hit` needs besides the rays: can be evaluated, reordered with `dr.gather`, and used later."""
        return (self.scene.ray_intersect_preliminary(rays, coherent=coherent, active=active),)

    def hit(self, rays: Any, traced: tuple[Any, ...]) -> Hit:
        """The closest hits that `trace` found for these rays."""
        return Hit(self, rays, *traced)

    def occluded(self, rays: Any, active: Any, *, coherent: bool = True) -> Any:
        """Whether anything lies along the rays; `coherent` where neighbours run alike."""
        return self.scene.ray_test(rays, coherent, active)


def _morton(points_m: NDArray[np.float32]) -> NDArray[np.uint64]:
    """Return the place of points float32[n, 3] along a curve that keeps neighbours together, uint64[n]: the bits of
    their coordinates, 21 each, interleaved (Morton 1966)."""
    low = points_m.min(axis=0)
    cells = (points_m - low) * (np.float32(2**21 - 1) / max(float((points_m - low).max()), 1e-30))
    code = np.zeros(len(points_m), dtype=np.uint64)
    for k in range(3):
        bits = cells[:, k].astype(np.uint64)
        for shift, kept in _SPREAD:
            bits = (bits | (bits << np.uint64(shift))) & np.uint64(kept)
        code |= bits << np.uint64(k)
    return code


class Hit:
    """Closest hits of a wavefront: `valid`, `distance_m`, and the unit outward `normal` that shades, interpolated
    over the facet unless it is flat. `material`: of the vehicle's, None for terrain alone."""

    material: Any = None
    on_vehicle: Any = None

    def __init__(self, surface: TerrainMesh, rays: Any, found: Any) -> None:
        self.valid = found.is_valid()
        self.distance_m = found.t
        self._surface, self._first = surface, found.prim_index
        self._rays = rays
        b1, b2 = found.prim_uv.x, found.prim_uv.y
        self._weights = (1 - b1 - b2, b1, b2)
        first = found.prim_index * 3
        self._corners = [dr.gather(mi.Vector4f, surface._corners, first + k, self.valid) for k in range(3)]
        w = self._weights
        self.normal = dr.normalize(sum((c.xyz * w[k] for k, c in enumerate(self._corners)), mi.Vector3f(0)))

    @cached_property
    def dust(self) -> Any:
        """How far the ground is covered with dust, in [0, 1], interpolated over the facet."""
        table = self._surface._dust
        if len(table) == 1:
            return mi.Float(0)
        corners = dr.gather(mi.Vector4f, table, self._first, self.valid)
        return sum((corners[k] * w for k, w in enumerate(self._weights)), mi.Float(0))

    def shading_normal(self, detail: Detail | None, dither: Any) -> Any:
        """The normal turned by the relief finer than facets; `dither` in [0, 1), one number a pixel."""
        if detail is None:
            return self.normal
        point = self._rays(self.distance_m)
        return detail.turned(self.normal, point, self._rays.d, self.distance_m, self.dust, dither)

    def shadow_rays(self, direction: Any) -> Any:
        """Rays from the hits. The origin is moved off the facet to the smooth surface that the corner normals
        suggest, so that facets near the terminator do not shadow themselves (Hanika 2021, Ray Tracing Gems II,
        chapter 4), and then by a few units of float32 resolution."""
        point = mi.Vector3f(self._rays(self.distance_m))
        lift = mi.Vector3f(0)
        for corner, weight in zip(self._corners, self._weights, strict=True):
            lift += corner.xyz * (weight * dr.maximum(corner.w - dr.dot(point, corner.xyz), 0))
        offset = _OFFSET * (dr.max(dr.abs(point)) + self.distance_m) + 1e-6
        return mi.Ray3f(mi.Point3f(point + lift + self.normal * offset), direction)


def facing(normal: Any, view: Any) -> Any:
    """Return unit normals that face the viewer: those given, or the nearest ones that a surface in view can have.

    An interpolated normal, or one turned by fine relief, may point away from who sees its facet, which no visible
    surface element does. It is turned within the plane of the two, no further than to the tangent plane of the line
    of sight. `view`: unit vectors from the surface to the viewer.
    """
    cosine = dr.dot(normal, view)
    turned = dr.normalize(dr.fma(view, _LEAST_COSINE - cosine, normal))
    return dr.select(cosine < _LEAST_COSINE, turned, normal)


def _with_a_fourth(three: NDArray[np.float32]) -> NDArray[np.float32]:
    """float32[m, 4] of float32[m, 3]: a power of two is fetched in one packet."""
    return np.pad(three.astype(np.float32), ((0, 0), (0, 1)))


def _corner_records(
    vertices: NDArray[np.float32], faces: NDArray[np.int32], flat: NDArray[np.bool_], normals: NDArray[np.float32]
) -> Any:
    """Per corner of each facet, floats [m, 3, 4]: its unit normal, and the distance of its tangent plane from the
    origin. Four floats: drjit fetches a power of two in one packet.

    The normal is the facet's own where it is flat, else that of the vertex.
    """
    corner = dr.arange(mi.UInt32, 3 * len(faces))
    facet = corner // 3
    table = mi.UInt32(np.ascontiguousarray(faces, np.uint32).ravel())
    places = mi.Float(np.ascontiguousarray(vertices).ravel())
    a, b, c = (dr.gather(mi.Vector3f, places, dr.gather(mi.UInt32, table, 3 * facet + k)) for k in range(3))
    across = dr.cross(b - a, c - a)
    own = across * dr.rcp(dr.maximum(dr.norm(across), 1e-30))
    vertex = dr.gather(mi.UInt32, table, corner)
    smooth = dr.gather(mi.Vector3f, mi.Float(normals.ravel()), vertex)
    normal = dr.select(dr.gather(mi.Bool, mi.Bool(flat), facet), own, smooth)
    return dr.ravel(mi.Vector4f(*normal, dr.dot(normal, dr.gather(mi.Vector3f, places, vertex))))


def _vertex_normals(
    vertices: NDArray[np.float32], faces: NDArray[np.int32], flat: NDArray[np.bool_]
) -> NDArray[np.float32]:
    """Unit means of the smooth facets around each vertex, weighted by area, float32[n, 3]; 0 where all are flat.

    Not on the device: sums over facets there depend on the order in which threads come.
    """
    # axis by axis: numpy is several times slower on arrays of triples
    at = [np.ascontiguousarray(faces[~flat, k]) for k in range(3)]
    axes = [np.ascontiguousarray(vertices[:, axis]) for axis in range(3)]
    one, other = ([of[at[k]] - of[at[0]] for of in axes] for k in (1, 2))
    area = [
        one[1] * other[2] - one[2] * other[1],
        one[2] * other[0] - one[0] * other[2],
        one[0] * other[1] - one[1] * other[0],
    ]
    total = np.stack([np.sum([np.bincount(i, of, len(vertices)) for i in at], axis=0) for of in area], axis=1)
    length = np.sqrt(np.einsum("ni,ni->n", total, total))
    return np.asarray(total / np.maximum(length, 1e-300)[:, None], np.float32)
