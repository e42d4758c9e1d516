"""Terrain: the whole body as one closed mesh, refined and roughened around a site, with boulders on it.

The global model's facets are tens of metres wide; a camera within a hundred metres of the ground needs relief
down to its pixels. Three steps, each a function of body-fixed position and seed, so that neighbouring sites
see the same ground:

1. edges near the site are split until they meet a target length, new points on the curved surface that the
   model's points and normals suggest;
2. relief is added along the normal, its spectrum continuing the model's below its own facets, with blocky
   consolidated ground above and smooth dust filling the lows;
3. boulders, closed meshes of their own, are set partly buried into the ground.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vbnfault.body.noise import Float32, block_noise, gradient_noise, noise_key
from vbnfault.body.shape import Float64, Int32, face_normals_areas, vertex_normals
from vbnfault.body.sites import Site
from vbnfault.errors import InputError

if TYPE_CHECKING:
    from vbnfault.body import Body

# Splitting halves an edge, so lengths end between half the limit and the limit; their mean is then near 1.
_LIMIT_PER_TARGET = 1.6
_GROUND_SHARE = 0.68  # of the triangles; the rest is left to the boulders
_PROBE = 4.0  # the triangle count is foretold with facets coarser by this, in a fraction of the time
# Beyond the radius the limit grows as its square: of the triangles, as many lie outside it as inside.
_GROWTH_POWER = 2.0
# A midpoint may leave the chord by at most this fraction of the edge: cliffs stay cliffs instead of bulging.
_MAX_BULGE = 0.06

_HURST = 0.80
_LARGEST_WAVELENGTH_M = 96.0
_LARGEST_AMPLITUDE_M = 5.0
_SMALLEST_WAVELENGTH_M = 1.5
# (cell width, height per unit of block noise) of the broken ground, in metres
_BLOCKS_M = ((38.0, 4.0), (13.0, 2.2), (5.0, 1.0))
_CRACK_DEPTH = 0.35  # between blocks, per unit of their height
_DUST_RIPPLE_M = 24.0  # the longest wavelength that shows, damped, on dust
_NO_DUST_M = 9.0  # how far below the ground steep slopes put the dust's surface
_STEP_WIDTH = 0.16  # of a cell: from one block to the next, and across the crack between them

_BOULDERS_PER_KM2 = 98.0  # N(>= 7 m), Pajola et al. 2015, A&A 583, A37
_BOULDER_REFERENCE_M = 7.0
_BOULDER_INDEX = 3.6
_MAX_BOULDER_M = 45.0
_BOULDER_NEAR_M = 120.0  # up to there the smallest are drawn; beyond, those that look as small as there
_MOST_BOULDERS = 2e5  # drawn before the triangle budget sorts them out
_BOULDER_STREAM = 0xB0D
_ROCK_PLANES = 11  # flat sides; deep cuts, or rocks look like eggs
_ROCK_LEVELS_M = (2.2, 5.0, 12.0)  # from these diameters on 80, 320, 1280 triangles; below 20


@dataclass(frozen=True, kw_only=True, eq=False)
class Patch:
    """The body as seen from one site.

    Attributes
    ----------
    site
        Where; the origin of the coordinates.
    vertices_L_m
        float32[n, 3], metres from the site, L axes (x north, y east, z down).
    faces
        int32[m, 3], outward winding: first the body, one closed surface, then boulders, each closed.
    face_is_boulder
        bool[m].
    """

    site: Site
    vertices_L_m: NDArray[np.float32]
    faces: Int32
    face_is_boulder: NDArray[np.bool_]

    @property
    def triangles(self) -> int:
        return len(self.faces)


def build_patch(
    body: Body,
    site: Site,
    *,
    seed: int,
    facet_m: float = 1.0,
    radius_m: float = 250.0,
    relief: float = 1.0,
    min_boulder_m: float = 0.8,
    max_triangles: int = 1_200_000,
) -> Patch:
    """Build the terrain around a site; deterministic in (body, site, seed and the parameters).

    Parameters
    ----------
    seed
        Non-negative integer.
    facet_m
        Mean edge length within `radius_m` of the site, 0.1 to 1000 m; beyond, it grows as the square of the
        distance until the global model's facets are reached. Coarsened where the ground alone would take more
        than 68 % of `max_triangles`.
    radius_m
        1 to 100 000 m.
    relief
        Scales the heights added to the model, 0 to 5; 0 leaves the interpolated model.
    min_boulder_m
        Smallest boulder's diameter near the site, > 0; grows with the distance beyond 120 m.
    max_triangles
        Upper bound, at least twice the model's; the smallest boulders (in angle) are left out beyond it.

    Raises
    ------
    InputError
        A parameter out of its range.
    """
    for key, value, low, high in (
        ("facet_m", facet_m, 0.1, 1000.0),
        ("radius_m", radius_m, 1.0, 1e5),
        ("relief", relief, 0.0, 5.0),
        ("min_boulder_m", min_boulder_m, 0.05, 1e6),
        ("seed", seed, 0, 2**63),
    ):
        if not low <= value <= high:
            raise InputError(f"patch: {key} must be from {low} to {high}; got {value}.")

    if max_triangles < 2 * len(body.faces):
        raise InputError(
            f"patch: max_triangles must be at least twice the model's {len(body.faces)} faces; got {max_triangles}."
        )

    model = (body.vertices_m - site.position_T_m, vertex_normals(body.vertices_m, body.faces), body.faces)
    limit = _affordable(_EdgeLimit(facet_m, radius_m), model, int(_GROUND_SHARE * max_triangles))
    points, normals, faces = _refine(*model, limit)
    if relief > 0:
        points = points + _relief(points, normals, site, seed, limit, relief)
    ground = (_rotate(points, site.T_from_L), faces)

    rng = np.random.Generator(np.random.Philox(np.random.SeedSequence((seed, _BOULDER_STREAM, site.index))))
    rocks = _boulders(*ground, site, rng, seed, min_boulder_m, max_triangles - len(faces))
    vertices = np.concatenate([ground[0], rocks[0]]).astype(np.float32)
    all_faces = np.concatenate([faces, rocks[1] + len(points)]).astype(np.int32)
    return Patch(
        site=site,
        vertices_L_m=vertices,
        faces=all_faces,
        face_is_boulder=np.arange(len(all_faces)) >= len(faces),
    )


@dataclass(frozen=True)
class _EdgeLimit:
    """Longest edge left unsplit, in metres, at points given relative to the site."""

    facet_m: float
    radius_m: float

    def __call__(self, points: Float64) -> Float64:
        return self._at(np.sqrt(np.einsum("...i,...i->...", points, points)))

    def along(self, a: Float64, b: Float64) -> Float64:
        """At the point nearest the site on each edge a-b: a long one can pass it between two far ends."""
        edge = b - a
        at = np.einsum("...i,...i->...", -a, edge) / np.maximum(np.einsum("...i,...i->...", edge, edge), 1e-30)
        return self(a + np.clip(at, 0.25, 0.75)[..., None] * edge)

    def _at(self, distance: Float64) -> Float64:
        return _LIMIT_PER_TARGET * self.facet_m * np.maximum(distance / self.radius_m, 1.0) ** _GROWTH_POWER


def _rotate(points: Float64, matrix: Float64) -> Float64:
    """points @ matrix outside BLAS, whose last bit may change with the number of threads."""
    return np.einsum("ni,ij->nj", points, matrix)


def _affordable(limit: _EdgeLimit, model: tuple[Float64, Float64, Int32], budget: int) -> _EdgeLimit:
    """The limit itself, or a coarser one with which the ground stays within about `budget` triangles."""
    coarse = _EdgeLimit(_PROBE * limit.facet_m, limit.radius_m)
    before = len(model[2])
    added = (len(_refine(*model, coarse)[2]) - before) * _PROBE**2
    if before + added <= budget:
        return limit
    return _EdgeLimit(limit.facet_m * float(np.sqrt(added / (budget - before))), limit.radius_m)


# --- refinement ---------------------------------------------------------------------------------------------


def _refine(points: Float64, normals: Float64, faces: Int32, limit: _EdgeLimit) -> tuple[Float64, Float64, Int32]:
    """Split every edge longer than its limit, the longest first.

    Whether an edge is split depends on its own two ends alone, so the triangles on both sides always agree
    and the mesh stays conforming with no neighbour search. Taking lengths in steps of sqrt 2, longest first,
    splits each triangle across its longest edge, which keeps the angles from degenerating.
    """
    done: list[NDArray] = []
    active = faces.astype(np.int64)
    bar = np.inf
    while len(active):
        ends = active[:, [[1, 2], [2, 0], [0, 1]]]  # edge k is opposite corner k
        a, b = points[ends[..., 0]], points[ends[..., 1]]
        length = np.sqrt(np.einsum("fki,fki->fk", b - a, b - a))
        long = length > limit.along(a, b)
        finished = ~long.any(axis=1)
        done.append(active[finished])
        active, long, length = active[~finished], long[~finished], length[~finished]
        if not len(active):
            break
        bar = min(float(length[long].max()), bar) / np.sqrt(2.0)
        split = long & (length > bar)
        points, normals, active = _split(points, normals, active, split, length)
    return points, normals, np.concatenate(done).astype(np.int32)


def _split(
    points: Float64, normals: Float64, faces: NDArray[np.int64], split: NDArray[np.bool_], length: Float64
) -> tuple[Float64, Float64, NDArray[np.int64]]:
    """One pass: insert the marked edges' midpoints and cut triangles with one, two or three of them."""
    ends = faces[:, [[1, 2], [2, 0], [0, 1]]][split]
    low, high = ends.min(axis=1), ends.max(axis=1)
    count = len(points)
    keys, inverse = np.unique(low * count + high, return_inverse=True)
    i, j = keys // count, keys % count
    new_points, new_normals = _midpoints(points[i], points[j], normals[i], normals[j])
    middle = np.full(faces.shape, -1, dtype=np.int64)
    middle[split] = count + inverse.ravel()

    how_many = split.sum(axis=1)
    out = [faces[how_many == 0]]

    one = how_many == 1
    f, m = _turn(faces[one], middle[one], np.argmax(split[one], axis=1))
    out += [np.column_stack([f[:, 0], f[:, 1], m[:, 0]]), np.column_stack([f[:, 0], m[:, 0], f[:, 2]])]

    two = how_many == 2
    # Turned so that edge 0 is the unsplit one: corner 0 is cut off, the rest is a quadrilateral whose
    # diagonal starts at the middle of its longer side, as repeated longest-edge bisection would have it.
    turn = np.argmin(split[two], axis=1)
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
    """The curved point-normal triangle's edge midpoint (Vlachos et al. 2001), its departure limited."""
    along = q - p
    bulge = (
        -(np.einsum("ij,ij->i", along, n_p)[:, None] * n_p - np.einsum("ij,ij->i", along, n_q)[:, None] * n_q) / 8.0
    )
    size = np.linalg.norm(bulge, axis=1)
    most = _MAX_BULGE * np.linalg.norm(along, axis=1)
    bulge *= np.minimum(1.0, most / np.maximum(size, 1e-12))[:, None]
    normal = n_p + n_q
    length = np.linalg.norm(normal, axis=1)
    return 0.5 * (p + q) + bulge, normal / np.where(length > 1e-9, length, 1.0)[:, None]


# --- relief -------------------------------------------------------------------------------------------------


def _smooth_step(low: float, high: float, x: NDArray) -> NDArray:
    t = np.clip((x - low) / (high - low), 0.0, 1.0)
    return t * t * (3.0 - 2.0 * t)


def _smooth_max(a: NDArray, b: NDArray, width: float) -> NDArray:
    h = np.maximum(width - np.abs(a - b), 0.0) / width
    return np.maximum(a, b) + h * h * width / 4.0


@dataclass(frozen=True)
class _Octaves:
    """Noise at points sorted by the facet size there, each octave where the facets can show it.

    An octave fades in between facets of 1/2 and 1/3.5 of its wavelength. Coarse ground sorts last, so that an
    octave works on a leading slice instead of on a masked copy.
    """

    place_m: Float64
    facet_m: Float64
    seed: int

    def _shown(self, wavelength_m: float) -> tuple[int, Float32]:
        count = int(np.searchsorted(self.facet_m, 0.5 * wavelength_m))
        return count, _smooth_step(2.0, 3.5, wavelength_m / self.facet_m[:count]).astype(np.float32)

    def gradient(self, wavelength_m: float, stream: int) -> Float32:
        out = np.zeros(len(self.place_m), dtype=np.float32)
        count, weight = self._shown(wavelength_m)
        points = self.place_m[:count] / wavelength_m
        out[:count] = weight * gradient_noise(points, noise_key(self.seed, stream))
        return out

    def blocks(self, width_m: float, stream: int) -> Float32:
        out = np.zeros(len(self.place_m), dtype=np.float32)
        count, weight = self._shown(width_m)
        level, neighbour, gap = block_noise(self.place_m[:count] / width_m, noise_key(self.seed, stream))
        # A step narrower than two facets would come out as a saw.
        ramp = np.maximum(_STEP_WIDTH, 2.5 * self.facet_m[:count] / width_m).astype(np.float32)
        edge = 1.0 - _smooth_step(0.0, 1.0, gap / ramp)
        out[:count] = weight * (level + 0.5 * edge * (neighbour - level) - _CRACK_DEPTH * edge)
        return out


def _relief(points: Float64, normals: Float64, site: Site, seed: int, limit: _EdgeLimit, scale: float) -> Float64:
    """Displacement in metres, float64[n, 3], at points relative to the site in T axes."""
    facet = limit(points) / _LIMIT_PER_TARGET
    chosen = np.flatnonzero(facet < 0.5 * _LARGEST_WAVELENGTH_M)
    chosen = chosen[np.argsort(facet[chosen], kind="stable")]
    up_T = -site.T_from_L[:, 2]
    steepness = (1.0 - np.einsum("ni,i->n", normals[chosen], up_T)).astype(np.float32)  # 0 level, 1 vertical
    noise = _Octaves(points[chosen] + site.position_T_m, facet[chosen], seed)

    swell = _LARGEST_AMPLITUDE_M * noise.gradient(_LARGEST_WAVELENGTH_M, 0)
    rough, fine = swell.copy(), np.zeros_like(swell)
    octaves = int(np.log2(_LARGEST_WAVELENGTH_M / _SMALLEST_WAVELENGTH_M)) + 1
    for k in range(1, octaves):
        wavelength = _LARGEST_WAVELENGTH_M / 2**k
        value = noise.gradient(wavelength, k)
        amplitude = _LARGEST_AMPLITUDE_M * (wavelength / _LARGEST_WAVELENGTH_M) ** _HURST
        # Every other octave is creased into ridges: plain noise alone looks like blobs.
        rough += amplitude * (value if k % 2 == 0 else 0.35 - 1.6 * np.abs(value))
        if wavelength <= _DUST_RIPPLE_M:
            fine += amplitude * value

    # Where the ground is consolidated and broken (1) and where it is not (0); slopes are bare.
    outcrop = noise.gradient(70.0, 101) + 0.4 * noise.gradient(27.0, 102) + 0.35 * steepness
    outcrop = _smooth_step(-0.16, 0.06, outcrop)
    # Cells bent by noise: otherwise their walls are dead straight.
    bend = np.column_stack([2.2 * noise.gradient(9.0, 110 + axis) for axis in range(3)])
    bent = _Octaves(noise.place_m + bend, noise.facet_m, seed)
    for number, (width, height) in enumerate(_BLOCKS_M):
        rough += outcrop * height * bent.blocks(width, 120 + number)

    # Dust settles on level ground and hides everything below its own slowly varying surface.
    dust = swell + 3.4 * noise.gradient(55.0, 130) - 0.7 + 0.22 * fine
    dust -= _NO_DUST_M * _smooth_step(0.10, 0.35, steepness)
    displacement = np.zeros(len(points))
    displacement[chosen] = scale * _smooth_max(rough, dust, 0.35)
    # Faded out with the last octave: blocks and dust have offsets of their own.
    displacement[chosen] *= _smooth_step(2.0, 3.5, _LARGEST_WAVELENGTH_M / noise.facet_m)
    return displacement[:, None] * normals


# --- boulders -----------------------------------------------------------------------------------------------


@lru_cache(maxsize=4)
def _icosphere(level: int) -> tuple[Float64, Int32]:
    """Unit sphere of 20 · 4^level triangles, outward winding."""
    t = (1.0 + np.sqrt(5.0)) / 2.0
    corners = np.array([(s, r * t, 0.0) for r in (1, -1) for s in (-1, 1)])
    points = np.concatenate([np.roll(corners, shift, axis=1) for shift in (0, 1, 2)])
    points /= np.linalg.norm(points, axis=1)[:, None]
    # Neighbours on the icosahedron are 63.4° apart, the next nearest 116.6°.
    near = points @ points.T > 0.4
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
        points, _, faces = _split(points, points, faces, np.ones(faces.shape, dtype=bool), np.ones(faces.shape))
        points = points / np.linalg.norm(points, axis=1)[:, None]
    return points, faces.astype(np.int32)


def _boulders(
    points: Float64,
    faces: Int32,
    site: Site,
    rng: np.random.Generator,
    seed: int,
    min_boulder_m: float,
    budget: int,
) -> tuple[Float64, Int32]:
    """All boulders' vertices float64[n, 3] (L axes, metres) and faces int32[m, 3], at most `budget`."""
    normals, _ = face_normals_areas(points, faces)
    centre = points[faces].mean(axis=1)
    place = _rotate(centre, site.T_from_L.T) + site.position_T_m
    # Clusters: talus and falls. None stay on steep ground.
    cluster = np.exp(
        3.5 * gradient_noise(place / 85.0, noise_key(seed, 9001))
        + 2.0 * gradient_noise(place / 21.0, noise_key(seed, 9002))
    )
    favour = cluster * _smooth_step(0.62, 0.86, -normals[:, 2])
    smallest = min_boulder_m * np.maximum(np.linalg.norm(centre, axis=1) / _BOULDER_NEAR_M, 1.0)
    diameter, face, at = _scatter(points, faces, favour, smallest, rng)

    level = np.searchsorted(_ROCK_LEVELS_M, diameter, side="right")
    order = np.argsort(-diameter / np.maximum(np.linalg.norm(at, axis=1), 100.0), kind="stable")
    keep = np.sort(order[np.cumsum(20 * 4 ** level[order]) <= budget])
    vertices, triangles, start = [np.empty((0, 3))], [np.empty((0, 3), dtype=np.int64)], 0
    for k in range(len(_ROCK_LEVELS_M) + 1):
        group = keep[level[keep] == k]
        if len(group):
            rocks = _rocks(k, diameter[group], at[group], normals[face[group]], rng)
            vertices.append(rocks[0])
            triangles.append(rocks[1] + start)
            start += len(rocks[0])
    return np.concatenate(vertices), np.concatenate(triangles).astype(np.int32)


def _scatter(
    points: Float64, faces: Int32, favour: Float64, smallest_m: Float64, rng: np.random.Generator
) -> tuple[Float64, NDArray[np.int64], Float64]:
    """Draw boulders after the published size law.

    Parameters
    ----------
    favour
        float64[m], how much likelier than elsewhere a boulder lies on each face; only ratios count.
    smallest_m
        float64[m], the smallest diameter drawn there.

    Returns
    -------
    diameter_m, face, at
        float64[n], int[n] and float64[n, 3]: how large, on which face, where on it.
    """
    area = face_normals_areas(points, faces)[1]
    # Normalised by area, so that clustering and bare slopes leave the mean density as published.
    share = favour * area / max(float(np.sum(favour * area) / np.sum(area)), 1e-12)
    law = _boulders_per_m2(smallest_m) - _boulders_per_m2(_MAX_BOULDER_M)
    expected = np.cumsum(share * np.maximum(law, 0.0))
    total = int(rng.poisson(min(float(expected[-1]), _MOST_BOULDERS)))
    face = np.minimum(np.searchsorted(expected, rng.random(total) * expected[-1]), len(faces) - 1)
    # Inverse of the power law truncated at both ends.
    truncated = 1.0 - (smallest_m[face] / _MAX_BOULDER_M) ** _BOULDER_INDEX
    diameter = smallest_m[face] * (1.0 - rng.random(total) * truncated) ** (-1.0 / _BOULDER_INDEX)
    u, v = np.sqrt(rng.random(total)), rng.random(total)
    weights = np.column_stack([1.0 - u, u * (1.0 - v), u * v])
    return diameter, face, np.einsum("nk,nki->ni", weights, points[faces[face]])


def _boulders_per_m2(diameter_m: ArrayLike) -> Float64:
    """Cumulative: boulders of that diameter or larger."""
    return 1e-6 * _BOULDERS_PER_KM2 * (np.asarray(diameter_m) / _BOULDER_REFERENCE_M) ** -_BOULDER_INDEX


def _rocks(
    level: int, diameter: Float64, at: Float64, normal: Float64, rng: np.random.Generator
) -> tuple[Float64, NDArray]:
    """Rocks of one level of detail: spheres cut by random planes, squeezed, turned and partly buried."""
    sphere, faces = _icosphere(level)
    count = len(diameter)
    planes = rng.normal(size=(count, _ROCK_PLANES, 3))
    planes /= np.linalg.norm(planes, axis=2)[:, :, None]
    depth = rng.uniform(0.36, 0.82, size=(count, _ROCK_PLANES))
    radius = np.ones((count, len(sphere)))
    for k in range(planes.shape[1]):  # plane by plane: all at once would take a gigabyte
        cosine = np.einsum("ni,vi->nv", planes[:, k], sphere)
        radius = np.minimum(radius, depth[:, k, None] / np.maximum(cosine, 0.05))
    radius *= 1.0 + (0.10, 0.03, 0.02, 0.015)[level] * rng.uniform(-1.0, 1.0, size=radius.shape)
    semi = (
        0.5
        * diameter[:, None]
        * np.column_stack([np.ones(count), rng.uniform(0.65, 0.95, count), rng.uniform(0.42, 0.72, count)])
    )
    rock = radius[:, :, None] * sphere * semi[:, None, :]
    # The squeezed axis lies near the ground's normal, heading at random: rocks rest on their broad side.
    up = normal + 0.35 * rng.normal(size=(count, 3))
    up /= np.linalg.norm(up, axis=1)[:, None]
    side = np.cross(up, rng.normal(size=(count, 3)))
    side /= np.linalg.norm(side, axis=1)[:, None]
    frame = np.stack([side, np.cross(up, side), up], axis=1)
    rock = np.einsum("nvk,nki->nvi", rock, frame)
    lift = semi[:, 2] * rng.uniform(-0.35, 0.45, count)
    rock += (at + lift[:, None] * normal)[:, None, :]
    offsets = np.arange(count)[:, None, None] * len(sphere)
    return rock.reshape(-1, 3), (faces[None] + offsets).reshape(-1, 3)
