"""Encode a sample as bytes: compress its chunks, compute checksums, and assemble the shard files."""

from __future__ import annotations

import hashlib
import json
import struct
import weakref
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import google_crc32c
import numpy as np
from numpy.typing import NDArray

from ..core.process import environment
from ..core.quantities import Sample
from .arrays import OF_SEQUENCES, SCALARS
from .compressors import compressor
from .schema import StoreSpec

_ABSENT = 2**64 - 1  # marks a missing chunk in a shard's index (Zarr v3 specification)
_LEAST_HELD_ONCE = 1024  # bytes of a chunk

_Packed = tuple[bytes, int, bytes]  # chunk, CRC-32C and sha256 of an array


def threads() -> int:
    """Return how many threads compress or check the layers of a sample, 1 to 4."""
    given = environment.whole_number("VBNFAULT_THREADS", environment.MOST_THREADS)
    return max(1, min(4, given or environment.usable_cores()))


def crc32c(array: NDArray[Any]) -> int:
    """Return the CRC-32C of the bytes of an array."""
    frozen = np.ascontiguousarray(array).view()
    frozen.flags.writeable = False  # the C function accepts read-only buffers only
    return int(google_crc32c.value(frozen))


# --- shard files: the `sharding_indexed` layout of the Zarr v3 specification, index at the end -------------


def join_shard(chunks: Mapping[int, bytes], count: int) -> bytes:
    """Return a shard file of `count` chunks; its index marks those missing from `chunks` as absent.

    Equal chunks, such as the depth in the samples of one view, are held once, and the index points to them several
    times. Smaller ones than 1 KiB, such as empty masks, are not compared.
    """
    index = np.full((count, 2), _ABSENT, dtype="<u8")
    parts: list[bytes] = []
    held: dict[bytes, int] = {}  # large chunks, each with its position
    position = 0
    for i in sorted(chunks):
        chunk = chunks[i]
        large = len(chunk) >= _LEAST_HELD_ONCE
        start = held.get(chunk) if large else None
        if start is None:
            start = position
            if large:
                held[chunk] = start
            parts.append(chunk)
            position += len(chunk)
        index[i] = start, len(chunk)
    table = index.tobytes()
    return b"".join([*parts, table, struct.pack("<I", google_crc32c.value(table))])


def index_size(count: int) -> int:
    """Return the size in bytes of the index, with its checksum, at the end of a shard file of `count` chunks."""
    return 16 * count + 4


def chunk_ranges(tail: bytes, count: int) -> dict[int, tuple[int, int]]:
    """Return start and length of each chunk by number, from the last `index_size(count)` bytes of a shard file.

    Raises ValueError if the index is damaged.
    """
    table, crc = tail[:-4], tail[-4:]
    if len(tail) != index_size(count) or struct.pack("<I", google_crc32c.value(table)) != crc:
        raise ValueError("truncated or overwritten: its index does not match its checksum")
    rows = np.frombuffer(table, dtype="<u8").reshape(count, 2).tolist()
    return {i: (start, length) for i, (start, length) in enumerate(rows) if start != _ABSENT}


def split_shard(data: bytes, count: int) -> dict[int, bytes]:
    """Return the compressed chunks of a shard file by number. Raises ValueError if its index is damaged."""
    ranges = chunk_ranges(data[-index_size(count) :], count)
    return {i: data[start : start + length] for i, (start, length) in ranges.items()}


# --- one sample, ready to be written ----------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True, eq=False)
class Encoded:
    """Hold a sample with its layers compressed; a task keeps it until its shard is complete.

    `chunks`: compressed bytes by layer. `crc32c`: uint32[layer], the last one over all scalars. `digest`: the
    result of `sample_digest`.
    """

    index: int
    chunks: Mapping[str, bytes]
    scalars: Mapping[str, Any]
    crc32c: NDArray[np.uint32]
    digest: bytes


class SharedChunks:
    """Keep the chunks of read-only arrays as long as the arrays exist.

    Layers that are one array, in a sample or in the samples of a view, are then compressed once.
    """

    def __init__(self) -> None:
        self._known: dict[tuple[int, str], tuple[weakref.ref[NDArray[Any]], _Packed]] = {}

    def packed(self, layers: Mapping[str, tuple[NDArray[Any], str]]) -> dict[str, _Packed]:
        """Return chunk, CRC-32C and sha256 of each layer, given its contiguous array and its codec."""
        keys = {name: (id(array), codec) for name, (array, codec) in layers.items()}
        arrays = {key: layers[name][0] for name, key in keys.items()}
        done = {}
        for key, array in arrays.items():
            known = self._known.get(key)  # another thread may drop the array that it was made of
            if known is not None and known[0]() is array:
                done[key] = known[1]
        left = {key: array for key, array in arrays.items() if key not in done}
        with ThreadPoolExecutor(threads()) as pool:
            done |= zip(left, pool.map(_pack, left.values(), (codec for _, codec in left)), strict=True)
        for key, array in left.items():
            if not array.flags.writeable:
                self._known[key] = weakref.ref(array, self._forget(key)), done[key]
        return {name: done[key] for name, key in keys.items()}

    def _forget(self, key: tuple[int, str]) -> Callable[[object], None]:
        """Return the function that is called when an array ceases to exist."""
        known = self._known
        return lambda _: known.pop(key, None) and None


def _pack(array: NDArray[Any], codec: str) -> _Packed:
    """Return chunk, CRC-32C and sha256 of an array."""
    digest = hashlib.sha256(array.data if array.size else b"").digest()
    return (compressor(codec).encode(array), crc32c(array), digest) if array.size else (b"", 0, digest)


def encode(spec: StoreSpec, sample: Sample, shared: SharedChunks | None = None) -> Encoded:
    """Check a sample against the schema, compress its layers, compute its checksums.

    `shared` keeps the chunks of arrays that a later sample may have, too. `mask_any` is computed here if the sample
    lacks it. Raises ValueError, with the sample and the array, if an array is missing, unknown, or of the wrong
    shape or dtype.
    """
    layers = dict(sample.layers)
    if "mask" in layers and "mask_any" not in layers:
        layers["mask_any"] = mask_union(spec, layers["mask"])
    _same_names(sample.index, "layer", layers, spec.pixel_layers)
    _same_names(sample.index, "scalar", sample.scalars, spec.scalars)

    arrays = {}
    for name, row in spec.pixel_layers.items():
        array = np.ascontiguousarray(layers[name])
        arrays[name] = array, spec.codecs[name]
        if array.shape != spec.shape(row) or array.dtype != np.dtype(row.dtype):
            raise ValueError(
                f"sample {sample.index}: {name} is {array.dtype}{list(array.shape)}, "
                f"not {row.dtype}{list(spec.shape(row))}"
            )
    packed = (shared or SharedChunks()).packed(arrays)
    scalars = {name: _scalar(spec, sample.index, name, sample.scalars[name]) for name in spec.scalars}
    crcs = [crc for _, crc, _ in packed.values()]
    return Encoded(
        index=sample.index,
        chunks={name: chunk for name, (chunk, _, _) in packed.items()},
        scalars=scalars,
        crc32c=np.array([*crcs, crc_of_scalars(scalars)], dtype=np.uint32),
        digest=sample_digest({name: digest for name, (_, _, digest) in packed.items()}, scalars),
    )


def mask_union(spec: StoreSpec, mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return the union bool[y, x] of the masks bool[fault, y, x] of the classes in `spec.mask_any_faults`."""
    chosen = np.array([f in spec.mask_any_faults for f in spec.faults], dtype=bool)
    return np.logical_or.reduce(mask[chosen], axis=0)


def _same_names(index: int, kind: str, got: Iterable[str], expected: Iterable[str]) -> None:
    """Raise ValueError if a sample's names are not exactly the expected ones."""
    for name in set(expected) - set(got):
        raise ValueError(f"sample {index}: the {kind} {name} is missing")
    for name in set(got) - set(expected):
        raise ValueError(f"sample {index}: the store holds no {kind} {name}")


def _scalar(spec: StoreSpec, index: int, name: str, value: Any) -> Any:
    """Return a scalar in the dtype of the schema; raise ValueError if its shape or value does not fit."""
    row = spec.scalars[name]
    if row.is_text:
        text = value if isinstance(value, str) else json.dumps(value, sort_keys=True)
        if len(text.encode()) > row.most_bytes:
            raise ValueError(f"sample {index}: {name} is longer than {row.most_bytes} bytes")
        return text
    array = np.asarray(value)
    shape = spec.shape(row)
    if array.shape != shape:
        raise ValueError(f"sample {index}: {name} has shape {list(array.shape)}, not {list(shape)}")
    typed = array.astype(row.dtype)
    if row.dtype != "float64" and not np.array_equal(typed, array):
        raise ValueError(f"sample {index}: {name} = {value!r} does not fit {row.dtype}")
    return typed


def crc_of_scalars(scalars: Mapping[str, Any]) -> int:
    """Return one CRC-32C over all scalars of a sample, in the order of the schema."""
    return int(google_crc32c.value(_packed(scalars)))


DIGEST_BYTES = hashlib.sha256().digest_size


def sample_digest(layers: Mapping[str, bytes], scalars: Mapping[str, Any]) -> bytes:
    """Return the sha256 of a sample: over its layers in the order of their names, then over its scalars.

    `layers`: by name, the sha256 of the decoded bytes of each layer.
    """
    total = hashlib.sha256()
    for name, layer in sorted(layers.items()):
        total.update(name.encode() + b"\0" + layer)
    total.update(_packed(scalars))
    return total.digest()


def _packed(scalars: Mapping[str, Any]) -> bytes:
    """Return all scalars of a sample as bytes, each after its length, in the order of the schema."""
    parts = []
    for name, row in {**SCALARS, **OF_SEQUENCES}.items():
        if name not in scalars:
            continue
        data = scalars[name].encode() if row.is_text else np.asarray(scalars[name]).astype(row.dtype).tobytes()
        parts.append(struct.pack("<Q", len(data)) + data)
    return b"".join(parts)
