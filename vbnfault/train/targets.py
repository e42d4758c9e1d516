"""Make what a trainer asks for (image, masks, classes, pose, …) out of the layers and scalars of a store."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..core.errors import InputError, shown
from ..store import MASK_RULES, Store
from .selection import known_classes


class Target(NamedTuple):
    """Describe one target: the layer or the scalars that it is made of, and what it holds."""

    layer: str
    scalars: tuple[str, ...]
    meaning: str


# `masks` and `instances` read the layer that `masks=` names
TARGETS: dict[str, Target] = {
    "image": Target("image", (), "uint8[4, y, x]: R, G, B, I with faults; always there"),
    "clean": Target("clean", (), "uint8[4, y, x]: the same without faults"),
    "classes": Target("", ("injected",), "float32[fault]: 1 where a fault is in the pixels"),
    "masks": Target("mask", (), "bool[fault, y, x]: footprint or effect of each fault"),
    "instances": Target("mask", (), "int32[fault, y, x]: 0, or the number of a grain, defect, flare or track"),
    "semantic": Target("semantic", (), "uint8[y, x]: 0 sky, 1 body, 2 Sun, 3 spacecraft"),
    "depth": Target("depth_m", (), "float32[y, x]: m along the boresight, inf on the sky"),
    "normal": Target("normal", (), "float16[3, y, x]: surface normal in C, 0 on the sky"),
    "pose": Target(
        "", ("camera_position_T_m", "camera_from_T"), "float64[7]: position in T in m, unit quaternion, w first"
    ),
}
_LAST_AXIS = ("channel", "xyz", "xy")  # dimensions that a layer has last and a trainer first


class Targets:
    """Hold the chosen targets of a store.

    Parameters
    ----------
    store
        An open store.
    names
        Names in `TARGETS`, or of any other layer or number of the store. `image` is always added.
    classes
        Fault classes on the axis of `classes`, `masks` and `instances`, in this order; by default all.
    masks
        "footprint" or "effect": which mask `masks` and `instances` hold.

    Attributes
    ----------
    layers
        Layers to read.
    scalars
        Scalars to read.
    """

    def __init__(
        self,
        store: Store,
        names: Sequence[str],
        classes: Sequence[str] | None = None,
        masks: str = "footprint",
    ) -> None:
        self.spec = store.spec
        if not isinstance(names, str | Iterable):
            raise InputError(f"targets = {shown(names)}: must be a list of names")
        self.names = tuple(dict.fromkeys(["image", *((names,) if isinstance(names, str) else names)]))
        self.classes = store.spec.faults if classes is None else known_classes(store, classes, "classes")
        if masks not in tuple(MASK_RULES):
            raise InputError(f"masks = {shown(masks)}: must be one of {', '.join(MASK_RULES)}")
        self._of: dict[str, Target] = {name: self._target(store, name, MASK_RULES[masks]) for name in self.names}
        self._chosen = (
            None if self.classes == store.spec.faults else list(map(store.spec.faults.index, self.classes))
        )
        self._localised = [name in (store.spec.localised_faults or ()) for name in self.classes]
        self.layers = tuple(dict.fromkeys(target.layer for target in self._of.values() if target.layer))
        self.scalars = tuple(dict.fromkeys(scalar for target in self._of.values() for scalar in target.scalars))

    def _target(self, store: Store, name: str, mask: str) -> Target:
        """Return the description of a target. Raises InputError if the store cannot give it."""
        target = TARGETS.get(name)
        if target is None and name in store.spec.pixel_layers:
            target = Target(name, (), "")
        if target is None and name in store.spec.scalars and not store.spec.scalars[name].is_text:
            target = Target("", (name,), "")
        if target is None:
            from ..core.tables import did_you_mean  # not above: its import takes longer than all others here

            known = list(dict.fromkeys([*TARGETS, *store.spec.pixel_layers]))
            raise InputError(
                f"targets: {shown(name)} is no target, and no layer or number of the store"
                f"{did_you_mean(str(name), known)}"
            )
        if name in ("masks", "instances"):
            target = target._replace(layer=mask)
        if target.layer and target.layer not in store.spec.pixel_layers:
            raise InputError(
                f"{store.path}: it has no layer {target.layer}, which {name} needs; add it to dataset.layers and "
                "build the dataset again"
            )
        return target

    def buffers(self, count: int) -> dict[str, tuple[tuple[int, ...], np.dtype[Any]]]:
        """Return shape and dtype of the array into which each layer of `count` samples is decoded."""
        rows = {name: self.spec.pixel_layers[name] for name in self.layers}
        return {name: ((count, *self.spec.shape(row)), np.dtype(row.dtype)) for name, row in rows.items()}

    def make(
        self,
        layers: Mapping[str, Any],
        scalars: Mapping[str, NDArray[Any]],
        move_axis: Callable[[Any, int, int], Any] = np.moveaxis,
    ) -> dict[str, Any]:
        """Return the targets of a batch by name; layers become views where possible.

        `layers` may be arrays of another library that are indexed like NumPy's; `move_axis` is its `moveaxis`.
        """
        batch: dict[str, Any] = {}
        for name, target in self._of.items():
            if name == "classes":
                batch[name] = self._of_classes(scalars["injected"]).astype(np.float32)
            elif name == "instances":
                batch[name] = self._instances(np.asarray(self._of_classes(layers[target.layer])))
            elif target.layer:
                row, values = self.spec.pixel_layers[target.layer], layers[target.layer]
                if "fault" in row.dims:
                    values = self._of_classes(values)
                batch[name] = move_axis(values, -1, 1) if row.dims[-1] in _LAST_AXIS else values
            else:
                parts = [scalars[scalar] for scalar in target.scalars]
                batch[name] = parts[0] if len(parts) == 1 else np.concatenate(parts, axis=1)
        return batch

    def _of_classes(self, values: Any) -> Any:
        """Return an array with only the chosen classes on its axis 1."""
        return values if self._chosen is None else values[:, self._chosen]

    def _instances(self, masks: NDArray[np.bool_]) -> NDArray[np.int32]:
        """Return for each pixel the number of its instance, int32[sample, fault, y, x], 0 outside the masks."""
        out = np.zeros(masks.shape, dtype=np.int32)
        for i, of_sample in enumerate(masks):
            for k, mask in enumerate(of_sample):
                if mask.any():
                    out[i, k] = regions(mask) if self._localised[k] else mask
        return out


def regions(mask: NDArray[np.bool_]) -> NDArray[np.int32]:
    """Return the number of the connected region of each pixel, int32[y, x], from 1 on; 0 outside the mask.

    Pixels that touch at a side or a corner are connected. The regions are in the order of their first pixel, row by
    row.
    """
    import cv2  # only for instances: a worker that reads masks starts without it

    count, labels = cv2.connectedComponents(mask.view(np.uint8), connectivity=8, ltype=cv2.CV_32S)
    inside = labels[mask]
    first = np.full(count, inside.size, dtype=np.int64)
    np.minimum.at(first, inside, np.arange(inside.size))
    number = np.zeros(count, dtype=np.int32)
    number[np.argsort(first[1:], kind="stable") + 1] = np.arange(1, count)
    return number[labels]
