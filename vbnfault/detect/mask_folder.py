"""Read the predicted masks of any other program: PNG files of 8 bits, one for each class and sample."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..core.errors import InputError, in_file
from ..core.files.images import png_numbers
from ..core.files.user_files import read_input
from ..store import MASK_RULES, Store
from .prediction import Prediction

MODEL_FILE = "model.json"  # a folder with it holds a detector
CHECKPOINT_FILE = "checkpoint.pt"  # and one with this a training
_MOST_REST_BYTES = 1 << 20  # of a PNG besides its pixels


class MaskFolder:
    """Give the masks in a folder as predictions.

    The files are `CLASS/SAMPLE.png`, SAMPLE being the index of the sample in the store, with or without leading
    zeros. They may also lie in `SPLIT/mask/CLASS/`, as `vbnfault export --format png` writes them. A value of
    0 to 255 is a probability of 0 to 1. The greatest one of an image says whether the class is present. A class of
    the store without a folder counts as never predicted.

    Parameters
    ----------
    path
        The folder.
    store
        The store whose samples the masks are of.
    samples
        Indices of the samples that are needed.
    splits
        The split of each of them.
    masks
        "footprint" or "effect": which of an export's masks are read.

    Raises
    ------
    InputError
        There is no folder of a class, or no mask of a sample.
    """

    def __init__(
        self,
        path: Path,
        store: Store,
        samples: Sequence[int],
        splits: Sequence[str],
        masks: str = "footprint",
    ) -> None:
        self.masks = masks
        self.path, self._shape = path, (store.spec.height, store.spec.width)
        inside = {split: path / split / MASK_RULES[masks] for split in dict.fromkeys(splits)}
        self._root = {split: folder if folder.is_dir() else path for split, folder in inside.items()}
        self.classes = tuple(
            name for name in store.spec.faults if any((root / name).is_dir() for root in self._root.values())
        )
        if not self.classes and (path / CHECKPOINT_FILE).is_file():
            raise InputError(f"{path}: holds a training that is not finished; the same command continues it")
        if not self.classes:
            raise InputError(
                f"{path}: is no detector, for it has no {MODEL_FILE}, and no folder of masks; masks are files "
                f"CLASS/SAMPLE.png with one of the classes {', '.join(store.spec.faults)}"
            )
        files = {
            (split, name): _numbered(root / name) for split, root in self._root.items() for name in self.classes
        }
        for of_class in files.values():
            if of_class and max(of_class) >= store.samples:
                raise InputError(
                    f"{of_class[max(of_class)]}: {store.path} has the samples 0 to {store.samples - 1} only; these "
                    "are masks of another dataset"
                )
        self._files: dict[tuple[int, str], Path] = {}
        for sample, split in zip(samples, splits, strict=True):
            for name in self.classes:
                file = files[split, name].get(int(sample))
                if file is None:
                    expected = self._root[split] / name / f"{int(sample):06d}.png"
                    raise InputError(f"{expected}: there is no mask of sample {sample}; each sample needs one")
                self._files[int(sample), name] = file

    @property
    def sha256(self) -> str:
        """Return a digest of the masks of the needed samples, whatever their folders are called (hex)."""
        total = hashlib.sha256()
        for (sample, name), file in sorted(self._files.items()):
            total.update(f"{name}/{sample}\0".encode() + hashlib.sha256(read_input(file, "image")).digest())
        return total.hexdigest()

    def predicted(self, samples: Sequence[int], images: NDArray[np.uint8]) -> list[Prediction]:
        """Return the masks of samples. Raises InputError if a file is no grey PNG of the store's size."""
        return [self._prediction(int(sample)) for sample in samples]

    def _prediction(self, sample: int) -> Prediction:
        """Return the masks of one sample."""
        masks = np.stack([self._mask(self._files[sample, name]) for name in self.classes])
        unknown = np.full(len(masks), np.nan, np.float32)
        present = masks.max(axis=(1, 2), initial=0)
        return Prediction(masks=masks, present=present, severity=unknown, usable_fraction=float("nan"))

    def _mask(self, file: Path) -> NDArray[np.float32]:
        """Return the probabilities in a file, float32[y, x]."""
        height, width = self._shape
        with in_file(str(file)):
            data = read_input(file, "image", limit_bytes=8 * height * width + _MOST_REST_BYTES)
            numbers = png_numbers(data, 4 * height * width)
            if numbers.shape[2] != 1 or numbers.dtype != np.uint8:
                raise InputError("a mask must be a grey PNG of 8 bits, 255 for a probability of 1")
            if numbers.shape[:2] != self._shape:
                rows, columns = numbers.shape[:2]
                raise InputError(
                    f"has {columns} x {rows} pixels; must be {width} x {height}, as the store's images"
                )
            return np.asarray(numbers[..., 0], np.float32) / np.float32(255)


def _numbered(folder: Path) -> dict[int, Path]:
    """Return the PNG files of a folder by their number. Raises InputError if two have the same one."""
    files: dict[int, Path] = {}
    for file in sorted(folder.glob("*.png")) if folder.is_dir() else ():
        if file.stem.isascii() and file.stem.isdigit():
            other = files.setdefault(int(file.stem), file)
            if other != file:
                raise InputError(f"{file}: is a mask of the same sample as {other.name}; remove one of them")
    return files
