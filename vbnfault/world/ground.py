"""Choose the terrain for poses of a trajectory, so that its facets have the same width in pixels from any distance.

Far away, the whole body is refined evenly, and poses at nearly the same distance share it. Where this would take
too many triangles, the terrain is refined where the camera looks, as at a site of `[geometry]`: evenly over the
ground in the frame, and beyond with facets that grow with the distance. Near the ground, `[patch]` sets the
smallest facets. There is no border between these cases: facets are about `patch.facet_px` wide in all of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache, lru_cache
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..body import Body, Site, Sites, choose_sites, site_at
from ..core import frames
from ..core.errors import InputError, shown
from ..scene.config import Scene
from ..scene.instrument import CameraTable
from ..scene.plan import Plan
from ..scene.trajectory import FlownPose, Trajectory

if TYPE_CHECKING:
    from ..render import TerrainMesh

F64 = NDArray[np.float64]

# Smallest boulder, in facets.
_BOULDER_FACETS = 2.0
# Area of an equilateral triangle with edges of length 1.
_TRIANGLE = 3**0.5 / 4
# Fraction of the triangles for the even ground. The ground takes 0.66 of them (`body.patch`). Where one terrain
# serves several poses, half of this is left to the ground around.
_EVEN_FRACTION, _SHARED_FRACTION = 0.66, 0.33
# Frames of a sequence, and points of the ground in each, that its terrain is chosen for.
_FRAMES, _POINTS = 48, 3000
# A pose also shares a terrain if it needs at most this many times the triangles that it needs alone.
_MORE = 1.3
# Rays across the frame, on each side, that look for ground between the vertices of a coarse shape model.
_RAYS = 3
# Points in the frame that are compared as the origin of a terrain.
_ORIGINS = 100
# Largest facets and boulders, and range of the radius, that a patch takes (`body.PatchSpec`). Facets of a shape
# model are smaller, so that a patch with these facets is the model itself.
_LARGEST_FACET_M, _RADIUS_M = 1e6, (1.0, 1e8)
# Distances are rounded down to a power of this, so that poses at nearly the same distance share a terrain.
_STEP = 2**0.5
# A body of fewer pixels is rendered in a close-up, which shows facets of a pixel of the frame.
_FEWEST_PX = 64


@dataclass(frozen=True, kw_only=True)
class GroundDetail:
    """Describe where and how finely the terrain of poses is refined. Equal objects mean the same terrain.

    `position_T_m` is the origin of L. Facets measure `facet_m` within `radius_m` of it, boulders at least
    `boulder_m`.
    """

    position_T_m: tuple[float, float, float]
    facet_m: float
    radius_m: float
    boulder_m: float

    def site(self, body: Body, index: int) -> Site:
        """Return the site at the origin of L."""
        return site_at(body, index, self.position_T_m)


@dataclass(frozen=True, kw_only=True, eq=False)
class _Seen:
    """Hold ground points in a frame, float64[k, 3] in T, and their distances from the camera, float64[k]."""

    points_T_m: F64
    distance_m: F64

    def thinned(self) -> _Seen:
        """Return at most `_POINTS` of the points, the nearest among them."""
        nearest, step = int(np.argmin(self.distance_m)), -(-len(self.distance_m) // _POINTS)
        kept = slice(nearest % step, None, step)
        return _Seen(points_T_m=self.points_T_m[kept], distance_m=self.distance_m[kept])


def ground_details(scene: Scene, body: Body, poses: Sequence[FlownPose]) -> list[GroundDetail]:
    """Return the terrain of each of several consecutive poses.

    Neighbours share a terrain where its triangles suffice for them. The result depends on scene, body and these
    poses only.
    """
    whole = [_whole_body(scene, body, pose) for pose in poses]
    details: list[GroundDetail | None] = list(whole)
    group: list[int] = []
    seen: list[_Seen] = []

    def close() -> None:
        if group:
            shared = _affordable(scene, body, _around(scene, seen))
            for k in group:
                details[k] = shared
            group.clear()
            seen.clear()

    model: TerrainMesh | None = None
    budget = _SHARED_FRACTION * scene.patch.max_triangles
    for k, pose in enumerate(poses):
        if whole[k] is not None:
            continue
        if model is None:
            model = shape_model(body)
        here = _seen(scene, body, pose, model)
        enough = max(budget, _MORE * _even_triangles(_around(scene, [here])))
        if group and _even_triangles(_around(scene, [*seen, here])) > enough:
            close()
        group.append(k)
        seen.append(here)
    close()
    return [detail for detail in details if detail is not None]


def ground_of_sequence(scene: Scene, body: Body, poses: Sequence[FlownPose]) -> GroundDetail:
    """Return the terrain that all frames of a sequence share, so that no ground changes from frame to frame.

    It is as fine as the nearest frame needs, where the frames look, as far as its triangles suffice.
    """
    nearest = min(poses, key=lambda pose: float(_distances_m(body, pose).min()))
    whole = _whole_body(scene, body, nearest)
    if whole is not None:
        return whole
    model = shape_model(body)
    spread = np.unique(np.linspace(0, len(poses) - 1, min(len(poses), _FRAMES)).astype(int))
    chosen = [*(poses[k] for k in spread if poses[k] is not nearest), nearest]
    return _affordable(scene, body, _around(scene, [_seen(scene, body, pose, model).thinned() for pose in chosen]))


@lru_cache(maxsize=1)
def shape_model(body: Body) -> TerrainMesh:
    """Return the shape model of a body for the renderer, in T."""
    from .. import render

    smooth = np.zeros(len(body.faces), dtype=bool)
    return render.TerrainMesh(body.vertices_m.astype(np.float32), body.faces, smooth)


def in_frame(camera: CameraTable, points_C: F64, part: float = 1.0) -> NDArray[np.bool_]:
    """Return which points float64[n, 3] lie in the frame, or in the middle `part` of its sides, bool[n]."""
    size_px = np.array([camera.width_px, camera.height_px])
    calibration = camera.frame_calibration
    if calibration is None:
        z = np.where(points_C[:, 2:] > 0, points_C[:, 2:], np.nan)
        off_px = points_C[:, :2] / z * (size_px[0] / 2 / np.tan(np.radians(camera.fov_deg) / 2))
    else:
        off_px = calibration.pixel_of(points_C) - size_px / 2
    return np.asarray((np.abs(off_px) <= part * size_px / 2).all(axis=1))


def rays_C(camera: CameraTable, places: F64) -> F64:
    """Return unit directions through a grid of places in the frame, 0 to 1 along each side, float64[ray, 3]."""
    calibration = camera.frame_calibration
    if calibration is not None:
        size_px = calibration.width_px, calibration.height_px
        return calibration.directions_at(*(places * n for n in size_px)).reshape(-1, 3)
    slope = np.tan(np.radians(camera.fov_deg) / 2)
    x, y = np.meshgrid(slope * (places * 2 - 1), slope * camera.height_px / camera.width_px * (places * 2 - 1))
    rays = np.stack([x, y, np.ones_like(x)], axis=-1).reshape(-1, 3)
    return np.asarray(rays / np.linalg.norm(rays, axis=1, keepdims=True))


def _rounded(length_m: float) -> float:
    """Return a length rounded down to a power of `_STEP`."""
    return float(_STEP ** np.floor(np.log(max(length_m, 1e-3)) / np.log(_STEP) + 1e-9))


def _distances_m(body: Body, pose: FlownPose) -> F64:
    """Return the distances of the vertices from the camera, float64[vertex]."""
    return np.asarray(np.linalg.norm(body.vertices_m - pose.camera_position_T_m, axis=1))


def _whole_body(scene: Scene, body: Body, pose: FlownPose) -> GroundDetail | None:
    """Return the terrain that is even all over the body, or None if it would take too many triangles.

    Its origin is the vertex with the largest x in T, the same for all poses. From so far away that the body is less
    than `_FEWEST_PX` pixels wide, the terrain stays as it is at this distance, or as fine as it may be.
    """
    nearest_m = float(_distances_m(body, pose).min())
    pixel, budget = scene.camera.pixel_rad, _EVEN_FRACTION * scene.patch.max_triangles * _TRIANGLE
    few_px_m = float(np.ptp(body.vertices_m, axis=0).max()) / (_FEWEST_PX * pixel)
    wanted_m, close_m = (
        max(scene.patch.facet_m, scene.patch.facet_px * pixel * _rounded(distance))
        for distance in (nearest_m, min(nearest_m, few_px_m))
    )
    facet_m = min(wanted_m, max(close_m, 1.001 * float(np.sqrt(body.area_m2 / budget))))
    if body.area_m2 > budget * facet_m**2:
        return None
    origin = body.vertices_m[np.argmax(body.vertices_m[:, 0])]
    return _detail(scene, origin, facet_m, float(np.linalg.norm(body.vertices_m - origin, axis=1).max()))


def _around(scene: Scene, seen: Sequence[_Seen]) -> GroundDetail:
    """Return the terrain for the ground in several frames.

    A point at the distance d from its camera and s from the origin has facets of the wanted width if the even
    radius is at least s · d_nearest / d. The origin is the point for which this radius is smallest, or the ground
    nearest to a camera where `patch.radius_m` suffices.
    """
    points = np.concatenate([part.points_T_m for part in seen])
    distance = np.concatenate([part.distance_m for part in seen])
    least_m = float(distance.min())

    def needed_radius_m(origin: F64) -> float:
        return float((np.linalg.norm(points - origin, axis=1) * least_m / distance).max())

    origin = points[np.argmin(distance)]
    radius_m = needed_radius_m(origin)
    if radius_m > scene.patch.radius_m:
        spread = points[np.linspace(0, len(points) - 1, min(len(points), _ORIGINS)).astype(int)]
        origin = min(spread, key=needed_radius_m)
        radius_m = needed_radius_m(origin)
    facet_m = max(scene.patch.facet_m, scene.patch.facet_px * scene.camera.pixel_rad * _rounded(least_m))
    return _detail(scene, origin, facet_m, max(radius_m, scene.patch.radius_m))


def _affordable(scene: Scene, body: Body, detail: GroundDetail) -> GroundDetail:
    """Return a terrain with larger facets where its even ground would take too many triangles.

    Where the even ground is no larger than at a site, `body.patch` keeps to the number of triangles itself.
    """
    if detail.radius_m <= scene.patch.radius_m:
        return detail
    even_m2 = min(np.pi * detail.radius_m**2, body.area_m2)
    most = _EVEN_FRACTION * scene.patch.max_triangles
    facet_m = max(detail.facet_m, float(np.sqrt(even_m2 / (most * _TRIANGLE))))
    return replace(detail, facet_m=min(facet_m, _LARGEST_FACET_M))


def _detail(scene: Scene, origin_T_m: F64, facet_m: float, radius_m: float) -> GroundDetail:
    """Return a terrain with the boulders that facets of this size can show."""
    x, y, z = (float(v) for v in origin_T_m)
    boulder_m = max(scene.patch.min_boulder_m, _BOULDER_FACETS * facet_m)
    if facet_m == scene.patch.facet_m:  # pixels are smaller than facets
        boulder_m = scene.patch.min_boulder_m
    return GroundDetail(
        position_T_m=(x, y, z),
        facet_m=min(facet_m, _LARGEST_FACET_M),
        radius_m=float(np.clip(radius_m, *_RADIUS_M)),
        boulder_m=min(boulder_m, _LARGEST_FACET_M),
    )


def _even_triangles(detail: GroundDetail) -> float:
    """Return about how many triangles the even ground takes."""
    return float(np.pi * detail.radius_m**2 / (_TRIANGLE * detail.facet_m**2))


def _seen(scene: Scene, body: Body, pose: FlownPose, model: TerrainMesh) -> _Seen:
    """Return the ground in a frame: the vertices that no other ground hides, and what a few rays meet.

    If there is none, it is the vertex nearest to the line of sight. `model` is the shape model in T.
    """
    from .. import render

    camera = scene.camera
    away = body.vertices_m - pose.camera_position_T_m
    facing = np.einsum("ni,ni->n", body.vertex_normals, away) < 0
    vertices = body.vertices_m[in_frame(camera, away @ pose.T_from_C) & facing]
    points = [vertices[~render.hidden_points(model, pose.camera_position_T_m, vertices)]] if len(vertices) else []
    for towards in rays_C(camera, np.linspace(0, 1, _RAYS)) @ pose.T_from_C.T:
        hit = first_hit(body, pose.camera_position_T_m, towards)
        points += [] if hit is None else [hit[None]]
    ground = np.concatenate(points) if points else np.zeros((0, 3))
    if not len(ground):
        ground = looked_at(body, pose.camera_position_T_m, pose.T_from_C[:, 2])[None]
    distance = np.linalg.norm(ground - pose.camera_position_T_m, axis=1)
    return _Seen(points_T_m=ground, distance_m=np.maximum(distance, 1e-3))


def encloses(body: Body, point_T_m: F64) -> bool:
    """Return whether a point, float64[3] in T, lies inside the body's shape model.

    The facets then subtend the full sphere (van Oosterom & Strackee 1983, IEEE Trans. Biomed. Eng. 30, 125).
    """
    if ((point_T_m < body.vertices_m.min(axis=0)) | (point_T_m > body.vertices_m.max(axis=0))).any():
        return False
    a, b, c = (body.vertices_m[body.faces[:, k]] - point_T_m for k in range(3))
    la, lb, lc = (np.linalg.norm(v, axis=1) for v in (a, b, c))
    volume = np.einsum("ni,ni->n", a, np.cross(b, c))
    dots = [np.einsum("ni,ni->n", p, q) for p, q in ((a, b), (a, c), (b, c))]
    half = np.arctan2(volume, la * lb * lc + dots[0] * lc + dots[1] * lb + dots[2] * la)
    return bool(half.sum() > np.pi)  # half of the solid angle: 2 π inside, 0 outside


def nearest_ground(body: Body, point_T_m: F64) -> tuple[float, int]:
    """Return the distance in m from a point, float64[3] in T, to the shape model, and the facet there."""
    import trimesh

    away_m = np.linalg.norm(body.vertices_m - point_T_m, axis=1)
    # the nearest ground lies in a facet that has a vertex within the length of an edge of it
    near = away_m <= away_m.min() + _longest_edge_m(body)
    facets = np.flatnonzero(near[body.faces].any(axis=1))
    points = np.broadcast_to(point_T_m, (len(facets), 3))
    closest = trimesh.triangles.closest_point(body.vertices_m[body.faces[facets]], points)
    distance_m = np.linalg.norm(closest - point_T_m, axis=1)
    return float(distance_m.min()), int(facets[distance_m.argmin()])


def first_inside(body: Body, path_T_m: F64) -> tuple[int, float] | None:
    """Return the first position of a path, float64[n, 3] in T, inside the shape model, and its depth in m, or None.

    Where the ray away from T's origin meets no ground, a position is outside.
    """
    from .. import render

    distance_m = np.linalg.norm(path_T_m, axis=1, keepdims=True)
    near = np.flatnonzero(distance_m <= body_radius_m(body))
    if not len(near):
        return None
    outward = path_T_m[near] / np.maximum(distance_m[near], 1e-9)
    covered = near[np.isfinite(render.first_hit_m(shape_model(body), path_T_m[near], outward))]
    for index in covered.tolist():
        if encloses(body, path_T_m[index]):
            return index, nearest_ground(body, path_T_m[index])[0]
    return None


def body_radius_m(body: Body) -> float:
    """Return the distance of the farthest vertex from T's origin."""
    return float(np.linalg.norm(body.vertices_m, axis=1).max())


def check_above_ground(body: Body, trajectory: Trajectory, count: int) -> None:
    """Raise InputError if one of the first `count` rows of a trajectory lies inside the body's shape model."""
    inside = first_inside(body, trajectory.camera_position_T_m[:count])
    if inside is not None:
        raise InputError(f"{trajectory.source}: {below_ground(trajectory.pose(inside[0]), inside[1])}")


def below_ground(pose: FlownPose, depth_m: float) -> str:
    """Return the sentence about a row of a trajectory that lies below the surface of the shape model."""
    when = f"Julian date {pose.julian_date:.6f}" if np.isnan(pose.time_s) else f"{pose.time_s:.6g} s"
    return (
        f"row {shown(pose.name)}, at {when}, is {depth_m:.3g} m below the ground; choose other poses, or the "
        "body.shape that they were made for"
    )


def _longest_edge_m(body: Body) -> float:
    """Return the length of the longest edge of the shape model."""
    corners = body.vertices_m[body.faces]
    return float(np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max())


def looked_at(body: Body, origin_T_m: F64, direction_T: F64) -> F64:
    """Return where a ray first meets the body's shape model, float64[3] in m in T, or else the nearest vertex."""
    hit = first_hit(body, origin_T_m, direction_T)
    if hit is not None:
        return hit
    away = body.vertices_m - origin_T_m
    along = np.maximum(away @ direction_T, 0)
    return np.asarray(body.vertices_m[np.argmin(np.linalg.norm(away - along[:, None] * direction_T, axis=1))])


def first_hit(body: Body, origin_T_m: F64, direction_T: F64) -> F64 | None:
    """Return where a ray first meets the body's shape model, float64[3] in m in T; None where it misses."""
    a, b, c = (body.vertices_m[body.faces[:, k]] - origin_T_m for k in range(3))
    normal = np.cross(b - a, c - a)
    turn = np.stack([np.cross(p, q) @ direction_T for p, q in ((a, b), (b, c), (c, a))])
    facing = normal @ direction_T
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = np.einsum("ni,ni->n", a, normal) / facing
    hit = ((turn >= 0).all(axis=0) | (turn <= 0).all(axis=0)) & (distance > 0)
    return np.asarray(origin_T_m + distance[hit].min() * direction_T) if hit.any() else None


# --- sites for the Suns that Sun-facing samples see there -----------------------------------------------------

# Random positions compared for a site. On the packaged shape of 67P, 53 % of the paper's Suns are seen at a random
# site, and 95 % from the best of 64.
_CANDIDATES = 64
_MOST_SUNS = 32  # of a site that are tried, each from all of their camera positions
_START_M = 300.0  # height above the site from which the ground below a camera is looked for


def sites_for_suns(scene: Scene, body: Body, plan: Plan) -> Sites:
    """Return the sites of a plan whose samples keep their Suns. Each is chosen when it is first used.

    A Sun below the horizon is seen where the ground falls away towards it. With `plan.unusable_views = "exchange"`
    the Suns of a site come from one sector of azimuth (`scene.exchange`). Each site is the best of several random
    positions: the one from which most of its Suns are seen, over the shape model, from the positions that are drawn
    for them.
    """
    count = scene.dataset.sites
    candidates = choose_sites(body, count * _CANDIDATES, scene.dataset.seed)
    model = cache(lambda: shape_model(body))

    def make(index: int) -> Site:
        suns = plan.suns_of_site(index)
        if not len(suns):
            return candidates[index]
        suns = suns[np.linspace(0, len(suns) - 1, min(len(suns), _MOST_SUNS)).astype(int)]
        drawn = {name: values[suns] for name, values in plan.variables.items()}
        mine = [candidates[index + k * count] for k in range(_CANDIDATES)]
        best = mine[int(np.argmax([suns_seen(scene, model(), site, drawn).sum() for site in mine]))]
        return Site(index=index, position_T_m=best.position_T_m, T_from_L=best.T_from_L)

    return Sites(count, make)


def suns_seen(scene: Scene, model: TerrainMesh, site: Site, drawn: dict[str, F64]) -> NDArray[np.bool_]:
    """Return which Suns are seen at a site, over the shape model `model` in T, bool[position, Sun].

    `drawn` holds the values of n views, float64[n] each, by the names of `redraw.VARIABLES`.
    """
    from .. import render

    x, y, height = (drawn[name] for name in ("x_m", "y_m", "height_m"))
    angles = zip(drawn["sun_azimuth_deg"], drawn["sun_elevation_deg"], strict=True)
    suns_T = np.stack([frames.direction_L(*pair) for pair in angles]) @ site.T_from_L.T
    down_T = np.broadcast_to(site.T_from_L[:, 2], (len(x), 3))
    level_T = site.position_T_m + np.column_stack([x, y, np.zeros(len(x))]) @ site.T_from_L.T
    if scene.geometry.height_reference == "local_ground":
        ground_m = _START_M - render.first_hit_m(model, level_T - _START_M * down_T, down_T)
        height = height + np.where(np.isfinite(ground_m), ground_m, 0.0)
    camera_T = level_T - height[:, None] * down_T
    seen = np.isinf(
        render.first_hit_m(model, np.repeat(camera_T, len(suns_T), axis=0), np.tile(suns_T, (len(x), 1)))
    )
    return seen.reshape(len(x), len(suns_T))
