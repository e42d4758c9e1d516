"""Answer the planner's questions about the terrain: ground height, clearance, visible fraction of the Sun."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.sundisc import axes, sunflower
from .description import Sunlight
from .runtime import columns, dr, mi, packets
from .sampling import opaque_vector
from .surface import TerrainMesh
from .vehicle import Vehicle

F64 = NDArray[np.float64]

_SUN_SAMPLES = 1024  # gives the area on one side of a straight edge within 0.3 % of the disc's area
_FACETS = 1 << 16  # facets whose distance is computed at a time, to bound memory
_GROUND_HITS = 4
_MOST_CROSSINGS = 64  # of surfaces that a ray leaves or enters


def ground_height_m(surface: TerrainMesh, x_m: F64, y_m: F64, start_height_m: float) -> F64:
    """Return the height (up, −z of L) of the ground at positions in L, float64 like `x_m`; 0 without ground.

    The ground is the first surface below `start_height_m` that faces up. A ray that starts inside an overhang first
    leaves the body.
    """
    n = len(x_m)
    origin = np.column_stack([x_m, y_m, np.full(n, -start_height_m)])
    down = mi.Vector3f(0, 0, 1)
    height = np.zeros(n)
    open_ = np.ones(n, dtype=bool)
    for _ in range(_GROUND_HITS):
        hit = surface.intersect(mi.Ray3f(mi.Point3f(*columns(origin)), down))
        normal, distance, valid = hit.normal, hit.distance_m, hit.valid
        dr.eval(normal, distance, valid)
        met, up = valid.numpy().astype(bool), normal.z.numpy() < 0
        depth = origin[:, 2] + np.where(met, distance.numpy(), 0.0)
        hit_ground = open_ & met & up
        height[hit_ground] = -depth[hit_ground]
        open_ &= met & ~up
        if not open_.any():
            break
        origin[:, 2] = np.where(open_, depth + 1e-3, origin[:, 2])
    return height


def is_clear(surface: TerrainMesh, position_L_m: F64, clearance_m: float) -> NDArray[np.bool_]:
    """Return which positions float64[n, 3] are at least `clearance_m` from every facet, bool[n].

    Distances are exact. The boxes of the facets leave few facets to measure.
    """
    positions = np.asarray(position_L_m, dtype=np.float64)
    clear = np.ones(len(positions), dtype=bool)
    near = surface.facets_near(positions, clearance_m)
    for start in range(0, len(near), _FACETS):
        corners = surface.corners_m(near[start : start + _FACETS])
        for k in np.flatnonzero(clear):
            clear[k] = not (_distance_m(corners - positions[k]) < clearance_m).any()
    return clear


def _distance_m(corners: F64) -> F64:
    """Return the distance of the origin from triangles float64[n, corner, 3], float64[n].

    It is the distance to the plane if the origin projects into the triangle, else the distance to the nearest edge.
    """
    nearest = np.full(len(corners), np.inf)
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    within = np.ones(len(corners), dtype=bool)
    for k in range(3):
        a, edge = corners[:, k], corners[:, (k + 1) % 3] - corners[:, k]
        length2 = np.maximum(np.einsum("ni,ni->n", edge, edge), 1e-300)
        along = np.clip(-np.einsum("ni,ni->n", a, edge) / length2, 0, 1)
        nearest = np.minimum(nearest, np.linalg.norm(a + along[:, None] * edge, axis=1))
        within &= np.einsum("ni,ni->n", np.cross(edge, -a), normal) >= 0
    area = np.linalg.norm(normal, axis=1)
    within &= area > 0
    plane = np.abs(np.einsum("ni,ni->n", corners[:, 0], normal)) / np.maximum(area, 1e-300)
    return np.where(within, plane, nearest)


def first_ground(surface: TerrainMesh, position_L_m: F64, direction_L: F64) -> tuple[float, bool]:
    """Return the distance of the first surface on a ray, and whether the ray begins outside of all surfaces.

    All surfaces on the ray count: from below the ground, the first may be the underside of a half-buried boulder.

    Parameters
    ----------
    surface
        The terrain; its spacecraft is ignored.
    position_L_m, direction_L
        float64[3] each; the direction is a unit vector.

    Returns
    -------
    tuple[float, bool]
        The distance in m, infinite without a surface, and False only if the ray begins below the ground.
    """
    first_m, travelled_m, left = float("inf"), 0.0, 0
    for _ in range(_MOST_CROSSINGS):
        origin = position_L_m + travelled_m * direction_L
        rays = mi.Ray3f(mi.Point3f(*columns(origin[None])), mi.Vector3f(*columns(direction_L[None])))
        (met,) = surface.trace(rays)
        distance, facet, valid = met.t, met.prim_index, met.is_valid()
        dr.eval(distance, facet, valid)
        if not valid.numpy()[0]:
            break
        # the facet's own normal: the interpolated one may face away where the ray grazes the ground
        (corners,) = surface.corners_m(facet.numpy().astype(np.intp))
        outward = np.cross(corners[1] - corners[0], corners[2] - corners[0])
        left += 1 if outward @ direction_L >= 0 else -1
        travelled_m += float(distance.numpy()[0])
        first_m = min(first_m, travelled_m)
        travelled_m += max(1e-3, 1e-6 * float(np.abs(origin).max() + travelled_m))  # beyond float32's rounding
    return first_m, left <= 0


def first_hit_m(surface: TerrainMesh, origin_m: F64, direction: F64) -> F64:
    """Return the distance of the first surface on each ray, float64[n], infinite without one.

    `origin_m` and the unit vectors `direction` are float64[n, 3], in the axes of the surface.
    """
    rays = mi.Ray3f(mi.Point3f(*columns(origin_m)), mi.Vector3f(*columns(direction)))
    (met,) = surface.trace(rays, coherent=False)
    distance, valid = met.t, met.is_valid()
    dr.eval(distance, valid)
    return np.where(valid.numpy(), distance.numpy().astype(np.float64), np.inf)


def is_between(surface: TerrainMesh, origin_L_m: F64, points_L_m: F64) -> bool:
    """Return whether any surface lies between `origin_L_m`, float64[3], and any of the points, float64[n, 3]."""
    ray = points_L_m - origin_L_m
    length = np.maximum(np.linalg.norm(ray, axis=1), 1e-9)
    return bool(_any_hit(surface, origin_L_m[None], (ray / length[:, None])[None], length).any())


def hidden_points(surface: TerrainMesh, origin_m: F64, points_m: F64) -> NDArray[np.bool_]:
    """Return which points of the surface, float64[n, 3], other parts of it hide from `origin_m`, bool[n].

    Parts within 0.1 % of the distance in front of a point count as the point itself.
    """
    ray = points_m - origin_m
    length = np.maximum(np.linalg.norm(ray, axis=1), 1e-9)
    return _any_hit(surface, origin_m[None], (ray / length[:, None])[None], 0.999 * length)[0]


def sun_visible_fraction(
    surface: TerrainMesh, position_L_m: F64, suns: list[Sunlight], L_from_C: F64 | None = None
) -> F64:
    """Return the fraction of the Sun's disc that is not hidden, float64[n], from 1024 points of the disc each.

    The body hides the Sun. If the camera's axes are given, float64[n, 3, 3], its spacecraft hides the Sun, too.
    """
    points = sunflower(_SUN_SAMPLES)
    directions = []
    for sun in suns:
        across = axes(sun.direction_L)
        d = across[2] + np.tan(sun.angular_radius_rad) * points @ across[:2]
        directions.append(d / np.linalg.norm(d, axis=1, keepdims=True))
    towards = np.stack(directions)
    hidden = _any_hit(surface, position_L_m, towards, np.inf)
    if L_from_C is not None and surface.vehicle is not None:
        hidden = hidden | _any_hit(surface.vehicle, np.zeros_like(position_L_m), towards @ L_from_C, np.inf)
    return np.asarray(1 - hidden.mean(axis=1))


def sunlit_ground(surface: TerrainMesh, position_L_m: F64, rays_L: F64, sun_L: F64) -> NDArray[np.bool_]:
    """Return whether rays meet ground in direct sunlight, bool[view, ray].

    Parameters
    ----------
    surface
        The terrain; its spacecraft is ignored.
    position_L_m
        float64[view, 3]: where the rays of each view start.
    rays_L
        float64[view, ray, 3]: their unit directions.
    sun_L
        float64[view, 3]: the unit direction of each view's Sun.
    """
    views, count = rays_L.shape[:2]

    def each(vectors: F64) -> Any:
        """Return the components of one vector per ray."""
        return columns(np.broadcast_to(vectors, (views, count, 3)).reshape(-1, 3))

    sun = mi.Vector3f(*each(sun_L[:, None]))
    rays = mi.Ray3f(mi.Point3f(*each(position_L_m[:, None])), mi.Vector3f(*each(rays_L)))
    hit = surface.intersect(rays, coherent=False)
    facing = hit.valid & (dr.dot(hit.normal, sun) > 0)
    lit = facing & ~surface.occluded(hit.shadow_rays(sun), facing, coherent=False)
    return np.asarray(lit.numpy().astype(bool).reshape(views, count))


def _any_hit(
    surface: TerrainMesh | Vehicle, position: F64, directions: F64, reach_m: float | F64
) -> NDArray[np.bool_]:
    """Return whether rays from positions float64[n, 3] hit anything, bool[n, k].

    Directions are float64[n or 1, k, 3]. `reach_m` is the largest distance: one number, or one for each of the n ·
    k rays.
    """
    n, k = len(position), directions.shape[1]
    origins = np.repeat(position, k, axis=0)
    d = np.broadcast_to(directions, (n, k, 3)).reshape(-1, 3)
    rays = mi.Ray3f(mi.Point3f(*columns(origins)), mi.Vector3f(*columns(d)))
    rays.maxt = packets(mi.Float, np.asarray(np.minimum(reach_m, 3e38), np.float32))
    hits = surface.occluded(rays, mi.Bool(True), coherent=False)
    return hits.numpy().astype(bool).reshape(n, k)


# Height at which the rays start, in units of half the width.
_ABOVE = 1.5


def heights_towards_sun(
    surface: TerrainMesh, centre_L_m: NDArray[np.float64], axes: NDArray[np.float64], half_m: float, cells: int
) -> NDArray[np.float32]:
    """Return the height of the terrain above the plane through a centre at right angles to the Sun, in m.

    Parameters
    ----------
    surface
        The terrain; its spacecraft is ignored.
    centre_L_m
        float64[3]: the centre.
    axes
        float64[3, 3]: two unit vectors in the plane, and the one towards the Sun, as rows.
    half_m
        Half the width of the square around the centre. All of the terrain lies within this distance of it.
    cells
        Number of cells along each side of the square.

    Returns
    -------
    float32[cells, cells]
        The greatest height in the middle of each cell; columns run along the first axis, rows along the second.
        -inf where the cell shows no terrain.
    """
    index = dr.arange(mi.UInt32, cells * cells)
    # opaque numbers: a new Sun needs no new kernel
    first, second, sun = (opaque_vector(mi.Vector3f, axis) for axis in axes)
    corner = opaque_vector(mi.Point3f, centre_L_m + half_m * (_ABOVE * axes[2] - axes[0] - axes[1]))
    step, above = dr.opaque(mi.Float, 2 * half_m / cells), dr.opaque(mi.Float, _ABOVE * half_m)
    across, down = (mi.Float(index % cells) + 0.5) * step, (mi.Float(index // cells) + 0.5) * step
    hit = surface.trace(mi.Ray3f(corner + across * first + down * second, -sun))[0]
    height = dr.select(hit.is_valid(), above - hit.t, -dr.inf)
    return np.asarray(height.numpy(), dtype=np.float32).reshape(cells, cells)
