"""Evaluate random fields on a mesh, each only where the facets can show it."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from .fields import GRADIENT_STD, PLANES_STD, Points
from .noise import Float32, noise_key
from .roughness import Roughness, deviogram
from .shape import Float64

# A field fades in as its wavelength grows from 1.6 to 2.8 facets.
_FADE = (1.6, 2.8)

_CRATER_WIDTHS_M = (72.0, 36.0, 18.0, 9.0)  # cells; diameters are a third to two thirds of their width
_CRATER_SHARE_PER_DENSITY = 1534e-6  # fraction of the cells, per crater of 10 m or more in a square kilometre
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
    """Evaluate fields at points sorted by their facet size; a field is 0 where the facets cannot show it."""

    def __init__(
        self, place_m: Float64, facet_m: Float64, seed: int, roughness: Roughness, longest_m: float
    ) -> None:
        self.place_m = place_m
        self.facet_m = facet_m
        self.seed = seed
        self._points = Points(place_m)
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

    def clods(self, width_m: float, stream: int, fraction: float) -> Float32:
        """Return the height of half-buried stones on cells of that width, metres."""
        shows = 0.7 * width_m
        part = self._points.clods(width_m, noise_key(self.seed, stream), self._count(shows), fraction)
        return self._full(part, shows)


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
