"""Check that a store is complete, correctly labelled and as planned; compute the digest that identifies it.

Every problem is reported as one sentence. Two stores with the same digest hold the same data.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..core.errors import VbnfaultError
from ..core.quantities import soft_kind
from .bucket import Url
from .codec import DIGEST_BYTES, crc32c, crc_of_scalars, mask_union, sample_digest, threads
from .group import open_store
from .layout import drawn_table
from .metadata import metadata_problems, short
from .opened import Store
from .schema import DIGEST_VERSION, MAX_HELD_BYTES, SPLITS, VOLATILE_ATTRIBUTES, StoreSpec


class FaultCounts:
    """Count the samples for which each fault class is planned, and those in which it is injected, by split."""

    def __init__(self, faults: Sequence[str]) -> None:
        self.faults = tuple(faults)
        self.samples: Counter[str] = Counter()
        self._planned: Counter[tuple[str, str]] = Counter()
        self._realised: Counter[tuple[str, str]] = Counter()
        self._has_plan = True

    def add(self, splits: NDArray[Any], planned: NDArray[np.bool_] | None, injected: NDArray[np.bool_]) -> None:
        """Count some samples: their splits, str[sample], commanded and injected faults, bool[sample, fault].

        `planned` is None if no plan is known.
        """
        self._has_plan &= planned is not None
        for split in dict.fromkeys(splits.tolist()):
            chosen = splits == split
            self.samples[split] += int(chosen.sum())
            for counts, flags in ((self._planned, planned), (self._realised, injected)):
                if flags is not None:
                    totals = flags[chosen].sum(axis=0).tolist()
                    for fault, total in zip(self.faults, totals, strict=True):
                        counts[split, fault] += total

    def planned(self, fault: str, split: str | None = None) -> int:
        """Return the number of samples for which a fault is planned, in one split or in all."""
        return sum(n for (s, f), n in self._planned.items() if f == fault and split in (None, s))

    def realised(self, fault: str, split: str | None = None) -> int:
        """Return the number of samples in which a fault is injected, in one split or in all."""
        return sum(n for (s, f), n in self._realised.items() if f == fault and split in (None, s))

    @property
    def missing(self) -> dict[str, int]:
        """Return planned minus realised samples by fault class, only where the difference is not 0."""
        if not self._has_plan:
            return {}
        differences = {f: self.planned(f) - self.realised(f) for f in self.faults}
        return {fault: n for fault, n in differences.items() if n}

    @property
    def splits(self) -> list[str]:
        """Return the splits that have samples, in their usual order."""
        known = [name for name in SPLITS if name in self.samples]
        return [*known, *sorted(set(self.samples) - set(known))]

    def missing_text(self) -> str:
        """Return `missing` as a sentence."""
        few = ", ".join(f"{name} {count}" for name, count in self.missing.items())
        return f"planned, but without effect and not injected: {few}"

    def lines(self) -> list[str]:
        """Return a text table: for each fault class the planned and realised samples, in all and by split."""
        if not self.faults or not self.samples:
            return []
        splits = self.splits
        head = ["fault", "planned", "realised", *splits]
        if not self._has_plan:
            head.remove("planned")
        table = [head]
        for fault in self.faults:
            row = [fault, str(self.planned(fault)), str(self.realised(fault))]
            for split in splits:
                planned, realised = self.planned(fault, split), self.realised(fault, split)
                same = planned == realised or not self._has_plan
                row.append(str(realised) if same else f"{realised} of {planned}")
            table.append(row if self._has_plan else [row[0], *row[2:]])
        totals = ["samples", *[""] * (len(head) - len(splits) - 2), str(self.samples.total())]
        table.append([*totals, *(str(self.samples[s]) for s in splits)])
        return aligned(table)


def aligned(table: list[list[str]]) -> list[str]:
    """Return the rows of a table as lines; columns of numbers are aligned to the right, others to the left."""
    columns = list(zip(*table, strict=True))
    adjusted = []
    for column in columns:
        width = max(map(len, column))
        is_text = any(cell[:1].isalpha() for cell in column[1:])
        adjusted.append([cell.ljust(width) if is_text else cell.rjust(width) for cell in column])
    return ["  ".join(row).rstrip() for row in zip(*adjusted, strict=True)]


class Problem(NamedTuple):
    """Say in one sentence what is wrong with some samples.

    `unfinished` is True if they are not damaged, but only not built yet.
    """

    samples: tuple[int, ...]
    sentence: str
    unfinished: bool = False


Planned = Callable[[int, int], Mapping[str, Any]]  # (sample, its `tries`) → planned scalars by name
_MOST_RANGES = 16  # sample ranges that one sentence lists


class ShardCheck(NamedTuple):
    """Hold the result of reading one shard.

    Attributes
    ----------
    problems
        What is unfinished, missing or damaged.
    scalars, digests, contradictions
        By sample, for undamaged finished samples only: the scalars, the digest (`sample_digest`), and one sentence
        for each contradiction between labels and pixels (no sentence unless labels were checked).
    """

    problems: list[Problem]
    scalars: dict[int, dict[str, Any]]
    digests: dict[int, bytes]
    contradictions: dict[int, list[str]]

    @property
    def wanted(self) -> set[int]:
        """Return the samples that must be built or rebuilt."""
        wrong = {i for i, sentences in self.contradictions.items() if sentences}
        return wrong.union(*(problem.samples for problem in self.problems))


def examine_shard(store: Store, number: int, *, labels: bool = False) -> ShardCheck:
    """Read one shard once: decode every finished layer, compare it with its checksum, compute its digest.

    `labels`: also compare the labels of the samples with their pixels.
    """
    samples = store.shard(number)
    columns, unreadable = _columns(store, number)
    if "done" not in columns and store.files.exists(store.file_name("image", number)):
        problem = Problem(tuple(samples), f"done of samples {spans(samples)}: {unreadable['done']}")
        return ShardCheck([problem], {}, {}, {})
    finished = [i for i in samples if "done" in columns and columns["done"][i - samples.start]]
    missing = tuple(i for i in samples if i not in finished)
    problems = [Problem(missing, f"samples {spans(missing)}: not finished", True)] if missing else []
    if not finished:
        return ShardCheck(problems, {}, {}, {})
    problems += [
        Problem(tuple(finished), f"{name} of samples {spans(finished)}: {why}") for name, why in unreadable.items()
    ]
    if "crc32c" not in columns:
        return ShardCheck(problems, {}, {}, {})
    crcs = {i: columns["crc32c"][i - samples.start] for i in finished}
    scalars: dict[int, dict[str, Any]] = {}
    if not unreadable:
        scalars = {i: {name: columns[name][i - samples.start] for name in store.spec.scalars} for i in finished}
        problems += [
            Problem((i,), f"sample {i}: its scalars do not match their crc32c")
            for i in finished
            if crc_of_scalars(scalars[i]) != crcs[i][-1]
        ]
    chunks, lost = _chunks(store, number, finished)
    problems += lost
    damaged = {i for problem in problems for i in problem.samples}

    def examine_sample(i: int) -> _SampleCheck:
        problems_of_layers, layers = _layers(store, number, i, chunks, crcs[i])
        if problems_of_layers or i in damaged:
            return _SampleCheck(problems_of_layers, None, [])
        sentences = list(_check_labels(store.spec, i, scalars[i], layers, crcs[i])) if labels else []
        hashes = {name: hashlib.sha256(a.data if a.size else b"").digest() for name, a in layers.items()}
        return _SampleCheck([], sample_digest(hashes, scalars[i]), sentences)

    sample_bytes = sum(map(store.spec.layer_bytes, store.spec.pixel_layers))
    with ThreadPoolExecutor(min(threads(), 1 + MAX_HELD_BYTES // sample_bytes)) as pool:
        checks = dict(zip(finished, pool.map(examine_sample, finished), strict=True))
    by_layer = sorted(
        (entry for check in checks.values() for entry in check.problems),
        key=lambda entry: (entry[0], entry[1].samples),
    )
    sound = {i: check for i, check in checks.items() if check.digest is not None}
    return ShardCheck(
        problems=[*problems, *(problem for _, problem in by_layer)],
        scalars={i: scalars[i] for i in sound},
        digests={i: check.digest for i, check in sound.items() if check.digest is not None},
        contradictions={i: check.contradictions for i, check in sound.items()},
    )


class _SampleCheck(NamedTuple):
    """Hold the result of examining one sample: problems by layer, the digest, and contradictions.

    `digest` is None if the sample is damaged.
    """

    problems: list[tuple[int, Problem]]
    digest: bytes | None
    contradictions: list[str]


def _columns(store: Store, number: int) -> tuple[dict[str, NDArray[Any]], dict[str, str]]:
    """Return the scalars of a shard by name, and for each that cannot be read the reason as a clause.

    If `done` cannot be read, nothing else is.
    """
    columns: dict[str, NDArray[Any]] = {}
    unreadable: dict[str, str] = {}
    for names in (("done",), ("crc32c", *store.spec.scalars)):
        for name, column in zip(names, store.columns(names, number), strict=True):
            file = store.file_name(name, number)
            if not isinstance(column, Exception):
                columns[name] = column
            elif isinstance(column, FileNotFoundError):
                unreadable[name] = f"the chunk file {file} is missing"
            elif isinstance(column, ValueError):
                unreadable[name] = f"cannot be decoded, {file} is damaged"
            else:
                unreadable[name] = f"{file} cannot be read: {column.strerror}"
        if "done" not in columns:
            break
    return columns, unreadable


def _chunks(store: Store, number: int, finished: list[int]) -> tuple[dict[str, dict[int, bytes]], list[Problem]]:
    """Return the compressed chunks of a shard by layer and sample, and one problem for each unreadable file."""
    chunks: dict[str, dict[int, bytes]] = {}
    problems = []
    for name in store.spec.pixel_layers:
        if store.spec.empty(name):
            continue
        file = store.file_name(name, number)
        try:
            chunks[name] = store.chunk(name, number)
        except FileNotFoundError:
            why = "is missing"
        except ValueError as error:
            why = f"is damaged: {error}"
        except OSError as error:
            why = f"cannot be read: {error.strerror}"
        if name not in chunks:
            sentence = f"{name} of samples {spans(finished)}: the shard file {file} {why}"
            problems.append(Problem(tuple(finished), sentence))
    return chunks, problems


def _layers(
    store: Store, number: int, i: int, chunks: Mapping[str, Mapping[int, bytes]], crcs: NDArray[np.uint32]
) -> tuple[list[tuple[int, Problem]], dict[str, NDArray[Any]]]:
    """Return the problems of one sample, each with the index of its layer, and its layers."""
    problems: list[tuple[int, Problem]] = []
    layers: dict[str, NDArray[Any]] = {}
    for k, name in enumerate(store.spec.pixel_layers):
        if store.spec.empty(name):
            layers[name] = store.decoded(name, b"")
        if name not in chunks:
            continue
        file, why = store.file_name(name, number), ""
        if i not in chunks[name]:
            why = f"has no chunk in {file}"
        else:
            try:
                layers[name] = store.decoded(name, chunks[name][i])
                if crc32c(layers[name]) != crcs[k]:
                    why = f"in {file} does not match its stored crc32c"
            except ValueError:
                why = f"cannot be decoded, its chunk in {file} is damaged"
        if why:
            problems.append((k, Problem((i,), f"sample {i}: {name} {why}")))
    return problems, layers


def runs(indices: Iterable[int]) -> list[list[int]]:
    """Return indices as ascending ranges [first, last]."""
    ranges: list[list[int]] = []
    for i in sorted(indices):
        if ranges and i == ranges[-1][1] + 1:
            ranges[-1][1] = i
        else:
            ranges.append([i, i])
    return ranges


def spans(indices: Iterable[int]) -> str:
    """Return indices as ranges: `3-7, 9` for 3, 4, 5, 6, 7, 9."""
    return ", ".join(str(a) if a == b else f"{a}-{b}" for a, b in runs(indices))


def _not_built(samples: list[int]) -> Iterator[str]:
    """Yield one sentence that lists the first ranges of the samples that are not built yet; none if all are."""
    if samples:
        ranges = spans(samples).split(", ")
        more = f" and {len(ranges) - _MOST_RANGES} ranges more" if len(ranges) > _MOST_RANGES else ""
        listed = ", ".join(ranges[:_MOST_RANGES]) + more
        yield f"samples {listed} are not built yet" if len(samples) > 1 else f"sample {listed} is not built yet"


def problem_samples(store: str | os.PathLike[str] | Url | Store) -> list[int]:
    """Return the samples that must be built or rebuilt: unfinished, missing or damaged ones, in ascending order."""
    store = open_store(store)
    begun = store.begun()
    wanted = {i for n in begun for p in examine_shard(store, n).problems for i in p.samples}
    return sorted(wanted.union(*(store.shard(n) for n in {*range(store.shards)}.difference(begun))))


def unplanned_samples(store: Store, number: int, expected: Planned, *, exact: bool = False) -> set[int]:
    """Return the finished samples of a shard whose stored scalars differ from the plan.

    The set is empty if the scalars cannot be read: `examine_shard` reports that. `examine` explains the parameters.
    """
    finished = [i for i, done in store.done(number).items() if done]
    try:
        columns = {name: store.column(name, number) for name in store.spec.scalars} if finished else {}
    except (OSError, ValueError):
        return set()
    scalars = {
        i: {name: column[i - number * store.spec.shard_samples] for name, column in columns.items()}
        for i in finished
    }
    return {
        i
        for i in finished
        if any(_check_plan(store.spec, i, scalars[i], expected(i, int(scalars[i]["tries"])), exact))
    }


class Report(NamedTuple):
    """Hold the result of `examine`.

    Attributes
    ----------
    problems
        One sentence each.
    digest
        sha256 (hex); None if a sample is missing or damaged.
    counts
        How often each fault class is planned, and how often it is in the pixels.
    """

    problems: list[str]
    digest: str | None
    counts: FaultCounts


def examine(
    path: str | os.PathLike[str] | Url | Store,
    *,
    expected: Planned | None = None,
    exact: bool = False,
    progress: Callable[[int], None] | None = None,
) -> Report:
    """Read a store once and return every problem, its digest and its counts of faults.

    First check that every array exists and that its layout, attributes and coordinates match the schema and the
    consolidated metadata. If the layout of an array of samples is wrong, no sample is read. Then check that each
    sample is complete (`examine_shard`) and labelled: masks, `injected`, `parameters` and images must agree, and
    all samples of a site must be in one split.

    Parameters
    ----------
    expected
        Called with a sample and its stored `tries`; returns the scalars planned for that view. They are compared
        exactly, except `injected`, for which it returns the commanded faults.
    exact
        Whether a commanded fault that is not injected is a problem. An injected fault that was not commanded is
        always one.
    progress
        Called with the number of samples just checked.

    Raises
    ------
    InputError
        If there is no store at `path`.
    """
    store = open_store(path)
    counts = FaultCounts(store.spec.faults)
    problems, hopeless = metadata_problems(store)
    if hopeless:
        return Report(problems, None, counts)
    digests = SampleDigests(store.samples)
    split_of: dict[int, tuple[int, str]] = {}
    not_built: list[int] = []
    begun = set(store.begun())
    for number in range(store.shards):
        if number not in begun:
            not_built += store.shard(number)
            continue
        check = examine_shard(store, number, labels=True)
        problems += [p.sentence for p in check.problems if not p.unfinished]
        not_built += [i for p in check.problems if p.unfinished for i in p.samples]
        digests.add(check.digests)
        for i, scalars in check.scalars.items():
            planned = expected(i, int(scalars["tries"])) if expected else {}
            problems += check.contradictions[i]
            problems += _check_split(store, i, scalars, split_of)
            problems += _check_plan(store.spec, i, scalars, planned, exact)
            commanded = None if "injected" not in planned else np.asarray(planned["injected"])[None]
            counts.add(np.array([str(scalars["split"])]), commanded, scalars["injected"][None])
        if progress:
            progress(len(store.shard(number)))
    if progress and len(begun) < store.shards:
        progress(sum(len(store.shard(n)) for n in range(store.shards) if n not in begun))
    problems += _not_built(not_built)
    return Report(problems, digests.of(store) if digests.complete else None, counts)


def count_faults(
    store: Store, planned: NDArray[np.bool_] | None = None, shards: range | None = None
) -> FaultCounts:
    """Return how often each fault is injected in the finished samples, and how often it is planned there.

    `planned`: commanded faults, bool[sample, fault]. `shards`: which shards are counted; all by default. Only
    the arrays `done`, `split` and `injected` are read.
    """
    counts = FaultCounts(store.spec.faults)
    for number in store.begun():
        done = np.array(list(store.done(number).values()))
        if (shards is not None and number not in shards) or not done.any():
            continue
        samples = store.shard(number)
        commanded = None if planned is None else planned[samples.start : samples.stop][done]
        counts.add(store.column("split", number)[done], commanded, store.column("injected", number)[done])
    return counts


def _check_labels(
    spec: StoreSpec,
    i: int,
    scalars: Mapping[str, Any],
    layers: Mapping[str, NDArray[Any]],
    crcs: NDArray[np.uint32],
) -> Iterator[str]:
    """Yield one sentence for each contradiction between a sample's labels and its pixels or other labels."""
    injected = scalars["injected"]
    try:
        parameters = drawn_table(scalars["parameters"])
    except ValueError:
        yield f"sample {i}: its parameters are no table in JSON"
        return
    for fault, is_in in zip(spec.faults, injected.tolist(), strict=True):
        drawn = parameters.get(fault)
        listed = drawn is not None and not (isinstance(drawn, dict) and drawn.get("injected") is False)
        if listed != is_in:
            clause = "has no parameters, although" if is_in else "has parameters, although not"
            yield f"sample {i}: {fault} {clause} marked in injected"
    mask = layers["mask"]
    yield from _check_masks(i, spec.faults, "mask", mask, injected, spec.localised_faults or ())
    effect: Any = ()
    if "mask_effect" in layers:
        # by definition, an injected fault changes the noise-free image somewhere
        effect = layers["mask_effect"]
        yield from _check_masks(i, spec.faults, "mask_effect", effect, injected, spec.faults)
    mask_any, union = layers["mask_any"], mask_union(spec, mask)
    members = ", ".join(spec.mask_any_faults) or "no class"
    is_joint = spec.mask_any_joint and injected[[name in spec.mask_any_faults for name in spec.faults]].any()
    if is_joint and (union & ~mask_any).any():
        yield f"sample {i}: mask_any does not hold the masks of {members}"
    if not is_joint and not np.array_equal(mask_any, union):
        yield f"sample {i}: mask_any is not the union of the masks of {members}"
    for fault, name, is_in in zip(spec.faults, spec.soft_layers, injected, strict=False):
        if name in layers and not is_in and (layers[name] != soft_kind(name).neutral).any():
            yield f"sample {i}: {name} is not {soft_kind(name).neutral:g}, although {fault} is not injected"
    for fault, kind, its_mask, its_effect in zip(spec.faults, spec.mask_kinds, mask, effect, strict=False):
        if kind == "effect" and not np.array_equal(its_mask, its_effect):
            yield f"sample {i}: mask of {fault} is not its effect, as mask_effect has it"
        if kind == "strong effect" and (its_mask & ~its_effect).any():
            yield f"sample {i}: mask of {fault} holds pixels outside of its effect, as mask_effect has it"
    # equal checksums mean equal images: both have just been compared with their pixels
    crc = dict(zip(spec.pixel_layers, crcs.tolist(), strict=False))
    if not injected.any() and crc["image"] != crc["clean"]:
        yield f"sample {i}: image differs from clean, although no fault is injected"
    for name in layers:
        fault = name.removeprefix("without_")
        if fault != name and not injected[spec.faults.index(fault)] and crc[name] != crc["image"]:
            yield f"sample {i}: {name} differs from image, although {fault} is not injected"


def _check_masks(
    i: int,
    faults: Iterable[str],
    name: str,
    masks: NDArray[np.bool_],
    injected: Iterable[bool],
    seen: Iterable[str],
) -> Iterator[str]:
    """Yield one sentence for each mask that marks a fault that is not injected, or that is empty although its fault
    is injected and is one of `seen`."""
    seen = set(seen)
    for fault, mask, is_in in zip(faults, masks, injected, strict=True):
        marks = bool(mask.any())
        if marks and not is_in:
            yield f"sample {i}: {name} of {fault} is not empty, although it is not injected"
        if is_in and not marks and fault in seen:
            yield f"sample {i}: {name} of {fault} is empty, although it is injected"


def _check_split(
    store: Store, i: int, scalars: Mapping[str, Any], split_of: dict[int, tuple[int, str]]
) -> Iterator[str]:
    """Yield a sentence if a sample's split differs from that of the first sample of its site.

    `split_of`: site → (its first sample, the split of that sample); this function adds new sites.
    """
    site, split = int(scalars["site"]), str(scalars["split"])
    first, before = split_of.setdefault(site, (i, split))
    if split != before:
        names = store.spec.site_names
        named = names[site] if 0 <= site < len(names) else str(site)
        yield f"sample {i}: split = {split}, but sample {first} of the same site {named} has {before}"


def _check_plan(
    spec: StoreSpec, i: int, scalars: Mapping[str, Any], expected: Mapping[str, Any], exact: bool
) -> Iterator[str]:
    """Yield one sentence for each stored scalar of a sample that differs from the `expected` (planned) one."""
    for name, planned in expected.items():
        stored = scalars[name]
        if name == "injected":  # a commanded fault may have no effect, but no other fault may be injected
            for fault, is_in, commanded in zip(spec.faults, stored, planned, strict=True):
                if is_in and not commanded:
                    yield f"sample {i}: {fault} is injected, but the plan does not command it"
                if exact and commanded and not is_in:
                    yield f"sample {i}: {fault} is not injected, although the plan commands it"
            continue
        row = spec.scalars[name]
        if row.is_text:
            text = planned if isinstance(planned, str) else json.dumps(planned)
            same = str(stored) == text or _parsed(str(stored)) == _parsed(text)
        else:
            values = np.asarray(planned).astype(row.dtype)
            same = np.array_equal(values, stored, equal_nan=row.dtype == "float64")
        if not same:
            yield f"sample {i}: {name} = {short(stored)} is not as planned ({short(planned)})"


def _parsed(text: str) -> Any:
    """Return JSON text as data, so that the order of keys does not count; return other text as it is."""
    try:
        return json.loads(text)
    except (ValueError, RecursionError):
        return text


class SampleDigests:
    """Collect the digests of a store's samples in any order; compute the digest of the store from them."""

    def __init__(self, samples: int) -> None:
        self._digests = np.zeros((samples, DIGEST_BYTES), dtype=np.uint8)

    def add(self, digests: Mapping[int, bytes]) -> None:
        """Add the digests of some samples."""
        for i, digest_of_sample in digests.items():
            self._digests[i] = np.frombuffer(digest_of_sample, dtype=np.uint8)

    @property
    def complete(self) -> bool:
        """Return whether every sample has a digest."""
        return bool(self._digests.any(axis=1).all())

    def of(self, store: Store) -> str:
        """Return the sha256 (hex) of the root attributes, the schema and the samples' digests.

        A sample without a digest counts as unfinished: zeros stand for it.
        """
        attributes = {k: v for k, v in store.attributes.items() if k not in VOLATILE_ATTRIBUTES}
        attributes["format_version"] = DIGEST_VERSION
        arrays = [[name, array.dims, array.dtype] for name, array in sorted(store.spec.arrays.items())]
        total = hashlib.sha256(
            json.dumps([attributes, store.spec.data, store.samples, arrays], sort_keys=True).encode()
        )
        total.update(self._digests.data)
        return total.hexdigest()


def digest(path: str | os.PathLike[str] | Url | Store, *, progress: Callable[[int], None] | None = None) -> str:
    """Return the sha256 (hex) of the data in a store: root attributes, schema, and decoded arrays of its samples.

    The digest does not depend on the creation time, the sharding or the compression. The store is read once, shard
    by shard; `progress` is called with the number of samples just read. Raises VbnfaultError for damaged chunks and
    for an array that cannot be opened.
    """
    store = open_store(path)
    problems, hopeless = metadata_problems(store)
    if hopeless:
        more = f", and there are {len(problems) - 1} problems more" if len(problems) > 1 else ""
        raise VbnfaultError(f"{store.path}: {problems[0]}{more}; the build command mends it")
    digests = SampleDigests(store.samples)
    for number in store.begun():
        check = examine_shard(store, number)
        for problem in check.problems:
            if not problem.unfinished:
                raise VbnfaultError(f"{store.path}: {problem.sentence}; the build command mends it")
        digests.add(check.digests)
        if progress:
            progress(len(store.shard(number)))
    return digests.of(store)
