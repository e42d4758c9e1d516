"""Run the tasks of a job, such as a build, in worker processes on this machine.

A worker process is replaced after a number of tasks, before it grows too large, and when it dies.

Two libraries were tried in place of this pool, with the same tasks and tests: `loky` 3.7, and a `LocalCluster` of
Dask 2026.8 below `dask.py`. Measured with two workers, on two cores that other programs loaded:

====================================  ==============  ======================  ============================
figure                                this pool       loky                    LocalCluster
====================================  ==============  ======================  ============================
lines of this module, without this    245             171                     50, on top of `dask.py`
further required packages             none            loky, cloudpickle       dask, distributed and theirs
processor time of 24 small samples    8.0 s           8.0 s                   9.2 s
processor time of a task of 4         42 ms           43 ms                   124 ms
a sample that kills its worker twice  fails alone     the build ends          the build ends
samples not made in that build        1 of 40         34 of 40                16 of 40
Ctrl-C from a terminal                one sentence    not measured            tracebacks of its processes
====================================  ==============  ======================  ============================

If one worker dies, loky kills all of them and does not say which one died. A healthy shard was therefore blamed
and ended the build. The workers of the local cluster did not come back within ten minutes. On a cluster that a user
runs, Dask does replace them (`tests/test_build_dask.py`).
"""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
import sys
import threading
from collections import Counter, deque
from collections.abc import Callable, Iterator
from multiprocessing import connection, resource_tracker
from typing import Any

from ..core.errors import VbnfaultError
from ..core.process import interrupts, streams
from ..core.process.environment import import_path
from .work import Fatal, Job, WorkerFactory

_SECONDS_TO_STOP = 60.0  # for a worker to write its finished items; a second Ctrl-C ends the wait


def _worker(factory: WorkerFactory, pipe: connection.Connection) -> None:
    """Run a worker process. It ends when its parent ends."""
    with contextlib.suppress(EOFError, OSError, interrupts.Stopped), streams.steady():
        interrupts.obey_parent()
        streams.warn_in_sentences()
        threading.Thread(target=_die_with_parent, daemon=True).start()
        _do_tasks(factory, pipe)


def _do_tasks(factory: WorkerFactory, pipe: connection.Connection) -> None:
    """Receive tasks from the pipe, and send events back, until the pipe is closed."""
    with interrupts.interruptible():
        interrupts.check()
        worker = factory()
        while True:
            task = pipe.recv()
            try:
                worker.do(task, lambda *event: pipe.send(event))
            except Fatal as fatal:
                pipe.send((-1, "fatal", fatal.error))
            except VbnfaultError as error:  # files cannot be written
                pipe.send((-1, "fatal", error))
            else:
                pipe.send((-1, "finished", ""))


def _die_with_parent() -> None:
    """Wait until the parent process ends, then end this one."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


class _Process:
    """Represent a worker process in its parent."""

    def __init__(self, factory: WorkerFactory, threads: int) -> None:
        context = multiprocessing.get_context("spawn")
        self.pipe, pipe_of_worker = context.Pipe()
        self.process = context.Process(target=_worker, args=(factory, pipe_of_worker), daemon=True)
        try:
            with _environment(threads), _without_working_folder():
                # If `start` had to start the tracker itself, signals would no longer be held back.
                resource_tracker.ensure_running()
                with interrupts.held():
                    self.process.start()
        except BaseException:
            if self.process.pid is not None:
                self.process.kill()  # the pool does not know this process yet
            raise
        pipe_of_worker.close()
        self.has_reported = False  # whether it has sent anything yet
        self.tasks = 0
        self.number = -1  # of its task
        self.item: int | None = None  # the item it works on

    def give(self, number: int, task: Any) -> None:
        """Send it a task."""
        self.number, self.item = number, None
        self.tasks += 1
        with contextlib.suppress(OSError):  # it died; the next `connection.wait` reports that
            self.pipe.send(task)

    def stop(self, *, at_once: bool = False) -> None:
        """Ask it to end: after its task, or at once but with time to write its finished items."""
        # what it has sent may still wait in the pipe, on a busy machine
        if at_once and not (self.has_reported or self.pipe.poll()):
            self.process.kill()  # it has made nothing yet
        elif at_once:
            self.process.terminate()
        self.pipe.close()

    def join(self) -> None:
        """Wait until it ends; kill it after `_SECONDS_TO_STOP`."""
        self.process.join(_SECONDS_TO_STOP)
        if self.process.is_alive():
            self.process.kill()
            self.process.join()

    def exit_reason(self) -> str:
        """Return how it ended, as a clause."""
        code = self.process.exitcode or 0
        if code == -signal.SIGKILL:
            return "was killed (signal 9, as the system does when memory runs out)"
        return f"was killed by signal {-code}" if code < 0 else f"ended with exit code {code}"


@contextlib.contextmanager
def _environment(threads: int) -> Iterator[None]:
    """Limit the threads of processes started in a `with` block, and stop imports from their working folder.

    The libraries and Python read these environment variables when they load.
    """
    names = ("VBNFAULT_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
    values = dict.fromkeys(names, str(threads)) | {"PYTHONSAFEPATH": "1"}
    before = {name: os.environ[name] for name in values if name in os.environ}
    os.environ.update(values)
    try:
        yield
    finally:
        for name in values:
            del os.environ[name]
        os.environ.update(before)


@contextlib.contextmanager
def _without_working_folder() -> Iterator[None]:
    """Keep the working folder out of the import path of processes started in a `with` block.

    A process imports modules before it receives this path; PYTHONSAFEPATH protects those imports.
    """
    before = sys.path.copy()
    sys.path[:] = import_path()
    try:
        yield
    finally:
        sys.path[:] = before


class Pool:
    """Run worker processes, which are replaced after `recycle` tasks, or when they die.

    If a process dies during an item, the task is done again in a new process, which writes each item as soon as it
    is made. So a second crash loses only that item, which is then recorded as failed and skipped. If a process dies
    while it works on no item, its task is done again, too. The job ends if this happens twice to a task that made
    no item in between.
    """

    def __init__(self, factory: WorkerFactory, job: Job, threads: int, recycle: int) -> None:
        self._new: Callable[[], _Process] = lambda: _Process(factory, threads)
        self._job, self._recycle = job, recycle
        self._workers: list[_Process] = []
        self._again: deque[int] = deque()
        self._deaths_by_item: Counter[int] = Counter()
        # number of deaths between items, counted from the task's last finished item
        self._deaths_by_task: Counter[int] = Counter()
        # The items to skip of each task whose worker died. These tasks have `careful` = True.
        self._given_up: dict[int, frozenset[int]] = {}

    def work(self, workers: int) -> None:
        """Do all tasks of the job with this number of processes."""
        try:
            for _ in range(min(workers, self._job.tasks)):
                self._next(None, None)
            while self._workers:
                by_pipe: dict[Any, _Process] = {worker.pipe: worker for worker in self._workers}
                for pipe in connection.wait(list(by_pipe)):
                    self._receive(by_pipe[pipe])
        finally:
            with interrupts.finishing(self._kill):
                for worker in self._workers:
                    worker.stop(at_once=True)
                for worker in self._workers:
                    worker.join()

    def _kill(self) -> None:
        """Kill all processes."""
        for worker in self._workers:
            worker.process.kill()

    def _next(self, worker: _Process | None, last: int | None) -> None:
        """Give the next task to a worker, or to a new one if it is None or due for replacement.

        If no task is left, the worker ends. `last` is the task that it has just completed.
        """
        busy = [w.number for w in self._workers if w is not worker]
        number = self._again.popleft() if self._again else self._job.next_task(last, busy)
        if worker is not None and (number is None or worker.tasks >= self._recycle):
            self._workers.remove(worker)
            worker.stop()
            worker.join()
            worker = None
        if number is None:
            return
        if worker is None:
            worker = self._new()
            self._workers.append(worker)
        careful = number in self._given_up
        worker.give(number, self._job.task(number, self._given_up.get(number, frozenset()), careful=careful))

    def _receive(self, worker: _Process) -> None:
        """Handle one message from a worker, or its death."""
        try:
            item, what, payload = worker.pipe.recv()
            worker.has_reported = True
        except (EOFError, OSError):
            self._replace_dead(worker)
            return
        if what == "fatal":
            raise payload
        if what == "finished":
            self._next(worker, worker.number)
        else:
            worker.item = item if what in ("begun", "stage") else None
            if what == "built":
                del self._deaths_by_task[worker.number]
            self._job.tick(item, what, payload)

    def _replace_dead(self, worker: _Process) -> None:
        """Replace a worker that died, and do its task again.

        Raises VbnfaultError if two workers die at one task while they work on no item, and no item of it was
        finished in between.
        """
        self._workers.remove(worker)
        worker.stop()
        worker.join()
        item, number, how = worker.item, worker.number, f"its worker process {worker.exit_reason()}"
        task_noun, item_noun = f"{self._job.task_noun} {number}", self._job.item_noun
        given_up = self._given_up.setdefault(number, frozenset())
        if item is None:
            self._deaths_by_task[number] += 1
            if self._deaths_by_task[number] > 1:
                raise VbnfaultError(
                    f"{self._job.path}: {task_noun}: {how}, twice while no {item_noun} was in work; "
                    f"finished {item_noun}s stay, and the same command resumes"
                )
            self._job.progress.say(
                f"{task_noun}: {how} while no {item_noun} was in work; trying again in a new one"
            )
        else:
            self._deaths_by_item[item] += 1
            if self._deaths_by_item[item] == 1:
                self._job.progress.say(f"{item_noun} {item}: {how}; trying again in a new one")
            else:
                self._job.tick(item, "failed", f"{how}, twice")
                self._given_up[number] = given_up | {item}
        self._again.append(number)
        self._next(None, None)
