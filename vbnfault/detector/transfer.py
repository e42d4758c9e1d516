"""Apply steps along the paths of charge through a sensor, and compute the dark current that it collects there."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from .charge import smear

if TYPE_CHECKING:
    from .sensor import Sensor

F32 = NDArray[np.float32]


def transfer_dark_e(sensor: Sensor, dark_rate_e_s: F32, direction: str) -> F32 | None:
    """Return the electrons from dark current that charge packets collect during transfer, float32[y, x].

    A full-frame CCD moves each packet through all pixels between its own pixel and the register. It stays in each
    for the readout time of a row, so a hot pixel leaves a line. Packets in the store of a frame-transfer CCD and in
    the registers of an interline CCD wait equally long; their dark current is assumed to be the median of the
    image. In a frame-transfer CCD a packet also passes the image pixels on its quick transfer to the store.

    Returns None for a CMOS sensor, and for a CCD without transfer times.
    """
    move = sensor.transfer
    if sensor.architecture == "cmos" or not (move.row_readout_s or move.row_transfer_s):
        return None
    if sensor.architecture == "full_frame_ccd":
        return passing_dark_e(sensor, dark_rate_e_s, direction)
    even = np.full_like(dark_rate_e_s, np.median(dark_rate_e_s))
    waiting = partial(smear, exposure_s=0.0, row_transfer_s=move.row_readout_s)
    return along_columns(sensor, direction, waiting, even) + passing_dark_e(sensor, dark_rate_e_s, direction)


def passing_dark_e(sensor: Sensor, dark_rate_e_s: F32, direction: str) -> F32:
    """Return the part of `transfer_dark_e` from the image's own pixels, float32[y, x]: linear in their rate."""
    period_s = {
        "full_frame_ccd": sensor.transfer.row_readout_s,
        "frame_transfer_ccd": sensor.transfer.row_transfer_s,
    }.get(sensor.architecture, 0.0)
    if not period_s:
        return np.zeros_like(dark_rate_e_s)
    gather = partial(smear, exposure_s=0.0, row_transfer_s=period_s)
    return along_columns(sensor, direction, gather, dark_rate_e_s)


def along_columns(sensor: Sensor, direction: str, step: Callable[..., F32], image: F32) -> F32:
    """Apply `step(part, direction=…)` along the columns of an image.

    A part holds all rows that are read towards one register: the whole image or, with four nodes, each half of it.
    """
    if sensor.readout.nodes < 4:
        return step(image, direction=direction)
    middle = (len(image) + 1) // 2
    return np.concatenate([step(image[:middle], direction="up"), step(image[middle:], direction="down")])


def along_registers(sensor: Sensor, step: Callable[..., F32], image: F32) -> F32:
    """Apply `step(part, direction=…)` along the rows of an image.

    All rows move to the left or, with two or four nodes, each half to its own side.
    """
    if sensor.readout.nodes == 1:
        return step(image, direction="left")
    middle = (image.shape[1] + 1) // 2
    return np.concatenate(
        [step(image[:, :middle], direction="left"), step(image[:, middle:], direction="right")], axis=1
    )
