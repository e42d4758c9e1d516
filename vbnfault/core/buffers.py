"""Reuse the memory of large arrays.

The system hands out memory page by page as it is first written, which for a plane of an image takes several times
as long as to compute the plane. So the memory of such arrays is kept for the next ones of the same size.
"""

from __future__ import annotations

import ctypes
import math
import os
import threading
import weakref
from typing import Any, TypeVar

import numpy as np
from numpy.typing import DTypeLike, NDArray

T = TypeVar("T", bound=np.generic)

_LEAST_BYTES = 1 << 20  # smaller arrays come from memory that the C library keeps
_ALIGNED_BYTES = 64
_MOST_KEPT_BYTES = 256 << 20  # what the faults of a sample with 1024×1024 pixels leave


class _Kept:
    """Hold free blocks of memory by their size."""

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Hold nothing; what other threads are about to do is forgotten, too."""
        self._lock = threading.RLock()  # a block may be freed by the garbage collector anywhere
        self._free: dict[int, list[NDArray[np.uint8]]] = {}
        self._bytes = 0

    def take(self, size: int) -> NDArray[np.uint8] | None:
        """Return a free block that holds an aligned array of `size` bytes, or None."""
        with self._lock:
            blocks = self._free.get(size)
            if not blocks:
                return None
            self._bytes -= size
            return blocks.pop()

    def give(self, block: NDArray[np.uint8]) -> None:
        """Keep a free block, unless too much is kept."""
        size = len(block) - _ALIGNED_BYTES
        with self._lock:
            if self._bytes + size <= _MOST_KEPT_BYTES:
                self._bytes += size
                self._free.setdefault(size, []).append(block)

    def clear(self) -> None:
        """Free all blocks."""
        with self._lock:
            self._free.clear()
            self._bytes = 0


_kept = _Kept()

if hasattr(os, "register_at_fork"):  # another thread of the parent may hold the lock at that moment
    os.register_at_fork(after_in_child=_kept.reset)


def empty(shape: tuple[int, ...], dtype: DTypeLike = np.float32) -> NDArray[Any]:
    """Return an array whose values are not set, as `numpy.empty`.

    Its memory is kept for another array once the array and all its views are gone. It begins at a multiple of 64
    bytes if the array has a MiB or more.
    """
    of_type = np.dtype(dtype)
    size = math.prod(shape) * of_type.itemsize
    if size < _LEAST_BYTES:
        return np.empty(shape, of_type)
    block = _kept.take(size)
    if block is None:
        block = np.empty(size + _ALIGNED_BYTES, np.uint8)
    # the array and its views hold this object, but not the block alone
    owner = (ctypes.c_ubyte * size).from_buffer(block.data, -block.ctypes.data % _ALIGNED_BYTES)
    weakref.finalize(owner, _kept.give, block).atexit = False
    array: NDArray[Any] = np.frombuffer(memoryview(owner), of_type).reshape(shape)
    return array


def zeros(shape: tuple[int, ...], dtype: DTypeLike = np.float32) -> NDArray[Any]:
    """Return an array of zeros in memory as that of `empty`."""
    out = empty(shape, dtype)
    out.fill(0)
    return out


def copy(array: NDArray[T]) -> NDArray[T]:
    """Return a copy of an array in memory as that of `empty`."""
    out = empty(array.shape, array.dtype)
    out[...] = array
    return out


def aligned(array: NDArray[T]) -> NDArray[T]:
    """Return a contiguous array, or a copy of it, that begins at a multiple of 64 bytes.

    drjit uses numpy's memory as it is, and compiles another kernel for each set of arrays that begin elsewhere.
    """
    if array.flags.c_contiguous and array.ctypes.data % _ALIGNED_BYTES == 0:
        return array
    if array.nbytes >= _LEAST_BYTES:
        return copy(array)
    memory = np.empty(array.nbytes + _ALIGNED_BYTES, np.uint8)
    start = -memory.ctypes.data % _ALIGNED_BYTES
    out: NDArray[T] = memory[start : start + array.nbytes].view(array.dtype).reshape(array.shape)
    out[...] = array
    return out


def flat(array: NDArray[T]) -> NDArray[T]:
    """Return `aligned` of an array in one dimension, as drjit takes it."""
    return aligned(array).reshape(-1)


def clear() -> None:
    """Free the memory that is kept for coming arrays."""
    _kept.clear()
