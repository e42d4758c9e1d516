"""Split the edges of a mesh near a site until they meet a length limit, without any seam."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from .geometry import Float64, Int32, in_blocks

# Splitting halves an edge, so final lengths lie between half the limit and the limit. With this ratio of limit to
# target, their mean is near the target.
LIMIT_PER_TARGET = 1.6
# Beyond the radius, the limit grows as this power of the distance, a little faster than the width of a pixel. The
# number of triangles per octave of distance then falls as the distance to the power -0.2, until the body ends.
GROWTH_POWER = 1.1
_PROBE = 4.0  # the number of triangles is predicted with facets coarser by this factor, which is much faster
_PROBE_BUDGETS = 4.0  # or by a larger one, if that could take more than this many times the triangles allowed
# A midpoint may leave the chord by at most this fraction of the edge, so that cliffs do not bulge.
_MAX_BULGE = 0.06


@dataclass(frozen=True)
class EdgeLimit:
    """Compute the longest edge that is left unsplit, in metres, at points relative to the site."""

    facet_m: float
    radius_m: float

    def facet_at(self, points: Float64) -> Float64:
        """Return the target mean edge length at the points, metres."""
        return self(points) / LIMIT_PER_TARGET

    def __call__(self, points: Float64) -> Float64:
        return self._at(np.sqrt(np.einsum("...i,...i->...", points, points)))

    def along(self, a: Float64, b: Float64) -> Float64:
        """Return the limit at the point of each edge a-b that is nearest the site.

        A long edge can pass the site between two far ends. The point is kept within the middle half of the edge.
        """
        edge = b - a
        nearest = np.einsum("...i,...i->...", -a, edge) / np.maximum(np.einsum("...i,...i->...", edge, edge), 1e-30)
        return self(a + np.clip(nearest, 0.25, 0.75)[..., None] * edge)

    def _at(self, distance: Float64) -> Float64:
        """Return the limit at a distance from the site."""
        return LIMIT_PER_TARGET * self.facet_m * np.maximum(distance / self.radius_m, 1.0) ** GROWTH_POWER


def affordable(limit: EdgeLimit, model: tuple[Float64, Float64, Int32], budget: int) -> EdgeLimit:
    """Return the limit itself, or a coarser one that keeps the ground within about `budget` triangles.

    The prediction itself takes a few times `budget` triangles at most, however small the facets are.
    """
    before = len(model[2])
    excess = _most_triangles(limit, model) / (_PROBE**2 * _PROBE_BUDGETS * budget)
    probe = _PROBE * 2.0 ** max(int(np.ceil(np.log2(max(excess, 1.0)) / 2)), 0)
    while True:
        coarse = EdgeLimit(probe * limit.facet_m, limit.radius_m)
        added = len(refine(*model, coarse)[2]) - before
        if probe <= _PROBE or added > budget:
            break
        probe /= 2  # these facets are too coarse to predict the number of finer ones
    wanted = added * probe**2
    # a probe splits no edge of a model whose facets are as small as its own
    while probe > 1 and added < before and before + wanted <= budget:
        probe /= 2
        added = len(refine(*model, EdgeLimit(probe * limit.facet_m, limit.radius_m))[2]) - before
        wanted = added * probe**2
    if before + wanted <= budget:
        return limit
    return EdgeLimit(limit.facet_m * float(np.sqrt(wanted / (budget - before))), limit.radius_m)


def _most_triangles(limit: EdgeLimit, model: tuple[Float64, Float64, Int32]) -> float:
    """Return a number of triangles that refining a model hardly exceeds.

    All of a face gets facets as small as those at its point nearest the site.
    """
    points, _, faces = model
    corners = points[faces]
    centre = corners.mean(axis=1)
    extent = np.sqrt(np.max(np.sum((corners - centre[:, None]) ** 2, axis=2), axis=1))
    nearest = np.maximum(np.sqrt(np.sum(centre**2, axis=1)) - extent, 0.0)
    area = 0.5 * np.sqrt(
        np.sum(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]) ** 2, axis=1)
    )
    facet = limit.facet_at(np.column_stack([nearest, np.zeros((len(nearest), 2))]))
    return float(np.sum(area / (np.sqrt(3) / 4 * facet**2)))


def refine(points: Float64, normals: Float64, faces: Int32, limit: EdgeLimit) -> tuple[Float64, Float64, Int32]:
    """Split every edge longer than its limit, the longest first.

    Whether an edge is split depends on its own two ends alone. The triangles on both sides therefore agree, and the
    mesh stays conforming without a search for neighbours. Lengths are treated in steps of sqrt 2, the longest
    first. Each triangle is thereby split across its longest edge, which prevents degenerate angles.

    Returns points, normals and faces.
    """
    done: list[NDArray] = []
    active = faces.astype(np.int64)
    bar = np.inf
    while len(active):
        length, long = in_blocks(partial(_edges, points, limit), active)
        finished = ~(long[:, 0] | long[:, 1] | long[:, 2])  # numpy's `any` is slow along an axis of three
        done.append(active[finished])
        active, long, length = active[~finished], long[~finished], length[~finished]
        if not len(active):
            break
        bar = min(float(length[long].max()), bar) / np.sqrt(2.0)
        chosen = long & (length > bar)
        points, normals, active = split(points, normals, active, chosen, length)
    return points, normals, np.concatenate(done).astype(np.int32)


def _edges(points: Float64, limit: EdgeLimit, faces: NDArray[np.int64]) -> tuple[Float64, NDArray[np.bool_]]:
    """Return the length of each edge of the faces, float64[m, 3], and whether it exceeds its limit, bool[m, 3]."""
    ends = faces[:, [[1, 2], [2, 0], [0, 1]]]  # edge k is opposite corner k
    a, b = (points.take(ends[..., k], axis=0) for k in (0, 1))  # takes half as long as an index in brackets
    length = np.sqrt(np.einsum("fki,fki->fk", b - a, b - a))
    return length, length > limit.along(a, b)


def split(
    points: Float64, normals: Float64, faces: NDArray[np.int64], marked: NDArray[np.bool_], length: Float64
) -> tuple[Float64, Float64, NDArray[np.int64]]:
    """Insert the midpoints of the marked edges, and cut the triangles that have one, two or three of them."""
    ends = faces[:, [[1, 2], [2, 0], [0, 1]]][marked]
    low, high = np.minimum(ends[:, 0], ends[:, 1]), np.maximum(ends[:, 0], ends[:, 1])
    count = len(points)
    keys, inverse = np.unique(low * count + high, return_inverse=True)
    i, j = keys // count, keys % count
    new_points, new_normals = _midpoints(*(of.take(k, axis=0) for of in (points, normals) for k in (i, j)))
    middle = np.full(faces.shape, -1, dtype=np.int64)
    middle[marked] = count + inverse.ravel()

    one, other, third = marked.T.astype(np.int8)
    how_many = one + other + third
    out = [faces[how_many == 0]]

    marked_once = how_many == 1
    f, m = _turn(faces[marked_once], middle[marked_once], np.argmax(marked[marked_once], axis=1))
    out += [np.column_stack([f[:, 0], f[:, 1], m[:, 0]]), np.column_stack([f[:, 0], m[:, 0], f[:, 2]])]

    two = how_many == 2
    # Corners are renumbered so that edge 0 is the unsplit one. Corner 0 is cut off. The diagonal of the remaining
    # quadrilateral starts at the middle of its longer side, as in repeated longest-edge bisection.
    turn = np.argmin(marked[two], axis=1)
    f, m = _turn(faces[two], middle[two], turn)
    side = np.take_along_axis(length[two], (turn[:, None] + np.arange(3)) % 3, axis=1)
    from_m1 = side[:, 1] >= side[:, 2]
    out.append(np.column_stack([f[:, 0], m[:, 2], m[:, 1]]))
    g, n = f[from_m1], m[from_m1]
    out += [np.column_stack([n[:, 2], g[:, 1], n[:, 1]]), np.column_stack([g[:, 1], g[:, 2], n[:, 1]])]
    g, n = f[~from_m1], m[~from_m1]
    out += [np.column_stack([n[:, 2], g[:, 1], g[:, 2]]), np.column_stack([n[:, 2], g[:, 2], n[:, 1]])]

    f, m = faces[how_many == 3], middle[how_many == 3]
    out += [
        np.column_stack([f[:, 0], m[:, 2], m[:, 1]]),
        np.column_stack([f[:, 1], m[:, 0], m[:, 2]]),
        np.column_stack([f[:, 2], m[:, 1], m[:, 0]]),
        m,
    ]
    return np.concatenate([points, new_points]), np.concatenate([normals, new_normals]), np.concatenate(out)


def _turn(faces: NDArray, middle: NDArray, first: NDArray) -> tuple[NDArray, NDArray]:
    """Renumber each triangle's corners so that corner `first` comes first."""
    order = (first[:, None] + np.arange(3)) % 3
    return np.take_along_axis(faces, order, axis=1), np.take_along_axis(middle, order, axis=1)


def _midpoints(p: Float64, q: Float64, n_p: Float64, n_q: Float64) -> tuple[Float64, Float64]:
    """Return midpoints and normals on the curved point-normal triangle (Vlachos et al. 2001), bulge limited."""
    along = q - p
    bulge = (
        -(np.einsum("ij,ij->i", along, n_p)[:, None] * n_p - np.einsum("ij,ij->i", along, n_q)[:, None] * n_q) / 8.0
    )
    size = _length(bulge)
    most = _MAX_BULGE * _length(along)
    bulge *= np.minimum(1.0, most / np.maximum(size, 1e-12))[:, None]
    normal = n_p + n_q
    length = _length(normal)
    return 0.5 * (p + q) + bulge, normal / np.where(length > 1e-9, length, 1.0)[:, None]


def _length(vectors: Float64) -> Float64:
    """Return the lengths of vectors float64[n, 3], float64[n]."""
    x, y, z = vectors.T  # `numpy.linalg.norm` is slow along an axis of three
    return np.sqrt(x * x + y * y + z * z)
