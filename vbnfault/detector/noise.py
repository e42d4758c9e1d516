"""Draw noise with a fixed number of variates per pixel, which does not depend on the signal.

Two exposures of twins therefore differ only where their signals differ.
"""

from __future__ import annotations

import math
import sys
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr, ndtri

from ..core import buffers
from .poisson import poisson_cumulative, poisson_least_count

F32 = NDArray[np.float32]

# Below this mean the Poisson quantile is summed exactly. Above it an asymptotic expansion is used (Giles 2016, ACM
# TOMS 42, 6, doi 10.1145/2699466, Q_N2). It is wrong by one count in at most 0.2 % of the draws up to 1e4
# electrons, and in 0.4 % at 1e5, where float32 rounds. The mean is wrong by at most 0.001 and 0.005 electrons
# (tests/test_detector.py).
EXACT_POISSON_BELOW_E = 4.0

# Above this mean the first three terms of that expansion are enough.
ALL_TERMS_BELOW_E = 1000.0

# Above this mean, counting steps takes longer than the general quantile.
_MANY_STEPS_E = 30.0

# A sum of a distribution that no longer changes in float64.
SUM_COMPLETE = 1 - 1e-15

# Numbers that are looked up together: numpy makes indices of 8 bytes of them, which stay in the cache.
_CODES_AT_ONCE = 1 << 17

# Means whose distributions are summed together, so that their five arrays of 8 bytes stay in the cache.
_SUMMED_AT_ONCE = 1 << 15


@dataclass(frozen=True, kw_only=True, eq=False)
class NormalField:
    """Hold standard normal variates as 16 bit uniform numbers, from which `values` looks them up.

    Each number stands for the median of its bin. The two outermost bins, 4.2 standard deviations from the mean, are
    drawn again within the bin, so the tails are complete. A variate is a monotonic function of its number.

    Attributes
    ----------
    codes
        The uniform numbers, uint16[y, x, ...].
    tail
        Flat indices of the two outermost numbers, intp[n], ascending.
    tail_values
        Their variates, float32[n].
    """

    codes: NDArray[np.uint16]
    tail: NDArray[np.intp]
    tail_values: F32

    def of_pixels(self, pixels: NDArray[np.intp]) -> NormalField:
        """Return the variates of some pixels, given by their flat indices intp[row, n] and arranged like them."""
        channels = self.codes.shape[2]
        codes = self.codes.reshape(-1, channels)[pixels]
        tail = _outermost(codes.reshape(-1))
        place, channel = np.divmod(tail, channels)
        known = np.searchsorted(self.tail, pixels.reshape(-1)[place] * channels + channel)
        return NormalField(codes=codes, tail=tail, tail_values=self.tail_values[known])

    def values(self) -> F32:
        """Return the variates, float32[y, x, ...]."""
        codes, table = self.codes.reshape(-1), variates_by_code()
        out = buffers.empty(codes.shape)
        for start in range(0, codes.size, _CODES_AT_ONCE):
            part = slice(start, start + _CODES_AT_ONCE)
            np.take(table, codes[part], mode="clip", out=out[part])
        out[self.tail] = self.tail_values
        return out.reshape(self.codes.shape)


def draw_normals(
    shape: tuple[int, ...], rng: np.random.Generator, codes: NDArray[np.uint16] | None = None
) -> NormalField:
    """Draw standard normal variates by the inverse distribution function of 16 bit uniform numbers.

    `codes` receives these numbers, uint16 of the given shape, which may be a view with equal gaps between all of
    them. Raises ValueError if the gaps differ.
    """
    if codes is None:
        codes = buffers.empty(shape, np.uint16)
    flat = codes.reshape(math.prod(shape))
    if flat.size and not np.shares_memory(flat, codes):
        raise ValueError(f"codes has the strides {codes.strides}: its numbers must be equally spaced")
    tail, outermost = _draw_codes(flat, rng)
    sign = np.where(outermost == 0, 1.0, -1.0)
    values = sign * ndtri((1.0 - rng.random(len(tail))) / 65536)
    return NormalField(codes=codes, tail=tail, tail_values=values.astype(np.float32))


def normal_field(shape: tuple[int, ...], rng: np.random.Generator) -> F32:
    """Draw standard normal variates as `draw_normals` does and return their values, float32 of the given shape."""
    return draw_normals(shape, rng).values()


def _outermost(codes: NDArray[np.uint16]) -> NDArray[np.intp]:
    """Return the indices at which a code is the smallest or the largest possible, intp[n], ascending."""
    return np.flatnonzero(codes + np.uint16(1) <= 1)


def _draw_codes(codes: NDArray[np.uint16], rng: np.random.Generator) -> tuple[NDArray[np.intp], NDArray[np.uint16]]:
    """Draw 16 bit uniform numbers: those of `rng.bytes`, in a quarter of its time if possible.

    Returns the indices of the outermost numbers, intp[n], and these numbers.
    """
    # `bytes` takes words of 32 bits, of which a generator of 64 bits yields the low one first and keeps the other
    size, found = codes.size, [np.zeros(0, dtype=np.intp)]
    whole = size % 4 == 0 and rng.bit_generator.state.get("has_uint32") == 0 and sys.byteorder == "little"
    drawn = None if whole else np.frombuffer(rng.bytes(2 * size), dtype=np.uint16)
    for start in range(0, size, _CODES_AT_ONCE):  # their memory stays in the cache
        stop = min(start + _CODES_AT_ONCE, size)
        if drawn is None:
            words = rng.integers(0, 2**64 - 1, (stop - start) // 4, dtype=np.uint64, endpoint=True)
            part = words.view(np.uint16)
        else:
            part = drawn[start:stop]
        codes[start:stop] = part
        found.append(_outermost(part) + start)
    tail = np.concatenate(found)
    return tail, codes[tail]


@lru_cache(maxsize=1)
def variates_by_code() -> F32:
    """Return the normal variates by their codes, float32[65536]; those of the two outermost codes are medians."""
    return ndtri((np.arange(65536) + 0.5) / 65536).astype(np.float32)


def later_poisson_terms(xp: Any, mean: Any, z: Any) -> Any:
    """Return the terms of the Poisson quantile's expansion (Giles 2016, Q_N2) that matter for small means, float32.

    `xp` is the array namespace, numpy or drjit, of the means and the normal variates `z`.
    """
    safe, zz = xp.maximum(mean, 1), z * z
    return (zz * (zz * (1 / 270) + 7 / 810) - 8 / 405) / safe - z * (zz * (1 / 72) + 1 / 36) / xp.sqrt(safe)


def poisson_quantile(mean: F32, normal: F32) -> F32:
    """Return the Poisson count at the quantile Φ(normal), float32: one variate per value for any mean.

    The result is exact (the distribution is summed) where the mean is below `EXACT_POISSON_BELOW_E`. Elsewhere it
    uses the expansion named there.
    """
    normal = z = np.ascontiguousarray(normal)  # out takes its layout: ravel must be a view
    root = np.sqrt(mean)
    out = z * z
    out *= np.float32(1 / 6)
    out += np.float32(1 / 3)
    root *= z
    out += root
    out += mean
    # the later terms move a count by less than 0.01 where the mean is above this
    few = np.flatnonzero(mean < ALL_TERMS_BELOW_E)
    if len(few):
        m, z = mean.ravel(), normal.ravel()
        if len(few) < m.size:
            m, z = m[few], z[few]
        terms = later_poisson_terms(np, m, z)
        if len(few) < out.size:
            out.ravel()[few] += terms
        else:
            out.ravel()[:] += terms
    np.floor(out, out=out)
    np.clip(out, 0, np.inf, out=out)  # half the time of `maximum`
    if len(few):
        low = np.flatnonzero(m < EXACT_POISSON_BELOW_E)
        out.ravel()[few[low]] = _poisson_exact(m[low], z[low])
    return out


def poisson_on_dark(signal: F32, dark: np.float32, normal: F32) -> F32:
    """Return `poisson_quantile(signal + dark, normal)`, where unlit values count the steps of their only mean."""
    lit = signal > 0
    out = counts_of_one_mean(float(dark), normal)
    out[lit] = poisson_quantile(signal[lit] + dark, normal[lit])
    return out


def _poisson_exact(mean: F32, normal: F32) -> F32:
    """Return the Poisson count, float32[n], at the quantile Φ(normal) by summing the distribution."""
    out = np.zeros(len(mean), dtype=np.float32)
    for start in range(0, len(mean), _SUMMED_AT_ONCE):
        part = slice(start, start + _SUMMED_AT_ONCE)
        counts, m, u = out[part], mean[part].astype(np.float64), ndtr(normal[part].astype(np.float64))
        term = np.exp(-m)
        total = term.copy()
        left = np.flatnonzero(u > total)
        u, m, term, total = u[left], m[left], term[left], total[left]
        count = 0
        while len(left):
            count += 1
            term *= m
            term /= count
            total += term
            counts[left] = count  # those that go on are written again
            more = np.flatnonzero((u > total) & (total < SUM_COMPLETE))
            left, m, u, term, total = left[more], m[more], u[more], term[more], total[more]
    return out


def counts_of_one_mean(mean: float, normal: F32) -> F32:
    """Return `poisson_quantile` for a single mean by counting the distribution's steps below each variate."""
    if mean > _MANY_STEPS_E:
        return poisson_quantile(np.full(normal.shape, mean, dtype=np.float32), normal)
    count = np.zeros(normal.shape, dtype=np.uint8)
    for step in _normal_steps(mean):
        count += normal > step
    return count.astype(np.float32)


@lru_cache(maxsize=256)
def _normal_steps(mean: float) -> tuple[np.float32, ...]:
    """Return the normal variates at which the Poisson count of this mean increases by one."""
    # ±6 includes every float32 normal variate that a generator gives in practice (1 in 5e8 lies outside)
    last = int(poisson_least_count(float(ndtr(6.0)), mean)) if mean > 0 else 0
    return tuple(np.float32(z) for z in ndtri(poisson_cumulative(np.arange(last), mean)))
