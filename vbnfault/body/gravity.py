"""Compute the gravity of a homogeneous polyhedron.

The formulas are those of Werner & Scheeres 1996, Celest. Mech. Dyn. Astron. 65, 313-344:

    U = ½ Gρ (Σ_e L_e r_e·E_e·r_e - Σ_f ω_f r_f·F_f·r_f)
    ∇U = -Gρ (Σ_e L_e E_e·r_e - Σ_f ω_f F_f·r_f)

The sums run over edges e and faces f. The vector r_e or r_f points from the field point to any point of the edge or
face. E and F are dyads of normals. L_e is the logarithmic term of an edge. ω_f is the solid angle of a face.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .geometry import Float64, face_normals_areas, signed_volume

GRAVITATIONAL_CONSTANT = 6.67430e-11  # m³ kg⁻¹ s⁻², CODATA 2018


class GravityField(NamedTuple):
    """Hold the gravity at k points: the potential and its gradient, which is the acceleration.

    The potential is positive; far from the body it is U = GM/r.
    """

    potential_m2_s2: Float64
    acceleration_m_s2: Float64


class PolyhedronGravity:
    """Compute the gravity of a polyhedron; the constructor computes the dyads of edges and faces once.

    The field is valid inside the body, outside the body and on its surface. At a point on an edge, the logarithm of
    this edge is infinite but its factor is 0, so the code limits the logarithm. The result at a point is the same
    to the bit whatever other points are in the call. For this, all sums run over the mesh alone and avoid BLAS,
    whose order of summation changes with the number of threads and the shapes of the arrays.

    Parameters
    ----------
    vertices_m
        float64[n, 3], metres.
    faces
        int[m, 3], closed, outward winding.
    density_kg_m3
        Bulk density, > 0.
    """

    def __init__(self, vertices_m: NDArray, faces: NDArray, density_kg_m3: float) -> None:
        self.density_kg_m3 = float(density_kg_m3)
        # Coordinates start at the centre of the bounding box. The terms of the sums nearly cancel, and with small
        # coordinates they lose fewer digits.
        self._centre_m: Float64 = 0.5 * (vertices_m.max(axis=0) + vertices_m.min(axis=0)).astype(np.float64)
        self._vertices_m: Float64 = np.asarray(vertices_m, dtype=np.float64) - self._centre_m
        self._faces = np.asarray(faces, dtype=np.int64)
        self.mass_kg = self.density_kg_m3 * signed_volume(self._vertices_m, self._faces)

        normals, _ = face_normals_areas(self._vertices_m, self._faces)
        self._face_normal = normals
        self._face_offset_m: Float64 = np.einsum("fi,fi->f", normals, self._vertices_m[self._faces[:, 0]])

        directed = np.concatenate([self._faces[:, [k, (k + 1) % 3]] for k in range(3)])
        owner = np.tile(np.arange(len(self._faces)), 3)
        along = self._vertices_m[directed[:, 1]] - self._vertices_m[directed[:, 0]]
        length = np.linalg.norm(along, axis=1)
        # Unit vectors in the plane of the face, perpendicular to the edge. They point out of the face, because the
        # winding is counter-clockwise.
        outward = np.cross(along / length[:, None], normals[owner])
        half_dyad = np.einsum("ei,ej->eij", normals[owner], outward)
        key = directed.min(axis=1) * len(self._vertices_m) + directed.max(axis=1)
        _, first, inverse = np.unique(key, return_index=True, return_inverse=True)
        dyad = np.zeros((len(first), 9))
        np.add.at(dyad, inverse.ravel(), half_dyad.reshape(-1, 9))
        self._edges = directed[first]
        self._edge_length_m: Float64 = length[first]
        self._edge_dyad: Float64 = dyad.reshape(-1, 3, 3)
        self._edge_start_m: Float64 = self._vertices_m[self._edges[:, 0]]

    def evaluate(self, points_m: ArrayLike) -> GravityField:
        """Return the potential and the acceleration of gravity, without the centrifugal term.

        Parameters
        ----------
        points_m
            float64[k, 3] or [3], in the frame of the vertices.

        Returns
        -------
        GravityField
            float64[k] in m²/s² and float64[k, 3] in m/s².
        """
        points = np.atleast_2d(np.asarray(points_m, dtype=np.float64)) - self._centre_m
        potential = np.empty(len(points))
        acceleration = np.empty((len(points), 3))
        # A loop over points is fast enough, because tens of thousands of edges fill the vector units. The loop
        # needs memory for only one array over the mesh.
        for k, point in enumerate(points):
            potential[k], acceleration[k] = self._at(point)
        return GravityField(potential, acceleration)

    def _at(self, point: Float64) -> tuple[float, Float64]:
        """Return potential and acceleration at a point, whose coordinates start at the centre of the box."""
        to_vertex = self._vertices_m - point
        distance = np.sqrt(np.einsum("vi,vi->v", to_vertex, to_vertex))

        to_edge = self._edge_start_m - point
        ends = distance[self._edges[:, 0]] + distance[self._edges[:, 1]]
        # Far away, ln((a+b+e)/(a+b−e)) loses digits, but 2 artanh(e/(a+b)), which is equal, does not.
        ratio = np.minimum(self._edge_length_m / np.maximum(ends, 1e-300), 1.0 - 1e-16)
        log_term = 2.0 * np.arctanh(ratio)
        edge_vector = np.einsum("eij,ej->ei", self._edge_dyad, to_edge) * log_term[:, None]

        a, b, c = (to_vertex[self._faces[:, k]] for k in range(3))
        ra, rb, rc = (distance[self._faces[:, k]] for k in range(3))
        triple = np.einsum("fi,fi->f", a, np.cross(b, c))
        cosine = (
            ra * rb * rc
            + ra * np.einsum("fi,fi->f", b, c)
            + rb * np.einsum("fi,fi->f", c, a)
            + rc * np.einsum("fi,fi->f", a, b)
        )
        solid_angle = 2.0 * np.arctan2(triple, cosine)
        height = self._face_offset_m - np.einsum("fi,i->f", self._face_normal, point)
        weighted = height * solid_angle

        gravity = GRAVITATIONAL_CONSTANT * self.density_kg_m3
        potential = 0.5 * gravity * (np.sum(to_edge * edge_vector) - np.sum(weighted * height))
        acceleration = gravity * (-edge_vector.sum(axis=0) + (self._face_normal * weighted[:, None]).sum(axis=0))
        return float(potential), acceleration

    def effective(self, points_m: ArrayLike, omega_rad_s: float) -> Float64:
        """Return gravity plus the centrifugal term of a rotation about +z, float64[k, 3] in m/s²."""
        points = np.atleast_2d(np.asarray(points_m, dtype=np.float64))
        acceleration = self.evaluate(points).acceleration_m_s2
        acceleration[:, :2] += omega_rad_s**2 * points[:, :2]
        return acceleration
