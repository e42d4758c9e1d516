"""Write, replace and remove files and folders, and reach nothing through a link.

A file or folder is replaced only once its new content is written: a full disk leaves the former one. What is
removed or truncated is never reached through a link that has the name of a file or folder that vbnfault makes: the
link itself makes way (`own`, `own_folder`, `remove`). A path that the user names for a file may be a link, and the
file behind it is replaced (`write_whole`).
"""

from __future__ import annotations

import contextlib
import errno
import json
import math
import os
import shutil
import stat
import uuid
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from ..errors import InputError, VbnfaultError
from .path_checks import real

# What ends a run although its path is right; every other error of the system means that the path cannot be used.
_FAILED_RUNS = (errno.ENOSPC, errno.EDQUOT, errno.EIO, errno.EFBIG, errno.EMFILE, errno.ENFILE)


def kind_of(error: OSError) -> type[VbnfaultError]:
    """Return the kind of error, and so the exit code, for a file or folder that cannot be written.

    It is InputError, unless the disk is full or fails, or the process may open no more files.
    """
    return VbnfaultError if error.errno in _FAILED_RUNS else InputError


@contextlib.contextmanager
def writing(path: object, *, within: bool = False, then: str = "") -> Iterator[None]:
    """Turn an OSError of a block that writes a file into a VbnfaultError of one sentence, which `then` ends.

    With `within`, `path` is a folder, and the sentence names the file of the error.
    """
    try:
        yield
    except OSError as error:
        why = error.strerror or str(error)
        if isinstance(error, FileExistsError):
            why = "it is a link that leads nowhere" if os.path.islink(str(path)) else "it is a file, not a folder"
        named = (error.filename2 or error.filename) if within else ""
        raise kind_of(error)(f"{named or path}: cannot be written: {why}{then}") from None


def write_whole(path: Path, content: str | bytes) -> None:
    """Write bytes, or a text as UTF-8, to a file; if that fails, the file keeps its former content or stays absent.

    A device or a pipe is written to as it is; a link stays, and the file that it names is replaced and keeps its
    permissions. Characters of a file name that are no Unicode become question marks. Raises OSError if the file
    cannot be written.
    """
    data = content.encode("utf-8", "replace") if isinstance(content, str) else content
    target = real(path)
    if target.exists() and not target.is_file():
        path.write_bytes(data)
        return
    with replacing(target) as temporary:
        mode = stat.S_IMODE(target.stat().st_mode) if target.exists() else None
        # what nobody else may read is not readable meanwhile, either
        descriptor = os.open(
            temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o666 if mode is None else mode | 0o200
        )
        with os.fdopen(descriptor, "wb") as file:
            file.write(data)
            file.flush()
            flush(file.fileno())
        if mode is not None:
            with contextlib.suppress(OSError):  # a file system without permissions
                temporary.chmod(mode)


def plain(value: Any) -> Any:
    """Return a value as JSON can hold it.

    Arrays and tuples become lists. NaN and infinity, which JSON does not have, become None: the value is undefined
    or has no bound.
    """
    if isinstance(value, Mapping):
        return {key: plain(inner) for key, inner in value.items()}
    if hasattr(value, "tolist"):  # an array or a number of numpy, which this module does not import
        return plain(value.tolist())
    if isinstance(value, list | tuple):
        return [plain(inner) for inner in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def write_json(path: Path, value: Any, *, indent: int = 2) -> None:
    """Write a value as JSON, null where a number is not finite; see `plain`."""
    write_whole(path, json.dumps(plain(value), indent=indent, allow_nan=False) + "\n")


class replacing:
    """Write a file or folder under a temporary name beside it, and rename it at the end of a `with` block.

    A file is flushed to the device before: it is the old or the complete new one, also after a loss of power.
    A link of this name is replaced, not what it names; a folder is replaced by a folder only.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._temporary = path.with_name(f".{uuid.uuid4().hex}.partial")  # short: a name has at most 255 bytes

    def __enter__(self) -> Path:
        return self._temporary

    def __exit__(self, kind: Any, *_: object) -> None:
        try:
            if kind is None:
                if self._temporary.is_dir():
                    remove(self._path)
                else:
                    with contextlib.suppress(PermissionError):  # `write_whole` has flushed it and set its mode
                        _flush_at(self._temporary, os.O_RDWR)
                rename(self._temporary, self._path)
        finally:
            with contextlib.suppress(OSError):  # the first error counts
                remove(self._temporary)


def rename(source: Path, target: Path) -> None:
    """Rename a file or folder within one parent folder, durably."""
    os.replace(source, target)
    flush_folder(target.parent)


def flush_folder(folder: Path) -> None:
    """Flush the entries of a folder to the device: files made, renamed or removed in it."""
    _flush_at(folder, os.O_RDONLY)


def _flush_at(path: Path, flags: int) -> None:
    """Flush a file or folder to the device."""
    handle = os.open(path, flags)
    try:
        flush(handle)
    finally:
        os.close(handle)


def flush(handle: int) -> None:
    """Flush an open file or folder to the device; ignore file systems that cannot."""
    try:
        os.fsync(handle)
    except OSError as error:
        if error.errno not in (errno.EINVAL, errno.ENOTSUP):
            raise


def remove(path: Path) -> None:
    """Remove a file, a link or a folder with its contents, if it exists; what links name stays."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


def own(path: Path) -> Path:
    """Return the path of a file in a folder that vbnfault makes; a link of this name is removed."""
    if path.is_symlink():
        path.unlink()
    return path


def own_folder(path: Path) -> Path:
    """Make a folder within one that vbnfault makes, and return it; a link of this name is removed."""
    own(path).mkdir(parents=True, exist_ok=True)
    return path
