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
from .runtime import dr, mi, packets
from .sampling import opaque_vector

if TYPE_CHECKING:
    from .surface import Hit, TerrainMesh

# Distance from the facet at which shadow rays start: far above float32's resolution at 1 km, far below a part's
# size.
_OFFSET_M = 5e-4

# Rays that start this close to the camera's centre, or within its aperture, are rays of the camera.
_AT_CAMERA_M = 1e-6

# Facets narrower than this are sampled by themselves, if they are wholly farther than so many metres.
_THIN_PX, _NEAREST_M = 1.0, 0.05


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
        self._corners_m = vertices_m[faces].astype(np.float64)
        used = self._corners_m.reshape(-1, 3)
        self.centre_m = (used.min(axis=0) + used.max(axis=0)) / 2
        self.radius_m = 1.001 * float(np.linalg.norm(used - self.centre_m, axis=1).max()) + 1e-3
        a, b, c = (vertices_m[faces[:, k]].astype(np.float64) for k in range(3))
        normal = np.cross(b - a, c - a)
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)
        # four floats per facet, fetched in one packet: its normal and its material
        self._facets = packets(mi.Float, np.column_stack([normal, face_material]).astype(np.float32))
        self._reflectance = [mi.Float(np.ascontiguousarray(column, np.float32)) for column in reflectance.T]
        dr.eval(self._facets, *self._reflectance)

    def facet(self, index: Any, active: Any) -> tuple[Any, Any]:
        """Return the normal in B and the material of facets."""
        record = dr.gather(mi.Vector4f, self._facets, index, active)
        return mi.Vector3f(record.xyz), mi.UInt32(record.w)

    def thin_in(self, view: View) -> NDArray[np.bool_]:
        """Return which facets before the camera are narrower than a pixel in a view, bool[m]."""
        corners = self._corners_m
        z = np.maximum(corners[..., 2], _NEAREST_M)
        x, y = (corners[..., k] / z * view.intrinsics[k] for k in (0, 1))
        sides = [(np.roll(x, -1, axis=1) - x), (np.roll(y, -1, axis=1) - y)]
        twice_area = np.abs(sides[0][:, 0] * sides[1][:, 1] - sides[0][:, 1] * sides[1][:, 0])
        longest = np.hypot(*sides).max(axis=1)
        half = np.array([view.width_px, view.height_px]) / 2 + np.abs(view.intrinsics[2:])
        inside = (np.abs(x).min(axis=1) < half[0]) & (np.abs(y).min(axis=1) < half[1])
        before = (corners[..., 2] > _NEAREST_M).all(axis=1)
        return np.asarray((twice_area < _THIN_PX * longest) & before & inside)

    def corners_of(self, facets: NDArray[np.intp]) -> NDArray[np.float64]:
        """Return the corners of facets in B, float64[n, corner, 3]."""
        return self._corners_m[facets]

    def slopes_in(self, view: View) -> NDArray[np.float64]:
        """Return bounds of x/z and y/z in B beyond which no ray of a camera meets a part, float64[2, axis].

        The lower bounds lie above the upper ones if the camera sees no part.
        """
        fx, fy, cx, cy = view.intrinsics
        low = np.array([-cx / fx, -cy / fy])
        high = np.array([(view.width_px - cx) / fx, (view.height_px - cy) / fy])
        aperture, corners = view.aperture_radius_m, self._corners_m
        z = corners[..., 2]
        # a facet is out of sight if all its corners lie behind the camera or beyond the same side of the field
        hidden = (z <= 0).all(axis=1)
        for axis in (0, 1):
            x = corners[..., axis]
            hidden |= (x + aperture < low[axis] * z).all(axis=1) | (x - aperture > high[axis] * z).all(axis=1)
        seen = corners[~hidden]
        if not len(seen):
            return np.array([high + 1, low - 1])
        if (seen[..., 2] < 1e-2).any():
            return np.array([low - 1, high + 1])
        slopes, margin = seen[..., :2] / seen[..., 2:], aperture / seen[..., 2:]
        least, most = (slopes - margin).min(axis=(0, 1)), (slopes + margin).max(axis=(0, 1))
        return np.array([least - 1e-3, most + 1e-3])

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


class VehicleHit:
    """Hold hits of which some are on the vehicle and the others on the ground."""

    def __init__(self, ground: Hit, nearer: Any, on_vehicle: Any, normal: Any, material: Any, rays: Any) -> None:
        self._ground, self._rays, self.start_m = ground, rays, 0.0
        self.on_vehicle, self.material, self.facet = nearer, material, on_vehicle.prim_index
        self.valid = ground.valid | nearer
        self.distance_m = dr.select(nearer, on_vehicle.t, ground.distance_m)
        self.normal = dr.select(nearer, normal, ground.normal)

    @cached_property
    def dust(self) -> Any:
        """Return the dust cover of the ground; 0 on the vehicle."""
        return dr.select(self.on_vehicle, 0, self._ground.dust)

    @property
    def point(self) -> Any:
        """Return the positions of the hits in L."""
        return self._rays(self.distance_m)

    @property
    def range_m(self) -> Any:
        """Return the distance from the camera, whose rays start at its pupil."""
        return self.distance_m

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
