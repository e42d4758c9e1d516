"""Draw noise with a fixed number of variates per pixel, which does not depend on the signal.

Two exposures of twins therefore differ only where their signals differ.
"""

from __future__ import annotations

import math
import sys
from dataclasses import dataclass
from functools import lru_cache

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
_ALL_TERMS_BELOW_E = 1000.0

# Above this mean, counting steps takes longer than the general quantile.
_MANY_STEPS_E = 30.0

# Numbers that are looked up together: numpy makes indices of 8 bytes of them, which stay in the cache.
_CODES_AT_ONCE = 1 << 17

# Means whose distributions are summed together, so that their five arrays of 8 bytes stay in the cache.
_SUMMED_AT_ONCE = 1 << 15


@dataclass(frozen=True, kw_only=True, eq=False)
class NormalField:
    """Hold standard normal variates as 16 bit uniform numbers, from which `values` and `at` look them up.

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

    @property
    def _row_size(self) -> int:
        return math.prod(self.codes.shape[1:])

    def __getitem__(self, rows: slice) -> NormalField:
        """Return the variates of contiguous rows. Raises ValueError if the slice has a step other than 1."""
        if rows.step not in (None, 1):
            raise ValueError(f"step = {rows.step}: must be 1, rows of variates are contiguous")
        start, stop, _ = rows.indices(len(self.codes))
        first, last = np.searchsorted(self.tail, (start * self._row_size, stop * self._row_size))
        tail = self.tail[first:last] - start * self._row_size
        return NormalField(codes=self.codes[start:stop], tail=tail, tail_values=self.tail_values[first:last])

    def of_pixels(self, pixels: NDArray[np.intp]) -> NormalField:
        """Return the variates of some pixels, given by their flat indices intp[row, n] and arranged like them."""
        channels = self.codes.shape[2]
        codes = np.take(self.codes.reshape(-1, channels), pixels, axis=0)
        tail = _outermost(codes)
        place, channel = np.divmod(tail, channels)
        known = np.searchsorted(self.tail, pixels.reshape(-1)[place] * channels + channel)
        return NormalField(codes=codes, tail=tail, tail_values=self.tail_values[known])

    def at(self, places: NDArray[np.intp]) -> F32:
        """Return the variates at ascending flat indices, float32[n]."""
        codes = np.take(self.codes.reshape(-1), places, mode="clip")  # a third of the time of indexing
        out = np.take(_normal_table(), codes, mode="clip")
        # places and tail ascend, so those of the tail that are among the places lie where they would be inserted
        place = np.searchsorted(places, self.tail)
        inside = place < len(places)
        known = np.flatnonzero(inside)[places[place[inside]] == self.tail[inside]]
        out[place[known]] = self.tail_values[known]
        return out

    def values(self) -> F32:
        """Return the variates, float32[y, x, ...]."""
        codes, table = self.codes.reshape(-1), _normal_table()
        out = buffers.empty(codes.shape)
        for start in range(0, codes.size, _CODES_AT_ONCE):
            part = slice(start, start + _CODES_AT_ONCE)
            np.take(table, codes[part], mode="clip", out=out[part])
        out[self.tail] = self.tail_values
        return out.reshape(self.codes.shape)


def draw_normals(shape: tuple[int, ...], rng: np.random.Generator) -> NormalField:
    """Draw standard normal variates by the inverse distribution function of 16 bit uniform numbers."""
    codes = _codes(math.prod(shape), rng)
    tail = _outermost(codes)
    sign = np.where(codes[tail] == 0, 1.0, -1.0)
    values = sign * ndtri((1.0 - rng.random(len(tail))) / 65536)
    return NormalField(codes=codes.reshape(shape), tail=tail, tail_values=values.astype(np.float32))


def normal_field(shape: tuple[int, ...], rng: np.random.Generator) -> F32:
    """Draw standard normal variates as `draw_normals` does and return their values, float32 of the given shape."""
    return draw_normals(shape, rng).values()


def variates_of(codes: NDArray[np.uint16]) -> F32:
    """Return the normal variates of 16 bit uniform numbers, which exclude the least and the greatest, float32."""
    return _normal_table()[codes]


def _outermost(codes: NDArray[np.uint16]) -> NDArray[np.intp]:
    """Return the flat indices at which a code is the smallest or the largest possible, intp[n], ascending."""
    flat = codes.reshape(-1)
    parts = range(0, flat.size, _CODES_AT_ONCE)
    found = [np.flatnonzero(flat[i : i + _CODES_AT_ONCE] + np.uint16(1) <= 1) + i for i in parts]
    return np.concatenate(found) if found else np.zeros(0, dtype=np.intp)


def _codes(size: int, rng: np.random.Generator) -> NDArray[np.uint16]:
    """Return 16 bit uniform numbers, uint16[size]: those of `rng.bytes`, in a quarter of its time if possible."""
    # `bytes` takes words of 32 bits, of which a generator of 64 bits yields the low one first and keeps the other
    whole = size % 4 == 0 and rng.bit_generator.state.get("has_uint32") == 0 and sys.byteorder == "little"
    if not whole:
        return np.frombuffer(rng.bytes(2 * size), dtype=np.uint16)
    out = buffers.empty((size,), np.uint16)
    for start in range(0, size, _CODES_AT_ONCE):  # their memory is in the cache, and that of `out` is kept
        part = out[start : start + _CODES_AT_ONCE]
        words = rng.integers(0, 2**64 - 1, part.size // 4, dtype=np.uint64, endpoint=True)
        part[:] = words.view(np.uint16)
    return out


@lru_cache(maxsize=1)
def _normal_table() -> F32:
    return ndtri((np.arange(65536) + 0.5) / 65536).astype(np.float32)


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
    few = np.flatnonzero(mean < _ALL_TERMS_BELOW_E)
    if len(few):
        m, z = mean.ravel(), normal.ravel()
        if len(few) < m.size:
            m, z = m[few], z[few]
        safe = np.maximum(m, np.float32(1))
        zz = z * z
        terms = (np.float32(-8 / 405) + zz * (np.float32(7 / 810) + np.float32(1 / 270) * zz)) / safe
        terms -= z * (np.float32(1 / 36) + np.float32(1 / 72) * zz) / np.sqrt(safe)
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
    """Return `poisson_quantile(signal + dark, normal)`, quickly where there is no signal: the sky has one mean."""
    lit = signal > 0
    count = np.count_nonzero(lit)
    if count == signal.size:
        return poisson_quantile(signal + dark, normal)
    out = _counts_of_one_mean(float(dark), normal)
    if 3 * count > 2 * signal.size:  # to choose the lit values takes longer than to compute all
        dim, mean = ~lit, signal + dark
        np.copyto(mean, np.float32(_ALL_TERMS_BELOW_E), where=dim)  # the quickest mean
        counts = poisson_quantile(mean, normal)
        np.copyto(counts, out, where=dim)
        return counts
    if count:
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
            # past 1 - 1e-15 the sum no longer changes in float64: stop there
            more = np.flatnonzero((u > total) & (total < 1 - 1e-15))
            left, m, u, term, total = left[more], m[more], u[more], term[more], total[more]
    return out


def _counts_of_one_mean(mean: float, normal: F32) -> F32:
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
