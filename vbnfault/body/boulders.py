"""Place boulders on the terrain: draw their sizes and positions, shape them and set them into the ground."""

from __future__ import annotations

from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from ..core.process.llvm import backend
from .fields import GRADIENT_STD, Points
from .geometry import Float64, Int32, face_centres, face_normals_areas
from .noise import noise_key
from .refine import split
from .spec import INDEX, PER_KM2, PatchSpec

REFERENCE_M = 7.0
LARGEST_M = 45.0
# The steep size law, continued to a few decimetres, would cover the ground many times over. Where boulders cover
# this fraction of the ground (above 1 they form heaps), smaller ones are left out.
_MOST_COVER = 1.2
_MOST_DRAWN = 150_000

_PLANES = 18  # flat sides of a rock; without deep cuts, rocks look like eggs
_LEVELS = 6  # highest level of detail; level k has 20 · 4^k triangles
# Edges of rocks up to half a metre, in edges of the ground around them. For larger rocks this number falls as the
# diameter to the power `_EDGE_POWER`.
_EDGE_FACETS = 2.4
_EDGE_POWER = -0.3
# Within this distance of the site, edges shrink in proportion to the distance, but not below this fraction.
_CLOSE_M, _CLOSEST = 50.0, 0.45
# Factors on the edge length, tried until the triangles fit the budget. Only in regolith are stones so many that
# coarse ones are better than none.
_COARSER, _COARSEST = (1.0, 1.2, 1.45, 1.75, 2.1), (2.6, 3.2, 4.0, 5.0)
_FLAT_LEVELS = 2  # up to this level, triangles are the rock's fracture planes and are shaded flat
_WIDTHS_LEVEL = 1  # of the sphere whose vertices are the directions in which a rock is measured, to 6 %
_RING = 12  # directions in which the ground around a rock is sampled
_LOWEST_CORNERS = 8
_CORNERS_AT_ONCE = 1 << 14  # of rocks that a thread cuts; the temporaries then fit the processor's cache
# Fraction of a rock's height that lies below the lowest ground around it, on a comet and in regolith
_BURIED, _SUNK = (0.10, 0.40), (0.20, 0.50)
# Albedos of boulders in units of the contrast: two kinds (on Bennu: DellaGiustina et al. 2020, Science 370,
# eabc3660), the fraction of the brighter one, and the deviation within a kind
_KINDS, _BRIGHT_KIND, _KIND_SIGMA = (-0.35, 0.8), 0.3, 0.25


@dataclass(frozen=True, kw_only=True, eq=False)
class Boulders:
    """Hold all boulders of a patch: closed meshes and the values drawn for them.

    Attributes
    ----------
    vertices_m, faces
        float64[n, 3] in L and int32[m, 3], outward winding; boulder after boulder.
    flat
        bool[m]: the face is shaded with its own normal.
    shade
        float32[n]: how far the albedo of the boulder departs from the ground's mean, see `Patch.dust`.
    diameter_m, position_m
        float64[k] largest diameters, and float64[k, 3] centres in L.
    smallest_m
        float64[k]: smallest diameter for which the size law was drawn at each boulder's position.
    drawn
        Number of boulders that the size law gave, k of which fitted into the budget of triangles.
    """

    vertices_m: Float64
    faces: Int32
    flat: NDArray[np.bool_]
    shade: NDArray[np.float32]
    diameter_m: Float64
    position_m: Float64
    smallest_m: Float64
    drawn: int


def smallest_at(distance_m: Float64, min_boulder_m: float, near_m: float = 20.0) -> Float64:
    """Return the smallest diameter drawn at a distance from the site, metres.

    It is constant up to the distance `near_m`. Beyond, it grows with the distance, so that its angular size for a
    camera near the site is constant.
    """
    return min_boulder_m * np.maximum(np.asarray(distance_m) / near_m, 1.0)


@dataclass(frozen=True, kw_only=True, eq=False)
class GroundMesh:
    """Hold the ground on which boulders lie.

    Attributes
    ----------
    points, faces
        float64[n, 3] in L, metres, and int32[m, 3].
    facet_m
        float64[n]: edge length at each point.
    dust, talus
        float32[n] in [0, 1] at each point.
    place_T_m
        float64[n, 3]: body-fixed position of each point, before the relief was added.
    """

    points: Float64
    faces: Int32
    facet_m: Float64
    dust: NDArray[np.float32]
    talus: NDArray[np.float32]
    place_T_m: Float64


def add_boulders(ground: GroundMesh, spec: PatchSpec, *, rng: np.random.Generator, budget: int) -> Boulders:
    """Scatter boulders over the ground with at most `budget` triangles.

    If the boulders exceed the budget, their meshes first become coarser. If they still exceed it, the boulders that
    are smallest in proportion to the smallest drawn diameter (nearly: smallest in angle) are left out.

    `rng` draws the boulders; `spec.seed` selects the noise fields by which they cluster.
    """
    with ThreadPoolExecutor(1) as aside:  # the tree keeps one core busy
        tree = aside.submit(cKDTree, ground.points, balanced_tree=False, compact_nodes=False)
        return _strewn(ground, spec, tree, rng=rng, budget=budget)


def _strewn(
    ground: GroundMesh, spec: PatchSpec, tree: Future[cKDTree], *, rng: np.random.Generator, budget: int
) -> Boulders:
    """Do the work of `add_boulders`; another thread builds `tree`, which finds the nearest points of the ground."""
    points, faces = ground.points, ground.faces
    normals, _ = face_normals_areas(points, faces)
    centre = face_centres(points, faces)
    distance = np.sqrt(np.einsum("ni,ni->n", centre, centre))
    smallest = smallest_at(distance, spec.min_boulder_m, spec.boulder_near_m)
    bearing = smallest < spec.largest_boulder_m
    favour = np.zeros(len(faces))
    favour[bearing] = _favour(ground, normals[bearing], faces[bearing], spec)
    law = SizeLaw(per_m2=1e-6 * spec.boulders_per_km2, index=spec.boulder_index, largest_m=spec.largest_boulder_m)
    # the law holds where boulders are drawn, which is a small part of a moon
    drawn = np.flatnonzero(bearing if spec.regolith is not None and bearing.any() else favour >= 0)
    diameter, face, position, least = scatter(points, faces[drawn], favour[drawn], smallest[drawn], law, rng)
    face = drawn[face]

    coarser = _COARSER if spec.regolith is None else _COARSER + _COARSEST
    level = _levels(diameter, ground.facet_m[faces[face, 0]], distance[face], budget, coarser)
    # The cut is at the same multiple of the smallest diameter everywhere, so the size law holds above it.
    order = np.argsort(-diameter / least, kind="stable")
    fits = np.cumsum(20 * 4 ** level[order]) <= budget
    kept = order[: int(np.argmin(fits)) if not fits.all() else len(order)]
    if len(kept) < len(order):
        least = least * (diameter[order[len(kept)]] / least[order[len(kept)]])
    kept = np.sort(kept)
    kept = kept[np.argsort(level[kept], kind="stable")]

    vertices, triangles, flat, positions, start = [np.empty((0, 3))], [np.empty((0, 3), np.int64)], [], [], 0
    buried, shades = _BURIED if spec.regolith is None else _SUNK, [np.empty(0, np.float32)]
    shade = np.zeros(len(diameter), np.float32) if spec.regolith is None else _kinds(len(diameter), rng)
    for k in range(_LEVELS + 1):
        group = kept[level[kept] == k]
        if len(group):
            rocks, sphere_faces, centres = _rocks(
                k, diameter[group], position[group], normals[face[group]], points, tree.result(), rng, buried
            )
            offsets = start + np.arange(len(group))[:, None, None] * rocks.shape[1]
            vertices.append(rocks.reshape(-1, 3))
            triangles.append((sphere_faces[None] + offsets).reshape(-1, 3))
            flat.append(np.full(len(triangles[-1]), k <= _FLAT_LEVELS))
            positions.append(centres)
            shades.append(np.repeat(shade[group], rocks.shape[1]))
            start += len(vertices[-1])
    return Boulders(
        vertices_m=np.concatenate(vertices),
        faces=np.concatenate(triangles).astype(np.int32),
        flat=np.concatenate([np.empty(0, bool), *flat]),
        shade=np.concatenate(shades),
        diameter_m=diameter[kept],
        position_m=np.concatenate([np.empty((0, 3)), *positions]),
        smallest_m=least[kept],
        drawn=len(diameter),
    )


def _kinds(count: int, rng: np.random.Generator) -> NDArray[np.float32]:
    """Return how far the albedos of dark and bright boulders depart from the mean, float32[count]."""
    kind = np.where(rng.random(count) < _BRIGHT_KIND, _KINDS[1], _KINDS[0])
    return np.clip(kind + _KIND_SIGMA * rng.normal(size=count), -1, 1.5).astype(np.float32)


def _levels(
    diameter_m: Float64, facet_m: Float64, distance_m: Float64, budget: int, factors: tuple[float, ...]
) -> NDArray[np.int64]:
    """Return the level of detail of each boulder, int64[k], coarser ones if the budget asks for it.

    Coarser rocks are better than fewer rocks. A single rock takes at most 6 % of the budget.
    """
    edge = _EDGE_FACETS * facet_m * np.maximum(diameter_m / 0.5, 1.0) ** _EDGE_POWER
    edge *= np.clip(distance_m / _CLOSE_M, _CLOSEST, 1.0)
    finest = min(_LEVELS, max(1, int(np.log2(max(0.06 * budget / 20, 1.0)) / 2)))
    for coarser in factors:
        level = np.clip(np.ceil(np.log2(0.53 * diameter_m / (coarser * edge))), 0, finest).astype(np.int64)
        if np.sum(20 * 4**level) <= budget:
            break
    return level


def _favour(ground: GroundMesh, normals: Float64, faces: Int32, spec: PatchSpec) -> Float64:
    """Return the relative density of boulders on some faces, float64[m], from their normals and vertices."""
    dust, talus = ground.dust[faces], ground.talus[faces]
    place = Points(face_centres(ground.place_T_m, faces))
    count = len(faces)
    broad = place.gradient(110.0, noise_key(spec.seed, 9001), count) / GRADIENT_STD
    close = place.gradient(23.0, noise_key(spec.seed, 9002), count) / GRADIENT_STD
    cluster = np.exp(1.0 * broad.astype(np.float64) + 0.6 * close)
    if spec.regolith is not None:
        spread = cluster ** (1 - 0.7 * spec.regolith.rubble)  # rubble lies everywhere
        return np.asarray(spread * talus.mean(axis=1), dtype=np.float64)
    cover = 0.15 + 0.6 * (1 - dust.mean(axis=1))
    if spec.fractured is None:
        cover = cover + 7.0 * talus.mean(axis=1)
    else:
        cover = cover * (1 + (spec.fractured.apron - 1) * talus.mean(axis=1))
    # Boulders do not stay on steep ground.
    lie = np.clip((-normals[:, 2] - 0.70) / (0.84 - 0.70), 0, 1)
    return np.asarray(cluster * cover * lie, dtype=np.float64)


# --- numbers and sizes ------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class SizeLaw:
    """Describe the size law N(>= D) = per_m2 · (D / 7 m)^-index boulders per m², cut off above `largest_m`."""

    per_m2: float = 1e-6 * PER_KM2
    index: float = INDEX
    largest_m: float = LARGEST_M

    def above(self, diameter_m: ArrayLike) -> Float64:
        """Return the number per square metre from `diameter_m` up to the largest diameter; 0 beyond that."""
        d = np.minimum(np.asarray(diameter_m, dtype=np.float64), self.largest_m)
        return self.per_m2 * ((d / REFERENCE_M) ** -self.index - (self.largest_m / REFERENCE_M) ** -self.index)

    def draw(self, smallest_m: Float64, u: Float64) -> Float64:
        """Return the diameters at quantiles u in [0, 1) of the law from `smallest_m` to the largest."""
        truncated = 1.0 - (smallest_m / self.largest_m) ** self.index
        return np.asarray(smallest_m * (1.0 - u * truncated) ** (-1.0 / self.index))

    def paved_m(self, density: Float64) -> Float64:
        """Return the diameter above which boulders cover the fraction `_MOST_COVER` of the ground.

        `density` is the density of boulders on this ground, relative to the law's.
        """
        index = max(self.index, 2.05)
        unit = np.pi / 4 * index / (index - 2) * self.per_m2 * REFERENCE_M**index
        return np.asarray((np.maximum(density, 0.0) * unit / _MOST_COVER) ** (1.0 / (index - 2)))


def scatter(
    points: Float64,
    faces: Int32,
    favour: Float64,
    smallest_m: Float64,
    law: SizeLaw,
    rng: np.random.Generator,
) -> tuple[Float64, NDArray[np.int64], Float64, Float64]:
    """Draw boulders from a size law.

    Parameters
    ----------
    points, faces
        float64[n, 3] in metres and int32[m, 3]: the ground.
    favour
        float64[m]: relative density of boulders on each face; only ratios count.
    smallest_m
        float64[m]: smallest diameter drawn on each face. It is raised where boulders would cover the ground, and
        raised everywhere if there would be too many boulders.

    Returns
    -------
    diameter_m, face, at, smallest_m
        float64[n] diameters, int64[n] indices of the faces they lie on, float64[n, 3] positions on these faces, and
        float64[n] smallest diameters for which the law was drawn there.
    """
    area = face_normals_areas(points, faces)[1]
    # Normalising by area keeps the mean density at its published value, whatever the clusters and empty slopes.
    density = favour / max(float(np.sum(favour * area) / np.sum(area)), 1e-12)
    least = np.maximum(smallest_m, law.paved_m(density))
    expected = density * area * law.above(least)
    if expected.sum() > _MOST_DRAWN:
        least = least * (expected.sum() / _MOST_DRAWN) ** (1.0 / law.index)
        expected = density * area * law.above(least)
    cumulative = np.cumsum(expected)
    total = int(rng.poisson(float(cumulative[-1])))
    face = np.searchsorted(cumulative, rng.random(total) * cumulative[-1], side="right")
    face = np.minimum(face, len(faces) - 1)
    diameter = law.draw(least[face], rng.random(total))
    u, v = np.sqrt(rng.random(total)), rng.random(total)
    weights = np.column_stack([1.0 - u, u * (1.0 - v), u * v])
    return diameter, face, np.einsum("nk,nki->ni", weights, points[faces[face]]), least[face]


# --- shapes -----------------------------------------------------------------------------------------------------


@lru_cache(maxsize=8)
def _icosphere(level: int) -> tuple[Float64, Int32]:
    """Return a unit sphere of 20 · 4^level triangles with outward winding."""
    t = (1.0 + np.sqrt(5.0)) / 2.0
    corners = np.array([(s, r * t, 0.0) for r in (1, -1) for s in (-1, 1)])
    points = np.concatenate([np.roll(corners, shift, axis=1) for shift in (0, 1, 2)])
    points /= np.linalg.norm(points, axis=1)[:, None]
    # Neighbouring vertices of the icosahedron are 63.4° apart, the next nearest 116.6°.
    near = np.einsum("ik,jk->ij", points, points) > 0.4
    faces = np.array(
        [
            (i, j, k) if np.linalg.det(points[[i, j, k]]) > 0 else (i, k, j)
            for i in range(12)
            for j in range(i + 1, 12)
            for k in range(j + 1, 12)
            if near[i, j] and near[j, k] and near[i, k]
        ],
        dtype=np.int64,
    )
    for _ in range(level):
        points, _, faces = split(points, points, faces, np.ones(faces.shape, dtype=bool), np.ones(faces.shape))
        points = points / np.linalg.norm(points, axis=1)[:, None]
    return points, faces.astype(np.int32)


def _unit(v: Float64) -> Float64:
    """Return vectors scaled to unit length."""
    return v / np.maximum(np.sqrt(np.einsum("...i,...i->...", v, v)), 1e-12)[..., None]


def _rocks(
    level: int,
    diameter: Float64,
    position: Float64,
    normal: Float64,
    ground: Float64,
    tree: cKDTree,
    rng: np.random.Generator,
    buried: tuple[float, float],
) -> tuple[Float64, Int32, Float64]:
    """Return rocks of one level of detail: float64[k, v, 3], their common faces and their centres float64[k, 3].

    Each rock is a sphere that is cut by random planes, squeezed, turned and set into the ground.
    """
    sphere, faces = _icosphere(level)
    count = len(diameter)
    planes = _unit(rng.normal(size=(count, _PLANES, 3)))
    depth = rng.uniform(0.45, 0.80, size=(count, _PLANES))
    # Joints in rock are parallel or perpendicular: plane 1 is opposite to plane 0, plane 2 perpendicular to it.
    planes[:, 1] = _unit(-planes[:, 0] + 0.15 * rng.normal(size=(count, 3)))
    planes[:, 2] = _unit(np.cross(planes[:, 0], planes[:, 3]) + 0.1 * rng.normal(size=(count, 3)))
    radius = _cut(sphere, planes, depth)
    if level >= 2:
        radius *= _weathered(sphere, level, count, rng)
    semi = (
        0.5
        * diameter[:, None]
        * np.column_stack([np.ones(count), rng.uniform(0.65, 0.95, count), rng.uniform(0.45, 0.80, count)])
    )
    rock = radius[:, :, None] * sphere * semi[:, None, :]
    rock *= (diameter / _widest(rock))[:, None, None]
    normal = _ground_normal(position, normal, 0.5 * diameter, ground, tree)
    # The third axis, usually the shortest, lies near the ground's normal, so that rocks rest on their broad side.
    # The heading is random.
    up = _unit(normal + 0.25 * rng.normal(size=(count, 3)))
    side = _unit(np.cross(up, rng.normal(size=(count, 3))))
    rock = np.einsum("nvk,nki->nvi", rock, np.stack([side, np.cross(up, side), up], axis=1))

    along = np.einsum("nvi,ni->nv", rock, normal)
    low, high = along.min(axis=1), along.max(axis=1)
    lowest = _lowest_ground(position, normal, 0.5 * diameter, ground, tree)
    lift = lowest - low - rng.uniform(*buried, count) * (high - low)
    centre = position + lift[:, None] * normal
    for _ in range(3):  # lower the rock until its lowest corners are in the ground beside them
        corners = rock + centre[:, None, :]
        lowest_few = np.argsort(-corners[..., 2], axis=1, kind="stable")[:, :_LOWEST_CORNERS]
        corners = np.take_along_axis(corners, lowest_few[..., None], axis=1)
        beside = _nearest(ground, tree, corners)
        gap = np.einsum("nvi,ni->nv", corners - beside, normal).max(axis=1)
        centre = centre - np.maximum(gap + 0.08 * (high - low), 0.0)[:, None] * normal
    return rock + centre[:, None, :], faces, centre


def _cut(sphere: Float64, planes: Float64, depth: Float64) -> Float64:
    """Return the radii, float64[k, v] with a maximum of 1, of unit spheres that planes cut at depths float64[k, p].

    `planes` are the unit normals of each sphere's planes, float64[k, p, 3].
    """
    radius = np.ones((len(planes), len(sphere)))

    def cut(start: int) -> None:
        rows = slice(start, start + step)
        out = radius[rows]
        for k in range(planes.shape[1]):
            cosine = np.einsum("ni,vi->nv", planes[rows, k], sphere)
            np.maximum(cosine, 0.05, out=cosine)
            np.minimum(out, np.divide(depth[rows, k, None], cosine, out=cosine), out=out)
        out /= out.max(axis=1, keepdims=True)

    step = max(1, _CORNERS_AT_ONCE // len(sphere))
    with ThreadPoolExecutor(backend().dr.thread_count()) as pool:
        list(pool.map(cut, range(0, len(planes), step)))
    return radius


def _widest(rock: Float64) -> Float64:
    """Return the largest width of rocks float64[k, v, 3] about the origin, float64[k]."""
    axes = _icosphere(_WIDTHS_LEVEL)[0]
    width = np.zeros(len(rock))
    for axis in axes[axes @ (1.0, 1e-3, 1e-6) > 0]:  # one of each two opposite ones
        np.maximum(width, np.ptp(np.einsum("nvi,i->nv", rock, axis), axis=1), out=width)
    return width


def _nearest(ground: Float64, tree: cKDTree, position: Float64) -> Float64:
    """Return the point of the ground, float64[..., 3], that is nearest to each position float64[..., 3]."""
    return np.asarray(ground[tree.query(position, workers=backend().dr.thread_count())[1]])


def _ground_normal(position: Float64, normal: Float64, radius: Float64, ground: Float64, tree: cKDTree) -> Float64:
    """Return the ground's unit normal at the scale of a rock, float64[n, 3], from a ring of points."""
    across, other = _tangents(normal)
    ring = [
        _nearest(ground, tree, position + radius[:, None] * (np.cos(turn) * across + np.sin(turn) * other))
        - position
        for turn in np.linspace(0, 2 * np.pi, _RING, endpoint=False)
    ]
    total = np.zeros_like(normal)
    for k in range(_RING):
        total += np.cross(ring[k - 1], ring[k])
    mean = _unit(total)
    usable = np.einsum("ni,ni->n", mean, normal) > 0.5
    return np.where(usable[:, None], mean, normal)


def _tangents(normal: Float64) -> tuple[Float64, Float64]:
    """Return two unit vectors that are perpendicular to each normal and to each other."""
    axis = np.where(np.abs(normal[:, :1]) < 0.7, np.array([1.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0]))
    across = _unit(np.cross(axis, normal))
    return across, np.cross(normal, across)


def _weathered(sphere: Float64, level: int, count: int, rng: np.random.Generator) -> Float64:
    """Return factors on the radius, float64[count, v], for lumps and pits that become finer with each level."""
    origin = rng.uniform(-1e5, 1e5, size=(count, 1, 3))
    field = Points((origin + sphere[None]).reshape(-1, 3))
    size = count * len(sphere)
    out = np.zeros(size)
    for octave in range(level):
        wave = 0.9 / 2**octave
        out += 0.05 * wave / GRADIENT_STD * field.gradient(wave, 77_000 + octave, size)
    return 1.0 + out.reshape(count, -1)


def _lowest_ground(position: Float64, normal: Float64, radius: Float64, ground: Float64, tree: cKDTree) -> Float64:
    """Return the height along the normal of the lowest ground within a rock's reach, float64[n] m, at most 0."""
    across, other = _tangents(normal)
    lowest = np.zeros(len(position))
    for reach in (0.5, 1.0):
        for turn in np.linspace(0, 2 * np.pi, _RING, endpoint=False):
            ring = position + reach * radius[:, None] * (np.cos(turn) * across + np.sin(turn) * other)
            near = _nearest(ground, tree, ring) - position
            height = np.einsum("ni,ni->n", near, normal)
            aside = np.sqrt(np.maximum(np.einsum("ni,ni->n", near, near) - height**2, 0.0))
            lowest = np.minimum(lowest, np.where(aside < 1.3 * radius, height, 0.0))
    return lowest
