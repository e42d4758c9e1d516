"""Relief finer than facets: slopes that turn the normal, down to the pixel and no further.

A facet near the site is a decimetre wide, a pixel seen from ten metres a centimetre. What lies between is a
self-affine surface that continues the terrain's roughness: two periodic fields of slopes, turned against each other
so that their repetition does not show, averaged over the pixel (a pyramid) so that what is smaller than a pixel is
left to the photometric model's own roughness. It shades; it does not cast shadows.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np

from .runtime import dr, mi

_SIDE = 512  # texels
_LEVELS = 8
_TILES_M = (2.03, 1.37)
_TURN = np.radians(37.0)
_LONGEST_M = 0.3  # wavelength: what is longer is in the facets
_HURST = 0.85
# Dust lies smoother than the ground that it covers.
_ON_DUST = 0.35
_GRAZING = 0.15


class Detail:
    """Slopes of RMS `slope` an octave and axis on bare ground; `pixel_rad`: angle that a pixel subtends."""

    def __init__(self, slope: float, pixel_rad: float) -> None:
        self._slope = dr.opaque(mi.Float, slope / np.sqrt(len(_TILES_M)))
        self._pixel = dr.opaque(mi.Float, pixel_rad)
        self._pyramid, self._starts = _pyramid()

    def turned(self, normal: Any, point: Any, view: Any, distance_m: Any, dust: Any, dither: Any) -> Any:
        """Unit normals turned by the slopes at points of L. `dither` in [0, 1) chooses between two neighbouring
        levels of the pyramid: over the samples of a pixel they mix."""
        footprint = distance_m * self._pixel * dr.rsqrt(dr.maximum(dr.abs(dr.dot(normal, view)), _GRAZING))
        texels = dr.maximum(footprint * (_SIDE / _TILES_M[0]), 1.0)
        level = mi.Int32(dr.floor(dr.log2(texels) + dither))
        shown = level < _LEVELS
        level = dr.clip(level, 0, _LEVELS - 1)  # a ray that hits nothing may give any number
        side = mi.Int32(_SIDE) >> level
        start = dr.gather(mi.Int32, self._starts, level)
        # the plane that the normal is nearest to: xy, yz or xz
        a = dr.abs(normal)
        level_ground, faces_x = (a.z >= a.x) & (a.z >= a.y), a.x > a.y
        u = dr.select(level_ground | ~faces_x, point.x, point.y)
        v = dr.select(level_ground, point.y, point.z)
        su, sv = mi.Float(0), mi.Float(0)
        for k, tile in enumerate(_TILES_M):
            c, s = float(np.cos(k * _TURN)), float(np.sin(k * _TURN))
            tu, tv = (c / tile) * u + (s / tile) * v, (c / tile) * v - (s / tile) * u
            x = mi.Int32((tu - dr.floor(tu)) * mi.Float(side)) & (side - 1)
            y = mi.Int32((tv - dr.floor(tv)) * mi.Float(side)) & (side - 1)
            pair = dr.gather(mi.Vector2f, self._pyramid, mi.UInt32(start + y * side + x), shown)
            su += c * pair.x - s * pair.y
            sv += s * pair.x + c * pair.y
        strength = self._slope * dr.lerp(1.0, _ON_DUST, dust)
        su, sv = su * strength, sv * strength
        off = mi.Vector3f(
            dr.select(level_ground | ~faces_x, su, 0),
            dr.select(level_ground, sv, dr.select(faces_x, su, 0)),
            dr.select(level_ground, 0, sv),
        )
        return dr.normalize(normal - off)


@lru_cache(maxsize=1)
def _pyramid() -> tuple[Any, Any]:
    """Slopes of all levels as pairs, and where each level starts."""
    k = np.fft.fftfreq(_SIDE) * _SIDE
    kx, ky = np.meshgrid(k, k)
    radius = np.hypot(kx, ky)
    longest = _TILES_M[0] / _LONGEST_M  # cycles a tile
    power = np.where(radius >= longest, np.maximum(radius, 1.0) ** (-2 * (1 + _HURST)), 0.0)
    rng = np.random.Generator(np.random.Philox(np.random.SeedSequence(0xDE7A11)))
    height = np.sqrt(power) * np.fft.fft2(rng.normal(size=(_SIDE, _SIDE)))
    slopes = np.stack([np.fft.ifft2(2j * np.pi * f * height).real for f in (kx, ky)], axis=-1)
    octaves = np.log2(_SIDE / 2 / longest)
    slopes *= np.sqrt(octaves) / np.sqrt(np.mean(slopes**2))
    levels: list[np.ndarray] = []
    starts: list[int] = []
    for _ in range(_LEVELS):
        starts.append(sum(level.shape[0] ** 2 for level in levels))
        levels.append(slopes)
        slopes = slopes.reshape(len(slopes) // 2, 2, -1, 2, 2).mean(axis=(1, 3))
    table = mi.Float(np.concatenate([level.reshape(-1) for level in levels]).astype(np.float32))
    first = mi.Int32(np.array(starts, dtype=np.int32))
    dr.eval(table, first)
    return table, first
