"""Notice files that change during a run, and cache what was read from them.

`user_files` passes the digest of each file that it reads to this module.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Iterator
from contextvars import ContextVar
from functools import lru_cache, wraps
from pathlib import Path
from typing import Any, TypeVar

from ..errors import InputChanged
from .resources import PACKAGE

_R = TypeVar("_R")

_OWN = "vbnfault:"  # prefix of the keys of vbnfault's own files


class Contents:
    """Record the digests of the files that a run reads, and compare every later reading with the first.

    One object serves a run from its planning to its last worker process; pickling keeps the digests. After
    `complete`, a file that was not read before is refused too, unless it belongs to vbnfault.
    """

    def __init__(self) -> None:
        self._sha256: dict[str, str] = {}
        self._status: dict[str, tuple[int, ...]] = {}  # of files too large to hash at every reading
        self._complete = False

    def __getstate__(self) -> dict[str, Any]:
        return {**vars(self), "_status": {}}  # a file's status has no meaning on another machine

    def complete(self) -> None:
        """Record that the run is planned, so that all its files have been read."""
        self._complete = True

    def knows(self, path: str | Path) -> bool:
        """Return whether the file has been read before."""
        return _key(path) in self._sha256

    @contextlib.contextmanager
    def in_use(self) -> Iterator[None]:
        """Compare every file that this thread reads within a block with the first reading."""
        before = _in_use.set(self)
        try:
            yield
        finally:
            _in_use.reset(before)

    def check(self, path: str | Path, what: str, digest: Callable[[], str], status: os.stat_result | None) -> None:
        """Compare a file's digest with its first one. Raises InputChanged.

        `status` is given for a large file: its digest is then computed only where the status has changed.
        """
        key = _key(path)
        status_now = None if status is None else _identity(status)
        if status_now is not None and self._status.get(key) == status_now:
            return
        digest_now = digest()
        if key not in self._sha256 and self._complete and not key.startswith(_OWN):
            raise changed(f"{path}: {what} file was not there, or not used, when the build began", path, what)
        if self._sha256.setdefault(key, digest_now) != digest_now:
            raise changed(f"{path}: {what} file has changed since the build began", path, what)
        if status_now is not None:
            self._status[key] = status_now


_in_use: ContextVar[Contents | None] = ContextVar("contents", default=None)
_noted: ContextVar[list[str] | None] = ContextVar("noted", default=None)
# Status of each file that the innermost cached function in work has read.
_statuses: ContextVar[dict[str, tuple[int, ...] | None] | None] = ContextVar("statuses", default=None)


def _key(path: str | Path) -> str:
    """Return the absolute path, or for vbnfault's own files a relative one that is the same on every machine."""
    absolute = os.path.abspath(path)
    for root in (PACKAGE, PACKAGE.parent):
        for kind in ("scenes", "textures", "catalogues"):
            if absolute.startswith(f"{root / kind}{os.sep}"):
                return _OWN + os.path.relpath(absolute, root)
    return absolute


def was_read(path: str | Path) -> bool:
    """Return whether the run that this thread works on has read a file before."""
    contents = _in_use.get()
    return contents is not None and contents.knows(path)


def changed(sentence: str, path: str | Path, what: str) -> InputChanged:
    """Return the error that says what changed, and what to do next."""
    return InputChanged(
        f"{sentence.rstrip('.')}; finished samples stay: put the {what} file of before back and repeat the "
        "command, or build the changed scene elsewhere"
    )


def check_contents(
    path: str | Path, what: str, digest: Callable[[], str], status: os.stat_result | None = None
) -> None:
    """Pass the digest of a file to the `Contents` in use and to `noting`, where they are active.

    The function in work that `cached_with_contents` decorates notes the file's status, too.
    """
    contents, noted, statuses = _in_use.get(), _noted.get(), _statuses.get()
    if statuses is not None:
        statuses[os.path.abspath(path)] = _status(os.path.abspath(path))
    if contents is not None:
        contents.check(path, what, digest, status)
    if noted is not None:
        noted.append(digest())


@contextlib.contextmanager
def noting() -> Iterator[list[str]]:
    """Yield a list to which every file that is read within a block appends its SHA-256 (hex), in order."""
    digests: list[str] = []
    before = _noted.set(digests)
    try:
        yield digests
    finally:
        _noted.reset(before)


def cached_with_contents(maxsize: int) -> Callable[[Callable[..., _R]], Callable[..., _R]]:
    """Return a decorator like `lru_cache` for functions of file names; each run (`Contents`) has its own cache.

    Outside a run, as in a notebook, a result is computed again when a file that it was read from has changed.
    """

    def decorate(function: Callable[..., _R]) -> Callable[..., _R]:
        @lru_cache(maxsize=maxsize)
        def result_of(_contents: Contents | None, /, *args: Any) -> _CachedResult:
            return _CachedResult()

        @wraps(function)
        def wrapper(*args: Any) -> _R:
            contents = _in_use.get()
            result = result_of(contents, *args)
            if not result.is_known or (contents is None and result.is_outdated()):
                result.compute(lambda: function(*args))
            around = _statuses.get()
            if around is not None:
                around.update(result.statuses)
            value: _R = result.value
            return value

        return wrapper

    return decorate


class _CachedResult:
    """Hold a result, and the status of each file that it was read from."""

    def __init__(self) -> None:
        self.is_known = False
        self.value: Any = None
        self.statuses: dict[str, tuple[int, ...] | None] = {}

    def is_outdated(self) -> bool:
        """Return whether a file has changed since the result was computed."""
        return any(_status(path) != status for path, status in self.statuses.items())

    def compute(self, function: Callable[[], Any]) -> None:
        """Compute the result and note the files that are read."""
        statuses: dict[str, tuple[int, ...] | None] = {}
        before = _statuses.set(statuses)
        try:
            self.value, self.statuses, self.is_known = function(), statuses, True
        finally:
            _statuses.reset(before)


def _status(path: str) -> tuple[int, ...] | None:
    """Return what changes with a file's contents: device, inode, size and time; None if the file is missing."""
    try:
        return _identity(os.stat(path))
    except OSError:
        return None


def _identity(status: os.stat_result) -> tuple[int, ...]:
    """Return the parts of a file's status that change with its contents."""
    return status.st_dev, status.st_ino, status.st_size, status.st_mtime_ns
