"""Lock a store or a study: only one command writes to it at a time, even if its folder is replaced meanwhile.

Commands that each write a range of the shards of one store (`--shard-range`) may work at the same time if their
ranges are disjoint. Each command first takes the lock of what it writes, then looks for the locks of others that
overlap: so of two that begin together, at least one sees the other.

The lock is a locked file beside the store, `.NAME.lock`, or `.NAME.shards-A-B.lock` for the shards A to B - 1. So
it exists before the store does, and it stays when the store is replaced. The operating system releases the lock
when the process ends. In an object store, and where the file system has no locks, `claims` takes its place.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import json
import os
import re
import stat
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from ..core.errors import InputError, VbnfaultError
from ..core.files.whole_files import kind_of
from ..store import Location, Url
from . import claims
from .claims import overlap, still_writing, this_process

# a lock is no link, whose target would be emptied, and no pipe, which would block
_PLAIN = os.O_NOFOLLOW | os.O_NONBLOCK
_MOST_BYTES = 65536  # of what a lock says of its owner
_SECONDS_BETWEEN_TRIES = 0.1
_SECONDS_TO_PREPARE = 600.0  # after which a command does not wait any longer until another has prepared a store


@contextlib.contextmanager
def locked(path: Location, shards: range | None = None) -> Iterator[None]:
    """Hold the lock of the store or study at `path`, or of some of its shards, during a `with` block.

    Raises
    ------
    VbnfaultError
        Another command holds the lock.
    InputError
        No lock can be made at this path.
    """
    with contextlib.ExitStack() as stack:
        if isinstance(path, Url) or not _take(path, _stem(path, shards), stack):
            stack.enter_context(claims.claimed(path, shards))
        else:
            for held, file in _held_locks(path):
                if held != shards and overlap(held, shards):
                    raise still_writing(path, _read_owner(file), held)
            for claim in claims.at_work(path):  # of hosts that mount this folder without locks
                if overlap(claim.shards, shards):
                    raise still_writing(path, claim.owner, claim.shards, claim.file)
        yield


@contextlib.contextmanager
def prepared_by_one(path: Location) -> Iterator[None]:
    """Let the commands that write shards of one store pass a `with` block one after the other.

    In it, a command takes the lock of its shards, and the first one creates or repairs the store. Raises
    VbnfaultError after ten minutes of waiting.
    """
    until = time.monotonic() + _SECONDS_TO_PREPARE
    with contextlib.ExitStack() as stack:
        has_lock = None
        while has_lock is None:
            try:
                has_lock = not isinstance(path, Url) and _take(path, f".{path.name}.prepare", stack)
            except claims.Held:
                if time.monotonic() > until:
                    raise
                time.sleep(_SECONDS_BETWEEN_TRIES)
        if not has_lock:
            stack.enter_context(claims.prepared(path, _SECONDS_TO_PREPARE))
        yield


def others_at_work(path: Location, shards: range) -> bool:
    """Return whether other commands write other shards of the store at `path` now."""
    held = [] if isinstance(path, Url) else [held for held, _ in _held_locks(path)]
    claimed = [claim.shards for claim in claims.at_work(path)]
    return any(others not in (None, shards) for others in (*held, *claimed))


def _stem(path: Path, shards: range | None) -> str:
    """Return the name of a lock without its ending."""
    return f".{path.name}" if shards is None else f".{path.name}.shards-{shards.start}-{shards.stop}"


def _held_locks(path: Path) -> Iterator[tuple[range | None, Path]]:
    """Yield the shards (None: everything) and the file of each lock that a process holds, this one's too.

    Files that nobody locks are removed.
    """
    own = re.compile(rf"\.{re.escape(path.name)}(?:\.shards-(\d+)-(\d+))?\.lock")
    folder = path.absolute().parent
    try:
        names = sorted(os.listdir(folder))
    except OSError:  # a folder that this user may not list: only the lock of the whole is taken there
        return
    for name in names:
        match = own.fullmatch(name)
        if match is not None and not _removed_if_free(folder / name):
            yield range(int(match[1]), int(match[2])) if match[1] else None, folder / name


def _removed_if_free(file: Path) -> bool:
    """Remove the file of a lock that no process holds; return False if one holds it."""
    try:
        handle = os.open(file, os.O_RDONLY | _PLAIN)
    except OSError:
        return True
    try:
        fcntl.flock(handle, fcntl.LOCK_SH | fcntl.LOCK_NB)  # shared: others that look do not disturb each other
        file.unlink(missing_ok=True)
    except BlockingIOError:
        return False
    except OSError:
        pass
    finally:
        os.close(handle)
    return True


def _take(path: Path, stem: str, stack: contextlib.ExitStack) -> bool:
    """Take a lock until the stack ends, which removes its file. Return False if the file system has no locks.

    Raises Held if another process holds it.
    """
    file = path.absolute().with_name(f"{stem}.lock")
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        above = next((p for p in path.absolute().parents if os.path.isfile(p)), None)
        why = f"{above} is a file, not a folder" if above else error.strerror
        raise kind_of(error)(f"{path}: nothing can be created here: {why}") from None
    while True:
        handle = _opened(path, file)
        with contextlib.ExitStack() as undo:
            undo.callback(os.close, handle)
            try:
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise still_writing(path, _read_owner(file)) from None
            except OSError:
                with contextlib.suppress(OSError):
                    file.unlink()
                return False
            status = os.fstat(handle)
            if not (stat.S_ISDIR(status.st_mode) or stat.S_ISREG(status.st_mode)):
                raise _no_lock(file)
            with contextlib.suppress(FileNotFoundError):
                named = os.stat(path if stat.S_ISDIR(status.st_mode) else file)
                if (named.st_dev, named.st_ino) == (status.st_dev, status.st_ino):
                    if not stat.S_ISDIR(status.st_mode):
                        undo.callback(file.unlink, missing_ok=True)  # before it is closed
                        _write_owner(file, handle)
                    stack.push(undo.pop_all())
                    return True
            # the file was removed by its owner between our opening and our locking it: try again


def _opened(path: Path, file: Path) -> int:
    """Open the file of a lock. Where it cannot be made, open the store's own folder: it cannot be replaced then."""
    try:
        return os.open(file, os.O_RDWR | os.O_CREAT | _PLAIN, 0o666)
    except OSError as error:
        if error.errno == errno.ELOOP:
            raise _no_lock(file) from None
        if file.name != f"{_stem(path, None)}.lock":
            raise kind_of(error)(f"{file}: a lock cannot be created here: {error.strerror}") from None
        if not os.path.isdir(path):
            raise kind_of(error)(f"{path}: nothing can be created here: {error.strerror}") from None
        return os.open(path, os.O_RDONLY)


def _write_owner(file: Path, handle: int) -> None:
    """Write into the file of a lock who holds it."""
    try:
        os.ftruncate(handle, 0)
        os.write(handle, json.dumps(this_process()).encode())
    except OSError as error:
        raise VbnfaultError(f"{file}: cannot be written: {error.strerror}") from None


def _no_lock(file: Path) -> InputError:
    """Return the error for a link or a pipe that has the name of a lock."""
    return InputError(f"{file}: has the name of a lock, but is a link or a pipe; remove it")


def _read_owner(file: Path) -> dict[str, Any]:
    """Return what the file of a lock says of its owner; empty if it cannot be read."""
    try:
        handle = os.open(file, os.O_RDONLY | _PLAIN)
        with os.fdopen(handle, "rb") as content:
            owner = json.loads(content.read(_MOST_BYTES))
    except (OSError, ValueError, RecursionError):
        return {}
    return owner if isinstance(owner, dict) else {}
