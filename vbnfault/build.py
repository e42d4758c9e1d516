"""Building a dataset: which samples are missing, who makes them, what happens when something goes wrong.

The only importer of dask. A task is a shard. Tasks are handed out by site, so that a worker loads a site's
terrain once. A task first checks what its shard already holds, then makes the rest: resuming, repairing and
appending are the same thing. What a build makes depends on no order: workers, interruption and repair leave
no trace in the arrays.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import multiprocessing
import os
import pickle
import shutil
import signal
import socket
import sys
import threading
import time
import traceback
from collections import Counter, deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from multiprocessing import connection
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from . import store as store_module
from .errors import InputError, VbnfaultError
from .quantities import Sample
from .store import Encoded, Store, StoreSpec

RECYCLE_SHARDS = 32  # a worker process is replaced after so many: long LLVM runs grow and at last fail
_SECONDS_TO_STOP = 15.0
_SECONDS_TO_CONNECT = 5.0
_SECONDS_TO_ANSWER = 15.0  # a busy scheduler takes its time
_HOPELESS = 32  # so many failed samples and not one success: the rest would fail as well
_SECONDS_BETWEEN_LINES = 5.0


class Session(Protocol):
    """What makes samples; it keeps between samples what is costly to make, such as the terrain of a site."""

    def simulate(self, index: int) -> Sample:
        """The sample of this index, the same whatever was simulated before."""
        ...


SessionFactory = Callable[[], Session]


class Interrupted(VbnfaultError):
    """Stopped by the user or the system; the same command resumes."""

    exit_code = 130


class BuildFailed(VbnfaultError):
    """Some samples could not be made. `failures`: sample → traceback, or what happened to its worker."""

    def __init__(self, sentence: str, failures: Mapping[int, str] | None = None) -> None:
        super().__init__(sentence)
        self.failures = dict(failures or {})


@dataclass(frozen=True, kw_only=True)
class Summary:
    """What a build would do, or did. `finished` samples were there before; `built` ones were made now."""

    path: Path
    samples: int
    shards: int
    sites: int
    finished: int
    estimated_bytes: int
    free_bytes: int
    fault_counts: Mapping[str, int] = field(default_factory=dict)
    built: int = 0
    seconds: float = 0.0

    def lines(self) -> list[str]:
        """The summary in words."""
        head = f"{self.path}: {self.samples} samples at {self.sites} sites in {self.shards} shards"
        size = f"about {_size(self.estimated_bytes)}, {_size(self.free_bytes)} free"
        lines = [f"{head}, {size}; {self.finished} of them were finished before"]
        if self.fault_counts:
            lines.append("faults: " + ", ".join(f"{k} {v}" for k, v in self.fault_counts.items()))
        if self.built:
            lines.append(f"{self.built} samples built in {_duration(self.seconds)}")
        return lines


def planned_blocks(
    out: str | os.PathLike[str], samples: int, *, append: int = 0, overwrite: bool = False
) -> tuple[int, ...]:
    """Sizes of the planned blocks: those of an existing store, one more where `append` asks for it.

    Where the last block was appended, has the size `append` and is unfinished, it is resumed instead of
    adding another: so a command that was interrupted can be repeated as it is. Raises InputError where there
    is nothing to append to, or where the store was made with another number of samples.
    """
    exists = store_module.is_store(out) and not overwrite
    if not exists:
        if append:
            raise InputError(f"--append {append}: there is no store at {out} yet; build it first")
        return (samples,)
    store = store_module.open_store(out)
    blocks = tuple(int(b) for b in store.attributes.get("blocks", [store.samples]))
    if blocks[0] != samples:
        raise InputError(
            f"{out}: samples = {samples}, but the store was made with {blocks[0]}; use --append to add some, "
            f"--overwrite to start anew, or another --out"
        )
    if append < 0:
        raise InputError(f"--append {append}: must be at least 1")
    resumes = len(blocks) > 1 and blocks[-1] == append and store.finished() < store.samples
    return (*blocks, append) if append and not resumes else blocks


def build(
    session_factory: SessionFactory,
    spec: StoreSpec,
    out: str | os.PathLike[str],
    *,
    site: ArrayLike,
    blocks: Sequence[int] | None = None,
    workers: int = 1,
    scheduler: str | None = None,
    threads: int | None = None,
    overwrite: bool = False,
    dry_run: bool = False,
    progress: bool = True,
    fault_counts: Mapping[str, int] | None = None,
    recycle_shards: int = RECYCLE_SHARDS,
) -> Summary:
    """Build, resume, repair or extend the store at `out`; see the module.

    `session_factory`: picklable where `workers` > 1 or a scheduler is used. `site` int[sample], over all
    blocks. `blocks`: from `planned_blocks`; one block by default. `workers` processes on this machine (1: in
    this process), each with `threads` threads (an equal share of the cores by default; VBNFAULT_THREADS and
    OMP_NUM_THREADS in its environment), or the Dask cluster at `scheduler`, whose workers must see `out`.

    Raises InputError where `out` holds another scene or nothing answers at `scheduler`, BuildFailed where
    samples failed (all others are built), Interrupted after Ctrl-C or SIGTERM, VbnfaultError where the disk
    or the cluster fails.
    """
    sites = np.asarray(site, dtype=np.int64)
    blocks = tuple(blocks or (len(sites),))
    if sum(blocks) != len(sites):
        raise ValueError(f"site has {len(sites)} samples, the blocks {sum(blocks)}")
    if workers < 1:
        raise InputError(f"--workers {workers}: must be at least 1")
    path = Path(out)
    spec = _with_attributes(spec, blocks)
    existing = store_module.is_store(path) and not overwrite
    if existing:
        _same_scene(store_module.open_store(path), spec, blocks)
    finished = store_module.open_store(path).finished() if existing else 0
    summary = Summary(
        path=path,
        samples=len(sites),
        shards=-(-len(sites) // spec.shard_samples),
        sites=len(np.unique(sites)),
        finished=finished,
        estimated_bytes=spec.estimated_sample_bytes * len(sites),
        free_bytes=_free_bytes(path),
        fault_counts=dict(fault_counts or {}),
    )
    if dry_run:
        return summary
    _check_room(summary, spec)
    if scheduler is not None:
        _check_scheduler(scheduler)

    began = time.monotonic()
    with _interruptible(), contextlib.ExitStack() as stack:
        try:
            if not existing:
                store_module.create(path, spec, len(sites), overwrite=overwrite)
            stack.enter_context(_locked(path))
            store = store_module.recover(path)
            if store.samples < len(sites):
                added = len(sites) - store.samples
                store = store_module.append_samples(store, added, {"blocks": list(blocks)})
            run = _Run(store, sites, _Progress(len(sites), shown=progress))
            with run.progress:
                if scheduler is not None:
                    _run_on_dask(session_factory, run, scheduler)
                elif workers == 1:
                    _run_here(session_factory, run)
                else:
                    share = max(1, (os.cpu_count() or 1) // workers)
                    _Pool(session_factory, run, threads or share, recycle_shards).work(workers)
        except KeyboardInterrupt as stop:
            done = store_module.open_store(path).finished() if store_module.is_store(path) else 0
            raise Interrupted(
                f"{path}: interrupted; {done} of {len(sites)} samples are finished, and the same command resumes"
            ) from stop
        run.raise_failures()
    return Summary(**{**vars(summary), "built": run.built, "seconds": time.monotonic() - began})


# --- before the work --------------------------------------------------------------------------------------


def _with_attributes(spec: StoreSpec, blocks: tuple[int, ...]) -> StoreSpec:
    values = {**spec.plain(), "attributes": {**spec.attributes, "blocks": list(blocks)}}
    return StoreSpec(**values)


def _same_scene(store: Store, spec: StoreSpec, blocks: tuple[int, ...]) -> None:
    """Raise InputError that says what differs between a store and what is to be built into it."""
    ignored = {"blocks", "shard_samples", "format", "format_version", *store_module.VOLATILE_ATTRIBUTES}

    def flat(a_spec: StoreSpec) -> dict[str, Any]:
        everything = json.loads(json.dumps({**a_spec.attributes, **a_spec.plain()}))
        return dict(_flatten({k: v for k, v in everything.items() if k not in ignored}))

    old, new = flat(store.spec), flat(spec)
    absent = object()
    differing = [k for k in {**new, **old} if old.get(k, absent) != new.get(k, absent)]
    if differing:
        # a scene's keys say more than the hash that follows from them
        differing.sort(key=lambda k: (not k.startswith("scene."), "hash" in k, k))

        def show(values: Mapping[str, Any], key: str) -> str:
            text = repr(values[key]) if key in values else "absent"
            return text if len(text) <= 60 else text[:57] + "..."

        first = [f"{k} is {show(old, k)} in the store and {show(new, k)} now" for k in differing[:4]]
        more = f", and {len(differing) - 4} more" if len(differing) > 4 else ""
        raise InputError(
            f"{store.path}: holds another dataset: {'; '.join(first)}{more}; "
            f"choose another --out, or --overwrite to replace it"
        )
    stored = tuple(store.attributes.get("blocks", [store.samples]))
    if blocks[: len(stored)] != stored:
        raise InputError(
            f"{store.path}: holds blocks of {_list(stored)} samples, not {_list(blocks)}; "
            f"choose another --out, or --overwrite to replace it"
        )


def _flatten(value: Any, key: str = "") -> Iterator[tuple[str, Any]]:
    """Nested tables → dotted key, value."""
    if isinstance(value, dict) and value:
        for name, inner in value.items():
            yield from _flatten(inner, f"{key}.{name}" if key else str(name))
    else:
        yield key, value


def _list(values: Sequence[int]) -> str:
    return " + ".join(str(v) for v in values)


def _free_bytes(path: Path) -> int:
    existing = next(p for p in (path, *path.absolute().parents) if p.exists())
    usage = shutil.disk_usage(existing)
    return usage.free if usage.total else sys.maxsize  # some mounts do not say


def _check_room(summary: Summary, spec: StoreSpec) -> None:
    """Refuse what cannot fit, warn of what may not: images compress to half or twice the estimate."""
    needed = spec.estimated_sample_bytes * (summary.samples - summary.finished)
    free, text = summary.free_bytes, f"{summary.path}: about {_size(needed)} are needed"
    if needed / 2 > free:
        raise VbnfaultError(f"{text}, but only {_size(free)} are free there; choose another --out")
    if needed > free:
        print(f"warning: {text}, and {_size(free)} are free there: it may not fit", file=sys.stderr)


def _size(count: float) -> str:
    for unit in ("B", "kB", "MB", "GB"):
        if count < 1000:
            return f"{count:.3g} {unit}"
        count /= 1000
    return f"{count:.3g} TB"


def _duration(seconds: float) -> str:
    minutes, hours = seconds / 60, seconds / 3600
    return f"{seconds:.0f} s" if seconds < 100 else f"{minutes:.0f} min" if minutes < 100 else f"{hours:.1f} h"


@contextlib.contextmanager
def _locked(path: Path) -> Iterator[None]:
    """One build at a time: two would remove each other's files in work. The lock ends with the process."""
    try:
        import fcntl
    except ImportError:  # no such locks on Windows
        yield
        return
    folder = os.open(path, os.O_RDONLY)
    try:
        try:
            fcntl.flock(folder, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise VbnfaultError(f"{path}: another build is writing to it; wait until it ends") from None
        except OSError:
            pass  # a file system without locks
        yield
    finally:
        os.close(folder)


@contextlib.contextmanager
def _interruptible() -> Iterator[None]:
    """SIGTERM stops a build as Ctrl-C does, where this is the main thread."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGTERM, _raise_interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def _raise_interrupt(_number: int, _frame: Any) -> None:
    raise KeyboardInterrupt


# --- one task ---------------------------------------------------------------------------------------------

# sample; "kept", "begun", "built" or "failed"; where it failed one line, then the traceback
Tick = Callable[[int, str, str], None]


@dataclass(frozen=True, kw_only=True)
class _Task:
    """Complete one shard. `sites`: of its samples. `skip`: not to be tried. `careful`: write every sample at
    once, because the process may die at the next one."""

    shard: int
    sites: tuple[int, ...]
    skip: frozenset[int] = frozenset()
    careful: bool = False


def _work(simulate: Callable[[int], Sample], store: Store, task: _Task, tick: Tick) -> None:
    """Do a task; a sample that fails is reported and left out.

    What was made is written also where an interrupt ends the task early, but not where `tick` finds that
    nobody listens any more: another build may have begun.
    """
    wanted = {i for problem in store_module.check_shard(store, task.shard) for i in problem.samples}
    samples = store.shard(task.shard)
    made: dict[int, Encoded] = {}
    try:
        for i in samples:
            if i not in wanted:
                tick(i, "kept", "")
        for i in sorted(wanted - task.skip, key=lambda i: (task.sites[i - samples.start], i)):
            tick(i, "begun", "")
            try:
                made[i] = store_module.encode(store.spec, simulate(i))
            except Exception as error:
                tick(i, "failed", _describe(error))
                continue
            if task.careful:
                store.write_shard(task.shard, {i: made.pop(i)})
            tick(i, "built", "")
    except OSError:
        made.clear()
        raise
    finally:
        if made:
            store.write_shard(task.shard, made)


def _describe(error: Exception) -> str:
    """One line, then the traceback."""
    frame = traceback.extract_tb(error.__traceback__)[-1]
    if isinstance(error, VbnfaultError):
        line = str(error)
    else:
        line = f"{type(error).__name__}: {error} ({Path(frame.filename).name}:{frame.lineno})"
    return " ".join(line.split()) + "\n" + "".join(traceback.format_exception(error))


# --- the whole of the work, and how it is going -----------------------------------------------------------


class _Run:
    """The tasks of a build, handed out by site, and what came of them."""

    def __init__(self, store: Store, sites: NDArray[np.int64], progress: _Progress) -> None:
        self.store, self.sites, self.progress = store, sites, progress
        self.built = 0
        self.failures: dict[int, str] = {}
        self._outcome: dict[int, str] = {}
        self._by_site: dict[int, deque[int]] = {}
        for shard in range(store.shards):
            self._by_site.setdefault(self.lead(shard), deque()).append(shard)

    def lead(self, shard: int) -> int:
        """The site a shard is handed out with: that of its first sample."""
        return int(self.sites[self.store.shard(shard).start])

    def task(self, shard: int, skip: frozenset[int] = frozenset(), *, careful: bool = False) -> _Task:
        """The task that completes a shard."""
        samples = self.store.shard(shard)
        sites = tuple(int(s) for s in self.sites[samples.start : samples.stop])
        return _Task(shard=shard, sites=sites, skip=skip, careful=careful)

    def next_shard(self, last: int | None = None, busy: Sequence[int] = ()) -> int | None:
        """What a worker does after the shard `last`: a shard of the same site if one is left, else of the
        site where the fewest of the `busy` shards are, then of the one with the most left."""
        left = {site: queue for site, queue in self._by_site.items() if queue}
        if not left:
            return None
        site = None if last is None else self.lead(last)
        if site is None or site not in left:
            taken = [self.lead(shard) for shard in busy]
            site = min(left, key=lambda s: (taken.count(s), -len(left[s]), s))
        return left[site].popleft()

    def tick(self, sample: int, what: str, text: str) -> None:
        """Note what became of a sample. Raises BuildFailed where nothing succeeds."""
        if what == "begun":
            return
        before = self._outcome.get(sample)
        self._outcome[sample] = what
        self.built += (what == "built") - (before == "built")
        if what == "failed":
            self.failures[sample] = text
            self.progress.say(f"sample {sample} failed: {text.splitlines()[0]}")
        else:
            self.failures.pop(sample, None)
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


class _Progress:
    """Samples done, rate and time left: a bar on a terminal, a line every few seconds elsewhere."""

    def __init__(self, total: int, *, shown: bool) -> None:
        self._total, self._shown = total, shown
        self._done = self._built = 0
        self._began = self._last_line = time.monotonic()
        self._bar: Any = None
        self._task: Any = None

    def __enter__(self) -> _Progress:
        if self._shown and sys.stderr.isatty():
            from rich.console import Console
            from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn

            columns = (
                BarColumn(bar_width=None),
                MofNCompleteColumn(),
                TextColumn("samples, {task.description}"),
            )
            self._bar = Progress(*columns, console=Console(stderr=True))
            self._task = self._bar.add_task("checking", total=self._total)
            self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._bar is not None:
            self._bar.stop()
        elif self._shown and self._built:
            print(self._line(), file=sys.stderr, flush=True)

    def _pace(self) -> str:
        seconds = time.monotonic() - self._began
        if not self._built or seconds <= 0:
            return "checking"
        rate = self._built / seconds
        unit = f"{rate:.2f} samples/s" if rate >= 0.1 else f"{1 / rate:.0f} s/sample"
        return f"{unit}, {_duration((self._total - self._done) / rate)} left"

    def _line(self) -> str:
        return f"{self._done}/{self._total} samples, {self._pace()}"

    def advance(self, built: bool) -> None:
        """One sample further."""
        self._done += 1
        self._built += built
        if self._bar is not None:
            self._bar.update(self._task, advance=1, description=self._pace())
        elif self._shown and time.monotonic() - self._last_line > _SECONDS_BETWEEN_LINES:
            self._last_line = time.monotonic()
            print(self._line(), file=sys.stderr, flush=True)

    def say(self, text: str) -> None:
        """A line beside the bar."""
        if self._bar is not None:
            self._bar.console.print(text, highlight=False, markup=False)
        elif self._shown:
            print(text, file=sys.stderr, flush=True)


# --- who does it: this process, some processes, a cluster -------------------------------------------------


class _Lazy:
    """A session made when the first sample needs it: a shard that is whole needs none."""

    def __init__(self, factory: SessionFactory) -> None:
        self._factory = factory
        self._session: Session | None = None

    def simulate(self, index: int) -> Sample:
        if self._session is None:
            try:
                self._session = self._factory()
            except VbnfaultError as error:
                raise _Fatal(error) from error
            except Exception as error:
                raise _Fatal(VbnfaultError(_describe(error).splitlines()[0])) from error
        return self._session.simulate(index)


class _Fatal(BaseException):
    """Carries what ends the whole build, past the handling of a single sample's failure."""

    def __init__(self, error: VbnfaultError) -> None:
        super().__init__(error)
        self.error = error


def _run_here(factory: SessionFactory, run: _Run) -> None:
    session = _Lazy(factory)
    shard = run.next_shard()
    while shard is not None:
        try:
            _work(session.simulate, run.store, run.task(shard), run.tick)
        except _Fatal as fatal:
            raise fatal.error from fatal
        shard = run.next_shard(shard)


def _worker(factory: SessionFactory, path: Path, pipe: connection.Connection) -> None:
    """A worker process: tasks come in by the pipe, ticks go out. It does not outlive its parent."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent decides
    signal.signal(signal.SIGTERM, _raise_interrupt)
    threading.Thread(target=_die_with_parent, daemon=True).start()
    with contextlib.suppress(EOFError, OSError, KeyboardInterrupt):
        session, store = _Lazy(factory), store_module.open_store(path, "r+")
        while True:
            task = pipe.recv()
            try:
                _work(session.simulate, store, task, lambda *event: pipe.send(event))
            except _Fatal as fatal:
                pipe.send((-1, "fatal", fatal.error))
            except VbnfaultError as error:  # the disk refused
                pipe.send((-1, "fatal", error))
            else:
                pipe.send((-1, "finished", ""))


def _die_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


class _Process:
    """A worker process as its parent sees it."""

    def __init__(self, factory: SessionFactory, path: Path, threads: int) -> None:
        context = multiprocessing.get_context("spawn")
        self.pipe, theirs = context.Pipe()
        self.process = context.Process(target=_worker, args=(factory, path, theirs), daemon=True)
        with _environment(threads):
            self.process.start()
        theirs.close()
        self.shards = 0
        self.shard = -1
        self.sample: int | None = None  # in work

    def give(self, task: _Task) -> None:
        """Hand it a task."""
        self.shard, self.sample = task.shard, None
        self.shards += 1
        with contextlib.suppress(OSError):  # it died: the next wait notices
            self.pipe.send(task)

    def stop(self, *, at_once: bool = False) -> None:
        """Let it end: after its task, or at once, with time to write what it has."""
        if at_once:
            self.process.terminate()
        self.pipe.close()

    def join(self) -> None:
        """Wait for its end, but not for ever."""
        self.process.join(_SECONDS_TO_STOP)
        if self.process.is_alive():
            self.process.kill()
            self.process.join()

    def obituary(self) -> str:
        """How it ended."""
        code = self.process.exitcode or 0
        if code == -signal.SIGKILL:
            return "was killed (signal 9, as the system does when memory runs out)"
        return f"was killed by signal {-code}" if code < 0 else f"ended with exit code {code}"


@contextlib.contextmanager
def _environment(threads: int) -> Iterator[None]:
    """Cap the threads of processes started within: libraries read these variables when they load."""
    names = ("VBNFAULT_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
    before = {name: os.environ[name] for name in names if name in os.environ}
    os.environ.update(dict.fromkeys(names, str(threads)))
    try:
        yield
    finally:
        for name in names:
            del os.environ[name]
        os.environ.update(before)


class _Pool:
    """Worker processes that are replaced after `recycle` shards, or when they die.

    A sample during which a process died is tried once more, in a new one, then given up; the others of its
    shard are written one by one, so that a crash costs that sample alone.
    """

    def __init__(self, factory: SessionFactory, run: _Run, threads: int, recycle: int) -> None:
        self._new: Callable[[], _Process] = lambda: _Process(factory, run.store.path, threads)
        self._run, self._recycle = run, recycle
        self._workers: list[_Process] = []
        self._again: deque[int] = deque()
        self._deaths: Counter[int | None] = Counter()
        self._given_up: dict[int, frozenset[int]] = {}  # shard → samples; its keys are worked carefully

    def work(self, workers: int) -> None:
        """Do all tasks."""
        try:
            for _ in range(min(workers, self._run.store.shards)):
                self._next(None, None)
            while self._workers:
                by_pipe: dict[Any, _Process] = {worker.pipe: worker for worker in self._workers}
                for pipe in connection.wait(list(by_pipe)):
                    self._hear(by_pipe[pipe])
        finally:
            for worker in self._workers:
                worker.stop(at_once=True)
            for worker in self._workers:
                worker.join()

    def _next(self, worker: _Process | None, last: int | None) -> None:
        """Hand the next task to a worker, or to a new one; without a task it retires."""
        busy = [w.shard for w in self._workers if w is not worker]
        shard = self._again.popleft() if self._again else self._run.next_shard(last, busy)
        if worker is not None and (shard is None or worker.shards >= self._recycle):
            self._workers.remove(worker)
            worker.stop()
            worker.join()
            worker = None
        if shard is None:
            return
        if worker is None:
            worker = self._new()
            self._workers.append(worker)
        careful = shard in self._given_up
        worker.give(self._run.task(shard, self._given_up.get(shard, frozenset()), careful=careful))

    def _hear(self, worker: _Process) -> None:
        try:
            sample, what, payload = worker.pipe.recv()
        except (EOFError, OSError):
            self._mourn(worker)
            return
        if what == "fatal":
            raise payload
        if what == "finished":
            self._next(worker, worker.shard)
        else:
            worker.sample = sample if what == "begun" else None
            self._run.tick(sample, what, payload)

    def _mourn(self, worker: _Process) -> None:
        self._workers.remove(worker)
        worker.stop()
        worker.join()
        sample, shard, how = worker.sample, worker.shard, f"its worker process {worker.obituary()}"
        self._deaths[sample] += 1
        given_up = self._given_up.setdefault(shard, frozenset())
        if self._deaths[sample] == 1:
            self._run.progress.say(f"sample {sample}: {how}; trying again in a new one")
        elif sample is None:
            raise VbnfaultError(
                f"{self._run.store.path}: a worker process ended before it made anything ({how}); "
                f"finished samples stay, and the same command resumes"
            )
        else:
            self._run.tick(sample, "failed", f"{how}, twice")
            self._given_up[shard] = given_up | {sample}
        self._again.append(shard)
        self._next(None, None)


_cluster_lock = threading.Lock()
_cluster_session: dict[bytes, _Lazy] = {}


def _work_on_cluster(pickled: bytes, path: Path, task: _Task) -> list[tuple[int, str, Any]]:
    """A task on a Dask worker. Its threads share one session and take turns."""
    events: list[tuple[int, str, Any]] = []
    with _cluster_lock:
        if pickled not in _cluster_session:
            _cluster_session.clear()
            _cluster_session[pickled] = _Lazy(pickle.loads(pickled))
        session = _cluster_session[pickled]
        try:
            _work(session.simulate, store_module.open_store(path, "r+"), task, lambda *e: events.append(e))
        except _Fatal as fatal:
            events.append((-1, "fatal", fatal.error))
        except VbnfaultError as error:
            events.append((-1, "fatal", VbnfaultError(f"on a worker of the cluster: {error}")))
    return events


def _check_scheduler(address: str) -> None:
    """Refuse an address that is none, or where no Dask scheduler answers: Dask's client would leave a traceback,
    and would wait for ever for an answer."""
    try:
        from distributed import comm
    except ImportError as error:
        raise InputError(f"--scheduler {address}: Dask is not installed; pip install 'vbnfault[dask]'") from error
    try:
        if comm.parse_address(address)[0] in ("inproc", "ucx"):  # no TCP
            return
        host, port = comm.get_address_host_port(address)
    except ValueError as error:
        raise InputError(f"--scheduler {address}: is no address such as tcp://host:8786: {error}") from error
    try:
        socket.create_connection((host, port), timeout=_SECONDS_TO_CONNECT).close()
    except (OSError, OverflowError, UnicodeError) as error:
        raise InputError(f"--scheduler {address}: nothing answers there: {error}") from error
    with ThreadPoolExecutor(1) as pool:  # a loop of its own: the caller's thread may be running one
        kind = pool.submit(asyncio.run, _kind_of_dask_node(address)).result()
    if not kind:
        raise InputError(f"--scheduler {address}: what listens there does not answer as a Dask scheduler does")
    if kind != "Scheduler":
        raise InputError(f"--scheduler {address}: a Dask {kind.lower()} listens there, no scheduler")


async def _kind_of_dask_node(address: str) -> str:
    """`Scheduler`, `Worker` or `Nanny`, as what listens there says; empty where it does not speak Dask."""
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
    except Exception:  # other protocols are read as Dask's: absurd sizes, undecodable messages, silence
        return ""


def _run_on_dask(factory: SessionFactory, run: _Run, scheduler: str) -> None:
    import distributed

    try:
        client = distributed.Client(scheduler, timeout="10s", set_as_default=False)
    except (OSError, ValueError) as error:
        raise VbnfaultError(f"--scheduler {scheduler}: cannot connect: {error}") from error
    path, pickled = run.store.path.absolute(), pickle.dumps(factory)
    with client:
        futures: dict[Any, int] = {}
        shard = run.next_shard()
        while shard is not None:
            task = run.task(shard)
            priority = -len(futures)  # in the order of the sites
            futures[client.submit(_work_on_cluster, pickled, path, task, pure=False, priority=priority)] = shard
            shard = run.next_shard(shard)
        try:
            for future in distributed.as_completed(list(futures), loop=client.loop):
                shard = futures.pop(future)
                try:
                    events = future.result()
                except Exception as error:  # its workers died, or the cluster gave it up
                    text = _describe(error)
                    events = [(i, "failed", text) for i in run.store.shard(shard)]
                for sample, what, payload in events:
                    if what == "fatal":
                        raise payload
                    run.tick(sample, what, payload)
        finally:
            client.cancel(list(futures))
