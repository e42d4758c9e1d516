"""Run the tasks of a build on a Dask cluster. Only this module imports dask.

The client, which is the process of the build, holds the lock of the store. A worker writes only while its task is
wanted: if the client ends, or gives the task up, the worker stops at the next sample. After an interrupt the client
waits until the workers have written their finished samples.

Dask itself does a task again when its worker dies, on another worker. After several deaths it gives the task up and
raises KilledWorker. Then the sample that was in work is recorded as failed, and the shard is done without it.
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
from pathlib import Path
from typing import Any

from .. import store as store_module
from ..core.errors import InputError, VbnfaultError
from ..core.interrupts import Stopped
from .tasks import Fatal, Lazy, Run, SessionFactory, Task, describe, work

# Time limits for addresses where nothing listens, or no scheduler. They are long because the scheduler of a busy
# cluster may need many seconds to answer.
_SECONDS_TO_CONNECT = 30.0
_SECONDS_TO_ANSWER = 60.0
_SECONDS_BETWEEN_CHECKS = 2.0  # of whether the cluster has workers
_SECONDS_WITHOUT_WORKERS = 600.0  # after which a build ends whose workers have all gone
_SECONDS_TO_STOP = 60.0  # for the workers to write their finished samples; a second Ctrl-C ends the wait

# --- on a worker of the cluster ----------------------------------------------------------------------------------

_BETWEEN_SAMPLES = -1
_session_lock = threading.Lock()
_session: dict[bytes, Lazy] = {}
_stopped_builds: set[str] = set()


def _stop_build(build: str) -> None:
    """Have the tasks of a build on this worker end at their next sample, with what they have made."""
    _stopped_builds.add(build)


def _work_on_cluster(pickled: bytes, path: Path, task: Task, build: str) -> list[tuple[int, str, Any]]:
    """Do a task on a Dask worker and return its events; the worker's threads share one session, one at a time.

    What happens to a sample is also reported at once, under the topic `build` of the cluster's event log. The
    scheduler has received the report before the work goes on, so that it is known what a worker died of.
    """
    import distributed
    from distributed.utils import sync

    events: list[tuple[int, str, Any]] = []
    worker = distributed.get_worker()
    key = worker.get_current_task()

    def report(sample: int, what: str, text: str) -> None:
        sync(worker.loop, worker.scheduler.log_event, topic=build, msg=(task.shard, sample, what, text))

    def tick(sample: int, what: str, text: str) -> None:
        if build in _stopped_builds:
            raise Stopped
        if not _is_wanted(worker, key):
            raise OSError("the build that gave this task has ended, or has given it to another worker")
        if what != "kept":
            report(sample, what, text if what == "stage" else "")
        if what not in ("begun", "stage"):
            events.append((sample, what, text))

    with _session_lock:
        report(_BETWEEN_SAMPLES, "started", "")
        if pickled not in _session:
            _session.clear()
            _session[pickled] = Lazy(pickle.loads(pickled))
        simulate = _session[pickled].simulate
        try:
            work(simulate, store_module.open_store(path, "r+"), task, tick)
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


# --- in the process of the build ---------------------------------------------------------------------------------


def check_scheduler(address: str) -> None:
    """Raise InputError if an address is invalid, or if no Dask scheduler answers there.

    Dask's own client would end with a traceback, or wait for an answer without a time limit.
    """
    try:
        from distributed import comm
    except ImportError as error:
        raise InputError(f"--scheduler {address}: Dask is not installed; pip install 'vbnfault[dask]'") from error
    try:
        if comm.parse_address(address)[0] in ("inproc", "ucx"):  # these do not use TCP
            return
        host, port = comm.get_address_host_port(address)
    except ValueError as error:
        raise InputError(f"--scheduler {address}: is no address such as tcp://host:8786: {error}") from error
    try:
        socket.create_connection((host, port), timeout=_SECONDS_TO_CONNECT).close()
    except (OSError, OverflowError, UnicodeError) as error:
        raise InputError(f"--scheduler {address}: nothing answers there: {error}") from error
    with ThreadPoolExecutor(1) as pool:  # another thread: an event loop may be running in the caller's
        kind = pool.submit(asyncio.run, _kind_of_dask_node(address)).result()
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


def run_on_dask(factory: SessionFactory, run: Run, scheduler: str) -> None:
    """Do all tasks of a run on the Dask cluster at an address.

    Raises
    ------
    VbnfaultError
        If the connection to the scheduler is lost, if the cluster loses all its workers, or if workers keep dying
        while no sample is in work.
    """
    import distributed

    try:
        client = distributed.Client(scheduler, timeout=_SECONDS_TO_ANSWER, set_as_default=False)
    except (OSError, ValueError) as error:
        raise VbnfaultError(f"--scheduler {scheduler}: cannot connect: {error}") from error
    with client:
        _ClusterRun(client, factory, run, scheduler).work()


class _ClusterRun:
    """Hand out the tasks of a run on a cluster, collect their events, and repeat tasks whose worker died."""

    def __init__(self, client: Any, factory: SessionFactory, run: Run, scheduler: str) -> None:
        self._client, self._run, self._scheduler = client, run, scheduler
        self._pickled = pickle.dumps(factory)
        self._build = f"vbnfault-{uuid.uuid4().hex}"
        self._shards: dict[Any, int] = {}  # future → shard, of tasks that have not ended
        self._ended: queue.SimpleQueue[Any] = queue.SimpleQueue()  # their futures, as they end
        # shard → the sample that a worker is making, or _BETWEEN_SAMPLES; only shards that a worker has started
        self._in_work: dict[int, int] = {}
        self._given_up: dict[int, frozenset[int]] = {}  # shard → samples that workers do not survive
        self._deaths_between_samples: Counter[int] = Counter()  # by shard
        self._seen_workers = False
        self._without_workers_since: float | None = None

    def work(self) -> None:
        """Do all tasks. At an interrupt or an error, let the workers write what they have made."""
        self._client.subscribe_topic(self._build, self._on_event)
        try:
            shard = self._run.next_shard()
            while shard is not None:
                self._submit(shard)
                shard = self._run.next_shard(shard)
            while self._shards:
                self._take(self._next_ended())
        except BaseException:
            with contextlib.suppress(Exception):
                self._wind_up()
            raise
        finally:
            with contextlib.suppress(Exception):
                self._client.cancel(list(self._shards))

    def _submit(self, shard: int) -> None:
        """Give the task of a shard to the cluster."""
        given_up = self._given_up.get(shard)
        task = self._run.task(shard, given_up or frozenset(), careful=given_up is not None)
        future = self._client.submit(
            _work_on_cluster,
            self._pickled,
            self._run.store.path.absolute(),
            task,
            self._build,
            pure=False,
            priority=-len(self._shards),  # keeps the order of `next_shard`, which groups by site
        )
        self._shards[future] = shard
        future.add_done_callback(self._ended.put)

    def _on_event(self, event: tuple[float, Any]) -> None:
        """Handle an event that a worker reports at once."""
        shard, sample, what, text = event[1]
        if what == "stage":
            self._run.progress.stage(text)
        else:
            self._in_work[shard] = sample if what == "begun" else _BETWEEN_SAMPLES

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
            self._run.progress.say(f"--scheduler {self._scheduler}: the cluster has no workers; waiting for some")
        seconds = time.monotonic() - self._without_workers_since
        if (self._seen_workers or self._in_work) and seconds >= _SECONDS_WITHOUT_WORKERS:
            raise VbnfaultError(
                f"--scheduler {self._scheduler}: all workers of the cluster have gone; finished samples stay, and "
                "the same command resumes"
            )

    def _connection_lost(self) -> VbnfaultError:
        """Return the error for a scheduler that does not answer any more."""
        return VbnfaultError(
            f"--scheduler {self._scheduler}: the connection to the scheduler was lost; finished samples stay, and "
            "the same command resumes"
        )

    def _take(self, future: Any) -> None:
        """Handle the result of a task that has ended."""
        import distributed

        shard = self._shards.pop(future)
        try:
            events = future.result()
        except CancelledError as error:  # only the loss of the scheduler cancels a task of ours
            raise self._connection_lost() from error
        except distributed.KilledWorker as error:
            self._do_again(shard, error.allowed_failures + 1)
            return
        except Exception as error:  # the cluster gave up, for example because it could not load vbnfault
            text = describe(error)
            events = [(i, "failed", text) for i in self._run.store.shard(shard)]
        self._in_work.pop(shard, None)
        for sample, what, payload in events:
            if what == "fatal":
                raise payload
            self._run.tick(sample, what, payload)

    def _do_again(self, shard: int, deaths: int) -> None:
        """Do a shard again after the cluster gave it up, without the sample that its workers died of.

        Dask also gives up tasks that only waited on a worker that died; these are submitted again as they were.
        Raises VbnfaultError at the second time that a task was started and no sample was in work.
        """
        sample = self._in_work.pop(shard, None)
        how = f"{deaths} workers of the cluster died" if deaths > 1 else "a worker of the cluster died"
        if sample == _BETWEEN_SAMPLES:
            self._deaths_between_samples[shard] += 1
            if self._deaths_between_samples[shard] > 1:
                raise VbnfaultError(
                    f"{self._run.store.path}: shard {shard}: {how} while no sample was in work, for the second "
                    "time; finished samples stay, and the same command resumes"
                )
            self._run.progress.say(f"shard {shard}: {how} while no sample was in work; trying again")
        elif sample is not None:
            self._run.tick(sample, "failed", f"{how} while it was in work")
            self._given_up[shard] = self._given_up.get(shard, frozenset()) | {sample}
        self._submit(shard)

    def _wind_up(self) -> None:
        """Take back the tasks that no worker has begun, and wait until the others have written what they made."""
        if self._client.status != "running":
            return
        begun = {key for keys in self._client.processing().values() for key in keys}
        waiting = {future for future in self._shards if future.key in begun}
        self._client.cancel([future for future in self._shards if future not in waiting])
        if not waiting:
            return
        self._client.run(_stop_build, self._build, on_error="ignore")
        self._run.progress.say("waiting for the workers of the cluster to write their finished samples")
        deadline = time.monotonic() + _SECONDS_TO_STOP
        while waiting and (seconds := deadline - time.monotonic()) > 0:
            with contextlib.suppress(queue.Empty):
                waiting.discard(self._ended.get(timeout=seconds))
