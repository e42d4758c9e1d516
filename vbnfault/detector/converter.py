"""Convert the level at the output to codes: uneven widths, missing codes and stuck bits."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..core.errors import InputError
from ..core.llvm import backend, flat

if TYPE_CHECKING:
    from .readout import ReadoutSpec

F32 = NDArray[np.float32]
Raw = NDArray[np.uint16]


def convert(analogue: F32, spec: ReadoutSpec, transitions_dn: F32 | None = None) -> Raw:
    """Return the code, uint16[y, x], of a level float32[y, x] in DN; half codes round to even.

    With `transitions_dn` (see `ReadoutIndividual`) a code begins at its transition.
    """
    return raw_of(Converter(spec, transitions_dn).codes(on_device(plane(analogue))), analogue.shape)


def transitions_dn(dnl_lsb: NDArray[np.floating]) -> F32:
    """Return the transition levels, float32[2^bits - 1], of a converter whose codes are 1 + dnl_lsb[2^bits] wide.

    A width below 0 counts as 0: that code is missing. The widths are scaled, as in an end-point fit, so that the
    first transition stays at half a code and the last at half a code below the top. The outermost codes have one
    transition only, so their widths do not matter.
    """
    widths = np.maximum(1.0 + np.asarray(dnl_lsb, dtype=np.float64)[1:-1], 0.0)
    if widths.size and widths.sum() > 0:
        widths *= widths.size / widths.sum()
    return np.concatenate([[0.5], 0.5 + np.cumsum(widths)]).astype(np.float32)


class Converter:
    """Convert levels to codes in a kernel that drjit compiles, with tables that are made once."""

    def __init__(self, spec: ReadoutSpec, transitions: F32 | None) -> None:
        self._top = spec.top_dn
        self._table = spec.codes if spec.missing_codes or spec.stuck_bits else None
        self._transitions = transitions
        if transitions is not None:
            check_shape("transitions_dn", transitions, (self._top,))
            # levels with integer part k have at least low[k] transitions at or below them, and at most `more`
            # further ones
            low = np.searchsorted(transitions, np.arange(self._top + 2), side="right")
            self._low = low.astype(np.uint32)
            self._more = int(np.diff(low).max(initial=0))
            self._padded = np.append(transitions, np.float32(np.inf))

    def codes(self, level: Any) -> Any:
        """Return the codes, UInt32, of levels in DN, Float."""
        be = backend()
        dr, UInt32 = be.dr, be.UInt32
        level = dr.clip(level, 0, dr.opaque(be.Float, self._top))
        if self._transitions is None:
            code = UInt32(be.Int32(dr.round(level)))
        else:
            code = dr.gather(UInt32, UInt32(self._low), UInt32(be.Int32(level)))
            above = on_device(self._padded)
            for _ in range(self._more):
                code = code + dr.select(dr.gather(be.Float, above, code) <= level, UInt32(1), UInt32(0))
        return code if self._table is None else dr.gather(UInt32, UInt32(self._table.astype(np.uint32)), code)


def on_device(array: NDArray[Any]) -> Any:
    """Return real numbers of any shape as a device array, Float, in their order."""
    return backend().Float(flat(np.asarray(array, dtype=np.float32)))


def raw_of(codes: Any, shape: tuple[int, ...]) -> Raw:
    """Return codes of a device as raw numbers, uint16 of a shape."""
    dr = backend().dr
    dr.eval(codes)
    dr.sync_thread()
    return np.array(codes, copy=False).reshape(shape).astype(np.uint16)


def with_stuck_bits(raw: Raw, stuck_bits: Sequence[tuple[int, int]]) -> Raw:
    """Return raw numbers in which some bits, given as (bit, value), always have the same value."""
    high = sum(1 << bit for bit, value in dict(stuck_bits).items() if value)
    low = sum(1 << bit for bit, value in dict(stuck_bits).items() if not value)
    return (raw | np.uint16(high)) & np.uint16(0xFFFF ^ low)


def check_shape(name: str, array: F32 | None, shape: tuple[int, ...]) -> None:
    """Raise InputError, which names the array, unless it is None or has the shape."""
    if array is not None and array.shape != shape:
        raise InputError(f"{name} has shape {array.shape}, but must have {shape}")


def plane(array: F32) -> F32:
    """Return an image as float32[y, x]. Raises InputError for another number of axes."""
    if array.ndim != 2:
        raise InputError(f"the image has shape {array.shape}, but must be [y, x]")
    return np.asarray(array, dtype=np.float32)
