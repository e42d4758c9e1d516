"""Open a store as labelled arrays, for analysis and training."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

from .bucket import Url
from .group import open_store

if TYPE_CHECKING:
    import xarray


def open_dataset(path: str | os.PathLike[str] | Url) -> xarray.Dataset:
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
        return xarray.open_zarr(store.files.zarr(), chunks=None, zarr_format=3)
    except Exception as error:
        failure = store.files.failure(error, "")
        if failure is None:
            raise
        raise failure from error
