"""Say in which order samples are read: a function of the seed and the epoch, not of workers or machines.

The order is that of a shuffle buffer over shuffled shards. First the shards are permuted. Then the sample at
position p of that sequence gets the key p + buffer · u, u uniform in [0, 1), and the samples are sorted by their
keys. So two samples change places only if fewer than `buffer` samples lie between them, and the samples of a shard
are read close together: a file that was opened for one of them is soon needed for the others.

All random numbers are hashes of (seed, epoch, number of the shard or sample), so the order does not depend on the
version of NumPy either.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, TypeGuard

import numpy as np
from numpy.typing import NDArray

from ..core.errors import InputError, shown
from ..scene.keyed_random import keyed_uniform

Index = NDArray[np.int64]
# what a saved state must have in common with the order that continues it
_OF_STATE = ("seed", "shuffle", "buffer", "batch_size", "drop_last", "ranks", "samples_sha256")


@dataclass(frozen=True, kw_only=True, eq=False)
class Order:
    """Describe the order of batches.

    Parameters
    ----------
    samples
        Indices of the samples in the store, int64[n], ascending.
    shard_samples
        Number of samples a shard.
    batch_size
        Samples a batch, at least 1.
    seed
        Any whole number from 0 on.
    shuffle
        False: ascending order in every epoch.
    buffer
        Size of the shuffle buffer in samples. With at least as many as there are samples, every order is equally
        likely.
    drop_last
        Leave out the last batch if it is smaller, and as many more that each rank gets as many batches. By default
        True if there are several ranks.
    rank, ranks
        Rank r of n reads the batches r, r + n, r + 2n, … of the order.
    """

    samples: Index
    shard_samples: int
    batch_size: int = 8
    seed: int = 0
    shuffle: bool = True
    buffer: int = 256
    drop_last: bool | None = None
    rank: int = 0
    ranks: int = 1

    def __post_init__(self) -> None:
        for name, low in (("batch_size", 1), ("seed", 0), ("buffer", 1), ("ranks", 1), ("rank", 0)):
            value = getattr(self, name)
            if not isinstance(value, int | np.integer) or isinstance(value, bool) or value < low:
                raise InputError(f"{name} = {shown(value)}: must be a whole number of at least {low}")
        if self.rank >= self.ranks:
            raise InputError(f"rank = {self.rank}: must be below ranks = {self.ranks}")
        if self.drop_last is None:
            object.__setattr__(self, "drop_last", self.ranks > 1)
        if not len(self):
            raise InputError(
                f"batch_size = {self.batch_size}: {len(self.samples)} samples make no whole batch for each of "
                f"{self.ranks} ranks; must be at most {max(1, len(self.samples) // self.ranks)}, unless drop_last "
                "is False"
            )

    def __len__(self) -> int:
        """Return the number of batches of this rank in an epoch."""
        return len(range(self.rank, self._batches, self.ranks))

    @property
    def _batches(self) -> int:
        """Return the number of batches of all ranks in an epoch."""
        if self.drop_last:
            return len(self.samples) // self.batch_size // self.ranks * self.ranks
        return -(-len(self.samples) // self.batch_size)

    def of_epoch(self, epoch: int) -> Index:
        """Return all samples in the order of an epoch, int64[n]."""
        if not self.shuffle:
            return self.samples
        shard = self.samples // self.shard_samples
        numbers, first = np.unique(shard, return_inverse=True)
        of_shard = keyed_uniform(self.seed, numbers, f"epoch {epoch}", "shards")
        sequence = self.samples[np.argsort(of_shard[first], kind="stable")]
        key = keyed_uniform(self.seed, sequence, f"epoch {epoch}", "samples")
        if self.buffer < len(sequence):
            key = np.arange(len(sequence)) + self.buffer * key
        return sequence[np.argsort(key, kind="stable")]

    def batches(self, epoch: int, start: int = 0, worker: int = 0, workers: int = 1) -> list[Index]:
        """Return the batches that a worker reads in an epoch, from the batch `start` of this rank on.

        Worker w of n reads the batches w, w + n, w + 2n, … from there. A loader that asks its workers in turn
        therefore returns the same sequence for every number of workers.
        """
        order, size = self.of_epoch(epoch), self.batch_size
        mine = range(self.rank, self._batches, self.ranks)[start + worker :: workers]
        return [order[k * size : (k + 1) * size] for k in mine]

    # --- the state of a run in mid-epoch ------------------------------------------------------------------

    @cached_property
    def samples_sha256(self) -> str:
        """Return a checksum of the chosen samples and the size of the shards."""
        data = np.ascontiguousarray(self.samples, dtype="<i8").tobytes()
        return hashlib.sha256(data + str(self.shard_samples).encode()).hexdigest()

    def state(self, epoch: int, batch: int) -> dict[str, Any]:
        """Return plain data that say which batch of which epoch comes next, and of which order."""
        return {"epoch": epoch, "batch": self.checked_batch(batch)} | {
            name: getattr(self, name) for name in _OF_STATE
        }

    def position(self, state: Mapping[str, Any]) -> tuple[int, int]:
        """Return epoch and next batch of a state. Raises InputError if it is of another order."""
        if not isinstance(state, Mapping):
            raise InputError(f"state = {shown(state)}: must be what state_dict() returned, a mapping")
        epoch, batch = state.get("epoch"), state.get("batch")
        if not (is_count(epoch) and is_count(batch)):
            raise InputError("state: it must hold epoch and batch, whole numbers from 0 to 2⁶³ - 1")
        for name in _OF_STATE:
            saved, own = state.get(name), getattr(self, name)
            if saved != own:
                if name == "samples_sha256":
                    raise InputError("state: it belongs to other samples; choose the same store, split and filter")
                raise InputError(f"state: its {name} = {shown(saved)}, but here {name} = {shown(own)}")
        return epoch, self.checked_batch(batch)

    def checked_batch(self, batch: int) -> int:
        """Return the number of a batch. Raises InputError if an epoch ends before it."""
        number = int(batch) if isinstance(batch, np.integer) else batch
        if not is_count(number) or number > len(self):
            raise InputError(
                f"batch = {shown(batch)}: must be a whole number from 0 to {len(self)}, the batches of an epoch"
            )
        return number


def is_count(value: object) -> TypeGuard[int]:
    """Return whether a value is a whole number of at least 0 that fits 64 bits, as epochs and batches are."""
    return isinstance(value, int) and not isinstance(value, bool) and 0 <= value < 2**63


def checked_epoch(epoch: int) -> int:
    """Return the number of an epoch. Raises InputError if it is no whole number from 0 to 2⁶³ - 1."""
    number = int(epoch) if isinstance(epoch, np.integer) else epoch
    if not is_count(number):
        raise InputError(f"epoch = {shown(epoch)}: must be a whole number from 0 to 2⁶³ - 1")
    return number
