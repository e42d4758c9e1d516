"""Trace rays through the terrain, one triangle mesh, and through the spacecraft around the camera.

Mitsuba moves the origin of a shadow ray by 9e-5 · (1 + max|p|): 0.22 m at 2.5 km, more than a stone. Here the hit
is a point of the ray, moved off the facet by a few units of float32 resolution at its own distance. The facet's
data come from tables instead of a virtual call. This is faster and keeps contact shadows.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.quantities import SunInView
from .albedo import AlbedoMap
from .description import Sunlight, View
from .detail import Detail, FineRelief
from .earth import EarthAlbedo
from .runtime import dr, mi, packets
from .sampling import opaque_vector
from .vehicle import Vehicle, mesh_scene

# Float32 resolves 2⁻²³ of a coordinate. Hit distance, ray direction and vertex rounding each err by about one unit.
# Eight units therefore clear the facet and do not visibly move the shadow (1 mm at 1 km).
_OFFSET = 8 * 2.0**-23
_POSITIONS = 8  # that one kernel compares with the facets
# Least cosine between a normal and the direction to the viewer. Truth stores normals in half precision,
# which moves a cosine by up to √3 · 2⁻¹².
_LEAST_COSINE = 2.0**-11
# Distance from the facet at which shadow rays start: far above float32's resolution at 1 km, far below a part's
# size.
_OFFSET_M = 5e-4

# Rays that start this close to the camera's centre, or within its aperture, are rays of the camera.
_AT_CAMERA_M = 1e-6


class TerrainMesh:
    """Hold a triangle mesh in L for ray tracing.

    Parameters
    ----------
    vertices_m, faces
        float32[n, 3] in metres, int32[m, 3].
    flat
        bool[m]: facets shaded with their own normal, such as boulders. The others use normals interpolated from
        their vertices.
    dust
        float32[n] in [0, 1]: dust cover of each vertex. None: no dust.
    vehicle
        The spacecraft with the camera.
    fine
        Relief finer than the facets.
    albedo
        Map of factors on the albedo of the ground. None: 1 everywhere.

    `centre_m` float64[3] and `radius_m` are those of a sphere that holds all vertices.
    """

    def __init__(
        self,
        vertices_m: NDArray[np.float32],
        faces: NDArray[np.int32],
        flat: NDArray[np.bool_],
        dust: NDArray[np.float32] | None = None,
        vehicle: Vehicle | None = None,
        fine: FineRelief | None = None,
        albedo: AlbedoMap | EarthAlbedo | None = None,
    ) -> None:
        vertices_m, faces = np.asarray(vertices_m, dtype=np.float32), np.asarray(faces, dtype=np.int32)
        with ThreadPoolExecutor(1) as aside:  # the last steps of building the tree keep only one core busy
            normals = aside.submit(_vertex_normals, vertices_m, faces, flat)
            self.scene = mesh_scene("terrain", vertices_m, faces)
        self._corners = _corner_records(self.scene.shapes()[0], len(faces), flat, normals.result())
        self._dust = mi.Float(0.0) if dust is None else packets(mi.Float, _with_a_fourth(dust[faces]))
        dr.eval(self._corners, self._dust)
        self.vehicle, self.fine, self.albedo = vehicle, fine, albedo
        self._mesh, self._facet_count = self.scene.shapes()[0], len(faces)
        low, high = vertices_m.min(axis=0).astype(np.float64), vertices_m.max(axis=0).astype(np.float64)
        self.centre_m = (low + high) / 2
        self.radius_m = float(np.linalg.norm(high - low)) / 2
        self.kept_sun: tuple[View, Sunlight, SunInView | None] | None = None  # the last result of `sun_in_view`

    @property
    def vertices_m(self) -> NDArray[np.float64]:
        """Return the corners of all facets in L, float64[n, 3]."""
        return np.asarray(self._mesh.vertex_positions_buffer().numpy().reshape(-1, 3), np.float64)

    def corners_m(self, facets: NDArray[np.intp]) -> NDArray[np.float64]:
        """Return the corners of facets, float64[facet, corner, 3] in L."""
        corners = self._corners_of(packets(mi.UInt32, np.asarray(facets, np.uint32)))
        return np.stack([corner.numpy().T for corner in corners], axis=1).astype(np.float64)

    def facets_near(self, positions_L_m: NDArray[np.float64], reach_m: float) -> NDArray[np.intp]:
        """Return the indices of all facets within `reach_m` of any position float64[n, 3], and of few others.

        These are the facets whose bounding boxes are within reach. One kernel tests all facets for a few positions;
        an order of the facets by position would take ten times as long and serve few samples.
        """
        corners = self._corners_of(dr.arange(mi.UInt32, self._facet_count))
        low, high = (f(f(corners[0], corners[1]), corners[2]) for f in (dr.minimum, dr.maximum))
        near = np.zeros(self._facet_count, dtype=bool)
        for start in range(0, len(positions_L_m), _POSITIONS):
            within = mi.Bool(False)
            for position in positions_L_m[start : start + _POSITIONS]:
                point = opaque_vector(mi.Point3f, position)
                away = dr.maximum(dr.maximum(low - point, point - high), 0)
                # the position is rounded to float32
                reach = reach_m + _OFFSET * (float(np.abs(position).max()) + reach_m)
                within |= dr.squared_norm(away) <= dr.opaque(mi.Float, reach**2)
            near |= within.numpy().astype(bool)
        return np.flatnonzero(near)

    def _corners_of(self, facet: Any) -> list[Any]:
        """Return the three corners of facets, given by their index."""
        vertices, faces = self._mesh.vertex_positions_buffer(), self._mesh.faces_buffer()
        return [
            dr.gather(mi.Point3f, vertices, dr.gather(mi.UInt32, faces, 3 * facet + corner)) for corner in range(3)
        ]

    def seen_from(self, view: View) -> TerrainMesh | World:
        """Return what a camera sees: the terrain, and its own spacecraft if there is one."""
        return self if self.vehicle is None else World(self, self.vehicle, view)

    def intersect(self, rays: Any, active: Any = True, *, coherent: bool = True) -> Hit:
        """Return the closest hits; set `coherent` where neighbouring rays are alike."""
        return self.hit(rays, self.trace(rays, active, coherent=coherent))

    def trace(self, rays: Any, active: Any = True, *, coherent: bool = True) -> tuple[Any, ...]:
        """Return what `hit` needs besides the rays.

        It can be evaluated, reordered with `dr.gather` and used later.
        """
        return (self.scene.ray_intersect_preliminary(rays, coherent=coherent, active=active),)

    def hit(self, rays: Any, traced: tuple[Any, ...]) -> Hit:
        """Return the closest hits that `trace` computed for these rays."""
        return Hit(self, rays, *traced)

    def occluded(self, rays: Any, active: Any, *, coherent: bool = True) -> Any:
        """Return whether anything lies along the rays; set `coherent` where neighbouring rays are alike."""
        return self.scene.ray_test(rays, coherent, active)


class Hit:
    """Hold the closest hits of a wavefront.

    Attributes
    ----------
    valid, distance_m
        Whether there is a hit, and its distance from the origin of the ray.
    start_m
        Distance from the camera at which the ray starts; `range_m` is that of the hit.
    normal
        Unit outward normal for shading, interpolated over the facet unless it is flat.
    material, on_vehicle
        Material of the vehicle and whether the hit is on it; None for terrain alone.
    """

    material: Any = None
    on_vehicle: Any = None
    facet: Any = None  # of the vehicle
    start_m: Any = 0.0

    def __init__(self, surface: TerrainMesh, rays: Any, intersection: Any) -> None:
        self.valid = intersection.is_valid()
        self.distance_m = intersection.t
        self._surface, self._first = surface, intersection.prim_index
        self._rays = rays
        b1, b2 = intersection.prim_uv.x, intersection.prim_uv.y
        self._weights = (1 - b1 - b2, b1, b2)
        first = intersection.prim_index * 3
        self._corners = [dr.gather(mi.Vector4f, surface._corners, first + k, self.valid) for k in range(3)]
        w = self._weights
        self.normal = dr.normalize(sum((c.xyz * w[k] for k, c in enumerate(self._corners)), mi.Vector3f(0)))

    @cached_property
    def dust(self) -> Any:
        """Return the dust cover of the ground in [0, 1], interpolated over the facet."""
        table = self._surface._dust
        if len(table) == 1:
            return mi.Float(0)
        corners = dr.gather(mi.Vector4f, table, self._first, self.valid)
        return sum((corners[k] * w for k, w in enumerate(self._weights)), mi.Float(0))

    @property
    def point(self) -> Any:
        """Return the positions of the hits in L."""
        return self._rays(self.distance_m)

    @property
    def range_m(self) -> Any:
        """Return the distance from the camera, for hits of its own rays."""
        return self.distance_m if isinstance(self.start_m, float) else self.distance_m + self.start_m

    def shading_normal(self, detail: Detail | None) -> Any:
        """Return the normal turned by the relief finer than facets."""
        if detail is None:
            return self.normal
        point = self._rays(self.distance_m)
        return detail.turned(self.normal, point, self._rays.d, self.range_m, self.dust)

    def shadow_rays(self, direction: Any) -> Any:
        """Return rays from the hits in a direction.

        The origin is moved off the facet to the smooth surface that the corner normals suggest, so that facets near
        the terminator do not shadow themselves (Hanika 2021, Ray Tracing Gems II, chapter 4). It is then moved by a
        few units of float32 resolution.
        """
        point = mi.Vector3f(self._rays(self.distance_m))
        lift = mi.Vector3f(0)
        for corner, weight in zip(self._corners, self._weights, strict=True):
            lift += corner.xyz * (weight * dr.maximum(corner.w - dr.dot(point, corner.xyz), 0))
        offset = _OFFSET * (dr.max(dr.abs(point)) + self.distance_m) + 1e-6
        return mi.Ray3f(mi.Point3f(point + lift + self.normal * offset), direction)


class World:
    """Intersect rays with the terrain and with a vehicle at its position."""

    def __init__(self, surface: TerrainMesh, vehicle: Vehicle, view: View) -> None:
        self.surface, self.vehicle = surface, vehicle
        self._origin = opaque_vector(mi.Point3f, view.position_L_m)
        self._axes = [opaque_vector(mi.Vector3f, view.L_from_C[:, k]) for k in range(3)]  # B coincides with C
        self._centre = opaque_vector(mi.Point3f, vehicle.centre_m)
        self._radius2 = dr.opaque(mi.Float, vehicle.radius_m**2)
        self._pupil2 = dr.opaque(mi.Float, (1.01 * view.aperture_radius_m + _AT_CAMERA_M) ** 2)
        self._low, self._high = (opaque_vector(mi.Vector2f, bound) for bound in vehicle.slopes_in(view))

    def intersect(self, rays: Any, active: Any = True, *, coherent: bool = True) -> VehicleHit:
        """Return the closest hits on either; `on_vehicle` marks those on the vehicle."""
        return self.hit(rays, self.trace(rays, active, coherent=coherent))

    def trace(self, rays: Any, active: Any = True, *, coherent: bool = True) -> tuple[Any, ...]:
        """Return the hits on the terrain and on the vehicle, in the form that `hit` needs besides the rays."""
        in_B = self._in_B(rays)
        near = self._may_meet(in_B)
        # the camera may stand among the parts, but see none of them in most of its field
        d, from_camera = in_B.d, dr.squared_norm(mi.Vector3f(in_B.o)) <= self._pupil2
        within = (d.x >= self._low.x * d.z) & (d.x <= self._high.x * d.z)
        within &= (d.y >= self._low.y * d.z) & (d.y <= self._high.y * d.z)
        near &= ~from_camera | within | (d.z <= 0)
        hit = self.vehicle.scene.ray_intersect_preliminary(in_B, coherent=coherent, active=active & near)
        return *self.surface.trace(rays, active, coherent=coherent), hit

    def hit(self, rays: Any, traced: tuple[Any, ...]) -> VehicleHit:
        """Return the nearer of the two hits of each ray."""
        ground, on_vehicle = self.surface.hit(rays, traced[:-1]), traced[-1]
        nearer = on_vehicle.is_valid() & (~ground.valid | (on_vehicle.t < ground.distance_m))
        normal, material = self.vehicle.facet(on_vehicle.prim_index, nearer)
        normal = self._in_L(normal)
        normal = dr.mulsign(normal, -dr.dot(normal, rays.d))  # towards the viewer
        return VehicleHit(ground, nearer, on_vehicle, normal, material, rays)

    def occluded(self, rays: Any, active: Any, *, coherent: bool = True) -> Any:
        """Return whether anything lies along the rays."""
        in_B = self._in_B(rays)
        behind = self.vehicle.occluded(in_B, active & self._may_meet(in_B), coherent=coherent)
        return behind | self.surface.occluded(rays, active & ~behind, coherent=coherent)

    def _may_meet(self, rays: Any) -> Any:
        """Return whether rays in B pass through the sphere around all parts; the others need no search."""
        towards = mi.Vector3f(self._centre - rays.o)
        inside, ahead = dr.squared_norm(towards) <= self._radius2, dr.dot(towards, rays.d) > 0
        # far away, the difference of squares would lose more digits than the cross product
        return inside | (ahead & (dr.squared_norm(dr.cross(towards, rays.d)) <= self._radius2))

    def _in_B(self, rays: Any) -> Any:
        """Return rays transformed into B."""
        o = rays.o - self._origin
        turned = mi.Ray3f(
            mi.Point3f(*(dr.dot(o, axis) for axis in self._axes)),
            mi.Vector3f(*(dr.dot(rays.d, axis) for axis in self._axes)),
        )
        turned.maxt = rays.maxt
        return turned

    def _in_L(self, v: Any) -> Any:
        """Return vectors of B in L."""
        x, y, z = self._axes
        return v.x * x + v.y * y + v.z * z


class VehicleHit(Hit):
    """Hold hits of which some are on the vehicle and the others on the ground."""

    def __init__(self, ground: Hit, nearer: Any, on_vehicle: Any, normal: Any, material: Any, rays: Any) -> None:
        self._ground, self._rays = ground, rays
        self.on_vehicle, self.material, self.facet = nearer, material, on_vehicle.prim_index
        self.valid = ground.valid | nearer
        self.distance_m = dr.select(nearer, on_vehicle.t, ground.distance_m)
        self.normal = dr.select(nearer, normal, ground.normal)

    @cached_property
    def dust(self) -> Any:
        """Return the dust cover of the ground; 0 on the vehicle."""
        return dr.select(self.on_vehicle, 0, self._ground.dust)

    def shading_normal(self, detail: Detail | None) -> Any:
        """Return the ground's shading normal; the vehicle has no finer relief."""
        return dr.select(self.on_vehicle, self.normal, self._ground.shading_normal(detail))

    def shadow_rays(self, direction: Any) -> Any:
        """Return rays from the hits in a direction; they start off the facet."""
        rays = self._ground.shadow_rays(direction)
        # the origin lies on the side on which the ray leaves
        side = dr.mulsign(mi.Vector3f(self.normal), dr.dot(self.normal, direction))
        rays.o = dr.select(self.on_vehicle, self._rays(self.distance_m) + side * _OFFSET_M, rays.o)
        return rays


def facing(normal: Any, view: Any) -> Any:
    """Return unit normals that face the viewer: those given, or the nearest ones that a visible surface can have.

    An interpolated normal, or one turned by fine relief, may point away from a viewer who sees its facet. No
    visible surface element has such a normal. The normal is turned in the plane of normal and line of sight, no
    further than perpendicular to the line of sight. `view` holds unit vectors from the surface to the viewer.
    """
    cosine = dr.dot(normal, view)
    turned = dr.normalize(dr.fma(view, _LEAST_COSINE - cosine, normal))
    return dr.select(cosine < _LEAST_COSINE, turned, normal)


def _with_a_fourth(three: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return float32[m, 3] padded to float32[m, 4], because a power of two is fetched in one packet."""
    return np.pad(three.astype(np.float32), ((0, 0), (0, 1)))


def _corner_records(mesh: Any, facets: int, flat: NDArray[np.bool_], normals: NDArray[np.float32]) -> Any:
    """Return four floats per corner of each facet: its unit normal, and the distance of its tangent plane from 0.

    The normal is the facet's own if the facet is flat, else that of the vertex. The order is
    [facet, corner, float]. drjit fetches four floats, a power of two, in one packet.
    """
    corner = dr.arange(mi.UInt32, 3 * facets)
    facet = corner // 3
    table, coordinates = mesh.faces_buffer(), mesh.vertex_positions_buffer()
    a, b, c = (dr.gather(mi.Vector3f, coordinates, dr.gather(mi.UInt32, table, 3 * facet + k)) for k in range(3))
    across = dr.cross(b - a, c - a)
    own = across * dr.rcp(dr.maximum(dr.norm(across), 1e-30))
    vertex = dr.gather(mi.UInt32, table, corner)
    smooth = dr.gather(mi.Vector3f, mi.Float(normals.ravel()), vertex)
    normal = dr.select(dr.gather(mi.Bool, mi.Bool(flat), facet), own, smooth)
    return dr.ravel(mi.Vector4f(*normal, dr.dot(normal, dr.gather(mi.Vector3f, coordinates, vertex))))


def _vertex_normals(
    vertices: NDArray[np.float32], faces: NDArray[np.int32], flat: NDArray[np.bool_]
) -> NDArray[np.float32]:
    """Return area-weighted unit means of the smooth facets' normals at each vertex, float32[n, 3].

    The normal is 0 if all facets of a vertex are flat. The sums are not computed on the device, because there they
    depend on the order of the threads.
    """
    # axis by axis, because numpy is several times slower on arrays of triples
    corners = [np.ascontiguousarray(faces[~flat, k]) for k in range(3)]
    axes = [np.ascontiguousarray(vertices[:, axis]) for axis in range(3)]
    first_edge, second_edge = ([of[corners[k]] - of[corners[0]] for of in axes] for k in (1, 2))
    area = [
        first_edge[1] * second_edge[2] - first_edge[2] * second_edge[1],
        first_edge[2] * second_edge[0] - first_edge[0] * second_edge[2],
        first_edge[0] * second_edge[1] - first_edge[1] * second_edge[0],
    ]
    total = np.stack([np.sum([np.bincount(i, of, len(vertices)) for i in corners], axis=0) for of in area], axis=1)
    length = np.sqrt(np.einsum("ni,ni->n", total, total))
    return np.asarray(total / np.maximum(length, 1e-300)[:, None], np.float32)
