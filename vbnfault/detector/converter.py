"""Convert the level at the output to codes: uneven widths, missing codes and stuck bits."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..core.errors import InputError
from .blocks import blockwise

if TYPE_CHECKING:
    from .readout import ReadoutSpec

F32 = NDArray[np.float32]
Raw = NDArray[np.uint16]


def convert(analogue: F32, spec: ReadoutSpec, transitions_dn: F32 | None = None) -> Raw:
    """Return the code, uint16[y, x], of a level float32[y, x] in DN; half codes round to even.

    With `transitions_dn` (see `ReadoutIndividual`) a code begins at its transition.
    """
    return blockwise(Converter(spec, transitions_dn), plane(analogue))


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
    """Convert levels to codes with tables that are made once."""

    def __init__(self, spec: ReadoutSpec, transitions: F32 | None) -> None:
        self.top = spec.top_dn
        self.table = spec.codes if spec.missing_codes or spec.stuck_bits else None
        self.transitions = transitions
        if transitions is not None:
            check_shape("transitions_dn", transitions, (self.top,))
            # levels with integer part k have at least low[k] transitions at or below them, and at most `more`
            # further ones
            low = np.searchsorted(transitions, np.arange(self.top + 2), side="right")
            self.low = low.astype(np.int32)
            self.more = int(np.diff(low).max(initial=0))
            self.padded = np.append(transitions, np.float32(np.inf))

    def __call__(self, level: F32) -> Raw:
        level = np.clip(level, 0, self.top)
        if self.transitions is None:
            code = np.rint(level).astype(np.uint16)
        else:
            count = self.low.take(level.astype(np.int32))
            for _ in range(self.more):
                count += self.padded.take(count) <= level
            code = count.astype(np.uint16)
        return code if self.table is None else self.table.take(code)


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
