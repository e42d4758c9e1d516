"""Keep built patches on disk: to build one takes many seconds, to read one takes a fraction of a second.

A file's name is a hash of everything that determines its content: the body, the site, all parameters, the sources
of the terrain code, and the versions of the libraries that compute it. The file holds the same hash and ends with a
checksum of all its bytes. A damaged file is reported to the user and the patch is built again. If the folder cannot
be written, the user is told once, and only time is lost.
"""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import importlib.metadata
import json
import os
import platform
import shutil
import stat
import struct
import sys
import tempfile
import time
from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ..core import activity
from ..core.errors import InputError
from .patch import Patch, build_patch
from .sites import Site
from .spec import PatchSpec

if TYPE_CHECKING:
    from . import Body

FOLDER_VARIABLE = "VBNFAULT_CACHE_DIR"
SIZE_VARIABLE = "VBNFAULT_CACHE_GIB"
DEFAULT_GIB = 4.0
_SOURCES = ("fields", "noise", "refine", "relief", "roughness", "boulders", "patch", "gravity", "shape")
_LIBRARIES = ("numpy", "scipy", "drjit")
_ARRAYS = tuple(name for name in Patch.__dataclass_fields__ if name != "site")
_SUFFIX = ".patch"
_MAGIC = b"vbnfault patch 1"
_HEADER = struct.Struct("<16sQ")  # magic, and the number of bytes of the table that follows
_ALIGNED_BYTES = 64  # each array begins at a multiple of this
_STALE_S = 3600.0  # an unfinished file older than this belongs to no running process


def cache_folder() -> Path:
    """Return the folder for patches: $VBNFAULT_CACHE_DIR, or a folder vbnfault in the user's cache folder."""
    given = os.environ.get(FOLDER_VARIABLE)
    if given:
        return Path(given)
    if sys.platform == "win32":
        base = os.environ.get("LOCALAPPDATA")
        return (Path(base) if base else Path.home() / "AppData" / "Local") / "vbnfault" / "cache"
    base = os.environ.get("XDG_CACHE_HOME")
    return (Path(base) if base else Path.home() / ".cache") / "vbnfault"


def cache_limit_bytes() -> int:
    """Return the size limit of the cache from $VBNFAULT_CACHE_GIB (default 4); 0 keeps nothing.

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


def cached_patch(body: Body, site: Site, spec: PatchSpec) -> Patch:
    """Return what `build_patch` returns for the same arguments, from disk if it was built before.

    The patch is the same bit for bit in both cases. Raises what `build_patch` raises, and InputError if
    $VBNFAULT_CACHE_GIB is unusable.
    """
    limit = cache_limit_bytes()
    if limit == 0:
        return _new_patch(body, site, spec)
    key = patch_key(body, site, spec)
    try:
        path = cache_folder() / f"patch-{key}{_SUFFIX}"
    except (RuntimeError, OSError):  # no home folder
        return _new_patch(body, site, spec)
    try:
        patch = _read(path, key, site)
    except (FileNotFoundError, NotADirectoryError):
        patch = None
    except (OSError, ValueError, MemoryError) as error:
        why = error.strerror if isinstance(error, OSError) else error
        print(f"note: {path}: the terrain kept there is damaged ({why}); it is built again", file=sys.stderr)
        patch = None
    if patch is None:
        patch = _new_patch(body, site, spec)
        _write(path, key, patch, limit)
    return patch


def _new_patch(body: Body, site: Site, spec: PatchSpec) -> Patch:
    """Build a patch and report the activity."""
    activity.begin(f"terrain of site {site.index} (new patch)")
    return build_patch(body, site, spec)


def patch_key(body: Body, site: Site, spec: PatchSpec) -> str:
    """Return the sha256 (hex) of all that determines a patch."""
    content = {
        "code": _code_hash(),
        "body": [body.content_hash, body.density_kg_m3, body.rotation_period_s],
        "site": [site.index, site.position_T_m.tolist(), site.T_from_L.tolist()],
        "spec": dataclasses.asdict(spec),
    }
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


@lru_cache(maxsize=1)
def _code_hash() -> str:
    """Return the sha256 (hex) of the terrain sources, the library versions and the platform."""
    parts = hashlib.sha256()
    for name in _SOURCES:
        parts.update(Path(__file__).with_name(f"{name}.py").read_bytes())
    versions = [importlib.metadata.version(name) for name in _LIBRARIES]
    parts.update(json.dumps([versions, platform.machine(), sys.byteorder]).encode())
    return parts.hexdigest()


def _read(path: Path, key: str, site: Site) -> Patch:
    """Return the patch in a file.

    Raises ValueError if the file is damaged or has another key, and OSError if it cannot be read.
    """
    if not stat.S_ISREG(path.stat().st_mode):
        raise ValueError("not a regular file")
    data = np.fromfile(path, dtype=np.uint8)
    checksum = hashlib.sha256().digest_size
    if len(data) < _HEADER.size + checksum:
        raise ValueError("cut short")
    content = data[:-checksum]
    if hashlib.sha256(content.data).digest() != data[-checksum:].tobytes():
        raise ValueError("its checksum does not match")
    magic, length = _HEADER.unpack(data[: _HEADER.size].tobytes())
    if magic != _MAGIC:
        raise ValueError("another format")
    table = json.loads(data[_HEADER.size : _HEADER.size + length].tobytes())
    if table["key"] != key:
        raise ValueError("the terrain of another site or scene")
    arrays, start = {}, _aligned(_HEADER.size + length)
    for name, dtype, shape in table["arrays"]:
        count = int(np.prod(shape, dtype=np.int64)) * np.dtype(dtype).itemsize
        # `[()]` turns an array without axes into a number
        arrays[name] = data[start : start + count].view(dtype).reshape(shape)[()]
        start += _aligned(count)
    with contextlib.suppress(OSError):
        os.utime(path)  # marks the file as just used, so that it is evicted last
    return Patch(site=site, **arrays)


def _parts(key: str, patch: Patch) -> Iterator[bytes]:
    """Yield the content of a patch's file in parts; the checksum is the last part."""
    arrays = {name: np.asarray(getattr(patch, name)) for name in _ARRAYS}
    rows = [[name, array.dtype.str, array.shape] for name, array in arrays.items()]
    table = json.dumps({"key": key, "arrays": rows}).encode()
    total = hashlib.sha256()
    for part in (_HEADER.pack(_MAGIC, len(table)) + table, *(array.tobytes() for array in arrays.values())):
        padded = part.ljust(_aligned(len(part)), b"\0")
        total.update(padded)
        yield padded
    yield total.digest()


def _aligned(count: int) -> int:
    """Return a byte count rounded up to the alignment."""
    return -(-count // _ALIGNED_BYTES) * _ALIGNED_BYTES


def _write(path: Path, key: str, patch: Patch, limit_bytes: int) -> None:
    """Write the patch under another name, then rename it, so that a reader sees the whole file or none."""
    unfinished = None
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile(dir=path.parent, prefix="patch-", suffix=".part", delete=False) as file:
            unfinished = Path(file.name)
            for part in _parts(key, patch):
                file.write(part)
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path)
        os.replace(unfinished, path)
        unfinished = None
        _evict(path.parent, limit_bytes)
    except OSError as error:  # the folder is read-only or full, or another worker uses the file
        _warn_unwritable(path.parent, error.strerror or str(error))
    finally:
        if unfinished is not None:
            with contextlib.suppress(OSError):
                unfinished.unlink()


@lru_cache
def _warn_unwritable(folder: Path, why: str) -> None:
    """Tell the user, once in a process, that patches cannot be kept in a folder."""
    print(
        f"warning: {folder}: terrain cannot be kept there ({why}), so every run builds it again; "
        f"{FOLDER_VARIABLE} names another folder",
        file=sys.stderr,
    )


def _evict(folder: Path, limit_bytes: int) -> None:
    """Remove the least recently used files until the rest fits, and old unfinished files of killed processes."""
    kept = []
    for path in folder.glob("patch-*"):
        with contextlib.suppress(OSError):  # another worker may evict at the same time
            status = path.stat()
            if path.suffix in (_SUFFIX, ".npz"):  # .npz files are from earlier versions
                kept.append((status.st_mtime, status.st_size, path))
            elif path.suffix == ".part" and time.time() - status.st_mtime > _STALE_S:
                path.unlink()
    total = sum(size for _, size, _ in kept)
    for _, size, path in sorted(kept, key=lambda entry: (entry[0], entry[2].name)):
        if total <= limit_bytes:
            break
        with contextlib.suppress(OSError):
            path.unlink()
        total -= size
