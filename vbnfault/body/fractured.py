"""Compute ground as on 67P: layered and jointed rock, cliffs and terraces, and basins that dust fills softly.

Gaussian fields look melted, because their phases are random. Here, long fields only place the relief. Its shape
comes from discontinuities, whose edges are straight or angular:

- large tilted planes, which meet in edges;
- strata: the rock consists of layers about perpendicular to gravity. Where the ground crosses them, it becomes
  treads and scarps. On cliffs, hard layers stand out as ledges;
- joints: three sets of fractures with directions fixed in the body cut the rock into slabs, each at its own level.
  They also shift the layers, so that scarps are angular in plan;
- polygons of cracks a few metres wide.

Dust lies where the slope lets it rest. In basins it fills the ground up to a smooth surface of its own. Its
thickness, and with it the cover, ends over a distance and not at a line.

References
----------
El-Maarry et al. 2015, Geophys. Res. Lett. 42, 5170: fractures of a few metres to 250 m, some of which cross at 90°.
Auger et al. 2018, Icarus 301, 173: polygons of 1 to 5 m in consolidated ground, 3.0 m in the mean. Groussin et al.
2015, A&A 583, A32: fine material on slopes of 0 to 20°, debris with many boulders at 20 to 45°, bare consolidated
cliffs from 45°. Massironi et al. 2015, Nature 526, 402: layers nearly perpendicular to the gravity of their lobe.
Vincent et al. 2017, MNRAS 469, S329: heights of cliffs follow a power law with the cumulative index -1.69. Heights
and strengths below are assumed; they were chosen by eye and by the deviogram of the shape model (`roughness`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .fields import Octaves, smooth_max, smooth_step
from .geometry import Float64
from .noise import Float32
from .spec import Fractured

_LAYERS = 4096  # random numbers of a sequence of layers, after which it repeats; a power of two
_LAST = _LAYERS - 1
# (mean thickness of the layers in metres, fraction of the rise that is gathered into the scarp)
_BEDS = ((34.0, 0.55), (14.0, 0.65), (5.5, 0.6), (2.2, 0.5))
_LEDGES_M = ((9.0, 1.5), (3.3, 0.7), (1.2, 0.25))  # thickness of a layer, and how far a hard layer stands out
# (mean distance of the joints, height per unit of the slabs' random level), in metres
_JOINTS_M = ((46.0, 4.5), (17.0, 1.3), (6.5, 0.35))
_POLYGONS_M = ((3.0, 0.22), (1.3, 0.10))
_BASIN_M = (420.0, 170.0)
_SHARED_M = 20.0  # longer octaves shape the large planes
_SCARP_FACETS = 4.0  # least width of a scarp on the ground


@dataclass(frozen=True, kw_only=True, eq=False)
class Bedrock:
    """Hold the rock down to its terraces, float32[n] in metres each.

    Attributes
    ----------
    height_m
        Height along the model's normal.
    swell_m
        The part of the height without layers and joints.
    slabs_m
        Height of the middle size of slabs between joints.
    """

    height_m: Float32
    swell_m: Float32
    slabs_m: Float32


def bedrock(
    noise: Octaves,
    swell: Float32,
    elevation_m: Float64,
    model_slope_deg: Float32,
    slope_of: Callable[[Float32], Float32],
    spec: Fractured,
) -> Bedrock:
    """Return the rock down to its terraces.

    Parameters
    ----------
    swell
        Long octaves of the relief, float32[n] in metres.
    slope_of
        Function that returns the slope in degrees of the ground with added heights.
    """
    slabs = _joints(noise, 1)
    blocks = np.float32(spec.joints) * (_joints(noise, 0) + 0.5 * slabs)
    swell = 0.6 * swell + _facets(noise)
    # joints shift the layers, so that scarps are angular in plan
    shifted = swell + 0.8 * blocks
    slope = slope_of(shifted)
    level = np.cos(np.radians(np.minimum(slope, 75.0))).astype(np.float32)
    dip = 26.0 * noise.gradient(1100.0, 600) + 9.0 * noise.gradient(420.0, 601)
    where = smooth_step(-0.9, 0.9, noise.gradient(260.0, 602) + 0.8 * noise.gradient(90.0, 603))
    # on a plain, layers hardly crop out
    strength = (0.3 + 0.7 * smooth_step(5.0, 17.0, model_slope_deg)) * (0.15 + 0.85 * where)
    steepness = np.tan(np.radians(np.clip(slope, 8.0, 65.0)))
    rise = _terraces(noise, elevation_m + dip + level * shifted, steepness, strength)
    height = swell + np.float32(0.5) * blocks + np.float32(spec.strata) * level * rise
    return Bedrock(height_m=np.asarray(height, dtype=np.float32), swell_m=swell, slabs_m=slabs)


def _terraces(noise: Octaves, bed_m: Float64, steepness: Float32, strength: Float32) -> Float32:
    """Return what gathers the rise of the ground across each layer into a scarp, metres along the vertical."""
    rise = np.zeros_like(strength)
    for number, (thickness, gathered) in enumerate(_BEDS):
        crinkle = noise.gradient(2.5 * thickness, 610 + number)
        crinkle -= 0.7 * np.abs(noise.gradient(0.9 * thickness, 620 + number))
        crinkle = np.float32(0.10 * thickness) * (crinkle + 0.3 * noise.gradient(0.35 * thickness, 630 + number))
        index, inside, height = _layers(bed_m + crinkle + rise, thickness, (noise.seed, 1, number))
        hard = _random((noise.seed, 2, number))[index & _LAST]
        # a scarp narrower than a few facets would have an edge like a saw
        wide = np.clip(_SCARP_FACETS * noise.facet_m / height * steepness, 0.2, 0.9).astype(np.float32)
        stair = smooth_step(0, 1, (inside - (1 - wide)) / wide)
        kept = np.float32(gathered) * (0.25 + 0.75 * hard) * noise.shown(0.5 * thickness)
        rise += kept * strength * height * (stair - inside)
    return rise


def _facets(noise: Octaves) -> Float32:
    """Return the height of large tilted planes, metres."""
    total = np.zeros(len(noise.facet_m), dtype=np.float32)
    bent = noise.bent(np.column_stack([6.0 * noise.gradient(60.0, 700 + axis) for axis in range(3)]))
    for k, wavelength in noise.wavelengths(noise.longest_m, 30.0):
        total += np.float32(0.85) * noise.amplitude(wavelength) * bent.planes(0.8 * wavelength, 710 + k)
    return total


def _random(key: tuple[int, ...]) -> Float32:
    """Return random numbers in [0, 1), float32[_LAYERS]."""
    seeds = np.random.SeedSequence((0x57A7A, *key))
    return np.random.Generator(np.random.Philox(seeds)).random(_LAYERS).astype(np.float32)


def _layers(coordinate_m: NDArray, thickness_m: float, key: tuple[int, ...]) -> tuple[NDArray, Float32, Float32]:
    """Cut a coordinate into layers of uneven thickness.

    Returns the number of the layer, int64[n], the position in it from 0 to 1, and its thickness in metres.
    """
    edge = 0.8 * _random(key)
    u = np.asarray(coordinate_m, dtype=np.float64) / thickness_m
    cell = np.floor(u).astype(np.int64)
    index = cell - (u - cell < edge[cell & _LAST])
    low = index + edge[index & _LAST]
    width = index + 1 + edge[(index + 1) & _LAST] - low
    return index, ((u - low) / width).astype(np.float32), (thickness_m * width).astype(np.float32)


def _joint_axes(seed: int) -> Float64:
    """Return the normals of the three sets of joints, float64[3, 3], in T."""
    rng = np.random.Generator(np.random.Philox(np.random.SeedSequence((0x7017, seed))))
    return np.asarray(np.linalg.qr(rng.normal(size=(3, 3)))[0] + 0.12 * rng.normal(size=(3, 3)))


def _joints(noise: Octaves, size: int) -> Float32:
    """Return the height of slabs between joints of one size, in metres, with cracks at the joints."""
    spacing, height = _JOINTS_M[size]
    total = np.zeros(len(noise.facet_m), dtype=np.float32)
    if not noise.shown(0.5 * spacing).any():
        return total
    crack_m = 0.02 * spacing
    shown = noise.shown(3 * crack_m)
    axes = _joint_axes(noise.seed)
    for k in range(3):
        stream = 640 + 10 * size + 3 * k
        bend = 0.5 * noise.gradient(8.0 * spacing, stream) + 0.05 * noise.gradient(1.5 * spacing, stream + 1)
        along = np.einsum("ni,i->n", noise.place_m, axes[k]) + spacing * bend
        index, inside, width = _layers(along, spacing, (noise.seed, 3, size, k))
        random = _random((noise.seed, 4, size, k))
        upper = inside > 0.5
        level, other = random[index & _LAST], random[(index + np.where(upper, 1, -1)) & _LAST]
        gap = np.where(upper, 1 - inside, inside) * width
        step = np.float32(height) * (other - level)
        ramp = np.maximum(np.maximum(0.06 * spacing, 4.5 * noise.facet_m), 0.6 * np.abs(step))
        slab = level - 0.5 + 0.5 * (other - level) * (1 - smooth_step(0, 1, gap / np.minimum(ramp, 0.48 * width)))
        # each joint ends: where the field is low, the slabs are one rock
        present = smooth_step(-0.5, 0.8, noise.gradient(3.0 * spacing, stream + 2))
        crack = 0.5 * crack_m * shown * (1 - smooth_step(0, 1, gap / np.maximum(crack_m, 2.0 * noise.facet_m)))
        total += present * (np.float32(height) * slab - crack * smooth_step(0.3, 0.6, 0.5 * (level + other)))
    return total * noise.shown(0.5 * spacing)


@dataclass(frozen=True, kw_only=True, eq=False)
class Lie:
    """Hold the slopes of the model and of the bedrock in degrees, talus and elevation, float[n] each."""

    model_slope_deg: Float32
    slope_deg: Float32
    talus: Float32
    elevation_m: Float64


def surface(noise: Octaves, rocks: Bedrock, broad: Float32, lie: Lie, spec: Fractured) -> tuple[Float32, Float32]:
    """Return the height in metres and the dust cover, both float32[n]."""
    history = noise.gradient(130.0, 100) + 0.5 * noise.gradient(47.0, 101)
    slope = lie.slope_deg
    # 1 where the ground is consolidated, 0 where it is loose
    rocky = noise.gradient(_BASIN_M[0], 690) + 0.5 * noise.gradient(_BASIN_M[1], 691)
    bare = smooth_step(10.0, 32.0, slope + 7 * history + 7 * rocky)
    cliff = smooth_step(38.0, 55.0, slope + 3 * history)
    rock = broad + _rubble(noise, bare) + spec.joints * bare * (0.4 * rocks.slabs_m + _joints(noise, 2))
    bend = np.column_stack([0.35 * noise.gradient(2.6, 110 + axis) for axis in range(3)])
    bent = noise.bent(bend)
    cracked = smooth_step(-0.6, 0.8, noise.gradient(33.0, 116)) * bare
    for number, (width, height) in enumerate(_POLYGONS_M):
        rock += spec.joints * cracked * bent.blocks(width, height, 120 + number)
    rock += spec.strata * cliff * _ledges(noise, lie.elevation_m)
    rock += lie.talus * (0.45 * noise.gradient(3.4, 140) + 0.2 * noise.gradient(1.4, 141))

    # a basin: level ground, where a slowly varying field lets dust gather
    low, high = _dust_slopes_deg(spec)
    basin = 1 - smooth_step(0.5 * low, 0.5 * (low + high), lie.model_slope_deg + 5 * rocky)
    rests = 1 - smooth_step(low, high, slope)
    depth = spec.dust_m * (0.15 + 1.4 * basin + 0.3 * history + 0.3 * noise.gradient(19.0, 131))
    depth -= 0.5 * spec.dust_m * lie.talus + (6.0 + 3.0 * spec.dust_m) * (1 - rests)
    floor = broad + basin * 0.75 * (0.35 * rocks.swell_m - broad)
    grit = np.zeros_like(rock)
    for k, wavelength in noise.wavelengths(7.0, max(1.8 * float(noise.facet_m[0]), 0.05)):
        grit += np.float32(0.02 * wavelength**0.65) * noise.gradient(wavelength, 300 + k)
    dust = floor + depth + grit
    strewn = 0.1 + 0.9 * smooth_step(-0.4, 1.4, noise.gradient(13.0, 170) + 0.6 * noise.gradient(41.0, 171))
    dust = dust + noise.clods() * np.maximum(strewn, lie.talus)
    cover = noise.dust_cover(dust - rock, 0.5 * spec.border_m) * rests
    soft = spec.border_m * (0.2 + 0.8 * basin)
    top = np.asarray(smooth_max(rock, dust, soft), dtype=np.float32)
    return top, np.asarray(cover, dtype=np.float32)


def dust_that_rests(slope_deg: Float32, spec: Fractured) -> Float32:
    """Return the fraction of the dust that the slope of the finished ground lets rest, float32[n]."""
    low, high = _dust_slopes_deg(spec)
    return np.asarray(1 - smooth_step(0.5 * (low + high), high + 2.0, slope_deg), dtype=np.float32)


def _dust_slopes_deg(spec: Fractured) -> tuple[float, float]:
    """Return the slopes up to which all dust rests and from which none does, at least 1° apart."""
    low, high = spec.dust_slope_deg
    return low, max(high, low + 1.0)


def _rubble(noise: Octaves, bare: Float32) -> Float32:
    """Return the roughness of the rock below its terraces: creased octaves that follow the law, metres."""
    total = np.zeros_like(bare)
    bent = noise.bent(np.column_stack([1.2 * noise.gradient(11.0, 703 + axis) for axis in range(3)]))
    vigour = 0.6 + 0.9 * smooth_step(-1.2, 1.4, noise.gradient(70.0, 102)) * (0.5 + 0.5 * bare)
    for k, wavelength in noise.wavelengths(_SHARED_M, max(1.8 * float(noise.facet_m[0]), 0.05)):
        value = noise.gradient(wavelength, 300 + k)
        creased = (0.80 - np.abs(value)) / np.float32(0.60)
        value += np.float32(0.9 if k % 2 else 0.5) * bare * (creased - value)
        amplitude = noise.amplitude(wavelength) * np.float32(min(1.25, 0.45 + 0.09 * wavelength))
        if wavelength > 2.0:
            value = 0.55 * value + 0.9 * bare * bent.planes(0.7 * wavelength, 730 + k)
        total += amplitude * value
    return np.asarray(vigour * total, dtype=np.float32)


def _ledges(noise: Octaves, elevation_m: Float64) -> Float32:
    """Return how far the layers stand out of a cliff, metres."""
    total = np.zeros(len(elevation_m), dtype=np.float32)
    for number, (thickness, reach) in enumerate(_LEDGES_M):
        coordinate = elevation_m + 0.25 * thickness * noise.gradient(5 * thickness, 150 + number)
        index, inside, _ = _layers(coordinate, thickness, (noise.seed, 5, number))
        hard = _random((noise.seed, 6, number))
        total += noise.ledge(thickness, reach, hard, index, inside)
    return total
