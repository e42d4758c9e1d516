"""Masks: where a fault sits, and where it shows.

The mask of a class is its *footprint*, except for classes that label by *effect* (straylight): the pixels that
change by at least `Fault.effect_level_dn` digital numbers (one by default), noise-free, when the fault is switched
off. Whatever overwrites a flare
(a broken line, saturation) therefore drops out of its mask.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping

import cv2
import numpy as np
from numpy.typing import NDArray

from ..faults import Fault, FaultContext, Params

Mask = NDArray[np.bool_]

# Steps of a detector with a mosaic at which charge may still leave the pixels that a fault acts on.
_MOVES = {"light", "pixels", "charge"}


def effect(image: NDArray[np.uint8], without: NDArray[np.uint8], least_dn: float = 1.0) -> Mask:
    """bool[y, x]: pixels of two noise-free 8 bit images that differ by `least_dn` or more in any channel."""
    if least_dn > 1:
        return np.asarray((cv2.absdiff(image, without) >= least_dn).any(axis=2))
    # four 8 bit channels compare as one 32 bit word
    a, b = (np.ascontiguousarray(x).view(np.uint32)[..., 0] for x in (image, without))
    return a != b


def kind(fault: Fault, *, is_ccd: bool) -> str:
    """Return what the mask of a fault is: `footprint`, `effect`, both united, or `strong effect`: the effect from
    more than one digital number on."""
    if fault.effect_mask:
        return "effect" if fault.effect_level_dn <= 1 else "strong effect"
    return "footprint and effect" if is_ccd and _moves(fault) else "footprint"


def _moves(fault: Fault) -> bool:
    return not _MOVES.isdisjoint(fault.steps)


def footprint_rule(fault: Fault) -> str:
    """Return which pixels the mask of a fault holds, with the thresholds of the fault: its fields mask_*."""
    thresholds = [f for f in dataclasses.fields(fault) if f.name.startswith("mask_")]
    rules = []
    for f in thresholds:
        unit = f.metadata.get("unit", "")
        rules.append(f"{f.metadata['doc']}: {f.name} = {getattr(fault, f.name):g}{unit and ' ' + unit}")
    return "; ".join(rules) or "the pixels that the fault acts on"


def mask_layers(
    faults: Mapping[str, Fault],
    drawn: Mapping[str, Params],
    context: FaultContext,
    effects: Mapping[str, Mask],
) -> Mask:
    """bool[fault, y, x] in the order of `faults`; classes not in `drawn` are empty."""
    out = np.zeros((len(faults), *context.shape), dtype=bool)
    for k, (name, fault) in enumerate(faults.items()):
        if name not in drawn:
            continue
        mask = effects[name] if fault.effect_mask else fault.footprint(drawn[name], context)
        if mask is not None and spreads(fault, context):
            mask = mask | effects[name]
        if mask is not None:
            out[k] = mask
    return out


def spreads(fault: Fault, context: FaultContext) -> bool:
    """Whether a fault's charge may leave its footprint: in a CCD it overflows along columns, and traps trail it."""
    return _moves(fault) and kind(fault, is_ccd=context.camera.is_ccd) == "footprint and effect"


def union(masks: Mask, faults: Iterable[str], members: Iterable[str]) -> Mask:
    """bool[y, x]: where any of the classes `members` has its mask."""
    chosen = set(members)
    return np.asarray(masks[[name in chosen for name in faults]].any(axis=0))


def outline(mask: Mask) -> Mask:
    """bool[y, x]: the inner border of a mask."""
    solid = mask.astype(np.uint8)
    return mask & (cv2.erode(solid, np.ones((3, 3), np.uint8)) == 0)
