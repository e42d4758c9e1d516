"""Damage raw images: lines and nodes that the readout loses, and packets that the downlink loses.

All functions are pure: the positions of the faults are arguments. Raw images are uint16[y, x].
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ..core.errors import InputError
from .converter import with_stuck_bits
from .nodes import node_of

Raw = NDArray[np.uint16]
Mask = NDArray[np.bool_]

Axis = Literal["row", "column"]
Fill = Literal["zero", "previous"]


@dataclass(frozen=True, kw_only=True, eq=False)
class Damaged:
    """Hold a raw image uint16[y, x] after a fault.

    `region` bool[y, x] is where the fault acted; `changed` bool[y, x] are its pixels whose value changed.
    """

    raw: Raw
    region: Mask
    changed: Mask


def _damaged(before: Raw, after: Raw, region: Mask) -> Damaged:
    return Damaged(raw=after, region=region, changed=after != before)


def _checked(raw: Raw) -> Raw:
    if raw.ndim != 2 or raw.dtype != np.uint16:
        raise InputError(f"the raw image is {raw.dtype} of shape {raw.shape}, but must be uint16[y, x]")
    return raw


def _indices(name: str, values: Sequence[int] | NDArray[np.integer], count: int) -> NDArray[np.intp]:
    indices = np.unique(np.asarray(values, dtype=np.intp))
    for value in indices[(indices < 0) | (indices >= count)]:
        raise InputError(f"{name} holds {value}, but must be in 0 to {count - 1}")
    return indices


def _along(array: NDArray, axis: Axis) -> NDArray:
    """Return the array with the lines of `axis` as its first index."""
    if axis not in ("row", "column"):
        raise InputError(f"axis is '{axis}', but must be row or column")
    return array if axis == "row" else array.T


def _last_before(lost: NDArray[np.intp]) -> NDArray[np.intp]:
    """Return, for each of the increasing indices `lost`, the nearest lower index that is not lost, or -1."""
    run_begins = np.append(True, np.diff(lost) > 1)
    return (lost[run_begins] - 1)[np.cumsum(run_begins) - 1] if len(lost) else lost


def _with_lines(
    raw: Raw, lines: Sequence[int] | NDArray[np.integer], axis: Axis
) -> tuple[Raw, Mask, NDArray[np.intp]]:
    """Return a copy of the image, the region of the lines, and their checked numbers."""
    chosen = _indices("lines", lines, len(_along(_checked(raw), axis)))
    region = np.zeros(raw.shape, dtype=np.bool_)
    _along(region, axis)[chosen] = True
    return raw.copy(), region, chosen


def dead_lines(
    raw: Raw, lines: Sequence[int] | NDArray[np.integer], axis: Axis = "column", level_dn: int = 0
) -> Damaged:
    """Set rows or columns to one level, such as 0 or the bias."""
    _within("level_dn", level_dn, 0, 65535)
    out, region, chosen = _with_lines(raw, lines, axis)
    _along(out, axis)[chosen] = level_dn
    return _damaged(raw, out, region)


def saturated_lines(
    raw: Raw, lines: Sequence[int] | NDArray[np.integer], axis: Axis = "column", bits: int = 12
) -> Damaged:
    """Set rows or columns to the top code."""
    _within("bits", bits, 1, 16)
    return dead_lines(raw, lines, axis, 2**bits - 1)


def duplicated_lines(raw: Raw, lines: Sequence[int] | NDArray[np.integer], axis: Axis = "row") -> Damaged:
    """Make rows or columns repeat the line before, as if an address failed to advance.

    A run of them repeats the last line before the run. Lines at the border without a line before them stay.
    """
    out, region, chosen = _with_lines(raw, lines, axis)
    source = _last_before(chosen)
    chosen, source = chosen[source >= 0], source[source >= 0]
    _along(out, axis)[chosen] = _along(raw, axis)[source]
    return _damaged(raw, out, region)


def shifted_lines(
    raw: Raw,
    lines: Sequence[int] | NDArray[np.integer],
    axis: Axis = "row",
    shift_px: int = 1,
    fill_dn: int | None = 0,
) -> Damaged:
    """Shift rows or columns along themselves, as after a lost or added clock.

    A positive `shift_px` is towards larger indices. Vacated pixels take `fill_dn`; with None the line wraps round.
    """
    if fill_dn is not None:
        _within("fill_dn", fill_dn, 0, 65535)
    out, region, chosen = _with_lines(raw, lines, axis)
    length = raw.shape[1] if axis == "row" else raw.shape[0]
    moved = np.roll(_along(raw, axis)[chosen], shift_px, axis=1)
    if fill_dn is not None:
        from_pixel = np.arange(length) - shift_px
        moved[:, (from_pixel < 0) | (from_pixel >= length)] = fill_dn
    _along(out, axis)[chosen] = moved
    return _damaged(raw, out, region)


def lost_node(raw: Raw, nodes: int, node: int, level_dn: int = 0) -> Damaged:
    """Set all pixels of one output node (see `node_of`) to one level."""
    _within("level_dn", level_dn, 0, 65535)
    _indices("node", [node], nodes)
    region = node_of(_checked(raw).shape, nodes) == node  # type: ignore[arg-type]
    return _damaged(raw, np.where(region, np.uint16(level_dn), raw), region)


def stick_bits(
    raw: Raw, stuck_bits: Sequence[tuple[int, int]], bits: int = 12, where: Mask | None = None
) -> Damaged:
    """Hold the bits of (bit, value) pairs at 0 or 1, in the whole image or in the pixels `where` bool[y, x]."""
    _within("bits", bits, 1, 16)
    _check_bits(stuck_bits, bits)
    region = np.ones(_checked(raw).shape, dtype=np.bool_) if where is None else np.array(where, dtype=np.bool_)
    return _damaged(raw, np.where(region, with_stuck_bits(raw, stuck_bits), raw), region)


# --- the downlink -----------------------------------------------------------------------------------------------


def packet_count(shape: tuple[int, int], packet_px: int) -> int:
    """Return how many packets of `packet_px` pixels carry an image; the last one may be short."""
    if packet_px < 1:
        raise InputError(f"packet_px is {packet_px}, but must be at least 1")
    return -(-shape[0] * shape[1] // packet_px)


def _stream(
    raw: Raw, packets: Sequence[int] | NDArray[np.integer], packet_px: int, order: NDArray[np.intp] | None
) -> tuple[Raw, NDArray[np.intp], NDArray[np.intp]]:
    """Return the pixels in the order sent, the checked packets, and the positions of their pixels in that order.

    The positions, int[packet, packet_px], include those beyond the end of a short last packet.
    """
    chosen = _indices("packets", packets, packet_count(_checked(raw).shape, packet_px))  # type: ignore[arg-type]
    if order is not None and order.shape != (raw.size,):
        raise InputError(f"order has shape {order.shape}, but must have ({raw.size},)")
    stream = raw.ravel() if order is None else raw.ravel()[order]
    return stream.copy(), chosen, chosen[:, None] * packet_px + np.arange(packet_px)


def _received(raw: Raw, stream: Raw, hit: NDArray[np.intp], order: NDArray[np.intp] | None) -> Damaged:
    """Return the image that the receiver makes from a stream that was damaged at the positions `hit`."""
    region, out = np.zeros(raw.size, dtype=np.bool_), stream
    if order is None:
        region[hit] = True
    else:
        region[order[hit]] = True
        out = np.empty_like(stream)
        out[order] = stream
    return _damaged(raw, out.reshape(raw.shape), region.reshape(raw.shape))


def lost_packets(
    raw: Raw,
    packets: Sequence[int] | NDArray[np.integer],
    packet_px: int,
    fill: Fill = "zero",
    order: NDArray[np.intp] | None = None,
) -> Damaged:
    """Fill packets that never arrive with 0 or with the last packet that did arrive (0 if none did).

    A packet is a run of `packet_px` pixels in the order sent: row by row, or by the flat indices `order`
    (`transmission_order`).
    """
    stream, chosen, positions = _stream(raw, packets, packet_px, order)
    inside = positions < raw.size
    value = np.zeros(positions.shape, dtype=np.uint16)
    if _checked_fill(fill) == "previous":
        source = _last_before(chosen)
        held = source >= 0
        value[held] = stream[source[held, None] * packet_px + np.arange(packet_px)]
    stream[positions[inside]] = value[inside]
    return _received(raw, stream, positions[inside], order)


def corrupted_packets(
    raw: Raw,
    packets: Sequence[int] | NDArray[np.integer],
    packet_px: int,
    bit_error_rate: float,
    rng: np.random.Generator,
    bits: int = 12,
    order: NDArray[np.intp] | None = None,
) -> Damaged:
    """Flip each of the `bits` of a pixel in some packets, independently, with probability `bit_error_rate`.

    The number of uniform variates (one per bit) does not depend on the signal or the rate.
    """
    _within("bit_error_rate", bit_error_rate, 0, 1)
    _within("bits", bits, 1, 16)
    stream, _, positions = _stream(raw, packets, packet_px, order)
    flips = np.zeros(positions.shape, dtype=np.uint16)
    for bit in range(bits):
        flips |= (rng.random(positions.shape) < bit_error_rate).astype(np.uint16) << np.uint16(bit)
    inside = positions < raw.size
    stream[positions[inside]] ^= flips[inside]
    return _received(raw, stream, positions[inside], order)


def lost_lines(
    raw: Raw, lines: Sequence[int] | NDArray[np.integer], axis: Axis = "row", fill: Fill = "zero"
) -> Damaged:
    """Fill rows or columns that never arrive with 0 or with the last line that did arrive (0 if none did)."""
    out, region, chosen = _with_lines(raw, lines, axis)
    _along(out, axis)[chosen] = 0
    if _checked_fill(fill) == "previous":
        source = _last_before(chosen)
        _along(out, axis)[chosen[source >= 0]] = _along(raw, axis)[source[source >= 0]]
    return _damaged(raw, out, region)


def _checked_fill(fill: Fill) -> Fill:
    if fill not in ("zero", "previous"):
        raise InputError(f"fill is '{fill}', but must be zero or previous")
    return fill


def _within(name: str, value: float, low: float, high: float) -> None:
    if not low <= value <= high:
        raise InputError(f"{name} is {value}, but must be in {low} to {high}")


def _check_bits(stuck_bits: Sequence[tuple[int, int]], bits: int) -> None:
    for bit, value in stuck_bits:
        if not 0 <= bit < bits or value not in (0, 1):
            raise InputError(
                f"stuck_bits holds ({bit}, {value}), but must be (bit, value), bit in 0 to {bits - 1}, value 0 or 1"
            )
