"""Decide how a build continues an existing store: its blocks of samples, its scene and its versions."""

from __future__ import annotations

import json
import os
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

from .. import store as store_module
from ..core import tables
from ..core.errors import InputError, shown
from ..store import Planned, Store, StoreSpec, Url

# Root attribute: a list of tables, each with `versions` and the `samples` made with them, as ranges [first, last].
# All other samples were made with the versions in the root attribute `versions`.
VERSIONS_OF_SAMPLES = "versions_of_samples"


def planned_blocks(
    out: str | os.PathLike[str] | Url, samples: int, *, append: int = 0, overwrite: bool = False
) -> tuple[int, ...]:
    """Return the sizes of the planned blocks: those of an existing store, and one of size `append` if it is not 0.

    If the last block was appended, has the size `append` and is unfinished, it is resumed and none is added. So an
    interrupted command can be repeated unchanged. Raises InputError if there is no store to append to, if `append`
    is negative, or if the first block of the store does not have `samples` samples.
    """
    if (number := tables.whole(append)) is None or number < 0:
        raise InputError(f"--append {shown(append)}: must be at least 1, and a whole number")
    append = number
    if append and overwrite:
        raise InputError(f"--append {append} and --overwrite exclude each other: give one of them")
    exists = store_module.is_store(out) and not overwrite
    if not exists:
        if append:
            raise InputError(f"--append {append}: there is no store at {out} yet; build it first")
        return (samples,)
    store = store_module.open_store(out)
    blocks = blocks_of(store)
    if blocks[0] != samples:
        raise InputError(
            f"{out}: samples = {samples}, but the store was made with {blocks[0]}; use --append to add some, "
            f"--overwrite to start anew, or another --out"
        )
    resumes = len(blocks) > 1 and blocks[-1] == append and store.finished() < store.samples
    return (*blocks, append) if append and not resumes else blocks


def blocks_of(store: Store) -> tuple[int, ...]:
    """Return the sizes of the blocks of a store; a store that does not name them has one."""
    return tuple(store.attributes.get("blocks", [store.samples]))


def with_versions_noted(store: Store, spec: StoreSpec, expected: Planned | None, *, exact: bool) -> Store:
    """Record in a store which samples this build will make with other versions; return the store opened again.

    This happens before any of them is made, so that the record is right after an interruption, too.
    """
    now = spec.attributes.get("versions", {})
    if known_versions(store.attributes) == [now]:
        return store
    wanted = set(store_module.problem_samples(store))
    if expected is not None:
        shards = range(store.shards)
        wanted |= {i for n in shards for i in store_module.unplanned_samples(store, n, expected, exact=exact)}
    made = versions_made_now(store.attributes, now, wanted)
    if made == store.attributes.get(VERSIONS_OF_SAMPLES, []):
        return store
    store.update_attributes({VERSIONS_OF_SAMPLES: made})
    return store_module.open_store(store.path, "r+")


def check_same_scene(
    store: Store, spec: StoreSpec, blocks: tuple[int, ...], *, accept_versions: bool = False
) -> None:
    """Raise InputError with the differences if a store does not belong to the scene that is to be built into it.

    `accept_versions`: other versions of the libraries are no difference.
    """
    differing = list(differences(_compared(store.spec), _compared(spec)))
    if differing and all(d.key.startswith("versions.") for d in differing):
        if not accept_versions and spec.attributes.get("versions") not in known_versions(store.attributes):
            changed = version_differences(store.attributes, spec.attributes)
            raise InputError(
                f"{store.path}: was made with other versions: {changed}; "
                "--accept-versions completes it with those of now and notes which samples they made, or choose "
                "another --out"
            )
        differing = []
    if differing:
        raise InputError(
            f"{store.path}: holds another dataset: {_named(differing, 'in the store', 'now')}; "
            "choose another --out, or delete it (`vbnfault build --overwrite` does)"
        )
    blocks_of_store = blocks_of(store)
    if blocks[: len(blocks_of_store)] != blocks_of_store:
        raise InputError(
            f"{store.path}: holds blocks of {_sum_text(blocks_of_store)} samples, not {_sum_text(blocks)}; "
            "choose another --out, or delete it (`vbnfault build --overwrite` does)"
        )


def check_same_dataset(store: Store, reference: Store) -> None:
    """Raise InputError with the differences if two stores do not hold samples of one dataset.

    Scene, seed, blocks and number of samples, versions and size of the shards must be equal.
    """
    stored, wanted = (
        {
            **_compared(s.spec),
            "blocks": s.attributes.get("blocks", [s.samples]),
            "samples": s.samples,  # of the arrays, which damage may have made others than the blocks say
            "shard_samples": s.spec.shard_samples,
        }
        for s in (store, reference)
    )
    differing = list(differences(stored, wanted))
    if differing:
        raise InputError(
            f"{store.path}: holds another dataset than {reference.path}: {_named(differing, 'here', 'there')}"
        )


def _named(differing: list[Difference], *holders: str) -> str:
    """Return the first differences in words; `holders` say where the two values of each are."""
    # keys of the scene first: they tell a user more than the hashes that follow from them
    differing.sort(key=lambda d: (not d.key.startswith("scene."), "hash" in d.key, d.key))
    more = f", and {len(differing) - 4} more" if len(differing) > 4 else ""
    return "; ".join(d.text(*holders) for d in differing[:4]) + more


_NOT_COMPARED = {
    "blocks",
    VERSIONS_OF_SAMPLES,
    "shard_samples",
    "format",
    "format_version",
    *store_module.VOLATILE_ATTRIBUTES,
}
# Free texts, which no pixel depends on, and the tables that have them: the attributes themselves, their scene with
# its table `dataset`, and, in a store that was taken again, what is known of the other store.
_TEXTS = {"title", "description", "licence", "citation", "scene_hash"}
_HOLDERS_OF_TEXTS = ("scene", "dataset", "retake", "source")


_ABSENT = object()
_LONGEST_VALUE = 60


class Difference(NamedTuple):
    """Hold one value that differs between a store and a scene, with its dotted key."""

    key: str
    stored: Any
    wanted: Any

    def text(self, holds_stored: str, holds_wanted: str) -> str:
        """Return the difference in words; long values begin shortly before the part that differs."""
        texts = ["absent" if value is _ABSENT else repr(value) for value in (self.stored, self.wanted)]
        equal = next((k for k, pair in enumerate(zip(*texts, strict=False)) if pair[0] != pair[1]), 0)
        start = max(0, equal - _LONGEST_VALUE // 3)
        stored, wanted = (_part(text, start) for text in texts)
        return f"{self.key} is {stored} {holds_stored} and {wanted} {holds_wanted}"


def _part(text: str, start: int) -> str:
    """Return a text of at most `_LONGEST_VALUE` characters whole, and of a longer one a part from `start`."""
    if len(text) <= _LONGEST_VALUE:
        return text
    start = min(start, len(text) - _LONGEST_VALUE + 6)
    before, rest = ("..." if start else ""), text[start:]
    size = _LONGEST_VALUE - 6
    return f"{before}{rest[:size]}{'...' if len(rest) > size else ''}"


def _compared(spec: StoreSpec) -> dict[str, Any]:
    """Return what a store and a scene must have in common, as plain data."""
    everything = _with_new_names(json.loads(json.dumps({**spec.attributes, **spec.data})))
    return _without_texts({key: value for key, value in everything.items() if key not in _NOT_COMPARED})


def _with_new_names(plain: Any) -> Any:
    """Return plain data in which all keys have their current names."""
    if isinstance(plain, dict):
        return {tables.new_name(key): _with_new_names(value) for key, value in plain.items()}
    return [_with_new_names(value) for value in plain] if isinstance(plain, list) else plain


def _without_texts(attributes: dict[str, Any]) -> dict[str, Any]:
    """Return attributes, or a table of them, without free texts and without the hash of the scene that has them."""
    kept = {key: value for key, value in attributes.items() if key not in _TEXTS}
    for key in _HOLDERS_OF_TEXTS:
        if isinstance(kept.get(key), dict):
            kept[key] = _without_texts(kept[key])
    return kept


def differences(stored: Any, wanted: Any, key: str = "") -> Iterator[Difference]:
    """Yield the values that differ, each by its deepest key: `table.key`, and `key[2]` within a list."""
    if isinstance(stored, dict) and isinstance(wanted, dict):
        for name in {**wanted, **stored}:
            below = f"{key}.{name}" if key else str(name)
            yield from differences(stored.get(name, _ABSENT), wanted.get(name, _ABSENT), below)
    elif wanted is _ABSENT and isinstance(stored, dict) and stored:
        yield from differences(stored, {}, key)
    elif stored is _ABSENT and isinstance(wanted, dict) and wanted:
        yield from differences({}, wanted, key)
    elif _same_length(stored, wanted) and (_has_parts(stored) or _has_parts(wanted)):
        for k, pair in enumerate(zip(stored, wanted, strict=True)):
            yield from differences(*pair, f"{key}[{k}]")
    elif stored is _ABSENT or wanted is _ABSENT or stored != wanted:
        yield Difference(key, stored, wanted)


def _same_length(stored: Any, wanted: Any) -> bool:
    """Return whether two values are lists of one length."""
    return isinstance(stored, list) and isinstance(wanted, list) and len(stored) == len(wanted)


def _has_parts(values: list[Any]) -> bool:
    """Return whether a list is better compared item by item: it has tables or lists, or is long."""
    return len(repr(values)) > _LONGEST_VALUE or any(isinstance(value, dict | list) for value in values)


def _sum_text(values: Sequence[int]) -> str:
    """Return block sizes as text: `8 + 4`."""
    return " + ".join(str(v) for v in values)


# --- which versions of the libraries made which samples ---------------------------------------------------------


def known_versions(attributes: Mapping[str, Any]) -> list[dict[str, str]]:
    """Return all sets of versions that made samples of a store, or were accepted for that."""
    return [attributes.get("versions", {}), *(entry["versions"] for entry in _entries(attributes))]


def version_differences(stored: Mapping[str, Any], now: Mapping[str, Any]) -> str:
    """Return as text which versions differ between two sets of root attributes."""
    old, new = stored.get("versions", {}), now.get("versions", {})
    names = [name for name in {**new, **old} if old.get(name) != new.get(name)]
    return ", ".join(f"{name} {old.get(name, 'absent')} (now {new.get(name, 'absent')})" for name in names)


def versions_made_now(
    attributes: Mapping[str, Any], now: Mapping[str, str], samples: Collection[int]
) -> list[dict[str, Any]]:
    """Return the new attribute `versions_of_samples` of a store.

    Parameters
    ----------
    attributes
        Root attributes of the store.
    now
        Versions with which `samples` are about to be made.
    """
    entry = {"versions": dict(now), "samples": store_module.runs(samples)}
    made = {} if now == attributes.get("versions", {}) else {VERSIONS_OF_SAMPLES: [entry]}
    return joined_versions(attributes, [(made, samples)])


def joined_versions(
    attributes: Mapping[str, Any], taken: Iterable[tuple[Mapping[str, Any], Collection[int]]]
) -> list[dict[str, Any]]:
    """Return the new attribute `versions_of_samples` of a store that takes samples of other stores.

    Parameters
    ----------
    attributes
        Root attributes of the store. Its `versions` are those of the others.
    taken
        For each of the others, its root attributes and the samples that are taken.
    """
    everything = list(taken)
    new = {i for _, samples in everything for i in samples}
    made = [(entry["versions"], _samples(entry) - new) for entry in _entries(attributes)]
    for others, samples in everything:
        for entry in _entries(others):
            of_entry = next((known for versions, known in made if versions == entry["versions"]), None)
            if of_entry is None:
                made.append((entry["versions"], of_entry := set()))
            of_entry.update(_samples(entry) & set(samples))
    return [{"versions": versions, "samples": store_module.runs(samples)} for versions, samples in made if samples]


def _entries(attributes: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return the tables of `versions_of_samples`; none if the attribute is missing."""
    return list(attributes.get(VERSIONS_OF_SAMPLES, ()))


def _samples(entry: Mapping[str, Any]) -> set[int]:
    """Return the samples in the ranges of a table."""
    return {i for first, last in entry["samples"] for i in range(first, last + 1)}
