"""Run the tasks of a build on a Dask cluster. Only this module imports dask."""

from __future__ import annotations

import asyncio
import pickle
import socket
import threading
import uuid
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from .. import store as store_module
from ..core.errors import InputError, VbnfaultError
from .tasks import Fatal, Lazy, Run, SessionFactory, Task, describe, work

# Time limits for addresses where nothing listens, or no scheduler. They are long because the scheduler of a busy
# cluster may need many seconds to answer.
_SECONDS_TO_CONNECT = 30.0
_SECONDS_TO_ANSWER = 60.0


_cluster_lock = threading.Lock()


_cluster_session: dict[bytes, Lazy] = {}


def _work_on_cluster(pickled: bytes, path: Path, task: Task, topic: str) -> list[tuple[int, str, Any]]:
    """Do a task on a Dask worker and return its events; the worker's threads share one session, one at a time.

    Stages are reported at once, under `topic` in the cluster's event log; all other events are returned at the end.
    """
    import distributed

    events: list[tuple[int, str, Any]] = []
    worker = distributed.get_worker()

    def tick(sample: int, what: str, text: str) -> None:
        if what == "stage":
            worker.log_event(topic, text)
        else:
            events.append((sample, what, text))

    with _cluster_lock:
        if pickled not in _cluster_session:
            _cluster_session.clear()
            _cluster_session[pickled] = Lazy(pickle.loads(pickled))
        session = _cluster_session[pickled]
        try:
            work(session.simulate, store_module.open_store(path, "r+"), task, tick)
        except Fatal as fatal:
            events.append((-1, "fatal", fatal.error))
        except VbnfaultError as error:
            events.append((-1, "fatal", VbnfaultError(f"on a worker of the cluster: {error}")))
    return events


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

    A task that its workers do not survive is reported as the failure of all its samples.
    """
    import distributed

    try:
        client = distributed.Client(scheduler, timeout=_SECONDS_TO_ANSWER, set_as_default=False)
    except (OSError, ValueError) as error:
        raise VbnfaultError(f"--scheduler {scheduler}: cannot connect: {error}") from error
    path, pickled = run.store.path.absolute(), pickle.dumps(factory)
    topic = f"vbnfault-{uuid.uuid4().hex}"
    with client:
        client.subscribe_topic(topic, lambda event: run.progress.stage(str(event[1])))
        futures: dict[Any, int] = {}
        shard = run.next_shard()
        while shard is not None:
            task = run.task(shard)
            priority = -len(futures)  # keeps the order of `next_shard`, which groups by site
            futures[client.submit(_work_on_cluster, pickled, path, task, topic, pure=False, priority=priority)] = (
                shard
            )
            shard = run.next_shard(shard)
        try:
            for future in distributed.as_completed(list(futures), loop=client.loop):
                shard = futures.pop(future)
                try:
                    events = future.result()
                except Exception as error:  # its workers died, or the cluster gave up
                    text = describe(error)
                    events = [(i, "failed", text) for i in run.store.shard(shard)]
                for sample, what, payload in events:
                    if what == "fatal":
                        raise payload
                    run.tick(sample, what, payload)
        finally:
            client.cancel(list(futures))
