"""Compress the chunks of a store, with the codecs that every reader of Zarr v3 has: Zstd, and Blosc with a CRC-32C.

A codec has a name, which the root attributes of a store keep for each layer:

- `zstd LEVEL`: Zstd with a checksum of its own.
- `blosc zstd LEVEL SHUFFLE SIZE BLOCK`: Blosc, which first sorts the bytes (`shuffle`) or bits (`bitshuffle`) of
  words of SIZE bytes by weight, and then compresses blocks of BLOCK bytes with Zstd; behind it the CRC-32C of the
  compressed bytes, because Blosc has no checksum. Without BLOCK, Blosc chooses the size, as in older stores.
"""

from __future__ import annotations

import functools
import re
import struct
from dataclasses import dataclass
from typing import Any

import google_crc32c
import numpy as np
from numcodecs import Blosc, Zstd, blosc
from numpy.typing import NDArray

from ..core.errors import InputError, shown

# Level 1: 16 ms for a noisy 1024 px RGBI image; level 3 takes three times as long and saves a sixth.
ZSTD = "zstd 1"
_MOST_BYTES = Blosc.max_buffer_size  # that Blosc can compress as one chunk
_MAGIC_OF_ZSTD = b"\x28\xb5\x2f\xfd"
_NAME = re.compile(r"zstd (\d{1,2})|blosc zstd (\d) (shuffle|bitshuffle) ([1-9]\d?)(?: (\d{3,7}))?")
# numcodecs makes a semaphore for Blosc in each process, of which multiprocessing complains if a worker is killed or
# the terminal hangs up. Where there are none, Blosc takes one thread, in which equal data also give equal bytes.
blosc._MUTEX, blosc._MUTEX_IS_INIT = None, True
_DAMAGED = (RuntimeError, MemoryError, ValueError)


@dataclass(frozen=True)
class Compressor:
    """Compress chunks and decompress them again.

    `shuffle` is "" for plain Zstd. If `block_bytes` is 0, Blosc chooses the size of its blocks.
    """

    level: int
    shuffle: str = ""
    word_bytes: int = 1
    block_bytes: int = 0

    @property
    def documents(self) -> list[dict[str, Any]]:
        """Return the codecs as `zarr.json` lists them."""
        if not self.shuffle:
            return [{"name": "zstd", "configuration": {"level": self.level, "checksum": True}}]
        configuration = {
            "typesize": self.word_bytes,
            "cname": "zstd",
            "clevel": self.level,
            "shuffle": self.shuffle,
            "blocksize": self.block_bytes,
        }
        return [{"name": "blosc", "configuration": configuration}, {"name": "crc32c"}]

    def encode(self, data: Any) -> bytes:
        """Return data as the bytes of a chunk."""
        if not self.shuffle:
            return bytes(Zstd(level=self.level, checksum=True).encode(data))
        shuffle = {"shuffle": Blosc.SHUFFLE, "bitshuffle": Blosc.BITSHUFFLE}[self.shuffle]
        words = np.frombuffer(memoryview(data).cast("B"), dtype=f"V{self.word_bytes}")
        coded = bytes(Blosc("zstd", self.level, shuffle, self.block_bytes).encode(words))
        return coded + struct.pack("<I", google_crc32c.value(coded))

    def decode(self, data: bytes, most_bytes: int) -> NDArray[np.uint8]:
        """Return the data that `encode` was given. Raises ValueError if the chunk or its checksum is wrong.

        A chunk says how large its data are; more than `most_bytes` are refused before any memory is taken.
        """
        size = self._decoded_bytes(data)
        if size > most_bytes:
            raise ValueError(f"it holds {size} bytes, where at most {most_bytes} are possible")
        out = np.empty(size, dtype=np.uint8)
        self.decode_into(data, out)
        out.flags.writeable = False  # what computes checksums takes no other
        return out

    def decode_into(self, data: bytes, out: NDArray[Any]) -> None:
        """Decode a chunk into a contiguous array. Raises ValueError if it is damaged or has another size.

        The libraries write no byte behind `out`, whatever the header of the chunk says.
        """
        room = out.reshape(-1).view(np.uint8)
        if self._decoded_bytes(data) != room.size:
            raise ValueError(f"it does not hold {room.size} bytes")
        try:
            if self.shuffle:
                Blosc().decode(_checked(data), out=room)
            else:
                Zstd().decode(data, out=room)
        except _DAMAGED as error:
            raise ValueError(str(error)) from error

    def _decoded_bytes(self, data: bytes) -> int:
        """Return how large a chunk says that its data are. Raises ValueError if it says nothing."""
        if self.shuffle:
            (size,) = struct.unpack_from("<I", data[:8].ljust(8, b"\0"), 4)
            return int(size)
        # the header of a Zstd frame (RFC 8878, section 3.1.1.1): magic number, descriptor, window, dictionary, size
        if data[:4] != _MAGIC_OF_ZSTD or len(data) < 5:
            raise ValueError("it is no frame of Zstd")
        flag, single, dictionary = data[4] >> 6, data[4] >> 5 & 1, data[4] & 3
        width = (single, 2, 4, 8)[flag]
        start = 6 - single + (0, 1, 2, 4)[dictionary]
        if not width or len(data) < start + width:
            raise ValueError("it does not say how large its data are")
        return int.from_bytes(data[start : start + width], "little") + (256 if flag == 1 else 0)


def _checked(data: bytes) -> NDArray[np.uint8]:
    """Return a chunk without the checksum at its end, as a view. Raises ValueError if that does not match."""
    coded = np.frombuffer(data, np.uint8)[:-4]
    if struct.pack("<I", google_crc32c.value(coded)) != data[-4:]:
        raise ValueError("it does not match its checksum")
    return coded


def most_compressed(size: int) -> int:
    """Return the most bytes that a chunk of so many bytes of data takes.

    Zstd adds up to 1/256 and 64 bytes to what it cannot compress, Blosc 16 bytes; both have checksums.
    """
    return size + size // 128 + 1024


@functools.cache
def compressor(name: str) -> Compressor:
    """Return the codec of a name. Raises InputError if there is none of this name."""
    match = _NAME.fullmatch(name) if isinstance(name, str) else None
    if match is None:
        raise InputError(f"codec = {shown(name)}: must be 'zstd LEVEL' or 'blosc zstd LEVEL SHUFFLE SIZE BLOCK'")
    if match[1]:
        return Compressor(int(match[1]))
    return Compressor(int(match[2]), match[3], int(match[4]), int(match[5] or 0))


def fitting(name: str, chunk_bytes: int) -> str:
    """Return the name of the codec for chunks of a size: plain Zstd where they are too large for Blosc.

    Raises InputError if there is no codec of this name.
    """
    return name if not compressor(name).shuffle or chunk_bytes <= _MOST_BYTES else ZSTD
