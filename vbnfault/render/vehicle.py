"""Trace the spacecraft around the camera in its own frame.

The vehicle moves with the camera. Its mesh therefore stays as it is, and the rays are transformed into its frame B.
Nothing is built again from sample to sample, and parts near the camera keep the precision of float32.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from .description import View
from .runtime import columns, dr, mi, packets

# Facets narrower than this are sampled by themselves, if they are wholly farther than so many metres.
_THIN_PX, _NEAREST_M = 1.0, 0.05
_ANY_SLOPE = 1e30  # of a camera with distortion, which may see all parts


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

    `corners_m` float64[m, corner, 3] are the corners of the facets.
    """

    def __init__(
        self,
        vertices_m: NDArray[np.float32],
        faces: NDArray[np.int32],
        face_material: NDArray[np.int32],
        reflectance: NDArray[np.float64],
    ) -> None:
        self.scene = mesh_scene("vehicle", vertices_m, faces)
        self.corners_m = vertices_m[faces].astype(np.float64)
        used = self.corners_m.reshape(-1, 3)
        self.centre_m = (used.min(axis=0) + used.max(axis=0)) / 2
        self.radius_m = 1.001 * float(np.linalg.norm(used - self.centre_m, axis=1).max()) + 1e-3
        a, b, c = (self.corners_m[:, k] for k in range(3))
        normal = np.cross(b - a, c - a)
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)
        # four floats per facet, fetched in one packet: its normal and its material
        self._facets = packets(mi.Float, np.column_stack([normal, face_material]).astype(np.float32))
        self._reflectance = columns(reflectance)
        dr.eval(self._facets, *self._reflectance)

    def facet(self, index: Any, active: Any) -> tuple[Any, Any]:
        """Return the normal in B and the material of facets."""
        record = dr.gather(mi.Vector4f, self._facets, index, active)
        return mi.Vector3f(record.xyz), mi.UInt32(record.w)

    def thin_in(self, view: View) -> NDArray[np.bool_]:
        """Return which facets before the camera are narrower than a pixel in a view, bool[m]."""
        corners = self.corners_m
        z = np.maximum(corners[..., 2], _NEAREST_M)
        x, y = (corners[..., k] / z * view.intrinsics[k] for k in (0, 1))
        sides = [(np.roll(x, -1, axis=1) - x), (np.roll(y, -1, axis=1) - y)]
        twice_area = np.abs(sides[0][:, 0] * sides[1][:, 1] - sides[0][:, 1] * sides[1][:, 0])
        longest = np.hypot(*sides).max(axis=1)
        half = np.array([view.width_px, view.height_px]) / 2 + np.abs(view.intrinsics[2:])
        half = half if view.projection is None else half + np.inf
        inside = (np.abs(x).min(axis=1) < half[0]) & (np.abs(y).min(axis=1) < half[1])
        before = (corners[..., 2] > _NEAREST_M).all(axis=1)
        return np.asarray((twice_area < _THIN_PX * longest) & before & inside)

    def slopes_in(self, view: View) -> NDArray[np.float64]:
        """Return bounds of x/z and y/z in B beyond which no ray of a camera meets a part, float64[2, axis].

        The lower bounds lie above the upper ones if the camera sees no part.
        """
        if view.projection is not None:
            return np.array([[-_ANY_SLOPE] * 2, [_ANY_SLOPE] * 2])
        fx, fy, cx, cy = view.intrinsics
        low = np.array([-cx / fx, -cy / fy])
        high = np.array([(view.width_px - cx) / fx, (view.height_px - cy) / fy])
        aperture, corners = view.aperture_radius_m, self.corners_m
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


def mesh_scene(name: str, vertices_m: NDArray[np.float32], faces: NDArray[np.int32]) -> Any:
    """Return a Mitsuba scene of one triangle mesh: `vertices_m` float32[n, 3], `faces` int32[m, 3]."""
    mesh = mi.Mesh(name, len(vertices_m), len(faces))
    parameters = mi.traverse(mesh)
    # drjit keeps the numpy array that it is given; a copy lets go of the file that a patch is a part of
    parameters["vertex_positions"] = mi.Float(np.array(vertices_m, np.float32).ravel())
    parameters["faces"] = mi.UInt32(np.ascontiguousarray(faces, np.uint32).ravel())
    parameters.update()
    return mi.load_dict({"type": "scene", name: mesh})
