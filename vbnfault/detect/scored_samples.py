"""Read samples of a store together with what a detector, or a folder of masks, says about them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..core.errors import InputError, VbnfaultError, shown
from ..store import MASK_RULES, SPLITS, Store
from ..train import Columns, SampleReader, Targets
from .mask_folder import MaskFolder
from .prediction import Detector, Prediction
from .scores import binned

I64 = NDArray[np.int64]

ALL, FOOTPRINT, EFFECT = "all", "footprint", "effect"


@dataclass(frozen=True, kw_only=True)
class ScoreOptions:
    """Say how a detector is scored.

    Attributes
    ----------
    split
        "train", "val", "test" or "all".
    masks
        "footprint" or "effect": which masks of the store are the truth; "": those that the detector learned, and
        footprints for a folder of masks.
    calibrate
        Take the threshold of each class that has the best F1 on the split val, instead of 0.5.
    navigation
        Whether to measure the errors of navigation, which takes longest.
    name
        Name in the score; "": that of the model's file or folder.
    batch
        Samples that are held at once.
    seed
        Of the bootstrap.
    """

    split: str = "test"
    masks: str = ""
    calibrate: bool = False
    navigation: bool = True
    name: str = ""
    batch: int = 4
    seed: int = 0

    def __post_init__(self) -> None:
        if self.split not in (*SPLITS, ALL):
            raise InputError(f"split = {shown(self.split)}: must be one of {', '.join((*SPLITS, ALL))}")
        if self.masks not in ("", *MASK_RULES):
            raise InputError(f"masks = {shown(self.masks)}: must be one of {', '.join(MASK_RULES)}")
        if self.calibrate and self.split in ("val", ALL):
            raise InputError(
                f"calibrate: the thresholds are chosen on the split val, so split = {self.split} cannot be scored "
                "with them; score test"
            )


@dataclass(frozen=True)
class OfImages:
    """Make a predictor of a detector, which sees only the images."""

    detector: Detector
    sha256: str = ""

    @property
    def masks(self) -> str:
        """Return what the detector learned to mark."""
        return str(getattr(self.detector, "masks", FOOTPRINT))

    @property
    def classes(self) -> tuple[str, ...]:
        """Return the classes of the detector."""
        return tuple(self.detector.classes)

    def predicted(self, samples: Sequence[int], images: NDArray[np.uint8]) -> list[Prediction]:
        """Return the detector's predictions for images."""
        return self.detector.predict(images)


class Batch(NamedTuple):
    """Hold some samples: their rows among all that are scored, their layers, scalars and predictions."""

    rows: I64
    samples: list[int]
    layers: dict[str, NDArray[Any]]
    scalars: dict[str, NDArray[Any]]
    predictions: list[tuple[NDArray[np.uint8], Prediction]]


class Samples:
    """Read samples with their predictions, whose classes are brought to those of the store.

    Parameters
    ----------
    store, predictor, options
        What is scored, and how.
    indices
        The samples, int64[n].

    Attributes
    ----------
    masks
        "footprint" or "effect": which masks of the store are the truth.
    """

    def __init__(self, store: Store, predictor: OfImages | MaskFolder, options: ScoreOptions, indices: I64) -> None:
        self.masks = options.masks or predictor.masks
        self.store, self.predictor, self.options, self.indices = store, predictor, options, indices
        self.columns = Columns(store)
        self.place = np.searchsorted(self.columns.samples, indices)
        self.classes = store.spec.faults
        self.known = [self.classes.index(name) for name in predictor.classes if name in self.classes]
        self._given = [k for k, name in enumerate(predictor.classes) if name in self.classes]

    def column(self, name: str) -> NDArray[Any]:
        """Return a scalar of all samples."""
        return self.columns[name][self.place]

    def batches(
        self, rows: Sequence[int] | I64, names: Sequence[str], *, size: int | None = None, predict: bool = True
    ) -> Iterator[Batch]:
        """Yield batches of some rows with named targets; their arrays hold until the next one.

        `size`: samples of a batch, by default those of the options; `predict`: whether predictions are needed.
        """
        targets = Targets(self.store, names, masks=self.masks)
        reader, wanted = SampleReader(self.store, targets, threads=2), np.asarray(rows, dtype=np.int64)
        size = max(1, min(size or self.options.batch, len(wanted)))
        buffers = reader.buffers(size)
        try:
            for first in range(0, len(wanted), size):
                part = wanted[first : first + size]
                samples = self.indices[part].tolist()
                layers = {name: buffer[: len(part)] for name, buffer in buffers.items()}
                scalars = reader.fill(samples, layers, self.indices[wanted[first + size : first + 2 * size]])
                found = self._predictions(samples, layers["image"]) if predict else []
                yield Batch(part, samples, layers, scalars, found)
        finally:
            reader.close()

    def _predictions(
        self, samples: list[int], images: NDArray[np.uint8]
    ) -> list[tuple[NDArray[np.uint8], Prediction]]:
        """Return what `_of_store` makes of the predictions for samples."""
        predictions = self.predictor.predicted(samples, images)
        if len(predictions) != len(samples):
            raise VbnfaultError(f"the detector gives {len(predictions)} predictions for {len(samples)} images")
        return [self._of_store(*pair) for pair in zip(samples, predictions, strict=True)]

    def _of_store(self, sample: int, given: Prediction) -> tuple[NDArray[np.uint8], Prediction]:
        """Return the bins of the masks of the store's classes, uint8[class, y, x], and the same prediction."""
        shape, count = (self.store.spec.height, self.store.spec.width), len(self.predictor.classes)
        expected = {"masks": (count, *shape), "present": (count,), "severity": (count,)}
        for name, wanted in expected.items():
            values = getattr(given, name)
            if values.shape != wanted:
                raise VbnfaultError(f"sample {sample}: {name} has the shape {values.shape}; must be {wanted}")
            if name != "severity" and not (np.min(values, initial=0) >= 0 and np.max(values, initial=0) <= 1):
                raise VbnfaultError(f"sample {sample}: {name} must be probabilities from 0 to 1")
        bins = np.zeros((len(self.classes), *shape), np.uint8)
        present = np.zeros(len(self.classes), np.float32)
        severity = np.full(len(self.classes), np.nan, np.float32)
        bins[self.known] = binned(given.masks[self._given])
        present[self.known], severity[self.known] = given.present[self._given], given.severity[self._given]
        whole = Prediction(
            masks=given.masks, present=present, severity=severity, usable_fraction=given.usable_fraction
        )
        return bins, whole
