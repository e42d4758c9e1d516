"""Read and write TOML as plain data."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import tomli_w

from ..errors import InputError, shown
from .path_checks import shown_path
from .user_files import read_input

_DEEPEST_TABLE = 24
# Half of a pair of UTF-16, which has no encoding in UTF-8.
_NO_UNICODE = re.compile("[\ud800-\udfff]")
# Kinds of files that users have in place of a TOML file, by how they start and by suffix.
_STARTS = {
    r"(!.*\n\s*)*(RDM|LEN)\b(?! NEW \")": "a CODE V sequence file",
    r"(//.*\n\s*)*LEN NEW \"": "an OSLO lens file",
    r"VERS \d": "a Zemax lens file",
    r"[{]": "a JSON file",
    r"<": "an XML or HTML file",
    r"(---|%YAML)\s": "a YAML file",
    r"PK\x03\x04": "a ZIP archive",
    r"\x1f\x8b": "a gzip archive",
    r"\x89PNG|II\*\0|MM\0\*|II\+\0|MM\0\+|\xff\xd8\xff": "an image",
    r"%PDF": "a PDF file",
}
_SUFFIXES = {
    ".seq": "a CODE V sequence file",
    ".len": "an OSLO or CODE V lens file",
    ".osl": "an OSLO lens file",
    ".zmx": "a Zemax lens file",
    ".zar": "a Zemax archive",
    ".zos": "an OpticStudio lens file",
    ".zmf": "a Zemax lens catalogue",
    ".agf": "a glass catalogue",
    ".otx": "an OpTaliX lens file",
    ".roa": "a RayOptics lens file",
    ".csv": "a CSV table",
    ".json": "a JSON file",
    ".yaml": "a YAML file",
    ".yml": "a YAML file",
}


def read_toml(path: Path, what: str = "scene") -> dict[str, Any]:
    """Return a TOML file as plain data; `what` is its kind, a key of `LIMIT_BYTES`. Raises InputError."""
    data = read_input(path, what)
    try:
        return parse_toml(data.decode("utf-8-sig"), str(path))
    except (UnicodeDecodeError, InputError) as error:
        if kind := _other_kind(path, data):
            takes = "a TOML file or a Zemax lens file (.zmx)" if what == "lens" else "a TOML file"
            raise InputError(f"{path}: is {kind}, which is not read; a {what} is {takes}") from None
        if isinstance(error, UnicodeDecodeError):
            raise InputError(f"{path}: not a TOML file: {error.reason} at byte {error.start}") from None
        raise


def _other_kind(path: Path, data: bytes) -> str | None:
    """Return what a file that is no TOML is, by its first bytes or else by its suffix; None if neither says."""
    start = data[:512].decode("utf-16" if data[:2] in (b"\xff\xfe", b"\xfe\xff") else "latin-1", "ignore").lstrip()
    by_start = (kind for pattern, kind in _STARTS.items() if re.match(pattern, start, re.IGNORECASE))
    return next(by_start, None) or _SUFFIXES.get(path.suffix.lower())


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


def check_plain(table: Mapping[str, Any] | Sequence[Any], source: str, where: str = "", depth: int = 0) -> None:
    """Check that plain data can be written as TOML.

    It must be nested at most 24 deep, its whole numbers must fit 64 bits, and its texts must be Unicode. A text of
    the command line may be none.

    Raises InputError; the message begins with `source`.
    """
    if depth == _DEEPEST_TABLE:
        raise InputError(f"{source}: {where.rstrip('.')}: nested deeper than {_DEEPEST_TABLE} tables or lists")
    wanted = ""
    for key, value in table.items() if isinstance(table, Mapping) else enumerate(table):
        if isinstance(value, Mapping | list | tuple):
            check_plain(value, source, f"{where}{_shown_key(key)}.", depth + 1)
        elif isinstance(value, int) and not -(2**63) <= value < 2**64:
            wanted = "a whole number of at most 64 bits"
        elif isinstance(value, str) and _NO_UNICODE.search(value):
            wanted = "text in UTF-8"
        if wanted:
            raise InputError(f"{source}: {where}{_shown_key(key)} = {shown(value)}: must be {wanted}")


def _shown_key(key: object) -> str:
    """Return a key, or the index of a list, for an error message."""
    return str(key) if isinstance(key, int) else shown_path(str(key))
