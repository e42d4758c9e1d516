"""Compute the relief below the shape model's facets, and the dust that covers it.

Heights are added along the model's normal. Each is a function of body-fixed position, of the facets' size there and
of the slope against gravity. The relief consists of:

- fractal octaves, creased and patchy, whose deviogram continues that of the model (`roughness`);
- terraces with treads and scarps of a few metres; pits and craters with rims;
- strata, blocks and the cracks between them, where the slope or a slowly varying field leaves the ground bare;
- dust that fills low and level ground up to a smooth surface of its own, with faint ripples.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import cKDTree

from . import fractured, regolith
from .body import Body
from .fields import Octaves, smooth_max, smooth_step
from .geometry import Float64, Int32, in_blocks, vertex_normals
from .noise import Float32
from .roughness import Roughness
from .scarps import form
from .sites import Site
from .spec import PatchSpec

_COVER_M = 0.5  # height over which the cover of dust grows
_SHARED_M = 20.0  # longer octaves raise dust and rock alike
LONGEST_EDGES = 1.0  # wavelength of the longest octave, in mean edges of the model
_REGION_EDGES = 4.5  # size of the regions, in longest octaves
_SHORTEST_FACETS = 1.8  # wavelength of the shortest octave, in the smallest facets

# Of the uneven relief: limits of the model's local roughness, over its mean; factor on level ground, and slopes
# below which ground is level and above which it is bare; standard deviation of each factor of the cascade, their
# number, and the longest in longest octaves. Level ground and cascade were chosen together with the texture of the
# flight replay (`benchmarks`), by a classifier of its patches.
_ROUGH_RANGE = (0.25, 2.5)
_LEVEL, _LEVEL_DEG, _MEAN_COVERED = 0.03, (10.0, 38.0), 0.6
_CASCADE, _CASCADE_STEPS, _CASCADE_LONGEST = 0.65, 3, 4.0

_TERRACE_M = (5.5, 2.6)  # height of a step, and of the smaller steps between them
# (cell width, height per unit of block noise) of the broken ground, in metres
_BLOCKS_M = ((17.0, 1.9), (6.0, 0.95), (2.2, 0.40), (0.85, 0.14))
# (rise, fraction of it that is gathered) of the layers whose edges are scarps along the contours of the ground
_CONTOURS_M = ((45.0, 0.9), (21.0, 0.8))
_CONTOUR_FACETS = 2.5  # least width of a scarp: a narrower one has an edge like a saw
# Of the notch at the foot of a scarp: depth over the rise, half-width in facets, and greatest slope. Flight frames
# of 81 to 131 km ask for the depth; from near, a steeper notch would be a ditch.
_NOTCH, _NOTCH_FACETS, _NOTCH_STEEP = 0.25, 2.4, 1.35
_STRATA_M = ((9.0, 1.3), (3.1, 0.55), (1.1, 0.20))  # thickness of a layer, and how far a hard layer stands out

_DUST_LEAVES_DEG = (27.0, 40.0)  # dust lies on slopes below the first, and has slid off slopes above the second
_BARE_DEG = (30.0, 44.0)  # slopes below the first are loose ground, slopes above the second consolidated
_CLIFF_DEG = (38.0, 52.0)
_GRAVITY_PLACES = 6  # nearest ones from which gravity is interpolated, with the one that has no weight
_GRADIENT_PLACES = 9  # nearest ones, with the place itself, to which the gradient of gravity is fitted

_STEEPEST = 1.5  # tangent of the relief's largest slope against the model
_SLUMPS, _SLUMP_STEPS = 4, 25

_LOW, _MEAN_SLOPE_DEG = (
    0.18,
    30.0,
)  # elevations in mean radii and slopes that make airfall depart by 1 from its mean

_TALUS_CELL_M = 4.0
_TALUS_REACH_M = 480.0
_TALUS_WIDTH_M, _APRON_WIDTH_M = 9.0, 32.0  # of debris below small and large cliffs


@dataclass(frozen=True, kw_only=True, eq=False)
class Ground:
    """Hold the relief at each vertex of a patch.

    Attributes
    ----------
    height_m
        float64[n], along the model's normal.
    dust
        float32[n]: 1 is covered by dust, 0 bare; airfall goes beyond both. Of regolith: deviation of the albedo
        from its mean, -1 to 1.5.
    talus
        float32[n] in [0, 1]; 1 is debris at the foot of a cliff. Of regolith: the density of boulders.
    """

    height_m: Float64
    dust: Float32
    talus: Float32


def add_relief(
    body: Body,
    site: Site,
    mesh: tuple[Float64, Float64, Int32],
    facet_m: Float64,
    spec: PatchSpec,
    *,
    roughness: Roughness,
    longest_m: float,
) -> Ground:
    """Return the relief on a refined mesh.

    Parameters
    ----------
    mesh
        Points float64[n, 3] in metres relative to the site in T axes, unit normals float64[n, 3], and faces
        int32[m, 3].
    facet_m
        float64[n]: the facets' size at each vertex. Wavelengths shorter than about two facets are left out.
    spec
        Seed, factor on the heights and number of craters.
    roughness
        Law that the fractal octaves follow.
    longest_m
        Wavelength of the longest octave; longer relief belongs to the model.
    """
    points, normals, faces = mesh
    up, elevation = _vertical(body, site, points)
    if spec.relief == 0:
        slope = _slope_deg(points, normals, faces, up)
        return Ground(
            height_m=np.zeros(len(points)),
            dust=1 - smooth_step(*_DUST_LEAVES_DEG, slope) + _airfall(body, elevation, slope, spec.airfall),
            talus=np.zeros(len(points), dtype=np.float32),
        )
    # Points are sorted by facet size, so that each octave is evaluated at a leading part of them only.
    order = np.argsort(facet_m, kind="stable")
    rank = np.empty_like(order)
    rank[order] = np.arange(len(order))
    noise = Octaves(
        points[order] + site.position_T_m, facet_m[order], spec.seed, roughness, longest_m, normals[order]
    )
    if spec.regolith is not None:
        return _of_regolith(body, mesh, noise, (order, rank), (up, elevation), spec)
    model_slope = _slope_deg(points, normals, faces, up)[order]
    scale: Float64 | float = spec.relief
    if spec.intermittency:
        scale = spec.relief * _unevenness(body, noise, model_slope, spec.intermittency)[rank]

    # Roughness differs between regions. Far away, facets show few octaves, and evenly rough ground would look like
    # orange peel.
    region = 0.45 + 0.95 * smooth_step(-1.0, 1.2, noise.gradient(_REGION_EDGES * longest_m, 210))
    swell = region * noise.fractal(longest_m, _SHARED_M, 0, spec.angularity)
    shown = noise.shown(longest_m)

    def raised(height: Float32) -> Float64:
        return points + (scale * (height * shown)[rank].astype(np.float64))[:, None] * normals

    def slope_of(height: Float32) -> Float32:
        return _slope_deg(raised(height), normals, faces, up)[order]

    pits = (1 - smooth_step(26.0, 42.0, model_slope)) * noise.craters(spec.craters_per_km2)
    if spec.fractured is None:
        broad = _terraced(noise, swell) + pits
    else:
        rock = fractured.bedrock(noise, swell, elevation[order], model_slope, slope_of, spec.fractured)
        broad = rock.height_m + pits
    slope = slope_of(broad)
    place_L = np.einsum("ni,ij->nj", raised(broad), site.T_from_L)
    talus = _talus(place_L, slope[rank], _TALUS_WIDTH_M)
    if spec.fractured is None:
        height, dust = _surface(noise, broad, slope, talus[order], elevation[order])
    else:
        talus = np.maximum(talus, _talus(place_L, slope[rank], _APRON_WIDTH_M))
        lie = fractured.Lie(
            model_slope_deg=model_slope, slope_deg=slope, talus=talus[order], elevation_m=elevation[order]
        )
        height, dust = fractured.surface(noise, rock, broad, lie, spec.fractured)
    total = scale * (height * shown)[rank].astype(np.float64)
    if spec.contour_scarps:
        total += spec.contour_scarps * _contour_scarps(noise, elevation[order], model_slope)[rank]
    height_m = _slumped(points, faces, total)
    dust = dust[rank]
    if spec.fractured is not None:
        slope = _slope_deg(points + height_m[:, None] * normals, normals, faces, up)
        dust = dust * fractured.dust_that_rests(slope, spec.fractured)
    dust = dust + _airfall(body, elevation[order], model_slope, spec.airfall)[rank]
    return Ground(height_m=height_m, dust=dust, talus=talus)


def _of_regolith(
    body: Body,
    mesh: tuple[Float64, Float64, Int32],
    noise: Octaves,
    sorting: tuple[NDArray[np.intp], NDArray[np.intp]],
    vertical: tuple[Float64, Float64],
    spec: PatchSpec,
) -> Ground:
    """Return the ground of asteroids and moons; `sorting`: order of the points in `noise`, and its inverse."""
    points, normals, faces = mesh
    (order, rank), (up, elevation) = sorting, vertical
    assert spec.regolith is not None
    low_m = float(np.quantile(body.places[2], spec.regolith.smooth)) if spec.regolith.smooth else 0.0
    slope = _slope_deg(points, normals, faces, up)[order]
    broad, height, fine, bright = regolith.surface(noise, elevation[order], slope, low_m, spec)
    slope = _slope_deg(points + broad[rank].astype(np.float64)[:, None] * normals, normals, faces, up)
    return Ground(
        height_m=_slumped(points, faces, height[rank].astype(np.float64)),
        dust=regolith.brightness(noise, slope[order], fine, bright, spec.regolith.rubble)[rank],
        talus=regolith.stony(slope, fine[rank], bright[rank], spec.regolith.rubble),
    )


def _airfall(body: Body, elevation_m: Float64, slope_deg: Float32, factor: float) -> Float32:
    """Return what airfall adds to the cover of dust, float32[n], -2 to 2 times the factor.

    It gathers on level and on low ground: the neck of 67P is the brightest of its regions (Fornasier et al. 2015,
    A&A 583, A30; Keller et al. 2015, A&A 583, A34). Slope and elevation count alike; with both, the ranks of
    brightness in 11 flight frames correlate by 0.027 more, with either alone by 0.008.
    """
    if not factor:
        return np.zeros(len(slope_deg), dtype=np.float32)
    low = np.clip((np.median(body.places[2]) - elevation_m) / (_LOW * body.mean_radius_m), -1, 1)
    return np.asarray(factor * (low + np.clip(1 - slope_deg / _MEAN_SLOPE_DEG, -1, 1)), dtype=np.float32)


def _unevenness(body: Body, noise: Octaves, slope_deg: Float32, strength: float) -> Float64:
    """Return the factor on the relief at the points of `noise`, float64[n]: the ground is rough here, smooth there.

    Three causes multiply. Ground below the facets is rough where the model is. Dust smooths level ground. What
    remains is a cascade (Mandelbrot 1974, J. Fluid Mech. 62, 331): independent factors of several sizes with
    lognormal distributions.
    """
    rough = np.clip(form(body, noise.place_m).rough, *_ROUGH_RANGE)
    covered = _LEVEL + (1 - _LEVEL) * smooth_step(*_LEVEL_DEG, slope_deg).astype(np.float64)
    cascade = np.full(len(noise.facet_m), -_CASCADE_STEPS * _CASCADE**2)  # the mean square of its exponential is 1
    for k in range(_CASCADE_STEPS):
        cascade += _CASCADE * noise.gradient(_CASCADE_LONGEST * noise.longest_m / 2**k, 220 + k)
    return np.asarray((rough * covered / _MEAN_COVERED * np.exp(cascade)) ** strength)


# --- the vertical and slopes ------------------------------------------------------------------------------------


def _vertical(body: Body, site: Site, points: Float64) -> tuple[Float64, Float64]:
    """Return the unit vertical float64[n, 3] (T axes) and the elevation float64[n] in metres.

    Gravity at `body.places`, all over the body, and at the site is interpolated. It is extrapolated by its gradient
    at each of the nearest places, and potentials by both. The weights (Franke & Little in Franke 1982, Math. Comp.
    38, 181) vanish for the place beyond them, so that nothing jumps. Elevation is the effective potential over the
    body's mean gravity. It hardly depends on the site, nor do the strata that follow it.
    """
    place, gravity, level = (
        np.concatenate(both) for both in zip(body.places, body.sampled(site.position_T_m[None]), strict=True)
    )
    gradient, tree = _gradients(place, gravity), cKDTree(place)

    def interpolated(points_T_m: Float64) -> tuple[Float64, Float64]:
        distance, near = tree.query(points_T_m, k=min(_GRAVITY_PLACES, len(place)))
        distance = np.maximum(distance, 1e-3)
        weight = (1 / distance[:, :-1] - 1 / distance[:, -1:]) ** 2 + 1e-12 / distance[:, :-1] ** 2
        weight /= weight.sum(axis=1)[:, None]
        pull, elevation = np.zeros_like(points_T_m), np.zeros(len(points_T_m))
        for k in range(weight.shape[1]):
            g, off = gravity[near[:, k]], points_T_m - place[near[:, k]]
            bend = np.einsum("ni,nij->nj", off, gradient[near[:, k]])
            rise = -np.einsum("ni,ni->n", g + 0.5 * bend, off) / body.mean_gravity_m_s2
            pull += weight[:, k, None] * (g + bend)
            elevation += weight[:, k] * (level[near[:, k]] + rise)
        return -pull / np.maximum(np.sqrt(np.einsum("ni,ni->n", pull, pull)), 1e-30)[:, None], elevation

    up, elevation = in_blocks(interpolated, points + site.position_T_m)
    return up, elevation


def _gradients(place_m: Float64, gravity: Float64) -> Float64:
    """Return the gradient of gravity at places of a surface, float64[n, 3, 3], in 1/s²: rows are directions.

    It is fitted to the nearest places. They hardly tell the gradient across the surface, which a small term keeps
    near 0.
    """
    distance, near = cKDTree(place_m).query(place_m, k=min(_GRADIENT_PLACES, len(place_m)))
    off = (place_m[near] - place_m[:, None]) / distance[:, -1:, None]
    change = (gravity[near] - gravity[:, None]) / distance[:, -1:, None]
    square = np.einsum("nki,nkj->nij", off, off) + 1e-3 * np.eye(3)
    return np.asarray(np.linalg.solve(square, np.einsum("nki,nkj->nij", off, change)))


def _slope_deg(points: Float64, normals: Float64, faces: Int32, up: Float64) -> Float32:
    """Return the angle between the mesh's normals and the vertical, float32[n], 0 to 180°."""
    cosine = np.einsum("ni,ni->n", vertex_normals(points, faces), up)
    return np.degrees(np.arccos(np.clip(cosine, -1, 1))).astype(np.float32)


# --- components of the ground -----------------------------------------------------------------------------------


def _terraced(noise: Octaves, swell: Float32) -> Float32:
    """Return heights gathered into treads of uneven rise, in patches, so that scarps end along their length."""
    where = smooth_step(0.1, 1.5, noise.gradient(120.0, 200) + 0.5 * noise.gradient(31.0, 201))
    wander = swell + 1.6 * noise.gradient(43.0, 202) + 0.7 * noise.gradient(17.0, 203)
    wander += 0.16 * noise.gradient(6.0, 204) + 0.05 * noise.gradient(2.3, 205)
    out = swell.copy()
    for number, (step, height_fraction) in enumerate(zip(_TERRACE_M, (0.7, 0.5), strict=True)):
        rise = np.random.Generator(np.random.Philox(900 + number)).uniform(0.0, 1.0, 256).astype(np.float32)
        u = wander / np.float32(step)
        tread = np.floor(u)
        # Random factors weaken some of the steps.
        kept = where * height_fraction * rise[tread.astype(np.int64) & 255]
        out += kept * (step * (tread + smooth_step(0.30, 0.98, u - tread)) - wander)
    return out


def _contour_scarps(noise: Octaves, elevation_m: Float64, slope_deg: Float32) -> Float32:
    """Return what gathers the rise of the ground into scarps along its contours, metres along the vertical.

    Layers crop out along contours of the elevation, which random fields bend. A few of them are hard enough, and a
    scarp ends where its layer is soft.
    """
    total = np.zeros_like(slope_deg)
    tangent = np.hypot(np.tan(np.radians(np.minimum(slope_deg, 60.0))), np.float32(0.3))
    gentle = 1 - smooth_step(25.0, 45.0, slope_deg)  # on cliffs, contours are too near to each other
    for number, (rise, gathered) in enumerate(_CONTOURS_M):
        if not noise.shown(2 * rise).any():
            continue
        # small closed bends would be ringed by scarps
        stream = 230 + 10 * number
        bend = 0.8 * noise.gradient(22 * rise, stream) + 0.25 * noise.gradient(6 * rise, stream + 1)
        bend += 0.12 * noise.gradient(3 * rise, stream + 2) + 0.05 * noise.gradient(rise, stream + 5)
        u = elevation_m / rise + bend
        tread = np.floor(u)
        inside = (u - tread).astype(np.float32)
        hard = np.random.Generator(np.random.Philox(910 + number)).random(4096).astype(np.float32)
        where = 0.6 * noise.gradient(20 * rise, stream + 3) + 0.9 * noise.gradient(5 * rise, stream + 4)
        where += 5.0 * hard[tread.astype(np.int64) & 4095] - 3.7
        wide = np.maximum(0.6 * rise, _CONTOUR_FACETS * noise.facet_m) * tangent / rise
        wide = np.clip(wide, 0.05, 0.95).astype(np.float32)
        foot = 0.5 * (1 - wide)
        stair = smooth_step(0, 1, (inside - foot) / wide)
        kept = np.float32(gathered * rise) * smooth_step(0.2, 1.1, where) * noise.shown(2 * rise)
        # a scarp is undercut: its foot lies in a notch, which is dark under any Sun
        foot_m = (inside - foot) * np.float32(rise) / tangent
        notch = np.exp(-((foot_m / (_NOTCH_FACETS * noise.facet_m)) ** 2)).astype(np.float32)
        deep = np.minimum(_NOTCH, _NOTCH_STEEP * _NOTCH_FACETS * noise.facet_m / rise).astype(np.float32)
        total += gentle * kept * (stair - inside - deep * notch)
    return total


def _surface(
    noise: Octaves, broad: Float32, slope: Float32, talus: Float32, elevation: Float64
) -> tuple[Float32, Float32]:
    """Return the height in metres and the dust cover, both float32[n]."""
    history = noise.gradient(66.0, 100) + 0.45 * noise.gradient(25.0, 101)
    cliff = smooth_step(*_CLIFF_DEG, slope + 3 * history)
    # 1 where the ground is consolidated and broken, 0 where it is loose.
    bare = smooth_step(*_BARE_DEG, slope + 11 * history)
    vigour = 0.55 + 1.0 * smooth_step(-1.2, 1.4, noise.gradient(47.0, 102)) * (0.6 + 0.4 * bare)

    shortest = max(_SHORTEST_FACETS * float(noise.facet_m[0]), 0.05)
    rough, grit = np.zeros_like(broad), np.zeros_like(broad)
    for k, wavelength in noise.wavelengths(_SHARED_M, shortest):
        value = noise.gradient(wavelength, 300 + k)
        # Creases form ridges; plain noise alone looks like blobs.
        creased = (0.80 - np.abs(value)) / np.float32(0.60)
        crease = np.float32(0.8 if k % 2 else 0.35) * bare
        rough += noise.amplitude(wavelength) * (value + crease * (creased - value))
        if wavelength < 7.0:
            grit += np.float32(0.028 * wavelength**0.65) * value
    rock = broad + vigour * rough

    # Without this shift, the walls between blocks would be straight.
    bend = np.column_stack([1.1 * noise.gradient(7.0, 110 + axis) for axis in range(3)])
    bend += np.column_stack([0.25 * noise.gradient(1.9, 113 + axis) for axis in range(3)])
    bent = noise.bent(bend)
    joints = smooth_step(-1.0, 0.8, noise.gradient(33.0, 116))
    for number, (width, height) in enumerate(_BLOCKS_M):
        rock += bare * (0.4 + 0.6 * joints) * bent.blocks(width, height, 120 + number)
    rock += cliff * _strata(noise, elevation + np.einsum("ni,i->n", bend, np.array([0.5, 0.3, 0.4])))
    rock += talus * (0.25 * noise.gradient(2.6, 140) + 0.10 * noise.gradient(1.1, 141))

    # Dust settles on level ground and hides everything below its own slowly varying surface.
    depth = 0.75 + 0.9 * noise.gradient(58.0, 130) + 0.4 * noise.gradient(19.0, 131)
    depth -= 1.1 * bare * (0.5 + 0.5 * joints) + 0.5 * talus
    depth -= 9.0 * smooth_step(*_DUST_LEAVES_DEG, slope)
    ripples = 0.5 + 0.5 * np.tanh(noise.gradient(40.0, 132))
    dust = broad + depth + grit + 0.05 * ripples * noise.gradient(4.5, 133)
    strewn = 0.15 + 0.85 * smooth_step(-0.4, 1.4, noise.gradient(13.0, 170) + 0.6 * noise.gradient(41.0, 171))
    dust = dust + noise.clods() * np.maximum(strewn, talus)
    # Stones and lumps of the ground below show through thin dust.
    return smooth_max(rock, dust, 0.30), noise.dust_cover(dust - rock, _COVER_M)


def _strata(noise: Octaves, elevation: Float64) -> Float32:
    """Return how far the layers of uneven hardness stand out of a cliff, metres."""
    total = np.zeros(len(elevation), dtype=np.float32)
    for number, (thickness, reach) in enumerate(_STRATA_M):
        hard = np.random.Generator(np.random.Philox(4096 + number)).random(4096).astype(np.float32)
        u = elevation / thickness + 0.35 * noise.gradient(70.0, 150 + number)
        layer = np.floor(u)
        k = layer.astype(np.int64)
        inside = (u - layer).astype(np.float32)
        total += noise.ledge(thickness, reach, hard, k, inside)
    return total


def _slumped(points: Float64, faces: Int32, height_m: Float64) -> Float64:
    """Return heights with hardly any edge of the mesh steeper than `_STEEPEST`.

    Facets cannot show steeper slopes: every scarp would have saw teeth. Each step moves both ends of such an edge
    by half of the excess.
    """
    # in a closed mesh, every edge occurs once in each direction; one of them is kept
    a, b = (np.concatenate([faces[:, k] for k in ends]) for ends in ((0, 1, 2), (1, 2, 0)))
    a, b = a[a < b], b[a < b]

    def steepest(a: Int32, b: Int32) -> tuple[Float64]:
        off = points.take(a, axis=0) - points.take(b, axis=0)
        return (_STEEPEST * np.sqrt(np.einsum("ni,ni->n", off, off)),)

    (most,) = in_blocks(steepest, a, b)
    height = height_m.copy()
    for _ in range(_SLUMPS):
        # edges that are nearly too steep may become so while others become flatter
        near = np.abs(height.take(a) - height.take(b)) > 0.8 * most
        if not near.any():
            break
        i, j, limit = a[near], b[near], most[near]
        ends, number = np.unique(np.concatenate([i, j]), return_inverse=True)
        i, j, moved = number[: len(i)], number[len(i) :], height[ends]
        for _ in range(_SLUMP_STEPS):
            step = moved[i] - moved[j]
            excess = step - np.clip(step, -limit, limit)
            touched = (excess != 0).astype(np.float64)
            pull = np.bincount(j, excess, len(ends)) - np.bincount(i, excess, len(ends))
            edges = np.bincount(i, touched, len(ends)) + np.bincount(j, touched, len(ends))
            moved += 0.5 * pull / np.maximum(edges, 1)
        height[ends] = moved
    return height


def _talus(points_L: Float64, slope: Float32, width_m: float) -> Float32:
    """Return the debris at the feet of cliffs, float32[n]: it lies on moderate slopes below steep ground nearby."""
    cells = int(2 * _TALUS_REACH_M / _TALUS_CELL_M)
    cell_xy = np.floor((points_L[:, :2] + _TALUS_REACH_M) / _TALUS_CELL_M).astype(np.int64)
    inside = ((cell_xy >= 0) & (cell_xy < cells)).all(axis=1) & (np.abs(points_L[:, 2]) < _TALUS_REACH_M)
    cell = cell_xy[inside, 0] * cells + cell_xy[inside, 1]
    weight = smooth_step(*_CLIFF_DEG, slope[inside]).astype(np.float64)
    height = -points_L[inside, 2]

    def grid(values: NDArray) -> Float64:
        return np.asarray(np.bincount(cell, values, minlength=cells * cells), np.float64).reshape(cells, cells)

    count = np.maximum(grid(np.ones(len(cell))), 1)
    steep, above = grid(weight) / count, grid(weight * height) / count
    spread = width_m / _TALUS_CELL_M
    near = ndimage.gaussian_filter(steep, spread)
    level = ndimage.gaussian_filter(above, spread) / np.maximum(near, 1e-6)
    out = np.zeros(len(points_L), dtype=np.float32)
    below = smooth_step(1.0, 5.0, level.ravel()[cell] - height)
    out[inside] = smooth_step(0.02, 0.22, near.ravel()[cell]) * below
    return out * (1 - smooth_step(33.0, 42.0, slope))
