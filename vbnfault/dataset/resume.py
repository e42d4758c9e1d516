"""Decide how a build continues an existing store: its blocks of samples, its scene and its versions."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from .. import store as store_module
from ..core.errors import InputError
from ..store import Planned, Store, StoreSpec
from . import versions


def planned_blocks(
    out: str | os.PathLike[str], samples: int, *, append: int = 0, overwrite: bool = False
) -> tuple[int, ...]:
    """Return the sizes of the planned blocks: those of an existing store, and one of size `append` if it is not 0.

    If the last block was appended, has the size `append` and is unfinished, it is resumed and none is added. So an
    interrupted command can be repeated unchanged. Raises InputError if there is no store to append to, if `append`
    is negative, or if the first block of the store does not have `samples` samples.
    """
    if append < 0:
        raise InputError(f"--append {append}: must be at least 1")
    if append and overwrite:
        raise InputError(f"--append {append} and --overwrite exclude each other: give one of them")
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
    resumes = len(blocks) > 1 and blocks[-1] == append and store.finished() < store.samples
    return (*blocks, append) if append and not resumes else blocks


def with_versions_noted(store: Store, spec: StoreSpec, expected: Planned | None, *, exact: bool) -> Store:
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


def check_same_scene(
    store: Store, spec: StoreSpec, blocks: tuple[int, ...], *, accept_versions: bool = False
) -> None:
    """Raise InputError with the differences if a store does not belong to the scene that is to be built into it.

    `accept_versions`: other versions of the libraries are no difference.
    """
    stored, wanted = _flat(store.spec), _flat(spec)
    absent = object()
    differing = [key for key in {**wanted, **stored} if stored.get(key, absent) != wanted.get(key, absent)]
    if differing and all(key.startswith("versions.") or key == "scene_hash" for key in differing):
        if not accept_versions and spec.attributes.get("versions") not in versions.known(store.attributes):
            changed = versions.differences(store.attributes, spec.attributes)
            raise InputError(
                f"{store.path}: was made with other versions: {changed}; "
                "--accept-versions completes it with those of now and notes which samples they made, or choose "
                "another --out"
            )
        differing = []
    if differing:
        # keys of the scene first: they tell a user more than the hashes that follow from them
        differing.sort(key=lambda key: (not key.startswith("scene."), "hash" in key, key))
        first = [
            f"{key} is {_shown(stored, key)} in the store and {_shown(wanted, key)} now" for key in differing[:4]
        ]
        more = f", and {len(differing) - 4} more" if len(differing) > 4 else ""
        raise InputError(
            f"{store.path}: holds another dataset: {'; '.join(first)}{more}; "
            f"choose another --out, or --overwrite to replace it"
        )
    blocks_of_store = tuple(store.attributes.get("blocks", [store.samples]))
    if blocks[: len(blocks_of_store)] != blocks_of_store:
        raise InputError(
            f"{store.path}: holds blocks of {_sum_text(blocks_of_store)} samples, not {_sum_text(blocks)}; "
            f"choose another --out, or --overwrite to replace it"
        )


_NOT_COMPARED = {
    "blocks",
    versions.VERSIONS_OF_SAMPLES,
    "shard_samples",
    "format",
    "format_version",
    *store_module.VOLATILE_ATTRIBUTES,
}


def _flat(spec: StoreSpec) -> dict[str, Any]:
    """Return what a store and a scene must have in common: each value of a spec by its dotted key."""
    everything = json.loads(json.dumps({**spec.attributes, **spec.plain()}))
    return dict(_flatten({key: value for key, value in everything.items() if key not in _NOT_COMPARED}))


def _shown(values: Mapping[str, Any], key: str) -> str:
    """Return a value as text of at most 60 characters, or `absent`."""
    text = repr(values[key]) if key in values else "absent"
    return text if len(text) <= 60 else text[:57] + "..."


def _flatten(value: Any, key: str = "") -> Iterator[tuple[str, Any]]:
    """Yield each value of nested tables with its dotted key."""
    if isinstance(value, dict) and value:
        for name, inner in value.items():
            yield from _flatten(inner, f"{key}.{name}" if key else str(name))
    else:
        yield key, value


def _sum_text(values: Sequence[int]) -> str:
    """Return block sizes as text: `8 + 4`."""
    return " + ".join(str(v) for v in values)
