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

    One node is 0. Two nodes are 0 left and 1 right. Four nodes number the quadrants in reading order. The middle
    row or column of an odd number belongs to the top or left.
    """
    down, right = halves(shape, nodes)
    return (2 * down[:, None] + right).astype(np.uint8)


def halves(shape: tuple[int, int], nodes: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return, for each row and each column, the half (0 or 1) in which it lies, if the sensor is read in halves."""
    if nodes not in (1, 2, 4):
        raise InputError(f"nodes is {nodes}, but must be 1, 2 or 4")
    down, right = ((np.arange(n) >= (n + 1) // 2).astype(np.intp) for n in shape)
    return down * (nodes == 4), right * (nodes > 1)


def readout_steps(shape: tuple[int, int], nodes: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return how many lines, int[y], and pixels, int[x], the node of each reads before it.

    Nodes sit in the sensor's corners, the first at the top left (assumed), and are read at the same time.
    """
    down, right = halves(shape, nodes)
    y, x = (np.arange(n) for n in shape)
    return np.where(down, shape[0] - 1 - y, y), np.where(right, shape[1] - 1 - x, x)


def transmission_order(shape: tuple[int, int], nodes: int) -> NDArray[np.intp]:
    """Return the flat indices of the pixels, int[y·x], in the order in which they leave the sensor.

    Each step sends one pixel of every node, in the order of the nodes. With one node this is row by row.
    """
    if nodes == 1:
        return np.arange(shape[0] * shape[1])
    lines, pixels = readout_steps(shape, nodes)
    step = lines[:, None] * shape[1] + pixels
    return np.argsort((step * nodes + node_of(shape, nodes)).ravel(), kind="stable")
