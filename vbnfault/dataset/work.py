"""Define what worker processes do, whatever it is: a build makes samples, a study evaluates points.

A `Job` has numbered tasks; each completes a group of numbered items and says what happens to them by a `Tick`. The
`Pool` of `processes.py`, `run_on_dask` of `dask.py` and `run_here` have workers do all tasks of a job.
"""

from __future__ import annotations

import heapq
import traceback
from collections import Counter, deque
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Generic, Protocol, TypeVar

from ..core.errors import InputChanged, VbnfaultError
from ..core.process import activity
from ..core.process.interrupts import check
from .progress import Progress

T = TypeVar("T")

_HOPELESS = 32  # after so many failures without one success a job stops: the others would fail, too

# Arguments: the item; an event: "begun", "stage", "kept", "built" or "failed"; a text: the name of the stage,
# what a job needs to know of a kept or built item, or one line and the traceback of a failure.
Tick = Callable[[int, str, str], None]


class Worker(Protocol):
    """Do tasks of a job in one process. It may keep costly data between tasks, such as the terrain of a site."""

    def do(self, task: Any, tick: Tick) -> None:
        """Do a task. What comes of an item must not depend on the tasks done before.

        Raises Fatal, or VbnfaultError where files cannot be written, to end the whole job.
        """
        ...


# A picklable function that makes a worker, in the process in which it works.
WorkerFactory = Callable[[], Worker]


class ItemsFailed(VbnfaultError):
    """Report that some items of a job failed.

    `failures`: by item, one line and the traceback, or a sentence on how its worker ended.
    """

    def __init__(self, sentence: str, failures: Mapping[int, str] | None = None) -> None:
        super().__init__(sentence)
        self.failures = dict(failures or {})


class Job:
    """Hand out tasks and collect what becomes of their items; the base class of all jobs.

    Parameters
    ----------
    path
        Where the results are written, for messages.
    progress
        Where they are counted.
    leads
        The lead of each task by its number, see `Queue`.
    later
        Tasks that are assigned when all others are.

    Attributes
    ----------
    noun, task_noun, item_noun
        What messages call the job, a task and an item.
    failures
        By failed item, as in `ItemsFailed`.
    """

    noun: str
    task_noun: str
    item_noun: str
    error: type[ItemsFailed] = ItemsFailed  # what `raise_failures` raises
    successes: Collection[str] = ("built",)  # events after which further failures do not stop the job
    most_failures: int | None = _HOPELESS  # before the first success; None: failures do not stop the job

    def __init__(
        self, path: Any, progress: Progress, leads: Mapping[int, int], later: Collection[int] = frozenset()
    ) -> None:
        self.path, self.progress, self.tasks = path, progress, len(leads)
        self._queues = (
            Queue(leads, [n for n in leads if n not in later]),
            Queue(leads, [n for n in leads if n in later]),
        )
        self._outcome: dict[int, str] = {}
        self._counts: Counter[str] = Counter()  # of the outcomes
        self.failures: dict[int, str] = {}

    def items(self, number: int) -> Sequence[int]:
        """Return the items of a task."""
        raise NotImplementedError

    def task(self, number: int, skip: frozenset[int] = frozenset(), *, careful: bool = False) -> Any:
        """Return a task as its worker gets it.

        `skip`: items that must not be tried. `careful`: write every item as soon as it is made, because the process
        may die at the next one.
        """
        raise NotImplementedError

    def keep(self, item: int, text: str) -> None:
        """Record what a tick says of an item that is kept or built."""

    @property
    def built(self) -> int:
        """Return the number of items that were made."""
        return self._counts["built"]

    def next_task(self, last: int | None = None, busy: Sequence[int] = ()) -> int | None:
        """Return the task that a worker does after the task `last`; None if none is left.

        `busy`: tasks that other workers do.
        """
        tasks = (queue.next(last, busy) for queue in self._queues)
        return next((task for task in tasks if task is not None), None)

    def tick(self, item: int, what: str, text: str) -> None:
        """Record an event of an item, see `Tick`. A task whose process died is done again.

        Raises what `raise_failures` raises after too many failures without a success.
        """
        if what == "stage":
            self.progress.stage(text)
        if what in ("begun", "stage"):
            return
        before = self._outcome.get(item)
        self._outcome[item] = what
        self._counts.subtract([before] if before else [])
        self._counts.update([what])
        if what == "failed":
            self.failures[item] = text
            self.progress.say(f"{self.item_noun} {item} failed: {text.splitlines()[0]}")
        else:
            self.failures.pop(item, None)
            self.keep(item, text)
        if before is None:
            self.progress.advance(what == "built")
        most = self.most_failures or len(self.failures) + 1
        if len(self.failures) >= most and not any(self._counts[success] for success in self.successes):
            self.raise_failures(f" before any succeeded, so the {self.noun} was stopped")

    def raise_failures(self, why: str = "", kept: str = "", of: str = "", **more: Any) -> None:
        """Raise an error that names the failed items, if there are any.

        `kept` says what is kept of the others, and `of` how many there are in all, such as " of 320".
        """
        if not self.failures:
            return
        failed, noun = sorted(self.failures), self.item_noun
        names = ", ".join(map(str, failed[:8])) + (", ..." if len(failed) > 8 else "")
        listed = f"{noun} {names}" if len(failed) == 1 else f"{len(failed)} {noun}s ({names})"
        first = self.failures[failed[0]].splitlines()[0].rstrip(".")
        raise self.error(
            f"{self.path}: {listed}{of} failed{why}, the first with: {first}; "
            f"{kept or f'all other {noun}s are kept'}; the same command tries the failed ones again",
            self.failures,
            **more,
        )


class SingleItems(Job):
    """Hand out tasks of one item each, with the same number; if an item fails, the others are made."""

    most_failures = None

    def items(self, number: int) -> Sequence[int]:
        """Return the item of a task."""
        return (number,)

    def task(self, number: int, skip: frozenset[int] = frozenset(), *, careful: bool = False) -> int:
        """Return a task as its worker gets it: its number."""
        return number


class Queue:
    """Assign tasks so that a worker stays with one lead, such as a site, whose costly data it keeps.

    `leads`: the lead of each task by its number. `tasks`: the tasks to assign.
    """

    def __init__(self, leads: Mapping[int, int], tasks: Iterable[int]) -> None:
        self._leads = leads
        self._by_lead: dict[int, deque[int]] = {}
        for task in tasks:
            self._by_lead.setdefault(leads[task], deque()).append(task)
        # heap of leads, those with the most tasks left first; an entry is updated when it is taken out
        self._longest = [(-len(tasks), lead) for lead, tasks in self._by_lead.items()]
        heapq.heapify(self._longest)

    def next(self, last: int | None = None, busy: Sequence[int] = ()) -> int | None:
        """Return the task that a worker does after the task `last`; None if none is left.

        It is a task of the same lead, if one is left. Otherwise it comes from the lead that has the fewest of the
        `busy` tasks, and among equal leads from the one with the most tasks left.
        """
        lead = None if last is None else self._leads[last]
        if lead is None or not self._by_lead.get(lead):
            lead = self._next_lead(Counter(self._leads[task] for task in busy))
        return None if lead is None else self._by_lead[lead].popleft()

    def _next_lead(self, taken: Counter[int]) -> int | None:
        """Return, among leads with tasks left, the one with the fewest `taken`, then with the most left."""
        passed: list[tuple[int, int]] = []
        while self._longest:
            length, lead = heapq.heappop(self._longest)
            left = len(self._by_lead[lead])
            if left and left != -length:
                heapq.heappush(self._longest, (-left, lead))
            elif left:
                passed.append((length, lead))
                if not taken[lead]:
                    break
        for entry in passed:
            heapq.heappush(self._longest, entry)
        return min(passed, key=lambda entry: (taken[entry[1]], *entry))[1] if passed else None


class Lazy(Generic[T]):
    """Make an object when it is first needed: complete tasks need none."""

    def __init__(self, factory: Callable[[], T]) -> None:
        self._factory = factory
        self._made: T | None = None

    def __call__(self) -> T:
        """Return the object. Raises Fatal if it cannot be made."""
        if self._made is None:
            try:
                self._made = self._factory()
            except VbnfaultError as error:
                raise Fatal(error) from error
            except Exception as error:
                check()
                raise Fatal(VbnfaultError(describe(error).splitlines()[0])) from error
        return self._made


class Fatal(BaseException):
    """Carry an error that ends the whole job. As a BaseException it passes the handler of a failed item."""

    def __init__(self, error: VbnfaultError) -> None:
        super().__init__(error)
        self.error = error


def attempt(item: int, make: Callable[[int], T], tick: Tick) -> T | None:
    """Return `make(item)`; None if it fails, which is reported.

    Raises Fatal if an input file has changed: every other item would fail, too.
    """
    check()
    tick(item, "begun", "")
    try:
        with activity.reported_to(partial(tick, item, "stage")):
            return make(item)
    except InputChanged as error:
        raise Fatal(error) from error
    except Exception as error:
        check()
        tick(item, "failed", describe(error))
        return None


def describe(error: Exception) -> str:
    """Return one line on an error, then its traceback."""
    frame = traceback.extract_tb(error.__traceback__)[-1]
    if isinstance(error, VbnfaultError):
        line = str(error)
    else:
        line = f"{type(error).__name__}: {error} ({Path(frame.filename).name}:{frame.lineno})"
    return " ".join(line.split()) + "\n" + "".join(traceback.format_exception(error))


def run_here(factory: WorkerFactory, job: Job) -> None:
    """Do all tasks of a job in this process."""
    worker = factory()
    number = job.next_task()
    while number is not None:
        try:
            worker.do(job.task(number), job.tick)
        except Fatal as fatal:
            raise fatal.error from fatal
        number = job.next_task(number)
