"""Measure how rough a body is at each scale, and derive how the ground continues below the facets of its model.

The deviogram (Shepard et al. 2001, JGR 106, 32777) is ν(L), the root mean square difference in height between
points a distance L apart, with heights measured against the local shape. On a self-affine surface, ν = ν₀ (L/L₀)^H.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from .shape import Float64, vertex_normals

if TYPE_CHECKING:
    from . import Body

_WINDOWS = 120  # neighbourhoods, spread evenly over the points
_MOST_POINTS = 300  # points of a window; more cost time and add little
_FEWEST_POINTS = 16  # needed to fit a quadric
_WINDOW_BASELINES = 3.0  # radius of a window in baselines
_BIN = 1.15  # a baseline's bin reaches from L / 1.15 to 1.15 L
# Baselines of the fit, in mean edges. At shorter ones the facets are flat, at longer ones the body is round.
_FIT_EDGES = (1.3, 1.7, 2.2, 2.9, 3.8)
# Natural surfaces have exponents of 0.3 to 1 (Shepard et al. 2001). Heights against a quadric can show exponents up
# to 2: near the facets of a smoothed shape model, the measured exponent exceeds 1.
_HURST_RANGE = (0.5, 1.0)
# Least cosine between the normals of a vertex and of the window's centre; steeper vertices belong to another side.
_FACING = 0.5


@dataclass(frozen=True, kw_only=True)
class Roughness:
    """Describe a self-affine surface: ν(L) = deviation_m · (L / baseline_m)^hurst, metres."""

    deviation_m: float
    baseline_m: float
    hurst: float

    def with_hurst(self, hurst: float | None) -> Roughness:
        """Return the surface with another exponent and the same deviation at `baseline_m`; None keeps it."""
        return self if hurst is None else replace(self, hurst=hurst)

    def deviation_at(self, baseline_m: NDArray | float) -> Float64:
        """Return the RMS deviation in metres at baselines in metres."""
        return np.asarray(self.deviation_m * (np.asarray(baseline_m) / self.baseline_m) ** self.hurst)


def deviogram(points_m: NDArray, normals: NDArray, baselines_m: NDArray, *, windows: int = _WINDOWS) -> Float64:
    """Return the deviation in metres, float64[k], over a surface given by its points; nan where no points qualify.

    The result is the median, over neighbourhoods, of their RMS deviation. It describes typical ground; a mean
    square would describe the few highest cliffs. Heights refer to the quadric fitted within three baselines,
    because the body is round. On a self-affine surface of any exponent, this fit removes the same fraction of ν at
    each scale.

    Parameters
    ----------
    points_m, normals
        float[n, 3]: metres in any axes, and unit outward normals.
    baselines_m
        float[k], metres along the local plane.
    windows
        Number of neighbourhoods, spread evenly over the points' order.
    """
    points = np.asarray(points_m, dtype=np.float64)
    tree = cKDTree(points)
    centres = np.unique(np.linspace(0, len(points) - 1, windows).astype(int))
    out = np.full(len(baselines_m), np.nan)
    for k, baseline in enumerate(baselines_m):
        squares = [_mean_square(points, normals, tree, centre, float(baseline)) for centre in centres]
        known = [square for square in squares if square is not None]
        if known:
            out[k] = np.sqrt(np.median(known))
    return out


def _mean_square(points: Float64, normals: NDArray, tree: cKDTree, centre: int, baseline: float) -> float | None:
    """Return the mean square height difference over the baseline around one point, or None with too few points."""
    reach = _WINDOW_BASELINES * baseline
    near = np.sort(tree.query_ball_point(points[centre], reach))
    near = near[np.einsum("ni,i->n", normals[near], normals[centre]) > _FACING]
    if len(near) < _FEWEST_POINTS:
        return None
    near = near[np.unique(np.linspace(0, len(near) - 1, _MOST_POINTS).astype(int))]
    offset = points[near] - points[near].mean(axis=0)
    axes = np.linalg.eigh(np.einsum("ni,nj->ij", offset, offset))[1]
    height, x, y = np.einsum("ni,ij->jn", offset, axes) / reach
    terms = np.column_stack([np.ones_like(x), x, y, x * x, x * y, y * y])
    height = reach * (height - np.einsum("nk,k->n", terms, np.linalg.lstsq(terms, height, rcond=None)[0]))
    shortest, longest = baseline / reach / _BIN, baseline / reach * _BIN
    i, j = cKDTree(np.column_stack([x, y])).query_pairs(longest, output_type="ndarray").T
    apart = (x[i] - x[j]) ** 2 + (y[i] - y[j]) ** 2 > shortest**2
    return float(np.mean((height[i] - height[j])[apart] ** 2)) if apart.any() else None


def mean_edge_m(vertices_m: NDArray, faces: NDArray) -> float:
    """Return the mean edge length of a mesh, metres."""
    side = vertices_m[faces] - vertices_m[np.roll(faces, 1, axis=1)]
    return float(np.linalg.norm(side, axis=2).mean())


_laws: dict[str, Roughness] = {}  # of the shapes that this process has measured, by their content


def model_roughness(body: Body) -> Roughness:
    """Return the law that continues the body's own shape model below its facets.

    The law has the measured deviation at 1.3 mean edges. Its exponent is fitted over 1.3 to 3.8 mean edges and kept
    within 0.5 to 1. The measurement takes about a second for 36,000 faces, so each shape is measured once.
    """
    if body.content_hash not in _laws:
        _laws[body.content_hash] = _measured(body)
    return _laws[body.content_hash]


def _measured(body: Body) -> Roughness:
    """Measure the roughness of a shape and fit the law to it."""
    edge = mean_edge_m(body.vertices_m, body.faces)
    baselines = edge * np.array(_FIT_EDGES)
    deviation = deviogram(body.vertices_m, vertex_normals(body.vertices_m, body.faces), baselines)
    used = np.isfinite(deviation) & (deviation > 0)
    if used.sum() < 2:
        return Roughness(deviation_m=0.0, baseline_m=float(baselines[0]), hurst=_HURST_RANGE[1])
    log_l, log_v = np.log(baselines[used]), np.log(deviation[used])
    slope = float(np.sum((log_l - log_l.mean()) * log_v) / np.sum((log_l - log_l.mean()) ** 2))
    return Roughness(
        deviation_m=float(np.exp(log_v[0])),
        baseline_m=float(np.exp(log_l[0])),
        hurst=float(np.clip(slope, *_HURST_RANGE)),
    )
