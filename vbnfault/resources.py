"""Where the packaged scenes and textures lie, and the first look at a file that a user names."""

from __future__ import annotations

import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from .errors import InputError

_PACKAGE = Path(__file__).resolve().parent


def input_file(path: Path, what: str, types: Sequence[str]) -> str:
    """Suffix, in lower case, of a user's file of one of `types`; `what` names it in errors.

    Raises InputError for a file that is missing, no file, of another type, or empty.
    """
    if not path.exists():
        raise InputError(f"{path}: {what} file not found.")
    if not path.is_file():
        raise InputError(f"{path}: {what} is not a file.")
    suffix = path.suffix.lower()
    if suffix not in types:
        raise InputError(f"{path}: unsupported {what} type {suffix!r}; allowed are {', '.join(types)}.")
    if path.stat().st_size == 0:
        raise InputError(f"{path}: {what} file is empty.")
    return suffix


def read_toml(path: Path) -> dict[str, Any]:
    """A TOML file as plain data. Raises InputError."""
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: not a TOML file: {error}") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from None


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
    if path.suffix or path.exists():
        if path.is_file():
            return path
        raise InputError(f"{path}: no such file{', but a folder' if path.is_dir() else ''}")
    known = packaged(kind)
    if str(name_or_path) in known:
        return known[str(name_or_path)]
    what = kind.rsplit("/", 1)[-1]
    raise InputError(f"{name_or_path}: neither a file nor a packaged name; {what}: {', '.join(known)}")
