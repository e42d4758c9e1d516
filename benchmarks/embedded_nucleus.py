"""Make the two-lobed nucleus that ships with vbnfault, with the published dimensions of 67P.

    python benchmarks/embedded_nucleus.py

writes `scenes/bodies/embedded.npz`: `vertices_m` float64[n, 3] and `faces` int32[m, 3].

Dimensions and volume are from Jorda et al. 2016 (Icarus 277), the lobe centres from Preusker et al. 2015 (Table 4),
in the axes of 67P/C-G_FIXED. The orientation of the lobes and all relief are invented to resemble 67P: a smooth
neck, layered cliffs, plains with flat floors, and pits with steep walls.
"""

from __future__ import annotations

import numpy as np
import scipy.sparse
import scipy.sparse.csgraph
from numpy.typing import NDArray

from vbnfault.body.geometry import Float64, Int32, vertex_normals
from vbnfault.body.noise import fractal_noise, gradient_noise
from vbnfault.body.shape import check_mesh
from vbnfault.core.files.resources import data_dir

_SEED = 67
_SPACING_KM = 0.066
_BAND_KM = 0.45  # relief is computed within this distance of the smooth lobes; none is deeper
_METRES_PER_KM = 1000.0

# Semi-axes in km, centre in km, and directions of the short and the long axis (`_axes` makes them orthogonal).
_BIG = ((0.815, 1.76, 2.05), (-0.42, 0.26, -0.06), (0.71, -0.58, 0.41), (0.69, 0.70, -0.20))
_SMALL = ((0.82, 1.07, 1.25), (1.48, -0.34, 0.25), (0.91, -0.34, 0.22), (0.31, 0.94, 0.16))
_NECK_CENTRE_KM = (0.66, -0.20, -0.30)
_NECK_RADIUS_KM = 0.72
_SPUR_CENTRE_KM = (-1.35, -0.42, 0.10)  # the blunt end of the big lobe, which an ellipsoid lacks
_SPUR_RADIUS_KM = 0.95
_GROWTH_KM = -0.035  # even outward displacement of the surface, set so that the volume is 67P's

# Planes cut the lobes into flat faces with blunt edges. Each plane has a direction, and a distance from the lobe's
# centre as a fraction of that to the surface of the lobe grown by this factor. The first plane of each lobe is its
# great plain.
_GROWN = 1.08
_CUTS = (
    (((-0.75, 0.55, -0.38), 0.86), ((-0.30, -0.80, 0.45), 0.87), ((-0.20, 0.25, 0.95), 0.80),
     ((0.35, 0.75, -0.60), 0.86), ((0.15, -0.55, -0.85), 0.80), ((-0.10, 0.98, 0.25), 0.89),
     ((-0.85, -0.50, 0.20), 0.93), ((-0.45, 0.05, -0.90), 0.80), ((0.85, -0.50, -0.10), 0.90)),
    (((0.93, -0.25, 0.25), 0.86), ((0.25, 0.60, 0.80), 0.87), ((0.30, -0.70, 0.65), 0.86),
     ((0.35, 0.75, -0.55), 0.88), ((0.40, -0.60, -0.75), 0.87), ((-0.30, -0.95, 0.10), 0.90)),
)  # fmt: skip

# (direction from the lobe's centre, lobe, diameter km, depth/diameter, flatness of the floor 0-1)
_PITS = (
    ((-0.25, 0.75, 0.75), 0, 0.34, 0.55, 0.9),  # Seth: steep, active pits in a row
    ((-0.45, 0.60, 0.78), 0, 0.26, 0.60, 0.9),
    ((-0.05, 0.85, 0.62), 0, 0.22, 0.60, 0.9),
    ((-0.60, 0.40, 0.85), 0, 0.42, 0.35, 0.8),
    ((0.75, -0.25, 0.60), 1, 0.95, 0.20, 0.8),  # Hatmehit
    ((0.30, 0.90, 0.40), 1, 0.45, 0.20, 0.5),
    ((0.10, -0.90, 0.45), 1, 0.40, 0.25, 0.4),
    ((0.55, 0.20, -0.85), 1, 0.55, 0.18, 0.3),
    ((-0.55, -0.30, 0.80), 0, 0.90, 0.16, 0.7),  # Aten
    ((-0.80, 0.55, -0.15), 0, 1.35, 0.10, 0.9),  # Imhotep
    ((-0.55, 0.10, -0.85), 0, 0.70, 0.18, 0.3),
    ((0.05, 0.75, -0.80), 0, 0.85, 0.15, 0.4),
    ((-0.10, -0.95, -0.25), 0, 0.60, 0.20, 0.4),
    ((-0.75, -0.50, -0.10), 0, 0.50, 0.22, 0.5),
    ((0.55, 0.90, 0.05), 0, 0.55, 0.18, 0.4),
    ((-0.30, -0.65, -0.75), 0, 0.38, 0.25, 0.4),
    ((-0.95, 0.05, 0.20), 0, 0.30, 0.22, 0.4),
)


def _axes(short: tuple[float, ...], long: tuple[float, ...]) -> Float64:
    """Return a lobe's unit axes as rows, float64[3, 3]: short, middle, long."""
    a = np.array(short) / np.linalg.norm(short)
    c = np.array(long) - np.dot(long, a) * a
    c /= np.linalg.norm(c)
    return np.stack([a, np.cross(c, a), c])


def _lobe(points: Float64, lobe: tuple, cuts: tuple) -> Float64:
    """Return the first-order signed distance to the cut ellipsoid in km, negative inside."""
    semi = _GROWN * np.array(lobe[0])
    axes = _axes(lobe[2], lobe[3])
    offset = points - np.array(lobe[1])
    scaled = np.einsum("ni,ki->nk", offset, axes) / semi
    k0 = np.linalg.norm(scaled, axis=-1)
    k1 = np.linalg.norm(scaled / semi, axis=-1)
    distance = k0 * (k0 - 1.0) / np.maximum(k1, 1e-9)
    for direction, fraction in cuts:
        normal = np.array(direction) / np.linalg.norm(direction)
        plane = np.einsum("ni,i->n", offset, normal) - fraction * np.linalg.norm(semi * (axes @ normal))
        distance = -_smooth_min(-distance, -plane, 0.14)
    return distance


def _smooth_min(a: NDArray, b: NDArray, width: float) -> NDArray:
    """Return the minimum, rounded where a and b differ by less than `width`."""
    least = np.minimum(a, b)
    near = np.flatnonzero(np.abs(a - b) < width)
    h = (width - np.abs(a[near] - b[near])) / width
    least[near] -= h**3 * width / 6.0
    return least


def _smooth_step(low: float, high: float, x: NDArray) -> NDArray:
    """Return a smooth step from 0 at `low` to 1 at `high`."""
    t = np.clip((x - low) / (high - low), 0.0, 1.0)
    return t * t * (3.0 - 2.0 * t)


def _terraces(height: NDArray, step: float) -> NDArray:
    """Return heights with slopes turned into treads and risers of the given step, like layered cliffs."""
    k = height / step
    base = np.floor(k)
    return step * (base + _smooth_step(0.62, 0.98, k - base))


def _smooth_body(points: Float64) -> tuple[Float64, Float64]:
    """Return the signed distance to lobes and neck in km, and how far each point belongs to the neck (0-1)."""
    big, small = _lobe(points, _BIG, _CUTS[0]), _lobe(points, _SMALL, _CUTS[1])
    neck = np.linalg.norm((points - np.array(_NECK_CENTRE_KM)) / np.array([0.75, 1.0, 1.0]), axis=-1)
    neck = neck - _NECK_RADIUS_KM
    spur = np.linalg.norm(points - np.array(_SPUR_CENTRE_KM), axis=-1) - _SPUR_RADIUS_KM
    distance = _smooth_min(_smooth_min(_smooth_min(big, spur, 0.5), small, 0.30), neck, 0.35)
    # The region Hapi is the saddle, where both lobes' surfaces are about equally far.
    saddle = 1.0 - _smooth_step(0.10, 0.42, np.maximum(np.abs(big - small), 0.8 * np.maximum(big, small)))
    return distance, saddle


def _pits(points: Float64) -> tuple[Float64, Float64]:
    """Return the depth of the pits (km, positive inwards, rims negative) and the flatness of their floors (0-1)."""
    depth = np.zeros(len(points))
    flat = np.zeros(len(points))
    wobble = 0.16 * gradient_noise(points / 0.25, _SEED + 5) + 0.10 * gradient_noise(points / 0.1, _SEED + 6)
    for direction, lobe, diameter, ratio, floor in _PITS:
        semi, centre, short, long = (_BIG, _SMALL)[lobe]
        axes = _axes(short, long)
        unit = np.array(direction) / np.linalg.norm(direction)
        reach = 1.0 / np.linalg.norm((axes @ unit) / np.array(semi))
        offset = points - (np.array(centre) + reach * unit)
        # The profile depends on the distance across the pit's axis alone, within a limit along the axis. Walls are
        # then steep on curved ground, too.
        normal = axes.T @ ((axes @ unit) / np.array(semi) ** 2)
        normal /= np.linalg.norm(normal)
        along = np.einsum("ni,i->n", offset, normal)
        across = np.sqrt(np.maximum(np.einsum("ij,ij->i", offset, offset) - along**2, 0.0))
        x = across / (0.5 * diameter) * (1.0 + 0.9 * wobble)
        near = 1.0 - _smooth_step(0.55, 0.9, np.abs(along) / max(diameter, 0.6))
        wall = 0.5 * (1.0 - floor) + 0.12
        bowl = 1.0 - _smooth_step(1.0 - 2.0 * wall, 1.02, x)
        rim = np.exp(-(((x - 1.08) / 0.16) ** 2))
        depth += near * diameter * (ratio * bowl - 0.025 * rim)
        flat = np.maximum(flat, near * floor * (1.0 - _smooth_step(0.6, 0.85, x)) * (diameter > 0.4))
    return depth, flat


def _relief(points: Float64, saddle: Float64) -> Float64:
    """Return the outward displacement in km."""
    warp = np.column_stack([gradient_noise(points / 0.7, _SEED + 11 + k) for k in range(3)])
    p = points + 0.18 * warp
    broad = fractal_noise(p, _SEED, np.array([1.7, 0.85]), np.array([0.36, 0.17]))
    layered = _terraces(broad + 0.10 * gradient_noise(p / 0.45, _SEED + 21), 0.085)
    ridged = 0.3 - np.abs(gradient_noise(p / 0.42, _SEED + 31))
    fine = fractal_noise(points, _SEED + 41, np.array([0.36, 0.21, 0.13]), np.array([0.06, 0.045, 0.035]))
    depth, flat = _pits(points)
    calm = np.maximum(0.92 * saddle, 0.85 * flat)
    rough = 0.25 * broad + 0.75 * layered + 0.12 * ridged + fine
    return rough * (1.0 - calm) - depth * (1.0 - saddle)


def _umbrella(faces: Int32, count: int) -> scipy.sparse.csr_matrix:
    """Return the matrix that averages the neighbours of each vertex."""
    i = np.concatenate([faces[:, [0, 1, 2]].ravel(), faces[:, [1, 2, 0]].ravel()])
    j = np.concatenate([faces[:, [1, 2, 0]].ravel(), faces[:, [0, 1, 2]].ravel()])
    matrix = scipy.sparse.csr_matrix((np.ones(len(i)), (i, j)), shape=(count, count))
    return scipy.sparse.diags(1.0 / np.asarray(matrix.sum(axis=1)).ravel()) @ matrix


def made_nucleus() -> tuple[Float64, Int32]:
    """Return the vertices float64[n, 3] in metres and the faces int32[m, 3], closed, wound outwards."""
    import skimage.measure

    low, high = np.array([-2.95, -2.25, -2.15]), np.array([2.95, 2.35, 2.10])
    shape = np.ceil((high - low) / _SPACING_KM).astype(int) + 1
    axes = [low[k] + _SPACING_KM * np.arange(shape[k]) for k in range(3)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    distance, saddle = _smooth_body(grid)
    band = np.abs(distance) < _BAND_KM
    distance[band] -= _relief(grid[band], saddle[band]) + _GROWTH_KM
    vertices, faces, _, _ = skimage.measure.marching_cubes(
        distance.reshape(tuple(shape)).astype(np.float32), 0.0, spacing=(_SPACING_KM,) * 3
    )
    vertices = vertices.astype(np.float64) + low
    faces = _largest_piece(np.ascontiguousarray(faces).astype(np.int32), len(vertices))
    used, index = np.unique(faces, return_inverse=True)
    vertices, faces = vertices[used], index.reshape(-1, 3).astype(np.int32)

    # Marching cubes leaves slivers and steps. The first step smooths in all directions, the others only along the
    # surface.
    average = _umbrella(faces, len(vertices))
    for step in range(6):
        move = average @ vertices - vertices
        if step >= 1:
            normals = vertex_normals(vertices, faces)
            move -= normals * np.einsum("ij,ij->i", move, normals)[:, None]
        vertices = vertices + 0.55 * move
    return check_mesh(_METRES_PER_KM * vertices, faces, "embedded nucleus")


def _largest_piece(faces: Int32, count: int) -> Int32:
    """Return the faces of the connected piece that has the most faces."""
    ones = np.ones(len(faces) * 2)
    rows, columns = faces[:, [0, 1]].ravel(), faces[:, [1, 2]].ravel()
    graph = scipy.sparse.csr_matrix((ones, (rows, columns)), shape=(count, count))
    label = scipy.sparse.csgraph.connected_components(graph, directed=False)[1][faces[:, 0]]
    return faces[label == np.argmax(np.bincount(label))]


if __name__ == "__main__":
    vertices_m, faces = made_nucleus()
    np.savez_compressed(data_dir("scenes") / "bodies" / "embedded.npz", vertices_m=vertices_m, faces=faces)
