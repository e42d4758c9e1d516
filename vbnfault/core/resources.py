"""Load every file that a user names, and find the packaged scenes and textures.

`read_input` reads a file once. It refuses everything but a regular file of reasonable size, so that no file can
block the program or fill the memory before the first byte is parsed. `check_input` checks a file that a library
must read by its path, such as a SPICE kernel.
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

import tomli_w

from .errors import InputChanged, InputError, shown

_PACKAGE = Path(__file__).resolve().parents[1]

MIB = 1 << 20
# Kind of file → the most bytes it may have. A shape as text then has some 12 million facets; the other limits are
# ten times the size of the largest files in use.
LIMIT_BYTES: dict[str, int] = {
    "scene": 4 * MIB,
    "study": 4 * MIB,
    "lens": 4 * MIB,
    "glass catalogue": 16 * MIB,
    "detector": 4 * MIB,
    "shape": 1024 * MIB,
    "spacecraft": 512 * MIB,
    "texture": 256 * MIB,
    "data": 1024 * MIB,
    "plug-in": 64 * MIB,
    "SPICE kernel": 8192 * MIB,
    "star catalogue": 64 * MIB,
    "SPICE text kernel": 256 * MIB,
}
_DEEPEST_TABLE = 24
_LONGEST_NAME_BYTES = 255
_LONGEST_PATH_BYTES = 4095
_READ_BYTES = 16 * MIB
# The most threads that an environment variable or option may ask for: more than any machine has.
MOST_THREADS = 4096


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
            data = file.read(limit + 1)  # one more than allowed: the size may be wrong, or have grown
        except OSError as error:
            raise InputError(f"{path}: {what} file cannot be read: {error.strerror}.") from None
    if len(data) > limit:
        raise _too_large(Path(path), what, len(data), limit)
    _check_contents(path, what, lambda: sha256(data))
    return data


def check_input(path: str | Path, what: str, *, types: Sequence[str] = ()) -> None:
    """Check a file, as `read_input` does, that a library will read by its path. Raises InputError, InputChanged."""
    with _opened(Path(path), what, types, LIMIT_BYTES[what]) as file:
        _check_contents(path, what, lambda: _sha256_of(file), os.fstat(file.fileno()))


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


def _sha256_of(file: BinaryIO) -> str:
    """Return the SHA-256 (hex) of an open file, read in pieces."""
    digest = hashlib.sha256()
    while data := file.read(_READ_BYTES):
        digest.update(data)
    return digest.hexdigest()


def _opened(path: Path, what: str, types: Sequence[str], limit_bytes: int) -> BinaryIO:
    """Return an open, regular file of one of `types`, neither empty nor too large. Raises InputError."""
    try:
        return _opened_now(path, what, types, limit_bytes)
    except InputError as error:
        contents = _in_use.get()
        if contents is not None and contents.knows(path):
            raise _changed(f"{error}", path, what) from None
        raise


def _opened_now(path: Path, what: str, types: Sequence[str], limit_bytes: int) -> BinaryIO:
    """Return the open file as `_opened` does, but without comparing it with an earlier reading."""
    status = file_status(path)
    if status is None:
        raise InputError(f"{shown_path(path)}: {what} file {_why_absent(path)}.")
    if not stat.S_ISREG(status.st_mode):  # before opening: opening a device may already act on it
        raise InputError(f"{path}: {what} is not a file{_kind(status)}.")
    if types and path.suffix.lower() not in types:
        raise InputError(
            f"{path}: unsupported {what} type {path.suffix.lower()!r}; allowed are {', '.join(types)}."
        )
    try:
        # O_NONBLOCK, since the name may belong to a pipe by now, which would block.
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


# --- contents of files when a run was planned -----------------------------------------------------------------


class Contents:
    """Record the digests of the files that a run reads, and compare every later reading with the first.

    One object serves a run from its planning to its last worker process; pickling keeps the digests. After
    `complete`, a file that was not read before is refused too, unless it belongs to vbnfault.
    """

    def __init__(self) -> None:
        self._sha256: dict[str, str] = {}
        self._status: dict[str, tuple[int, ...]] = {}  # of files too large to hash at every reading
        self._complete = False

    def __getstate__(self) -> dict[str, Any]:
        return {**vars(self), "_status": {}}  # it holds on one machine only

    def complete(self) -> None:
        """Record that the run is planned: by now, all its files have been read."""
        self._complete = True

    def knows(self, path: str | Path) -> bool:
        """Return whether the file has been read before."""
        return _key(path) in self._sha256

    @contextlib.contextmanager
    def in_use(self) -> Iterator[None]:
        """Compare every file that this thread reads within a block with the first reading."""
        before = _in_use.set(self)
        try:
            yield
        finally:
            _in_use.reset(before)

    def check(self, path: str | Path, what: str, digest: Callable[[], str], status: os.stat_result | None) -> None:
        """Compare a file's digest with its first one. Raises InputChanged.

        `status` is given for a large file: its digest is then computed only where the status has changed.
        """
        key = _key(path)
        status_now = None if status is None else (status.st_dev, status.st_ino, status.st_size, status.st_mtime_ns)
        if status_now is not None and self._status.get(key) == status_now:
            return
        digest_now = digest()
        if key not in self._sha256 and self._complete and not key.startswith(_OWN):
            raise _changed(f"{path}: {what} file was not there, or not used, when the build began", path, what)
        if self._sha256.setdefault(key, digest_now) != digest_now:
            raise _changed(f"{path}: {what} file has changed since the build began", path, what)
        if status_now is not None:
            self._status[key] = status_now


_in_use: ContextVar[Contents | None] = ContextVar("contents", default=None)
_noted: ContextVar[list[str] | None] = ContextVar("noted", default=None)
_OWN = "vbnfault:"


def _key(path: str | Path) -> str:
    """Return the absolute path, or for vbnfault's own files a relative one that is the same on every machine."""
    absolute = os.path.abspath(path)
    for root in (_PACKAGE, _PACKAGE.parent):
        for kind in ("scenes", "textures", "catalogues"):
            if absolute.startswith(f"{root / kind}{os.sep}"):
                return _OWN + os.path.relpath(absolute, root)
    return absolute


def _changed(sentence: str, path: str | Path, what: str) -> InputChanged:
    """Return the error that says what changed, and what to do next."""
    return InputChanged(
        f"{sentence.rstrip('.')}; finished samples stay: put the {what} file of before back and repeat the "
        "command, or build the changed scene elsewhere"
    )


def _check_contents(
    path: str | Path, what: str, digest: Callable[[], str], status: os.stat_result | None = None
) -> None:
    """Pass the digest of a file to the `Contents` in use and to `noting`, where they are active."""
    contents, noted = _in_use.get(), _noted.get()
    if contents is not None:
        contents.check(path, what, digest, status)
    if noted is not None:
        noted.append(digest())


@contextlib.contextmanager
def noting() -> Iterator[list[str]]:
    """Yield a list to which every file that is read within a block appends its SHA-256 (hex), in order."""
    digests: list[str] = []
    before = _noted.set(digests)
    try:
        yield digests
    finally:
        _noted.reset(before)


_R = TypeVar("_R")


def cached_with_contents(maxsize: int) -> Callable[[Callable[..., _R]], Callable[..., _R]]:
    """Return a decorator like `lru_cache` for functions of file names; each run (`Contents`) has its own cache."""

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
    """Return the error that states a file's size and its limit."""
    return InputError(
        f"{path}: {what} file has {size_bytes / MIB:.3g} MiB or more; at most {limit_bytes / MIB:g} MiB are read."
    )


def _kind(status: os.stat_result) -> str:
    """Return " but a folder" or the like for something that is no regular file, empty for other things."""
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
    """Return the whole number in an environment variable, 0 where it is unset or empty.

    Raises InputError unless it is a whole number from 0 to `high`.
    """
    text = os.environ.get(name, "").strip() or "0"
    if not (text.isascii() and text.isdigit() and len(text) < 20 and int(text) <= high):
        raise InputError(f"{name} = {shown(text)}: must be a whole number from 0 to {high}")
    return int(text)


def file_status(path: str | Path) -> os.stat_result | None:
    """Return the file system's status of a path; None where nothing exists there or the path is impossible."""
    try:
        return os.stat(path)
    except (OSError, ValueError):  # ValueError: the path holds a NUL, or lone surrogates
        return None


def _why_absent(path: Path) -> str:
    """Return as a clause why a path has no status: nothing exists there, or this user may not look."""
    try:
        os.stat(path)
    except PermissionError as error:
        return f"cannot be read: {error.strerror}"
    except (OSError, ValueError):
        pass
    return "not found"


def check_path(path: str, where: str) -> None:
    """Check that a path is possible. Raises InputError; its message begins with `where`, the key of the path."""
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
    """Return the absolute path with links resolved. Raises InputError; its message begins with the key `where`."""
    check_path(str(path), where)
    try:
        return str(Path(path).resolve())
    except (OSError, RuntimeError):  # links in a circle, a working folder that is gone
        raise InputError(f"{where} = {shown(str(path))}: no such file") from None


def shown_path(path: str | Path) -> str:
    """Return a path for the beginning of an error message.

    The path is unchanged, or shortened and quoted where it is long or cannot be printed.
    """
    text = str(path)
    return text if len(text) <= 500 and text.isprintable() else shown(text)


def read_toml(path: Path, what: str = "scene") -> dict[str, Any]:
    """Return a TOML file as plain data; `what` is its kind, a key of `LIMIT_BYTES`. Raises InputError."""
    data = read_input(path, what)
    try:
        return parse_toml(data.decode("utf-8-sig"), str(path))
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: not a TOML file: {error.reason} at byte {error.start}") from None


def parse_toml(text: str, source: str) -> dict[str, Any]:
    """Return a TOML text as plain data, nested at most 24 deep and with whole numbers of at most 64 bits.

    Raises InputError, never `tomllib.TOMLDecodeError`; the message begins with `source`.
    """
    try:
        table = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise InputError(f"{source}: not a TOML file: {error}") from None
    except RecursionError:
        raise InputError(f"{source}: nested deeper than {_DEEPEST_TABLE} tables or lists") from None
    except ValueError:  # a number of too many digits for Python, or a date that does not exist
        raise InputError(
            f"{source}: not a TOML file: a number or date is out of range; whole numbers have at most 64 bits"
        ) from None
    check_plain(table, source)
    return table


def toml_text(table: Mapping[str, Any]) -> str:
    """Return plain data as a TOML text. A lone surrogate, as in a path, becomes a question mark: UTF-8 has none."""
    return tomli_w.dumps(table).encode("utf-8", "replace").decode()


def check_plain(table: Mapping[str, Any], source: str) -> None:
    """Check that plain data is nested at most 24 deep and holds no whole number of more than 64 bits.

    Raises InputError; the message begins with `source`.
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
                    path = f"{where}{_shown_key(key)}"
                    raise InputError(
                        f"{source}: {path} = {shown(value)}: must be a whole number of at most 64 bits"
                    )
        level = below
        if not level:
            return
    where = level[0][0].rstrip(".")
    raise InputError(f"{source}: {where}: nested deeper than {_DEEPEST_TABLE} tables or lists")


def _shown_key(key: object) -> str:
    """Return a key, or the index of a list, for an error message."""
    return str(key) if isinstance(key, int) else shown_path(str(key))


def import_path() -> list[str]:
    """Return the import path for a process that this one starts: this one's path without the working folder.

    Under `python -m` and at the prompt, Python puts the working folder first, so that it would run a file
    `random.py` among a user's data. The working folder stays in the path where PYTHONPATH names it, or where it
    follows the standard library, as an editable installation from this folder has it. Where it holds vbnfault
    itself, it moves to the end.
    """
    here, package = os.path.realpath(os.getcwd()), os.path.realpath(_PACKAGE.parent)
    wanted = {os.path.realpath(p) for p in os.environ.get("PYTHONPATH", "").split(os.pathsep) if p}
    library, after_library, path = os.path.realpath(os.path.dirname(os.__file__)), False, []
    for entry in (p for p in sys.path if isinstance(p, str)):
        where = os.path.realpath(entry or here)
        after_library |= where == library
        if where != here or here in wanted or after_library:
            path.append(entry)
    return [*path, package] if here == package and here not in wanted else path


def data_dir(kind: str) -> Path:
    """Return the folder `scenes` or `textures`. Raises InputError where the installation lacks it."""
    for candidate in (_PACKAGE / kind, _PACKAGE.parent / kind):
        if candidate.is_dir():
            return candidate
    raise InputError(f"{kind}: the folder is missing from this installation of vbnfault; install it again")


def packaged(kind: str) -> dict[str, Path]:
    """Return name → path of every packaged TOML of a kind: `scenes`, `scenes/lenses`, `scenes/detectors`."""
    top, *rest = kind.split("/")
    folder = data_dir(top).joinpath(*rest)
    return {p.stem: p for p in sorted(folder.glob("*.toml"))}


def find(kind: str, name_or_path: str | Path) -> Path:
    """Return the path as given, or the packaged file of that name. Raises InputError, which lists these names."""
    path = Path(name_or_path)
    what = kind.rsplit("/", 1)[-1]
    check_path(str(name_or_path), what)
    status = file_status(path)
    if path.suffix or status:
        if status and stat.S_ISREG(status.st_mode):
            return path
        if status is None and (why := _why_absent(path)) != "not found":
            raise InputError(f"{shown_path(path)}: {why}")
        raise InputError(f"{shown_path(path)}: no such file{',' + _kind(status) if status else ''}")
    known = packaged(kind)
    if str(name_or_path) in known:
        return known[str(name_or_path)]
    raise InputError(f"{shown_path(name_or_path)}: neither a file nor a packaged name; {what}: {', '.join(known)}")
