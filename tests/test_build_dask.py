"""Builds and studies on a Dask cluster: the same bits, and a sentence for whatever happens to it."""

from __future__ import annotations

import asyncio
import contextlib
import gc
import os
import pickle
import signal
import socket
import subprocess
import sys
import threading
import time
import types
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import study_kit
import test_plugins
from conftest import small_scene
from dask import config as dask_config
from synthetic import SAMPLES, Broken, Session, fake_sample, make_spec, run, site_of

from vbnfault import store as st
from vbnfault.core.errors import InputError, VbnfaultError
from vbnfault.core.files import toml_files
from vbnfault.core.process.interrupts import Interrupted
from vbnfault.core.quantities import Sample
from vbnfault.core.registry import undoing_registrations
from vbnfault.dataset import BuildOptions, build_scene, dask
from vbnfault.dataset.tasks import BuildFailed
from vbnfault.faults import plugins
from vbnfault.scene.config import load_scene
from vbnfault.study import results
from vbnfault.study.run import run_study
from vbnfault.study.spec import parse_study

distributed = pytest.importorskip("distributed")
pytestmark = pytest.mark.filterwarnings("default")  # what Dask warns of is not ours
HERE = Path(__file__).resolve().parent
MOST_SECONDS = 300  # far longer than any wait on a busy machine
AT = 6  # the third sample of the second shard, in the order of the work


def wait_until(happened: Callable[[], bool]) -> None:
    """Return as soon as something has happened in this process; the limit only ends a test that would hang."""
    limit = time.monotonic() + MOST_SECONDS
    while not happened():
        if time.monotonic() > limit:
            raise TimeoutError(f"nothing happened within {MOST_SECONDS} s")
        time.sleep(0.01)


@dataclass(frozen=True)
class Disturbing:
    """Makes made-up samples; something happens when a worker makes sample `AT`.

    `client`: the process of the build. `folder`: holds a file once the event has happened.
    """

    event: str
    folder: str
    client: int = 0

    def __call__(self) -> Disturbing:
        return self

    def simulate(self, index: int) -> Sample:
        happened = Path(self.folder) / "happened"
        if index == AT and not (happened.exists() and self.event != "worker dies"):
            happened.touch()
            getattr(self, "_" + self.event.replace(" ", "_"))()
        return fake_sample(make_spec(), index, site=int(site_of(index + 1)[-1]))

    def _worker_dies(self) -> None:
        end_watched_worker()

    _worker_dies_once = _worker_dies

    def _user_interrupts(self) -> None:
        os.kill(self.client, signal.SIGINT)
        wait_until(lambda: bool(dask._stopped_jobs))

    def _client_dies(self) -> None:
        os.kill(self.client, signal.SIGKILL)
        self._until_unwanted()

    def _scheduler_closes(self) -> None:
        worker = distributed.get_worker()
        instances = distributed.Scheduler._instances
        (scheduler,) = [s for s in instances if s.address == worker.scheduler.address]
        # what asks a scheduler that is gone need not wait; the test restores the limit
        dask_config.set({"distributed.comm.timeouts.connect": "10ms"})
        asyncio.run_coroutine_threadsafe(scheduler.close(), worker.loop.asyncio_loop)
        self._until_unwanted()

    def _workers_leave(self) -> None:
        worker = distributed.get_worker()
        worker.loop.add_callback(worker.close, nanny=False)
        self._until_unwanted()

    def _until_unwanted(self) -> None:
        worker = distributed.get_worker()
        task = worker.get_current_task()
        wait_until(lambda: not dask._is_wanted(worker, task))


@dataclass(frozen=True)
class Deadly:
    """A factory that kills every other process that receives it."""

    def __reduce__(self) -> tuple[Any, ...]:
        return end_elsewhere, (os.getpid(),)


def end_elsewhere(process: int) -> None:
    """Kill this worker unless its process is `process`."""
    if os.getpid() != process:
        end_watched_worker()


def watches(dask_worker: Any) -> bool:
    """Return whether a nanny has started its process, the first or a later one, and waits for its end."""
    return all(its.status is distributed.Status.running for its in (dask_worker, dask_worker.process))


def end_watched_worker() -> None:
    """Kill this worker once its nanny would start it again: a nanny that is still starting a worker gives it up."""
    worker = distributed.get_worker()

    def is_watched() -> bool:
        asked = worker.rpc(worker.nanny).run(function=pickle.dumps(watches))
        answer = asyncio.run_coroutine_threadsafe(asked, worker.loop.asyncio_loop).result()
        return bool(answer["result"])

    wait_until(is_watched)
    os.kill(os.getpid(), signal.SIGKILL)


@pytest.fixture(scope="module")
def processes() -> Iterator[Any]:
    """Yield a cluster of two worker processes, which are started again when they die."""
    import dask.config

    settings = {
        "distributed.scheduler.allowed-failures": 0,
        # a worker that is missed for 15 s would not come back, however busy the machine is
        "distributed.deploy.lost-worker-timeout": "1 hour",
    }
    with (
        dask.config.set(settings),
        distributed.LocalCluster(
            n_workers=2, threads_per_worker=1, processes=True, memory_limit=0, dashboard_address=None
        ) as cluster,
    ):
        yield cluster


@contextlib.contextmanager
def threads(workers: int = 2) -> Iterator[Any]:
    """Yield a cluster whose workers are threads of this process."""
    with distributed.LocalCluster(
        n_workers=workers, threads_per_worker=2, processes=False, protocol="tcp://", dashboard_address=None
    ) as cluster:
        yield cluster


def finished(out: Path) -> set[int]:
    """Return the finished samples of a store."""
    store = st.open_store(out)
    return {i for shard in range(store.shards) for i, done in store.done(shard).items() if done}


def resumed(out: Path) -> str | None:
    """Complete a store in this process, check that nothing is left behind, and return its digest."""
    summary = run(out)
    assert st.examine(out).problems == []
    assert [p.name for p in out.parent.iterdir() if p.name != "happened"] == ["s.zarr"]
    assert not list(out.rglob("*.partial"))
    return summary.digest


def test_a_worker_that_dies_once_is_replaced(processes: Any, undisturbed: tuple[Path, str], tmp_path: Path) -> None:
    processes.scheduler.allowed_failures = 1
    try:
        summary = run(
            tmp_path / "s.zarr",
            Disturbing("worker dies once", str(tmp_path)),
            scheduler=processes.scheduler_address,
        )
    finally:
        processes.scheduler.allowed_failures = 0
    assert (tmp_path / "happened").exists()
    assert (summary.built, summary.digest) == (SAMPLES, undisturbed[1])


def test_a_sample_that_kills_its_workers_fails_alone(
    processes: Any, undisturbed: tuple[Path, str], tmp_path: Path
) -> None:
    out = tmp_path / "s.zarr"
    sentence = rf"sample {AT} failed, the first with: a worker of the cluster died while it was in work"
    with pytest.raises(BuildFailed, match=sentence):
        run(out, Disturbing("worker dies", str(tmp_path)), scheduler=processes.scheduler_address)
    assert finished(out) == set(range(SAMPLES)) - {AT}
    assert resumed(out) == undisturbed[1]


def test_tasks_that_kill_every_worker_end_the_build(processes: Any, tmp_path: Path) -> None:
    with pytest.raises(VbnfaultError, match=r"shard \d: a worker .*died while no sample .* second time"):
        run(tmp_path / "s.zarr", Deadly(), scheduler=processes.scheduler_address)
    assert finished(tmp_path / "s.zarr") == set()


def test_ctrl_c_waits_until_the_workers_have_written(
    processes: Any, undisturbed: tuple[Path, str], tmp_path: Path
) -> None:
    out = tmp_path / "s.zarr"
    with pytest.raises(Interrupted, match=r"interrupted; (\d+) of 18 samples are finished") as stopped:
        run(
            out,
            Disturbing("user interrupts", str(tmp_path), os.getpid()),
            scheduler=processes.scheduler_address,
        )
    assert stopped.value.exit_code == 130
    done = finished(out)
    assert f" {len(done)} of 18" in str(stopped.value)
    assert done & {4, 5, 6, 7} == {4, 5, 6}  # what the worker had made of its shard, and nothing more
    assert resumed(out) == undisturbed[1]


def test_workers_write_nothing_after_the_client_was_killed(
    processes: Any, undisturbed: tuple[Path, str], tmp_path: Path
) -> None:
    """Another build of the same store may have begun by then."""
    out = tmp_path / "s.zarr"
    code = "import sys, test_build_dask; test_build_dask.main(*sys.argv[1:])"
    client = subprocess.run(
        [sys.executable, "-c", code, str(out), processes.scheduler_address],
        env={**os.environ, "PYTHONPATH": os.pathsep.join([str(HERE.parent), str(HERE)])},
        capture_output=True,
        text=True,
    )
    assert client.returncode == -signal.SIGKILL, client.stderr
    with distributed.Client(processes.scheduler_address, set_as_default=False) as other:
        other.run(until_idle)
    assert finished(out).isdisjoint({4, 5, 6, 7})
    (tmp_path / ".s.zarr.lock").unlink()
    assert resumed(out) == undisturbed[1]


async def until_idle() -> None:
    """Wait until no task runs on a worker, which needs its event loop to report that it was cancelled."""
    while not dask._worker_lock.acquire(blocking=False):
        await asyncio.sleep(0.02)
    dask._worker_lock.release()


def main(out: str, scheduler: str) -> None:
    """Build on a cluster; a worker kills this process."""
    run(Path(out), Disturbing("client dies", str(Path(out).parent), os.getpid()), scheduler=scheduler)


@pytest.mark.parametrize(
    ("event", "sentence"),
    [
        ("scheduler closes", "the connection to the scheduler was lost; finished samples stay"),
        ("workers leave", "all workers of the cluster have gone; finished samples stay"),
    ],
)
def test_a_cluster_that_ends_is_one_sentence(
    event: str, sentence: str, undisturbed: tuple[Path, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(dask, "_SECONDS_BETWEEN_CHECKS", 0.01)
    if event == "workers leave":  # a scheduler that closes may lose its workers first
        monkeypatch.setattr(dask, "_SECONDS_WITHOUT_WORKERS", 0.0)
    connect = distributed.Client._ensure_connected

    async def connected(client: Any, timeout: float | None = None) -> None:
        if (tmp_path / "happened").exists():
            raise ImportError("the client closes at once, where it else tries again for a minute")
        await connect(client, timeout)

    monkeypatch.setattr(distributed.Client, "_ensure_connected", connected)
    out = tmp_path / "s.zarr"
    with (
        dask_config.set({"distributed.comm.timeouts.connect": "300s"}),
        threads(1) as cluster,
        pytest.raises(VbnfaultError, match=f"^--scheduler tcp://.*: {sentence}"),
    ):
        run(out, Disturbing(event, str(tmp_path)), scheduler=cluster.scheduler_address)
    assert resumed(out) == undisturbed[1]


class Gone:
    """A client of Dask whose scheduler has ended, which the client has not noticed: one task is in work."""

    status = "running"

    def __init__(self) -> None:
        self.key = "task"  # it is its own future
        self.asked = 0

    def processing(self) -> dict[str, list[str]]:
        return {"worker": [self.key]}

    def cancel(self, futures: list[Any]) -> None:
        assert futures == []

    def run(self, *_: Any, **__: Any) -> None:
        """Reach nobody."""

    def nthreads(self) -> dict[str, int]:
        self.asked += 1
        raise OSError("nothing answers")


def test_the_end_of_a_build_does_not_wait_for_a_scheduler_that_is_gone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(dask, "_SECONDS_BETWEEN_CHECKS", 0.01)
    client: Any = Gone()
    job: Any = types.SimpleNamespace(item_noun="sample", progress=types.SimpleNamespace(say=lambda _: None))
    ending = dask._ClusterRun(client, Session(), job, "tcp://x:1")
    ending._tasks[client] = 0
    with pytest.raises(OSError, match="nothing answers"):
        ending._wind_up()
    assert client.asked == 1
    ending._connection_lost()
    ending._wind_up()  # asks nothing
    assert client.asked == 1


def test_a_dask_cluster_makes_the_same_bits(
    undisturbed: tuple[Path, str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "s.zarr"
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=2, processes=False, dashboard_address=None
    ) as cluster:
        with pytest.raises(BuildFailed, match=r"sample 5 failed.*KeyError"):
            run(out, Session(raises=frozenset({5})), scheduler=cluster.scheduler_address)
        summary = run(out, Session(stage="terrain of"), scheduler=cluster.scheduler_address, progress=True)
        assert (summary.built, summary.digest) == (1, undisturbed[1])
        with pytest.raises(VbnfaultError, match="no such mesh"):
            run(tmp_path / "t.zarr", Broken(), scheduler=cluster.scheduler_address)
    assert capsys.readouterr().err.splitlines().count("terrain of 5") == 1
    assert st.digest(out) == undisturbed[1]


def table_of_study(folder: Path, study: Any, scheduler: str | None = None, **given: Any) -> bytes:
    """Run a study and return its table."""
    options = BuildOptions(scheduler=scheduler, progress=False)
    run_study(study, folder, options, report=False, **given)
    return (folder / results.TABLE).read_bytes()


def test_a_study_on_a_cluster_gives_the_same_table(
    processes: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    spec, made = study_kit.small_spec(), study_kit.Stopping
    here = table_of_study(tmp_path / "here", spec, evaluator=made)
    assert table_of_study(tmp_path / "there", spec, processes.scheduler_address, evaluator=made) == here
    # a worker that dies is replaced; what it had not written is evaluated again
    processes.scheduler.allowed_failures = 1
    try:
        deadly = partial(Dying, folder=str(tmp_path))
        assert table_of_study(tmp_path / "again", spec, processes.scheduler_address, evaluator=deadly) == here
    finally:
        processes.scheduler.allowed_failures = 0
    assert (tmp_path / "happened").exists()


class Dying(study_kit.Stopping):
    """End the process at evaluation 77, once."""

    def __init__(self, study: Any, folder: str) -> None:
        super().__init__(study)
        self.happened = Path(folder) / "happened"

    def evaluate(self, evaluation: Any) -> Any:
        if evaluation.index == 77 and not self.happened.exists():
            self.happened.touch()
            end_watched_worker()
        return super().evaluate(evaluation)


def test_a_plug_in_reaches_the_workers_of_a_cluster(processes: Any, tmp_path: Path) -> None:
    """The scene names it by a path, which the workers read for themselves."""
    (tmp_path / "my_glint.py").write_text(test_plugins.GLINT, encoding="utf-8")
    tables = small_scene(
        dataset={"samples": 1, "sites": 1, "layers": ["clean"]},
        camera={"width_px": 32, "height_px": 32},
        plan={"mode": "per_class", "faulty_fraction": 1.0},
    )
    scene = tmp_path / "scene.toml"
    named = {"plugins": ["my_glint.py"], "faults": {"glint": {}}}
    scene.write_text(toml_files.toml_text(tables | named), encoding="utf-8")
    level = {"key": "scene.faults.glint.level", "distribution": "uniform", "low": 0.2, "high": 0.9}
    study = {
        "title": "glint",
        "design": {"method": "one_at_a_time", "n": 2},
        "scene": {"base": str(scene)},
        "factor": [level],
        "metrics": {"names": ["centroid_shift_px"]},
    }
    address = processes.scheduler_address
    with undoing_registrations(always=True):
        digests = [
            build_scene(load_scene(scene), tmp_path / f"{name}.zarr", BuildOptions(**given, progress=False)).digest
            for name, given in (("there", {"scheduler": address}), ("here", {}))
        ]
        assert digests[0] == digests[1]
        made = [
            table_of_study(tmp_path / name, parse_study(study, source="test"), scheduler)
            for name, scheduler in (("study there", address), ("study here", None))
        ]
        assert made[0] == made[1]
        shifts = results.read_table(tmp_path / "study here")["centroid_shift_px"].to_numpy()
        assert len(set(shifts)) == 3  # the level was read
        plugins.loaded.clear()


def test_a_scheduler_is_told_from_a_worker() -> None:
    with distributed.LocalCluster(
        n_workers=1, processes=False, protocol="tcp://", dashboard_address=None
    ) as cluster:
        dask.check_scheduler(cluster.scheduler_address)
        (worker,) = cluster.scheduler_info["workers"]
        with pytest.raises(InputError, match="a Dask worker listens there, no scheduler"):
            dask.check_scheduler(worker)


def test_without_dask_the_sentence_says_how_to_get_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(InputError, match=r"pip install 'vbnfault\[dask\]'"):
        run(tmp_path / "s.zarr", scheduler="tcp://127.0.0.1:1")


@pytest.mark.parametrize(
    "address",
    ["nonsense", "foo://x:1", "tcp://127.0.0.1:1", "tcp://127.0.0.1:99999999", "ucx://127.0.0.1:1", "inproc://x"],
)
def test_a_scheduler_that_cannot_be_reached_is_one_sentence(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], address: str
) -> None:
    with pytest.raises(InputError, match=f"^--scheduler {address}: "):
        run(tmp_path / "s.zarr", scheduler=address)
    assert not (tmp_path / "s.zarr").exists()
    assert capsys.readouterr().err == ""


@contextlib.contextmanager
def listening(reply: bytes | None) -> Iterator[str]:
    """Address of a socket that sends `reply` to everyone and hangs up; that stays silent where it is None."""
    kept: list[socket.socket] = []

    def serve() -> None:
        with contextlib.suppress(OSError):  # closed at the end
            while True:
                kept.append(server.accept()[0])
                if reply is not None:
                    kept[-1].sendall(reply)
                    kept.pop().close()

    with socket.create_server(("127.0.0.1", 0)) as server:
        thread = threading.Thread(target=serve, daemon=True)
        thread.start()
        yield f"tcp://127.0.0.1:{server.getsockname()[1]}"
        server.shutdown(socket.SHUT_RDWR)
        thread.join()
    for link in kept:
        link.close()


@pytest.mark.parametrize(
    "reply", [b"", b"HTTP/1.1 400 Bad\r\n\r\n", bytes(64), None], ids=["closes", "http", "zeros", "silent"]
)
def test_what_is_no_dask_scheduler_is_one_sentence(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, reply: bytes | None
) -> None:
    monkeypatch.setattr(dask, "_SECONDS_TO_ANSWER", 2.0)
    with listening(reply) as address, pytest.raises(InputError) as e:
        run(tmp_path / "s.zarr", scheduler=address)
    assert str(e.value) == f"--scheduler {address}: what listens there does not answer as a Dask scheduler does"
    assert not (tmp_path / "s.zarr").exists()
    gc.collect()
    assert capfd.readouterr().err == ""
