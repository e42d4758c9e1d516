"""Offer a store to PyTorch: a dataset of samples, the same in shuffled batches, and a sampler for the first.

All three give the same batches for one seed and epoch, whatever the number of workers and the way they are started.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, TypedDict, Unpack

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.utils.data import Dataset, IterableDataset, Sampler, default_collate, get_worker_info

from ..core.errors import InputError, shown
from ..core.process import environment
from ..store import open_store
from .order import Order, checked_epoch
from .reader import SampleReader
from .selection import Columns, Where, select
from .slots import Slots, contiguous
from .targets import Targets

Batch = dict[str, Any]
Transform = Callable[[Batch], Batch]
MOST_THREADS = 8


class _OptionsOfOneRank(TypedDict, total=False):
    """Name the options of an order but the ranks; what is not given has the default of `Order`."""

    batch_size: int
    seed: int
    shuffle: bool
    buffer: int
    drop_last: bool | None


class OrderOptions(_OptionsOfOneRank, total=False):
    """Name the options of an order, which `BatchDataset` describes."""

    ranks: tuple[int, int] | None


class SampleDataset(Dataset[Batch]):
    """Read samples of a store as dictionaries of tensors, in any order: a map-style dataset.

    A sample has `image`, `sample` (its index in the store) and the targets. Values are as stored, so `image` is
    uint8[4, y, x] in 0 to 255; `vbnfault.train.TARGETS` describes all targets.

    Parameters
    ----------
    store
        Path or URL of a store.
    split
        `train`, `val` or `test`; None: all samples.
    targets
        Any of `clean`, `classes`, `masks`, `instances`, `semantic`, `depth`, `normal`, `pose`, and the names of
        other layers and numbers of the store.
    containing
        Fault classes: only samples with at least one of them in their pixels. `[]`: only samples without any fault.
    where
        Called with the scalars of all samples as arrays by name; returns which samples to keep, bool[n].
    classes
        Fault classes on the axis of `classes`, `masks` and `instances`, in this order; by default all.
    masks
        "footprint" or "effect": which mask `masks` and `instances` hold.
    transform
        Called with each sample; returns what becomes of it. Random numbers of PyTorch that it draws are keyed by
        seed, epoch and sample, so they do not depend on workers either. With `spawn`, it must be picklable.

    Raises
    ------
    InputError
        If there is no such store, split, class or target, or no sample is left.
    """

    def __init__(
        self,
        store: str | os.PathLike[str],
        split: str | None = None,
        targets: Sequence[str] = ("classes",),
        *,
        containing: Sequence[str] | None = None,
        where: Where | None = None,
        classes: Sequence[str] | None = None,
        masks: str = "footprint",
        transform: Transform | None = None,
    ) -> None:
        if transform is not None and not callable(transform):
            raise InputError(f"transform = {shown(transform)}: must be a function of a sample, or None")
        opened = open_store(store)
        self.path = opened.path
        self.targets = Targets(opened, targets, classes, masks)
        self.samples: NDArray[np.int64] = select(opened, split, containing, where)
        self.transform = transform
        self.seed = 0
        self._epoch = _shared_numbers(1)
        self._reader: tuple[tuple[int, int], SampleReader] | None = None

    @property
    def classes(self) -> tuple[str, ...]:
        """Return the fault classes on the axis of `classes`, `masks` and `instances`."""
        return self.targets.classes

    def set_epoch(self, epoch: int, seed: int = 0) -> None:
        """Say which epoch begins, for the random numbers of `transform`; `ShardSampler` and `Loader` do so.

        Raises InputError if it is no whole number from 0 to 2⁶³ - 1, as in the other classes.
        """
        self._epoch[0], self.seed = checked_epoch(epoch), seed

    def __len__(self) -> int:
        """Return the number of samples."""
        return len(self.samples)

    def __getitem__(self, position: int) -> Batch:
        """Return the sample at a position among the chosen ones."""
        return self.__getitems__([position])[0]

    def __getitems__(self, positions: Sequence[int]) -> list[Batch]:
        """Return several samples, which are decoded in threads; a `DataLoader` calls this for a batch."""
        samples = [int(self.samples[position]) for position in positions]
        batch = self.read(samples, new_tensors(self.targets, len(samples)))
        return self.transformed(split_batch(batch), int(self._epoch[0]))

    def read(self, samples: Sequence[int], layers: Mapping[str, Tensor], upcoming: Sequence[int] = ()) -> Batch:
        """Return samples of the store as one batch whose layers are decoded into `layers`; see `SampleReader`."""
        scalars = self._open_reader().fill(samples, {name: t.numpy() for name, t in layers.items()}, upcoming)
        made = self.targets.make(layers, scalars, torch.movedim)
        batch = {name: v if isinstance(v, Tensor) else torch.from_numpy(v) for name, v in made.items()}
        return {**batch, "sample": torch.tensor(samples)}

    def transformed(self, samples: list[Batch], epoch: int) -> list[Batch]:
        """Return samples after `transform`, each with its own random numbers."""
        if self.transform is None:
            return samples
        out = []
        with torch.random.fork_rng(devices=[]):
            for sample in samples:
                key = f"{self.seed}\0{epoch}\0{int(sample['sample'])}\0transform"
                number = int.from_bytes(hashlib.sha256(key.encode()).digest()[:7], "little")
                torch.default_generator.manual_seed(number)
                out.append(self.transform(sample))
        return out

    def class_weights(self) -> Tensor:
        """Return samples without over samples with each class, float32[class], 1 where a class never occurs.

        This is the `pos_weight` of `torch.nn.BCEWithLogitsLoss` for the target `classes`.
        """
        columns = Columns(open_store(self.path))
        injected = columns["injected"][np.isin(columns.samples, self.samples)][:, self._class_indices()]
        positive = injected.sum(axis=0)
        return _weights(positive, len(injected) - positive)

    def pixel_weights(self, most: int = 256) -> Tensor:
        """Return pixels outside over pixels inside the masks of each class, float32[class], 1 where none is inside.

        This is the `pos_weight` for the target `masks`, after `[:, None, None]`. `most`: number of samples that are
        read, evenly spaced over the chosen ones.
        """
        inside, total = self.mask_pixels(most)
        return _weights(inside, total - inside)

    def mask_pixels(self, most: int) -> tuple[NDArray[np.int64], int]:
        """Return pixels inside the masks of each class, int64[class], and all pixels, of `most` samples."""
        if type(most) is not int or most < 1:
            raise InputError(f"most = {shown(most)}: must be a whole number of at least 1")
        layer = next((t for t in ("mask", "mask_effect") if t in self.targets.layers), "")
        if not layer:
            raise InputError("pixel_weights: the dataset reads no masks; add masks to targets")
        chosen = self.samples[np.unique(np.linspace(0, len(self.samples) - 1, most).astype(int))]
        inside, total = np.zeros(len(self.classes), dtype=np.int64), 0
        for sample in chosen.tolist():
            layers = new_tensors(self.targets, 1)
            self.read([sample], layers)
            masks = layers[layer].numpy()[0, self._class_indices()]
            inside += masks.sum(axis=(1, 2))
            total += masks[0].size
        return inside, total

    def close(self) -> None:
        """End the threads that read; the next access starts them again."""
        if self._reader is not None and self._reader[0][0] == os.getpid():
            self._reader[1].close()
        self._reader = None

    def release(self) -> None:
        """Drop what was read, so that a store that changes between epochs gives its new samples."""
        if self._reader is not None and self._reader[0][0] == os.getpid():
            self._reader[1].release()

    def _class_indices(self) -> list[int]:
        """Return the positions of the chosen classes on the fault axis of the store."""
        return [self.targets.spec.faults.index(name) for name in self.classes]

    def _open_reader(self) -> SampleReader:
        """Return the reader of this process and worker, opened at first use: threads do not survive a fork."""
        worker = get_worker_info()
        key = (os.getpid(), threads_of(worker.num_workers if worker else 0))
        if self._reader is None or self._reader[0] != key:
            store = open_store(self.path, "r+")  # what is damaged was said when the dataset was made
            self._reader = key, SampleReader(store, self.targets, key[1])
        return self._reader[1]

    def __getstate__(self) -> dict[str, Any]:
        """Return what another process needs: not the reader of this one."""
        return {**self.__dict__, "_reader": None}


class ShardSampler(Sampler[list[int]]):
    """Give a `DataLoader` over a `SampleDataset` the batches of `BatchDataset`, as its `batch_sampler`.

    The parameters are those of `BatchDataset`. Call `set_epoch` before each epoch.
    """

    def __init__(self, data: SampleDataset, **order: Unpack[OrderOptions]) -> None:
        self.data = data
        self.order = _order(data, **order)
        self.epoch = self._start = 0

    def set_epoch(self, epoch: int) -> None:
        """Choose the order of an epoch."""
        self.epoch, self._start = checked_epoch(epoch), 0

    def state_dict(self, batches: int) -> dict[str, Any]:
        """Return the state after the training loop has used `batches` batches of this epoch.

        A `DataLoader` reads ahead of the loop, so only the loop knows this number.
        """
        return self.order.state(self.epoch, batches)

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue from a state in the next iteration. Raises InputError if it is of another order."""
        self.epoch, self._start = self.order.position(state)

    def __len__(self) -> int:
        """Return the number of batches of this rank in an epoch."""
        return len(self.order)

    def __iter__(self) -> Iterator[list[int]]:
        """Yield the positions of the samples of each batch."""
        self.data.set_epoch(self.epoch, self.order.seed)
        start, self._start = self._start, 0
        for batch in self.order.batches(self.epoch, start):
            yield np.searchsorted(self.data.samples, batch).tolist()


class BatchDataset(IterableDataset[Batch]):
    """Read the samples of a `SampleDataset` in shuffled batches: an iterable dataset, for `batch_size=None`.

    `Loader` iterates over it with epochs, states and worker processes. A plain `DataLoader(batches,
    batch_size=None, num_workers=n)` works too. Either returns one sequence of batches for every number of workers:
    worker w of n reads the batches w, w + n, w + 2n, …, and the loader asks its workers in turn.

    Parameters
    ----------
    data
        The samples, their targets and their transform.
    batch_size
        Samples a batch, 8 by default. The last one of an epoch may be smaller, see `drop_last`.
    seed
        The order depends on seed, 0 by default, and epoch alone.
    shuffle
        False: in the order of the store.
    buffer
        Size of the shuffle buffer in samples, 256 by default: how far apart samples are that are read together. A
        loader holds their compressed layers, at most 256 MiB in each worker.
    drop_last
        Leave out the last, smaller batch. By default only if there are several ranks, and then all of them get the
        same number of batches.
    ranks
        Rank of this process and number of ranks; by default those of `torch.distributed` where it is initialised.
        All ranks together read the batches that one rank would read, in turns.
    """

    def __init__(self, data: SampleDataset, **order: Unpack[OrderOptions]) -> None:
        self.data = data
        self.order = _order(data, **order)
        self._position = _shared_numbers(2)  # epoch and first batch; workers that live on see a change

    def set_epoch(self, epoch: int, batch: int = 0) -> None:
        """Choose the epoch, and its first batch, of the next iteration."""
        self._position[0], self._position[1] = checked_epoch(epoch), self.order.checked_batch(batch)

    def state_dict(self, batches: int = 0) -> dict[str, Any]:
        """Return the state after the training loop has used `batches` batches since `set_epoch`."""
        epoch, first = (int(number) for number in self._position)
        return self.order.state(epoch, first + self.order.checked_batch(batches))

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue from a state in the next iteration. Raises InputError if it is of another order."""
        self.set_epoch(*self.order.position(state))

    def __len__(self) -> int:
        """Return the number of batches of this rank in an epoch."""
        return len(self.order)

    def __iter__(self) -> Iterator[Batch]:
        """Yield the batches of this worker."""
        return self.read_batches()

    def read_batches(self, slots: Slots | None = None) -> Iterator[Any]:
        """Yield the batches of this worker; with slots, as `Packed` where one is free."""
        info = get_worker_info()
        worker, workers = (info.id, info.num_workers) if info else (0, 1)
        epoch, start = (int(number) for number in self._position)
        batches = self.order.batches(epoch, start, worker, workers)
        ahead = -(-self.order.buffer // self.order.batch_size // workers) + 1
        self.data.set_epoch(epoch, self.order.seed)
        scratch: dict[int, dict[str, Tensor]] = {}
        try:
            for k, batch in enumerate(batches):
                soon = np.concatenate([*batches[k + 1 : k + 1 + ahead], np.empty(0, dtype=np.int64)])
                if self.data.transform is not None:
                    yield self._transformed(batch.tolist(), soon.tolist(), epoch, scratch)
                    continue
                slot = slots.take(worker) if slots is not None else None
                targets, count = self.data.targets, len(batch)
                layers = slot.tensors(targets.buffers(count)) if slot else new_tensors(targets, count)
                made = self.data.read(batch.tolist(), layers, soon.tolist())
                yield slot.packed(made) if slot else made
        finally:
            self.data.release()

    def _transformed(
        self, samples: list[int], upcoming: list[int], epoch: int, scratch: dict[int, dict[str, Tensor]]
    ) -> Batch:
        """Return the collated results of the transform; `scratch` keeps the layers, which are used again."""
        data, count = self.data, len(samples)
        if count not in scratch:
            scratch[count] = new_tensors(data.targets, count, shared=False)
        read = data.read(samples, scratch[count], upcoming)
        return default_collate(data.transformed(split_batch(read), epoch))


def _order(
    data: SampleDataset, *, ranks: tuple[int, int] | None = None, **order: Unpack[_OptionsOfOneRank]
) -> Order:
    """Return the order of a dataset's samples; the parameters are those of `BatchDataset`."""
    if not isinstance(data, SampleDataset):
        raise InputError(f"data = {shown(data)}: must be a SampleDataset")
    if ranks is None:
        parallel = torch.distributed
        known = parallel.is_available() and parallel.is_initialized()
        ranks = (parallel.get_rank(), parallel.get_world_size()) if known else (0, 1)
    if not isinstance(ranks, tuple | list) or len(ranks) != 2:
        raise InputError(f"ranks = {shown(ranks)}: must be two whole numbers, the rank and the number of ranks")
    return Order(
        samples=data.samples,
        shard_samples=data.targets.spec.shard_samples,
        rank=ranks[0],
        ranks=ranks[1],
        **order,
    )


def new_tensors(targets: Targets, count: int, *, shared: bool | None = None) -> dict[str, Tensor]:
    """Return tensors for the layers of `count` samples; in a worker process, in memory that it can pass on."""
    new_shared = getattr(torch.UntypedStorage, "_new_shared", None)  # as `default_collate` does
    shared = get_worker_info() is not None if shared is None else shared
    out = {}
    for name, (shape, dtype) in targets.buffers(count).items():
        kind = torch.from_numpy(np.empty(0, dtype)).dtype
        if shared and new_shared is not None:
            size = int(np.prod(shape)) * dtype.itemsize
            out[name] = torch.empty(0, dtype=kind).set_(new_shared(max(1, size)), 0, shape, contiguous(shape))
        else:
            out[name] = torch.empty(shape, dtype=kind)
    return out


def split_batch(batch: Batch) -> list[Batch]:
    """Return the samples of a batch; their tensors are views."""
    return [{name: values[k] for name, values in batch.items()} for k in range(len(batch["sample"]))]


def threads_of(workers: int) -> int:
    """Return how many threads decode in each of so many workers, 1 to 8."""
    return max(1, min(MOST_THREADS, environment.usable_cores() // max(1, workers)))


def _shared_numbers(count: int) -> Tensor:
    """Return whole numbers, 0 at first, that worker processes see change."""
    return torch.zeros(count, dtype=torch.int64).share_memory_()


def _weights(positive: NDArray[Any], negative: NDArray[Any]) -> Tensor:
    """Return negative over positive, float32, 1 where there is no positive."""
    ratio = np.where(positive > 0, negative / np.maximum(positive, 1), 1.0)
    return torch.from_numpy(ratio.astype(np.float32))


__all__ = ["Batch", "BatchDataset", "SampleDataset", "ShardSampler"]
