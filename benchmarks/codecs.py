"""Measure the bytes, and the time to encode and to decode, of each layer of a store with many codecs.

    python benchmarks/codecs.py paper67p.zarr physical67p.zarr --samples 6 [--layer depth_m ...] \
        [--candidate "blosc zstd"] [--json table.json]

Every layer of some finished samples is encoded with every candidate in one thread, and decoded again; the decoded
bytes must be equal. The codecs in `vbnfault/store/arrays.py` were chosen from such tables. A candidate marked `*`
cannot be chosen: its codec is not in the Zarr v3 specification, so that readers such as zarrita.js lack it. PNG and
JPEG XL (with `imagecodecs` installed) show what a codec that predicts a pixel from its neighbours would gain.
"""

from __future__ import annotations

import argparse
import functools
import json
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numcodecs import LZ4, Blosc, GZip, PackBits, Zstd
from numpy.typing import NDArray

from vbnfault import store

Bytes = bytes | bytearray | memoryview
# 0: Blosc's own choice, 32 KiB for Zstd 1; each block has tables of its own, which are built before it is decoded
BLOCKS_BYTES = (0, 2**17, 2**18, 2**19, 2**20)


@dataclass(frozen=True)
class Candidate:
    """Hold one way to encode a layer: `encode` takes an array, `decode` returns its bytes."""

    name: str
    encode: Callable[[NDArray[Any]], Bytes]
    decode: Callable[[Bytes], Any]


def as_words(array: NDArray[Any], size: int) -> NDArray[Any]:
    """Return the bytes of an array as words of `size` bytes, between which Blosc shuffles."""
    return np.frombuffer(np.ascontiguousarray(array).tobytes(), dtype=f"V{size}")


def blosc(library: str, level: int, shuffle: str, size: int, block: int = 0) -> Candidate:
    """Return Blosc with words of `size` bytes, in blocks of `block` bytes; 0: as Blosc chooses them."""
    codec = Blosc(cname=library, clevel=level, shuffle=getattr(Blosc, shuffle.upper()), blocksize=block)
    name = f"blosc {library} {level} {shuffle} {size}"
    return Candidate(f"{name} {block}" if block else name, lambda a: codec.encode(as_words(a, size)), codec.decode)


def candidates(array: NDArray[Any]) -> Iterator[Candidate]:
    """Yield the candidates for a layer, of which `array` is one sample."""
    for level in (1, 3, 6, 9):
        zstd = Zstd(level=level, checksum=True)
        yield Candidate(f"zstd {level}", zstd.encode, zstd.decode)
    gzip, lz4 = GZip(level=5), LZ4()
    yield Candidate("gzip 5", gzip.encode, gzip.decode)
    yield Candidate("lz4", lz4.encode, lz4.decode)
    sizes = {array.itemsize} | ({array.itemsize * array.shape[-1]} if array.shape[-1] in (3, 4) else set())
    if array.dtype == np.uint8:
        sizes.add(2)  # Blosc shuffles the bits of single bytes without vector instructions
    for size in sorted(sizes):
        for shuffle in ("shuffle", "bitshuffle"):
            for library, level in (("lz4", 5), ("zstd", 1), ("zstd", 3), ("zstd", 5), ("zstd", 7)):
                for block in BLOCKS_BYTES if library == "zstd" and level <= 3 else (0,):
                    yield blosc(library, level, shuffle, size, block)
    if array.dtype == bool:
        bits, zstd = PackBits(), Zstd(level=1)
        yield Candidate(
            "* packbits, zstd 1", lambda a: zstd.encode(bits.encode(a)), lambda b: bits.decode(zstd.decode(b))
        )
    if array.dtype in (np.uint8, np.uint16) and array.ndim in (2, 3):
        yield Candidate(
            "* PNG",
            lambda a: cv2.imencode(".png", a, [cv2.IMWRITE_PNG_COMPRESSION, 3])[1].tobytes(),
            lambda b: cv2.imdecode(np.frombuffer(b, np.uint8), cv2.IMREAD_UNCHANGED),
        )
        try:
            import imagecodecs
        except ImportError:
            return
        for effort in (1, 3):
            yield Candidate(
                f"* JPEG XL {effort}",
                lambda a, effort=effort: imagecodecs.jpegxl_encode(a, effort=effort, lossless=True),
                imagecodecs.jpegxl_decode,
            )


def timed(action: Callable[[], Any], rounds: int) -> tuple[float, Any]:
    """Return the least duration in s of some calls, and the result."""
    seconds = []
    for _ in range(rounds):
        start = time.perf_counter()
        result = action()
        seconds.append(time.perf_counter() - start)
    return min(seconds), result


def measure(samples: list[NDArray[Any]], rounds: int, begins: str = "") -> dict[str, dict[str, float]]:
    """Return by candidate the mean bytes of a layer's samples, and the mean ms to encode and to decode."""
    table: dict[str, dict[str, float]] = {}
    for candidate in candidates(samples[0]):
        if not candidate.name.startswith(begins):
            continue
        totals = np.zeros(3)
        for array in samples:
            encoding, data = timed(functools.partial(candidate.encode, array), rounds)
            decoding, back = timed(functools.partial(candidate.decode, data), rounds)
            plain = back.tobytes() if isinstance(back, np.ndarray) else bytes(back)
            assert plain == array.tobytes(), f"{candidate.name} changes the data"
            totals += [len(data), 1e3 * encoding, 1e3 * decoding]
        size, encode_ms, decode_ms = totals / len(samples)
        table[candidate.name] = {"bytes": size, "encode_ms": encode_ms, "decode_ms": decode_ms}
    return table


def main() -> None:
    """Print a table for each store and layer."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("stores", nargs="+")
    parser.add_argument("--samples", type=int, default=4, help="samples of each store, spread over it")
    parser.add_argument("--rounds", type=int, default=3, help="of each the fastest counts")
    parser.add_argument("--layer", action="append", help="only these layers")
    parser.add_argument("--candidate", default="", help="only candidates whose name begins so")
    parser.add_argument("--json", help="also write the numbers to this file")
    options = parser.parse_args()
    results: dict[str, Any] = {}
    for path in options.stores:
        opened = store.open_store(path)
        chosen = sorted(set(np.linspace(0, opened.samples - 1, options.samples).astype(int).tolist()))
        samples = [opened.read_sample(i).layers for i in chosen]
        print(f"{path}: {opened.spec.height} x {opened.spec.width} px, samples {chosen}")
        for layer in options.layer or opened.spec.pixel_layers:
            table = measure([sample[layer] for sample in samples], options.rounds, options.candidate)
            results.setdefault(str(path), {})[layer] = table
            print(f"\n{layer}, {samples[0][layer].nbytes} bytes uncompressed")
            print(f"{'codec':34s} {'bytes':>10s} {'encode ms':>10s} {'decode ms':>10s}")
            for name, row in sorted(table.items(), key=lambda item: item[1]["bytes"]):
                print(
                    f"{name:34s} {row['bytes']:10.0f} {row['encode_ms']:10.1f} {row['decode_ms']:10.1f}", flush=True
                )
    if options.json:
        with open(options.json, "w", encoding="utf-8") as file:
            json.dump(results, file, indent=1)


if __name__ == "__main__":
    main()
