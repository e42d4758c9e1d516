"""Run the tasks of a job, such as a build, on a Dask cluster. Only this module imports dask.

The client, which is the process of the job, holds the lock of its folder. A worker writes only while its task is
wanted: if the client ends, or gives the task up, the worker stops at the next item. After an interrupt the client
waits until the workers have written their finished items.

Dask itself does a task again when its worker dies, on another worker. After several deaths it gives the task up and
raises KilledWorker. Then the item that was in work is recorded as failed, and the task is done without it.
"""

from __future__ import annotations

import asyncio
import contextlib
import pickle
import queue
import socket
import threading
import time
import uuid
from collections import Counter
from concurrent.futures import CancelledError, ThreadPoolExecutor
from typing import Any

from ..core.errors import InputError, VbnfaultError
from ..core.process.interrupts import Stopped
from .work import Fatal, Job, Worker, WorkerFactory, describe

# Time limits for addresses where nothing listens, or no scheduler. They are long because the scheduler of a busy
# cluster may need many seconds to answer.
_SECONDS_TO_CONNECT = 30.0
_SECONDS_TO_ANSWER = 60.0
_WITHOUT_TCP = ("inproc", "ucx", "ucxx")  # protocols
_SECONDS_BETWEEN_CHECKS = 2.0  # of whether the cluster has workers
_SECONDS_WITHOUT_WORKERS = 600.0  # after which a build ends whose workers have all gone
_SECONDS_TO_STOP = 60.0  # for the workers to write their finished items; a second Ctrl-C ends the wait

# --- on a worker of the cluster ----------------------------------------------------------------------------------

_BETWEEN_ITEMS = -1
_worker_lock = threading.Lock()
_worker: dict[bytes, Worker] = {}
_stopped_jobs: set[str] = set()


def _stop_job(job: str) -> None:
    """Have the tasks of a job on this worker end at their next item, with what they have made."""
    _stopped_jobs.add(job)


def _work_on_cluster(pickled: bytes, number: int, task: Any, job: str) -> list[tuple[int, str, Any]]:
    """Do a task on a Dask worker and return its events; the threads share one `Worker`, one at a time.

    What happens to an item is also reported at once, under the topic `job` of the cluster's event log. The
    scheduler has received the report before the work goes on, so that it is known what a worker died of.
    """
    import distributed
    from distributed.utils import sync

    events: list[tuple[int, str, Any]] = []
    node = distributed.get_worker()
    key = node.get_current_task()

    def report(item: int, what: str, text: str) -> None:
        sync(node.loop, node.scheduler.log_event, topic=job, msg=(number, item, what, text))

    def tick(item: int, what: str, text: str) -> None:
        if job in _stopped_jobs:
            raise Stopped
        if not _is_wanted(node, key):
            raise OSError("the command that gave this task has ended, or has given it to another worker")
        if what != "kept":
            report(item, what, text if what == "stage" else "")
        if what not in ("begun", "stage"):
            events.append((item, what, text))

    with _worker_lock:
        report(_BETWEEN_ITEMS, "started", "")
        if pickled not in _worker:
            _worker.clear()
            _worker[pickled] = pickle.loads(pickled)()
        try:
            _worker[pickled].do(task, tick)
        except Stopped:
            pass
        except Fatal as fatal:
            events.append((-1, "fatal", fatal.error))
        except VbnfaultError as error:
            events.append((-1, "fatal", VbnfaultError(f"on a worker of the cluster: {error}")))
    return events


def _is_wanted(worker: Any, key: Any) -> bool:
    """Return whether the scheduler still wants a running task of a worker.

    The state is `cancelled` after the client has ended or has cancelled the task. A worker without its scheduler
    closes: its tasks are given to others.
    """
    task = worker.state.tasks.get(key)
    return task is not None and task.state == "executing" and worker.status.name in ("running", "paused")


# --- in the process of the job -----------------------------------------------------------------------------------


def check_scheduler(address: str) -> None:
    """Raise InputError if an address is invalid, or if no Dask scheduler answers there.

    Dask's own client would end with a traceback, or wait for an answer without a time limit.
    """
    try:
        from distributed import comm
    except ImportError as error:
        raise InputError(f"--scheduler {address}: Dask is not installed; pip install 'vbnfault[dask]'") from error
    try:
        protocol = comm.parse_address(address)[0]
        host, port = (None, 0) if protocol in _WITHOUT_TCP else comm.get_address_host_port(address)
    except ValueError as error:
        raise InputError(f"--scheduler {address}: is no address such as tcp://host:8786: {error}") from error
    try:
        if host is not None:
            socket.create_connection((host, port), timeout=_SECONDS_TO_CONNECT).close()
    except (OSError, OverflowError, UnicodeError) as error:
        raise InputError(f"--scheduler {address}: nothing answers there: {error}") from error
    with ThreadPoolExecutor(1) as pool:  # another thread: an event loop may be running in the caller's
        kind = pool.submit(asyncio.run, _kind_of_dask_node(address)).result()
    if not kind and host is None:
        raise InputError(
            f"--scheduler {address}: no Dask scheduler answers there, or the protocol {protocol} is not installed; "
            "use an address such as tcp://host:8786"
        )
    if not kind:
        raise InputError(f"--scheduler {address}: what listens there does not answer as a Dask scheduler does")
    if kind != "Scheduler":
        raise InputError(f"--scheduler {address}: a Dask {kind.lower()} listens there, no scheduler")


async def _kind_of_dask_node(address: str) -> str:
    """Ask the Dask node at an address what it is: `Scheduler`, `Worker` or `Nanny`; empty if it is no Dask node."""
    from distributed import Security, comm

    async def ask() -> Any:
        link = await comm.connect(address, timeout=_SECONDS_TO_ANSWER, **Security().get_connection_args("client"))
        try:
            await link.write({"op": "identity", "reply": True})
            return await link.read()
        finally:
            link.abort()

    try:
        answer = await asyncio.wait_for(ask(), _SECONDS_TO_ANSWER)
        return str(answer["type"])
    except Exception:  # another protocol, read as Dask's, gives absurd sizes, undecodable messages or silence
        return ""


def run_on_dask(factory: WorkerFactory, job: Job, scheduler: str) -> None:
    """Do all tasks of a job on the Dask cluster at an address.

    Raises
    ------
    VbnfaultError
        If the connection to the scheduler is lost, if the cluster loses all its workers, or if workers keep dying
        while no item is in work.
    """
    import distributed

    try:
        client = distributed.Client(scheduler, timeout=_SECONDS_TO_ANSWER, set_as_default=False)
    except (OSError, ValueError) as error:
        raise VbnfaultError(f"--scheduler {scheduler}: cannot connect: {error}") from error
    with client:
        _ClusterRun(client, factory, job, scheduler).work()


class _ClusterRun:
    """Hand out the tasks of a job on a cluster, collect their events, and repeat tasks whose worker died."""

    def __init__(self, client: Any, factory: WorkerFactory, job: Job, scheduler: str) -> None:
        self._client, self._job, self._scheduler = client, job, scheduler
        self._pickled = pickle.dumps(factory)
        self._topic = f"vbnfault-{uuid.uuid4().hex}"
        self._tasks: dict[Any, int] = {}  # future → number of the task, of those that have not ended
        self._ended: queue.SimpleQueue[Any] = queue.SimpleQueue()  # their futures, as they end
        # task → the item that a worker is making, or _BETWEEN_ITEMS; only tasks that a worker has started
        self._in_work: dict[int, int] = {}
        self._given_up: dict[int, frozenset[int]] = {}  # task → items that workers do not survive
        self._deaths_between_items: Counter[int] = Counter()  # by task
        self._seen_workers = False
        self._without_workers_since: float | None = None
        self._lost = False  # the connection to the scheduler

    def work(self) -> None:
        """Do all tasks. At an interrupt or an error, let the workers write what they have made.

        Without a scheduler nothing can be said to them: each request would only wait for its time limit.
        """
        self._client.subscribe_topic(self._topic, self._on_event)
        try:
            number = self._job.next_task()
            while number is not None:
                self._submit(number)
                number = self._job.next_task(number)
            while self._tasks:
                self._take(self._next_ended())
        except BaseException:
            try:
                self._wind_up()
            except Exception:
                self._lost = True  # nothing more is asked of the scheduler
            raise
        finally:
            if not self._lost:
                with contextlib.suppress(Exception):
                    self._client.cancel(list(self._tasks))

    def _submit(self, number: int) -> None:
        """Give a task to the cluster."""
        given_up = self._given_up.get(number)
        task = self._job.task(number, given_up or frozenset(), careful=given_up is not None)
        future = self._client.submit(
            _work_on_cluster,
            self._pickled,
            number,
            task,
            self._topic,
            pure=False,
            priority=-len(self._tasks),  # keeps the order of `next_task`, which groups by lead
        )
        self._tasks[future] = number
        future.add_done_callback(self._ended.put)

    def _on_event(self, event: tuple[float, Any]) -> None:
        """Handle an event that a worker reports at once."""
        number, item, what, text = event[1]
        if what == "stage":
            self._job.progress.stage(text)
        else:
            self._in_work[number] = item if what == "begun" else _BETWEEN_ITEMS

    def _next_ended(self) -> Any:
        """Wait for the next task to end, and return its future. Raises VbnfaultError if the workers are gone."""
        while True:
            try:
                return self._ended.get(timeout=_SECONDS_BETWEEN_CHECKS)
            except queue.Empty:
                self._check_workers()

    def _check_workers(self) -> None:
        """Say if the cluster has no worker; raise VbnfaultError if it had some and has had none for long."""
        try:
            count = len(self._client.nthreads())
        except Exception as error:
            raise self._connection_lost() from error
        if count:
            self._seen_workers, self._without_workers_since = True, None
            return
        if self._without_workers_since is None:
            self._without_workers_since = time.monotonic()
            self._job.progress.say(f"--scheduler {self._scheduler}: the cluster has no workers; waiting for some")
        seconds = time.monotonic() - self._without_workers_since
        if (self._seen_workers or self._in_work) and seconds >= _SECONDS_WITHOUT_WORKERS:
            raise VbnfaultError(
                f"--scheduler {self._scheduler}: all workers of the cluster have gone; finished "
                f"{self._job.item_noun}s stay, and "
                "the same command resumes"
            )

    def _connection_lost(self) -> VbnfaultError:
        """Note that the scheduler does not answer any more, and return the error for it."""
        self._lost = True
        return VbnfaultError(
            f"--scheduler {self._scheduler}: the connection to the scheduler was lost; finished "
            f"{self._job.item_noun}s stay, and "
            "the same command resumes"
        )

    def _take(self, future: Any) -> None:
        """Handle the result of a task that has ended."""
        import distributed

        number = self._tasks.pop(future)
        try:
            events = future.result()
        except CancelledError as error:  # only the loss of the scheduler cancels a task of ours
            raise self._connection_lost() from error
        except distributed.KilledWorker as error:
            self._do_again(number, error.allowed_failures + 1)
            return
        except Exception as error:  # the cluster gave up, for example because it could not load vbnfault
            text = describe(error)
            events = [(i, "failed", text) for i in self._job.items(number)]
        self._in_work.pop(number, None)
        for item, what, payload in events:
            if what == "fatal":
                raise payload
            self._job.tick(item, what, payload)

    def _do_again(self, number: int, deaths: int) -> None:
        """Do a task again after the cluster gave it up, without the item that its workers died of.

        Dask also gives up tasks that only waited on a worker that died; these are submitted again as they were.
        Raises VbnfaultError at the second time that a task was started and no item was in work.
        """
        item = self._in_work.pop(number, None)
        task_noun, item_noun = f"{self._job.task_noun} {number}", self._job.item_noun
        how = f"{deaths} workers of the cluster died" if deaths > 1 else "a worker of the cluster died"
        if item == _BETWEEN_ITEMS:
            self._deaths_between_items[number] += 1
            if self._deaths_between_items[number] > 1:
                raise VbnfaultError(
                    f"{self._job.path}: {task_noun}: {how} while no {item_noun} was in work, for the second "
                    f"time; finished {item_noun}s stay, and the same command resumes"
                )
            self._job.progress.say(f"{task_noun}: {how} while no {item_noun} was in work; trying again")
        elif item is not None:
            self._job.tick(item, "failed", f"{how} while it was in work")
            self._given_up[number] = self._given_up.get(number, frozenset()) | {item}
        self._submit(number)

    def _wind_up(self) -> None:
        """Take back the tasks that no worker has begun, and wait until the others have written what they made."""
        if self._lost or self._client.status != "running":
            return
        begun = {key for keys in self._client.processing().values() for key in keys}
        waiting = {future for future in self._tasks if future.key in begun}
        self._client.cancel([future for future in self._tasks if future not in waiting])
        if not waiting:
            return
        self._client.run(_stop_job, self._topic, on_error="ignore")
        self._job.progress.say(
            f"waiting for the workers of the cluster to write their finished {self._job.item_noun}s"
        )
        deadline = time.monotonic() + _SECONDS_TO_STOP
        while waiting and (seconds := deadline - time.monotonic()) > 0:
            try:
                waiting.discard(self._ended.get(timeout=min(seconds, _SECONDS_BETWEEN_CHECKS)))
            except queue.Empty:
                if not self._client.nthreads():  # or an error, if the scheduler has gone
                    return
