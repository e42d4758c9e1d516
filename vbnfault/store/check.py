"""Is a store whole, labelled and as planned? Every problem is a sentence; `digest` says whether two are equal."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import google_crc32c
import numpy as np
from numpy.typing import NDArray

from .codec import crc_of_scalars, decompress, mask_union, threads
from .group import Store, open_store
from .metadata import metadata_problems, short
from .schema import SCALARS, VOLATILE_ATTRIBUTES, StoreSpec


class Problem(NamedTuple):
    """What is wrong with some samples, in one sentence."""

    samples: tuple[int, ...]
    sentence: str


def check_shard(store: Store, number: int) -> list[Problem]:
    """What is unfinished, missing or damaged in one shard; every finished layer is decoded and compared."""
    samples = store.shard(number)
    columns: dict[str, NDArray[Any]] = {}
    unreadable = {}
    for name in ("done", "crc32c", *SCALARS):
        where = store.file(name, number).relative_to(store.path)
        try:
            columns[name] = store.column(name, number)
        except FileNotFoundError:
            unreadable[name] = f"the chunk file {where} is missing"
        except (OSError, ValueError):
            unreadable[name] = f"cannot be decoded, {where} is damaged"
        if name == "done" and unreadable and store.file("image", number).exists():
            return [Problem(tuple(samples), f"done of samples {_spans(samples)}: {unreadable[name]}")]
        if name == "done" and unreadable:
            break
    finished = [i for i in samples if "done" in columns and columns["done"][i - samples.start]]
    missing = tuple(i for i in samples if i not in finished)
    problems = [Problem(missing, f"samples {_spans(missing)}: not finished")] if missing else []
    if not finished:
        return problems
    many = f"of samples {_spans(finished)}"
    problems += [Problem(tuple(finished), f"{name} {many}: {why}") for name, why in unreadable.items()]
    if "crc32c" not in columns:
        return problems
    if not unreadable:
        for i in finished:
            k = i - samples.start
            if crc_of_scalars({n: columns[n][k] for n in SCALARS}) != columns["crc32c"][k, -1]:
                problems.append(Problem((i,), f"sample {i}: its scalars do not match their crc32c"))

    crcs = {i: columns["crc32c"][i - samples.start] for i in finished}
    with ThreadPoolExecutor(threads()) as pool:
        for found in pool.map(lambda name: _check_layer(store, name, number, crcs), store.spec.pixel_layers):
            problems += found
    return problems


def _check_layer(store: Store, name: str, number: int, crcs: Mapping[int, NDArray[np.uint32]]) -> list[Problem]:
    if store.spec.empty(name):
        return []
    file, column = store.file(name, number), store.spec.checked.index(name)
    where, many = file.relative_to(store.path), f"{name} of samples {_spans(crcs)}"
    try:
        chunks = store.chunk(name, number)
    except FileNotFoundError:
        return [Problem(tuple(crcs), f"{many}: the shard file {where} is missing")]
    except (OSError, ValueError) as error:
        return [Problem(tuple(crcs), f"{many}: the shard file {where} is damaged: {error}")]
    problems = []
    for i, stored in crcs.items():
        wrong = ""
        if i not in chunks:
            wrong = f"has no chunk in {where}"
        else:
            try:
                if google_crc32c.value(decompress(chunks[i])) != stored[column]:
                    wrong = f"in {where} does not match its stored crc32c"
            except ValueError:
                wrong = f"cannot be decoded, its chunk in {where} is damaged"
        if wrong:
            problems.append(Problem((i,), f"sample {i}: {name} {wrong}"))
    return problems


def _spans(indices: Iterable[int]) -> str:
    """`3-7, 9` for 3, 4, 5, 6, 7, 9."""
    runs: list[list[int]] = []
    for i in sorted(indices):
        if runs and i == runs[-1][1] + 1:
            runs[-1][1] = i
        else:
            runs.append([i, i])
    return ", ".join(str(a) if a == b else f"{a}-{b}" for a, b in runs)


def problem_samples(store: str | os.PathLike[str] | Store) -> list[int]:
    """Samples that have to be built, or built again: unfinished, missing or damaged ones."""
    store = open_store(store)
    return sorted({i for n in range(store.shards) for p in check_shard(store, n) for i in p.samples})


def verify(
    path: str | os.PathLike[str] | Store,
    *,
    expected: Callable[[int], Mapping[str, Any]] | None = None,
    progress: Callable[[int], None] | None = None,
) -> list[str]:
    """Every problem of a store, one sentence each that names the array, the sample and the file.

    Checks that every array is there with its layout, attributes and coordinates, and as the consolidated
    metadata say; where an array of samples is not, samples are not looked at. Checks that each sample is whole
    (`check_shard`) and labelled: masks, `injected` and `parameters` agree, a site lies in one split.
    `expected(sample)` gives the scalars as planned, compared exactly, except for `injected`: there it gives the
    commanded faults, of which some may have had no effect. `progress` is called with the number of samples just
    checked. Raises InputError where there is no store.
    """
    store = open_store(path)
    problems, hopeless = metadata_problems(store)
    if hopeless:
        return problems
    split_of: dict[int, tuple[int, int]] = {}
    for number in range(store.shards):
        damage = check_shard(store, number)
        problems += [p.sentence for p in damage]
        broken = {i for p in damage for i in p.samples}
        sound = [i for i in store.shard(number) if i not in broken]
        if sound:
            start = store.shard(number).start
            columns = {name: store.column(name, number) for name in SCALARS}
            masks = {name: store.chunk(name, number) for name in ("mask", "mask_any")}
            for i in sound:
                scalars = {name: column[i - start] for name, column in columns.items()}
                layers = {name: _decode(store.spec, name, chunks[i]) for name, chunks in masks.items()}
                problems += _check_labels(store.spec, i, scalars, layers)
                problems += _check_split(store, i, scalars, split_of)
                problems += _check_plan(store.spec, i, scalars, expected(i) if expected else {})
        if progress:
            progress(len(store.shard(number)))
    return problems


def _decode(spec: StoreSpec, name: str, chunk: bytes) -> NDArray[Any]:
    row = spec.pixel_layers[name]
    if spec.empty(name):
        return np.zeros(spec.shape(row), dtype=row.dtype)
    return np.frombuffer(decompress(chunk), dtype=row.dtype).reshape(spec.shape(row))


def _check_labels(
    spec: StoreSpec, i: int, scalars: Mapping[str, Any], layers: Mapping[str, NDArray[Any]]
) -> Iterator[str]:
    injected, mask = scalars["injected"], layers["mask"]
    parameters = json.loads(str(scalars["parameters"]) or "{}")
    for fault, is_in in zip(spec.faults, injected.tolist(), strict=True):
        drawn = parameters.get(fault)
        listed = drawn is not None and not (isinstance(drawn, dict) and drawn.get("injected") is False)
        if listed != is_in:
            says = "has no parameters, although" if is_in else "has parameters, although not"
            yield f"sample {i}: {fault} {says} marked in injected"
    for k, fault in enumerate(spec.faults):
        if not injected[k] and mask[k].any():
            yield f"sample {i}: mask of {fault} is not empty, although it is not injected"
        if injected[k] and fault in (spec.localised_faults or ()) and not mask[k].any():
            yield f"sample {i}: mask of {fault} is empty, although it is injected"
    if not np.array_equal(layers["mask_any"], mask_union(spec, mask)):
        yield f"sample {i}: mask_any is not the union of the masks of {', '.join(spec.mask_any_faults)}"


def _check_split(
    store: Store, i: int, scalars: Mapping[str, Any], split_of: dict[int, tuple[int, int]]
) -> Iterator[str]:
    site, split = int(scalars["site"]), int(scalars["split"])
    first, before = split_of.setdefault(site, (i, split))
    if split != before:
        names = store.spec.site_names
        named = names[site] if 0 <= site < len(names) else str(site)
        yield f"sample {i}: split = {split}, but sample {first} of the same site {named} has {before}"


def _check_plan(spec: StoreSpec, i: int, scalars: Mapping[str, Any], expected: Mapping[str, Any]) -> Iterator[str]:
    for name, planned in expected.items():
        stored = scalars[name]
        if name == "injected":  # a commanded fault may have no effect, but no other may be there
            for fault, is_in, commanded in zip(spec.faults, stored, planned, strict=True):
                if is_in and not commanded:
                    yield f"sample {i}: {fault} is injected, but the plan does not command it"
            continue
        if SCALARS[name].is_text:
            planned = json.loads(planned) if isinstance(planned, str) else json.loads(json.dumps(planned))
            same = json.loads(str(stored)) == planned
        else:
            values = np.asarray(planned).astype(SCALARS[name].dtype)
            same = np.array_equal(values, stored, equal_nan=SCALARS[name].dtype == "float64")
        if not same:
            yield f"sample {i}: {name} = {short(stored)} is not as planned ({short(planned)})"


def digest(path: str | os.PathLike[str] | Store) -> str:
    """sha256 (hex) of what a store holds: root attributes, and decoded arrays with dims and dtypes.

    Time of creation, sharding and compression are no part of it. Raises VbnfaultError for damaged chunks.
    """
    store = open_store(path)
    total = hashlib.sha256()
    attributes = {k: v for k, v in store.attributes.items() if k not in VOLATILE_ATTRIBUTES}
    plain = {k: v for k, v in store.spec.plain().items() if k != "shard_samples"}
    total.update(json.dumps([attributes, plain, store.samples], sort_keys=True).encode())
    for name, row in sorted(store.spec.arrays.items()):
        total.update(json.dumps([name, row.dims, row.dtype]).encode())
        step = max(1, 2**26 // max(1, store.spec.layer_bytes(name))) if name in store.spec.pixel_layers else 4096
        for start in range(0, store.samples, step):
            values = store.read(name, start, min(start + step, store.samples))
            if row.is_text:
                for text in values.tolist():
                    total.update(json.dumps(text).encode())
            else:
                total.update(np.ascontiguousarray(values).data)
    return total.hexdigest()
