"""Record which versions of the libraries made which samples of a store."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from typing import Any

from ..store import runs

# Root attribute: a list of tables, each with `versions` and the `samples` made with them, as ranges [first, last].
# All other samples were made with the versions in the root attribute `versions`.
VERSIONS_OF_SAMPLES = "versions_of_samples"


def known(attributes: Mapping[str, Any]) -> list[dict[str, str]]:
    """Return all sets of versions that made samples of a store, or were accepted for that."""
    return [attributes.get("versions", {}), *(entry["versions"] for entry in _entries(attributes))]


def differences(stored: Mapping[str, Any], now: Mapping[str, Any]) -> str:
    """Return as text which versions differ between two sets of root attributes."""
    old, new = stored.get("versions", {}), now.get("versions", {})
    names = [name for name in {**new, **old} if old.get(name) != new.get(name)]
    return ", ".join(f"{name} {old.get(name, 'absent')} (now {new.get(name, 'absent')})" for name in names)


def made_now(
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
    entries = [(entry["versions"], _samples(entry) - set(samples)) for entry in _entries(attributes)]
    if now != attributes.get("versions", {}):
        made = next((made for versions, made in entries if versions == now), None)
        if made is None:
            entries.append((dict(now), made := set()))
        made.update(samples)
    return [{"versions": versions, "samples": runs(made)} for versions, made in entries if made]


def joined(
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
    return [{"versions": versions, "samples": runs(samples)} for versions, samples in made if samples]


def _entries(attributes: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return the tables of `versions_of_samples`; none if the attribute is missing."""
    return list(attributes.get(VERSIONS_OF_SAMPLES, ()))


def _samples(entry: Mapping[str, Any]) -> set[int]:
    """Return the samples in the ranges of a table."""
    return {i for first, last in entry["samples"] for i in range(first, last + 1)}
