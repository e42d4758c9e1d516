"""Gather the slopes of a smoothed shape model into scarps, and tell where its ground is rough.

The ground of comets is flat treads and floors between scarps; a model of some ten thousand facets has gentle bumps
and hollows in their place. A shock filter (Osher & Rudin 1990, SIAM J. Numer. Anal. 27, 919, equation 1.6; with a
smooth curvature: Alvarez & Mazorra 1994, SIAM J. Numer. Anal. 31, 590) undoes this: what lies on a crest grows
towards the highest of its neighbours, what lies in a hollow sinks towards the lowest. Crests and floors become
flat, and the slope between them gathers in a scarp where the curvature changes its sign. Heights are those over the
model smoothed over some edges, since a cliff stands upright on the ground and not on its own slope. Where the model
is flat, nothing happens.

Scarps lie where the model has its slopes, but the model knows their lines no better than to a facet. Random
curvature makes them wander by less than that.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse
from scipy.spatial import cKDTree

from .body import Body
from .fields import GRADIENT_STD, Points
from .geometry import Float64, Int32, in_blocks, mean_edge_m, vertex_normals
from .noise import noise_key
from .roughness import smoothed

# Lengths in mean edges of the model: smoothing that leaves the ground on which heights are measured, smoothing that
# tells crests from hollows, and neighbourhood of the local roughness
_GROUND_EDGES, _CREST_EDGES, _AROUND_EDGES = 2.5, 0.7, 1.5
FINEST = 0.1  # facets in which scarps are made, in mean edges; finer ones would only cost time
COARSEST = 0.25  # facets, in mean edges, that cannot show scarps
_REACH = 0.5  # distance in mean edges over which a scarp gathers its slope
_SURE = 0.3  # of the median curvature: beyond it, ground is wholly crest or hollow
_STEP = 0.4  # of the shortest edge at a vertex; the scheme is stable up to 1
# (wavelength in mean edges, standard deviation in the unit of `Form.crest`) of the random curvature
_WANDER = ((1.2, 0.5), (0.6, 0.4), (0.3, 0.3))
_STREAM = 800
_NEAREST, _WIDTH = 8, 0.5  # model vertices that give a value, and width of their weights in mean edges

_measured: dict[str, Float64] = {}  # `_at_vertices` of the last body of this process, by its content


@dataclass(frozen=True, kw_only=True, eq=False)
class Form:
    """Hold what the shape model says of the ground around each of n points.

    Attributes
    ----------
    up
        float64[n, 3]: unit normals of the smoothed model.
    crest
        float64[n]: 0 on even slopes, positive on crests, negative in hollows; 1 in the median of the magnitude.
    rough
        float64[n]: roughness of the model around the point, over the root mean square of the body.
    """

    up: Float64
    crest: Float64
    rough: Float64


def form(body: Body, points_T_m: Float64) -> Form:
    """Return the form of the model around points of its surface, float64[n, 3] in T."""
    edge = mean_edge_m(body.vertices_m, body.faces)
    values = _measured.get(body.content_hash)
    if values is None:
        values = _at_vertices(body, edge)
        _measured.clear()
        _measured[body.content_hash] = values
    tree = cKDTree(body.vertices_m)

    def interpolated(points: Float64) -> tuple[Float64, Float64]:
        distance, near = tree.query(points, k=_NEAREST)
        # measured from the nearest vertex, so that the weights never all vanish
        weight = np.exp(-0.5 * (distance**2 - distance[:, :1] ** 2) / (_WIDTH * edge) ** 2)
        weight /= weight.sum(axis=1)[:, None]
        mean = np.zeros((len(points), values.shape[1]))
        for k in range(_NEAREST):
            mean += weight[:, k, None] * values[near[:, k]]
        length = np.sqrt(np.einsum("ni,ni->n", mean[:, :3], mean[:, :3]))
        return mean[:, :3] / np.maximum(length, 1e-9)[:, None], mean[:, 3:]

    up, others = in_blocks(interpolated, points_T_m)
    return Form(up=up, crest=others[:, 0], rough=others[:, 1])


def _at_vertices(body: Body, edge_m: float) -> Float64:
    """Return `up`, `crest` and `rough` at the vertices of the model, float64[n, 5]."""
    vertices, faces = body.vertices_m, body.faces
    ground = vertices
    for _ in range(2):
        ground = smoothed(vertices, faces, ground, _GROUND_EDGES * edge_m)
    up = vertex_normals(ground, faces)
    off = vertices - smoothed(vertices, faces, vertices, _CREST_EDGES * edge_m)
    crest = np.einsum("ni,ni->n", off, body.vertex_normals)
    crest -= smoothed(vertices, faces, crest[:, None], _GROUND_EDGES * edge_m)[:, 0]  # the body itself is round
    square = smoothed(vertices, faces, (crest**2)[:, None], _AROUND_EDGES * edge_m)[:, 0]
    rough = np.sqrt(np.maximum(square, 0))
    return np.column_stack(
        [
            up,
            crest / max(float(np.median(np.abs(crest))), 1e-9),
            rough / max(float(np.sqrt(np.mean(rough**2))), 1e-9),
        ]
    )


def gathered(points: Float64, faces: Int32, where: Form, wander: Float64, edge_m: float) -> Float64:
    """Return how far the shock filter raises each point along `where.up`, float64[n] in metres.

    Parameters
    ----------
    points, faces
        Refined mesh, float64[n, 3] in metres and int32[m, 3].
    wander
        float64[n]: what is added to `where.crest`.
    edge_m
        Mean edge of the model.
    """
    joined = _joined(faces, len(points))
    here = np.repeat(np.arange(len(points)), np.diff(joined.indptr))
    there, first = joined.indices, joined.indptr[:-1]
    off = points[there] - points[here]
    rise = 0.5 * np.einsum("ni,ni->n", off, where.up[here] + where.up[there])
    length = np.sqrt(np.einsum("ni,ni->n", off, off))
    step = _STEP * np.minimum(np.minimum.reduceat(length, first), FINEST * edge_m)
    sure = np.tanh((where.crest + wander) / _SURE)
    grows, sinks = np.maximum(sure, 0), np.maximum(-sure, 0)
    raised = np.zeros(len(points))
    for _ in range(round(_REACH / (_STEP * FINEST))):
        slope = (rise + raised[there] - raised[here]) / length
        raised += step * grows * np.maximum(np.maximum.reduceat(slope, first), 0)
        raised += step * sinks * np.minimum(np.minimum.reduceat(slope, first), 0)
    return raised


def wander(points_T_m: Float64, edge_m: float, seed: int) -> Float64:
    """Return random curvature in the unit of `Form.crest`, float64[n], by which scarps leave the model's lines."""
    field, total = Points(points_T_m), np.zeros(len(points_T_m))
    for k, (edges, deviation) in enumerate(_WANDER):
        part = field.gradient(edges * edge_m, noise_key(seed, _STREAM + k), len(points_T_m))
        total += deviation / GRADIENT_STD * part
    return total


def _joined(faces: Int32, count: int) -> scipy.sparse.csr_matrix:
    """Return a matrix that is not 0 where an edge of a closed mesh joins two vertices."""
    i, j = (np.concatenate([faces[:, k] for k in ends]) for ends in ((0, 1, 2), (1, 2, 0)))
    return scipy.sparse.csr_matrix((np.ones(len(i), dtype=np.int8), (i, j)), shape=(count, count))
