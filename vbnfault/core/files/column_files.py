"""Read a table of named columns that a user names: a CSV or a Parquet file."""

from __future__ import annotations

import csv
import io
from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError, shown
from . import user_files

TYPES = (".csv", ".parquet")
_MOST_ROWS = 1_000_000


def read_columns(
    path: str, what: str, check_names: Callable[[Sequence[str], str], None], texts: Collection[str]
) -> Mapping[str, list[Any]]:
    """Return the columns of a file; all values of a CSV file are texts.

    Parameters
    ----------
    what
        Kind of file, a key of `user_files.LIMIT_BYTES`.
    check_names
        Called with the names of the columns and the path; raises InputError for wrong ones.
    texts
        Columns that hold texts, for the message about a wrong type.

    Raises
    ------
    InputError
        The file cannot be read, or is no such table.
    """
    data = user_files.read_input(path, what, types=TYPES)
    if Path(path).suffix.lower() == ".csv":
        return _csv_columns(data, path, check_names)
    return _parquet_columns(data, path, check_names, texts)


def check_once(names: Sequence[str], source: str) -> None:
    """Raise InputError for a column that stands twice."""
    for name, times in Counter(names).items():
        if times > 1:
            raise InputError(f"{source}: column {shown(name)} stands twice; must stand once")


def numbers(column: Sequence[Any], name: str, bounds: tuple[float, float], source: str) -> NDArray[np.float64]:
    """Return a column as float64[n]. Raises InputError for a value that is no number, or out of its bounds."""
    low, high = bounds
    out = np.empty(len(column))
    for row, value in enumerate(column):
        try:
            if isinstance(value, bool) or (isinstance(value, str) and "_" in value):
                raise ValueError
            out[row] = float(value)
        except (TypeError, ValueError, OverflowError):
            out[row] = np.nan
    wrong = np.flatnonzero(~((out >= low) & (out <= high)))
    if len(wrong):
        value = column[int(wrong[0])]
        raise InputError(
            f"{source}: row {wrong[0] + 1}: {name} = {value if isinstance(value, float) else shown(value)}: must "
            f"be a number from {low:.10g} to {high:.10g}"
        )
    return out


def _csv_columns(
    data: bytes, source: str, check_names: Callable[[Sequence[str], str], None]
) -> dict[str, list[Any]]:
    """Return the columns of a CSV file, as texts. Raises InputError."""
    try:
        rows = [row for row in csv.reader(io.StringIO(data.decode("utf-8-sig"), newline=""), strict=True) if row]
    except UnicodeDecodeError as error:
        raise InputError(f"{source}: byte {error.start} is no UTF-8; a CSV file must be UTF-8 text") from None
    except csv.Error as error:
        raise InputError(f"{source}: is no CSV file: {error}") from None
    header = [name.strip() for name in rows[0]] if rows else []
    check_names(header, source)
    for number, row in enumerate(rows[1:], 1):
        if len(row) != len(header):
            raise InputError(
                f"{source}: row {number} has {len(row)} values; must have {len(header)}, as the first line has"
            )
    return {name: [row[k].strip() for row in rows[1:]] for k, name in enumerate(header)}


def _parquet_columns(
    data: bytes, source: str, check_names: Callable[[Sequence[str], str], None], texts: Collection[str]
) -> dict[str, list[Any]]:
    """Return the columns of a Parquet file. Raises InputError."""
    import pyarrow
    import pyarrow.parquet

    try:
        file = pyarrow.parquet.ParquetFile(io.BytesIO(data))
        check_names(file.schema_arrow.names, source)
        if file.metadata.num_rows > _MOST_ROWS:  # before reading: a small file can hold a huge table
            raise InputError(f"{source}: has {file.metadata.num_rows} rows; must have at most {_MOST_ROWS}")
        _check_types(file.schema_arrow, source, texts)
        table = file.read()
        return {name: table.column(name).to_pylist() for name in file.schema_arrow.names}
    except (pyarrow.ArrowException, OSError, ValueError) as error:
        raise InputError(f"{source}: is no Parquet file: {' '.join(str(error).split())[:200]}") from None


def _check_types(schema: Any, source: str, texts: Collection[str]) -> None:
    """Raise InputError for a column of a Parquet file whose values are neither numbers nor texts."""
    from pyarrow import types

    for column in schema:
        kind = column.type.value_type if types.is_dictionary(column.type) else column.type
        checks = (types.is_floating, types.is_integer, types.is_decimal, types.is_string, types.is_large_string)
        if not any(check(kind) for check in checks):
            wanted = "texts" if column.name in texts else "numbers"
            raise InputError(f"{source}: column {column.name} has the type {kind}; must hold {wanted}")
