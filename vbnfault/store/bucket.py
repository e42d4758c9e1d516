"""Say where a store is, and read and write one in an object store, such as S3; only this module imports obstore.

An object is replaced as a whole or not at all, and once a write has returned it is durable. So there are no
temporary files, nothing to flush and nothing to rename. Two habits of the disk need another form:

- A new store appears when its root is written, which is the last of its files. What a killed creation has left is
  recognised by the names of its objects. An object `.vbnfault/replaced` stands for a store that is to be replaced,
  from before its first object is deleted until the new one is whole.
- Requests fail now and then. They are repeated for some time; then the command ends with a sentence. A failure is
  no damage: it never leads to a repair.
"""

from __future__ import annotations

import contextlib
import errno
import os
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from dataclasses import dataclass
from datetime import datetime, timedelta
from functools import cached_property, partial
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit

from ..core.errors import InputError, VbnfaultError, shown
from ..core.files.path_checks import path_of
from .disk import Disk, Misplaced

SCHEMES = ("s3", "s3a", "gs", "az", "azure", "adl", "abfs", "abfss")
OWN = ".vbnfault"  # what is below this name is no part of the data
_REPLACED = f"{OWN}/replaced"
_READS_AT_ONCE = 16
_WRITES_AT_ONCE = 4  # each holds one file of a shard in memory
# Without credentials, obstore asks the cloud's own machines for some, which others do not reach.
_METADATA_HOSTS = ("169.254.169.254", "169.254.170.2", "metadata.google.internal")
_PART_BYTES = 16 << 20  # larger objects are sent in parts, so that a part needs no longer than a request may take
# A request is repeated after 0.2 s, 0.4 s, ... for about a minute in all.
RETRIES: Any = {
    "max_retries": 9,
    "retry_timeout": timedelta(seconds=90),
    "backoff": {"init_backoff": timedelta(seconds=0.2), "max_backoff": timedelta(seconds=15), "base": 2.0},
}


_served: list[int] = []  # the process in which obstore has started the threads that serve its requests


def _expect_threads(url: Url) -> None:
    """Raise InputError in a forked process: it has no such threads, and a request would wait for ever."""
    if not _served:
        _served.append(os.getpid())
    if _served[0] != os.getpid():
        raise InputError(
            f"{url}: a forked process cannot read an object store that its parent has read; start worker processes "
            "with multiprocessing_context='spawn'"
        )


@dataclass(frozen=True)
class Url:
    """Hold the URL of a store in an object store; it has those methods of a path that messages need."""

    text: str

    def __str__(self) -> str:
        return self.text

    def __truediv__(self, name: str) -> Url:
        return Url(f"{self.text}/{name}")

    @property
    def name(self) -> str:
        """Return the last part of the URL."""
        return self.text.rsplit("/", 1)[-1]

    def absolute(self) -> Url:
        """Return the URL itself, which is absolute."""
        return self


def parsed(text: str) -> Url:
    """Return the URL of a store. Raises InputError unless it is one of an object store, with a name in a bucket."""
    match = re.fullmatch(r"([A-Za-z0-9+.-]+)://([^/?#\s]+)/+([^?#]*[^?#/\s])/*", text)
    if match is None:
        raise InputError(f"{shown(text)}: is no URL of a store, such as s3://BUCKET/NAME.zarr")
    scheme = match[1].lower()
    if scheme not in SCHEMES:
        raise InputError(f"{shown(text)}: {scheme}:// is unknown; known: file://, {'://, '.join(SCHEMES)}://")
    return Url(f"{scheme}://{match[2]}/{match[3]}")


class Bucket:
    """Read and write the objects below one URL; see `disk.Disk` for the methods."""

    def __init__(self, url: Url) -> None:
        self.path = url

    @cached_property
    def _objects(self) -> Any:
        """Return the client of obstore, whose names are relative to the URL."""
        try:
            import obstore.store
        except ImportError as error:
            raise InputError(f"{self.path}: obstore is not installed; pip install 'vbnfault[cloud]'") from error
        try:
            return obstore.store.from_url(str(self.path), retry_config=RETRIES)
        except Exception as error:  # obstore raises many types for what its environment variables hold
            raise InputError(f"{self.path}: cannot be opened: {_reason(error)}") from error

    @contextlib.contextmanager
    def _translated(self, name: str) -> Iterator[None]:
        """Turn errors of obstore in a `with` block into OSError: no such object, no right, or a failed request.

        Raises InputError if there is no such bucket, or if no credentials were found.
        """
        from obstore.exceptions import BaseError, PermissionDeniedError, UnauthenticatedError

        _expect_threads(self.path)
        where = f"{self.path}/{name}"
        try:
            yield
        except FileNotFoundError as error:
            if "NoSuchBucket" in str(error):
                raise InputError(f"{self.path}: there is no such bucket; create it, or correct the URL") from error
            raise FileNotFoundError(errno.ENOENT, "no such object", where) from error
        except (PermissionDeniedError, UnauthenticatedError) as error:
            raise PermissionError(errno.EACCES, f"access is refused ({_reason(error)})", where) from error
        except (BaseError, OSError, ValueError) as error:
            if any(f"http://{host}/" in str(error) for host in _METADATA_HOSTS):
                raise InputError(f"{self.path}: no credentials were found; {self._how_to_sign_in}") from error
            raise OSError(errno.EIO, _reason(error), where) from error

    @property
    def _how_to_sign_in(self) -> str:
        """Return which environment variables hold credentials, as a clause."""
        if self.path.text.startswith("s3"):
            return "set AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY, or AWS_SKIP_SIGNATURE=true for a public bucket"
        variables = "GOOGLE_SERVICE_ACCOUNT" if self.path.text.startswith("gs") else "AZURE_STORAGE_ACCOUNT_KEY"
        return f"set {variables}"

    @contextlib.contextmanager
    def _reading(self, name: str) -> Iterator[None]:
        """Turn a failure to read into an error that no caller takes for damage."""
        try:
            with self._translated(name):
                yield
        except FileNotFoundError:
            raise
        except PermissionError as error:
            raise InputError(
                f"{error.filename}: {error.strerror}: give this user the right to read it, and repeat the command"
            ) from error
        except OSError as error:
            raise VbnfaultError(
                f"{error.filename}: cannot be read: {error.strerror}; nothing is lost, repeat the command later"
            ) from error

    # --- reading --------------------------------------------------------------------------------------------

    def read(self, name: str, most_bytes: int) -> bytes:
        """Return the content of an object of at most so many bytes. Raises Misplaced for a larger one."""
        import obstore

        with self._reading(name):
            found = obstore.get(self._objects, name)
            if (size := found.meta["size"]) <= most_bytes:
                return bytes(found.bytes())
        why = f"it has {size} bytes, where at most {most_bytes} are possible"
        raise Misplaced(errno.EFBIG, why, f"{self.path}/{name}")

    def read_each(self, files: Sequence[tuple[str, int]]) -> Iterator[bytes | OSError]:
        """Yield the content of each object, several of which are read at once, or why it cannot be read."""

        def content(file: tuple[str, int]) -> bytes | OSError:
            try:
                return self.read(*file)
            except OSError as error:
                return error

        with ThreadPoolExecutor(_READS_AT_ONCE) as pool:
            yield from pool.map(content, files)

    def read_parts(
        self, name: str, tail: int, choose: Callable[[bytes], Sequence[tuple[int, int]]]
    ) -> list[tuple[int, bytes]]:
        """Return parts of an object, see `Disk.read_parts`; only these bytes and the tail are requested."""
        import obstore

        with self._reading(name):
            end = obstore.get(self._objects, name, options={"range": {"suffix": tail}})
            last, version = bytes(end.bytes()), end.meta["e_tag"]

        def part(start: int, length: int) -> tuple[int, bytes]:
            if not length:
                return start, b""
            with self._reading(name):
                options: Any = {"range": (start, start + length), "if_match": version}
                found = obstore.get(self._objects, name, options=options)
                return start, bytes(found.bytes())

        with ThreadPoolExecutor(_READS_AT_ONCE) as pool:
            return list(pool.map(lambda one: part(*one), choose(last)))

    def names(self, folder: str) -> list[str]:
        """Return the names directly below a folder."""
        import obstore

        with self._reading(folder):
            listed = obstore.list_with_delimiter(self._objects, folder)
        paths = [*listed["common_prefixes"], *(entry["path"] for entry in listed["objects"])]
        return [path.rstrip("/").rsplit("/", 1)[-1] for path in paths]

    def exists(self, name: str) -> bool:
        """Return whether there is an object of this name; for an empty name, whether there is any."""
        return self.stamp(name) is not None if name else next(self._all_names(), None) is not None

    def stamp(self, name: str) -> object:
        """Return what changes if an object is replaced; None if there is no such object."""
        import obstore

        try:
            with self._reading(name):
                entry = obstore.head(self._objects, name)
        except FileNotFoundError:
            return None
        return entry["e_tag"], entry["last_modified"]

    def modified(self, folder: str) -> dict[str, datetime]:
        """Return by name when each object directly below a folder was written, by the clock of the object store."""
        import obstore

        with self._reading(folder):
            entries = obstore.list_with_delimiter(self._objects, folder.rstrip("/"))["objects"]
        return {entry["path"].rsplit("/", 1)[-1]: entry["last_modified"] for entry in entries}

    def zarr(self) -> Any:
        """Return the store object that zarr and xarray open; they read ranges of objects by it."""
        from zarr.storage import ObjectStore

        return ObjectStore(self._objects, read_only=True)

    def failure(self, error: Exception, name: str) -> VbnfaultError | None:
        """Return the error for a failure of zarr that is no damage: it comes from obstore."""
        from obstore.exceptions import BaseError

        if not isinstance(error, BaseError):
            return None
        try:
            with self._reading(name):
                raise error
        except FileNotFoundError:
            return None
        except VbnfaultError as failure:
            return failure

    # --- writing --------------------------------------------------------------------------------------------

    def write(self, files: Iterable[tuple[str, bytes | Path]]) -> None:
        """Replace objects; each is the old or the complete new one at any moment."""
        import obstore

        def put(name: str, content: bytes | Path) -> None:
            with self._translated(name):
                obstore.put(self._objects, name, content, chunk_size=_PART_BYTES, max_concurrency=2)

        self._at_once(_WRITES_AT_ONCE, (partial(put, name, content) for name, content in files))

    def remove(self, files: Iterable[str]) -> None:
        """Remove objects; names that do not exist are left out."""
        import obstore

        def delete(name: str) -> None:
            with contextlib.suppress(FileNotFoundError), self._translated(name):
                obstore.delete(self._objects, name)

        self._at_once(_READS_AT_ONCE, (partial(delete, name) for name in files))

    @staticmethod
    def _at_once(count: int, actions: Iterable[Callable[[], None]]) -> None:
        """Do actions, up to `count` at once; raise the first error after those that have begun have ended."""
        running: set[Future[None]] = set()
        with ThreadPoolExecutor(count) as pool:
            for action in actions:
                running.add(pool.submit(action))
                if len(running) >= count:
                    done, running = wait(running, return_when=FIRST_COMPLETED)
                    for future in done:
                        future.result()
            for future in running:
                future.result()

    def copied(self, name: str, most_bytes: int, *, link: bool) -> bytes:
        """Return the content of an object, which `write` of another store takes."""
        return self.read(name, most_bytes)

    # --- the store as a whole -------------------------------------------------------------------------------

    def why_occupied(self, own: Iterable[str]) -> str:
        """Return why no store can be created here, as a clause, or an empty text.

        `own`: names that an interrupted creation may have left.
        """
        if self.exists(_REPLACED):
            return ""
        allowed = set(own)
        for name in self._all_names():
            if name not in allowed and not name.startswith(f"{OWN}/"):
                return f"holds {name} and is no vbnfault store, so it is left alone; choose another --out"
        return ""

    def create(self, files: Iterable[tuple[str, bytes]], *, old: bool) -> None:
        """Write the files of a new store, the root last, in place of an `old` one. Raises OSError."""
        replaces = old or self.exists(_REPLACED)
        if replaces:
            self.write([(_REPLACED, b"")])
            first = ["zarr.json", "spare/zarr.json"]
            self.remove(first)
            self.remove([n for n in self._all_names() if not n.startswith(f"{OWN}/")])
        *others, root = files
        self.write(others)
        self.write([root])
        if replaces:
            self.remove([_REPLACED])

    def remove_leftovers(self) -> None:
        """Remove what a killed process has left besides the data."""
        if self.exists(_REPLACED):
            self.remove([_REPLACED])

    def _all_names(self) -> Iterator[str]:
        """Yield the names of all objects."""
        import obstore

        with self._reading(""):
            for page in obstore.list(self._objects):
                yield from (entry["path"] for entry in page)

    def free_bytes(self) -> int | None:
        """Return None: an object store does not fill up."""
        return None


def _reason(error: BaseException) -> str:
    """Return what obstore says of an error on one line: the object store's answer, or why there was none."""
    text = str(error)
    answer = re.search(r"<Code>([^<]*)</Code>\s*(?:<Message>([^<]*)</Message>)?", text)
    status = re.search(r"status code: (\d+[^:\n]*)", text)
    if answer:
        return ": ".join(filter(None, answer.groups()))
    if status:
        return status[1].strip()
    head = " ".join(text.split("\n\n")[0].split())
    failure = head.rsplit(" - ", 1)[-1]
    return shown(failure)[1:-1] or type(error).__name__


def is_url(text: str | os.PathLike[str]) -> bool:
    """Return whether a text is a URL and no path."""
    return isinstance(text, str) and re.match(r"[A-Za-z][A-Za-z0-9+.-]+://", text) is not None


# --- where a store is -----------------------------------------------------------------------------------------

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
