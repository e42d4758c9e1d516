"""Limit the library behind numpy's products of matrices (BLAS) to one thread while samples are made.

The products of a sample are small, so more threads gain nothing. But a thread of OpenBLAS that waits for the next
product keeps a core busy for tens of milliseconds and takes it from render threads and OpenCV. With eight variants
a view and two cores, a sample of `paper67p` took a tenth longer for this reason.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from functools import lru_cache

from threadpoolctl import ThreadpoolController


@lru_cache(maxsize=1)
def _libraries() -> ThreadpoolController:
    """Return the libraries that are loaded at the first call; finding them takes milliseconds."""
    return ThreadpoolController()


@contextmanager
def one_thread() -> Iterator[None]:
    """Limit BLAS to one thread in a `with` block, or in a function that this decorates."""
    with _libraries().limit(limits=1, user_api="blas"):
        yield
