"""Read stores for training: crops with their labels, mixed from several stores, in an order resumed anywhere.

What is not changed in an image is as much a choice as what is:

- A crop shows the same sensor and the same faults, so every image of a store gives another crop in each epoch.
- A mirrored image is possible only where every fault acts on the light: lenses and dirt know no left and right.
  Behind the sensor's surface they exist: charge, smear, lines and trails run in the direction of the readout, and a
  network must not learn the other one. Top and bottom differ for both, since bodies lie below.
- Brightness, colour and sharpness stay as they are. They are what exposure, filters and lens made of the light, and
  dust, veils and blur are deviations from them.
- Half of the images get a black level of up to 12 DN and noise of up to 1.5 DN. A rendered sky is exactly black
  where the sensor's black level is subtracted, one of a real camera is not: the sky of frames of Rosetta's NAVCAM
  has 3 to 10 DN. A network that has never seen such takes all of it for a veil.
"""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Iterator, Mapping, Sequence
from functools import cached_property
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from ..core.errors import InputError
from ..faults import registry
from ..scene.keyed_random import keyed_uniform
from ..store import Store, open_store
from ..train import Columns
from ..train.datasets import BatchDataset, SampleDataset
from ..train.loader import Loader
from ..train.selection import known_classes
from .severity_labels import severity_labels

Batch = dict[str, Any]
CROP_PX = 256  # by default
LEAST_CROP_PX = 32
_MOST_WEIGHT = 10.0
_COUNTED = 64  # samples of each store that are read for it
_MOST_BLACK_LEVEL_DN, _MOST_NOISE_DN = 12.0, 1.5
_LIGHT = {"light", "electrons"}  # the steps of a fault before the sensor


class Labelled:
    """Make what a network is taught from a sample of a store: a crop, maybe mirrored, with its labels.

    It is the `transform` of a `SampleDataset`. The result has

    - `image`: uint8[4, y, x];
    - `masks`: bool[class, y, x];
    - `present`: float32[class], 1 where the class is in the pixels; in a crop, where its mask is;
    - `severity`: float32[class], the level of the image's fault, 0 where it is not present, nan where unknown;
    - `usable`: float32, the fraction of pixels outside `mask_any`.

    Parameters
    ----------
    severity
        Levels of the classes by sample.
    crop_px
        Side of the crop; None: the whole image.
    mirrored
        Whether half of the images are mirrored, left to right.
    raised
        Whether half of the images get another black level and more noise.
    """

    def __init__(
        self,
        severity: Mapping[int, NDArray[np.float32]],
        crop_px: int | None = None,
        *,
        mirrored: bool = False,
        raised: bool = False,
    ) -> None:
        self.severity, self.crop_px, self.mirrored, self.raised = severity, crop_px, mirrored, raised

    def __call__(self, sample: Batch) -> Batch:
        """Return the crop of a sample and its labels."""
        planes = [sample["image"], sample["masks"], sample["mask_any"]]
        present = sample["classes"]
        height, width = planes[0].shape[-2:]
        if self.crop_px is not None:
            first = [int(torch.randint(size - self.crop_px + 1, ())) for size in (height, width)]
            y, x = (slice(at, at + self.crop_px) for at in first)
            planes = [plane[..., y, x] for plane in planes]
            if (height, width) != (self.crop_px, self.crop_px):
                present = present * planes[1].flatten(1).any(1)
        if self.mirrored and torch.rand(()) < 0.5:
            planes = [plane.flip(-1) for plane in planes]
        if self.raised and torch.rand(()) < 0.5:
            planes[0] = _raised(planes[0])
        level = torch.from_numpy(self.severity[int(sample["sample"])])
        return {
            "image": planes[0],
            "masks": planes[1],
            "present": present,
            "severity": torch.where(present > 0, level, 0.0),
            "usable": 1 - planes[2].float().mean(),
        }


def _raised(image: torch.Tensor) -> torch.Tensor:
    """Return an image uint8[4, y, x] as that of a camera with a higher black level and more noise."""
    level, noise = torch.rand(2) * torch.tensor([_MOST_BLACK_LEVEL_DN, _MOST_NOISE_DN])
    return (image + level + noise * torch.randn(image.shape)).round().clamp(0, 255).to(torch.uint8)


def may_be_mirrored(store: Store) -> bool:
    """Return whether images of a store may be mirrored: all its faults, injected or not, act on the light."""
    models = store.attributes.get("fault_models", {})
    known = [registry().get(fault, {}).get(models.get(fault, "")) for fault in store.spec.faults]
    return all(model is not None and _LIGHT.issuperset(model.steps) for model in known)


class TrainingData:
    """Hold the training and validation samples of one or several stores.

    Parameters
    ----------
    stores
        Paths or URLs of stores: built, injected, or both.
    classes
        Classes that the network is to find; by default those that all stores have, in the order of the first.
    masks
        "effect" or "footprint": what the network learns to mark.
    crop_px
        Side of the crops; by default 256, or the shortest side of all images if this is less.
    batch_size
        Images of a batch.
    seed
        Of order, crops and mirror images.
    workers
        Processes that read; 0 reads in this one.

    Attributes
    ----------
    train, val
        The samples of each store. A store without a validation split has none there.

    Raises
    ------
    InputError
        If a store cannot be used, lacks a class or has no sample to train with, or the crop does not fit.
    """

    def __init__(
        self,
        stores: Sequence[str],
        classes: Sequence[str] | None,
        masks: str,
        crop_px: int | None,
        batch_size: int,
        seed: int,
        workers: int = 0,
    ) -> None:
        if not stores:
            raise InputError("no dataset is named; must be at least one store")
        opened = [open_store(path) for path in stores]
        self.stores, self.batch_size, self.seed, self.workers = opened, batch_size, seed, workers
        self.classes, self.masks = _classes(opened, classes), masks
        shortest = min(min(store.spec.height, store.spec.width) for store in opened)
        if shortest < LEAST_CROP_PX:
            raise InputError(f"images of {shortest} px: the shortest side must be at least {LEAST_CROP_PX} px")
        self.crop_px = min(CROP_PX, shortest) if crop_px is None else crop_px
        if not LEAST_CROP_PX <= self.crop_px <= shortest:
            raise InputError(
                f"crop_px = {self.crop_px}: must be from {LEAST_CROP_PX} to {shortest}, the shortest side of "
                "the images"
            )
        self._levels = [self._severity(store) for store in opened]
        self.train = [self._samples(k, "train") for k in range(len(opened))]
        self.val = [self._samples(k, "val") for k in range(len(opened)) if "val" in Columns(opened[k])["split"]]
        if not self.val:
            logging.getLogger("vbnfault").warning(
                "no dataset has a validation split: the training does not end early, and its last weights count"
            )

    def _severity(self, store: Store) -> dict[int, NDArray[np.float32]]:
        """Return the levels of severity of all finished samples of a store."""
        samples = Columns(store).samples
        return dict(zip(samples.tolist(), severity_labels(store, samples, self.classes), strict=True))

    def _samples(self, number: int, split: str) -> SampleDataset:
        """Return the samples of a split of a store: crops to train with, whole images to validate."""
        store = self.stores[number]
        crop = self.crop_px if split == "train" else None
        varied = crop is not None
        label = Labelled(self._levels[number], crop, mirrored=varied and may_be_mirrored(store), raised=varied)
        targets = ("masks", "classes", "mask_any")
        return SampleDataset(
            str(store.path), split, targets, classes=self.classes, masks=self.masks, transform=label
        )

    @property
    def images(self) -> int:
        """Return the number of images of an epoch."""
        return sum(map(len, self.train))

    @property
    def steps(self) -> int:
        """Return the number of batches of an epoch; the images that make no whole one are left out of it."""
        return max(1, self.images // self.batch_size)

    def sequence(self, epoch: int) -> NDArray[np.int64]:
        """Return from which store each image of an epoch comes, int64[image].

        The stores are spread evenly over the epoch, so that each batch holds as much of each as the epoch does.
        """
        place = [
            (np.arange(len(data)) + keyed_uniform(self.seed, np.arange(len(data)), f"epoch {epoch}", f"store {k}"))
            / len(data)
            for k, data in enumerate(self.train)
        ]
        of = np.repeat(np.arange(len(place)), [len(one) for one in place])
        return of[np.argsort(np.concatenate(place), kind="stable")]

    @cached_property
    def _loaders(self) -> list[Loader]:
        """Return a loader for each store, which gives one image at a time."""
        share = [len(range(k, self.workers, len(self.train))) for k in range(len(self.train))]
        orders = [BatchDataset(data, batch_size=1, seed=self.seed) for data in self.train]
        return [Loader(order, num_workers=count) for order, count in zip(orders, share, strict=True)]

    def batches(self, epoch: int, first: int = 0) -> Iterator[Batch]:
        """Yield the batches of an epoch from a number on, the same ones at each call."""
        stores = self.sequence(epoch)
        size = min(self.batch_size, len(stores))
        used = np.bincount(stores[: first * size], minlength=len(self.train))
        images = []
        for loader, count in zip(self._loaders, used.tolist(), strict=True):
            loader.load_state_dict(loader.batches.order.state(epoch, count))
            images.append(iter(loader))
        for k in range(first, self.steps):
            batch = [next(images[store]) for store in stores[k * size : (k + 1) * size].tolist()]
            yield {name: torch.cat([image[name] for image in batch]) for name in batch[0]}

    def validation(self) -> Iterator[Batch]:
        """Yield whole images to validate with, in batches of about as many pixels as those of the training."""
        for data in self.val:
            spec = data.targets.spec
            size = max(1, self.batch_size * self.crop_px**2 // (spec.height * spec.width))
            yield from Loader(BatchDataset(data, batch_size=size, shuffle=False))

    def pixel_weights(self) -> torch.Tensor:
        """Return the weight of pixels in a mask of each class, float32[class]: √(pixels outside / inside), 1 to 10.

        The square root lies between no balance, with which thin lines are not marked for long, and the whole ratio,
        with which neighbourhoods are marked. All stores count by their images.
        """
        counted = [inside / total for inside, total in (data.mask_pixels(_COUNTED) for data in self.train)]
        inside = np.average(counted, axis=0, weights=[len(data) for data in self.train])
        weight = np.sqrt((1 - inside) / np.maximum(inside, 1e-9)).clip(1, _MOST_WEIGHT)
        return torch.from_numpy(weight.astype(np.float32))

    def identity(self) -> list[dict[str, Any]]:
        """Return for each store what it is called, what it is, and how many images of it are used.

        `checksums_sha256` is over the stored checksums of all layers and numbers of all samples: equal for equal
        content, and read in milliseconds.
        """
        out = []
        for k, store in enumerate(self.stores):
            checksums = hashlib.sha256(str(store.attributes.get("scene_hash")).encode())
            checksums.update(np.ascontiguousarray(store.read("crc32c")).tobytes())
            val = [data for data in self.val if data.path == self.train[k].path]
            out.append(
                {
                    "name": store.path.name,
                    "title": store.attributes.get("title", ""),
                    "checksums_sha256": checksums.hexdigest(),
                    "train": len(self.train[k]),
                    "val": len(val[0]) if val else 0,
                    "mirrored": may_be_mirrored(store),
                }
            )
        return out


def _classes(stores: Sequence[Store], asked: Sequence[str] | None) -> tuple[str, ...]:
    """Return the classes to find. Raises InputError if a store lacks one, or no class is left."""
    if asked is None:
        shared = [name for name in stores[0].spec.faults if all(name in s.spec.faults for s in stores)]
        if not shared:
            raise InputError(f"{stores[0].path}: has no fault class that all datasets have")
        return tuple(shared)
    if not asked:
        raise InputError("classes = []: must name at least one class, and none twice")
    for store in stores:
        known_classes(store, asked, "classes")
    return tuple(asked)
