"""Compute hash-based noise in three dimensions with numpy.

The noise is a function of position and seed alone, so that every call returns the same values.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from .geometry import in_blocks

Float32 = NDArray[np.float32]
UInt32 = NDArray[np.uint32]

_PRIMES = tuple(np.uint32(p) for p in (0x8DA6B343, 0xD8163841, 0xCB1AB31F))
_MIX = (np.uint32(0x7FEB352D), np.uint32(0x846CA68B))


def _mix(h: UInt32) -> UInt32:
    """Return mixed hash words by the lowbias32 finaliser (C. Wellons, public domain); each bit affects all bits."""
    h = h ^ (h >> np.uint32(16))
    h = h * _MIX[0]
    h = h ^ (h >> np.uint32(15))
    h = h * _MIX[1]
    return h ^ (h >> np.uint32(16))


def _sphere_table() -> Float32:
    """Return 256 nearly even directions on a Fibonacci sphere, float32[256, 3]."""
    k = np.arange(256) + 0.5
    z = 1.0 - 2.0 * k / 256
    azimuth = np.pi * (1.0 + np.sqrt(5.0)) * k
    ring = np.sqrt(1.0 - z * z)
    return np.column_stack([ring * np.cos(azimuth), ring * np.sin(azimuth), z]).astype(np.float32)


_GRADIENTS = _sphere_table()


def _axis_hashes(cell: NDArray[np.int64]) -> list[tuple[UInt32, UInt32]]:
    """Return hash words of the lower and the upper cell on each axis."""
    low = cell.astype(np.uint32)  # negative cells wrap around, which does no harm
    return [(low[:, k] * _PRIMES[k], (low[:, k] + np.uint32(1)) * _PRIMES[k]) for k in range(3)]


def seed_word(seed: int) -> UInt32:
    """Return the low 64 bits of a seed, mixed into uint32[1]."""
    return _mix(_mix(np.array([seed & 0xFFFFFFFF], dtype=np.uint32)) ^ np.uint32((seed >> 32) & 0xFFFFFFFF))


def noise_key(seed: int, stream: int) -> int:
    """Return the noise seed of one use (`stream`, below 65536) of a run's seed.

    Two different pairs never share a noise seed if the run's seeds are below 2^48.
    """
    return (seed << 16) + stream


def _by_blocks(kernel: Callable[[NDArray, UInt32], Float32], points: NDArray, seed: int) -> Float32:
    """Return the values of a noise kernel at all points, float32[n, column]."""
    word = seed_word(seed)
    (out,) = in_blocks(lambda block: (kernel(block, word),), points)
    return out


def _gradient_kernel(points: NDArray, word: UInt32) -> Float32:
    """Return gradient noise at points in units of the wavelength, float32[n, 1]."""
    floor = np.floor(points)
    f = (points - floor).astype(np.float32)
    fade = f * f * f * (f * (f * np.float32(6) - np.float32(15)) + np.float32(10))
    axes = _axis_hashes(floor.astype(np.int64))
    value = np.zeros(len(points), dtype=np.float32)
    for i in (0, 1):
        wx = fade[:, 0] if i else 1 - fade[:, 0]
        dx = f[:, 0] - i
        for j in (0, 1):
            wxy = wx * (fade[:, 1] if j else 1 - fade[:, 1])
            dy = f[:, 1] - j
            hxy = axes[0][i] ^ axes[1][j] ^ word
            for k in (0, 1):
                g = _GRADIENTS[_mix(hxy ^ axes[2][k]) & np.uint32(255)]
                dot = g[:, 0] * dx + g[:, 1] * dy + g[:, 2] * (f[:, 2] - k)
                value += wxy * (fade[:, 2] if k else 1 - fade[:, 2]) * dot
    return value[:, None]


def gradient_noise(points: NDArray, seed: int) -> Float32:
    """Return gradient noise with one cycle per 1-2 units: float32[n], mean 0, standard deviation 0.22, within ±1.

    Parameters
    ----------
    points
        float64[n, 3] in units of the wavelength. Float32 would lose the fraction of a kilometre in units of a
        metre.
    seed
        Any integer; its low 64 bits count.
    """
    return _by_blocks(_gradient_kernel, points, seed)[:, 0]


def fractal_noise(points_m: NDArray, seed: int, wavelengths_m: NDArray, amplitudes_m: NDArray) -> Float32:
    """Return a sum of gradient-noise octaves, float32[n] in the unit of the amplitudes."""
    total = np.zeros(len(points_m), dtype=np.float32)
    for octave, (wavelength, amplitude) in enumerate(zip(wavelengths_m, amplitudes_m, strict=True)):
        total += np.float32(amplitude) * gradient_noise(points_m / wavelength, seed + 7919 * octave)
    return total
