"""Declare, check and describe the fields of a fault model, which are its keys in the scene file."""

from __future__ import annotations

import dataclasses
import difflib
import math
from collections.abc import Mapping
from dataclasses import field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..core.errors import InputError, shown


class Interval(NamedTuple):
    """Hold the closed bounds of a uniform draw. If `lo == hi`, the value is fixed."""

    lo: float
    hi: float

    def uniform(self, rng: np.random.Generator, size: int | None = None) -> Any:
        """Return one uniform float in [lo, hi], or float64[size] if `size` is given."""
        value = rng.uniform(self.lo, self.hi, size)
        return float(value) if size is None else value

    def power_law(self, uniform: NDArray[np.float64], exponent: float) -> NDArray[np.float64]:
        """Return values in [lo, hi] with density ∝ v^-(exponent + 1), one for each uniform number in [0, 1].

        Far below `hi`, the number of values above v therefore falls as v^-exponent. Exponent 0 gives a density that
        is uniform in log v. `lo` must be above 0.
        """
        if abs(exponent) < 1e-9:
            return np.asarray(self.lo * (self.hi / self.lo) ** uniform)
        a, b = self.lo**-exponent, self.hi**-exponent
        return np.asarray((a + (b - a) * uniform) ** (-1 / exponent))

    def integer(self, rng: np.random.Generator) -> int:
        """Return one uniform integer in [lo, hi], both bounds included."""
        return int(rng.integers(int(self.lo), int(self.hi), endpoint=True))


def bounds(
    lo: float, hi: float, *, limits: tuple[float, float], doc: str, unit: str = "", integer: bool = False
) -> Any:
    """Declare a field that is drawn uniformly from [lo, hi].

    A scene may set other bounds, or one fixed value, within `limits`.
    """
    return field(
        default=Interval(lo, hi),
        metadata={"kind": "bounds", "limits": limits, "doc": doc, "unit": unit, "integer": integer},
    )


def number(
    default: float | None, *, limits: tuple[float, float], doc: str, unit: str = "", integer: bool = False
) -> Any:
    """Declare a fixed number within `limits`. If its default is None, a scene may leave it out."""
    return field(
        default=default,
        metadata={"kind": "number", "limits": limits, "doc": doc, "unit": unit, "integer": integer},
    )


def flag(default: bool, *, doc: str) -> Any:
    """Declare a fixed true or false."""
    return field(default=default, metadata={"kind": "flag", "doc": doc})


def choice(default: str, options: tuple[str, ...], *, doc: str) -> Any:
    """Declare a string that must be one of `options`."""
    return field(default=default, metadata={"kind": "choice", "options": options, "doc": doc})


def text(default: str, *, doc: str) -> Any:
    """Declare a fixed string. For the path of a file, use `path`."""
    return field(default=default, metadata={"kind": "text", "doc": doc})


def path(*, content: str = "data", packaged: str = "", doc: str) -> Any:
    """Declare the path of a file; empty by default.

    A relative path in a scene file starts from the scene file's folder, or from the working folder if nothing lies
    there. The contents of the file, not its path, belong to the identity of a store. Read the file with
    `core.resources.read_input`, so that a change during a build is noticed.

    Parameters
    ----------
    content
        Kind of file in error messages, a key of `core.resources.LIMIT_BYTES`.
    packaged
        Folder of packaged files, such as `scenes/lenses`. A value without a suffix is then the name of one of them.
    """
    return field(default="", metadata={"kind": "path", "content": content, "packaged": packaged, "doc": doc})


def rows(columns: Mapping[str, tuple[float, float]], *, doc: str) -> Any:
    """Declare a list of tables with the given numeric columns and their limits.

    The list is empty by default; the model then draws these values.
    """
    return field(default=(), metadata={"kind": "rows", "columns": dict(columns), "doc": doc})


def suggestion(word: str, known: Any) -> str:
    """Return the most similar known word as a suggestion, or the list of all known words."""
    close = difflib.get_close_matches(word, list(known), n=1)
    return f" (did you mean {close[0]}?)" if close else f"; known: {', '.join(known)}"


def _is_number(value: Any) -> bool:
    """Return whether the value is a finite number; booleans do not count."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return False
    try:
        return math.isfinite(value)
    except OverflowError:  # an integer beyond the range of floats
        return False


def parse_field(value: Any, f: dataclasses.Field[Any], where: str) -> Any:
    """Return the value of one field after its check; `where` names the key in an InputError."""
    meta = f.metadata
    kind = meta["kind"]
    if kind == "number" and value is None and f.default is None:
        return None
    if kind == "flag":
        if not isinstance(value, bool):
            raise InputError(f"{where} = {shown(value)}: must be true or false")
        return value
    if kind == "choice":
        if not isinstance(value, str) or value not in meta["options"]:
            raise InputError(f"{where} = {shown(value)}: must be one of {', '.join(meta['options'])}")
        return value
    if kind in ("text", "path"):
        if not isinstance(value, str):
            raise InputError(f"{where} = {shown(value)}: must be a string")
        return value
    if kind == "rows":
        return _parse_rows(value, meta["columns"], where)
    lo, hi = meta["limits"]
    whole = " whole" if meta["integer"] else ""
    if kind == "number":
        fits = _is_number(value) and lo <= value <= hi and (not whole or float(value).is_integer())
        if not fits:
            raise InputError(f"{where} = {shown(value)}: must be a{whole} number from {lo:g} to {hi:g}")
        return value
    pair = value if isinstance(value, list | tuple) else [value, value]
    ok = len(pair) == 2 and all(_is_number(v) and (not whole or float(v).is_integer()) for v in pair)
    if not ok or not (lo <= pair[0] and pair[1] <= hi):
        raise InputError(
            f"{where} = {shown(value)}: must be one{whole} number, or [lower, upper]{whole} bounds, "
            f"from {lo:g} to {hi:g}"
        )
    if pair[0] > pair[1]:
        raise InputError(f"{where} = {shown(value)}: bounds reversed, the lower one comes first")
    return Interval(*pair)


def _parse_rows(value: Any, columns: Mapping[str, tuple[float, float]], where: str) -> tuple[Any, ...]:
    """Return a list of tables after its check, as a tuple of dicts."""
    if not isinstance(value, list | tuple):
        raise InputError(f"{where} = {shown(value)}: must be a list of tables with keys {', '.join(columns)}")
    for i, row in enumerate(value):
        if not isinstance(row, Mapping) or set(row) != set(columns):
            raise InputError(f"{where}[{i}] = {shown(row)}: must be a table with the keys {', '.join(columns)}")
        for key, (lo, hi) in columns.items():
            if not _is_number(row[key]) or not lo <= row[key] <= hi:
                raise InputError(f"{where}[{i}].{key} = {shown(row[key])}: must be a number from {lo:g} to {hi:g}")
    return tuple(dict(row) for row in value)


def field_schema(f: dataclasses.Field[Any]) -> dict[str, Any]:
    """Return the JSON Schema of one field."""
    meta = f.metadata
    unit = f" [{meta['unit']}]" if meta.get("unit") else ""
    schema: dict[str, Any] = {"description": meta["doc"] + unit}
    kind = meta["kind"]
    if kind in ("bounds", "number"):
        lo, hi = meta["limits"]
        value = {"type": "integer" if meta.get("integer") else "number"}
        value |= {k: v for k, v in (("minimum", lo), ("maximum", hi)) if np.isfinite(v)}
        if kind == "number":
            return schema | value | ({} if f.default is None else {"default": f.default})
        pair = {"type": "array", "items": value, "minItems": 2, "maxItems": 2}
        return schema | {"anyOf": [value, pair], "default": list(f.default)}  # type: ignore
    if kind == "rows":
        columns = {k: {"type": "number", "minimum": v[0], "maximum": v[1]} for k, v in meta["columns"].items()}
        item = {"type": "object", "properties": columns, "required": list(columns)}
        return schema | {"type": "array", "items": item | {"additionalProperties": False}, "default": []}
    if kind == "choice":
        return schema | {"enum": list(meta["options"]), "default": f.default}
    return schema | {"type": "boolean" if kind == "flag" else "string", "default": f.default}
