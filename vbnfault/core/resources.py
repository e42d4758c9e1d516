"""The one loader of every file that a user names, and where the packaged scenes and textures lie.

A file is read once, by `read_input`, which refuses all that is no regular file of a reasonable size: nothing that
a user names can block, or fill the memory, before the first byte is parsed. What has to be read by a library that
takes only paths (SPICE's kernels) goes through `check_input`.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import stat
import sys
import tomllib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextvars import ContextVar
from functools import lru_cache, wraps
from pathlib import Path
from typing import Any, BinaryIO, TypeVar

from .errors import InputChanged, InputError, shown

_PACKAGE = Path(__file__).resolve().parents[1]

MIB = 1 << 20
# Kind of file → the most bytes it may have: of a shape as text, some 12 million facets; of the others, ten times
# what the largest files in use have.
LIMIT_BYTES: dict[str, int] = {
    "scene": 4 * MIB,
    "lens": 4 * MIB,
    "detector": 4 * MIB,
    "shape": 1024 * MIB,
    "spacecraft": 512 * MIB,
    "texture": 256 * MIB,
    "SPICE kernel": 8192 * MIB,
    "star catalogue": 64 * MIB,
    "SPICE text kernel": 256 * MIB,
}
_DEEPEST_TABLE = 24
_LONGEST_NAME_BYTES = 255
_LONGEST_PATH_BYTES = 4095
_READ_BYTES = 16 * MIB
# What an environment variable or option may ask for: more than any machine has.
MOST_THREADS = 4096


def read_input(path: str | Path, what: str, *, types: Sequence[str] = (), limit_bytes: int | None = None) -> bytes:
    """Return the bytes of a file that a user names, read once.

    Parameters
    ----------
    path
        Of a regular file; a link to one is followed.
    what
        Kind of file, which names it in errors and gives its limit: a key of `LIMIT_BYTES`.
    types
        Suffixes in lower case; where some are given, the file has one of them.
    limit_bytes
        Most bytes of the file; default: that of its kind.

    Raises
    ------
    InputError
        The file is missing, unreadable, empty or too large, no regular file (a folder, a device, a pipe) or of
        another type.
    """
    limit = LIMIT_BYTES[what] if limit_bytes is None else limit_bytes
    with _opened(Path(path), what, types, limit) as file:
        try:
            data = file.read(limit + 1)  # one more than allowed: its size may have been a lie, or grown
        except OSError as error:
            raise InputError(f"{path}: {what} file cannot be read: {error.strerror}.") from None
    if len(data) > limit:
        raise _too_large(Path(path), what, len(data), limit)
    _check_contents(path, what, lambda: sha256(data))
    return data


def check_input(path: str | Path, what: str, *, types: Sequence[str] = ()) -> None:
    """Check a file that a library will read by its path, as `read_input` does. Raises InputError."""
    with _opened(Path(path), what, types, LIMIT_BYTES[what]) as file:
        _check_contents(path, what, lambda: _sha256_of(file), os.fstat(file.fileno()))


def head_of_input(path: str | Path, what: str, size_bytes: int) -> bytes:
    """Return the first bytes of a file that a user names, which tell how to read it. Raises InputError."""
    with _opened(Path(path), what, (), LIMIT_BYTES[what]) as file:
        return file.read(size_bytes)


def sha256(data: bytes) -> str:
    """Return the SHA-256 (hex) of a file's bytes as `read_input` gave them."""
    return hashlib.sha256(data).hexdigest()


def sha256_of_input(path: str | Path, what: str) -> str:
    """Return the SHA-256 (hex) of a file that is too large to be kept in memory. Raises InputError."""
    with _opened(Path(path), what, (), LIMIT_BYTES[what]) as file:
        return _sha256_of(file)


def _sha256_of(file: BinaryIO) -> str:
    digest = hashlib.sha256()
    while data := file.read(_READ_BYTES):
        digest.update(data)
    return digest.hexdigest()


def _opened(path: Path, what: str, types: Sequence[str], limit_bytes: int) -> BinaryIO:
    """An open file that is regular, of one of `types` and neither empty nor too large."""
    try:
        return _opened_now(path, what, types, limit_bytes)
    except InputError as error:
        contents = _in_use.get()
        if contents is not None and contents.knows(path):
            raise _changed(f"{error}", path, what) from None
        raise


def _opened_now(path: Path, what: str, types: Sequence[str], limit_bytes: int) -> BinaryIO:
    status = file_status(path)
    if status is None:
        raise InputError(f"{shown_path(path)}: {what} file not found.")
    if not stat.S_ISREG(status.st_mode):  # before opening: to open a device may already act on it
        raise InputError(f"{path}: {what} is not a file{_kind(status)}.")
    if types and path.suffix.lower() not in types:
        raise InputError(
            f"{path}: unsupported {what} type {path.suffix.lower()!r}; allowed are {', '.join(types)}."
        )
    try:
        # Without waiting: the name may have become a pipe's in between.
        flags = (
            os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0) | getattr(os, "O_CLOEXEC", 0)
        )
        file = os.fdopen(os.open(path, flags), "rb")
    except OSError as error:
        raise InputError(f"{path}: {what} file cannot be read: {error.strerror}.") from None
    try:
        status = os.fstat(file.fileno())
        if not stat.S_ISREG(status.st_mode):
            raise InputError(f"{path}: {what} is not a file{_kind(status)}.")
        if status.st_size == 0:
            raise InputError(f"{path}: {what} file is empty.")
        if status.st_size > limit_bytes:
            raise _too_large(path, what, status.st_size, limit_bytes)
    except BaseException:
        file.close()
        raise
    return file


# --- what files held when a run was planned -------------------------------------------------------------------


class Contents:
    """Record the digests of the files that a run reads, and compare every later reading with the first.

    One object serves a run from its planning to its last worker process; pickled, it carries the digests along.
    Once `complete`, a file that was not read before is refused as well, except where it belongs to vbnfault.
    """

    def __init__(self) -> None:
        self._sha256: dict[str, str] = {}
        self._status: dict[str, tuple[int, ...]] = {}  # of files too large to be hashed at every reading
        self._complete = False

    def __getstate__(self) -> dict[str, Any]:
        return {**vars(self), "_status": {}}  # another machine's

    def complete(self) -> None:
        """Note that the run is planned: all its files have been read."""
        self._complete = True

    def knows(self, path: str | Path) -> bool:
        """Whether the file has been read before."""
        return _key(path) in self._sha256

    @contextlib.contextmanager
    def in_use(self) -> Iterator[None]:
        """Compare what is read within a block, in this thread."""
        before = _in_use.set(self)
        try:
            yield
        finally:
            _in_use.reset(before)

    def check(self, path: str | Path, what: str, digest: Callable[[], str], status: os.stat_result | None) -> None:
        """Check what a file holds. Raises InputChanged."""
        key = _key(path)
        now = None if status is None else (status.st_dev, status.st_ino, status.st_size, status.st_mtime_ns)
        if now is not None and self._status.get(key) == now:
            return
        found = digest()
        if key not in self._sha256 and self._complete and not key.startswith(_OWN):
            raise _changed(f"{path}: {what} file was not there, or not used, when the build began", path, what)
        if self._sha256.setdefault(key, found) != found:
            raise _changed(f"{path}: {what} file has changed since the build began", path, what)
        if now is not None:
            self._status[key] = now


_in_use: ContextVar[Contents | None] = ContextVar("contents", default=None)
_noted: ContextVar[list[str] | None] = ContextVar("noted", default=None)
_OWN = "vbnfault:"


def _key(path: str | Path) -> str:
    """What a file is called on every machine: vbnfault's own ones lie elsewhere on each."""
    absolute = os.path.abspath(path)
    for root in (_PACKAGE, _PACKAGE.parent):
        for kind in ("scenes", "textures", "catalogues"):
            if absolute.startswith(f"{root / kind}{os.sep}"):
                return _OWN + os.path.relpath(absolute, root)
    return absolute


def _changed(sentence: str, path: str | Path, what: str) -> InputChanged:
    return InputChanged(
        f"{sentence.rstrip('.')}; finished samples stay: put the {what} file of before back and repeat the "
        "command, or build the changed scene elsewhere"
    )


def _check_contents(
    path: str | Path, what: str, digest: Callable[[], str], status: os.stat_result | None = None
) -> None:
    contents, noted = _in_use.get(), _noted.get()
    if contents is not None:
        contents.check(path, what, digest, status)
    if noted is not None:
        noted.append(digest())


@contextlib.contextmanager
def noting() -> Iterator[list[str]]:
    """Give a list that grows by the SHA-256 of every file that is read within a block, in order."""
    digests: list[str] = []
    before = _noted.set(digests)
    try:
        yield digests
    finally:
        _noted.reset(before)


_R = TypeVar("_R")


def cached_with_contents(maxsize: int) -> Callable[[Callable[..., _R]], Callable[..., _R]]:
    """Return a decorator like `lru_cache` for functions of a file's name: what one run has read serves no other."""

    def decorate(function: Callable[..., _R]) -> Callable[..., _R]:
        @lru_cache(maxsize=maxsize)
        def cached(_contents: Contents | None, /, *args: Any) -> _R:
            return function(*args)

        @wraps(function)
        def wrapper(*args: Any) -> _R:
            return cached(_in_use.get(), *args)

        return wrapper

    return decorate


def _too_large(path: Path, what: str, size_bytes: int, limit_bytes: int) -> InputError:
    return InputError(
        f"{path}: {what} file has {size_bytes / MIB:.3g} MiB or more; at most {limit_bytes / MIB:g} MiB are read."
    )


def _kind(status: os.stat_result) -> str:
    kinds = {
        stat.S_IFDIR: "a folder",
        stat.S_IFIFO: "a pipe",
        stat.S_IFCHR: "a device",
        stat.S_IFBLK: "a device",
        stat.S_IFSOCK: "a socket",
    }
    kind = kinds.get(stat.S_IFMT(status.st_mode))
    return f" but {kind}" if kind else ""


def environment_whole(name: str, high: int) -> int:
    """Return the whole number of an environment variable, 0 where it is not set. Raises InputError outside 0 to
    `high`."""
    text = os.environ.get(name, "").strip() or "0"
    if not (text.isascii() and text.isdigit() and len(text) < 20 and int(text) <= high):
        raise InputError(f"{name} = {shown(text)}: must be a whole number from 0 to {high}")
    return int(text)


def file_status(path: str | Path) -> os.stat_result | None:
    """Return what the file system says of a path; None where it has nothing of that name, or could have nothing."""
    try:
        return os.stat(path)
    except (OSError, ValueError):  # ValueError: a NUL, or characters that no file system takes
        return None


def check_path(path: str, where: str) -> None:
    """Check that a path can be one. Raises InputError whose sentence begins with `where`, the key that names it."""
    try:
        name = os.fsencode(path)
    except UnicodeEncodeError:
        raise InputError(f"{where} = {shown(path)}: must be a path, without lone surrogates") from None
    if b"\0" in name:
        raise InputError(f"{where} = {shown(path)}: must be a path, without NUL characters")
    longest = max(map(len, name.replace(os.sep.encode(), b"/").split(b"/")))
    if longest > _LONGEST_NAME_BYTES or len(name) > _LONGEST_PATH_BYTES:
        raise InputError(
            f"{where} = {shown(path)}: must be a path of at most {_LONGEST_PATH_BYTES} bytes and each of its "
            f"names of at most {_LONGEST_NAME_BYTES}"
        )


def absolute(path: str | Path, where: str) -> str:
    """Return a path from the root, links followed. Raises InputError whose sentence begins with the key `where`."""
    check_path(str(path), where)
    try:
        return str(Path(path).resolve())
    except (OSError, RuntimeError):  # links in a circle, a working folder that is gone
        raise InputError(f"{where} = {shown(str(path))}: no such file") from None


def shown_path(path: str | Path) -> str:
    """Return a path as an error sentence begins with it: as given, or shortened and quoted where it is long or
    cannot be printed."""
    text = str(path)
    return text if len(text) <= 500 and text.isprintable() else shown(text)


def read_toml(path: Path, what: str = "scene") -> dict[str, Any]:
    """Return a TOML file as plain data; `what` is its kind. Raises InputError."""
    data = read_input(path, what)
    try:
        return parse_toml(data.decode("utf-8-sig"), str(path))
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: not a TOML file: {error.reason} at byte {error.start}") from None


def parse_toml(text: str, source: str) -> dict[str, Any]:
    """Return a TOML text as plain data, nested at most 24 deep, its whole numbers of at most 64 bits.

    Raises InputError in a sentence that begins with `source`; `tomllib.TOMLDecodeError` never leaves it.
    """
    try:
        table = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise InputError(f"{source}: not a TOML file: {error}") from None
    except RecursionError:
        raise InputError(f"{source}: nested deeper than {_DEEPEST_TABLE} tables or lists") from None
    except ValueError:  # Python's own limit on the digits of a number, dates that no calendar has
        raise InputError(
            f"{source}: not a TOML file: a number or date is out of range; whole numbers have at most 64 bits"
        ) from None
    check_plain(table, source)
    return table


def check_plain(table: Mapping[str, Any], source: str) -> None:
    """Check that plain data are nested at most 24 deep and hold no whole number beyond 64 bits.

    Raises InputError in a sentence that begins with `source`.
    """
    level: list[tuple[str, Any]] = [("", table)]
    for _ in range(_DEEPEST_TABLE):
        below: list[tuple[str, Any]] = []
        for where, node in level:
            items = node.items() if isinstance(node, Mapping) else enumerate(node)
            for key, value in items:
                if isinstance(value, Mapping | list | tuple):
                    below.append((f"{where}{_shown_key(key)}.", value))
                elif isinstance(value, int) and not -(2**63) <= value < 2**64:
                    at = f"{where}{_shown_key(key)}"
                    raise InputError(f"{source}: {at} = {shown(value)}: must be a whole number of at most 64 bits")
        level = below
        if not level:
            return
    where = level[0][0].rstrip(".")
    raise InputError(f"{source}: {where}: nested deeper than {_DEEPEST_TABLE} tables or lists")


def _shown_key(key: object) -> str:
    return str(key) if isinstance(key, int) else shown_path(str(key))


def import_path() -> list[str]:
    """Return the import path for a process that this one starts: its own, without the working folder.

    Python puts the working folder first under `python -m` and at the prompt: a file `random.py` among a user's data
    would be run. It stays where PYTHONPATH names it, and last where vbnfault itself lies in it.
    """
    here, package = os.path.realpath(os.getcwd()), os.path.realpath(_PACKAGE.parent)
    wanted = {os.path.realpath(p) for p in os.environ.get("PYTHONPATH", "").split(os.pathsep) if p}
    path = [p for p in sys.path if isinstance(p, str) and (os.path.realpath(p or here) != here or here in wanted)]
    return [*path, package] if here == package and here not in wanted else path


def data_dir(kind: str) -> Path:
    """The folder `scenes` or `textures`; raises InputError where the installation lacks it."""
    for candidate in (_PACKAGE / kind, _PACKAGE.parent / kind):
        if candidate.is_dir():
            return candidate
    raise InputError(f"{kind}: the folder is missing from this installation of vbnfault; install it again")


def packaged(kind: str) -> dict[str, Path]:
    """Name → path of every packaged TOML of a kind: `scenes`, `scenes/lenses`, `scenes/detectors`."""
    top, *rest = kind.split("/")
    folder = data_dir(top).joinpath(*rest)
    return {p.stem: p for p in sorted(folder.glob("*.toml"))}


def find(kind: str, name_or_path: str | Path) -> Path:
    """A path as given, or the packaged file of that name. Raises InputError listing the packaged names."""
    path = Path(name_or_path)
    what = kind.rsplit("/", 1)[-1]
    check_path(str(name_or_path), what)
    status = file_status(path)
    if path.suffix or status:
        if status and stat.S_ISREG(status.st_mode):
            return path
        raise InputError(f"{shown_path(path)}: no such file{',' + _kind(status) if status else ''}")
    known = packaged(kind)
    if str(name_or_path) in known:
        return known[str(name_or_path)]
    raise InputError(f"{shown_path(name_or_path)}: neither a file nor a packaged name; {what}: {', '.join(known)}")
