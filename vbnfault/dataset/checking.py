"""Check a stored dataset against the plan of its own scene."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from .. import store
from ..faults import loaded_plugin
from .identity import is_exact, planned


def missing_plugins(attributes: Mapping[str, Any]) -> list[str]:
    """Return a sentence for each plug-in of a store that is not installed, or not with the same source."""
    sentences = []
    for name, stored in attributes["scene"].get("plugins", {}).items():
        plugin = loaded_plugin(name)
        if plugin is None or plugin.sha256 != stored["sha256"]:
            state = "not loaded" if plugin is None else "loaded in another version"
            sentences.append(
                f"the scene uses the plug-in {name} (sha256 {stored['sha256'][:12]}"
                + "".join(f", {model}" for model in stored["models"])
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
    return store.examine(
        opened,
        expected=planned(attributes, opened.spec.faults),
        exact=is_exact(attributes),
        progress=progress,
    )
