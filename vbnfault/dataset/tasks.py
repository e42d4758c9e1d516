"""Define the tasks of a build, the order in which workers get them, and how a task is done.

A task completes one shard: it makes and writes the missing samples. Tasks are assigned by site, so that a worker
loads the terrain of a site once.
"""

from __future__ import annotations

import functools
import heapq
import traceback
from collections import Counter, deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from .. import store as store_module
from ..core import activity
from ..core.errors import InputChanged, VbnfaultError
from ..core.interrupts import check, finishing
from ..core.quantities import Sample
from ..store import Encoded, Planned, SampleDigests, Store
from .errors import BuildFailed
from .progress import Progress

_HOPELESS = 32  # after so many failures without one success, the build stops: the others would fail, too


class SampleMaker(Protocol):
    """Make samples. An object may keep costly data between samples, such as the terrain of a site."""

    def simulate(self, index: int) -> Sample:
        """Return a sample, which must not depend on the samples simulated before."""
        ...


SessionFactory = Callable[[], SampleMaker]


# Arguments: the sample; an event: "begun", "stage", "kept", "built" or "failed"; a text. The text is the stage's
# name, the digest (hex) of a kept or built sample, or one line and the traceback of a failure.
Tick = Callable[[int, str, str], None]


@dataclass(frozen=True, kw_only=True)
class Task:
    """Describe the task to complete one shard.

    Attributes
    ----------
    sites
        Site of each sample of the shard.
    unplanned
        Finished samples that differ from the plan and must be rebuilt.
    skip
        Samples that must not be tried.
    careful
        Write every sample as soon as it is made, because the process may die at the next one.
    """

    shard: int
    sites: tuple[int, ...]
    unplanned: frozenset[int] = frozenset()
    skip: frozenset[int] = frozenset()
    careful: bool = False


def work(simulate: Callable[[int], Sample], store: Store, task: Task, tick: Tick) -> None:
    """Do a task; a sample that fails is reported and left out.

    If an interrupt ends the task early, the finished samples are still written. If `tick` raises OSError, they are
    not: the build that started this worker has ended, and another build may have begun.
    """
    checked = store_module.examine_shard(store, task.shard, labels=True)
    wanted = checked.wanted | task.unplanned
    samples = store.shard(task.shard)
    made: dict[int, Encoded] = {}
    pending = set(wanted)
    lost: set[int] = set()

    def write(given: dict[int, Encoded]) -> None:
        lost.update(store.write_shard(task.shard, given, damaged=pending - set(given)))
        pending.difference_update(given)

    try:
        for i in samples:
            if i not in wanted:
                tick(i, "kept", checked.digests[i].hex())
        for i in sorted(wanted - task.skip, key=lambda i: (task.sites[i - samples.start], i)):
            check()
            tick(i, "begun", "")
            try:
                with activity.reported_to(functools.partial(tick, i, "stage")):
                    encoded = store_module.encode(store.spec, simulate(i))
            except Exception as error:
                check()
                tick(i, "failed", describe(error))
                continue
            made[i] = encoded
            if task.careful:
                write({i: made.pop(i)})
            tick(i, "built", encoded.digest.hex())
    except OSError:
        made.clear()
        raise
    finally:
        with finishing():
            if made:
                write(made)
    if lost:
        named = ", ".join(map(str, sorted(lost)))
        raise VbnfaultError(
            f"{store.path}: the files of sample {named} were whole and no longer are; the same command builds "
            "what is lost again"
        )


def describe(error: Exception) -> str:
    """Return one line on an error, then its traceback."""
    frame = traceback.extract_tb(error.__traceback__)[-1]
    if isinstance(error, VbnfaultError):
        line = str(error)
    else:
        line = f"{type(error).__name__}: {error} ({Path(frame.filename).name}:{frame.lineno})"
    return " ".join(line.split()) + "\n" + "".join(traceback.format_exception(error))


class Run:
    """Assign the tasks of a build by site, and collect their results."""

    def __init__(
        self,
        store: Store,
        sites: NDArray[np.integer[Any]],
        progress: Progress,
        expected: Planned | None = None,
        *,
        exact: bool = False,
    ) -> None:
        self.store, self.sites, self.progress = store, sites, progress
        self._expected, self._exact = expected, exact
        self.built = 0
        self.digests = SampleDigests(store.samples)
        self.failures: dict[int, str] = {}
        self._outcome: dict[int, str] = {}
        self._by_site: dict[int, deque[int]] = {}
        for shard in range(store.shards):
            self._by_site.setdefault(self.lead(shard), deque()).append(shard)
        self._begun = frozenset(store.begun())
        # heap of sites, those with the most shards left first; an entry is updated when it is taken out
        self._longest = [(-len(queue), site) for site, queue in self._by_site.items()]
        heapq.heapify(self._longest)

    def lead(self, shard: int) -> int:
        """Return the site by which a shard is assigned: that of its first sample."""
        return int(self.sites[self.store.shard(shard).start])

    def task(self, shard: int, skip: frozenset[int] = frozenset(), *, careful: bool = False) -> Task:
        """Return the task that completes a shard; for `skip` and `careful` see `Task`."""
        samples = self.store.shard(shard)
        sites = tuple(int(s) for s in self.sites[samples.start : samples.stop])
        unplanned: set[int] = set()
        if self._expected is not None and shard in self._begun:
            unplanned = store_module.unplanned_samples(self.store, shard, self._expected, exact=self._exact)
        return Task(shard=shard, sites=sites, unplanned=frozenset(unplanned), skip=skip, careful=careful)

    def next_shard(self, last: int | None = None, busy: Sequence[int] = ()) -> int | None:
        """Return the shard that a worker does after the shard `last`; None if none is left.

        It is a shard of the same site, if one is left. Otherwise it comes from the site that has the fewest of the
        `busy` shards, and among equal sites from the one with the most shards left.
        """
        if last is None or not self._by_site[self.lead(last)]:
            site = self._next_site(Counter(self.lead(shard) for shard in busy))
        else:
            site = self.lead(last)
        return None if site is None else self._by_site[site].popleft()

    def _next_site(self, taken: Counter[int]) -> int | None:
        """Return, among sites with shards left, the one with the fewest `taken`, then with the most left."""
        passed: list[tuple[int, int]] = []
        while self._longest:
            length, site = heapq.heappop(self._longest)
            left = len(self._by_site[site])
            if left and left != -length:
                heapq.heappush(self._longest, (-left, site))
            elif left:
                passed.append((length, site))
                if not taken[site]:
                    break
        for entry in passed:
            heapq.heappush(self._longest, entry)
        return min(passed, key=lambda entry: (taken[entry[1]], *entry))[1] if passed else None

    def tick(self, sample: int, what: str, text: str) -> None:
        """Record an event of a sample, see `Tick`. Raises BuildFailed after too many failures without a success."""
        if what == "begun":
            return
        if what == "stage":
            self.progress.stage(text)
            return
        before = self._outcome.get(sample)
        self._outcome[sample] = what
        self.built += (what == "built") - (before == "built")
        if what == "failed":
            self.failures[sample] = text
            self.progress.say(f"sample {sample} failed: {text.splitlines()[0]}")
        else:
            self.failures.pop(sample, None)
            self.digests.add({sample: bytes.fromhex(text)})
        if before is None:
            self.progress.advance(what == "built")
        if self.built == 0 and len(self.failures) >= _HOPELESS:
            self.raise_failures(" before any succeeded, so the build was stopped")

    def raise_failures(self, why: str = "") -> None:
        """Raise BuildFailed with the failed samples, if there are any."""
        if not self.failures:
            return
        failed = sorted(self.failures)
        first = self.failures[failed[0]].splitlines()[0]
        names = ", ".join(map(str, failed[:8])) + (", ..." if len(failed) > 8 else "")
        listed = f"sample {names}" if len(failed) == 1 else f"{len(failed)} samples ({names})"
        raise BuildFailed(
            f"{self.store.path}: {listed} failed{why}, the first with: {first}; "
            f"all others are kept, and the same command tries the failed ones again",
            self.failures,
        )


class Lazy:
    """Make a session when the first sample needs it: a complete shard needs none."""

    def __init__(self, factory: SessionFactory) -> None:
        self._factory = factory
        self._session: SampleMaker | None = None

    def simulate(self, index: int) -> Sample:
        """Return a sample. Raises Fatal if no session can be made, or if an input file has changed."""
        if self._session is None:
            try:
                self._session = self._factory()
            except VbnfaultError as error:
                raise Fatal(error) from error
            except Exception as error:
                check()
                raise Fatal(VbnfaultError(describe(error).splitlines()[0])) from error
        try:
            return self._session.simulate(index)
        except InputChanged as error:  # every other sample would fail, too
            raise Fatal(error) from error


class Fatal(BaseException):
    """Carry an error that ends the whole build. As a BaseException it passes the handler of a failed sample."""

    def __init__(self, error: VbnfaultError) -> None:
        super().__init__(error)
        self.error = error


def run_here(factory: SessionFactory, run: Run) -> None:
    """Do all tasks of a run in this process."""
    session = Lazy(factory)
    shard = run.next_shard()
    while shard is not None:
        try:
            work(session.simulate, run.store, run.task(shard), run.tick)
        except Fatal as fatal:
            raise fatal.error from fatal
        shard = run.next_shard(shard)
