"""Find the packaged scenes, lenses, sensors and textures."""

from __future__ import annotations

import stat
from pathlib import Path

from ..errors import InputError, suggestion
from .path_checks import check_path, file_status, kind_of, path_of, shown_path, why_absent

# Folder of the package vbnfault.
PACKAGE = Path(__file__).resolve().parents[2]
_SINGULAR = {
    "scenes": "scene",
    "lenses": "lens",
    "detectors": "detector",
    "studies": "study",
    "benchmarks": "benchmark",
}


def data_dir(kind: str) -> Path:
    """Return the folder `scenes`, `textures` or `catalogues`. Raises InputError where the installation lacks it."""
    for candidate in (PACKAGE / kind, PACKAGE.parent / kind):
        if candidate.is_dir():
            return candidate
    raise InputError(f"{kind}: the folder is missing from this installation of vbnfault; install it again")


def packaged(kind: str) -> dict[str, Path]:
    """Return name → path of every packaged TOML of a kind: such as `scenes` or `scenes/lenses`."""
    top, *rest = kind.split("/")
    folder = data_dir(top).joinpath(*rest)
    return {p.stem: p for p in sorted(folder.glob("*.toml"))}


def find(kind: str, name_or_path: str | Path) -> Path:
    """Return the path as given, or the packaged file of that name. Raises InputError, which lists these names."""
    what = kind.rsplit("/", 1)[-1]
    one = _SINGULAR.get(what, what)
    path = path_of(name_or_path, one)
    check_path(str(name_or_path), one)
    status = file_status(path)
    if path.suffix or status:
        if status and stat.S_ISREG(status.st_mode):
            return path
        if status is None and (why := why_absent(path)) != "not found":
            raise InputError(f"{shown_path(path)}: {why}")
        raise InputError(f"{shown_path(path)}: no such file{',' + kind_of(status) if status else ''}")
    known = packaged(kind)
    if str(name_or_path) in known:
        return known[str(name_or_path)]
    beside = Path(f"{name_or_path}.toml")
    named = f" (did you mean {shown_path(beside)}?)" if file_status(beside) else ""
    hint = named or suggestion(str(name_or_path), known)
    raise InputError(
        f"{shown_path(name_or_path)}: neither a file nor a packaged name{hint}; {what}: {', '.join(known)}"
    )
