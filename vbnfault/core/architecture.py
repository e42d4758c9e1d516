"""Name the sensor architectures and the readout directions, for scene files, sensors, cameras and faults."""

from __future__ import annotations

from typing import Literal, get_args

# How a sensor moves and reads its charge. Every sample of a dataset has one of these.
Architecture = Literal["full_frame_ccd", "frame_transfer_ccd", "interline_ccd", "cmos"]
ARCHITECTURES: tuple[Architecture, ...] = get_args(Architecture)
# The side of the image towards which the rows, or columns, are read.
ReadoutDirection = Literal["up", "down", "left", "right"]
READOUT_DIRECTIONS: tuple[ReadoutDirection, ...] = get_args(ReadoutDirection)
