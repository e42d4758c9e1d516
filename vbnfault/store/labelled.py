"""Open a store as labelled arrays, for analysis and training."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

from . import disk
from .group import open_store

if TYPE_CHECKING:
    import xarray


def open_dataset(path: str | os.PathLike[str]) -> xarray.Dataset:
    """Return a store as an `xarray.Dataset` with named dimensions, units and coordinates.

    Arrays are read when they are used, a sample of a layer at a time. README and the reference list them.

    Raises
    ------
    InputError
        If there is no store at `path`, one of another format, or one that this user may not read.
    """
    import xarray

    store = open_store(path)
    try:
        return xarray.open_zarr(store.path, chunks=None)
    except PermissionError as error:
        raise disk.denied(error, store.path) from error
