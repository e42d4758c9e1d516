"""Compute relief finer than the facets: slopes that turn the shading normal, down to the size of a pixel.

Near the site, a facet is a decimetre wide and a pixel seen from ten metres a centimetre. Far away, facets are
metres wide and pixels decimetres. Between these scales lies a self-affine surface strewn with pebbles, which
continues the terrain's roughness.

The surface is the sum of two periodic fields of slopes. They are turned against each other so that their repetition
is not visible. A pyramid of resolutions averages them over the pixel; anything smaller is left to the roughness of
the ground reflectance. Both fields grow with the facets in factors of four, alternately: each changes its scale
while its weight is zero, so that no border is visible. The relief only changes the shading; it casts no shadows.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .runtime import dr, mi, packets

_SIDE = 512  # texels
_LEVELS = 8
_TILES_M = (2.03, 1.37)
_TURN = np.radians(37.0)
_LONGEST_M = 0.3  # longest wavelength of tiles this large; longer ones are in the facets
_FACETS = 2.5  # the longest wavelength, in facets
_HURST = 0.85
# Dust is smoother than the ground that it covers.
_ON_DUST = 0.5
_GRAZING = 0.15
_PEBBLES = 0.5  # fraction of the variance of slopes
_PEBBLE_CELLS = (4, 8, 16, 32, 64)  # texels; each cell holds at most one pebble, with a radius of up to 0.4 cells
_PEBBLE_SHARE = 0.5  # fraction of the cells with a pebble
_STEEPEST = 1.5
_SHARPER = 2**-0.5  # widths of a pixel that the pyramid averages over; the samples of the pixel average, too
_UNIT = 2.0**-11  # slopes are stored as int16 in this unit


@dataclass(frozen=True, kw_only=True)
class FineRelief:
    """Describe how a self-affine surface continues below the facets.

    Attributes
    ----------
    slope
        RMS slope per octave and axis on bare ground, at wavelengths of 2.5 `facet_m`. At longer wavelengths it
        changes as the wavelength to the power `hurst` - 1.
    facet_m, radius_m, growth
        Facets have the size `facet_m` up to `radius_m` from the origin. Beyond, their size grows as the distance to
        the power `growth`.
    hurst
        Exponent of the self-affine surface.
    """

    slope: float
    facet_m: float = _LONGEST_M / _FACETS
    radius_m: float = 1e9
    growth: float = 1.0
    hurst: float = _HURST

    @property
    def longest_m(self) -> float:
        """Return the longest wavelength near the origin."""
        return _FACETS * self.facet_m


class Detail:
    """Evaluate the relief as seen with pixels that subtend `pixel_rad`."""

    def __init__(self, relief: FineRelief, pixel_rad: float) -> None:
        self._slope = dr.opaque(mi.Float, relief.slope)
        self._pixel = dr.opaque(mi.Float, pixel_rad)
        self._inverse_radius2 = dr.opaque(mi.Float, relief.radius_m**-2)
        self._growth = dr.opaque(mi.Float, relief.growth)
        # near the site, the scales of the two tiles differ by a factor of 2
        self._per_m = dr.opaque(mi.Float, _LONGEST_M * np.sqrt(2) / relief.longest_m)
        self._fall = dr.opaque(mi.Float, relief.hurst - 1)
        self._pyramid = _pyramid()

    def turned(self, normal: Any, point: Any, view: Any, distance_m: Any, dust: Any) -> Any:
        """Return unit normals turned by the slopes at points of L."""
        footprint = distance_m * self._pixel * dr.rsqrt(dr.maximum(dr.abs(dr.dot(normal, view)), _GRAZING))
        # slopes refer to the coordinate plane (xy, yz or xz) that is most nearly perpendicular to the normal
        a = dr.abs(normal)
        level_ground, faces_x = (a.z >= a.x) & (a.z >= a.y), a.x > a.y
        u = dr.select(level_ground | ~faces_x, point.x, point.y)
        v = dr.select(level_ground, point.y, point.z)
        # this grows by 1 where facets become twice as large
        larger = self._growth * _log2(dr.maximum(dr.squared_norm(point) * self._inverse_radius2, 1.0)) * 0.5
        su, sv = mi.Float(0), mi.Float(0)
        for k, tile in enumerate(_TILES_M):
            turn = 0.5 * (larger + 0.5 - k)
            step = dr.round(turn)
            octave = 2 * step + k
            # this is nearly a cosine: 1 in the middle of a step, 0 where the next begins
            weight = (1 - 4 * dr.square(turn - step)) * dr.exp2(self._fall * octave)
            per_m = _power_of_two(-mi.Int32(octave)) * (self._per_m / tile)
            pair = self._slopes(k, u * per_m, v * per_m, footprint * per_m * _SIDE)
            c, s = float(np.cos(k * _TURN)), float(np.sin(k * _TURN))
            su += weight * (c * pair[0] - s * pair[1])
            sv += weight * (s * pair[0] + c * pair[1])
        strength = self._slope * dr.lerp(1.0, _ON_DUST, dust)
        su, sv = su * strength, sv * strength
        off = mi.Vector3f(
            dr.select(level_ground | ~faces_x, su, 0),
            dr.select(level_ground, sv, dr.select(faces_x, su, 0)),
            dr.select(level_ground, 0, sv),
        )
        return dr.normalize(normal - off)

    def _slopes(self, k: int, u: Any, v: Any, texels: Any) -> tuple[Any, Any]:
        """Return slopes along the axes of tile k at positions in tiles, averaged over `texels` texels."""
        level = _log2(dr.maximum(_SHARPER * texels, 1.0))
        c, s = float(np.cos(k * _TURN)), float(np.sin(k * _TURN))
        u, v = c * u + s * v, c * v - s * u
        u, v = u - dr.floor(u), v - dr.floor(v)
        shown = level < _LEVELS
        whole = mi.Int32(dr.clip(level, 0, _LEVELS - 1))  # a ray without a hit may give any number
        coarser = level - mi.Float(whole)
        fine, coarse = (self._of_level(n, u, v, shown & (n < _LEVELS)) for n in (whole, whole + 1))
        return tuple(dr.lerp(*pair, coarser) * _UNIT for pair in zip(fine, coarse, strict=True))

    def _of_level(self, level: Any, u: Any, v: Any, shown: Any) -> tuple[Any, Any]:
        """Return slopes of a level in units of `_UNIT` at positions from 0 to 1 in a tile."""
        side = mi.Int32(_SIDE) >> level
        x, y = u * mi.Float(side), v * mi.Float(side)
        column, row = mi.Int32(x), mi.Int32(y)
        x, y = x - mi.Float(column), y - mi.Float(row)
        # the texels of the larger levels come first; an index that rounds up to `side` belongs to the next tile
        start, last = (_SIDE * _SIDE - side * side) // 3 * 4, side - 1
        texel = mi.UInt32(start + (row & last) * side + (column & last))
        corners = dr.gather(mi.Vector4i, self._pyramid, texel, shown)
        su, sv = ([mi.Float(c << 16 >> 16 if low else c >> 16) for c in corners] for low in (True, False))
        return tuple(dr.lerp(dr.lerp(of[0], of[1], x), dr.lerp(of[2], of[3], x), y) for of in (su, sv))


def _log2(x: Any) -> Any:
    """Return log2 of positive numbers from the bits of the float, within 0.09.

    The result rises monotonically and is exact at powers of two.
    """
    return mi.Float(dr.reinterpret_array(mi.Int32, x)) * 2.0**-23 - 127


def _power_of_two(exponent: Any) -> Any:
    """Return 2 to the power of an integer."""
    return dr.reinterpret_array(mi.Float, (exponent + 127) << 23)


@lru_cache(maxsize=1)
def _pyramid() -> Any:
    """Return the slopes of all levels, level after level: each texel with its neighbours, two slopes to a word."""
    k = np.fft.fftfreq(_SIDE) * _SIDE
    kx, ky = np.meshgrid(k, k)
    radius = np.hypot(kx, ky)
    longest = _TILES_M[0] / _LONGEST_M  # cycles per tile
    power = np.where(radius >= longest, np.maximum(radius, 1.0) ** (-2 * (1 + _HURST)), 0.0)
    rng = np.random.Generator(np.random.Philox(np.random.SeedSequence(0xDE7A11)))
    height = np.sqrt(power) * np.fft.fft2(rng.normal(size=(_SIDE, _SIDE)))
    slopes = np.stack([np.fft.ifft2(2j * np.pi * f * height).real for f in (kx, ky)], axis=-1)
    slopes *= np.sqrt((1 - _PEBBLES) / np.mean(slopes**2))
    strewn = _pebbles(rng)
    slopes += strewn * np.sqrt(_PEBBLES / np.mean(strewn**2))
    octaves = np.log2(_SIDE / 2 / longest)
    slopes *= np.sqrt(octaves / np.mean(slopes**2))
    levels: list[np.ndarray] = []
    for _ in range(_LEVELS):
        levels.append(slopes)
        slopes = slopes.reshape(len(slopes) // 2, 2, -1, 2, 2).mean(axis=(1, 3))
    words = [
        np.round(level / _UNIT).clip(-32768, 32767).astype(np.int16).view(np.int32)[..., 0] for level in levels
    ]
    # each texel with its neighbours to the right, below, and both makes one packet
    corners = [np.stack([np.roll(w, (-j, -i), (0, 1)) for j in (0, 1) for i in (0, 1)], axis=-1) for w in words]
    table = packets(mi.Int32, np.concatenate([of.reshape(-1) for of in corners]))
    dr.eval(table)
    return table


def _pebbles(rng: np.random.Generator) -> NDArray[np.float64]:
    """Return slopes float64[y, x, 2] of a periodic layer of pebbles of all sizes."""
    highest = np.zeros((_SIDE, _SIDE))
    for cell in _PEBBLE_CELLS:
        count = _SIDE // cell
        position = rng.random((2, count, count))
        radius = cell * (0.15 + 0.25 * rng.random((count, count)) ** 2)
        tall = radius * (0.4 + 0.5 * rng.random((count, count))) * (rng.random((count, count)) < _PEBBLE_SHARE)
        turn, squeeze = rng.random((count, count)) * np.pi, 1 + 0.6 * rng.random((count, count))
        of = np.nonzero(tall)
        # rows and columns that the pebble of a cell may cover, and their distances from its middle
        about = np.arange(-(cell // 2), cell + cell // 2)
        row, column = (cell * k[:, None] + about for k in of)
        y, x = (about - cell * p[of][:, None] for p in position)
        y, x = y[:, :, None], x[:, None, :]
        c, s, q, r = (a[of][:, None, None] for a in (np.cos(turn), np.sin(turn), squeeze, radius))
        square = ((c * x + s * y) ** 2 + (q * (c * y - s * x)) ** 2) / r**2
        n, j, i = np.nonzero(square < 1)
        height = tall[of][n] * (1 - square[n, j, i] ** 1.5)
        np.maximum.at(highest, (row[n, j] % _SIDE, column[n, i] % _SIDE), height)
    slopes = np.stack([0.5 * (np.roll(highest, -1, axis) - np.roll(highest, 1, axis)) for axis in (1, 0)], axis=-1)
    return np.asarray(np.clip(slopes, -_STEEPEST, _STEEPEST))
