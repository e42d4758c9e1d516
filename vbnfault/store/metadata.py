"""Compare a store's metadata and coordinates with the schema, repair them, and append samples to the store."""

from __future__ import annotations

import contextlib
import json
import os
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.errors import InputError
from . import disk
from .arrays import Member
from .bucket import Files, Url
from .compressors import most_compressed
from .group import open_store, read_document, read_root
from .layout import (
    DOCUMENT,
    SPARE,
    array_documents,
    canonical,
    coordinate_chunks,
    decode_values,
    encode_values,
    group_document,
    plain_values,
    sealed,
    to_bytes,
)
from .opened import Store
from .schema import spec_from_plain


def metadata_problems(store: Store) -> tuple[list[str], bool]:
    """Compare the root, the metadata of every array and the coordinates with the schema.

    Returns
    -------
    problems : list of str
        One sentence for each difference.
    hopeless : bool
        Whether no sample can be read before the store is repaired.
    """
    root = read_root(store.files)
    problems = list(root.problems) if root is not None else [f"{DOCUMENT} and {SPARE}/{DOCUMENT} are damaged"]
    hopeless = False
    members = store.spec.members(store.samples)
    documents = array_documents(members)
    sound = {}
    for name, member in members.items():
        is_coordinate = member.values is not None
        stored = read_document(store.files, f"{name}/{DOCUMENT}")
        if stored is None:
            file = f"{name}/{DOCUMENT}"
            why = f"cannot be opened, {file} is damaged" if store.files.exists(file) else "is missing"
            problems.append(f"array {name} {why}")
            hopeless |= not is_coordinate
            continue
        differences = list(_differences(stored, documents[name]))
        if not is_coordinate and _samples_of(stored) not in (None, store.samples):
            problems.append(
                f"{name} holds {_samples_of(stored)} samples, not {store.samples}: appending was interrupted, "
                f"the build command resumes it"
            )
        else:
            problems += [f"array {name}: {clause}" for clause in differences]
        # a wrong attribute does not change how the data files are read
        hopeless |= not is_coordinate and any(not clause.startswith("its attribute") for clause in differences)
        if not differences:
            sound[name] = documents[name]
            problems += [f"array {name}: {clause}" for clause in _misvalued(store.files, name, member)]
    return problems + list(_root_differences(store, sound, documents)), hopeless


def _samples_of(document: Mapping[str, Any]) -> int | None:
    """Return the number of samples in an array's document; None if the document has no valid shape."""
    shape = document.get("shape")
    return shape[0] if isinstance(shape, list) and shape and type(shape[0]) is int else None


def _differences(stored: Mapping[str, Any], wanted: Mapping[str, Any]) -> Iterator[str]:
    """Yield a clause for each key and each attribute of an array's document that is wrong."""
    for key in {**wanted, **stored}:
        a, b = stored.get(key, _ABSENT), wanted.get(key, _ABSENT)
        if isinstance(a, dict) and isinstance(b, dict) and key == "attributes":
            for name in {**b, **a}:
                if _differ(a.get(name, _ABSENT), b.get(name, _ABSENT)):
                    yield f"its attribute {short(name)} = {short(a.get(name))}, not {short(b.get(name))}"
        elif _differ(a, b):
            yield f"its {short(key)} = {short(a)}, not {short(b)}"


_ABSENT = "absent"


def _differ(a: Any, b: Any) -> bool:
    """Return whether two JSON values differ; 1, 1.0 and true are different."""
    return canonical(a) != canonical(b)


def _misvalued(files: Files, name: str, member: Member) -> Iterator[str]:
    """Yield a clause for each chunk of a coordinate that cannot be decoded or holds wrong values."""
    for chunk, wanted, stored in _wrong_chunks(files, name, member):
        if stored is None or stored.shape != wanted.shape:
            yield f"its values in {chunk} are missing or cannot be decoded"
        else:
            first = next(i for i, (a, b) in enumerate(zip(stored, wanted, strict=True)) if a != b)
            number = int(chunk.removeprefix(f"{name}/c/")) * member.chunks[0] + first
            yield f"its value {number} is {short(stored[first])}, not {short(wanted[first])}"


def _wrong_chunks(
    files: Files, name: str, member: Member
) -> Iterator[tuple[str, NDArray[Any], NDArray[Any] | None]]:
    """Yield the file, the right values and the stored values of each chunk of a coordinate where these differ.

    The stored values are None if the file is missing, cannot be decoded, or is far larger.
    """
    for chunk, wanted in coordinate_chunks(member):
        most_bytes = 2 * len(memoryview(plain_values(wanted)).cast("B")) + 1024
        file, stored = f"{name}/{chunk}", None
        with contextlib.suppress(OSError, ValueError):
            stored = decode_values(files.read(file, most_compressed(most_bytes)), member.dtype, most_bytes)
        if stored is None or not np.array_equal(stored, wanted):
            yield file, wanted, stored


def _root_differences(
    store: Store, sound: Mapping[str, Any], documents: Mapping[str, Mapping[str, Any]]
) -> Iterator[str]:
    """Yield a sentence for each error in the root's document, attributes excepted.

    The consolidated metadata matter because readers look there first. They must list no unknown array. They are
    compared for `sound` arrays only: any other array is reported already.
    """
    root = read_document(store.files, DOCUMENT)
    if root is None:
        return
    wanted = group_document(root.get("attributes") or {}, documents)
    consolidated = root.get("consolidated_metadata")
    entries = consolidated.get("metadata") if isinstance(consolidated, dict) else None
    if not isinstance(entries, dict):
        yield f"{DOCUMENT} holds no consolidated metadata"
        return
    for name in (*sound, *sorted(entries.keys() - documents.keys())):
        if name not in documents or name not in entries or _differ(entries[name], documents[name]):
            name = short(name)
            yield f"array {name}: the consolidated metadata in {DOCUMENT} differ from {name}/{DOCUMENT}"
    for document in (root, wanted):
        del document["consolidated_metadata"]["metadata"]
    for key in {**wanted, **root}:
        if _differ(root.get(key, _ABSENT), wanted.get(key, _ABSENT)):
            yield f"{DOCUMENT}: its {short(key)} = {short(root.get(key))}, not {short(wanted.get(key))}"


def short(value: Any) -> str:
    """Return a value as text of at most 80 characters, for use in a sentence."""
    text = str(value.tolist() if isinstance(value, np.ndarray | np.generic) else value)
    return text if len(text) <= 80 else text[:77] + "..."


def append_samples(
    store: str | os.PathLike[str] | Url | Store, count: int, attributes: Mapping[str, Any] | None = None
) -> Store:
    """Extend a store by `count` unfinished samples, set further root attributes, and open the store again.

    Earlier samples stay bit-identical. The arrays are extended first, then `spare`, then the root. After a kill,
    `recover` completes the change if `spare` was written, and otherwise restores the store as it was.
    """
    store = open_store(store, "r+")
    if count < 1:
        raise InputError(f"append = {count}: must be at least 1")
    values = json.loads(json.dumps(attributes or {}))
    with disk.explained(store.path, f"adding {count} samples"):
        bring_to(store, {**store.root_attributes, **values, "samples": store.samples + count})
    return open_store(store.path, "r+")


def recover(path: str | os.PathLike[str] | Url) -> Store:
    """Repair a store's metadata and open it for writing. No other process may write to it meanwhile.

    This removes the `*.partial` files of killed processes. It rewrites root, `spare`, the metadata of arrays and
    the coordinates if they differ from what the root attributes require. A missing array gets its metadata again,
    but no data.
    """
    store = open_store(path, "r+")
    with disk.explained(store.path, "recovering the store"):
        store.files.remove_leftovers()
        bring_to(store, store.root_attributes)
    return open_store(store.path, "r+")


def bring_to(store: Store, attributes: Mapping[str, Any]) -> None:
    """Rewrite the metadata and coordinates that differ from `attributes`: arrays, then `spare`, then the root."""
    attributes = sealed(attributes)
    members = spec_from_plain(attributes["store"], attributes).members(int(attributes["samples"]))
    documents = array_documents(members)
    store.files.write(_outdated_arrays(store.files, members, documents))
    for name, document in (
        (f"{SPARE}/{DOCUMENT}", group_document(attributes)),
        (DOCUMENT, group_document(attributes, documents)),
    ):
        store.files.write(_outdated(store.files, {name: document}))


def _outdated_arrays(
    files: Files, members: Mapping[str, Member], documents: Mapping[str, Mapping[str, Any]]
) -> Iterator[tuple[str, bytes]]:
    """Yield the name and right content of each array document and coordinate chunk that is wrong."""
    for name, member in members.items():
        for file, wanted, _ in _wrong_chunks(files, name, member):
            yield file, encode_values(wanted)
        yield from _outdated(files, {f"{name}/{DOCUMENT}": documents[name]})


def _outdated(files: Files, documents: Mapping[str, Mapping[str, Any]]) -> Iterator[tuple[str, bytes]]:
    """Yield the name and right content of each document that is missing or wrong."""
    for name, wanted in documents.items():
        stored = read_document(files, name)
        if stored is None or _differ(stored, wanted):
            yield name, to_bytes(wanted)
