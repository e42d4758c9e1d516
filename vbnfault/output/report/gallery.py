"""Make the contact sheet of a report: small images with a mask for each fault, and their clean twins."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ...core.html_page import data_url, image_url
from ...core.quantities import Sample
from ...store import Store
from ..contact_sheet import COLOURS, resized_mask
from .measure import Scalars, readable, spread

_SIDES_PX = (640, 400, 256, 128)  # of the images; the first whose files fit is taken
_MOST_BYTES = 15_000_000  # of all images
_FILL, _FAINT_FILL = 77, 36  # opacity of a mask's inside, less for a class that is not localised
_WHOLE_FRAME = 0.98


def pick(scalars: Scalars, most: int) -> list[int]:
    """Return the positions of up to `most` samples: of each class in each split at least one where there is room.

    The rest is spaced evenly over the store.
    """
    chosen: set[int] = set()
    injected = scalars.injected
    for k in range(injected.shape[1]):
        for split in range(len(scalars.split_names)):
            having = np.flatnonzero(injected[:, k] & (scalars.split == split))
            if having.size and len(chosen) < most * 2 // 3 and not chosen & set(having.tolist()):
                chosen.add(int(having[len(having) // 2]))
    rest = [position for position in range(len(scalars.samples)) if position not in chosen]
    chosen |= {rest[k] for k in spread(len(rest), most - len(chosen)).tolist()}
    return sorted(chosen)


def cards(store: Store, scalars: Scalars, most: int, unread: dict[int, str]) -> list[dict[str, Any]]:
    """Return up to `most` samples as the template shows them.

    The reasons why samples cannot be read are added to `unread`, by position.
    """
    names = [name for name in ("image", "clean", "mask") if name in store.spec.pixel_layers]
    picked = list(readable(store, scalars, pick(scalars, most), names, unread))
    made: list[dict[str, Any]] = []
    for side in _SIDES_PX:
        made = [_card(store, scalars, position, sample, side) for position, sample in picked]
        if sum(len(url) for card in made for url in card["urls"].values()) <= _MOST_BYTES:
            break
    return made


def _card(store: Store, scalars: Scalars, position: int, sample: Sample, side_px: int) -> dict[str, Any]:
    """Return one sample: its number, what it is, and its images, at most `side_px` wide and high, as addresses."""
    spec, layers = store.spec, sample.layers
    scale = min(1.0, side_px / max(spec.height, spec.width))
    size = (max(1, round(spec.width * scale)), max(1, round(spec.height * scale)))
    urls = {name: image_url(layers[name][..., :3], side_px) for name in ("image", "clean") if name in layers}
    for k, fault in enumerate(spec.faults):
        if layers["mask"][k].any():
            is_localised = fault in (spec.localised_faults or spec.faults)
            colour = COLOURS[k % len(COLOURS)]
            urls[f"mask m{k}"] = _mask_url(resized_mask(layers["mask"][k].astype(bool), size), colour, is_localised)
    faults = np.flatnonzero(scalars.injected[position]).tolist()
    return {
        "index": sample.index,
        "words": ", ".join(spec.faults[k].replace("_", " ") for k in faults) or "no fault",
        "faults": faults,
        "where": f"{scalars.split_names[scalars.split[position]]}, {scalars.stratum(position)}",
        "coarse": max(size) <= _SIDES_PX[-1],
        "urls": urls,
    }


def _mask_url(mask: NDArray[np.bool_], colour: tuple[int, int, int], is_localised: bool) -> str:
    """Return a mask as a transparent image within the page: tinted inside, with an outline."""
    padded = np.pad(mask, 1).astype(np.uint8)  # so that a mask has an outline at the edge of the frame, too
    inside = cv2.erode(padded, np.ones((3, 3), np.uint8))[1:-1, 1:-1].astype(bool)
    fill = _FILL if is_localised and mask.mean() < _WHOLE_FRAME else _FAINT_FILL
    values = np.zeros((*mask.shape, 4), np.uint8)
    values[mask] = (*colour[::-1], 235)
    values[mask & inside, 3] = fill
    lossless = [cv2.IMWRITE_WEBP_QUALITY, 101]
    return data_url(cv2.imencode(".webp", values, lossless)[1].tobytes(), "image/webp")
