"""Lock a store or a study: only one command writes to it at a time, even if its folder is replaced meanwhile.

Commands that each write a range of the shards of one store (`--shard-range`) may work at the same time if their
ranges are disjoint. Each command first takes the lock of what it writes, then looks for the locks of others that
overlap: so of two that begin together, at least one sees the other.
"""

from __future__ import annotations

import contextlib
import errno
import json
import os
import re
import stat
import threading
import time
import uuid
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

from ..core.errors import InputError, VbnfaultError
from ..core.whole_files import kind_of
from ..store import Location, Url
from . import claims
from .owners import has_ended, overlap, still_writing, this_process

fcntl: ModuleType | None
try:
    import fcntl
except ImportError:  # Windows has no such locks
    fcntl = None

# a lock is no link, whose target would be emptied, and no pipe, which would block
_PLAIN = getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0)
_MOST_BYTES = 65536  # of what a lock says of its owner
_SECONDS_BETWEEN_BEATS = 10.0
_SECONDS_BETWEEN_TRIES = 0.1
_SECONDS_TO_PREPARE = 600.0  # after which a command does not wait any longer until another has prepared a store


@contextlib.contextmanager
def locked(path: Location, shards: range | None = None) -> Iterator[None]:
    """Hold the lock of the store or study at `path`, or of some of its shards, during a `with` block.

    In an object store, `claims` does this.

    The lock is a locked file beside the store, `.NAME.lock`, or `.NAME.shards-A-B.lock` for the shards A to B - 1.
    So it exists before the store does, and it stays when the store is replaced. The operating system releases the
    lock when the process ends.

    If the file system has no locks, a file that ends in `.owner` holds the host, the process number and the start
    time of its owner instead. If its owner ran on this host and has ended, the file is removed and the lock taken.
    The file of an owner on another host is never removed; the error then states the file and the owner's last
    heart-beat. The two kinds of lock have different names, so that one never removes the file of the other.

    Raises
    ------
    VbnfaultError
        Another command holds the lock.
    InputError
        No lock can be made at this path.
    """
    with contextlib.ExitStack() as stack:
        if isinstance(path, Url):
            stack.enter_context(claims.claimed(path, shards))
            yield
            return
        _take(path, _stem(path, shards), stack)
        for held in _held_locks(path):
            if held.shards != shards and overlap(held.shards, shards):
                raise held.error(path)
        yield


@contextlib.contextmanager
def prepared_by_one(path: Location) -> Iterator[None]:
    """Let the commands that write shards of one store pass a `with` block one after the other.

    In it, a command takes the lock of its shards, and the first one creates or repairs the store. Raises
    VbnfaultError after ten minutes of waiting.
    """
    until = time.monotonic() + _SECONDS_TO_PREPARE
    with contextlib.ExitStack() as stack:
        if isinstance(path, Url):
            stack.enter_context(claims.prepared(path, _SECONDS_TO_PREPARE))
            yield
            return
        while True:
            try:
                _take(path, f".{path.name}.prepare", stack)
                break
            except VbnfaultError as error:
                if isinstance(error, InputError) or time.monotonic() > until:
                    raise
            time.sleep(_SECONDS_BETWEEN_TRIES)
        yield


def others_at_work(path: Location, shards: range) -> bool:
    """Return whether other commands write other shards of the store at `path` now."""
    if isinstance(path, Url):
        return any(others != shards for others in claims.ranges_at_work(path))
    return any(held.shards not in (None, shards) for held in _held_locks(path))


def _stem(path: Path, shards: range | None) -> str:
    """Return the name of a lock without its ending."""
    return f".{path.name}" if shards is None else f".{path.name}.shards-{shards.start}-{shards.stop}"


class _HeldLock(NamedTuple):
    """Hold what another process has locked: some shards, or everything (None), and the file of the lock."""

    shards: range | None
    file: Path

    def error(self, path: Path) -> VbnfaultError:
        """Return the error for a command that wants the same."""
        file = self.file if self.file.suffix == ".owner" else None
        return _held(path, _read_owner(self.file), file, self.shards)


def _held_locks(path: Path) -> Iterator[_HeldLock]:
    """Yield the locks of the store at `path` that a process holds, this one's too, and remove abandoned files."""
    own = re.compile(rf"\.{re.escape(path.name)}(?:\.shards-(\d+)-(\d+))?\.(lock|owner)")
    folder = path.absolute().parent
    try:
        names = sorted(os.listdir(folder))
    except OSError:  # a folder that this user may not list: only the lock of the whole is taken there
        return
    for name in names:
        match = own.fullmatch(name)
        if match is None:
            continue
        file = folder / name
        is_held = _is_locked(file) if match[3] == "lock" else not has_ended(_read_owner(file))
        if is_held:
            yield _HeldLock(range(int(match[1]), int(match[2])) if match[1] else None, file)
        elif match[3] == "owner":
            _remove_owner(file, _read_owner(file))


def _is_locked(file: Path) -> bool:
    """Return whether a process holds the lock of a file; otherwise remove the file, which was left behind."""
    if fcntl is None:
        return False
    try:
        handle = os.open(file, os.O_RDONLY | _PLAIN)
    except OSError:
        return False
    try:
        fcntl.flock(handle, fcntl.LOCK_SH | fcntl.LOCK_NB)  # shared: others that look do not disturb each other
        file.unlink(missing_ok=True)
    except BlockingIOError:
        return True
    except OSError:
        return False
    finally:
        os.close(handle)
    return False


def _take(path: Path, stem: str, stack: contextlib.ExitStack) -> None:
    """Take a lock until the stack ends. Raises VbnfaultError if another process holds it."""
    beside = path.absolute().parent
    try:
        beside.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        above = next((p for p in path.absolute().parents if os.path.isfile(p)), None)
        why = f"{above} is a file, not a folder" if above else error.strerror
        raise kind_of(error)(f"{path}: nothing can be created here: {why}") from None
    if fcntl is None or not _lock_file(path, beside / f"{stem}.lock", stack):
        _own(path, beside / f"{stem}.owner", stack)


def _lock_file(path: Path, file: Path, stack: contextlib.ExitStack) -> bool:
    """Lock a file until the stack ends, which removes the file. Return False if the file system has no locks."""
    assert fcntl is not None
    whole = file.name == f"{_stem(path, None)}.lock"
    while True:
        try:
            handle = os.open(file, os.O_RDWR | os.O_CREAT | _PLAIN, 0o666)
        except OSError as error:
            if error.errno == errno.ELOOP:
                raise _no_lock(file) from None
            if not whole:
                raise kind_of(error)(f"{file}: a lock cannot be created here: {error.strerror}") from None
            if not os.path.isdir(path):
                raise kind_of(error)(f"{path}: nothing can be created here: {error.strerror}") from None
            # its parent folder is not writable, so the store cannot be replaced: lock the store's own folder
            handle = os.open(path, os.O_RDONLY)
        with contextlib.ExitStack() as undo:
            undo.callback(os.close, handle)
            try:
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise _held(path, _read_owner(file)) from None
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
                        os.ftruncate(handle, 0)
                        try:
                            os.write(handle, json.dumps(this_process()).encode())
                        except OSError as error:
                            raise VbnfaultError(f"{file}: cannot be written: {error.strerror}") from None
                    stack.push(undo.pop_all())
                    return True
            # the file was removed by its owner between our opening and our locking it: try again


def _no_lock(file: Path) -> InputError:
    """Return the error for a link or a pipe that has the name of a lock."""
    return InputError(f"{file}: has the name of a lock, but is a link or a pipe; remove it")


def _own(path: Path, file: Path, stack: contextlib.ExitStack) -> None:
    """Make an owner's file and keep its heart-beat going until the stack ends, which removes the file."""
    owner = this_process() | {"token": uuid.uuid4().hex}
    while True:
        try:
            handle = os.open(file, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o666)
        except FileExistsError:
            other = _read_owner(file)
            if not has_ended(other):
                raise _held(path, other, file) from None
            _remove_owner(file, other)
            continue
        except OSError as error:
            raise kind_of(error)(
                f"{path}: the file system has no locks, and {file} cannot be made in their place "
                f"({error.strerror}); choose an --out on another file system"
            ) from None
        with os.fdopen(handle, "w") as text:
            json.dump(owner, text)
        break
    ended = threading.Event()

    def beat() -> None:
        while not ended.wait(_SECONDS_BETWEEN_BEATS):
            with contextlib.suppress(OSError):
                os.utime(file)

    threading.Thread(target=beat, daemon=True).start()
    stack.callback(_remove_owner, file, owner)
    stack.callback(ended.set)


def _read_owner(file: Path) -> dict[str, Any]:
    """Return the content of an owner's file; empty if it cannot be read."""
    try:
        handle = os.open(file, os.O_RDONLY | _PLAIN)
        with os.fdopen(handle, "rb") as content:
            owner = json.loads(content.read(_MOST_BYTES))
    except (OSError, ValueError, RecursionError):
        return {}
    return owner if isinstance(owner, dict) else {}


def _remove_owner(file: Path, owner: dict[str, Any]) -> None:
    """Remove an owner's file, unless another process has replaced it meanwhile.

    The file is renamed first and then compared, because comparing and removing are not one atomic step.
    """
    aside = file.with_name(f"{file.name}.{uuid.uuid4().hex}")
    try:
        os.rename(file, aside)
    except FileNotFoundError:
        return
    if _read_owner(aside) != owner:
        with contextlib.suppress(OSError):
            os.link(aside, file)
    aside.unlink(missing_ok=True)


def _held(
    path: Path, owner: dict[str, Any], file: Path | None = None, shards: range | None = None
) -> VbnfaultError:
    """Return the error for a lock that another command holds; `file`: its file, if that has a heart-beat."""
    beat = ""
    if file is not None:
        with contextlib.suppress(OSError):
            beat = time.strftime("%Y-%m-%d %H:%M:%S", time.localtime(file.stat().st_mtime))
    return still_writing(path, owner, shards, file if beat else None, beat)
