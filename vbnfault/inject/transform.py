"""Inject faults into batches of a training loop. This module needs PyTorch; `vbnfault.torch` names its class."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch.utils.data import get_worker_info

from ..core.errors import InputError, shown
from ..core.process import llvm
from ..scene import keyed_random
from ..scene.config import parse_scene
from .injector import Injected, Injector


class Inject:
    """Put faults into images of a batch; each image has its own draw, keyed by the seed and its number.

    An object can be sent to worker processes; each sets up lens and sensor once for each size of image.

    Parameters
    ----------
    faults
        Tables of the faults by class, as under `[faults]` of a scene.
    camera, image
        Keys of `[camera]` and of `[image]`.
    probability
        Chance of each class in an image, 0 to 1.
    seed
        Seed of all random numbers.
    sun
        Position of the Sun, as for `Injector`; straylight is left out without one. Default: that of `image`.

    Attributes
    ----------
    classes
        The classes of the faults, in the order of the masks.
    left_out
        Why a class that was drawn is not in an image of the last batch of this process, by class.

    Raises
    ------
    InputError
        Camera or faults cannot be used.
    """

    def __init__(
        self,
        faults: Mapping[str, Any],
        *,
        camera: Mapping[str, Any] | None = None,
        image: Mapping[str, Any] | None = None,
        probability: float = 0.5,
        seed: int = 0,
        sun: str | Sequence[float] | None = None,
    ) -> None:
        if not (isinstance(probability, float | int) and 0 <= probability <= 1):
            raise InputError(f"probability = {probability!r}: must be from 0 to 1")
        tables: dict[str, Any] = {"title": "inject", "dataset": {"seed": seed}, "faults": faults}
        tables |= {key: table for key, table in (("camera", camera), ("image", image)) if table}
        self._scene = parse_scene(tables, source="Inject")
        self._probability, self.seed = probability, seed
        self._sun = self._scene.image.sun if sun is None and self._scene.image else sun
        self.classes = tuple(self.injector.faults)
        self.left_out: dict[str, str] = {}

    @cached_property
    def injector(self) -> Injector:
        """Return what injects the faults; each process makes its own."""
        return Injector(self._scene, source="Inject", effects=False)

    def __getstate__(self) -> dict[str, Any]:
        """Return what another process needs."""
        return {key: value for key, value in vars(self).items() if key != "injector"}

    def __call__(
        self,
        images: torch.Tensor,
        numbers: Sequence[int] | torch.Tensor,
        suns: Sequence[str | Sequence[float] | None] | None = None,
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Return images with faults, in the data type of the given ones, and masks.

        Parameters
        ----------
        images
            uint8 or float32 [image, channel, y, x] on the CPU, with 1 channel or R, G, B. White of floats is 1,
            which no fault exceeds.
        numbers
            Number of each image, such as its index in the data set plus the epoch times its length.
        suns
            Position of the Sun for each image; None: `sun`. Where "auto" finds none, there is none.

        Returns
        -------
        tuple
            The images, and bool[image, class, y, x] with the classes in the order of `classes`.

        Raises
        ------
        InputError
            The tensor has another shape, data type or device, or the numbers are not a whole one for each image.
        """
        known = images.dtype in (torch.uint8, torch.float32) and images.device.type == "cpu"
        if images.ndim != 4 or images.shape[1] not in (1, 3) or not known:
            raise InputError(
                f"images: {images.dtype} of shape {list(images.shape)} on {images.device}: must be uint8 or "
                "float32 of [image, channel, y, x] with 1 or 3 channels, on the CPU"
            )
        if get_worker_info() is not None:
            llvm.use_one_thread()
        given = images.detach().contiguous().numpy()
        changed, masks = np.empty_like(given), np.empty((len(given), len(self.classes), *given.shape[2:]), bool)
        places = [self._sun] * len(given) if suns is None else [self._sun if s is None else s for s in suns]
        keys = np.asarray(numbers.cpu() if isinstance(numbers, torch.Tensor) else numbers)
        if not keys.shape == (len(given),) == (len(places),):
            raise InputError(
                f"{len(given)} images: numbers of shape {list(keys.shape)} and {len(places)} Suns; must be one for "
                "each image"
            )
        if keys.size and keys.dtype.kind not in "iuO":  # times of 0.1 s and 0.2 s would get one draw
            raise InputError(f"numbers: {shown(keys.tolist())}: must be whole numbers")
        self.left_out = {}
        for planes, out, mask, number, sun in zip(given, changed, masks, keys, places, strict=True):
            result = self._injected(cv2.merge(list(planes)), int(number), sun)
            cv2.split(result.image, list(out))
            if given.dtype.kind == "f":
                np.clip(out, np.minimum(planes, 0), np.maximum(planes, 1), out=out)
            mask[...] = result.masks
            self.left_out |= result.left_out
        return torch.from_numpy(changed), torch.from_numpy(masks)

    def _injected(self, image: NDArray[Any], number: int, sun: str | Sequence[float] | None) -> Injected:
        """Return an image with the classes that its number draws."""
        chance = keyed_random.rng(self.seed, number, "inject", "classes").random(len(self.classes))
        chosen = [name for name, p in zip(self.classes, chance, strict=True) if p < self._probability]
        try:
            return self.injector(image, number, sun=sun, commanded=chosen)
        except InputError:
            if sun != "auto":
                raise
            return self.injector(image, number, sun="none", commanded=chosen)
