"""Compute the gravity of a homogeneous polyhedron.

The formulas are those of Werner & Scheeres 1996, Celest. Mech. Dyn. Astron. 65, 313-344:

    U = ½ Gρ (Σ_e L_e r_e·E_e·r_e - Σ_f ω_f r_f·F_f·r_f)
    ∇U = -Gρ (Σ_e L_e E_e·r_e - Σ_f ω_f F_f·r_f)

The sums run over edges e and faces f. The vector r_e or r_f points from the field point to any point of the edge or
face. E and F are dyads of normals. L_e is the logarithmic term of an edge. ω_f is the solid angle of a face.
"""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..core.process.llvm import backend, flat
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
        vertices: Float64 = np.asarray(vertices_m, dtype=np.float64) - self._centre_m
        corner = np.asarray(faces, dtype=np.int64)
        self.mass_kg = self.density_kg_m3 * signed_volume(vertices, corner)

        normals, _ = face_normals_areas(vertices, corner)
        offset = np.einsum("fi,fi->f", normals, vertices[corner[:, 0]])

        directed = np.concatenate([corner[:, [k, (k + 1) % 3]] for k in range(3)])
        owner = np.tile(np.arange(len(corner)), 3)
        along = vertices[directed[:, 1]] - vertices[directed[:, 0]]
        length = np.linalg.norm(along, axis=1)
        # Unit vectors in the plane of the face, perpendicular to the edge. They point out of the face, because the
        # winding is counter-clockwise.
        outward = np.cross(along / length[:, None], normals[owner])
        half_dyad = np.einsum("ei,ej->eij", normals[owner], outward)
        key = directed.min(axis=1) * len(vertices) + directed.max(axis=1)
        _, first, inverse = np.unique(key, return_index=True, return_inverse=True)
        dyad = np.zeros((len(first), 9))
        np.add.at(dyad, inverse.ravel(), half_dyad.reshape(-1, 9))
        start, end = (vertices[directed[first, k]] for k in (0, 1))
        corners = vertices[corner].reshape(-1, 9)
        # columns of a table of all edges and of one of all faces, as `_edge_terms` and `_face_terms` take them
        self._edge_table = [flat(column) for column in (*start.T, *end.T, length[first], *dyad.T)]
        self._face_table = [flat(column) for column in (*corners.T, *normals.T, offset)]

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
        # needs memory for only a few arrays over the mesh.
        be = backend()
        edges, faces = ([be.Float64(column) for column in table] for table in (self._edge_table, self._face_table))
        for k, point in enumerate(points):
            potential[k], acceleration[k] = self._at(point, edges, faces)
        return GravityField(potential, acceleration)

    def _at(self, point: Float64, edges: list[Any], faces: list[Any]) -> tuple[float, Float64]:
        """Return potential and acceleration at a point, whose coordinates start at the centre of the box.

        The terms are computed on the device, and summed by numpy, whose order does not depend on threads.
        """
        be = backend()
        terms = _terms()(edges, faces, [be.dr.opaque(be.Float64, float(x)) for x in point])
        be.dr.eval(*terms)
        be.dr.sync_thread()
        of_edges, of_faces = np.split(np.array([np.array(term, copy=False).sum() for term in terms]), 2)
        gravity = GRAVITATIONAL_CONSTANT * self.density_kg_m3
        return 0.5 * gravity * float(of_edges[0] - of_faces[0]), gravity * (of_faces[1:] - of_edges[1:])

    def effective(self, points_m: ArrayLike, omega_rad_s: float) -> Float64:
        """Return gravity plus the centrifugal term of a rotation about +z, float64[k, 3] in m/s²."""
        points = np.atleast_2d(np.asarray(points_m, dtype=np.float64))
        acceleration = self.evaluate(points).acceleration_m_s2
        acceleration[:, :2] += omega_rad_s**2 * points[:, :2]
        return acceleration


@functools.lru_cache(maxsize=1)
def _terms() -> Any:
    """Return the function that gives the four terms of edges and those of faces.

    Tracing is done once, for all meshes, since a fall asks for thousands of single points.
    """
    be = backend()
    return be.dr.freeze(lambda edges, faces, here: [*_edge_terms(be, edges, here), *_face_terms(be, faces, here)])


def _edge_terms(be: Any, table: list[Any], point: list[Any]) -> list[Any]:
    """Return L r·E·r and L E·r of the edges, four device arrays."""
    dr, start, end, length, dyad = be.dr, table[0:3], table[3:6], table[6], table[7:]
    r = [x - p for x, p in zip(start, point, strict=True)]
    ends = _norm(dr, r) + _norm(dr, [x - p for x, p in zip(end, point, strict=True)])
    # Far away, ln((a+b+e)/(a+b-e)) loses digits, but 2 artanh(e/(a+b)), which is equal, does not.
    ratio = dr.minimum(length / dr.maximum(ends, 1e-300), 1.0 - 1e-16)
    log_term = 2 * dr.atanh(ratio)
    vector = [_dot(dyad[3 * k : 3 * k + 3], r) * log_term for k in range(3)]
    return [_dot(r, vector), *vector]


def _face_terms(be: Any, table: list[Any], point: list[Any]) -> list[Any]:
    """Return ω r·F·r and ω F·r of the faces, four device arrays."""
    dr, normal, offset = be.dr, table[9:12], table[12]
    a, b, c = ([x - p for x, p in zip(table[k : k + 3], point, strict=True)] for k in (0, 3, 6))
    across = [b[1] * c[2] - b[2] * c[1], b[2] * c[0] - b[0] * c[2], b[0] * c[1] - b[1] * c[0]]
    ra, rb, rc = (_norm(dr, x) for x in (a, b, c))
    cosine = ra * rb * rc + ra * _dot(b, c) + rb * _dot(c, a) + rc * _dot(a, b)
    height = offset - _dot(normal, point)
    weighted = height * 2 * dr.atan2(_dot(a, across), cosine)
    return [weighted * height, *(n * weighted for n in normal)]


def _dot(a: list[Any], b: list[Any]) -> Any:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _norm(dr: Any, a: list[Any]) -> Any:
    return dr.sqrt(_dot(a, a))
