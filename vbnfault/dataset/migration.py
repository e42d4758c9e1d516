"""Bring a store to the current format under its lock, and write its card again."""

from __future__ import annotations

import os
from collections.abc import Callable

from .. import store as stores
from ..store import Store
from .card import write_card
from .lock import locked


def migrate_store(
    path: str | os.PathLike[str],
    out: str | os.PathLike[str] | None = None,
    *,
    progress: Callable[[int], None] | None = None,
) -> Store:
    """Bring a store to the current format, in place or as a copy at `out`, and open it.

    The values and the digest stay the same. A copy has the codecs of new stores, which take fewer bytes. After an
    interruption or a kill the same call continues.

    Parameters
    ----------
    path
        The store.
    out
        Path of the copy; without it the store itself is changed.
    progress
        Called with the numbers of samples that were just copied.

    Raises
    ------
    InputError
        If there is no store of a known format at `path`, or if `out` is in use.
    VbnfaultError
        If the store is damaged, the files cannot be written, or another command writes to one of the stores.
    """
    source = stores.open_store(path)
    with locked(source.path):
        if out is None:
            store = stores.migrate(source.path)
            write_card(store)
            return store
        with locked(stores.check_target(source, out)):
            store = stores.migrate_copy(stores.open_store(path), out, progress=progress)
            write_card(store)
            return store
