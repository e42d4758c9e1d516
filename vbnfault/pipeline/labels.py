"""Label a sample: compute the masks of its faults, their effects, and how strongly they act on each pixel."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.quantities import soft_kind
from ..faults import Fault
from . import masks
from .development import moved, movers
from .spec import Injection, Labels, SampleSpec, mask_any_faults, stored_layers


def label(spec: SampleSpec, injection: Injection) -> Labels:
    """Compute the masks of every class by footprint or by effect, and the effects and strengths that are stored."""
    return labels_of(
        spec.faults,
        injection,
        mask_any_faults(spec.scene, spec.faults),
        stored_layers(spec.scene, spec.faults),
    )


def labels_of(
    faults: Mapping[str, Fault], injection: Injection, members: Sequence[str], layers: Sequence[str]
) -> Labels:
    """Return the labels of an image: `members` are the classes united in mask_any, `layers` the optional layers."""
    draws, development = injection.draws, injection.development
    behind = {name: movers(draws, name) for name in draws}
    changed = {
        name: development.effect(draws, name, draw.fault.effect_level_dn)
        for name, draw in draws.items()
        if draw.fault.effect_mask or masks.spreads(draw.fault, development.context) or behind[name]
    }
    together = [name for name in members if name in draws]
    params = {name: draw.params for name, draw in draws.items()}
    soft = {fault.soft_layer: fault for fault in faults.values() if fault.soft_layer}
    moves = {name: partial(moved, draws=draws, names=names) for name, names in behind.items() if names}
    its_masks = masks.mask_layers(faults, params, development.context, changed, moves)
    mask_any = masks.union(its_masks, faults, together)
    if together:
        mask_any |= development.joint_effect(draws, together)
    return Labels(
        masks=its_masks,
        mask_any=mask_any,
        effects={name: development.effect(draws, name) for name in draws} if "mask_effect" in layers else {},
        strengths={layer: strength(soft[layer], injection) for layer in layers if layer in soft},
    )


def strength(fault: Fault, injection: Injection) -> NDArray[Any]:
    """Return how strongly a fault acts on each pixel, [y, x], in the data type of its soft layer."""
    kind, development = soft_kind(fault.soft_layer), injection.development
    draw = injection.draws.get(fault.fault)
    if draw is None:
        return np.full(development.context.shape, kind.neutral, dtype=kind.dtype)
    strength = fault.soft(draw.params, development.context_of(fault, injection.draws))
    strength = moved(strength, injection.draws, movers(injection.draws, fault.fault))
    return np.asarray(strength).astype(kind.dtype)
