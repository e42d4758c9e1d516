"""Keep the results of the stages of a study, and compute again only what differs in what it depends on."""

from __future__ import annotations

import contextlib
import time
from collections import Counter, OrderedDict
from collections.abc import Callable, Hashable, Iterator
from typing import Any, TypeVar

from ..core.shared_results import SharedResults

T = TypeVar("T")

# How many results of each stage are kept beside those of the base row A of a Sobol design; default: two.
_KEPT = {"render": 1}


class Kept:
    """Keep the last results of each stage, and count and time the computations.

    Attributes
    ----------
    events
        How often each stage was computed.
    seconds
        How long that took.
    """

    def __init__(self) -> None:
        self.events: Counter[str] = Counter()
        self.seconds: dict[str, float] = {}
        self._results: dict[str, OrderedDict[Hashable, Any]] = {}
        self._held: dict[str, set[tuple[str, Hashable]]] = {}
        self._holder: str | None = None

    @contextlib.contextmanager
    def holding(self, holder: str) -> Iterator[None]:
        """Hold what a block uses until the next block of the same holder, in place of what that one used."""
        self._held[holder], self._holder = set(), holder
        try:
            yield
        finally:
            self._holder = None

    def once(self, stage: str, key: Hashable, make: Callable[[], T], part: str = "") -> T:
        """Return `make()` for a key, from the last results of the stage where it was computed before.

        `part` separates results of one stage that have keys of their own.
        """
        name = f"{stage}/{part}"
        results = self._results.setdefault(name, OrderedDict())
        if self._holder is not None:
            self._held[self._holder].add((name, key))
        if key not in results:
            with self.timed(stage):
                results[key] = make()
            if not part:
                self.events[stage] += 1
        value: T = results[key]
        results.move_to_end(key)
        held = set().union(*self._held.values())
        loose = [other for other in results if (name, other) not in held]
        for other in loose[: max(len(loose) - _KEPT.get(stage, 2), 0)]:
            del results[other]
        return value

    def release(self, holder: str) -> None:
        """Stop holding what a block used."""
        self._held.pop(holder, None)

    @contextlib.contextmanager
    def timed(self, stage: str) -> Iterator[None]:
        """Add the duration of a block to a stage."""
        start = time.perf_counter()
        try:
            yield
        finally:
            self.seconds[stage] = self.seconds.get(stage, 0.0) + time.perf_counter() - start

    def of_view(self, view: Hashable) -> SharedResults:
        """Return results of the pipeline's stages that evaluations with an equal `view` share."""
        return _OfView(self, view)


class _OfView(SharedResults):
    """Keep the results of one view among those of all views."""

    def __init__(self, kept: Kept, view: Hashable) -> None:
        super().__init__(kept=True)
        self._all, self._view = kept, view

    def once(self, name: str, key: Hashable, make: Callable[[], T]) -> T:
        """Return `make()` for a name and a key, from the last results where it was computed before."""
        return self._all.once(name, (self._view, key), make, "view")
