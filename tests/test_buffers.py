"""Memory of large arrays is used again, and only once nobody can see the array."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Iterator

import numpy as np
import pytest

from vbnfault.core import buffers, memory

SHAPE = (512, 1024, 3)  # 6 MB


@pytest.fixture(autouse=True)
def empty_pool() -> Iterator[None]:
    buffers.clear()
    yield
    buffers.clear()


def address(array: np.ndarray) -> int:
    return int(array.ctypes.data)


def test_memory_is_used_again_once_the_last_view_is_gone() -> None:
    first = buffers.empty(SHAPE)
    assert (first.shape, first.dtype) == (SHAPE, np.float32)
    assert address(first) % 64 == 0
    where, part = address(first), first[7:9, ::2]
    del first
    second = buffers.empty(SHAPE)
    assert address(second) != where, "a view of the first array still shows its memory"
    part[:] = 1
    del part
    assert address(buffers.empty((*SHAPE, 1))) == where
    assert address(buffers.empty((SHAPE[0], SHAPE[1] - 1, 3))) != where, "the size differs"
    same_size = buffers.empty((*SHAPE, 4), np.uint8)
    assert address(same_size) == where
    # a frozen array leaves memory that can be written again
    same_size.flags.writeable = False
    del same_size
    third = buffers.zeros(SHAPE)
    assert address(third) == where
    assert not third.any()
    copied = buffers.copy(third + 1)
    assert (copied == 1).all()
    assert copied.flags.writeable
    assert copied.flags.c_contiguous


def test_a_copy_is_made_only_of_arrays_that_are_not_aligned() -> None:
    for size in (1000, 3_000_000):
        memory = np.arange(size + 16, dtype=np.float32)
        first = -address(memory) % 64 // 4
        there = memory[first : first + size]
        assert buffers.aligned(there) is there
        for other in (memory[first + 1 : first + 1 + size], memory[first:][: size // 2 * 2].reshape(-1, 2).T):
            copied = buffers.aligned(other)
            assert address(copied) % 64 == 0
            assert copied.flags.c_contiguous
            np.testing.assert_array_equal(copied, other)


def test_small_arrays_and_too_much_memory_are_not_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    assert buffers.empty((10, 10)).base is None
    monkeypatch.setattr(buffers, "_MOST_KEPT_BYTES", 7 << 20)
    arrays = [buffers.empty(SHAPE) for _ in range(3)]
    del arrays
    assert buffers._kept._bytes == 6 << 20
    buffers.clear()
    assert buffers._kept._bytes == 0
    assert not buffers._kept._free


def test_a_process_that_holds_much_gives_back_what_is_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    array = buffers.empty(SHAPE)
    del array
    assert buffers._kept._bytes
    memory.release_unused()
    assert buffers._kept._bytes, "the process holds little"
    monkeypatch.setattr(memory, "_MOST", 0)
    memory.release_unused()
    assert not buffers._kept._bytes


@pytest.mark.skipif(not hasattr(os, "fork"), reason="the system has no fork")
@pytest.mark.filterwarnings("ignore:This process:DeprecationWarning")
def test_a_forked_process_does_not_wait_for_a_thread_that_it_lacks() -> None:
    """Loaders of training data fork, maybe while another thread takes memory."""
    holds, done = threading.Event(), threading.Event()

    def hold() -> None:
        with buffers._kept._lock:
            holds.set()
            done.wait()

    thread = threading.Thread(target=hold)
    thread.start()
    holds.wait()
    child = os.fork()
    if not child:
        signal.alarm(20)
        buffers.clear()
        os._exit(0 if buffers.empty(SHAPE).shape == SHAPE else 1)
    _, status = os.waitpid(child, 0)
    done.set()
    thread.join()
    assert os.waitstatus_to_exitcode(status) == 0
