"""Keep arrays that take seconds to compute on disk: to read them takes a fraction of a second.

All kinds of arrays share one folder and one limit of its size. A file's name is a hash of everything that
determines its content. The file is one of numpy (.npz) that ends with a checksum of its bytes and of that hash. It
is written under another name and then renamed, so that a reader sees a whole file or none, whoever is killed and
however many processes write it. A damaged file is reported to the user, and its arrays are computed again. If the
folder cannot be written, the user is told once, and only time is lost.
"""

from __future__ import annotations

import contextlib
import hashlib
import importlib.metadata
import io
import json
import os
import platform
import shutil
import stat
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import platformdirs

from ..errors import InputError

Arrays = dict[str, Any]

FOLDER_VARIABLE = "VBNFAULT_CACHE_DIR"
SIZE_VARIABLE = "VBNFAULT_CACHE_GIB"
DEFAULT_GIB = 4.0
_LIBRARIES = ("numpy", "scipy", "drjit")
_DIGEST_BYTES = hashlib.sha256().digest_size
_STALE_S = 3600.0  # an unfinished file older than this belongs to no running process
_KINDS = ("patch", "ghosts", "mie", "nucleus")  # prefixes and suffixes of names; the last is of earlier versions
_UNFINISHED = ".part"


def cache_folder() -> Path:
    """Return the folder: $VBNFAULT_CACHE_DIR, or a folder vbnfault in the user's cache folder (`platformdirs`)."""
    given = os.environ.get(FOLDER_VARIABLE)
    return Path(given) if given else platformdirs.user_cache_path("vbnfault", appauthor=False).expanduser()


def cache_limit_bytes() -> int:
    """Return the size limit of the folder from $VBNFAULT_CACHE_GIB (default 4); 0 keeps nothing.

    Raises
    ------
    InputError
        The variable is not a number from 0 to 1e6.
    """
    text = os.environ.get(SIZE_VARIABLE, "")
    try:
        gib = float(text) if text else DEFAULT_GIB
    except ValueError:
        gib = -1.0
    if not 0 <= gib < 1e6:
        raise InputError(f"{SIZE_VARIABLE} must be a number from 0 to 1e6; got {text!r}.")
    return int(gib * 2**30)


def code_hash(sources: Sequence[Path]) -> str:
    """Return the sha256 (hex) of source files, the versions of numerical libraries and the platform."""
    parts = hashlib.sha256()
    for path in sources:
        parts.update(path.read_bytes())
    versions = [importlib.metadata.version(name) for name in _LIBRARIES]
    parts.update(json.dumps([versions, platform.machine(), sys.byteorder]).encode())
    return parts.hexdigest()


@dataclass(frozen=True, kw_only=True)
class ArrayFiles:
    """Keep one kind of arrays on disk.

    Attributes
    ----------
    kind
        First word of the files' names, and their suffix; one of those that the folder's limit counts.
    content
        What the arrays are, in messages to the user.
    """

    kind: str
    content: str

    def path(self, key: str) -> Path:
        """Return the file of a key. Raises RuntimeError or OSError if there is no home folder."""
        return cache_folder() / f"{self.kind}-{key}.{self.kind}"

    def kept(self, key: str, compute: Callable[[], Mapping[str, Any]]) -> Arrays:
        """Return the arrays of a key from disk; if they are not there, compute and keep them.

        The arrays are the same bit for bit in both cases. Raises what `compute` raises, and InputError if
        $VBNFAULT_CACHE_GIB is unusable.
        """
        limit = cache_limit_bytes()
        if limit == 0:
            return dict(compute())
        try:
            path = self.path(key)
        except (RuntimeError, OSError):  # no home folder
            return dict(compute())
        try:
            return self.read(path, key)
        except (FileNotFoundError, NotADirectoryError):
            pass
        except (OSError, ValueError, KeyError, TypeError, MemoryError) as error:
            why = error.strerror if isinstance(error, OSError) else error
            print(
                f"note: {path}: the {self.content} kept there is damaged ({why}); it is built again",
                file=sys.stderr,
            )
        arrays = dict(compute())
        self.write(path, key, arrays, limit)
        return arrays

    def read(self, path: Path, key: str) -> Arrays:
        """Return the arrays in a file.

        Raises ValueError if the file is damaged or has another key, and OSError if it cannot be read.
        """
        if not stat.S_ISREG(path.stat().st_mode):
            raise ValueError("not a regular file")
        data = path.read_bytes()
        content = memoryview(data)[:-_DIGEST_BYTES]
        if _digest(key, content) != data[-_DIGEST_BYTES:]:
            raise ValueError("its checksum does not match")
        with np.load(io.BytesIO(content), allow_pickle=False) as file:
            arrays = {
                name: file[name][()] for name in file.files
            }  # `[()]` turns an array without axes into a number
        with contextlib.suppress(OSError):
            os.utime(path)  # marks the file as just used, so that it is evicted last
        return arrays

    def write(self, path: Path, key: str, arrays: Mapping[str, Any], limit_bytes: int) -> None:
        """Write arrays under another name, then rename the file."""
        unfinished = None
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            with tempfile.NamedTemporaryFile(
                dir=path.parent, prefix=f"{self.kind}-", suffix=_UNFINISHED, delete=False
            ) as file:
                unfinished = Path(file.name)
                content = io.BytesIO()
                np.savez(content, **arrays)
                file.write(content.getbuffer())
                file.write(_digest(key, content.getbuffer()))
            if path.is_dir() and not path.is_symlink():
                shutil.rmtree(path)
            os.replace(unfinished, path)
            unfinished = None
            _evict(path.parent, limit_bytes)
        except (OSError, MemoryError) as error:  # the folder is read-only or full, or another worker uses the file
            _warn_unwritable(path.parent, self.content, getattr(error, "strerror", None) or str(error))
        finally:
            if unfinished is not None:
                with contextlib.suppress(OSError):
                    unfinished.unlink()


def _digest(key: str, content: bytes | memoryview) -> bytes:
    """Return the checksum of a file's content and of the key that determines it."""
    total = hashlib.sha256(key.encode())
    total.update(content)
    return total.digest()


@lru_cache
def _warn_unwritable(folder: Path, content: str, why: str) -> None:
    """Tell the user, once in a process, that arrays cannot be kept in a folder."""
    print(
        f"warning: {folder}: {content} cannot be kept there ({why}), so every run builds it again; "
        f"{FOLDER_VARIABLE} names another folder",
        file=sys.stderr,
    )


def _evict(folder: Path, limit_bytes: int) -> None:
    """Remove the least recently used files until the rest fits, and old unfinished files of killed processes."""
    kept = []
    for path in (path for kind in _KINDS for path in folder.glob(f"{kind}-*")):
        with contextlib.suppress(OSError):  # another worker may evict at the same time
            status = path.stat()
            if path.suffix == _UNFINISHED:
                if time.time() - status.st_mtime > _STALE_S:
                    path.unlink()
            elif path.suffix[1:] in (*_KINDS, "npz"):  # .npz files are from earlier versions
                kept.append((status.st_mtime, status.st_size, path))
    total = sum(size for _, size, _ in kept)
    for _, size, path in sorted(kept, key=lambda entry: (entry[0], entry[2].name)):
        if total <= limit_bytes:
            break
        with contextlib.suppress(OSError):
            path.unlink()
        total -= size
