"""Find the connected regions of masks, and encode them as COCO run lengths and as polygons."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, eq=False)
class Region:
    """Hold one connected region of a mask.

    Attributes
    ----------
    area
        Number of pixels.
    box
        Left and upper edge, width and height, in pixels.
    counts
        COCO's run lengths, int64[n]: pixels outside and inside by turns, down the columns of the whole image.
    inside
        The region within its box, bool[height, width].
    """

    area: int
    box: tuple[int, int, int, int]
    counts: NDArray[np.int64]
    inside: NDArray[np.bool_]


def regions(mask: NDArray[np.bool_]) -> list[Region]:
    """Return the regions of a mask, bool[y, x], in the order of their first pixel down the columns.

    Pixels that touch at a side or a corner are connected.
    """
    count, labels, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=8)
    down = np.asarray(labels).T.ravel()  # down the columns, as COCO counts
    pixels = np.flatnonzero(down)
    by_label = np.argsort(down[pixels], kind="stable")
    if count < 2:
        return []
    ends = np.cumsum(np.bincount(down[pixels], minlength=count)[1:])[:-1]
    found = []
    for label, indices in enumerate(np.split(pixels[by_label], ends), start=1):
        x, y, w, h, area = (int(v) for v in stats[label])
        inside = np.asarray(labels[y : y + h, x : x + w] == label)
        found.append((int(indices[0]), Region(area, (x, y, w, h), _run_lengths(indices, mask.size), inside)))
    return [region for _, region in sorted(found, key=lambda pair: pair[0])]


def whole(mask: NDArray[np.bool_]) -> Region:
    """Return all pixels of a mask as one region, connected or not; the mask must not be empty."""
    y, x = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    box = (int(x[0]), int(y[0]), int(np.ptp(x)) + 1, int(np.ptp(y)) + 1)
    inside = mask[y[0] : y[-1] + 1, x[0] : x[-1] + 1]
    counts = _run_lengths(np.flatnonzero(mask.T.ravel()), mask.size)
    return Region(int(mask.sum()), box, counts, inside)


def _run_lengths(indices: NDArray[np.int64], size: int) -> NDArray[np.int64]:
    """Return the lengths of runs outside and inside by turns; `indices` are the sorted pixels inside."""
    breaks = np.flatnonzero(np.diff(indices) > 1)
    first = indices[np.concatenate([[0], breaks + 1])]
    last = indices[np.concatenate([breaks, [len(indices) - 1]])] + 1
    bounds = np.stack([first, last], axis=1).ravel()
    return np.diff(np.concatenate([[0], bounds, [size] if bounds[-1] < size else []])).astype(np.int64)


def coco_text(counts: NDArray[np.int64]) -> str:
    """Return run lengths in COCO's compressed text.

    From the fourth number on, the difference from the last but one is coded. A number is written in groups of five
    bits, the least significant first, each as the character of its value plus 48; 32 is added to a group if more
    groups follow, and the last group carries the sign (pycocotools, `maskApi.c`, `rleToString`).
    """
    rest = np.array(counts, dtype=np.int64)
    rest[3:] -= counts[1:-2]
    groups, used = [], []
    open_ = np.ones(len(rest), dtype=bool)
    while open_.any():
        low = rest & 0x1F
        rest = rest >> 5
        follows = np.where(low & 0x10, rest != -1, rest != 0) & open_
        groups.append(low + 48 + 32 * follows)
        used.append(open_)
        open_ = follows
    characters, valid = np.stack(groups, axis=1), np.stack(used, axis=1)
    return characters[valid].astype(np.uint8).tobytes().decode("ascii")


def polygon(region: Region) -> NDArray[np.float64]:
    """Return the outline of a region, float64[n, 2] (x, y) in pixels, n at least 3; holes are filled.

    The vertices are the centres of the pixels along the outline, at +0.5, so that `cv2.fillPoly` of their whole
    numbers gives the region back. A region without three such vertices, such as one pixel, has the corners of its
    box.
    """
    left, top, width, height = region.box
    contours, _ = cv2.findContours(region.inside.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
    outline = max(contours, key=len).reshape(-1, 2).astype(np.float64)
    if len(outline) < 3:
        short = 1e-3  # keeps the corners within the last pixels, which contain coordinates below their far edge
        corners = [(0, 0), (width - short, 0), (width - short, height - short), (0, height - short)]
        if len(outline) == 2 and width > 1 and height > 1:  # a diagonal line: its box would hold other pixels
            (x0, y0), (x1, y1) = outline
            corners = [(x0 + 0.25, y0 + 0.25), (x1 + 0.5, y1 + 0.5), (x1 + 0.75, y1 + 0.75), (x0 + 0.5, y0 + 0.5)]
        return np.array(corners) + np.array([left, top])
    return outline + np.array([left + 0.5, top + 0.5])
