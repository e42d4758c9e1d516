"""Say where a store is, and read and write its files there: on a disk, or in an object store."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from datetime import datetime
from pathlib import Path
from typing import Any, Protocol
from urllib.parse import unquote, urlsplit

from ..core.errors import InputError, VbnfaultError, shown
from ..core.path_checks import path_of
from .bucket import Bucket, Url, is_url, parsed
from .disk import Disk

Location = Path | Url


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


class Files(Protocol):
    """Read and write the files of one store; their names are relative to it and separated by `/`."""

    @property
    def path(self) -> Any:
        """Return where the store is."""
        ...

    def read(self, name: str, most_bytes: int) -> bytes:
        """Return the content of a file of at most so many bytes.

        Raises
        ------
        FileNotFoundError
            There is no such file.
        OSError
            The file is damaged: it cannot be read, is larger, or a link stands in its place or above it.
        InputError
            This user may not read it.
        VbnfaultError
            The object store cannot be reached.
        """
        ...

    def read_each(self, files: Sequence[tuple[str, int]]) -> Iterator[bytes | OSError]:
        """Yield the content of each file, given by its name and its most bytes, or the OSError of `read`."""
        ...

    def read_parts(
        self, name: str, tail: int, choose: Callable[[bytes], Sequence[tuple[int, int]]]
    ) -> list[tuple[int, bytes]]:
        """Return parts of one version of a file, each with its start; `choose` gets the last `tail` bytes."""
        ...

    def names(self, folder: str) -> list[str]:
        """Return the names in a folder; an empty list if there is no such folder."""
        ...

    def exists(self, name: str) -> bool:
        """Return whether something has this name."""
        ...

    def modified(self, folder: str) -> dict[str, datetime]:
        """Return by name when each file directly in a folder was written, by the clock of what stores it."""
        ...

    def stamp(self, name: str) -> object:
        """Return what changes if a file is replaced; None if there is no file."""
        ...

    def zarr(self) -> Any:
        """Return what zarr and xarray open in order to read the store."""
        ...

    def failure(self, error: Exception, name: str) -> VbnfaultError | None:
        """Return the error for a failure while zarr reads an array that is no damage; None for any other."""
        ...

    def write(self, files: Iterable[tuple[str, Any]]) -> None:
        """Replace files durably, as one batch; each is the old or the complete new one at any moment.

        The contents are bytes, or what `copied` returns. Raises OSError if a file cannot be written.
        """
        ...

    def remove(self, files: Iterable[str]) -> None:
        """Remove files durably; names that do not exist are left out."""
        ...

    def copied(self, name: str, most_bytes: int, *, link: bool) -> Any:
        """Return a file as `write` of another store takes it. `link`: where possible, no byte is copied."""
        ...

    def why_occupied(self, own: Iterable[str]) -> str:
        """Return why no store can be created here, as a clause, or an empty text; `own`: names of a new store."""
        ...

    def create(self, files: Iterable[tuple[str, bytes]], *, old: bool) -> None:
        """Make a store of these files, the root last, in place of an `old` store; it appears when it is whole.

        Raises OSError if that is impossible.
        """
        ...

    def remove_leftovers(self) -> None:
        """Remove what killed processes have left. No other process may write meanwhile."""
        ...

    def free_bytes(self) -> int | None:
        """Return the free space in bytes; None if it is not known or not limited."""
        ...
