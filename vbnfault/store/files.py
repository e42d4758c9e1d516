"""Say where a store is, and read and write its files there: on a disk, or in an object store."""

from __future__ import annotations

import os
from pathlib import Path
from urllib.parse import unquote, urlsplit

from ..core.errors import InputError, shown
from ..core.path_checks import path_of
from .bucket import Bucket, Url, is_url, parsed
from .disk import Disk

Location = Path | Url
Files = Disk | Bucket  # both have the methods that `Disk` describes


def located(store: str | os.PathLike[str] | Url) -> Location:
    """Return where a store is: the path of a folder, also for a URL `file://`, or the URL of an object store.

    Raises InputError for another URL, and for what is no path.
    """
    if isinstance(store, Url):
        return store
    if not is_url(store):
        return path_of(store, "store")
    text = str(store)
    if not text.lower().startswith("file:"):
        return parsed(text)
    parts = urlsplit(text)
    if parts.netloc not in ("", "localhost") or not parts.path.startswith("/") or parts.query or parts.fragment:
        raise InputError(f"{shown(text)}: must be file:// and an absolute path, such as file:///data/NAME.zarr")
    return Path(unquote(parts.path))


def files_of(location: Location) -> Files:
    """Return what reads and writes the files at a location; nothing is opened yet."""
    return Bucket(location) if isinstance(location, Url) else Disk(location)
