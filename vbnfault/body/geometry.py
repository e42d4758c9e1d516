"""Compute normals, areas, volumes and centres of triangle meshes, block by block on two threads."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
from numpy.typing import NDArray

Float64 = NDArray[np.float64]
Int32 = NDArray[np.int32]

_ROWS = 1 << 15  # the temporaries of a step then fit the cache of the processor
_THREADS = 2


def in_blocks(step: Callable[..., tuple[NDArray[Any], ...]], *arrays: NDArray[Any]) -> tuple[NDArray[Any], ...]:
    """Call `step(*blocks)` for each block of rows of the arrays, and return the arrays that it gives, joined.

    All arrays have equally many rows. `step` must treat each row on its own, so that the bits do not depend on the
    blocks.
    """
    count = len(arrays[0])
    if count <= _ROWS:
        return step(*arrays)
    blocks = [slice(start, start + _ROWS) for start in range(0, count, _ROWS)]
    with ThreadPoolExecutor(_THREADS) as pool:  # numpy uses one core
        parts = list(pool.map(lambda rows: step(*(array[rows] for array in arrays)), blocks))
    return tuple(np.concatenate(part) for part in zip(*parts, strict=True))


def signed_volume(vertices: NDArray, faces: NDArray) -> float:
    """Return the volume by the divergence theorem, positive for outward winding, in the vertices' unit cubed."""
    a, b, c = (vertices[faces[:, k]].astype(np.float64) for k in range(3))
    return float(np.sum(a * np.cross(b, c)) / 6.0)


def centre_of_mass(vertices: NDArray, faces: NDArray) -> Float64:
    """Return the centre of mass of a closed, homogeneous mesh, float64[3] in the vertices' unit.

    It is the mean of the centroids of the tetrahedra from one point to each face, weighted with their signed
    volumes. The point is the centre of the bounding box, near which the terms lose few digits.
    """
    middle = 0.5 * (vertices.max(axis=0) + vertices.min(axis=0)).astype(np.float64)
    a, b, c = (vertices[faces[:, k]].astype(np.float64) - middle for k in range(3))
    volume = np.sum(a * np.cross(b, c), axis=1)
    return np.asarray(middle + np.sum(volume[:, None] * (a + b + c), axis=0) / (4 * volume.sum()))


def face_normals_areas(vertices: NDArray, faces: NDArray) -> tuple[Float64, Float64]:
    """Return outward unit normals float64[m, 3] (zero if degenerate) and areas float64[m] in the unit squared."""
    x, y, z = _face_crosses(vertices, faces)
    length = np.sqrt(x * x + y * y + z * z)
    return np.column_stack([x, y, z]) / np.where(length > 0, length, 1.0)[:, None], 0.5 * length


def vertex_normals(vertices: NDArray, faces: NDArray) -> Float64:
    """Return area-weighted unit normals float64[n, 3]."""
    corner = faces.ravel().astype(np.intp)
    x, y, z = (
        np.bincount(corner, np.repeat(cross, 3), minlength=len(vertices))
        for cross in _face_crosses(vertices, faces)
    )
    length = np.sqrt(x * x + y * y + z * z)
    return np.column_stack([x, y, z]) / np.where(length > 0, length, 1.0)[:, None]


def _face_crosses(vertices: NDArray, faces: NDArray) -> tuple[Float64, Float64, Float64]:
    """Return the cross products of two edges of each face, as three components float64[m]."""
    # axis by axis, because numpy is several times slower on arrays of triples
    axes = [np.ascontiguousarray(vertices[:, axis], dtype=np.float64) for axis in range(3)]

    def crosses(faces: NDArray) -> tuple[Float64, Float64, Float64]:
        corners = [faces[:, k].astype(np.intp) for k in range(3)]
        (ux, uy, uz), (vx, vy, vz) = ([of.take(corners[k]) - of.take(corners[0]) for of in axes] for k in (1, 2))
        return uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx

    x, y, z = in_blocks(crosses, faces)
    return x, y, z


def face_centres(vertices: NDArray, faces: NDArray) -> Float64:
    """Return the means of the faces' corners, float64[m, 3]."""

    def means(faces: NDArray) -> tuple[Float64]:
        a, b, c = (vertices.take(faces[:, k], axis=0) for k in range(3))
        return (((a + b) + c) / 3,)

    (out,) = in_blocks(means, faces)
    return out


def mean_edge_m(vertices_m: NDArray, faces: NDArray) -> float:
    """Return the mean edge length of a mesh, metres."""
    side = vertices_m[faces] - vertices_m[np.roll(faces, 1, axis=1)]
    return float(np.linalg.norm(side, axis=2).mean())
