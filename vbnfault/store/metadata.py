"""The metadata of a group, and the values of its coordinates: compared with the schema, mended, grown."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import zarr

from ..errors import InputError, VbnfaultError
from .group import Store, consolidate, consolidated_metadata, disk, open_store
from .schema import Member


def metadata_problems(store: Store) -> tuple[list[str], bool]:
    """What of the arrays' layout, attributes and coordinates is not as the spec says, one sentence each; and
    whether samples cannot be looked at before that is mended."""
    problems: list[str] = []
    sound: list[str] = []
    hopeless = False
    for name, member in store.spec.members(store.samples).items():
        try:
            array = store.array(name)
        except VbnfaultError:
            problems.append(store.why_closed(name))
            hopeless |= member.values is None
            continue
        misshapen = list(_misshapen(array, member))
        if member.values is None and not misshapen and array.shape != member.shape:
            problems.append(
                f"{name} holds {array.shape[0]} samples, not {store.samples}: appending was interrupted, "
                f"the build command resumes it"
            )
            hopeless = True
        hopeless |= member.values is None and bool(misshapen)
        found = misshapen + [*_misnamed(array, member)] + ([] if misshapen else [*_misvalued(array, member)])
        problems += [f"array {name}: {what}" for what in found]
        if not found:
            sound.append(name)
    return problems + list(_misconsolidated(store, sound)), hopeless


def _misshapen(array: zarr.Array[Any], member: Member) -> Iterator[str]:
    """What of an array's layout is not as it must be, the number of samples left out."""
    is_text = array.dtype.kind in "OTU"
    layout: dict[str, tuple[Any, Any]] = {
        "dims": (tuple(getattr(array.metadata, "dimension_names", None) or ()), member.dims),
        "dtype": ("str" if is_text else array.dtype.name, member.dtype),
    }
    if member.values is None:
        layout["shape of a sample"] = array.shape[1:], member.shape[1:]
        layout["chunks"] = array.chunks, member.chunks
        layout["shards"] = array.shards, member.shards
    for what, (stored, wanted) in layout.items():
        if stored != wanted:
            yield f"its {what} = {short(stored)}, not {short(wanted)}"


def _misnamed(array: zarr.Array[Any], member: Member) -> Iterator[str]:
    """Which attributes that carry meaning are not as they must be."""
    for key, wanted in member.attributes.items():
        stored = array.attrs.get(key)
        if key != "long_name" and stored != wanted:
            yield f"its attribute {key} = {short(stored)}, not {short(wanted)}"


def _misvalued(array: zarr.Array[Any], member: Member) -> Iterator[str]:
    """What of a coordinate's values is not as it must be."""
    if member.values is None:
        return
    try:
        stored = np.asarray(array[:])
    except Exception:  # zarr raises many kinds for chunks that it cannot decode
        yield "its values cannot be decoded"
        return
    if stored.shape != member.shape:
        yield f"it has the shape {list(stored.shape)}, not {list(member.shape)}"
    elif not np.array_equal(stored, np.asarray(member.values, dtype=stored.dtype)):
        first = next(i for i, (a, b) in enumerate(zip(stored, member.values, strict=True)) if a != b)
        yield f"its value {first} is {short(stored[first])}, not {short(member.values[first])}"


def _misconsolidated(store: Store, names: list[str]) -> Iterator[str]:
    """What the consolidated metadata say of the arrays `names`, or of arrays outside the schema, that the arrays
    themselves do not say: readers look into the consolidated ones first."""
    consolidated = consolidated_metadata(store.path)
    if consolidated is None:
        yield "zarr.json holds no consolidated metadata"
        return
    foreign = consolidated.keys() - store.spec.members(store.samples).keys()
    for name in (*names, *sorted(foreign)):
        try:
            own = json.loads((store.path / name / "zarr.json").read_text())
        except (OSError, ValueError):
            own = None
        if own is None or consolidated.get(name) != own:
            yield f"array {name}: the consolidated metadata in zarr.json differ from {name}/zarr.json"


def short(value: Any) -> str:
    """A value in a sentence: at most 80 characters."""
    text = str(value.tolist() if isinstance(value, np.ndarray | np.generic) else value)
    return text if len(text) <= 80 else text[:77] + "..."


def append_samples(
    store: str | os.PathLike[str] | Store, count: int, attributes: Mapping[str, Any] | None = None
) -> Store:
    """Grow a store by `count` unfinished samples, with further root attributes, and open it again.

    Earlier samples keep their bits. A kill half-way is mended by `recover`.
    """
    store = open_store(store, "r+")
    if count < 1:
        raise InputError(f"append = {count}: must be at least 1")
    with disk(store.path, f"adding {count} samples"):
        store.update_attributes({**(attributes or {}), "samples": store.samples + count})
    return recover(store.path)


def recover(path: str | os.PathLike[str]) -> Store:
    """Open a store for writing after whatever happened to it; only while nothing else writes to it.

    Removes the `*.partial` files of a killed process and brings every array to the length that the root says,
    its layout and attributes and all coordinates to what the root's spec says. Arrays that are missing are made
    again, unwritten.
    """
    store = open_store(path, "r+")
    with disk(store.path, "recovering the store"):
        for folder, _, files in os.walk(store.path):
            for name in files:
                if name.endswith(".partial"):
                    Path(folder, name).unlink(missing_ok=True)
        for name, member in store.spec.members(store.samples).items():
            _mend(store, name, member)
        consolidate(store.path)
    return open_store(store.path, "r+")


def _mend(store: Store, name: str, member: Member) -> None:
    """Bring the metadata of an array, and the values of a coordinate, to what they must be."""
    folder = store.path / name
    try:
        array: zarr.Array[Any] | None = store.array(name)
    except VbnfaultError:
        array = None
    if array is not None:
        sound = not any(_misshapen(array, member)) and not any(_misvalued(array, member))
        if sound and any(_misnamed(array, member)):
            array.update_attributes(member.attributes)
        if sound and array.shape != member.shape:
            array.resize(member.shape)
        if sound:
            return
    if not folder.is_dir():
        folder.unlink(missing_ok=True)
    elif member.values is not None:
        shutil.rmtree(folder)
    else:
        (folder / "zarr.json").unlink(missing_ok=True)
    store.make_array(name, member)
