"""Keep results that several samples of one view need."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from typing import Any, TypeVar

T = TypeVar("T")


class SharedResults:
    """Keep the last result of each name, so that the samples of a view compute it once.

    Parameters
    ----------
    kept
        Whether results are kept. Without it each call computes its result anew and no memory is held, which is best
        where a view has one sample.
    """

    def __init__(self, *, kept: bool = False) -> None:
        self.kept = kept
        self._last: dict[str, tuple[Hashable, Any]] = {}

    def once(self, name: str, key: Hashable, make: Callable[[], T]) -> T:
        """Return `make()`, or the kept result of the same name and key, which must not be changed.

        `key` holds everything on which the result depends, except the view. Another key of the same name replaces
        the kept result: most of them are large.
        """
        if not self.kept:
            return make()
        last = self._last.get(name)  # another thread may replace it
        if last is None or last[0] != key:
            self._last.pop(name, None)  # before the next one is made
            self._last[name] = last = key, make()
        result: T = last[1]
        return result
