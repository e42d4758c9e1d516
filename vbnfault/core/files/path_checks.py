"""Check the paths that a user names, and show them in error messages."""

from __future__ import annotations

import os
import stat
from pathlib import Path

from ..errors import InputError, shown

_LONGEST_NAME_BYTES = 255
_LONGEST_PATH_BYTES = 4095


def file_status(path: str | Path) -> os.stat_result | None:
    """Return the file system's status of a path; None where nothing exists there or the path is impossible."""
    try:
        return os.stat(path)
    except (OSError, ValueError):  # ValueError: the path holds a NUL, or lone surrogates
        return None


def why_absent(path: Path) -> str:
    """Return as a clause why a path has no status: nothing exists there, or this user may not look."""
    try:
        os.stat(path)
    except PermissionError as error:
        return f"cannot be read: {error.strerror}"
    except (OSError, ValueError):
        pass
    return "not found"


def kind_of(status: os.stat_result) -> str:
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


def path_of(value: object, what: str) -> Path:
    """Return a path from a text or an object that stands for one, its last part a name.

    Raises InputError for anything else: an empty text, which would name the working folder, and the root folder,
    beside which nothing can lie.
    """
    try:
        path = Path(value)  # type: ignore[arg-type]
    except TypeError:
        raise InputError(f"{what} = {shown(value)}: must be a path") from None
    if not str(value).strip():
        raise InputError(f"{what} = {shown(value)}: must be a path, and not empty")
    path = real(path) if path.name in ("", "..") else path
    if not path.name:
        raise InputError(f"{what} = {shown(str(value))}: is the root folder; choose a folder in it")
    return path


def real(path: str | os.PathLike[str]) -> Path:
    """Return the absolute path without links; links in a circle stay, so that opening the path fails."""
    return Path(os.path.realpath(path))


def check_folder(path: Path) -> None:
    """Check that a path to a folder, which `--out` names, is none to a file. Raises InputError."""
    if path.exists() and not path.is_dir():
        raise InputError(f"{path}: is a file, not a folder; choose another --out")


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
