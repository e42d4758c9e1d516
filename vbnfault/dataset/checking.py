"""Check a stored dataset against the plan of its own scene."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from .. import store
from ..core.errors import in_file
from ..faults import loaded_plugin
from .identity import check_described, is_exact, planned


def missing_plugins(attributes: Mapping[str, Any]) -> list[str]:
    """Return a sentence for each plug-in of a store that is not installed, or not with the same source."""
    sentences = []
    for name, stored in attributes.get("scene", {}).get("plugins", {}).items():
        plugin = loaded_plugin(name)
        sha256 = str(stored.get("sha256", "unknown"))
        if plugin is None or plugin.sha256 != sha256:
            state = "not loaded" if plugin is None else "loaded in another version"
            sentences.append(
                f"the scene uses the plug-in {name} (sha256 {sha256[:12]}"
                + "".join(f", {model}" for model in stored.get("models", ()))
                + f"), which is {state} here; the check does not need it"
            )
    return sentences


def verify(path: str | Path | store.Store, progress: Callable[[int], None] | None = None) -> store.Report:
    """Return what is wrong with a store, how its faults are counted, and its digest.

    Parameters
    ----------
    path
        Path of the store, or the open store.
    progress
        Called with the number of samples that were checked since its last call.

    Returns
    -------
    store.Report
        `problems` is empty if every sample is whole, labelled and as planned.

    Raises
    ------
    InputError
        If there is no store at `path`, or one of another format.
    """
    opened = store.open_store(path)
    attributes = opened.spec.attributes
    check_described(opened)
    with in_file(str(opened.path)):
        expected = planned(attributes, opened.spec.faults)
    return store.examine(
        opened,
        expected=expected,
        exact=is_exact(attributes),
        progress=progress,
    )
