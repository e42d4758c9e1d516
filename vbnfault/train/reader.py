"""Read batches of samples: whole parts of shards at once, ahead of their use, decoded in threads."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..store import FetchedSample, ShardReader, Store
from .targets import Targets

# The most compressed bytes that one reader holds ahead of their use.
READ_AHEAD_BYTES = 256 * 2**20
# The most shards of which one reader keeps the scalars.
SHARDS_OF_SCALARS = 64


class SampleReader:
    """Read the targets of samples.

    From a shard that it opens for one sample, it also takes the samples that are needed soon, and holds their
    compressed chunks, at most `READ_AHEAD_BYTES`. An object belongs to one process.
    """

    def __init__(self, store: Store, targets: Targets, threads: int = 1) -> None:
        self.targets = targets
        self._shard_samples = store.spec.shard_samples
        self._reader = ShardReader(store, targets.layers)
        self._decoders = ThreadPoolExecutor(threads) if threads > 1 else None
        self._ahead = ThreadPoolExecutor(1)
        self._fetching: Future[None] | None = None
        self._held: dict[int, FetchedSample] = {}
        self._scalars: dict[int, dict[str, NDArray[Any]]] = {}

    def close(self) -> None:
        """End the threads."""
        for pool in (self._ahead, self._decoders):
            if pool is not None:
                pool.shutdown(wait=True, cancel_futures=True)

    def release(self) -> None:
        """Drop what was read, so that a store that changes between epochs gives its new samples."""
        self._wait()
        self._held.clear()
        self._scalars.clear()

    def buffers(self, count: int) -> dict[str, NDArray[Any]]:
        """Return new arrays for `fill`, for `count` samples."""
        return {name: np.empty(shape, dtype) for name, (shape, dtype) in self.targets.buffers(count).items()}

    def fill(
        self,
        samples: Sequence[int] | NDArray[np.int64],
        layers: Mapping[str, NDArray[Any]],
        upcoming: Sequence[int] | NDArray[np.int64] = (),
    ) -> dict[str, NDArray[Any]]:
        """Decode the layers of samples into arrays like those of `buffers`, and return their scalars by name.

        Parameters
        ----------
        samples
            Indices of samples, one for each row of the arrays.
        layers
            Contiguous arrays by layer.
        upcoming
            Samples that the next calls will ask for, in order. The first `len(samples)` of them are read from disk
            while this call decodes.

        Raises
        ------
        VbnfaultError
            A sample is damaged or missing; the sentence names store, layer and sample.
        """
        wanted, soon = [int(i) for i in samples], [int(i) for i in upcoming]
        self._wait()
        self._fetch(wanted, soon)
        fetched = [self._held[i] for i in wanted]
        for i in set(wanted):
            del self._held[i]
        if soon:
            self._fetching = self._ahead.submit(self._fetch, soon[: len(wanted)], soon)
        work = [(sample, name, layers[name][k]) for k, sample in enumerate(fetched) for name in layers]
        if self._decoders is None:
            for sample, name, out in work:
                self._reader.decode(sample, name, out)
        else:
            list(self._decoders.map(lambda task: self._reader.decode(*task), work))
        return self._scalars_of(wanted)

    def _wait(self) -> None:
        """Wait for the reading ahead; what it met is met again by whoever needs the sample."""
        if self._fetching is not None:
            self._fetching.exception()
            self._fetching = None

    def _fetch(self, samples: list[int], upcoming: list[int]) -> None:
        """Hold the chunks of samples and, while there is room, those of upcoming samples of the same shards."""
        by_shard: dict[int, dict[int, None]] = {}
        for i in samples:
            if i not in self._held:
                by_shard.setdefault(i // self._shard_samples, {})[i] = None
        room = sum(sample.size for sample in self._held.values()) < READ_AHEAD_BYTES
        for i in upcoming if room else ():
            if i not in self._held and i // self._shard_samples in by_shard:
                by_shard[i // self._shard_samples][i] = None
        for number, wanted in by_shard.items():
            self._held.update(self._reader.fetch(number, sorted(wanted)))

    def _scalars_of(self, samples: list[int]) -> dict[str, NDArray[Any]]:
        """Return the scalars of samples by name; those of the shards that were used last are kept."""
        values: dict[str, NDArray[Any]] = {}
        for name in self.targets.scalars:
            rows = []
            for i in samples:
                number, k = divmod(i, self._shard_samples)
                kept = self._scalars.setdefault(number, {})
                if name not in kept:
                    kept[name] = self._reader.column(name, number)
                rows.append(kept[name][k])
            values[name] = np.stack(rows)
        while len(self._scalars) > SHARDS_OF_SCALARS:
            del self._scalars[next(iter(self._scalars))]
        return values
