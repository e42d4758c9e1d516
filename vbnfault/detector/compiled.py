"""Develop three-colour images, and draw the shot noise of mosaics, with compiled kernels.

Each kernel keeps its intermediate results in registers.

Every value takes the steps of `three_colour.ThreeColourDetector` in the same order and precision, so that it has
the bits that these steps give one after the other (tests/test_detector_compiled.py). Only the exponential function
of the Poisson sums may differ in its last bit. A count would differ for it only where a sum lies within 1e-16 of
one of the 65,536 quantiles of the variates.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from ..core.llvm import backend, flat
from ..core.quantities import LUMINANCE
from .noise import (
    ALL_TERMS_BELOW_E,
    EXACT_POISSON_BELOW_E,
    SUM_COMPLETE,
    NormalField,
    later_poisson_terms,
    poisson_quantile,
    variates_by_code,
)

F32 = NDArray[np.float32]
U8 = NDArray[np.uint8]

# The weights of R, G and B are rounded to whole 65536ths, and their sum is 1. Their products with levels, and the
# sums of these, are exact in single precision, so every order of the sum, fused or not, gives the same bits.
LUMINANCE_WEIGHTS = np.rint(LUMINANCE.astype(np.float64) * 65536) / 65536


def luminance(rgb: U8) -> U8:
    """Return the luminance, uint8[y, x], of R, G and B, uint8[y, x, 3]; halves become the even level."""
    return np.asarray(cv2.transform(rgb, LUMINANCE_WEIGHTS.reshape(1, 3))).reshape(rgb.shape[:2])


def with_luminance(rgb: U8) -> U8:
    """Return R, G, B and the luminance as I, uint8[y, x, 4], of R, G and B, uint8[y, x, 3]."""
    return np.asarray(cv2.insertChannel(luminance(rgb), cv2.cvtColor(rgb, cv2.COLOR_RGB2RGBA), 3))


@dataclass(frozen=True, kw_only=True, eq=False)
class Curve:
    """Hold the numbers with which a sensor turns the signals of one exposure into levels.

    Attributes
    ----------
    dark_e, full_well_e
        Mean dark electrons, and the most electrons of a pixel.
    gain_dn_per_e, read_noise_dn, bias_dn, adc_max_dn
        Numbers of the converter.
    black_dn, scale
        Code that is shown as 0, and the levels per code of R, G and B, float32[3].
    dark_counts_e
        Electrons of an unlit value by the code of its shot noise, float32[65536].
    """

    dark_e: np.float32
    full_well_e: np.float32
    gain_dn_per_e: np.float32
    read_noise_dn: np.float32
    bias_dn: np.float32
    adc_max_dn: np.float32
    black_dn: np.float32
    scale: F32
    dark_counts_e: F32


def image(curve: Curve, signal: F32, codes: NDArray[np.uint16] | None, base: tuple[F32, U8] | None = None) -> U8:
    """Return the 8 bit levels of R, G and B, and the luminance as I, uint8[y, x, 4].

    Parameters
    ----------
    curve
        The sensor and its exposure.
    signal
        Expected photo-electrons, float32[y, x, 3], of at least one pixel.
    codes
        Codes of the variates of shot noise and of read noise, uint16[y, x, 3, 2]; None for no noise. The two
        outermost codes stand for variates that no table holds; here they are the medians of their bins.
    base
        Another signal, float32[y, x, 3], and its image with the same variates, uint8[y, x, 4]. Where a value of the
        signal is the same, its level is taken from this image.
    """
    be = backend()
    dr, trace = be.dr, _Trace(curve, noisy=codes is not None)
    place = dr.arange(be.UInt32, signal.size)
    given = [
        be.Float(flat(signal)),
        place,
        be.UInt32(0) if codes is None else be.UInt32(flat(codes).view(np.uint32)),
    ]
    if base is None:
        found = trace.level(*given)
    else:
        of_base = be.UInt32(flat(base[1]).view(np.uint32))

        def known(_: Any, place: Any, __: Any) -> Any:
            pixel = place // 3
            return dr.gather(be.UInt32, of_base, pixel) >> 8 * (place - 3 * pixel) & 0xFF

        found = dr.if_stmt(tuple(given), given[0] != be.Float(flat(base[0])), trace.level, known)
    out = be.UInt8(found)
    dr.eval(out)
    dr.sync_thread()
    rgb: U8 = np.array(out, copy=False)
    return _with_luminance(rgb).reshape(*signal.shape[:2], 4)


def _with_luminance(rgb: U8) -> U8:
    """Return `display.with_luminance` of R, G and B in a row, uint8[3 * pixel], as uint8[4 * pixel]."""
    pixels = len(rgb) // 3
    if pixels % 4:
        return with_luminance(rgb.reshape(1, pixels, 3)).reshape(-1)
    be = backend()
    dr = be.dr
    group = dr.arange(be.UInt32, pixels // 4)
    words = be.UInt32(rgb.view(np.uint32))
    a, b, c = (dr.gather(be.UInt32, words, 3 * group + k) for k in range(3))  # three words hold four pixels
    four = a & 0xFFFFFF, a >> 24 | (b & 0xFFFF) << 8, b >> 16 | (c & 0xFF) << 16, c >> 8
    out = dr.empty(be.UInt32, pixels)
    dr.scatter(out, be.Array4u(*(pixel | _luminance_of(pixel) << 24 for pixel in four)), group)
    dr.eval(out)
    dr.sync_thread()
    array: U8 = np.array(out, copy=False).view(np.uint8)
    return array


def _luminance_of(pixel: Any) -> Any:
    """Return the luminance, as UInt32, of pixels that hold R, G and B in the three lowest bytes of a word."""
    be = backend()
    light = be.Float(0.0)
    for k, weight in enumerate(LUMINANCE_WEIGHTS):
        light = be.dr.fma(be.Float(be.Int32(pixel >> (8 * k) & 0xFF)), float(weight), light)
    return be.UInt32(be.Int32(be.dr.round(light)))


class _Trace:
    """Follow values through the steps.

    All numbers of the sensor are device arrays: as literals they would give each exposure a kernel of its own.
    """

    def __init__(self, curve: Curve, *, noisy: bool) -> None:
        be = backend()
        self._noisy = noisy
        self._dark, self._full_well, self._gain, self._read_noise, self._bias, self._top, self._black = (
            be.dr.opaque(be.Float, float(value))
            for value in (
                curve.dark_e,
                curve.full_well_e,
                curve.gain_dn_per_e,
                curve.read_noise_dn,
                curve.bias_dn,
                curve.adc_max_dn,
                curve.black_dn,
            )
        )
        self._scale = [be.dr.opaque(be.Float64, float(value)) for value in curve.scale]
        if noisy:
            self._normal = _tables()[0]
            self._dark_counts = be.Float(flat(curve.dark_counts_e))

    def level(self, signal: Any, place: Any, codes: Any) -> Any:
        """Return the 8 bit levels of signals; the low half of a word of codes is that of the shot noise."""
        be = backend()
        dr = be.dr
        if self._noisy:
            lit = signal > 0
            electrons = dr.if_stmt(
                (signal + self._dark, codes & 0xFFFF, lit),
                lit,
                _poisson,
                lambda mean, shot, lit: dr.gather(be.Float, self._dark_counts, shot, ~lit),
            )
        else:
            electrons = signal + self._dark
        dn = dr.clip(electrons, 0, self._full_well) * self._gain
        if self._noisy:
            dn = dn + dr.gather(be.Float, self._normal, codes >> 16) * self._read_noise
        dn = dr.clip(dr.round(dn + self._bias), 0, self._top)
        colour = place % 3
        scale = dr.select(colour == 0, self._scale[0], dr.select(colour == 1, self._scale[1], self._scale[2]))
        return be.UInt32(be.Int32(dr.clip(dr.round(be.Float64(dn - self._black) * scale), 0, 255)))


def poisson(mean: F32, normal: NormalField) -> F32:
    """Return `noise.poisson_quantile` of means and normal variates, float32[y, x].

    The variates are looked up by numpy, once for all exposures with this noise: on some processors, to fetch them
    in the kernel takes longer than all of its arithmetic.
    """
    be = backend()
    dr = be.dr
    codes = flat(normal.codes)
    if codes.size % 2:  # two codes share a word
        codes = flat(np.append(codes, np.uint16(0)))
    words = be.UInt32(codes.view(np.uint32))

    def code_at(place: Any, lanes: Any) -> Any:
        return dr.gather(be.UInt32, words, place >> 1, lanes) >> 16 * (place & 1) & 0xFFFF

    z = be.Float(flat(normal.looked_up))
    counts = _quantile(be.Float(flat(mean)), z, dr.arange(be.UInt32, mean.size), code_at)
    dr.eval(counts)
    dr.sync_thread()
    out: F32 = np.array(counts, copy=False)
    out[normal.tail] = poisson_quantile(mean.reshape(-1)[normal.tail], normal.tail_values)
    return out.reshape(mean.shape)


def _poisson(mean: Any, code: Any, active: Any = True) -> Any:
    """Return `noise.poisson_quantile` of means and of the normal variates with these codes, as Float.

    Lanes that are not active have any value.
    """
    be = backend()
    return _quantile(mean, be.dr.gather(be.Float, _tables()[0], code, active), code, lambda code, _: code, active)


def _quantile(mean: Any, z: Any, place: Any, code_at: Callable[[Any, Any], Any], active: Any = True) -> Any:
    """Return `noise.poisson_quantile` of means and of normal variates `z`, as Float.

    Lanes that are not active have any value. Where the mean is small, the distribution is summed up to the code of
    the variate, which `code_at(place, lanes)` returns for these lanes.
    """
    be = backend()
    dr = be.dr
    count = (z * z * be.Float(1 / 6) + be.Float(1 / 3) + dr.sqrt(mean) * z) + mean
    count = dr.if_stmt(
        (count, mean, z),
        mean < ALL_TERMS_BELOW_E,
        lambda count, mean, z: count + later_poisson_terms(dr, mean, z),
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
    u, m = dr.gather(be.Float64, _tables()[1], code, few), be.Float64(mean)

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
def _tables() -> tuple[Any, Any]:
    """Return the normal variates by code, and the values of their distribution function, on the device."""
    be, normal = backend(), variates_by_code()
    return be.Float(flat(normal)), be.Float64(flat(ndtr(normal.astype(np.float64))))
