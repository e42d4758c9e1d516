"""Read chosen layers of samples from the shard files for trainers, in place and compared with their checksums.

zarr would read the index of a shard again for each sample, and copy each layer several times. Here a file is opened
once for all samples that are wanted from it, and a layer is decoded into the array that the caller uses.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.errors import VbnfaultError
from .codec import crc32c
from .compressors import compressor
from .opened import Store

# A compressed chunk of at most this size may be that of an empty mask, which occurs again and again.
_SMALL_CHUNK = 1024


@dataclass(frozen=True, eq=False)
class FetchedSample:
    """Hold the compressed chunks of one sample and the stored CRC-32C of each, by layer."""

    index: int
    chunks: dict[str, bytes]
    crc32c: dict[str, int]

    @property
    def size(self) -> int:
        """Return the number of compressed bytes."""
        return sum(map(len, self.chunks.values()))


class ShardReader:
    """Read `layers` of the samples of a store.

    Threads may call `decode` at the same time.
    """

    def __init__(self, store: Store, layers: Sequence[str]) -> None:
        self.store = store
        self.layers = tuple(layers)
        self._checked = {name: k for k, name in enumerate(store.spec.checked)}
        # checksums of compressed chunks of zeros by layer, which are filled in without decoding them again
        self._zeros: dict[tuple[str, bytes], int] = {}
        # by layer and sample, which chunk matched which stored checksum when it was last compared: 0 if none did
        self._matched = {name: np.zeros(store.samples, dtype=np.uint64) for name in self.layers}

    def fetch(self, number: int, samples: Collection[int]) -> dict[int, FetchedSample]:
        """Return the compressed chunks of samples of one shard; each file is opened once.

        Raises VbnfaultError, with store, layer and samples, if they cannot be read.
        """
        crcs = self.column("crc32c", number)
        chunks = {name: self._chunks(name, number, samples) for name in self.layers}
        first = self.store.shard(number).start
        return {
            i: FetchedSample(
                index=i,
                chunks={name: chunks[name][i] for name in self.layers},
                crc32c={name: int(crcs[i - first, self._checked[name]]) for name in self.layers},
            )
            for i in samples
        }

    def decode(self, fetched: FetchedSample, name: str, out: NDArray[Any]) -> None:
        """Decode a layer of a sample into a contiguous array, and compare it with its checksum.

        Every chunk has a checksum of its own, which is always compared. The one that the store holds of the decoded
        layer is compared the first time, and again when the chunk or that checksum is another one.

        Raises VbnfaultError, with store, layer and sample, if it is damaged.
        """
        problem = self._decode(fetched, name, out)
        if problem:  # a process that rewrites the sample may just have replaced the files
            number = fetched.index // self.store.spec.shard_samples
            problem = self._decode(self.fetch(number, [fetched.index])[fetched.index], name, out)
        if problem:
            raise self._damaged(f"{name} of sample {fetched.index} {problem}")

    def column(self, name: str, number: int) -> NDArray[Any]:
        """Return a scalar for all samples of a shard. Raises VbnfaultError if it cannot be read."""
        try:
            return self.store.column(name, number)
        except (OSError, ValueError) as error:
            raise self._damaged(f"{name} of samples {self._span(number)} cannot be read ({error})") from error

    def _chunks(self, name: str, number: int, samples: Collection[int]) -> dict[int, bytes]:
        """Return the compressed chunks of one layer of samples of one shard."""
        file = self.store.file_name(name, number)
        try:
            chunks = self.store.chunk(name, number, samples)
        except (OSError, ValueError) as error:
            why = f"cannot be read, the shard file {file} is damaged or missing ({error})"
            raise self._damaged(f"{name} of samples {self._span(number)} {why}") from error
        for i in samples:
            if i not in chunks:
                raise self._damaged(f"{name} of sample {i} has no chunk in {file}")
        return chunks

    def _decode(self, fetched: FetchedSample, name: str, out: NDArray[Any]) -> str:
        """Decode a layer, and return what is wrong with it as a clause, "" if nothing is."""
        data = fetched.chunks[name]
        if not out.size:
            return ""
        crc = self._zeros.get((name, data)) if len(data) <= _SMALL_CHUNK else None
        if crc is not None:
            out.fill(0)
        else:
            try:
                compressor(self.store.spec.codecs[name]).decode_into(data, out)
            except ValueError:
                return "cannot be decoded"
            chunk = np.uint64(int.from_bytes(data[-4:], "little") << 32 | fetched.crc32c[name])
            if self._matched[name][fetched.index] == chunk:
                return ""
            crc = crc32c(out)
            if crc == fetched.crc32c[name]:
                self._matched[name][fetched.index] = chunk
                if len(data) <= _SMALL_CHUNK and not out.any():
                    self._zeros[name, data] = crc
        return "" if crc == fetched.crc32c[name] else "does not match its stored crc32c"

    def _span(self, number: int) -> str:
        """Return the first and the last sample of a shard as text."""
        samples = self.store.shard(number)
        return f"{samples.start}-{samples.stop - 1}"

    def _damaged(self, clause: str) -> VbnfaultError:
        """Return the error for damaged files."""
        return VbnfaultError(f"{self.store.path}: {clause}; the build command repairs it")
