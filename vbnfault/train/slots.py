"""Pass batches from worker processes in shared memory that is used again.

By default PyTorch makes a new piece of shared memory for every tensor of every batch. The system then has to
provide its pages one by one, which takes longer than decoding them (1 ms of processor time a MB on the machine on
which this was measured). Here each worker owns a few slots, each large enough for a batch. A slot is taken when the
worker begins a batch, and free again when no tensor of that batch is left in the main process.
"""

from __future__ import annotations

import weakref
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from ..core.errors import VbnfaultError

_ALIGNMENT = 64
# PyTorch passes a tensor in shared memory of its own, which costs as much as copying so many bytes
_SMALL_BYTES = 1 << 16


class Failure(NamedTuple):
    """Carry an error of a worker to the main process as data: PyTorch would add a traceback to its sentence."""

    kind: type[VbnfaultError]
    message: str


class _View(NamedTuple):
    """Describe a tensor in a slot: offset in elements, shape, strides in elements, dtype."""

    offset: int
    shape: tuple[int, ...]
    stride: tuple[int, ...]
    dtype: torch.dtype


def contiguous(shape: tuple[int, ...]) -> tuple[int, ...]:
    """Return the strides, in elements, of a contiguous tensor of a shape."""
    return tuple(torch.empty(shape, device="meta").stride())


class Packed(NamedTuple):
    """Hold a batch as it travels: tensors in the slot as views of it, small ones as arrays, others as they are."""

    worker: int
    slot: int
    values: dict[str, Any]


@dataclass(frozen=True, eq=False)
class Slot:
    """Hold one slot of a worker, which has taken it."""

    worker: int
    number: int
    memory: Tensor

    def tensors(self, buffers: Mapping[str, tuple[tuple[int, ...], np.dtype[Any]]]) -> dict[str, Tensor]:
        """Return tensors of the given shapes in the slot, which must be large enough."""
        out, start = {}, 0
        for name, (shape, dtype) in buffers.items():
            size = int(np.prod(shape)) * dtype.itemsize
            kind = torch.from_numpy(np.empty(0, dtype)).dtype
            out[name] = self.memory[start : start + size].view(kind).view(shape)
            start += _aligned(size)
        return out

    def packed(self, batch: Mapping[str, Any]) -> Packed:
        """Return a batch to be sent; its tensors in this slot are not copied."""
        first, own = self.memory.data_ptr(), self.memory.untyped_storage().data_ptr()
        values: dict[str, Any] = {}
        for name, value in batch.items():
            if isinstance(value, Tensor) and value.untyped_storage().data_ptr() == own:
                offset = (value.data_ptr() - first) // value.element_size()
                value = _View(offset, tuple(value.shape), value.stride(), value.dtype)
            elif isinstance(value, Tensor) and value.nbytes <= _SMALL_BYTES:
                value = value.numpy()
            values[name] = value
        return Packed(self.worker, self.number, values)


class Slots:
    """Hold the slots of all workers of one loader.

    Parameters
    ----------
    workers
        Number of worker processes.
    each
        Slots of each worker.
    size
        Bytes of a slot, see `slot_size`.
    shared
        False: the workers are threads of this process.
    """

    def __init__(self, workers: int, each: int, size: int, *, shared: bool = True) -> None:
        # memory that nobody has written takes no room
        shape = (workers, each, _aligned(max(1, size)))
        if shared:
            storage = torch.UntypedStorage._new_shared(int(np.prod(shape)))
            self._memory = torch.empty(0, dtype=torch.uint8).set_(storage, 0, shape, contiguous(shape))
        else:
            self._memory = torch.empty(shape, dtype=torch.uint8)
        self._taken = torch.zeros(workers, each, dtype=torch.uint8).share_memory_()
        self._used: set[tuple[int, int]] = set()  # of the main process

    def take(self, worker: int) -> Slot | None:
        """Return a free slot of a worker, which calls this; None if the main process still uses all of them."""
        free = np.flatnonzero(self._taken[worker].numpy() == 0)
        if not len(free):
            return None
        number = int(free[0])
        self._taken[worker, number] = 1
        return Slot(worker, number, self._memory[worker, number])

    def free_dropped(self) -> None:
        """Free the slots of batches that the main process will not receive, because their epoch was left early."""
        for worker, number in np.argwhere(self._taken.numpy()).tolist():
            if (worker, number) not in self._used:
                self._taken[worker, number] = 0

    def unpacked(self, packed: Packed) -> dict[str, Any]:
        """Return a batch in the main process; its slot becomes free when its last tensor is gone."""
        key = (packed.worker, packed.slot)
        memory = self._memory[key].numpy()
        self._used.add(key)
        weakref.finalize(memory, _free, self._taken, self._used, key).atexit = False
        base = torch.from_numpy(memory)
        out = {}
        for name, value in packed.values.items():
            if isinstance(value, _View):
                out[name] = base.view(value.dtype).as_strided(value.shape, value.stride, value.offset)
            else:
                out[name] = torch.from_numpy(value) if isinstance(value, np.ndarray) else value
        return out


def slot_size(buffers: Mapping[str, tuple[tuple[int, ...], np.dtype[Any]]]) -> int:
    """Return the bytes of a slot for arrays of these shapes."""
    return sum(_aligned(int(np.prod(shape)) * dtype.itemsize) for shape, dtype in buffers.values())


def _aligned(size: int) -> int:
    """Return the next multiple of the alignment of tensors."""
    return -(-size // _ALIGNMENT) * _ALIGNMENT


def _free(taken: Tensor, used: set[tuple[int, int]], key: tuple[int, int]) -> None:
    """Mark a slot as free."""
    used.discard(key)
    taken[key] = 0
