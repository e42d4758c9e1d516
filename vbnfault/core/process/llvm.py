"""Find a libLLVM that Mitsuba's LLVM backend can use, before drjit or mitsuba is imported.

Mitsuba does not ship LLVM. Versions 14 and 15, the defaults of Debian 12, abort the whole process inside the
first render ("Cannot select … fminimum"), so versions below 16 are refused here with an error message. The C
function `LLVMGetVersion` is exported from version 16 on; a library without it is too old.

The search order is: `DRJIT_LIBLLVM_PATH` if usable, the wheel `karellen-llvm-core`, then the system's libraries,
newest first.
"""

from __future__ import annotations

import ctypes
import functools
import importlib.metadata
import math
import os
import re
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any, TypeVar

import numpy as np
from numpy.typing import DTypeLike, NDArray

from ..errors import VbnfaultError

T = TypeVar("T", bound=np.generic)

OLDEST_USABLE = 16
VARIABLE = "DRJIT_LIBLLVM_PATH"
_WHEEL = "karellen-llvm-core"
_ALIGNED_BYTES, _LANES = 64, 16

_SYSTEM_PATTERNS = {
    "linux": (
        ("/usr/lib", "llvm-*/lib/libLLVM*.so*"),
        ("/usr/lib", "*-linux-gnu/libLLVM*.so*"),
        ("/usr/lib64", "libLLVM*.so*"),
        ("/usr/lib64", "llvm*/lib*/libLLVM*.so*"),
        ("/usr/lib", "libLLVM*.so*"),
        ("/usr/local/lib", "libLLVM*.so*"),
    ),
    "darwin": (
        ("/opt/homebrew/opt", "llvm*/lib/libLLVM*.dylib"),
        ("/usr/local/opt", "llvm*/lib/libLLVM*.dylib"),
    ),
}


@dataclass(frozen=True, kw_only=True)
class Candidate:
    """Describe one library that was inspected.

    `version` is (major, minor, patch), or None where it is unknown. `problem` is empty for a usable library.
    """

    path: Path
    origin: str
    version: tuple[int, int, int] | None
    problem: str

    @property
    def usable(self) -> bool:
        """Return whether Mitsuba can use the library."""
        return not self.problem


def candidates() -> Iterator[Candidate]:
    """Yield every library in the order of preference, each with its version and its problem."""
    seen: set[Path] = set()
    for origin, path in _paths():
        resolved = path.resolve()
        if resolved in seen:
            continue
        seen.add(resolved)
        yield _inspect(path, origin)


def find() -> Candidate:
    """Return the first usable library. Raises VbnfaultError, which lists the unusable ones and their problems."""
    candidates_seen = []
    for candidate in candidates():
        if candidate.usable:
            return candidate
        candidates_seen.append(f"{candidate.path} ({candidate.problem})")
    seen = "; ".join(candidates_seen) if candidates_seen else "none found"
    raise VbnfaultError(
        f"no usable LLVM: rendering needs libLLVM {OLDEST_USABLE} or newer, {seen}; install one with "
        f"'pip install {_WHEEL}' (Linux x86-64) or your system's package, or set {VARIABLE} to its path"
    )


@functools.lru_cache(maxsize=1)
def prepare() -> Candidate:
    """Point drjit to a usable library. Call this before drjit or mitsuba is imported. Raises VbnfaultError."""
    library = find()
    os.environ[VARIABLE] = str(library.path)
    return library


@functools.lru_cache(maxsize=1)
def backend() -> Any:
    """Return drjit as `dr` and its array types for the LLVM backend, on a usable library. Raises VbnfaultError."""
    prepare()
    import drjit
    import drjit.llvm as types

    names = ("Float", "Float64", "UInt8", "UInt32", "Int32", "UInt64", "Int64", "Array4u")
    return SimpleNamespace(dr=drjit, **{name: getattr(types, name) for name in names})


@functools.lru_cache(maxsize=1)
def use_one_thread() -> None:
    """Run kernels in the calling thread alone, as one of several processes that share the cores.

    A thread of drjit that waits for work keeps its core busy for a while. A forked process has no such thread where
    its parent loaded the backend; to end it there would wait for ever.
    """
    if not backend.cache_info().currsize:
        backend().dr.set_thread_count(0)


def flat(array: NDArray[T]) -> NDArray[T]:
    """Return an array, or a copy of it, in one dimension and beginning at a multiple of 16 numbers and 64 bytes.

    drjit uses numpy's memory as it is, and compiles another kernel for each set of arrays that begin elsewhere. Its
    kernels also read past the end, up to the next 16 numbers. From such a place on, these lie in the same page of
    memory as the last number; from others they may lie in a page that is not there, which ends the process.
    """
    step = max(_ALIGNED_BYTES, _LANES * array.itemsize)
    if array.flags.c_contiguous and array.ctypes.data % step == 0:
        return array.reshape(-1)
    out: NDArray[T] = empty(array.shape, array.dtype)
    out[...] = array
    return out.reshape(-1)


def empty(shape: tuple[int, ...], dtype: DTypeLike = np.float32) -> NDArray[Any]:
    """Return an array to write to which `flat` does not copy."""
    size = np.dtype(dtype).itemsize * math.prod(shape)
    step = max(_ALIGNED_BYTES, _LANES * np.dtype(dtype).itemsize)
    memory = np.empty(size + step, np.uint8)
    start = -memory.ctypes.data % step
    return memory[start : start + size].view(dtype).reshape(shape)


def on_device(array: NDArray[Any]) -> Any:
    """Return real numbers of any shape as a device array, Float, in their order."""
    return backend().Float(flat(np.asarray(array, dtype=np.float32)))


def evaluated(array: Any) -> NDArray[Any]:
    """Return the values of a device array, once its kernel has run, in the memory of the device array."""
    dr = backend().dr
    dr.eval(array)
    dr.sync_thread()
    return np.array(array, copy=False)


def _paths() -> Iterator[tuple[str, Path]]:
    """Yield the origin and the path of every library file to inspect, in the order of preference."""
    if os.environ.get(VARIABLE):
        yield VARIABLE, Path(os.environ[VARIABLE])
    yield from ((_WHEEL, path) for path in _wheel_files("libLLVM.so"))
    system = {
        path for folder, pattern in _SYSTEM_PATTERNS.get(sys.platform, ()) for path in Path(folder).glob(pattern)
    }
    yield from (("system", path) for path in sorted(system, key=_name_version, reverse=True))


def _wheel_files(stem: str) -> list[Path]:
    """Return the wheel's files whose names begin with `stem`, without the links that its start-up hook makes."""
    try:
        files = importlib.metadata.files(_WHEEL) or []
    except importlib.metadata.PackageNotFoundError:
        return []
    paths = (Path(str(f.locate())).resolve() for f in files if f.name.startswith(stem))
    return sorted({p for p in paths if p.is_file() and not p.is_symlink() and ".json" not in p.suffixes})


def _name_version(path: Path) -> tuple[int, ...]:
    """Return the numbers in a path, which sort libraries by version; the 64 of an architecture is left out."""
    numbers = re.findall(r"\d+", str(path).replace("x86_64", "").replace("64", ""))
    return tuple(int(n) for n in numbers)


def _inspect(path: Path, origin: str) -> Candidate:
    """Return a candidate; libraries whose name gives an old version are not loaded."""
    version, problem = _version(path, origin) if path.is_file() else (None, "no such file")
    if version is not None and version[0] < OLDEST_USABLE:
        problem = f"version {version[0]} aborts the first render"
    return Candidate(path=path, origin=origin, version=version, problem=problem)


def _version(path: Path, origin: str) -> tuple[tuple[int, int, int] | None, str]:
    """Return the version that a library's name or the library itself states, or None and what is wrong with it."""
    by_name = re.search(r"libLLVM[.-](?:so\.)?(\d+)", path.resolve().name)
    if by_name and int(by_name[1]) < OLDEST_USABLE:
        return (int(by_name[1]), 0, 0), ""
    try:
        get_version = _load(path, origin).LLVMGetVersion
    except OSError as error:
        return None, f"does not load: {error}"
    except AttributeError:
        return None, f"older than {OLDEST_USABLE}, or no LLVM: it exports no LLVMGetVersion"
    parts = [ctypes.c_uint() for _ in range(3)]
    get_version(*map(ctypes.byref, parts))
    return (parts[0].value, parts[1].value, parts[2].value), ""


def _load(path: Path, origin: str) -> ctypes.CDLL:
    """Load a library. Where the wheel's library fails, load its dependencies first and try again."""
    try:
        return ctypes.CDLL(str(path))
    except OSError:
        if origin != _WHEEL and path.resolve() not in _wheel_files("libLLVM.so"):
            raise
    # Where site-packages is read-only, the wheel's start-up hook cannot link libc++.so.1. If the real files are
    # loaded globally first, the loader resolves their names.
    for stem in ("libunwind.so.1", "libc++abi.so.1", "libc++.so.1"):
        for dependency in _wheel_files(stem)[:1]:
            ctypes.CDLL(str(dependency), mode=ctypes.RTLD_GLOBAL)
    return ctypes.CDLL(str(path))
