"""Build a dataset: find the missing samples, have workers make them, and handle failures and interruption.

A task completes one shard. Tasks are assigned by site, so that a worker loads the terrain of a site once. A task
first checks the samples that its shard already holds, then makes the others. So a build resumes, repairs and
extends a store with the same code. The arrays do not depend on the order of work, on the number of workers, or on
interruptions and repairs.
"""

from __future__ import annotations

import contextlib
import logging
import os
import sys
import time
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import BeforeValidator, Field, InstanceOf, Strict, WithJsonSchema

from .. import store as store_module
from ..core import tables
from ..core.errors import InputError, VbnfaultError, shown
from ..core.process import environment
from ..core.process.interrupts import interruptible
from ..store import FaultCounts, Location, Planned, Store, StoreSpec, Url, files_of, located
from .dask import check_scheduler, run_on_dask
from .lock import locked, others_at_work, prepared_by_one
from .processes import Pool
from .progress import Progress, duration_text, size_text
from .resume import check_same_scene, known_versions, with_versions_noted
from .tasks import Run, SampleWorker, SessionFactory
from .work import Job, WorkerFactory, run_here


def _of_python(value: Any) -> Any:
    """Return a number or truth value of numpy as one of Python; other values as they are."""
    return value.item() if isinstance(value, np.generic) else value


# Neither 1 is true here nor "2" a number: an option such as `overwrite` must not be set by chance.
_OF_PYTHON = BeforeValidator(_of_python)
_Flag = Annotated[bool, Strict(), _OF_PYTHON]


@tables.table_class()
class BuildOptions:
    """Hold the options of how a build does its work. No option changes a stored value.

    Parameters
    ----------
    workers : int
        Number of processes on this machine, 1 to 1024. With 1, this process does the work.
    threads : int, optional
        Render threads of each worker process, 1 to 1024; by default the processor's cores are divided equally.
    scheduler : str, optional
        Address of a Dask scheduler, whose workers do the work instead. They must have access to the store.
    overwrite : bool
        Replace an existing store.
    accept_versions : bool
        Also complete a store that was made with other library versions. Its root attribute `versions_of_samples`
        then lists the versions of each sample.
    dry_run : bool
        Plan and describe the build, but make nothing.
    progress : bool
        Show the progress on standard error.
    shard_range : range, optional
        Make only these shards, counted from 0, of the whole dataset. Commands with disjoint ranges may write into
        one store at the same time; `merge_stores` joins several stores.
    recycle_shards : int
        Number of shards after which a worker process is replaced: long runs of LLVM grow and finally fail.

    Raises
    ------
    InputError
        If a value is outside its range, or if two options exclude each other.
    """

    workers: Annotated[int, Field(strict=True, ge=1, le=environment.MOST_THREADS), _OF_PYTHON] = 1
    threads: Annotated[int, Field(strict=True, ge=1, le=environment.MOST_THREADS), _OF_PYTHON] | None = None
    scheduler: Annotated[str, Strict()] | None = None
    overwrite: _Flag = False
    accept_versions: _Flag = False
    dry_run: _Flag = False
    progress: _Flag = True
    shard_range: Annotated[InstanceOf[range], WithJsonSchema({"title": "a range"})] | None = None
    recycle_shards: Annotated[int, Field(strict=True, ge=1), _OF_PYTHON] = 32

    def __post_init__(self) -> None:
        if self.scheduler is not None and self.workers > 1:
            raise ValueError(
                f"--workers {self.workers} and --scheduler {self.scheduler} exclude each other: the cluster has its"
                " own workers; give one of them"
            )
        part = self.shard_range
        if part is None:
            return
        if part.step != 1:
            raise ValueError(f"shard_range = {part}: must be a range of steps of 1, such as range(0, 4)")
        if not 0 <= part.start < part.stop:
            raise ValueError(f"--shard-range {part.start}:{part.stop}: must be A:B, whole numbers with 0 <= A < B")
        if self.overwrite:
            raise ValueError("--shard-range and --overwrite exclude each other: delete the store first")

    @classmethod
    def of(cls, options: BuildOptions | None, keywords: Mapping[str, Any]) -> BuildOptions:
        """Return `options`, or the default options, with the fields replaced that `keywords` names.

        Raises InputError if `options` is of another type, or a value is outside its range.
        """
        if not isinstance(options, cls | None):
            raise InputError(f"options = {shown(options)}: must be BuildOptions")
        return cls(**{**vars(options or cls()), **keywords})

    def shards_of(self, count: int) -> range:
        """Return the shards to make of a store of `count` shards. Raises InputError if it has no such shards."""
        part = range(count) if self.shard_range is None else self.shard_range
        if part.stop > count:
            raise InputError(
                f"--shard-range {part.start}:{part.stop}: the dataset has {count} shards; must be A:B with "
                f"0 <= A < B <= {count}"
            )
        return part


@dataclass(frozen=True, kw_only=True)
class BuildPlan:
    """Describe what a build makes: a store, its samples, and what is known before the first one is rendered.

    Parameters
    ----------
    spec : StoreSpec
        The store.
    site : int[sample]
        Site of each sample, over all blocks.
    blocks : tuple of int
        Numbers of samples that were, or are now, added together, as `planned_blocks` returns them; one block by
        default. They become a root attribute of the store.
    planned_faults : bool[sample, fault], optional
        The commanded faults, counted beside the injected ones.
    expected : callable, optional
        Planned scalars of a sample, as in `store.examine`; finished samples that differ from them are rebuilt.
    exact : bool
        Whether every commanded fault must be injected, as in `store.examine`.
    estimated_seconds : float, optional
        Estimated duration of building the whole dataset.
    """

    spec: StoreSpec
    site: NDArray[np.integer[Any]]
    blocks: tuple[int, ...] = ()
    planned_faults: NDArray[np.bool_] | None = None
    expected: Planned | None = None
    exact: bool = False
    estimated_seconds: float | None = None

    def __post_init__(self) -> None:
        site = np.asarray(self.site, dtype=np.int64)
        blocks = tuple(self.blocks) or (len(site),)
        if sum(blocks) != len(site):
            raise ValueError(f"site has {len(site)} samples, the blocks {sum(blocks)}")
        values = {**self.spec.plain(), "attributes": {**self.spec.attributes, "blocks": list(blocks)}}
        object.__setattr__(self, "site", site)
        object.__setattr__(self, "blocks", blocks)
        object.__setattr__(self, "spec", StoreSpec(**values))

    @property
    def shards(self) -> int:
        """Return the number of shards of the whole dataset."""
        return -(-len(self.site) // self.spec.shard_samples)

    def samples_of(self, shards: range) -> int:
        """Return the number of samples of some shards."""
        size = self.spec.shard_samples
        return min(shards.stop * size, len(self.site)) - shards.start * size

    def fault_counts(self) -> dict[str, int]:
        """Return the number of samples that are planned for each fault class; empty if that is not known."""
        if self.planned_faults is None:
            return {}
        return dict(zip(self.spec.faults, self.planned_faults.sum(axis=0).tolist(), strict=True))


@dataclass(frozen=True, kw_only=True)
class Summary:
    """Describe what a build would do, or did.

    Attributes
    ----------
    samples, shards
        What the build completes: everything, or the shards of `shard_range`.
    shard_range
        The shards that the build completes, if these are not all of the store.
    finished, built
        Numbers of samples that existed before, and that were made now.
    estimated_bytes, free_bytes
        Approximate size of these samples, and free space on the disk of the store.
    fault_counts
        Number of samples planned for each fault class.
    optics
        One line on the lens.
    seconds
        Duration of the build.
    estimated_seconds
        Estimated duration of building all of these samples; None if unknown.
    counts, digest
        Of the store after the build; None before it. `digest` is also None if a sample is missing.
    description
        Lines that describe what the scene will photograph.
    """

    path: Location
    samples: int
    shards: int
    sites: int
    finished: int
    estimated_bytes: int
    free_bytes: int
    fault_counts: Mapping[str, int] = field(default_factory=dict)
    optics: str = ""
    shard_range: range | None = None
    built: int = 0
    seconds: float = 0.0
    estimated_seconds: float | None = None
    counts: FaultCounts | None = None
    digest: str | None = None
    description: tuple[str, ...] = ()

    @property
    def _where(self) -> str:
        """Return the path, and the range of shards if it is not all of them, as text."""
        part = self.shard_range
        return f"{self.path}" if part is None else f"{self.path}: shards {part.start}:{part.stop}"

    def outlook(self) -> list[str]:
        """Return lines that say what there is to do."""
        numbers = ((self.samples, "sample"), (self.sites, "site"), (self.shards, "shard"))
        samples, sites, shards = (f"{number} {noun}{'s' * (number != 1)}" for number, noun in numbers)
        head = f"{self._where}: {samples} at {sites} in {shards}"
        size = f"about {size_text(self.estimated_bytes)}"
        if self.free_bytes != sys.maxsize:
            size += f", {size_text(self.free_bytes)} free"
        lines = [f"{head}, {size}; {self.finished} of them were finished before"]
        if self.optics:
            lines.append(f"lens: {self.optics}")
        if self.estimated_seconds is not None and self.finished < self.samples:
            left = self.estimated_seconds * (self.samples - self.finished) / self.samples
            lines.append(f"estimated time: {duration_text(left)}, which the progress corrects as samples get done")
        if self.fault_counts:
            lines.append("planned faults: " + ", ".join(f"{k} {v}" for k, v in self.fault_counts.items()))
        return lines

    def lines(self) -> list[str]:
        """Return lines that say what was done, or, before a build, what there is to do."""
        if self.counts is None:
            return [*self.outlook(), *self.description]
        lines = [f"{self._where}: {self.samples} samples, {self.finished} of them finished before"]
        if self.built:
            # every sample is whole now, so what was built beyond the unfinished ones was damaged
            mended = max(self.finished + self.built - self.samples, 0)
            again = f", {mended} of them in place of damaged ones" if mended else ""
            lines.append(f"{self.built} samples built in {duration_text(self.seconds)}{again}")
        lines += self.counts.lines()
        if self.counts.missing:
            lines.append(self.counts.missing_text())
        if self.digest is not None:
            lines.append(f"digest {self.digest}")
        return lines


def build(
    session_factory: SessionFactory,
    plan: BuildPlan,
    out: str | os.PathLike[str] | Url,
    options: BuildOptions | None = None,
) -> Summary:
    """Build, resume, repair or extend the store at `out`; the module's docstring describes how.

    Parameters
    ----------
    session_factory
        Makes the object that simulates samples. It must be picklable if worker processes or a cluster are used.
    plan
        What is built.
    out
        Path of the store.
    options
        How it is built.

    Raises
    ------
    InputError
        If `out` holds another scene, or no scheduler answers.
    BuildFailed
        If samples failed; all others are built.
    Interrupted
        After Ctrl-C, SIGTERM or SIGHUP.
    VbnfaultError
        If the files cannot be written, the disk is too small, or the cluster fails.
    """
    options, path = options or BuildOptions(), located(out)
    summary = _outlook(plan, path, options)
    if options.dry_run:
        if not store_module.is_store(path):
            store_module.check_free(path, plan.spec, len(plan.site))
        return summary
    _check_room(summary, plan.spec)
    if options.scheduler is not None:
        check_scheduler(options.scheduler)

    began = time.monotonic()
    with interruptible(lambda: _interrupted(path, len(plan.site))):
        with contextlib.ExitStack() as stack:
            store = _locked_store(plan, path, options, stack)
            summary = _outlook(plan, path, options)  # another build may have ended before the lock was free
            run = _run(session_factory, plan, options, store, summary)
        run.raise_failures()
        store = store_module.open_store(path)
        return replace(
            summary,
            built=run.built,
            seconds=time.monotonic() - began,
            counts=store_module.count_faults(store, plan.planned_faults, summary.shard_range),
            # every sample was read or made in this run, so its digest is known already
            digest=run.digests.of(store) if run.digests.complete else None,
        )


def _run(
    session_factory: SessionFactory, plan: BuildPlan, options: BuildOptions, store: Store, summary: Summary
) -> Run:
    """Do all tasks, and return the run with its results. The caller holds the store's lock."""
    progress, shards = Progress(summary.samples, shown=options.progress), options.shards_of(store.shards)
    run = Run(store, plan.site, progress, plan.expected, exact=plan.exact, shards=shards)
    with run.progress:
        for line in summary.outlook():
            run.progress.say(line)
        do_tasks(partial(SampleWorker, session_factory, run.path.absolute()), run, options)
    return run


def _interrupted(path: Location, samples: int) -> str:
    """Return the sentence that says how many samples are finished after an interruption."""
    done = store_module.open_store(path).finished() if store_module.is_store(path) else 0
    return f"{path}: interrupted; {done} of {samples} samples are finished, and the same command resumes"


def _outlook(plan: BuildPlan, path: Location, options: BuildOptions) -> Summary:
    """Return what a build would do. Raises InputError if the store at `path` holds another scene."""
    finished, shards = 0, options.shards_of(plan.shards)
    part = None if options.shard_range is None else shards
    if store_module.is_store(path) and not options.overwrite:
        store = store_module.open_store(path)
        check_same_scene(store, plan.spec, plan.blocks, accept_versions=options.accept_versions)
        begun = range(min(shards.stop, store.shards))[shards.start :]
        finished = store.finished() if part is None else sum(sum(store.done(n).values()) for n in begun)
    samples = plan.samples_of(shards)
    seconds = plan.estimated_seconds
    return Summary(
        path=path,
        samples=samples,
        shards=len(shards),
        shard_range=part,
        sites=len(np.unique(plan.site[shards.start * plan.spec.shard_samples :][:samples])),
        finished=finished,
        estimated_bytes=plan.spec.estimated_sample_bytes * samples,
        free_bytes=files_of(path).free_bytes() or sys.maxsize,
        fault_counts=plan.fault_counts(),
        estimated_seconds=None if seconds is None else seconds * samples / len(plan.site),
        optics=plan.spec.attributes.get("optics", {}).get("summary", ""),
    )


def _locked_store(plan: BuildPlan, path: Location, options: BuildOptions, stack: contextlib.ExitStack) -> Store:
    """Lock what the build writes until the stack ends, and return the store, created, repaired or extended.

    Of several builds that write different shards, the first one prepares the store. The others find it whole.
    """
    if options.shard_range is None:
        stack.enter_context(locked(path))
        _outlook(plan, path, options)  # another build may have made another store before the lock was free
        return _prepared_store(plan, path, options)
    shards = options.shards_of(plan.shards)
    with prepared_by_one(path):
        stack.enter_context(locked(path, shards))
        _outlook(plan, path, options)
        if not others_at_work(path, shards):
            return _prepared_store(plan, path, options)
        store = store_module.open_store(path, "r+")
        versions = plan.spec.attributes.get("versions", {})
        if store.samples < len(plan.site) or versions not in known_versions(store.attributes):
            raise VbnfaultError(
                f"{path}: another command is writing shards of it, so no samples or versions can be added now; "
                "wait until it ends"
            )
        return store


def _prepared_store(plan: BuildPlan, path: Location, options: BuildOptions) -> Store:
    """Create, repair or extend the store, and return it open for writing. The caller holds its lock."""
    samples = len(plan.site)
    if options.overwrite or not store_module.is_store(path):
        store_module.create(path, plan.spec, samples, overwrite=options.overwrite)
    store = store_module.recover(path)
    if store.samples < samples:
        store = store_module.append_samples(store, samples - store.samples, {"blocks": list(plan.blocks)})
    return with_versions_noted(store, plan.spec, plan.expected, exact=plan.exact)


def do_tasks(
    workers: WorkerFactory, job: Job, options: BuildOptions, here: WorkerFactory | None = None, recycle: int = 0
) -> None:
    """Do all tasks of a job: on a cluster, in this process, or in worker processes.

    Parameters
    ----------
    workers
        Makes a worker.
    job
        The job.
    options
        Where and by how many it is done.
    here
        Makes the worker of this process, if that is another one.
    recycle
        Number of tasks after which a process is replaced, if it is larger than `options.recycle_shards`.
    """
    if options.scheduler is not None:
        run_on_dask(workers, job, options.scheduler)
    elif options.workers == 1:
        run_here(here or workers, job)
    else:
        threads = options.threads or max(1, environment.usable_cores() // options.workers)
        Pool(workers, job, threads, max(options.recycle_shards, recycle)).work(options.workers)


def _check_room(summary: Summary, spec: StoreSpec) -> None:
    """Raise VbnfaultError if the samples cannot fit on the disk; warn if they may not fit.

    Images compress to between half and twice the estimate.
    """
    needed = spec.estimated_sample_bytes * (summary.samples - summary.finished)
    free, text = summary.free_bytes, f"{summary.path}: about {size_text(needed)} are needed"
    if needed / 2 > free:
        raise VbnfaultError(f"{text}, but only {size_text(free)} are free there; choose another --out")
    if needed > free:
        logging.getLogger("vbnfault").warning(f"{text}, and {size_text(free)} are free there: it may not fit")
