"""Define the tasks of a build, the order in which workers get them, and how a task is done.

A task completes one shard: it makes and writes the missing samples. Tasks are assigned by site, so that a worker
loads the terrain of a site once.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from .. import store as store_module
from ..core.errors import VbnfaultError
from ..core.process.environment import release_unused
from ..core.process.interrupts import check, finishing
from ..core.quantities import Sample
from ..store import Encoded, Location, Planned, SampleDigests, Store
from .progress import Progress
from .work import ItemsFailed, Job, Lazy, Tick, attempt, describe


class BuildFailed(ItemsFailed):
    """Report that some samples could not be made."""


class SampleMaker(Protocol):
    """Make samples. An object may keep costly data between samples, such as the terrain of a site."""

    def simulate(self, index: int) -> Sample:
        """Return a sample, which must not depend on the samples simulated before."""
        ...


SessionFactory = Callable[[], SampleMaker]


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


class SampleWorker:
    """Make the samples of tasks; the session is made when the first sample needs it.

    `factory` makes the session, `path` is the store.
    """

    def __init__(self, factory: SessionFactory, path: Location) -> None:
        self._session, self._path = Lazy(factory), path

    def do(self, task: Task, tick: Tick) -> None:
        """Do a task."""
        store = store_module.open_store(self._path, "r+")
        work(lambda index: self._session().simulate(index), store, task, tick)


def work(simulate: Callable[[int], Sample], store: Store, task: Task, tick: Tick) -> None:
    """Do a task; a sample that fails is reported and left out.

    If an interrupt ends the task early, the finished samples are still written. If `tick` raises OSError, they are
    not: the build that started this worker has ended, and another build may have begun.

    At the end, memory that is no longer used is returned to the system, so that a worker does not grow: what the C
    library and drjit keep depends on the order of the samples and varies by a fifth of the process's size.
    """
    checked = store_module.examine_shard(store, task.shard, labels=True)
    wanted = checked.wanted | task.unplanned
    samples = store.shard(task.shard)
    with ThreadPoolExecutor(1) as aside:
        shard = _Shard(store, task, tick, wanted, aside)
        try:
            for i in samples:
                if i not in wanted:
                    tick(i, "kept", checked.digests[i].hex())
            for i in sorted(wanted - task.skip, key=lambda i: (task.sites[i - samples.start], i)):
                sample = attempt(i, simulate, tick)
                if sample is not None:
                    shard.add(sample, i)
                del sample  # its layers are freed as soon as they are encoded
            shard.collect()
        except OSError:
            shard.discard()
            raise
        finally:
            with finishing():
                shard.write_rest()
                release_unused()
    if shard.lost:
        named = ", ".join(map(str, sorted(shard.lost)))
        raise VbnfaultError(
            f"{store.path}: the files of sample {named} were whole and no longer are; the same command builds "
            "what is lost again"
        )


class _Shard:
    """Encode the samples of a shard in the thread `aside` while the next ones are simulated, and write them.

    `lost` are samples that were whole and are so no longer.
    """

    def __init__(
        self, store: Store, task: Task, tick: Tick, wanted: Iterable[int], aside: ThreadPoolExecutor
    ) -> None:
        self._store, self._task, self._tick, self._aside = store, task, tick, aside
        self._shared = store_module.SharedChunks()
        self._pending = set(wanted)
        self._made: dict[int, Encoded] = {}
        self._coded: dict[int, Future[Encoded]] = {}  # at most two, to bound memory
        self.lost: set[int] = set()

    def add(self, sample: Sample, index: int) -> None:
        """Begin to encode a sample, and report the one before. A careful task waits until it is written."""
        # begun first: an interrupt ends the report, and the sample is written all the same
        self._coded[index] = self._aside.submit(store_module.encode, self._store.spec, sample, self._shared)
        self.collect(left=0 if self._task.careful else 1)

    def collect(self, left: int = 0) -> None:
        """Wait until all samples but the last `left` are encoded, and report them."""
        while len(self._coded) > left:
            i = next(iter(self._coded))
            future = self._coded.pop(i)
            try:
                encoded = self._made[i] = future.result()
            except Exception as error:
                check()
                self._tick(i, "failed", describe(error))
                continue
            if self._task.careful:
                self._write({i: self._made.pop(i)})
            self._tick(i, "built", encoded.digest.hex())

    def discard(self) -> None:
        """Forget all samples that are not written."""
        self._made.clear()
        self._coded.clear()

    def write_rest(self) -> None:
        """Write the samples that are not written yet, also one that was not reported before an interrupt."""
        for i, future in self._coded.items():
            if future.exception() is None:
                self._made[i] = future.result()
        if self._made:
            self._write(self._made)
        self.discard()

    def _write(self, given: dict[int, Encoded]) -> None:
        """Write samples into the shard."""
        self.lost.update(self._store.write_shard(self._task.shard, given, damaged=self._pending - set(given)))
        self._pending.difference_update(given)


class Run(Job):
    """Assign the tasks of a build by site, and collect their results; `shards`: all of the store by default.

    Shards that are marked as finished come last: a build of a large store begins with what is missing.
    """

    noun, task_noun, item_noun = "build", "shard", "sample"
    error = BuildFailed

    def __init__(
        self,
        store: Store,
        sites: NDArray[np.integer[Any]],
        progress: Progress,
        expected: Planned | None = None,
        *,
        exact: bool = False,
        shards: range | None = None,
    ) -> None:
        self.store, self.sites = store, sites
        leads = {shard: self.lead(shard) for shard in (range(store.shards) if shards is None else shards)}
        super().__init__(store.path, progress, leads, store.whole_shards())
        self._expected, self._exact = expected, exact
        self.digests = SampleDigests(store.samples)
        self._begun = frozenset(store.begun())

    def items(self, number: int) -> Sequence[int]:
        """Return the samples of a shard."""
        return self.store.shard(number)

    def lead(self, shard: int) -> int:
        """Return the site by which a shard is assigned: that of its first sample."""
        return int(self.sites[self.store.shard(shard).start])

    def task(self, number: int, skip: frozenset[int] = frozenset(), *, careful: bool = False) -> Task:
        """Return the task that completes a shard; for `skip` and `careful` see `Task`."""
        shard, samples = number, self.store.shard(number)
        sites = tuple(int(s) for s in self.sites[samples.start : samples.stop])
        unplanned: set[int] = set()
        if self._expected is not None and shard in self._begun:
            unplanned = store_module.unplanned_samples(self.store, shard, self._expected, exact=self._exact)
        return Task(shard=shard, sites=sites, unplanned=frozenset(unplanned), skip=skip, careful=careful)

    def keep(self, item: int, text: str) -> None:
        """Record the digest of a sample."""
        self.digests.add({item: bytes.fromhex(text)})
