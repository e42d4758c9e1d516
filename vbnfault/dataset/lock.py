"""Lock a store or a study: only one command writes to it at a time, even if its folder is replaced meanwhile."""

from __future__ import annotations

import contextlib
import json
import os
import platform
import stat
import threading
import time
import uuid
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

from ..core.errors import InputError, VbnfaultError

fcntl: ModuleType | None
try:
    import fcntl
except ImportError:  # Windows has no such locks
    fcntl = None

_SECONDS_BETWEEN_BEATS = 10.0


@contextlib.contextmanager
def locked(path: Path) -> Iterator[None]:
    """Hold the lock of the store or study at `path` during a `with` block.

    The lock is a locked file beside the store, `.NAME.lock`. So it exists before the store does, and it stays when
    the store is replaced. The operating system releases the lock when the process ends.

    If the file system has no locks, a file `.NAME.owner` holds the host, the process number and the start time of
    its owner instead. If its owner ran on this host and has ended, the file is removed and the lock taken. The file
    of an owner on another host is never removed; the error then states the file and the owner's last heart-beat.
    The two kinds of lock have different names, so that one never removes the file of the other.

    Raises
    ------
    VbnfaultError
        Another command holds the lock.
    InputError
        No lock can be made at this path.
    """
    beside = path.absolute().parent
    try:
        beside.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        above = next((p for p in path.absolute().parents if os.path.isfile(p)), None)
        why = f"{above} is a file, not a folder" if above else error.strerror
        raise InputError(f"{path}: nothing can be created here: {why}") from None
    with contextlib.ExitStack() as stack:
        if fcntl is None or not _lock_file(path, beside / f".{path.name}.lock", stack):
            _own(path, beside / f".{path.name}.owner", stack)
        yield


def _lock_file(path: Path, file: Path, stack: contextlib.ExitStack) -> bool:
    """Lock a file until the stack ends, which removes the file. Return False if the file system has no locks."""
    assert fcntl is not None
    while True:
        try:
            handle = os.open(file, os.O_RDWR | os.O_CREAT, 0o666)
        except OSError as error:
            if not os.path.isdir(path):
                raise InputError(f"{path}: nothing can be created here: {error.strerror}") from None
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
            with contextlib.suppress(FileNotFoundError):
                named = os.stat(path if stat.S_ISDIR(status.st_mode) else file)
                if (named.st_dev, named.st_ino) == (status.st_dev, status.st_ino):
                    if not stat.S_ISDIR(status.st_mode):
                        os.ftruncate(handle, 0)
                        os.write(handle, json.dumps(_this_process()).encode())
                        undo.callback(file.unlink, missing_ok=True)  # before it is closed
                    stack.push(undo.pop_all())
                    return True
            # the file was removed by its owner between our opening and our locking it: try again


def _own(path: Path, file: Path, stack: contextlib.ExitStack) -> None:
    """Make an owner's file and keep its heart-beat going until the stack ends, which removes the file."""
    owner = _this_process() | {"token": uuid.uuid4().hex}
    while True:
        try:
            handle = os.open(file, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o666)
        except FileExistsError:
            other = _read_owner(file)
            if not _has_ended(other):
                raise _held(path, other, file) from None
            _remove_owner(file, other)
            continue
        except OSError as error:
            raise InputError(
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


def _this_process() -> dict[str, Any]:
    """Return host, process number and start time of this process."""
    import psutil

    return {"host": platform.node(), "pid": os.getpid(), "started": psutil.Process().create_time()}


def _read_owner(file: Path) -> dict[str, Any]:
    """Return the content of an owner's file; empty if it cannot be read."""
    try:
        owner = json.loads(file.read_text())
    except (OSError, ValueError):
        return {}
    return owner if isinstance(owner, dict) else {}


def _has_ended(owner: dict[str, Any]) -> bool:
    """Return whether a lock's owner was a process of this host that has ended.

    The start time is compared, too: another process may have got the number of the owner.
    """
    import psutil

    if owner.get("host") != platform.node() or not isinstance(owner.get("pid"), int):
        return False
    try:
        process = psutil.Process(owner["pid"])
        same = process.create_time() == owner.get("started")
    except psutil.NoSuchProcess:
        return True
    except psutil.Error:
        return False
    return not same or process.status() == psutil.STATUS_ZOMBIE


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


def _held(path: Path, owner: dict[str, Any], file: Path | None = None) -> VbnfaultError:
    """Return the error for a lock that another command holds."""
    by = f" (process {owner['pid']} on {owner['host']})" if {"pid", "host"} <= owner.keys() else ""
    sentence = f"{path}: another command is writing to it{by}; wait until it ends"
    if file is not None:
        with contextlib.suppress(OSError):
            beat = time.strftime("%Y-%m-%d %H:%M:%S", time.localtime(file.stat().st_mtime))
            sentence += f", or delete {file} if it has ended: its last heart-beat was at {beat}"
    return VbnfaultError(sentence)
