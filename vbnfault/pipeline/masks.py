"""Compute the masks of faults: the pixels on which a fault acts, or the pixels that it changes.

The mask of a class is its *footprint*. Classes that label by *effect* (straylight) are the exception. Their mask is
the pixels of the noise-free image that change by at least `Fault.effect_level_dn` DN (1 by default) when the fault
is switched off. So where a broken line or saturation overwrites a flare, the mask of the flare is empty. In a CCD
charge may leave the footprint of a fault, and effects such as compression spread what happens to a pixel; then the
mask is the union of footprint and effect.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Mapping
from functools import lru_cache
from types import MappingProxyType

import cv2
import numpy as np
from numpy.typing import NDArray

from ..camera import Camera
from ..faults import Fault, FaultContext, Params

Mask = NDArray[np.bool_]

# Steps of a mosaic detector after which charge may still leave the pixels on which a fault acts, and those after
# which effects of a sensor may spread what it does.
_MOVES = {"light", "pixels", "charge"}
_SPREADS = {*_MOVES, "offsets"}


def effect(image: NDArray[np.uint8], without: NDArray[np.uint8], least_dn: float = 1.0) -> Mask:
    """Return where two noise-free 8 bit images differ by `least_dn` or more in any channel, bool[y, x]."""
    # compare the four 8 bit channels as one 32 bit word
    if least_dn > 1:
        return np.asarray((cv2.absdiff(image, without) >= least_dn).view(np.uint32)[..., 0] != 0)
    a, b = (np.ascontiguousarray(x).view(np.uint32)[..., 0] for x in (image, without))
    return np.asarray(a != b)


def kind(fault: Fault, camera: Camera) -> str:
    """Return what the mask of a fault is: "footprint", "effect", "footprint and effect" or "strong effect".

    A strong effect is one whose threshold is above 1 DN.
    """
    if fault.effect_mask:
        return "effect" if fault.effect_level_dn <= 1 else "strong effect"
    return "footprint and effect" if _leaves(fault, camera) else "footprint"


def _leaves(fault: Fault, camera: Camera) -> bool:
    """Return whether a fault acts at a step after which its signal may still leave the pixels."""
    if _SPREADS.isdisjoint(fault.steps):
        return False
    mosaic = camera.detector.mosaic
    if mosaic is not None and any(effect.spreads for effect in mosaic.sensor.effects):
        return True
    return camera.is_ccd and not _MOVES.isdisjoint(fault.steps)


def footprint_rule(fault: Fault) -> str:
    """Return a text that says which pixels the mask of a fault holds, with its thresholds (fields mask_*)."""
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
    moves: Mapping[str, Callable[[Mask], Mask]] = MappingProxyType({}),
) -> Mask:
    """Return the masks of all classes, bool[fault, y, x], in the order of `faults`.

    Classes that are not in `drawn` have empty masks. `effects` holds the effect masks, bool[y, x], of the classes
    that need them. `moves` are the movements of footprints by faults behind these classes; demosaicing may change
    other neighbours there, so the effect is added.
    """
    if not drawn:
        return no_masks((len(faults), *context.shape))
    out = np.zeros((len(faults), *context.shape), bool)
    for k, (name, fault) in enumerate(faults.items()):
        if name not in drawn:
            continue
        mask = effects[name] if fault.effect_mask else fault.footprint(drawn[name], context)
        if mask is not None and not fault.effect_mask and name in moves:
            mask = moves[name](mask) | effects[name]
        elif mask is not None and spreads(fault, context):
            mask = mask | effects[name]
        if mask is not None:
            out[k] = mask
    return out


@lru_cache(maxsize=1)
def no_masks(shape: tuple[int, ...]) -> Mask:
    """Return empty masks, bool[fault, y, x], read-only, since samples without faults share them."""
    out = np.zeros(shape, dtype=bool)
    out.flags.writeable = False
    return out


def spreads(fault: Fault, context: FaultContext) -> bool:
    """Return whether a fault's signal may leave its footprint.

    In a CCD, charge overflows along columns and traps make trails; some sensors have effects that spread it.
    """
    return not fault.effect_mask and _leaves(fault, context.camera)


def union(masks: Mask, faults: Iterable[str], members: Iterable[str]) -> Mask:
    """Return where any of the classes `members` has its mask, bool[y, x]."""
    chosen, out = set(members), np.zeros(masks.shape[1:], dtype=bool)
    for name, mask in zip(faults, masks, strict=True):
        if name in chosen:
            out |= mask
    return out


def outline(mask: Mask) -> Mask:
    """Return the inner border of a mask, bool[y, x]."""
    solid = mask.astype(np.uint8)
    return mask & (cv2.erode(solid, np.ones((3, 3), np.uint8)) == 0)
