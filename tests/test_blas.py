"""BLAS uses one thread while samples are made, and as many as before afterwards."""

from __future__ import annotations

from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from threadpoolctl import threadpool_info, threadpool_limits

from vbnfault.pipeline.stages import simulate_frame


def threads() -> set[int]:
    """Return the numbers of threads of the BLAS libraries that are loaded."""
    return {library["num_threads"] for library in threadpool_info() if library["user_api"] == "blas"}


@pytest.fixture(autouse=True)
def two_threads() -> Iterator[None]:
    """Let BLAS use two threads, whatever the machine has."""
    np.ones((2, 2)) @ np.ones((2, 2))
    with threadpool_limits(limits=2, user_api="blas"):
        if threads() != {2}:
            pytest.skip(f"the BLAS libraries of this machine use {threads()} threads where two were asked for")
        yield


def test_a_sample_is_made_with_one_thread_also_if_it_fails() -> None:
    seen = []

    def failing(*_: Any, **__: Any) -> Any:
        seen.append(threads())
        raise ZeroDivisionError

    spec: Any = SimpleNamespace(of_view=SimpleNamespace(index=0))
    with pytest.raises(ZeroDivisionError):
        simulate_frame(spec, failing)
    assert seen == [{1}]
    assert threads() == {2}
