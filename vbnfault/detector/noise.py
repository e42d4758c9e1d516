"""Draw noise with a fixed number of variates per pixel, which does not depend on the signal.

Two exposures of twins therefore differ only where their signals differ.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import ndtr, ndtri, pdtr, pdtrik

from ..core.process.llvm import backend, evaluated, flat

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]

# Below this mean the Poisson quantile is summed exactly. Above it an expansion of the form of Giles' is used (2016,
# ACM TOMS 42, 6, doi 10.1145/2699466). It is wrong by one count in at most 0.2 % of the draws up to 1e4 electrons,
# and in 0.4 % at 1e5, where float32 rounds. The mean is wrong by at most 0.0005 and 0.005 electrons. Up to 1e4
# electrons each probability above 1e-6 is right to 1 % (tests/test_detector.py). The variates have 16 bits, so the
# probability of each drawn count is a multiple of 1.5e-5.
EXACT_POISSON_BELOW_E = 4.0

# Above this mean the first three terms of that expansion are enough.
ALL_TERMS_BELOW_E = 1000.0

# Coefficients of the other terms, and the least s = z / √mean for which they were fitted.
_TIMES_SQUARE = (-0.0146928, 0.00357783, -0.00057657, 0.000856, -0.00079417, 0.00019517)
_TIMES_ONE = (-0.02451018, 0.0089229, 0.00191077, -0.00224458)
_OVER_MEAN = -0.02302727
_LEAST_S = -1.31

# Above this mean, counting steps takes longer than the general quantile.
_MANY_STEPS_E = 30.0

# A sum of a distribution that no longer changes in float64.
SUM_COMPLETE = 1 - 1e-15


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
        out = np.take(variates_by_code(), self.codes)
        out.reshape(-1)[self.tail] = self.tail_values
        return out

    @cached_property
    def looked_up(self) -> F32:
        """Return the variates as `values` does, but compute them once; the array is read-only."""
        out = self.values()
        out.flags.writeable = False
        return out


def draw_normals(shape: tuple[int, ...], rng: np.random.Generator) -> NormalField:
    """Draw standard normal variates by the inverse distribution function of 16 bit uniform numbers.

    `rng` gives the key of these numbers (`uniform_codes`), and the variates of the two outermost bins.
    """
    codes, tail = uniform_codes(math.prod(shape), rng.integers(0, 2**64, 2, dtype=np.uint64))
    sign = np.where(codes[tail] == 0, 1.0, -1.0)
    values = sign * ndtri((1.0 - rng.random(len(tail))) / 65536)
    return NormalField(codes=codes.reshape(shape), tail=tail, tail_values=values.astype(np.float32))


def normal_field(shape: tuple[int, ...], rng: np.random.Generator) -> F32:
    """Draw standard normal variates as `draw_normals` does and return their values, float32 of the given shape."""
    return draw_normals(shape, rng).values()


def _outermost(codes: NDArray[np.uint16]) -> NDArray[np.intp]:
    """Return the indices at which a code is the smallest or the largest possible, intp[n], ascending."""
    return np.flatnonzero(codes + np.uint16(1) <= 1)


def uniform_codes(size: int, key: NDArray[np.uint64]) -> tuple[NDArray[np.uint16], NDArray[np.intp]]:
    """Return uniform numbers of 16 bits, uint16[size], and the indices of those that are 0 or 65535, intp[n].

    Word i of 64 bits, which holds four numbers, is the finalizer of SplitMix64 (Steele, Lea and Flood 2014, OOPSLA,
    doi 10.1145/2660193.2660195) of i times the golden ratio plus `key[0]`; `key[1]` is mixed in halfway, so that
    the numbers of two keys are not the same sequence from different starts. Each word depends on its place alone,
    so all are computed at once.
    """
    if not size:
        return np.zeros(0, np.uint16), np.zeros(0, np.intp)
    be = backend()
    dr, U64 = be.dr, be.UInt64
    first, second = (dr.opaque(U64, int(k)) for k in key)
    word = dr.arange(U64, -(-size // 4)) * 0x9E3779B97F4A7C15 + first
    word = (word ^ (word >> 30)) * 0xBF58476D1CE4E5B9 ^ second
    word = (word ^ (word >> 27)) * 0x94D049BB133111EB
    word = word ^ (word >> 31)
    # the highest bit of each 16 bits says whether they are all 0 or all 1; a carry from below may set it, too
    ones, tops, inverse = 0x0001000100010001, 0x8000800080008000, ~word
    marked = (((word - ones) & inverse) | ((inverse - ones) & word)) & tops
    maybe = be.UInt8(dr.select(marked != 0, U64(1), U64(0)))
    dr.eval(word, maybe)
    dr.sync_thread()
    codes: NDArray[np.uint16] = np.array(word, copy=False).view(np.uint16)[:size]
    words = np.flatnonzero(np.array(maybe, copy=False).view(np.bool_))
    places = (4 * words[:, None] + np.arange(4)).reshape(-1)
    places = places[places < size]
    return codes, places[_outermost(codes[places])]


@lru_cache(maxsize=1)
def variates_by_code() -> F32:
    """Return the normal variates by their codes, float32[65536]; those of the two outermost codes are medians."""
    return ndtri((np.arange(65536) + 0.5) / 65536).astype(np.float32)


def _later_terms(xp: Any, mean: Any, z: Any) -> Any:
    """Return the terms of the Poisson quantile's expansion that matter for small means, float32.

    They have the form of Giles' expansion (2016, Q_N2) in s = z / √mean, but its series does not converge in the
    lower tail: at 8 e it gives 16 % too many zeros. The coefficients here are those of the smallest error over all
    counts with a probability above 1e-6 and means from 4 to 1000 e. `xp` is the array namespace, numpy or drjit, of
    the means and the normal variates `z`.
    """
    per_root = 1 / xp.sqrt(xp.maximum(mean, 1))
    s = xp.maximum(z * per_root, _LEAST_S)
    of_square, of_one = (_horner(s, terms) for terms in (_TIMES_SQUARE, _TIMES_ONE))
    return s * (z * z * of_square + of_one) + per_root * per_root * _OVER_MEAN


def _horner(s: Any, terms: tuple[float, ...]) -> Any:
    """Return a polynomial of s, the constant term first."""
    value = s * terms[-1] + terms[-2]
    for term in terms[-3::-1]:
        value = value * s + term
    return value


def poisson_quantile(mean: F32, normal: F32) -> F32:
    """Return the Poisson count at the quantile Φ(normal), float32: one variate per value for any mean.

    The result is exact where the mean is below `EXACT_POISSON_BELOW_E`; elsewhere it is the expansion named there.
    """
    z = normal
    out: Any = z * z * np.float32(1 / 6) + np.float32(1 / 3) + np.sqrt(mean) * z + mean
    # the later terms move a count by less than 0.01 where the mean is above this
    out += np.where(mean < ALL_TERMS_BELOW_E, _later_terms(np, mean, z), np.float32(0))
    out = np.maximum(np.floor(out), 0)
    few = mean < EXACT_POISSON_BELOW_E
    u = np.minimum(ndtr(z[few].astype(np.float64)), SUM_COMPLETE)
    exact = np.zeros(len(u))
    some = u > np.exp(-mean[few].astype(np.float64))  # above the probability of no count
    exact[some] = poisson_least_count(u[some], mean[few][some].astype(np.float64))
    out[few] = exact
    return out


def poisson_on_dark(signal: F32, dark: np.float32, normal: F32) -> F32:
    """Return `poisson_quantile(signal + dark, normal)`, where unlit values count the steps of their only mean."""
    lit = signal > 0
    out = counts_of_one_mean(float(dark), normal)
    out[lit] = poisson_quantile(signal[lit] + dark, normal[lit])
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


# --- the distribution: scipy.stats has the same functions with the same bits, but takes a second to import ------


def poisson_cumulative(count: ArrayLike, mean: float) -> F64:
    """Return the probability of at most `count`, float64 in its shape."""
    return np.asarray(pdtr(np.floor(np.asarray(count, dtype=np.float64)), mean))


def poisson_least_count(probability: ArrayLike, mean: ArrayLike) -> NDArray[np.int64]:
    """Return the least counts whose cumulative probabilities reach `probability`, in (0, 1); `mean` > 0."""
    count = np.ceil(pdtrik(probability, mean))
    fewer = np.maximum(count - 1, 0)
    return np.asarray(np.where(pdtr(fewer, mean) >= probability, fewer, count)).astype(np.int64)


def poisson_above_0(mean: float, uniform: ArrayLike) -> NDArray[np.int64]:
    """Return Poisson variates, given that they are not 0, for uniform numbers in [0, 1), int64 of their shape.

    A variate is the inverse of the upper tail at a probability below that of 1 or more.
    """
    chance = -np.expm1(-mean) * (1 - np.asarray(uniform))
    if mean < 1e-12:
        return np.ones(chance.shape, dtype=np.int64)
    return np.maximum(poisson_least_count(1 - chance, mean), 1)


# --- compiled: the bits of `poisson_quantile`, with intermediate results in registers -----------------------------


def poisson(mean: F32, normal: NormalField) -> F32:
    """Return `poisson_quantile` of means and normal variates, float32[y, x].

    The variates are looked up by numpy, once for all exposures with this noise: on some processors, to fetch them
    in the kernel takes longer than all of its arithmetic.
    """
    be = backend()
    z, place = be.Float(flat(normal.looked_up)), be.dr.arange(be.UInt32, mean.size)
    out: F32 = evaluated(_quantile(be.Float(flat(mean)), z, place, codes_on_device(normal)))
    out[normal.tail] = poisson_quantile(mean.reshape(-1)[normal.tail], normal.tail_values)
    return out.reshape(mean.shape)


def codes_on_device(normal: NormalField) -> Callable[..., Any]:
    """Return a function of flat indices, UInt32, and of active lanes that gives the codes of variates, UInt32."""
    be, codes = backend(), flat(normal.codes)
    if codes.size % 2:  # two codes share a word
        codes = flat(np.append(codes, np.uint16(0)))
    words = be.UInt32(codes.view(np.uint32))

    def code_at(place: Any, active: Any = True) -> Any:
        return be.dr.gather(be.UInt32, words, place >> 1, active) >> 16 * (place & 1) & 0xFFFF

    return code_at


def poisson_of_codes(mean: Any, code: Any, active: Any = True) -> Any:
    """Return `poisson_quantile` of means and of the normal variates with these codes, as Float.

    Lanes that are not active have any value.
    """
    be = backend()
    return _quantile(
        mean, be.dr.gather(be.Float, device_tables()[0], code, active), code, lambda code, _: code, active
    )


def _quantile(mean: Any, z: Any, place: Any, code_at: Callable[[Any, Any], Any], active: Any = True) -> Any:
    """Return `poisson_quantile` of means and of normal variates `z`, as Float.

    Lanes that are not active have any value. Where the mean is small, the distribution is summed up to the code of
    the variate, which `code_at(place, lanes)` returns for these lanes.
    """
    be = backend()
    dr = be.dr
    count = (z * z * be.Float(1 / 6) + be.Float(1 / 3) + dr.sqrt(mean) * z) + mean
    count = dr.if_stmt(
        (count, mean, z),
        mean < ALL_TERMS_BELOW_E,
        lambda count, mean, z: count + _later_terms(dr, mean, z),
        lambda count, mean, z: count,
    )
    few = active & (mean < EXACT_POISSON_BELOW_E)
    count = dr.maximum(dr.floor(count), 0)
    return dr.if_stmt(
        (count, mean, place, few),
        few,
        lambda _, mean, place, few: _summed(mean, code_at(place, few), few),
        lambda count, *_: count,
    )


def _summed(mean: Any, code: Any, few: Any) -> Any:
    """Return the Poisson counts of means of few electrons, as Float, by summing the distribution in float64."""
    be = backend()
    dr = be.dr
    u, m = dr.gather(be.Float64, device_tables()[1], code, few), be.Float64(mean)

    def goes_on(term: Any, total: Any, count: Any) -> Any:
        return (u > total) & (total < SUM_COMPLETE)

    def add(term: Any, total: Any, count: Any) -> Any:
        count = count + 1
        term = term * m / count
        return term, total + term, count

    term = dr.exp(-m)
    _, _, count = dr.while_loop((term, be.Float64(term), be.Float64(0)), goes_on, add, mode="symbolic")
    return be.Float(count)


@lru_cache(maxsize=1)
def device_tables() -> tuple[Any, Any]:
    """Return the normal variates by code, and the values of their distribution function, on the device."""
    be, normal = backend(), variates_by_code()
    return be.Float(flat(normal)), be.Float64(flat(ndtr(normal.astype(np.float64))))
