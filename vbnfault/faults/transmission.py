"""Simulate transmission errors: packets and lines of the raw mosaic are lost or damaged before they arrive.

The pixels leave in packets of `packet_px`, in the order in which the sensor's nodes read them. A lost packet
arrives as zeros, or the receiver repeats the last packet that arrived. A burst removes several packets. In a
damaged packet, bits flip independently (binary symmetric channel) and at a high rate: links are coded, and a packet
that cannot be decoded is full of errors (CCSDS 130.1-G). A line may be lost on the camera's own interface.

Two patterns of flight images are off by default. A compressor with a fixed budget of bits drops the ends of lines
where the scene is busy: with `cut_rows`, each line of a block, or every second one, ends at a ragged edge and is 0
beyond, as in images of Cassini's cameras (ISS Data User's Guide; recalled). With `fill = "shifted"` the receiver
does not notice that packets are missing: all that follows moves up, so that the image is sheared along its lines,
until the next mark of `sync_rows`.

The image is made from the data that arrive, so demosaicing spreads the errors. Sizes and numbers are assumed. Space
packets carry at most 65 536 bytes of data (CCSDS 133.0-B).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..detector.readout import last_before, transmission_order
from .context import FaultContext, Params
from .contract import Fault
from .fields import Interval, Severity, bounds, choice, number

Raw = NDArray[np.uint16]
Mask = NDArray[np.bool_]

_CUT_FROM = (0.3, 0.9)  # column, over the width, at which the first cut line ends; assumed
_RAGGED = 0.02  # step from one cut line's end to the next one's, over the width; assumed


@dataclass(frozen=True, kw_only=True)
class PacketTransmission(Fault):
    """Lose and damage packets of the raw mosaic, and lose lines of it."""

    fault = "transmission"
    model = "packets"
    default = True
    after = "register_upset"
    step = "raw"
    per_exposure = True
    severity = Severity(key="lost_count", low=1, high=1000, width_power=2)
    needs_mosaic = True

    packet_px: Interval = bounds(
        256, 2048, limits=(1, 1 << 20), integer=True, unit="px", doc="pixels in a packet; assumed"
    )
    lost_count: Interval = bounds(1, 4, limits=(0, 10_000), integer=True, doc="bursts of lost packets; assumed")
    burst_packets: Interval = bounds(
        1, 8, limits=(1, 10_000), integer=True, doc="packets lost together, one burst after the other; assumed"
    )
    damaged_count: Interval = bounds(0, 8, limits=(0, 10_000), integer=True, doc="packets whose bits flip; assumed")
    bit_error_rate: Interval = bounds(
        0.01, 0.1, limits=(0, 1), doc="chance that a bit of a damaged packet flips; assumed"
    )
    lost_lines: Interval = bounds(0, 3, limits=(0, 10_000), integer=True, doc="rows lost one by one; assumed")
    fill: str = choice(
        "drawn",
        ("drawn", "zero", "previous", "shifted"),
        doc="what lost packets and rows show: 0, the last that arrived, or either with equal chance; shifted: what "
        "follows moves up to the next mark, lost rows are 0",
    )
    sync_rows: int = number(
        64, limits=(1, 16384), integer=True, unit="px", doc="rows between two marks, for fill = 'shifted'; assumed"
    )
    cut_rows: Interval = bounds(
        0, 0, limits=(0, 16384), integer=True, unit="px", doc="rows of a block whose lines lose their ends; 0: none"
    )
    cut_every: int = number(2, limits=(1, 64), integer=True, doc="of these lines, each such one is cut")

    def draw(self, context: FaultContext, rng: np.random.Generator) -> Params:
        """Return the indices of lost packets, damaged packets and lost rows, and the seed of the bit flips.

        No packet is both lost and damaged.
        """
        detector = context.camera.mosaic
        packet_px = self.packet_px.integer(rng)
        packets = -(-context.shape[0] * context.shape[1] // packet_px)
        bursts = self.lost_count.integer(rng)
        begin = rng.integers(packets, size=bursts)
        length = rng.integers(int(self.burst_packets.lo), int(self.burst_packets.hi), bursts, endpoint=True)
        change = np.zeros(packets + 1, dtype=np.intp)
        np.add.at(change, begin, 1)
        np.add.at(change, np.minimum(begin + length, packets), -1)
        lost = np.cumsum(change[:-1]) > 0
        arrived = rng.permutation(np.flatnonzero(~lost))
        rows = rng.permutation(context.shape[0])[: self.lost_lines.integer(rng)]
        params: Params = {
            "packet_px": packet_px,
            "nodes": int(detector.sensor.readout.nodes),
            "bits": int(detector.sensor.readout.bits),
            "lost": np.flatnonzero(lost).tolist(),
            "damaged": sorted(arrived[: self.damaged_count.integer(rng)].tolist()),
            "bit_error_rate": self.bit_error_rate.uniform(rng),
            "seed": int(rng.integers(2**32)),
            "lines": sorted(rows.tolist()),
            "fill": ("zero", "previous")[int(rng.integers(2))] if self.fill == "drawn" else self.fill,
        }
        if self.fill == "shifted":
            params["sync_rows"] = int(self.sync_rows)
        if cut_rows := self.cut_rows.integer(rng):
            params["cut"] = self._cut(cut_rows, context, rng)
        return params

    def _cut(self, count: int, context: FaultContext, rng: np.random.Generator) -> list[list[int]]:
        """Return row and first lost column of each cut line; neighbours end within some hundredths of the width.

        With a mosaic a line is a row of its tiles, so that all its colours end together.
        """
        height, width = context.shape
        tile = len(context.camera.mosaic.sensor.pattern.tile)
        first = int(rng.integers(max(height - count, 0) // tile, endpoint=True)) * tile
        lines = first + np.arange(0, count, tile * int(self.cut_every))
        steps = np.cumsum(rng.normal(0, _RAGGED * width, len(lines)))
        columns = np.clip(rng.uniform(*_CUT_FROM) * width + steps, 1, width - 1).astype(int)
        rows = (lines[:, None] + np.arange(tile)).tolist()
        return [[row, int(end)] for line, end in zip(rows, columns, strict=True) for row in line if row < height]

    def apply(self, quantity: Any, params: Params, context: FaultContext) -> Any:
        """Return the raw digital numbers that arrive."""
        return quantity.with_array(_arrived(quantity.array, params)[0])

    def footprint(self, params: Params, context: FaultContext) -> Mask:
        """Return the pixels of the image that lost or flipped pixels can change, bool[y, x]."""
        detector = context.camera.mosaic
        # the flipped bits do not depend on the signal
        _, region = _arrived(np.zeros(context.shape, dtype=np.uint16), params)
        reached: Mask = detector.footprint(region)
        return reached


def _arrived(raw: Raw, params: Params) -> tuple[Raw, Mask]:
    """Return the mosaic that arrives, and its pixels that were lost or had bits flipped, bool[y, x]."""
    order = _order(raw.shape, params["nodes"])
    stream, hit = np.array(raw.ravel()[order]), np.zeros(raw.size, dtype=np.bool_)
    damaged, lost = (_positions(params[packets], params["packet_px"]) for packets in ("damaged", "lost"))
    # the number of variates depends neither on the signal nor on the rate
    rng, flips = np.random.default_rng(params["seed"]), np.zeros(damaged.shape, dtype=np.uint16)
    for bit in range(params["bits"]):
        flips |= (rng.random(damaged.shape) < params["bit_error_rate"]).astype(np.uint16) << np.uint16(bit)
    inside = damaged < raw.size
    stream[damaged[inside]] ^= flips[inside]
    hit[damaged[inside]] = flips[inside] != 0
    repeats, inside = params["fill"] == "previous", lost < raw.size
    if params["fill"] == "shifted":
        _close_up(stream, hit, lost[inside], params["sync_rows"] * raw.shape[1])
    else:
        shown = np.zeros(lost.shape, dtype=np.uint16)
        if repeats:
            source = last_before(np.asarray(params["lost"], dtype=np.intp))
            shown[source >= 0] = stream[_positions(source[source >= 0], params["packet_px"])]
        stream[lost[inside]] = shown[inside]
        hit[lost[inside]] = True
    out, region = np.empty_like(raw), np.empty(raw.shape, dtype=np.bool_)
    out.ravel()[order], region.ravel()[order] = stream, hit
    lines = np.asarray(params["lines"], dtype=np.intp)
    source = last_before(lines)
    arrived = source >= 0 if repeats else np.zeros(len(lines), dtype=np.bool_)
    out[lines[~arrived]], out[lines[arrived]] = 0, out[source[arrived]]
    region[lines] = True
    for row, column in params.get("cut", ()):
        out[row, column:], region[row, column:] = 0, True
    return out, region


def _close_up(stream: Raw, hit: Mask, lost: NDArray[np.intp], block_px: int) -> None:
    """Let the pixels behind lost ones move up within blocks of `block_px`, in place; 0 where none is left."""
    arrives = np.ones(len(stream), dtype=np.bool_)
    arrives[lost] = False
    for start in np.unique(lost // block_px) * block_px:
        block = slice(int(start), int(start) + block_px)
        left, first = stream[block][arrives[block]], int(np.argmin(arrives[block]))
        hit[block][first:] = True
        stream[block] = 0
        stream[block][: len(left)] = left


def _positions(packets: ArrayLike, packet_px: int) -> NDArray[np.intp]:
    """Return the positions of the packets' pixels in the order sent, int[packet, packet_px], also past the end."""
    return np.asarray(packets, dtype=np.intp)[:, None] * packet_px + np.arange(packet_px)


@lru_cache(maxsize=2)
def _order(shape: tuple[int, int], nodes: int) -> NDArray[np.intp] | slice:
    """Return the order in which pixels are sent, read-only; one node sends them row by row."""
    if nodes == 1:
        return slice(None)
    order = transmission_order(shape, nodes)
    order.flags.writeable = False
    return order
