"""Trace the spacecraft around the camera in its own frame.

The vehicle moves with the camera. Its mesh therefore stays as it is, and the rays are transformed into its frame B.
Nothing is built again from sample to sample, and parts near the camera keep the precision of float32.
"""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from .description import View
from .detail import Detail
from .mesh import mesh_scene
from .runtime import dr, mi
from .sampling import opaque_vector

if TYPE_CHECKING:
    from .surface import Hit, TerrainMesh

# Distance from the facet at which shadow rays start: far above float32's resolution at 1 km, far below a part's
# size.
_OFFSET_M = 5e-4


class Vehicle:
    """Hold a spacecraft of diffuse facets in B, which are visible and reflect on both sides.

    Parameters
    ----------
    vertices_m, faces
        float32[n, 3] in metres, int32[m, 3].
    face_material
        int32[m].
    reflectance
        float64[material, band].
    """

    def __init__(
        self,
        vertices_m: NDArray[np.float32],
        faces: NDArray[np.int32],
        face_material: NDArray[np.int32],
        reflectance: NDArray[np.float64],
    ) -> None:
        self.scene = mesh_scene("vehicle", vertices_m, faces)
        a, b, c = (vertices_m[faces[:, k]].astype(np.float64) for k in range(3))
        normal = np.cross(b - a, c - a)
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)
        # four floats per facet, fetched in one packet: its normal and its material
        self._facets = mi.Float(np.column_stack([normal, face_material]).astype(np.float32).ravel())
        self._reflectance = [mi.Float(np.ascontiguousarray(column, np.float32)) for column in reflectance.T]
        dr.eval(self._facets, *self._reflectance)

    def facet(self, index: Any, active: Any) -> tuple[Any, Any]:
        """Return the normal in B and the material of facets."""
        record = dr.gather(mi.Vector4f, self._facets, index, active)
        return mi.Vector3f(record.xyz), mi.UInt32(record.w)

    def occluded(self, rays: Any, active: Any, *, coherent: bool = True) -> Any:
        """Return whether any part lies along rays in B."""
        return self.scene.ray_test(rays, coherent, active)

    def albedo(self, material: Any, active: Any) -> list[Any]:
        """Return the reflectance per band."""
        return [dr.gather(mi.Float, band, material, active) for band in self._reflectance]


class World:
    """Intersect rays with the terrain and with a vehicle at its position."""

    def __init__(self, surface: TerrainMesh, vehicle: Vehicle, view: View) -> None:
        self.surface, self.vehicle = surface, vehicle
        self._origin = opaque_vector(mi.Point3f, view.position_L_m)
        self._axes = [opaque_vector(mi.Vector3f, view.L_from_C[:, k]) for k in range(3)]  # B coincides with C

    def intersect(self, rays: Any, active: Any = True, *, coherent: bool = True) -> VehicleHit:
        """Return the closest hits on either; `on_vehicle` marks those on the vehicle."""
        return self.hit(rays, self.trace(rays, active, coherent=coherent))

    def trace(self, rays: Any, active: Any = True, *, coherent: bool = True) -> tuple[Any, ...]:
        """Return the hits on the terrain and on the vehicle, in the form that `hit` needs besides the rays."""
        hit = self.vehicle.scene.ray_intersect_preliminary(self._in_B(rays), coherent=coherent, active=active)
        return *self.surface.trace(rays, active, coherent=coherent), hit

    def hit(self, rays: Any, traced: tuple[Any, ...]) -> VehicleHit:
        """Return the nearer of the two hits of each ray."""
        ground, on_vehicle = self.surface.hit(rays, traced[:-1]), traced[-1]
        nearer = on_vehicle.is_valid() & (~ground.valid | (on_vehicle.t < ground.distance_m))
        normal, material = self.vehicle.facet(on_vehicle.prim_index, nearer)
        normal = self._in_L(normal)
        normal = dr.mulsign(normal, -dr.dot(normal, rays.d))  # towards the viewer
        return VehicleHit(ground, nearer, on_vehicle.t, normal, material, rays)

    def occluded(self, rays: Any, active: Any, *, coherent: bool = True) -> Any:
        """Return whether anything lies along the rays."""
        behind = self.vehicle.occluded(self._in_B(rays), active, coherent=coherent)
        return behind | self.surface.occluded(rays, active & ~behind, coherent=coherent)

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


class VehicleHit:
    """Hold hits of which some are on the vehicle and the others on the ground."""

    def __init__(self, ground: Hit, nearer: Any, distance_m: Any, normal: Any, material: Any, rays: Any) -> None:
        self._ground, self._rays = ground, rays
        self.on_vehicle, self.material = nearer, material
        self.valid = ground.valid | nearer
        self.distance_m = dr.select(nearer, distance_m, ground.distance_m)
        self.normal = dr.select(nearer, normal, ground.normal)

    @cached_property
    def dust(self) -> Any:
        """Return the dust cover of the ground; 0 on the vehicle."""
        return dr.select(self.on_vehicle, 0, self._ground.dust)

    @property
    def point(self) -> Any:
        """Return the positions of the hits in L."""
        return self._rays(self.distance_m)

    def shading_normal(self, detail: Detail | None, dither: Any) -> Any:
        """Return the ground's shading normal; the vehicle has no finer relief."""
        return dr.select(self.on_vehicle, self.normal, self._ground.shading_normal(detail, dither))

    def shadow_rays(self, direction: Any) -> Any:
        """Return rays from the hits in a direction; they start off the facet."""
        rays = self._ground.shadow_rays(direction)
        # the origin lies on the side on which the ray leaves
        side = dr.mulsign(mi.Vector3f(self.normal), dr.dot(self.normal, direction))
        rays.o = dr.select(self.on_vehicle, self._rays(self.distance_m) + side * _OFFSET_M, rays.o)
        return rays
