"""Check a stored dataset against the plan of its own scene."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from .. import store
from .identity import is_exact, planned


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
