"""Read every file that a user names.

`read_input` reads a file once. It refuses everything but a regular file of reasonable size, so that no file can
block the program or fill the memory before the first byte is parsed. `check_input` checks a file that a library
must read by its path, such as a SPICE kernel.
"""

from __future__ import annotations

import hashlib
import os
import stat
from collections.abc import Sequence
from io import BufferedReader
from pathlib import Path

from ..errors import InputError
from . import path_checks
from .file_contents import changed, check_contents, was_read

MIB = 1 << 20
# Kind of file → the most bytes it may have. A shape as text then has some 12 million facets; the other limits are
# ten times the size of the largest files in use.
LIMIT_BYTES: dict[str, int] = {
    "scene": 4 * MIB,
    "study": 4 * MIB,
    "benchmark": 4 * MIB,
    "severity table": 4 * MIB,
    "lens": 4 * MIB,
    "glass catalogue": 16 * MIB,
    "detector": 4 * MIB,
    "calibration": MIB,
    "shape": 1024 * MIB,
    "spacecraft": 512 * MIB,
    "texture": 256 * MIB,
    "image": 4096 * MIB,
    "film": 65536 * MIB,
    "response": 4 * MIB,
    "data": 1024 * MIB,
    "trajectory": 256 * MIB,
    "plug-in": 64 * MIB,
    "SPICE kernel": 8192 * MIB,
    "star catalogue": 64 * MIB,
    "weights": 4096 * MIB,
    "SPICE text kernel": 256 * MIB,
}


def read_input(path: str | Path, what: str, *, types: Sequence[str] = (), limit_bytes: int | None = None) -> bytes:
    """Return the bytes of a file that a user names, read once.

    Parameters
    ----------
    path
        Path of a regular file, or of a link to one.
    what
        Kind of file, a key of `LIMIT_BYTES`. Error messages name it.
    types
        Allowed suffixes in lower case; empty: all.
    limit_bytes
        The most bytes that the file may have; default: the limit of its kind.

    Raises
    ------
    InputError
        The file is missing, unreadable, empty or too large, is no regular file (a folder, a device, a pipe), or has
        another type.
    InputChanged
        The file has changed since the build began (`Contents`).
    """
    limit = LIMIT_BYTES[what] if limit_bytes is None else limit_bytes
    with _opened(Path(path), what, types, limit) as file:
        try:
            data = file.read()  # not `limit` bytes: that many would be allocated before one is read
        except OSError as error:
            raise InputError(f"{path}: {what} file cannot be read: {error.strerror}.") from None
    if len(data) > limit:
        raise _too_large(Path(path), what, len(data), limit)
    check_contents(path, what, lambda: sha256(data))
    return data


def check_input(path: str | Path, what: str) -> None:
    """Check a file, as `read_input` does, that a library will read by its path. Raises InputError, InputChanged."""
    with _opened(Path(path), what, (), LIMIT_BYTES[what]) as file:
        check_contents(path, what, lambda: _sha256_of(file), os.fstat(file.fileno()))


def head_of_input(path: str | Path, what: str, size_bytes: int) -> bytes:
    """Return the first bytes of a file that a user names, such as those that show its format. Raises InputError."""
    with _opened(Path(path), what, (), LIMIT_BYTES[what]) as file:
        return file.read(size_bytes)


def sha256(data: bytes) -> str:
    """Return the SHA-256 (hex) of a file's bytes, as `read_input` returns them."""
    return hashlib.sha256(data).hexdigest()


def sha256_of_input(path: str | Path, what: str) -> str:
    """Return the SHA-256 (hex) of a file that is too large for the memory. Raises InputError."""
    with _opened(Path(path), what, (), LIMIT_BYTES[what]) as file:
        return _sha256_of(file)


def _sha256_of(file: BufferedReader) -> str:
    """Return the SHA-256 (hex) of an open file, read in pieces."""
    return hashlib.file_digest(file, "sha256").hexdigest()


def _opened(path: Path, what: str, types: Sequence[str], limit_bytes: int) -> BufferedReader:
    """Return an open, regular file of one of `types`, neither empty nor too large. Raises InputError."""
    try:
        return _opened_now(path, what, types, limit_bytes)
    except InputError as error:
        if was_read(path):
            raise changed(f"{error}", path, what) from None
        raise


def _opened_now(path: Path, what: str, types: Sequence[str], limit_bytes: int) -> BufferedReader:
    """Return the open file as `_opened` does, but without comparing it with an earlier reading."""
    status = path_checks.file_status(path)
    if status is None:
        raise InputError(f"{path_checks.shown_path(path)}: {what} file {path_checks.why_absent(path)}.")
    if not stat.S_ISREG(status.st_mode):  # before opening: opening a device may already act on it
        raise InputError(f"{path}: {what} is not a file{path_checks.kind_of(status)}.")
    if types and path.suffix.lower() not in types:
        raise InputError(
            f"{path}: unsupported {what} type {path.suffix.lower()!r}; allowed are {', '.join(types)}."
        )
    try:
        # O_NONBLOCK, since the name may belong to a pipe by now, which would block.
        file = os.fdopen(os.open(path, os.O_RDONLY | os.O_NONBLOCK), "rb")
    except OSError as error:
        raise InputError(f"{path}: {what} file cannot be read: {error.strerror}.") from None
    try:
        status = os.fstat(file.fileno())
        if not stat.S_ISREG(status.st_mode):
            raise InputError(f"{path}: {what} is not a file{path_checks.kind_of(status)}.")
        if status.st_size == 0:
            raise InputError(f"{path}: {what} file is empty.")
        if status.st_size > limit_bytes:
            raise _too_large(path, what, status.st_size, limit_bytes)
    except BaseException:
        file.close()
        raise
    return file


def _too_large(path: Path, what: str, size_bytes: int, limit_bytes: int) -> InputError:
    """Return the error that states a file's size and its limit."""
    return InputError(
        f"{path}: {what} file has {size_bytes / MIB:.3g} MiB or more; at most {limit_bytes / MIB:g} MiB are read."
    )
