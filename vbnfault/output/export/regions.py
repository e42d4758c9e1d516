"""Find the connected regions of masks, and encode them as COCO run lengths and as polygons."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ...core.errors import InputError
from ...core.quantities import Sample
from ...store import StoreSpec

MOST_EDGES = 100  # of one outline: finding the way to ten thousand holes would take minutes


def flare_discs(
    params: Mapping[str, Any], sun_xy_px: NDArray[np.float64], shape: tuple[int, int]
) -> NDArray[np.float64]:
    """Return x, y and radius in pixels of the flares and the glare that a fault's parameters list, float64[n, 3].

    The flares lie on the line from the Sun through the image's centre, or that of the parameters. `shape` is
    (height, width). Parameters without them, or a Sun that is not in front of the camera, have none.
    """
    sun, middle = np.asarray(sun_xy_px, dtype=np.float64), np.array([shape[1], shape[0]]) / 2
    middle = np.asarray(params.get("centre_xy_px", middle), dtype=np.float64)
    if not np.all(np.isfinite(sun)):
        return np.zeros((0, 3))
    lights = [(flare["position"], flare["radius"]) for flare in params.get("flares", ())]
    lights += [(0.0, glare["radius"]) for glare in [params.get("glare")] if glare]
    return np.array([[*(sun + p * (middle - sun)), r * shape[1]] for p, r in lights]).reshape(-1, 3)


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


def region_labels(mask: NDArray[np.bool_], discs: NDArray[np.float64] | None = None) -> NDArray[np.int32]:
    """Return the number of the region of each pixel of a mask, int32[y, x], 0 outside of it; see `regions`."""
    if discs is None or not len(discs):
        return np.asarray(cv2.connectedComponents(mask.astype(np.uint8), connectivity=8)[1])
    y, x = np.nonzero(mask)
    distance = np.hypot(x[:, None] + 0.5 - discs[:, 0], y[:, None] + 0.5 - discs[:, 1]) / discs[:, 2]
    labels = np.zeros(mask.shape, dtype=np.int32)
    labels[y, x] = 1 + np.argmin(distance, axis=1)
    return labels


def regions(mask: NDArray[np.bool_], discs: NDArray[np.float64] | None = None) -> list[Region]:
    """Return the regions of a mask, bool[y, x], in the order of their first pixel down the columns.

    Pixels that touch at a side or a corner are connected. With `discs`, float64[n, 3] of centre and radius in
    pixels, a region is instead all pixels that are nearest to one disc, by their distance from its centre over its
    radius.
    """
    labels = region_labels(mask, discs)
    down = labels.T.ravel()  # down the columns, as COCO counts
    pixels = np.flatnonzero(down)
    by_label = pixels[np.argsort(down[pixels], kind="stable")]
    groups = np.split(by_label, 1 + np.flatnonzero(np.diff(down[by_label]))) if len(pixels) else []
    return [_region(group, mask.shape) for group in sorted(groups, key=lambda group: int(group[0]))]


def class_discs(
    spec: StoreSpec, index: int, parameters: Mapping[str, Any], fault: str, sun_xy_px: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return `flare_discs` of a class of a sample. Raises InputError if vbnfault did not write its parameters."""
    try:
        return flare_discs(parameters.get(fault) or {}, sun_xy_px, (spec.height, spec.width))
    except (TypeError, ValueError, KeyError, AttributeError):  # of a store that vbnfault did not write
        raise InputError(f"sample {index}: parameters of {fault} list no flares as vbnfault does") from None


def instances(
    spec: StoreSpec, sample: Sample, min_area_px: int, *, whole_frame: bool = False
) -> Iterator[list[Region]]:
    """Yield the instances of each class of a sample of at least `min_area_px` pixels.

    With `whole_frame`, a class that is not localised has one of its whole mask; without, it has none.
    """
    parameters = json.loads(sample.scalars["parameters"] or "{}")
    for fault, mask in zip(spec.faults, sample.layers["mask"], strict=True):
        found: list[Region] = []
        if fault in (spec.localised_faults or ()):
            discs = class_discs(spec, sample.index, parameters, fault, sample.scalars["sun_xy_px"])
            found = regions(mask, discs)
        elif whole_frame and mask.any():
            found = [whole(mask)]
        yield [region for region in found if region.area >= min_area_px]


def whole(mask: NDArray[np.bool_]) -> Region:
    """Return all pixels of a mask as one region, connected or not; the mask must not be empty."""
    return _region(np.flatnonzero(mask.T.ravel()), mask.shape)


def _region(indices: NDArray[np.int64], shape: tuple[int, ...]) -> Region:
    """Return the region of some pixels, whose sorted indices count down the columns of an image of a shape."""
    x, y = np.divmod(indices, shape[0])
    left, top = int(x[0]), int(y.min())
    inside = np.zeros((int(y.max()) - top + 1, int(x[-1]) - left + 1), dtype=bool)
    inside[y - top, x - left] = True
    counts = _run_lengths(indices, shape[0] * shape[1])
    return Region(len(indices), (left, top, inside.shape[1], inside.shape[0]), counts, inside)


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
    """Return the outline of a region, float64[n, 2] (x, y) in pixels, n at least 3.

    The vertices are the centres of the pixels along the outline, at +0.5, so that `cv2.fillPoly` of their whole
    numbers gives the region back. The outline goes along one line to the edge of each hole or further piece of the
    region, round it and back; of many, the `MOST_EDGES` longest are in it. A region without three vertices, such as
    one pixel, has the corners of its box.
    """
    from scipy.spatial import cKDTree

    left, top, width, height = region.box
    edges, _ = cv2.findContours(region.inside.astype(np.uint8), cv2.RETR_LIST, cv2.CHAIN_APPROX_SIMPLE)
    by_length = sorted(edges, key=lambda edge: cv2.arcLength(edge, closed=True), reverse=True)
    outline, *others = (edge.reshape(-1, 2).astype(np.float64) for edge in by_length[:MOST_EDGES])
    for edge in others:
        apart, nearest = cKDTree(edge).query(outline)
        i = int(apart.argmin())
        j = int(nearest[i])
        round_it = np.concatenate([edge[j:], edge[: j + 1]])
        outline = np.concatenate([outline[: i + 1], round_it, outline[i:]])
    if len(outline) < 3:
        short = 1e-3  # keeps the corners within the outer pixels, also where a reader has rounded them
        right, bottom = width - short, height - short
        corners = [(short, short), (right, short), (right, bottom), (short, bottom)]
        if len(outline) == 2 and width > 1 and height > 1:  # a diagonal line: its box would hold other pixels
            (x0, y0), (x1, y1) = outline
            corners = [(x0 + 0.25, y0 + 0.25), (x1 + 0.5, y1 + 0.5), (x1 + 0.75, y1 + 0.75), (x0 + 0.5, y0 + 0.5)]
        return np.array(corners) + np.array([left, top])
    return outline + np.array([left + 0.5, top + 0.5])
