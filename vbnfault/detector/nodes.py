"""Say which output node reads each pixel, and in which order pixels leave the sensor.

One of 1, 2 or 4 output nodes reads each pixel once. Nodes sit in the sensor's corners, the first at the top left
(assumed), and are read at the same time.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..core.errors import InputError


def node_of(shape: tuple[int, int], nodes: int) -> NDArray[np.uint8]:
    """Return the output node that reads each pixel, uint8[y, x].

    A single node has the number 0. Of two nodes, 0 reads the left half and 1 the right half. Of four nodes, 0 and
    1 read the upper quadrants and 2 and 3 the lower ones, from left to right. A middle row belongs to the upper
    half, a middle column to the left half.
    """
    down, right = halves(shape, nodes)
    return (2 * down[:, None] + right).astype(np.uint8)


def halves(shape: tuple[int, int], nodes: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return the half, 0 or 1, in which each row and each column lies; 0 where the sensor is not halved."""
    if nodes not in (1, 2, 4):
        raise InputError(f"nodes is {nodes}, but must be 1, 2 or 4")
    down, right = ((np.arange(n) >= (n + 1) // 2).astype(np.intp) for n in shape)
    return down * (nodes == 4), right * (nodes > 1)


def readout_steps(shape: tuple[int, int], nodes: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return how many rows a node reads before each row, int[y], and pixels before each column, int[x]."""
    down, right = halves(shape, nodes)
    y, x = (np.arange(n) for n in shape)
    return np.where(down, shape[0] - 1 - y, y), np.where(right, shape[1] - 1 - x, x)


def last_before(lost: NDArray[np.intp]) -> NDArray[np.intp]:
    """Return, for each of the increasing indices `lost`, the nearest lower index that is not lost, or -1."""
    run_begins = np.append(True, np.diff(lost) > 1)
    return (lost[run_begins] - 1)[np.cumsum(run_begins) - 1] if len(lost) else lost


def transmission_order(shape: tuple[int, int], nodes: int) -> NDArray[np.intp]:
    """Return the flat indices of the pixels, int[y·x], in the order in which they leave the sensor.

    Each step sends one pixel of every node, in the order of the nodes. With one node this is row by row.
    """
    if nodes == 1:
        return np.arange(shape[0] * shape[1])
    lines, pixels = readout_steps(shape, nodes)
    step = lines[:, None] * shape[1] + pixels
    return np.argsort((step * nodes + node_of(shape, nodes)).ravel(), kind="stable")
