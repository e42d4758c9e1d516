"""Read and write TOML as plain data."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import tomli_w

from .errors import InputError, shown
from .path_checks import shown_path
from .user_files import read_input

_DEEPEST_TABLE = 24


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
    """Check that plain data can be written as TOML.

    It must be nested at most 24 deep, its whole numbers must fit 64 bits, and its texts must be Unicode. A text of
    the command line may be none.

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
                elif isinstance(value, str) and not _is_unicode(value):
                    path = f"{where}{_shown_key(key)}"
                    raise InputError(f"{source}: {path} = {shown(value)}: must be text in UTF-8")
        level = below
        if not level:
            return
    where = level[0][0].rstrip(".")
    raise InputError(f"{source}: {where}: nested deeper than {_DEEPEST_TABLE} tables or lists")


def _is_unicode(text: str) -> bool:
    """Return whether a text can be written as UTF-8."""
    try:
        text.encode()
    except UnicodeEncodeError:
        return False
    return True


def _shown_key(key: object) -> str:
    """Return a key, or the index of a list, for an error message."""
    return str(key) if isinstance(key, int) else shown_path(str(key))
