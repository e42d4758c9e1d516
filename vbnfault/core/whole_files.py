"""Replace files and folders only once their new content is written: a full disk leaves the former one."""

from __future__ import annotations

import contextlib
import os
import shutil
import stat
import uuid
from pathlib import Path
from typing import Any


def write_whole(path: Path, content: str | bytes) -> None:
    """Write bytes, or a text as UTF-8, to a file; if that fails, the file keeps its former content or stays absent.

    A device or a pipe is written to as it is; a link stays, and the file that it names is replaced and keeps its
    permissions. Characters of a file name that are no Unicode become question marks. Raises OSError if the file
    cannot be written.
    """
    data = content.encode("utf-8", "replace") if isinstance(content, str) else content
    target = path.resolve()
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
        if mode is not None:
            with contextlib.suppress(OSError):  # a file system without permissions
                temporary.chmod(mode)


class replacing:
    """Write a file or folder under a temporary name beside it, and rename it at the end of a `with` block."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._temporary = path.with_name(f".{uuid.uuid4().hex}.partial")  # short: a name has at most 255 bytes

    def __enter__(self) -> Path:
        return self._temporary

    def __exit__(self, kind: Any, *_: object) -> None:
        try:
            if kind is None:
                if self._path.is_dir():
                    shutil.rmtree(self._path)
                os.replace(self._temporary, self._path)
        finally:
            with contextlib.suppress(OSError):  # the first error counts
                remove(self._temporary)


def remove(path: Path) -> None:
    """Remove a file or a folder, if it exists."""
    if path.is_dir():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)
