"""Build a dataset: find the missing samples, have workers make them, and handle failures and interruption.

A task completes one shard. Tasks are assigned by site, so that a worker loads the terrain of a site once. A task
first checks the samples that its shard already holds, then makes the others. So a build resumes, repairs and
extends a store with the same code. The arrays do not depend on the order of work, on the number of workers, or on
interruptions and repairs.
"""

from __future__ import annotations

import json
import os
import shutil
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .. import store as store_module
from ..core.errors import InputError, VbnfaultError
from ..core.interrupts import Stopped, exit_code, finishing, interruptible
from ..store import FaultCounts, Store, StoreSpec
from . import versions
from .dask import check_scheduler, run_on_dask
from .errors import BuildFailed, Interrupted
from .lock import locked
from .processes import Pool
from .progress import Progress, duration_text, size_text
from .tasks import Run, SampleMaker, SessionFactory, run_here

__all__ = [
    "RECYCLE_SHARDS",
    "BuildFailed",
    "Interrupted",
    "SampleMaker",
    "SessionFactory",
    "Summary",
    "build",
    "planned_blocks",
]

RECYCLE_SHARDS = 32  # shards after which a worker process is replaced: long LLVM runs grow and finally fail


@dataclass(frozen=True, kw_only=True)
class Summary:
    """What a build would do, or did.

    Attributes
    ----------
    finished, built
        Numbers of samples that existed before, and that were made now.
    estimated_bytes, free_bytes
        Approximate size of the whole store, and free space on its disk.
    fault_counts
        Number of samples planned for each fault class.
    optics
        One line on the lens.
    seconds
        Duration of the build.
    estimated_seconds
        Estimated duration of building the whole dataset; None if unknown.
    counts, digest
        Of the store after the build; None before it. `digest` is also None if a sample is missing.
    description
        Lines that describe what the scene will photograph.
    """

    path: Path
    samples: int
    shards: int
    sites: int
    finished: int
    estimated_bytes: int
    free_bytes: int
    fault_counts: Mapping[str, int] = field(default_factory=dict)
    optics: str = ""
    built: int = 0
    seconds: float = 0.0
    estimated_seconds: float | None = None
    counts: FaultCounts | None = None
    digest: str | None = None
    description: tuple[str, ...] = ()

    def outlook(self) -> list[str]:
        """Return lines that say what there is to do."""
        head = f"{self.path}: {self.samples} samples at {self.sites} sites in {self.shards} shards"
        size = f"about {size_text(self.estimated_bytes)}, {size_text(self.free_bytes)} free"
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
        lines = [f"{self.path}: {self.samples} samples, {self.finished} of them finished before"]
        if self.built:
            lines.append(f"{self.built} samples built in {duration_text(self.seconds)}")
        lines += self.counts.lines()
        if self.counts.missing:
            lines.append(self.counts.missing_text())
        if self.digest is not None:
            lines.append(f"digest {self.digest}")
        return lines


def planned_blocks(
    out: str | os.PathLike[str], samples: int, *, append: int = 0, overwrite: bool = False
) -> tuple[int, ...]:
    """Return the sizes of the planned blocks: those of an existing store, and one of size `append` if it is not 0.

    If the last block was appended, has the size `append` and is unfinished, it is resumed and none is added. So an
    interrupted command can be repeated unchanged. Raises InputError if there is no store to append to, if `append`
    is negative, or if the first block of the store does not have `samples` samples.
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
    planned_faults: NDArray[np.bool_] | None = None,
    estimated_seconds: float | None = None,
    expected: store_module.Planned | None = None,
    exact: bool = False,
    accept_versions: bool = False,
    recycle_shards: int = RECYCLE_SHARDS,
) -> Summary:
    """Build, resume, repair or extend the store at `out`; see the module.

    Parameters
    ----------
    session_factory
        Makes the object that simulates samples. It must be picklable if `workers` > 1 or a scheduler is used.
    spec
        The store to build.
    site
        Site of each sample, int[sample], over all blocks.
    blocks
        Result of `planned_blocks`; one block by default.
    workers
        Number of processes on this machine; 1 uses this process.
    scheduler
        Address of a Dask cluster that does the work instead; its workers must have access to `out`.
    threads
        Threads of each worker process, set through VBNFAULT_THREADS and OMP_NUM_THREADS in its environment; by
        default the cores are divided equally.
    overwrite
        Replace an existing store.
    dry_run
        Only return the summary.
    progress
        Whether to show progress.
    fault_counts, estimated_seconds
        Shown to the user, see `Summary`.
    planned_faults
        Commanded faults, bool[sample, fault], counted beside the injected ones.
    expected, exact
        As in `store.examine`; finished samples that differ from the plan are rebuilt.
    accept_versions
        Also complete a store that was made with other library versions. Its root attribute `versions_of_samples`
        then lists the versions of each sample.
    recycle_shards
        Number of shards after which a worker process is replaced.

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
    sites = np.asarray(site, dtype=np.int64)
    blocks = tuple(blocks or (len(sites),))
    if sum(blocks) != len(sites):
        raise ValueError(f"site has {len(sites)} samples, the blocks {sum(blocks)}")
    if workers < 1:
        raise InputError(f"--workers {workers}: must be at least 1")
    path = Path(out)
    spec = _with_attributes(spec, blocks)

    def outlook() -> Summary:
        existing = store_module.is_store(path) and not overwrite
        if existing:
            _same_scene(store_module.open_store(path), spec, blocks, accept_versions=accept_versions)
        return Summary(
            path=path,
            samples=len(sites),
            shards=-(-len(sites) // spec.shard_samples),
            sites=len(np.unique(sites)),
            finished=store_module.open_store(path).finished() if existing else 0,
            estimated_bytes=spec.estimated_sample_bytes * len(sites),
            free_bytes=_free_bytes(path),
            fault_counts=dict(fault_counts or {}),
            estimated_seconds=estimated_seconds,
            optics=spec.attributes.get("optics", {}).get("summary", ""),
        )

    summary = outlook()
    if dry_run:
        return summary
    _check_room(summary, spec)
    if scheduler is not None:
        check_scheduler(scheduler)

    began = time.monotonic()
    with interruptible():
        try:
            with locked(path):
                summary = outlook()  # again: another build may have ended before the lock was free
                if overwrite or not store_module.is_store(path):
                    store_module.create(path, spec, len(sites), overwrite=overwrite)
                store = store_module.recover(path)
                if store.samples < len(sites):
                    added = len(sites) - store.samples
                    store = store_module.append_samples(store, added, {"blocks": list(blocks)})
                store = _with_versions_noted(store, spec, expected, exact=exact)
                run = Run(store, sites, Progress(len(sites), shown=progress), expected, exact=exact)
                with run.progress:
                    for line in summary.outlook():
                        run.progress.say(line)
                    if scheduler is not None:
                        run_on_dask(session_factory, run, scheduler)
                    elif workers == 1:
                        run_here(session_factory, run)
                    else:
                        share = max(1, (os.cpu_count() or 1) // workers)
                        Pool(session_factory, run, threads or share, recycle_shards).work(workers)
        except (Stopped, KeyboardInterrupt) as stop:
            with finishing():
                done = store_module.open_store(path).finished() if store_module.is_store(path) else 0
            raise Interrupted(
                f"{path}: interrupted; {done} of {len(sites)} samples are finished, and the same command resumes",
                exit_code(stop),
            ) from stop
        run.raise_failures()
        store = store_module.open_store(path)
        results = {
            "built": run.built,
            "seconds": time.monotonic() - began,
            "counts": store_module.count_faults(store, planned_faults),
            # every sample was read or made in this run, so its digest is known already
            "digest": run.digests.of(store) if run.digests.complete else None,
        }
    return Summary(**{**vars(summary), **results})


def _with_attributes(spec: StoreSpec, blocks: tuple[int, ...]) -> StoreSpec:
    """Return the spec with the planned blocks as a root attribute."""
    values = {**spec.plain(), "attributes": {**spec.attributes, "blocks": list(blocks)}}
    return StoreSpec(**values)


def _with_versions_noted(
    store: Store, spec: StoreSpec, expected: store_module.Planned | None, *, exact: bool
) -> Store:
    """Record in a store which samples this build will make with other versions; return the store opened again.

    This happens before any of them is made, so that the record is right after an interruption, too.
    """
    now = spec.attributes.get("versions", {})
    if versions.known(store.attributes) == [now]:
        return store
    wanted = set(store_module.problem_samples(store))
    if expected is not None:
        shards = range(store.shards)
        wanted |= {i for n in shards for i in store_module.unplanned_samples(store, n, expected, exact=exact)}
    made = versions.made_now(store.attributes, now, wanted)
    if made == store.attributes.get(versions.VERSIONS_OF_SAMPLES, []):
        return store
    store.update_attributes({versions.VERSIONS_OF_SAMPLES: made})
    return store_module.open_store(store.path, "r+")


def _same_scene(store: Store, spec: StoreSpec, blocks: tuple[int, ...], *, accept_versions: bool = False) -> None:
    """Raise InputError with the differences if a store does not belong to the scene that is to be built into it."""
    ignored = {
        "blocks",
        versions.VERSIONS_OF_SAMPLES,
        "shard_samples",
        "format",
        "format_version",
        *store_module.VOLATILE_ATTRIBUTES,
    }

    def flat(a_spec: StoreSpec) -> dict[str, Any]:
        everything = json.loads(json.dumps({**a_spec.attributes, **a_spec.plain()}))
        return dict(_flatten({k: v for k, v in everything.items() if k not in ignored}))

    old, new = flat(store.spec), flat(spec)
    absent = object()
    differing = [k for k in {**new, **old} if old.get(k, absent) != new.get(k, absent)]
    if differing and all(k.startswith("versions.") or k == "scene_hash" for k in differing):
        if not accept_versions and spec.attributes.get("versions") not in versions.known(store.attributes):
            which = versions.differences(store.attributes, spec.attributes)
            raise InputError(
                f"{store.path}: was made with other versions: {which}; "
                "--accept-versions completes it with those of now and notes which samples they made, or choose "
                "another --out"
            )
        differing = []
    if differing:
        # keys of the scene first: they tell a user more than the hashes that follow from them
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
    """Yield each value of nested tables with its dotted key."""
    if isinstance(value, dict) and value:
        for name, inner in value.items():
            yield from _flatten(inner, f"{key}.{name}" if key else str(name))
    else:
        yield key, value


def _list(values: Sequence[int]) -> str:
    """Return block sizes as text: `8 + 4`."""
    return " + ".join(str(v) for v in values)


def _free_bytes(path: Path) -> int:
    """Return the free space at a path, in bytes; sys.maxsize if the system does not report it."""
    for folder in (path, *path.absolute().parents):
        try:
            usage = shutil.disk_usage(folder)
        except (OSError, ValueError):  # it does not exist yet, is not accessible, or is no valid name
            continue
        return usage.free if usage.total else sys.maxsize  # some mounts report a size of 0
    return sys.maxsize


def _check_room(summary: Summary, spec: StoreSpec) -> None:
    """Raise VbnfaultError if the samples cannot fit on the disk; warn if they may not fit.

    Images compress to between half and twice the estimate.
    """
    needed = spec.estimated_sample_bytes * (summary.samples - summary.finished)
    free, text = summary.free_bytes, f"{summary.path}: about {size_text(needed)} are needed"
    if needed / 2 > free:
        raise VbnfaultError(f"{text}, but only {size_text(free)} are free there; choose another --out")
    if needed > free:
        print(f"warning: {text}, and {size_text(free)} are free there: it may not fit", file=sys.stderr)
