"""Read windows of frames that follow each other in a sequence, for networks that see more than one image."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from torch.utils.data import Dataset

from ..core.errors import InputError, shown
from ..store import open_store
from .datasets import Batch, SampleDataset
from .selection import Columns


class WindowDataset(Dataset[Batch]):
    """Read windows of consecutive frames, dictionaries of tensors with a first axis of frames: a map-style dataset.

    A window lies in one sequence, and no frame of it is missing among the samples of `data`. A `DataLoader` makes
    batches of windows of it, `image` uint8[window, frame, 4, y, x].

    Parameters
    ----------
    data
        The samples. It has no `transform`, which would change each frame by itself.
    frames
        Number of frames of a window.
    step
        Frames from the beginning of one window to that of the next.
    transform
        Called with each window; returns what becomes of it.

    Raises
    ------
    InputError
        If the store has no sequences, or none is long enough.
    """

    def __init__(
        self, data: SampleDataset, frames: int, *, step: int = 1, transform: Callable[[Batch], Any] | None = None
    ) -> None:
        store = open_store(data.path)
        for name, value in (("frames", frames), ("step", step)):
            if type(value) is not int or value < 1:
                raise InputError(f"{name} = {shown(value)}: must be a whole number of at least 1")
        if data.transform is not None:
            raise InputError("transform: changes each frame by itself; give it to WindowDataset, for whole windows")
        if not store.spec.sequence_names:
            raise InputError(f"{store.path}: has no sequences")
        columns = Columns(store)
        place = np.searchsorted(columns.samples, data.samples)
        sequence, frame = (columns[name][place].astype(np.int64) for name in ("sequence", "frame"))
        order = np.lexsort((frame, sequence))
        sequence, frame = sequence[order], frame[order]
        first = np.arange(max(0, len(order) - frames + 1))
        last = first + frames - 1
        whole = (sequence[first] == sequence[last]) & (frame[last] - frame[first] == frames - 1)
        starts = first[whole & (frame[first] % step == 0)]
        if not len(starts):
            raise InputError(
                f"{store.path}: frames = {frames}, step = {step}: no sequence has as many frames side by side, "
                "from one whose number is a multiple of step"
            )
        self.data, self.transform = data, transform
        self.positions = order[starts[:, None] + np.arange(frames)]

    def __len__(self) -> int:
        """Return the number of windows."""
        return len(self.positions)

    def __getitem__(self, window: int) -> Batch:
        """Return a window."""
        return self.__getitems__([window])[0]

    def __getitems__(self, windows: Sequence[int]) -> list[Batch]:
        """Return several windows; a `DataLoader` calls this for a batch."""
        chosen = self.positions[list(windows)]
        samples = self.data.__getitems__(chosen.ravel().tolist())
        size = chosen.shape[1]
        out = []
        for k in range(len(chosen)):
            part = samples[k * size : (k + 1) * size]
            window = {name: torch.stack([sample[name] for sample in part]) for name in part[0]}
            out.append(window if self.transform is None else self.transform(window))
        return out
