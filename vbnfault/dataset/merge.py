"""Join stores of one dataset, each of which holds some of its shards, into one store.

Nothing is written before all stores are known to belong together. A shard is read and compared with its checksums
before it is copied, and `done` is written last. So the same command resumes a killed merge, and a damaged copy
never replaces a sound one. The result has the digest of a store that one command built.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .. import store as store_module
from ..core.errors import InputError, VbnfaultError, shown
from ..core.files.path_checks import real
from ..core.process.interrupts import check, finishing, interruptible
from ..store import Location, SampleDigests, Store, StoreSpec, Url, located, spans
from . import card
from .lock import locked
from .progress import Progress
from .resume import VERSIONS_OF_SAMPLES, check_same_dataset, joined_versions


@dataclass(frozen=True, kw_only=True)
class MergeSummary:
    """Describe what a merge did.

    Attributes
    ----------
    samples, finished, before
        Numbers of samples of the dataset, of those that the store now holds, and of those that it held before.
    taken
        By path of a store, the number of samples taken from it now.
    missing
        Samples that none of the stores holds.
    digest
        Digest of the store; None if a sample is missing.
    moved
        Whether the stores have given their shards away.
    """

    path: Location
    samples: int
    finished: int
    before: int
    taken: dict[str, int]
    missing: tuple[int, ...] = ()
    digest: str | None = None
    moved: bool = False

    def lines(self) -> list[str]:
        """Return lines that say what was done."""
        lines = [f"{self.path}: {self.finished} of {self.samples} samples, {self.before} of them merged before"]
        lines += [
            f"{count} samples {'moved' if self.moved else 'copied'} from {path}"
            for path, count in self.taken.items()
        ]
        if self.missing:
            lines.append(
                f"samples {spans(self.missing)} are in none of the stores; the build command with "
                f"--out {self.path} makes them"
            )
        if self.digest is not None:
            lines.append(f"digest {self.digest}")
        return lines


def merge_stores(
    stores: Sequence[str | os.PathLike[str] | Url],
    out: str | os.PathLike[str] | Url,
    *,
    move: bool = False,
    progress: bool = True,
) -> MergeSummary:
    """Join stores as `join_stores` does, and write the card of a complete store."""
    summary = join_stores(stores, out, move=move, progress=progress)
    if not summary.missing:
        card.write_card(summary.path)
    return summary


def migrate_store(
    path: str | os.PathLike[str] | Url, out: str | os.PathLike[str] | Url | None = None, *, progress: bool = True
) -> Store:
    """Copy a store to `out` with the codecs of new stores, which take fewer bytes, and open the copy.

    Values and digest stay the same; unfinished samples stay unfinished. Without `out`, the store itself is opened:
    every format that this vbnfault reads is the current one. For the errors see `join_stores`.
    """
    source = store_module.open_store(path)
    if out is None:
        return source
    target = located(out)
    new = replace(source.spec, codecs={}).codecs
    other = store_module.is_store(target) and not _same(source.path, target)
    if other and store_module.open_store(target).spec.codecs != new:
        raise InputError(f"{target}: exists already, and its layers have other codecs; choose another --out")
    summary = join_stores([source.path], out, progress=progress, codecs={})
    card.write_card(summary.path)
    return store_module.open_store(summary.path)


def join_stores(
    stores: Sequence[str | os.PathLike[str] | Url],
    out: str | os.PathLike[str] | Url,
    *,
    move: bool = False,
    progress: bool = True,
    codecs: Mapping[str, str] | None = None,
) -> MergeSummary:
    """Join stores of one dataset, made with `shard_range` or stopped early, into the store at `out`.

    Parameters
    ----------
    stores
        Paths of the stores. They must be of one scene, seed, plan and set of versions; samples that several of them
        hold must be equal.
    out
        Path of the store that gets all samples; it is made if missing, and may be one of `stores`.
    move
        Remove each shard from its store once `out` holds it. On one file system no byte is copied then.
    progress
        Whether to show the progress on standard error.
    codecs
        Codecs of the layers in a new store; by default those of the first of `stores`. Chunks of other codecs are
        compressed again.

    Raises
    ------
    InputError
        If a path holds no store, or the stores do not belong together; nothing was written then.
    VbnfaultError
        If a sample is damaged in every store that holds it (all others are merged), if files cannot be read or
        written, or if another command writes to a store. The same call resumes.
    Interrupted
        After Ctrl-C, SIGTERM or SIGHUP; the same call resumes.
    """
    target = located(out)
    if isinstance(stores, str | os.PathLike) or not isinstance(stores, Iterable):
        raise InputError(f"stores = {shown(stores)}: must be a list of stores, not one of them")
    paths = dict.fromkeys(map(located, stores))
    sources = [store_module.open_store(path) for path in paths if not _same(path, target)]
    if not sources:
        raise InputError(f"--out {target}: there is nothing to merge: give at least one other store")
    sentence = f"{target}: interrupted; merged samples stay, and the same command resumes"
    with interruptible(lambda: sentence), contextlib.ExitStack() as stack:
        for path in (target, *(source.path for source in sources if move)):
            stack.enter_context(locked(path))
        merge = _Merge(sources, target, move=move, codecs=codecs)
        with Progress(merge.store.samples, shown=progress) as bar:
            summary = merge.run(bar)
    return summary


def _same(path: Location, other: Location) -> bool:
    """Return whether two locations are the same folder or URL."""
    if isinstance(path, Url) or isinstance(other, Url):
        return path == other
    return real(path) == real(other)


class _Merge:
    """Join stores; the constructor compares them and prepares the store that gets their samples.

    `codecs` are those of a new store, by default the ones of the first source.
    """

    def __init__(
        self, sources: Sequence[Store], target: Location, *, move: bool, codecs: Mapping[str, str] | None = None
    ) -> None:
        exists = store_module.is_store(target)
        known = [*([store_module.open_store(target)] if exists else []), *sources]
        for other in known[1:]:
            check_same_dataset(other, known[0])
        _check_equal_samples(known)
        self.sources, self._move = sources, move
        if not exists:
            first = sources[0].spec
            attributes = {k: v for k, v in first.attributes.items() if k != VERSIONS_OF_SAMPLES}
            spec = StoreSpec(
                **{**first.plain(), **({} if codecs is None else {"codecs": codecs})}, attributes=attributes
            )
            store_module.create(target, spec, sources[0].samples)
        self.store = self._with_versions(store_module.recover(target))
        self._digests = SampleDigests(self.store.samples)
        self._begun = {source: set(source.begun()) for source in sources}
        self._before, self._taken = 0, {str(source.path): 0 for source in sources}
        self._damaged: dict[int, str] = {}  # sample → what is wrong with it, in the last store

    def _with_versions(self, store: Store) -> Store:
        """Record which versions made the samples that will be taken; return the store opened again.

        This happens before any is taken, so that the record is right after an interruption, too.
        """
        held = {i for number in store.begun() for i, done in store.done(number).items() if done}
        taken = []
        for source in self.sources:
            new = {i for number in source.begun() for i, done in source.done(number).items() if done} - held
            held |= new
            taken.append((source.attributes, new))
        joined = joined_versions(store.attributes, taken)
        if joined == store.attributes.get(VERSIONS_OF_SAMPLES, []):
            return store
        store.update_attributes({VERSIONS_OF_SAMPLES: joined})
        return store_module.open_store(store.path, "r+")

    def run(self, bar: Progress) -> MergeSummary:
        """Take the samples of all shards."""
        store, missing = self.store, list[int]()
        begun = set(store.begun()).union(*self._begun.values())
        for number in range(store.shards):
            held, before = set[int](), set[int]()
            if number in begun:
                check()
                with finishing():
                    held, before = self._merge_shard(number)
            missing += [i for i in store.shard(number) if i not in held]
            for i in store.shard(number):
                bar.advance(i in held and i not in before)
        lost = sorted(set(self._damaged).intersection(missing))
        if lost:
            raise VbnfaultError(
                f"{store.path}: {len(lost)} samples ({spans(lost)}) are damaged in every store that holds them, "
                f"the first with: {self._damaged[lost[0]]}; all others are merged, and the build command "
                "makes these again"
            )
        return MergeSummary(
            path=store.path,
            samples=store.samples,
            finished=store.samples - len(missing),
            before=self._before,
            taken=self._taken,
            missing=tuple(missing),
            digest=self._digests.of(store) if self._digests.complete else None,
            moved=self._move,
        )

    def _merge_shard(self, number: int) -> tuple[set[int], set[int]]:
        """Take the samples of a shard that the store lacks; return those that it holds then, and held before."""
        digests = dict(store_module.examine_shard(self.store, number).digests)
        before = set(digests)
        self._before += len(digests)
        for source in self.sources:
            finished = {i for i, done in source.done(number).items() if done}
            if not finished - digests.keys():
                continue
            checked = store_module.examine_shard(source, number)
            for problem in checked.problems:
                if not problem.unfinished:
                    self._damaged |= dict.fromkeys(problem.samples, f"{source.path}: {problem.sentence}")
            new = {i: digest for i, digest in checked.digests.items() if i not in digests}
            if not new:
                continue
            same = source.spec.codecs == self.store.spec.codecs
            if same and not digests and new.keys() == finished:
                self.store.copy_shard(number, source, finished, link=self._move)
            else:
                self._add(number, source, new, digests)
            digests |= new
            self._taken[str(source.path)] += len(new)
        self._digests.add(digests)
        for source in self.sources if self._move else ():
            if number in self._begun[source] and _holds_no_other(source, number, digests):
                source.remove_shard(number)
        return set(digests), before

    def _add(self, number: int, source: Store, new: Collection[int], held: Collection[int]) -> None:
        """Add some samples of a source to a shard of which the store holds others."""
        try:
            encoded = source.encoded(number, new, self.store.spec.codecs)
        except (OSError, ValueError) as error:
            raise VbnfaultError(f"{source.path}: shard {number} changed while it was read ({error})") from error
        self.store.write_shard(number, encoded, damaged=set(self.store.shard(number)).difference(held, new))


def _check_equal_samples(stores: Sequence[Store]) -> None:
    """Raise InputError if two stores hold different versions of a sample; their checksums are compared."""
    for number in sorted(set().union(*(store.begun() for store in stores))):
        known: dict[int, tuple[Store, NDArray[Any]]] = {}
        for store in stores:
            try:
                done, crcs = store.column("done", number), store.column("crc32c", number)
            except (OSError, ValueError):  # not begun, or damaged: no sample is taken from there
                continue
            for k in np.flatnonzero(done):
                i = store.shard(number)[k]
                other, row = known.setdefault(i, (store, crcs[k]))
                if not np.array_equal(row, crcs[k]):
                    differing = [
                        name for name, a, b in zip(store.spec.checked, row, crcs[k], strict=True) if a != b
                    ]
                    raise InputError(
                        f"{store.path}: sample {i} differs from that in {other.path} in {', '.join(differing)}; "
                        "merge only one of the two"
                    )


def _holds_no_other(source: Store, number: int, held: Collection[int]) -> bool:
    """Return whether every finished sample of a shard is among those `held` elsewhere."""
    try:
        done = source.column("done", number)
    except FileNotFoundError:  # removed by a merge that was killed
        return True
    except (OSError, ValueError):
        return False
    return all(source.shard(number)[k] in held for k in np.flatnonzero(done))
