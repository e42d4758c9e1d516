"""Evaluate random fields at a million points at once, with drjit on the LLVM backend (loaded at first use).

Each field is a function of body-fixed position and a key alone. Positions are float64 on the device. The integer
part of a position names a cell and is hashed; the remaining fraction is float32. Kilometres from the body's centre
therefore cost no precision. Each point is evaluated by itself in the same order of operations, so that neither the
number of threads nor the neighbouring points change a bit. `Octaves` evaluates fields on a mesh, each only where
the facets can show it.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache, partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from ..core.process.llvm import backend, flat
from .geometry import Float64
from .noise import Float32, noise_key, seed_word
from .roughness import Roughness, deviogram

# The axes of each octave are turned about this axis and shifted. Otherwise the cells of all octaves would align at
# the origin.
_TURN_AXIS = (0.26726124, 0.53452248, 0.80178373)
_TURN_RAD = 1.3
_OFFSET_CELLS = 0.37

# Standard deviation of `Points.gradient`, measured over a million points.
GRADIENT_STD = 0.191
PLANES_STD = 0.1826

_CRATER_REACH = 1.5  # radii up to which a crater changes the ground
_AT_ONCE = 0.8  # difference in age, over a lifetime of the octave's largest, of craters that share their ground
# Complex craters of the Moon are 1.044 D^0.301 km deep, and their peaks 0.6 m (D / km)^1.97 high, a fifth of D wide
# (Pike 1977): at twice the largest simple diameter, 0.03 radii
_SHALLOWER, _PEAK, _PEAK_WIDTH = -0.7, 0.03, 0.15
_HOLLOW = 0.4  # depth of a hollow that a younger crater of like size leaves of an older one
_OUTLINE, _LOBES = 0.03, 8.0  # how far outlines depart from circles, and how quickly around them
# square root of 2 κt over the radius: Gaussians whose widths wear a crater; the first rounds its rim by 0.1 radii
_CRATER_WORN = (0.036, 0.06, 0.1, 0.15, 0.2, 0.26, 0.33, 0.42, 0.54, 0.7, 0.9, 1.2, 1.7)


def octave_rotation(number: int) -> Float64:
    """Return the rotation of an octave's axes, float64[3, 3]."""
    angle = _TURN_RAD * (number % 997)
    k = np.array(_TURN_AXIS)
    cross = np.array([[0, -k[2], k[1]], [k[2], 0, -k[0]], [-k[1], k[0], 0]])
    return np.asarray(np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * (cross @ cross))


class Points:
    """Hold body-fixed positions on the device and evaluate fields at the first `count` of them.

    Parameters
    ----------
    position_m
        float64[n, 3], metres.
    normals
        float64[n, 3]: unit normals of the ground, which `impacts` needs.
    """

    def __init__(self, position_m: Float64, normals: Float64 | None = None) -> None:
        d = backend()
        self.count = len(position_m)
        self._normals = normals
        self._axes = [d.Float64(flat(position_m[:, k])) for k in range(3)]

    def gradient(self, wavelength_m: float, key: int, count: int) -> Float32:
        """Return gradient noise of one cycle per 1-2 wavelengths, float32[count], mean 0, within ±1.3."""
        (value,) = self._run(_gradient, wavelength_m, key, count)
        return value

    def planes(self, width_m: float, key: int, count: int) -> Float32:
        """Return a continuous surface of planes that meet in edges, float32[count], 0 to 1 with mean 0.5.

        Random values at the corners of cells of that width are interpolated linearly in tetrahedra.
        """
        (value,) = self._run(_planes, width_m, key, count)
        return value

    def blocks(self, width_m: float, key: int, count: int) -> tuple[Float32, Float32, Float32]:
        """Evaluate a pattern of cells about one width across; each cell has its own random level and tilt.

        Returns three arrays, float32[count]: the value of the cell's tilted plane (standard deviation about 0.4),
        that of the second nearest cell, and the distance to the border between the two in metres.
        """
        level, other, gap = self._run(_blocks, width_m, key, count)
        return level, other, np.float32(width_m) * gap

    def craters(self, width_m: float, key: int, count: int, fraction: float) -> Float32:
        """Return the height of bowls with rims, float32[count] in metres, negative inside.

        A cell of this width holds at most one crater, and the given fraction of the cells holds one. Diameters
        are a third to two thirds of the width, with a cumulative index of 2. The same index holds over several
        widths if each is half of the one before and all have the same fraction of cells.
        """
        (value,) = self._run(_craters, width_m, key, count, fraction)
        return np.float32(width_m) * value

    def impacts(
        self, width_m: float, key: int, age_m: Float32, layers: int, *law: float
    ) -> tuple[Float32, Float32, Float32]:
        """Return height of craters in metres, brightness of the freshest, and age of the ground, float32[n] each.

        A cell of this width holds at most one sphere per layer, with a diameter of a third to two thirds of the
        width. The ground cuts it in a circle, in which the crater lies. It lasts for a time in proportion to its
        width, in metres: 1.5 times its width. It erases what is older inside of its rim, and ever less up to
        1.5 radii.

        Parameters
        ----------
        age_m
            Of the ground at the first n positions before these craters, which are the smaller ones: the ground of
            a larger, younger crater holds none of them.
        law
            Fraction of the cells of a layer that hold a sphere, exponent of their cumulative size law in space,
            power of a uniform number that gives the depth over a fresh crater's, fraction of level floors, and
            the diameter of the largest simple craters in metres.
        """
        if not len(age_m):
            return age_m, age_m, age_m
        d, width = backend(), np.float32(width_m)
        assert self._normals is not None
        normals = self._normals[: len(age_m)] @ octave_rotation(key & 0xFFFF).T
        upright = [d.Float(flat(normals[:, k].astype(np.float32))) for k in range(3)]
        kernel = partial(_impacts, d.Float(flat(age_m / width)), upright, layers)
        height, bright, age = self._run(kernel, width_m, key, len(age_m), *law[:-1], law[-1] / width_m)
        return width * height, bright, width * age

    def clods(self, width_m: float, key: int, count: int, fraction: float) -> Float32:
        """Return the height above the ground of half-buried stones, float32[count] in metres.

        A cell of this width holds at most one stone, and the given fraction of the cells holds one. Diameters are
        0.3 to 0.65 of the width.
        """
        (value,) = self._run(_clods, width_m, key, count, fraction)
        return np.float32(width_m) * value

    def _run(self, kernel: Callable, unit_m: float, key: int, count: int, *more: float) -> tuple[Float32, ...]:
        """Evaluate a kernel at the first `count` positions, in units of `unit_m`, on the axes of its octave."""
        d = backend()
        if count == 0:
            return tuple(np.zeros(0, dtype=np.float32) for _ in range(_OUTPUTS.get(kernel, 1)))
        # With opaque values, one compiled kernel serves all octaves.
        matrix = octave_rotation(key & 0xFFFF) / unit_m
        rows = [[d.dr.opaque(d.Float64, float(v)) for v in row] for row in matrix]
        shift = d.dr.opaque(d.Float64, _OFFSET_CELLS)
        word = d.dr.opaque(d.UInt32, int(seed_word(key)[0]))
        extra = [d.dr.opaque(d.Float, float(v)) for v in more]
        index = d.dr.arange(d.UInt32, count)
        p = [d.dr.gather(d.Float64, axis, index) for axis in self._axes]
        q = [row[0] * p[0] + row[1] * p[1] + row[2] * p[2] + shift for row in rows]
        out = kernel(d, q, word, *extra)
        d.dr.eval(*out)
        return tuple(np.array(value.numpy(), dtype=np.float32) for value in out)


def _mix(d: Any, h: Any) -> Any:
    """Return mixed hash words, as in `noise`: the lowbias32 finaliser (C. Wellons, public domain)."""
    h = h ^ (h >> 16)
    h = h * d.UInt32(0x7FEB352D)
    h = h ^ (h >> 15)
    h = h * d.UInt32(0x846CA68B)
    return h ^ (h >> 16)


def _split(d: Any, q: list[Any]) -> tuple[list[list[Any]], list[Any]]:
    """Return hash words of the lower and the upper cell on each axis, and the float32 fraction."""
    words, fractions = [], []
    for x, prime in zip(q, (0x8DA6B343, 0xD8163841, 0xCB1AB31F), strict=True):
        floor = d.dr.floor(x)
        cell = d.dr.reinterpret_array(d.UInt32, d.Int32(floor))
        words.append([cell * d.UInt32(prime), (cell + 1) * d.UInt32(prime)])
        fractions.append(d.Float(x - floor))
    return words, fractions


def _nearest_cells(d: Any, q: list[Any]) -> tuple[list[list[Any]], list[Any]]:
    """Return what `_split` does, for the two nearest cells on each axis: positions are 0.5 to 1.5 in them."""
    words, f = _split(d, [x - 0.5 for x in q])
    return words, [x + 0.5 for x in f]


def _corners(words: list[list[Any]], word: Any) -> list[tuple[int, int, int, Any]]:
    """Return offsets and combined hash word of the eight cells around each point."""
    return [
        (i, j, k, words[0][i] ^ words[1][j] ^ words[2][k] ^ word) for i in (0, 1) for j in (0, 1) for k in (0, 1)
    ]


def _unit(d: Any, h: Any, shift: int) -> Any:
    """Return ten bits of a hash as a number in [0, 1)."""
    return d.Float((h >> shift) & 1023) * (1.0 / 1024)


def _gradient(d: Any, q: list[Any], word: Any) -> tuple[Any, ...]:
    """Return gradient noise at positions in cells."""
    words, f = _split(d, q)
    fade = [x * x * x * (x * (x * 6 - 15) + 10) for x in f]
    total = d.Float(0)
    for i, j, k, h in _corners(words, word):
        h = _mix(d, h)
        dot = d.Float(0)
        weight = d.Float(1)
        for axis, step in enumerate((i, j, k)):
            # The components are uniform over ±1. The gradients' lengths differ, which makes the noise slightly
            # patchy.
            dot = dot + (2 * _unit(d, h, 10 * axis) - (1 - 1 / 1024)) * (f[axis] - step)
            weight = weight * (fade[axis] if step else 1 - fade[axis])
        total = total + weight * dot
    return (total,)


def _planes(d: Any, q: list[Any], word: Any) -> tuple[Any, ...]:
    """Return values interpolated linearly in the six tetrahedra of each cell (Kuhn 1960) at positions in cells."""
    words, f = _split(d, q)
    high = d.dr.maximum(f[0], d.dr.maximum(f[1], f[2]))
    low = d.dr.minimum(f[0], d.dr.minimum(f[1], f[2]))
    first = [f[0] >= high, (f[1] >= high) & (f[0] < high), (f[2] >= high) & (f[0] < high) & (f[1] < high)]
    last = [(f[0] <= low) & ~first[0], None, None]
    last[1] = (f[1] <= low) & ~first[1] & ~last[0]
    last[2] = ~last[0] & ~last[1]
    middle = f[0] + f[1] + f[2] - high - low
    corners = (
        [words[axis][0] for axis in range(3)],
        [d.dr.select(first[axis], words[axis][1], words[axis][0]) for axis in range(3)],
        [d.dr.select(last[axis], words[axis][0], words[axis][1]) for axis in range(3)],
        [words[axis][1] for axis in range(3)],
    )
    weights = (1 - high, high - middle, middle - low, low)
    total = d.Float(0)
    for (x, y, z), weight in zip(corners, weights, strict=True):
        total = total + weight * _unit(d, _mix(d, x ^ y ^ z ^ word), 0)
    return (total,)


def _blocks(d: Any, q: list[Any], word: Any) -> tuple[Any, ...]:
    """Return the planes of the two nearest cells and the distance to their border, in cells."""
    words, f = _nearest_cells(d, q)
    nearest, second = d.Float(9), d.Float(9)
    level, other = d.Float(0), d.Float(0)
    near = [d.Float(0)] * 3
    far = [d.Float(0)] * 3
    for i, j, k, h in _corners(words, word):
        h = _mix(d, h)
        g = _mix(d, h + 0x9E3779B9)
        # With a jitter of ±0.35 about the cell's centre, the nearest point is nearly always in one of these eight
        # cells. A miss only moves a fracture.
        offset = [f[axis] - (step + 0.15 + 0.7 * _unit(d, h, 10 * axis)) for axis, step in enumerate((i, j, k))]
        distance = offset[0] * offset[0] + offset[1] * offset[1] + offset[2] * offset[2]
        plane = d.Float(h >> 24) * (1.0 / 255) - 0.5
        for axis in range(3):
            plane = plane + 1.3 * (_unit(d, g, 10 * axis) - 0.5) * offset[axis]
        closer, beaten = distance < nearest, distance < second
        other = d.dr.select(closer, level, d.dr.select(beaten, plane, other))
        for axis in range(3):
            far[axis] = d.dr.select(closer, near[axis], d.dr.select(beaten, offset[axis], far[axis]))
            near[axis] = d.dr.select(closer, offset[axis], near[axis])
        second = d.dr.select(closer, nearest, d.dr.select(beaten, distance, second))
        level = d.dr.select(closer, plane, level)
        nearest = d.dr.select(closer, distance, nearest)
    between = [a - b for a, b in zip(near, far, strict=True)]
    apart = d.dr.sqrt(between[0] * between[0] + between[1] * between[1] + between[2] * between[2])
    # This is the distance to the plane midway between the two centres.
    gap = 0.5 * (second - nearest) / d.dr.maximum(apart, 1e-4)
    return level, other, gap


def _craters(d: Any, q: list[Any], word: Any, fraction: Any) -> tuple[Any, ...]:
    """Return the sum of the craters' heights at positions in cells."""
    words, f = _nearest_cells(d, q)
    total = d.Float(0)
    for i, j, k, h in _corners(words, word):
        h = _mix(d, h)
        g = _mix(d, h + 0x9E3779B9)
        offset = [f[axis] - (step + _unit(d, h, 10 * axis)) for axis, step in enumerate((i, j, k))]
        distance = d.dr.sqrt(offset[0] * offset[0] + offset[1] * offset[1] + offset[2] * offset[2])
        # The radius inverts N(>= D) ~ D^-2. The outer slope of the rim ends at 1.5 radii, within the eight cells.
        radius = (1.0 / 6) / d.dr.sqrt(1 - 0.75 * _unit(d, g, 0))
        x = distance / radius
        present = (_unit(d, g, 10) < fraction) & (x < 1.5)
        freshness = 0.35 + 0.65 * _unit(d, g, 20)
        bowl = d.dr.minimum(x * x, 1) - 1  # -1 in the middle
        bowl = d.dr.maximum(bowl, -(0.45 + 0.5 * freshness))  # dust on the floor
        skirt = d.dr.maximum(1 - d.dr.abs(x - 1) * 2, 0)
        rim = skirt * skirt * (3 - 2 * skirt)
        height = radius * freshness * (0.42 * bowl + 0.07 * rim)
        total = total + d.dr.select(present, height, 0)
    return (total,)


def _impacts(before: Any, up: Any, layers: int, d: Any, q: list[Any], word: Any, *law: Any) -> tuple[Any, ...]:
    """Return the craters' height in cells, where the freshest are bright, and the age of the ground."""
    words, f = _nearest_cells(d, q)
    fraction, index, wear, ponds, simple = law
    craters = []
    youngest, next_youngest = d.Float(np.inf), d.Float(np.inf)
    for i, j, k, h in [corner for n in range(layers) for corner in _corners(words, word + 0x51ED27 * n)]:
        h = _mix(d, h)
        g = _mix(d, h + 0x9E3779B9)
        e = _mix(d, g)
        offset = [f[axis] - (step + _unit(d, h, 10 * axis)) for axis, step in enumerate((i, j, k))]
        # the radius inverts N(>= R) ~ R^-index; what lies beyond 1.5 radii may be in no cell of the eight
        sphere = (1.0 / 6) * d.dr.power(1 - (1 - d.dr.power(d.Float(2), -index)) * _unit(d, g, 0), -1 / index)
        depth = sum(a * b for a, b in zip(offset, up, strict=True))
        radius = d.dr.sqrt(d.dr.maximum(sphere * sphere - depth * depth, 1e-8))
        square = d.dr.maximum(sum(a * a for a in offset), 1e-12)
        lobes = sum((_unit(d, e, 8 * axis) - 0.5) * offset[axis] for axis in range(3)) * d.dr.rsqrt(square)
        x = d.dr.sqrt(d.dr.maximum(square - depth * depth, 0)) / radius
        x = x * (1 + _OUTLINE * d.dr.sin(_LOBES * lobes + 6.3 * _unit(d, e, 2)))
        x = d.dr.select(d.Float(e >> 8) * 2.0**-24 < fraction, x, np.inf)  # ten bits are too coarse
        early = _unit(d, g, 20) + 0.5 / 1024  # 1: just formed
        age = 3 * radius * (1 - early)
        outward = x / _CRATER_REACH
        hides = age + (1 + _AT_ONCE) * outward * outward * outward
        next_youngest = d.dr.minimum(next_youngest, d.dr.maximum(youngest, hides))
        youngest = d.dr.minimum(youngest, hides)
        craters.append((x, radius, early, age, hides, _unit(d, g, 10) < ponds))
    total, bright = d.Float(0), d.Float(0)
    profiles = _Profiles(d)
    for x, radius, early, age, hides, pond in craters:
        # one of like size leaves a hollow without a rim where a younger one lies on it, a smaller one nothing
        fresh = d.dr.power(early, wear)
        kept = _later(d, d.dr.select(hides == youngest, next_youngest, youngest) - age)
        left = fresh * d.dr.lerp(_HOLLOW, 1, kept)
        height = _with_level_floor(d, profiles(x, left), left, x, pond, 2 * radius / simple)
        stays = _later(d, before - age)
        total = total + stays * radius * height
        shine = d.dr.maximum(8 * fresh - 7, 0) * d.dr.clip(2 * (_CRATER_REACH - x), 0, 1)
        bright = bright + stays * kept * shine
    return total, bright, d.dr.minimum(before, youngest)


def _with_level_floor(d: Any, height: Any, left: Any, x: Any, pond: Any, size: Any) -> Any:
    """Return the height over the radius of a crater that is a pond or complex.

    `size` is its diameter over that of the largest simple craters.
    """
    complex_ = d.dr.select(size > 1, 0.33 * d.dr.power(d.dr.maximum(size, 1), _SHALLOWER), 1)
    floor = -left * d.dr.minimum(d.dr.select(pond, 0.2, 1), complex_)
    over = height - floor
    curve = 1e-6 - 0.3 * floor  # over which the floor meets the wall
    near = d.dr.maximum(curve - d.dr.abs(over), 0)
    peak = _PEAK * d.dr.clip(size - 1, 0, 1) * left * d.dr.exp(-d.dr.square(x / _PEAK_WIDTH))
    return floor + d.dr.maximum(over, 0) + 0.25 * near * near / curve + peak


def _later(d: Any, age_difference: Any) -> Any:
    """Return whether a crater is later than what it lies on, 0 to 1, from how much older that is."""
    t = d.dr.clip(0.5 + age_difference / _AT_ONCE, 0, 1)
    return t * t * (3 - 2 * t)


class _Profiles:
    """Interpolate `_worn_craters` at the distance and depth of each point."""

    def __init__(self, d: Any) -> None:
        table = _worn_craters()
        self._d, self._table, (self._rows, self._columns) = d, d.Float(table.ravel()), table.shape

    def __call__(self, x: Any, fresh: Any) -> Any:
        d, inside = self._d, x < _CRATER_REACH
        column = d.dr.select(inside, x, 0) * ((self._columns - 1.001) / _CRATER_REACH)
        row = fresh * (self._rows - 1.001)
        place = d.UInt32(row) * self._columns + d.UInt32(column)
        near, far = (
            [d.dr.gather(d.Float, self._table, place + below + step, inside) for step in (0, 1)]
            for below in (0, self._columns)
        )
        across = column - d.dr.floor(column)
        return d.dr.lerp(d.dr.lerp(*near, across), d.dr.lerp(*far, across), row - d.dr.floor(row))


@lru_cache(maxsize=1)
def _worn_craters() -> Float32:
    """Return heights over the radius of craters of the depths 0, 1/31 … 1 of a fresh one, float32[32, 96].

    Columns are distances from the centre from 0 to `_CRATER_REACH` radii. Fresh simple craters are those of Fassett
    & Thomson 2014 (JGR Planets 119, 2255, eq. 4), a fifth as deep as wide. Diffusion wears them and rounds rims.
    """
    step = 0.02
    axis = np.arange(-4.0, 4.0 + step / 2, step)
    x = np.hypot(axis, axis[:, None])
    wall = np.polynomial.Polynomial((-0.22881, 0.227534, 0.083117, -0.039499))(x)
    outside = np.polynomial.Polynomial((0.188253, -0.18705, 0.018447, 0.015056))(x)
    fresh = 2 * np.select([x < 0.98, x < 1.02, x < 1.5], [np.maximum(wall, 0.0368 - 0.2), 0.0368, outside], 0.0)
    middle = len(axis) // 2
    worn = [ndimage.gaussian_filter(fresh, width / step)[middle, middle:] for width in _CRATER_WORN]
    depth = np.array([profile.max() - profile[0] for profile in worn])
    at = np.linspace(0, _CRATER_REACH, 96)
    # worn ones reach farther
    taper = [smooth_step(0.0, min(0.1 + 1.5 * width, 0.8), _CRATER_REACH - at) for width in _CRATER_WORN]
    profiles = [part * np.interp(at, axis[middle:], one) for part, one in zip(taper, worn, strict=True)]
    wanted = np.linspace(0, 1, 32) * depth[0]
    rows = [np.interp(wanted, depth[::-1], column[::-1]) for column in np.transpose(profiles)]
    return np.transpose(rows).astype(np.float32)


def _clods(d: Any, q: list[Any], word: Any, fraction: Any) -> tuple[Any, ...]:
    """Return the height of the highest stone at positions in cells."""
    words, f = _nearest_cells(d, q)
    highest = d.Float(0)
    for i, j, k, h in _corners(words, word):
        h = _mix(d, h)
        g = _mix(d, h + 0x9E3779B9)
        offset = [f[axis] - (step + _unit(d, h, 10 * axis)) for axis, step in enumerate((i, j, k))]
        square = offset[0] * offset[0] + offset[1] * offset[1] + offset[2] * offset[2]
        radius = 0.15 + 0.175 * _unit(d, g, 0) * _unit(d, g, 0)
        # 1 - (distance / radius)^4 has a flatter top and steeper sides than a sphere.
        x = square / (radius * radius)
        dome = radius * (0.35 + 0.5 * _unit(d, g, 10)) * (1 - x * x)
        highest = d.dr.maximum(highest, d.dr.select(_unit(d, g, 20) < fraction, dome, 0))
    return (highest,)


_OUTPUTS = {_blocks: 3}  # arrays that a kernel returns, if not one

# --- fields on a mesh -------------------------------------------------------------------------------------------

# A field fades in as its wavelength grows from 1.6 to 2.8 facets.
_FADE = (1.6, 2.8)

_CRATER_WIDTHS_M = (72.0, 36.0, 18.0, 9.0)  # cells; diameters are a third to two thirds of their width
_CRATER_SHARE_PER_DENSITY = 1534e-6  # fraction of the cells, per crater of 10 m or more in a square kilometre
_HIDDEN = 3.0  # height over which dust hides relief, over the relief's deviation
_UNITS_M = (
    (260.0, 0.35),
    (110.0, 0.35),
    (45.0, 0.3),
    (18.0, 0.2),
    (8.0, 0.15),
)  # size of units of the ground, and how their cover differs
_CLOD_CELLS_M = (2.1, 1.2, 0.7)
_CRACK_DEPTH = 0.30  # of the cracks between blocks, per unit of the blocks' height


def smooth_step(low: float, high: float, x: NDArray) -> Float32:
    """Return a smooth step from 0 at `low` to 1 at `high`."""
    t = np.clip((np.asarray(x, dtype=np.float32) - np.float32(low)) / np.float32(high - low), 0, 1)
    return np.asarray(t * t * (3 - 2 * t), dtype=np.float32)


def smooth_max(a: NDArray, b: NDArray, width: float | Float32) -> NDArray:
    """Return the maximum, rounded where a and b differ by less than `width`."""
    reach = np.asarray(width, dtype=np.float32)
    h = np.maximum(reach - np.abs(a - b), 0) / reach
    return np.asarray(np.maximum(a, b) + h * h * (reach / np.float32(4)))


class Octaves:
    """Evaluate noise at points that are sorted by the size of their facets; it is 0 where facets are too coarse."""

    def __init__(
        self,
        place_m: Float64,
        facet_m: Float64,
        seed: int,
        roughness: Roughness,
        longest_m: float,
        normals: Float64 | None = None,
    ) -> None:
        self.place_m = place_m
        self.facet_m = facet_m
        self.seed = seed
        self._points = Points(place_m, normals)
        self._roughness = roughness
        self.longest_m = longest_m
        self._unit = 1.0 / windowed_deviation(roughness.hurst)

    def bent(self, shift_m: NDArray) -> Octaves:
        """Return the same fields at shifted positions."""
        return Octaves(self.place_m + shift_m, self.facet_m, self.seed, self._roughness, self.longest_m)

    def shown(self, wavelength_m: float) -> Float32:
        """Return how well the facets show a wavelength, float32[n] in [0, 1]."""
        return smooth_step(*_FADE, wavelength_m / self.facet_m)

    def _count(self, wavelength_m: float) -> int:
        """Return the number of points whose facets can show a wavelength."""
        return int(np.searchsorted(self.facet_m, wavelength_m / _FADE[0]))

    def _full(self, part: Float32, wavelength_m: float) -> Float32:
        """Return values of the leading points, faded in by their facet size, and 0 at the other points."""
        out = np.zeros(len(self.facet_m), dtype=np.float32)
        n = len(part)
        out[:n] = part * smooth_step(*_FADE, wavelength_m / self.facet_m[:n])
        return out

    def gradient(self, wavelength_m: float, stream: int) -> Float32:
        """Return gradient noise of standard deviation 1."""
        count = self._count(wavelength_m)
        part = self._points.gradient(wavelength_m, noise_key(self.seed, stream), count)
        return self._full(part, wavelength_m) * np.float32(1 / GRADIENT_STD)

    def amplitude(self, wavelength_m: float) -> np.float32:
        """Return the factor on an octave of standard deviation 1 that makes all octaves follow the law."""
        return np.float32(self._unit * float(self._roughness.deviation_at(wavelength_m)))

    def dust_cover(self, above_m: Float32, border_m: float) -> Float32:
        """Return the fraction of each facet that dust covers, float32[n], where it reaches `above_m` over the rock.

        Relief below the facets lets rock show through thin dust, so the cover grows over its height, or over
        `border_m` where that is larger: over metres of ground and not at a line. Units of 8 to 300 m differ.
        """
        hidden_m = _HIDDEN * self._unit * self._roughness.deviation_at(_FADE[1] * self.facet_m)
        unit = sum(np.float32(a) * self.gradient(w, 680 + k) for k, (w, a) in enumerate(_UNITS_M))
        # deep dust varies, too, by its age and its thickness
        return smooth_step(-1.6, 2.0, np.minimum(above_m / np.hypot(border_m, hidden_m), 1.0) + unit)

    def wavelengths(self, longest_m: float, shortest_m: float) -> list[tuple[int, float]]:
        """Return the octaves in (shortest, longest] as (number, wavelength); the patch's longest is number 0."""
        last = int(np.ceil(np.log2(self.longest_m / shortest_m)))
        both = [(k, self.longest_m / 2**k) for k in range(last + 1)]
        return [(k, w) for k, w in both if shortest_m < w <= longest_m * 1.0001]

    def fractal(self, longest_m: float, shortest_m: float, stream: int, angularity: float = 0.0) -> Float32:
        """Return the sum of octaves that follow the roughness law, metres.

        Of the variance of each, the part `angularity` is that of planes which meet in edges, the rest that of
        rounded waves. The two are independent.
        """
        total = np.zeros(len(self.facet_m), dtype=np.float32)
        for k, wavelength in self.wavelengths(longest_m, shortest_m):
            size = self.amplitude(wavelength)
            if angularity < 1:
                total += size * np.float32((1 - angularity) ** 0.5) * self.gradient(wavelength, stream + k)
            if angularity > 0:
                total += size * np.float32(angularity**0.5) * self.planes(wavelength, stream + k)
        return total

    def blocks(self, width_m: float, height_m: float, stream: int) -> Float32:
        """Return the height of blocks of that width, each at its own level, with cracks between them, metres."""
        count = self._count(width_m)
        level, other, gap = self._points.blocks(width_m, noise_key(self.seed, stream), count)
        step = np.float32(height_m) * (other - level)
        # A step narrower than two facets, or steeper than 60°, would have an edge like a saw.
        ramp = np.maximum(0.06 * width_m, 1.8 * self.facet_m[:count]).astype(np.float32)
        ramp = np.maximum(ramp, 0.45 * np.abs(step))
        edge = 1 - smooth_step(0, 1, gap / ramp)
        crack = np.minimum(np.float32(_CRACK_DEPTH * height_m), 0.5 * ramp)
        return self._full(height_m * level + (0.5 * step - crack) * edge, width_m)

    def planes(self, width_m: float, stream: int) -> Float32:
        """Return a surface of planes of that width that meet in edges, with standard deviation 1."""
        part = self._points.planes(width_m, noise_key(self.seed, stream), self._count(width_m))
        return self._full((part - np.float32(0.5)) * np.float32(1 / PLANES_STD), width_m)

    def craters(self, per_km2: float) -> Float32:
        """Return the height of craters on cells of all widths, metres."""
        total = np.zeros(len(self.facet_m), dtype=np.float32)
        fraction = min(1.0, _CRATER_SHARE_PER_DENSITY * per_km2)
        for k, width in enumerate(_CRATER_WIDTHS_M):
            shows = width / 4  # as a wavelength; the smallest bowls are a third of the cell wide
            part = self._points.craters(width, noise_key(self.seed, 400 + k), self._count(shows), fraction)
            total += self._full(part, shows)
        return total

    def impacts(
        self, width_m: float, stream: int, age_m: Float32, layers: int, *law: float
    ) -> tuple[Float32, Float32, Float32]:
        """Return height in metres, brightness, and age of the ground with craters, see `Points.impacts`."""
        shows = width_m / 4.5  # with fewer than four facets across, bowls would be dots
        count = self._count(shows)
        key = noise_key(self.seed, stream)
        height, bright, age = self._points.impacts(width_m, key, age_m[:count], layers, *law)
        return self._full(height, shows), self._full(bright, shows), np.concatenate([age, age_m[count:]])

    def clods(self) -> Float32:
        """Return the height of half-buried stones of all sizes, metres."""
        highest = np.zeros(len(self.facet_m), dtype=np.float32)
        for number, width in enumerate(_CLOD_CELLS_M):
            shows = 0.7 * width
            part = self._points.clods(width, noise_key(self.seed, 160 + number), self._count(shows), 0.55)
            highest = np.maximum(highest, self._full(part, shows))
        return highest

    def ledge(self, thickness_m: float, reach_m: float, hard: Float32, index: NDArray, inside: Float32) -> Float32:
        """Return how far layers of one thickness stand out of a cliff, metres.

        Parameters
        ----------
        reach_m
            How far a hard layer stands out.
        hard
            Random hardness of layers, float32[k]; k is a power of two.
        index, inside
            Number of each point's layer, int64[n], and its position in it from 0 to 1.
        """
        ramp = np.clip(1.5 * self.facet_m / thickness_m, 0.12, 0.5).astype(np.float32)
        below, here = hard[(index - 1) & (len(hard) - 1)], hard[index & (len(hard) - 1)]
        blend = smooth_step(0, 1, inside / ramp)
        return self.shown(thickness_m) * np.float32(reach_m) * (below + blend * (here - below) - 0.5)


@lru_cache(maxsize=16)
def windowed_deviation(hurst: float) -> float:
    """Return ν(1) that `deviogram` measures on octaves with wavelengths w and standard deviations w^hurst.

    The measurement uses 40 tiles. The quadric fitted to each removes a part of the long octaves, as it does on a
    model.
    """
    side, tiles = 36, 40
    x, y = np.meshgrid(np.arange(side) / 6.0, np.arange(side) / 6.0, indexing="ij")
    tile = np.column_stack([x.ravel(), y.ravel(), np.zeros(side * side)])
    position = (tile[None] + 400.0 * np.arange(tiles)[:, None, None] * np.array([1.0, 0.7, 0.3])).reshape(-1, 3)
    field, height = Points(position), np.zeros(len(position))
    for k in range(-4, 6):
        key = noise_key(1, 40 + k)
        height += 2.0 ** (k * hurst) / GRADIENT_STD * field.gradient(2.0**k, key, len(position))
    total = 0.0
    up = np.tile([0.0, 0.0, 1.0], (side * side, 1))
    for part in range(tiles):
        # The heights are scaled down, so that distances stay those along the plane.
        surface = tile + np.array([0.0, 0.0, 1e-4]) * height.reshape(tiles, -1)[part][:, None]
        total += 1e8 * float(deviogram(surface, up, np.array([1.0]), windows=9)[0]) ** 2
    return float(np.sqrt(total / tiles))
