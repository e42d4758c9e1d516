"""Simulate transmission errors: packets and lines of the raw mosaic are lost or damaged before they arrive.

The pixels leave in packets of `packet_px`, in the order in which the sensor's nodes read them. A lost packet
arrives as zeros, or the receiver repeats the last packet that arrived. A burst removes several packets. In a
damaged packet, bits flip independently (binary symmetric channel) and at a high rate: links are coded, and a packet
that cannot be decoded is full of errors (CCSDS 130.1-G). A line may be lost on the camera's own interface.

The image is made from the data that arrive, so demosaicing spreads the errors. Sizes and numbers are assumed. Space
packets carry at most 65 536 bytes of data (CCSDS 133.0-B).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from ..detector.nodes import transmission_order
from ..detector.raw_damage import Fill, corrupted_packets, lost_lines, lost_packets, packet_count
from .context import FaultContext, Params
from .contract import Fault
from .fields import Interval, Severity, bounds, choice

Raw = NDArray[np.uint16]
Mask = NDArray[np.bool_]


@dataclass(frozen=True, kw_only=True)
class PacketTransmission(Fault):
    """Lose and damage packets of the raw mosaic, and lose lines of it."""

    fault = "transmission"
    model = "packets"
    default = True
    after = "broken_lines"
    step = "raw"
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
        ("drawn", "zero", "previous"),
        doc="what lost packets and rows show: 0, the last that arrived, or either with equal chance",
    )

    def draw(self, context: FaultContext, rng: np.random.Generator) -> Params:
        """Return the indices of lost packets, damaged packets and lost rows, and the seed of the bit flips.

        No packet is both lost and damaged.
        """
        detector = context.camera.mosaic
        packet_px = self.packet_px.integer(rng)
        packets = packet_count(context.shape, packet_px)
        bursts = self.lost_count.integer(rng)
        begin = rng.integers(packets, size=bursts)
        length = rng.integers(int(self.burst_packets.lo), int(self.burst_packets.hi), bursts, endpoint=True)
        change = np.zeros(packets + 1, dtype=np.intp)
        np.add.at(change, begin, 1)
        np.add.at(change, np.minimum(begin + length, packets), -1)
        lost = np.cumsum(change[:-1]) > 0
        arrived = rng.permutation(np.flatnonzero(~lost))
        rows = rng.permutation(context.shape[0])[: self.lost_lines.integer(rng)]
        return {
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
    packet_px, fill = params["packet_px"], cast(Fill, params["fill"])
    order = None if params["nodes"] == 1 else _order(raw.shape, params["nodes"])
    damaged = corrupted_packets(
        raw,
        params["damaged"],
        packet_px,
        params["bit_error_rate"],
        np.random.default_rng(params["seed"]),
        params["bits"],
        order,
    )
    lost = lost_packets(damaged.raw, params["lost"], packet_px, fill, order)
    gone = lost_lines(lost.raw, params["lines"], "row", fill)
    return gone.raw, damaged.changed | lost.region | gone.region


@lru_cache(maxsize=2)
def _order(shape: tuple[int, int], nodes: int) -> NDArray[np.intp]:
    """Return the order of transmission, computed once; read-only."""
    order = transmission_order(shape, nodes)
    order.flags.writeable = False
    return order
