"""A task is a shard: what it lacks is made and written. Tasks are handed out by site, so that a worker loads a
site's terrain once.
"""

from __future__ import annotations

import functools
import heapq
import traceback
from collections import Counter, deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

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

_HOPELESS = 32  # so many failed samples and not one success: the rest would fail as well


class SampleMaker(Protocol):
    """What makes samples; it keeps between samples what is costly to make, such as the terrain of a site."""

    def simulate(self, index: int) -> Sample:
        """The sample of this index, the same whatever was simulated before."""
        ...


SessionFactory = Callable[[], SampleMaker]


# sample; what: "begun", "stage", "kept", "built" or "failed"; text: of a stage its name, of a sample that is kept
# or built its digest (hex), of one that failed a line and then the traceback
Tick = Callable[[int, str, str], None]


@dataclass(frozen=True, kw_only=True)
class Task:
    """Complete one shard. `sites`: of its samples. `unplanned`: finished, but not as planned, so to be built again.
    `skip`: not to be tried. `careful`: write every sample at once, because the process may die at the next one."""

    shard: int
    sites: tuple[int, ...]
    unplanned: frozenset[int] = frozenset()
    skip: frozenset[int] = frozenset()
    careful: bool = False


def work(simulate: Callable[[int], Sample], store: Store, task: Task, tick: Tick) -> None:
    """Do a task; a sample that fails is reported and left out.

    What was made is written also where an interrupt ends the task early, but not where `tick` finds that
    nobody listens any more: another build may have begun.
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
                with activity.told_to(functools.partial(tick, i, "stage")):
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
    """One line, then the traceback."""
    frame = traceback.extract_tb(error.__traceback__)[-1]
    if isinstance(error, VbnfaultError):
        line = str(error)
    else:
        line = f"{type(error).__name__}: {error} ({Path(frame.filename).name}:{frame.lineno})"
    return " ".join(line.split()) + "\n" + "".join(traceback.format_exception(error))


class Run:
    """The tasks of a build, handed out by site, and what came of them."""

    def __init__(
        self,
        store: Store,
        sites: NDArray[np.int64],
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
        # sites with the most shards left first; brought up to date when an entry is taken out
        self._longest = [(-len(queue), site) for site, queue in self._by_site.items()]
        heapq.heapify(self._longest)

    def lead(self, shard: int) -> int:
        """The site a shard is handed out with: that of its first sample."""
        return int(self.sites[self.store.shard(shard).start])

    def task(self, shard: int, skip: frozenset[int] = frozenset(), *, careful: bool = False) -> Task:
        """The task that completes a shard."""
        samples = self.store.shard(shard)
        sites = tuple(int(s) for s in self.sites[samples.start : samples.stop])
        unplanned: set[int] = set()
        if self._expected is not None and shard in self._begun:
            unplanned = store_module.unplanned_samples(self.store, shard, self._expected, exact=self._exact)
        return Task(shard=shard, sites=sites, unplanned=frozenset(unplanned), skip=skip, careful=careful)

    def next_shard(self, last: int | None = None, busy: Sequence[int] = ()) -> int | None:
        """What a worker does after the shard `last`: a shard of the same site if one is left, else of the
        site where the fewest of the `busy` shards are, then of the one with the most left."""
        if last is None or not self._by_site[self.lead(last)]:
            site = self._next_site(Counter(self.lead(shard) for shard in busy))
        else:
            site = self.lead(last)
        return None if site is None else self._by_site[site].popleft()

    def _next_site(self, taken: Counter[int]) -> int | None:
        """Return the site with shards left where the fewest are `taken`, of those the one with the most left."""
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
        """Note what became of a sample. Raises BuildFailed where nothing succeeds."""
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
        """Raise BuildFailed that names the failed samples, if any."""
        if not self.failures:
            return
        failed = sorted(self.failures)
        first = self.failures[failed[0]].splitlines()[0]
        names = ", ".join(map(str, failed[:8])) + (", ..." if len(failed) > 8 else "")
        many = f"sample {names}" if len(failed) == 1 else f"{len(failed)} samples ({names})"
        raise BuildFailed(
            f"{self.store.path}: {many} failed{why}, the first with: {first}; "
            f"all others are kept, and the same command tries the failed ones again",
            self.failures,
        )


class Lazy:
    """A session made when the first sample needs it: a shard that is whole needs none."""

    def __init__(self, factory: SessionFactory) -> None:
        self._factory = factory
        self._session: SampleMaker | None = None

    def simulate(self, index: int) -> Sample:
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
        except InputChanged as error:  # no other sample would be any better
            raise Fatal(error) from error


class Fatal(BaseException):
    """Carries what ends the whole build, past the handling of a single sample's failure."""

    def __init__(self, error: VbnfaultError) -> None:
        super().__init__(error)
        self.error = error


def run_here(factory: SessionFactory, run: Run) -> None:
    session = Lazy(factory)
    shard = run.next_shard()
    while shard is not None:
        try:
            work(session.simulate, run.store, run.task(shard), run.tick)
        except Fatal as fatal:
            raise fatal.error from fatal
        shard = run.next_shard(shard)
