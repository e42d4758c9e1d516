"""Check plain data, such as the contents of a TOML file, with pydantic, and say in one sentence what is wrong.

Every file that a user writes has a model: `Table` for data that only describe, `table_class` for dataclasses that
physics uses too. Both are frozen, refuse unknown keys and take ranges from `pydantic.Field`. From the same fields
follow the checks, the error messages and the JSON Schema.
"""

from __future__ import annotations

import dataclasses
import json
import logging
import operator
import os
import re
from collections.abc import Callable, Collection, Mapping, Sequence
from functools import lru_cache, wraps
from itertools import pairwise
from typing import Annotated, Any, TypeVar, dataclass_transform

import pydantic.dataclasses
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, TypeAdapter, ValidationError

from .errors import InputError, shown, suggestion
from .files import path_checks, toml_files

T = TypeVar("T")

_CONFIG = ConfigDict(extra="forbid", allow_inf_nan=False, validate_default=True)
_SCHEMA = "https://json-schema.org/draft/2020-12/schema"
# The most unknown keys that one message names.
_MOST_NAMED = 5
# Names that pydantic puts into an error's location for the alternatives of a union.
_ALTERNATIVE = re.compile(r"(str|float|int|bool)$|(constrained|literal|function|tuple|list|dict|lax|json)\b")
# A message of a model's own check that begins with the key.
_BEGINS_WITH_KEY = re.compile(r"[\w.]+( = |: )")
_COUNTS = {2: "two", 3: "three"}
# Types of pydantic's errors for an unknown key.
_UNKNOWN = ("extra_forbidden", "unexpected_keyword_argument")

Fraction = Annotated[float, Field(ge=0, le=1)]


class Table(BaseModel):
    """Check a table of a file: it is frozen and strict, and refuses unknown keys."""

    model_config = ConfigDict(frozen=True, **_CONFIG)


@dataclass_transform(frozen_default=True, kw_only_default=True, field_specifiers=(dataclasses.field, Field))
def table_class(*, required: Sequence[str] = ()) -> Callable[[type[T]], type[T]]:
    """Return a decorator that makes a class a frozen, keyword-only dataclass whose fields are always checked.

    An object made in Python is checked as one from a file, but numbers of numpy and lists in place of tuples are
    accepted; wrong values raise InputError. A check in `__post_init__` raises ValueError with a sentence
    "key = value: must be …".

    Parameters
    ----------
    required
        Fields that every file must set, although they have a default in Python.
    """
    config = ConfigDict(json_schema_extra={"required": list(required)}, **_CONFIG) if required else _CONFIG

    def decorate(cls: type[T]) -> type[T]:
        made: Any = pydantic.dataclasses.dataclass(frozen=True, kw_only=True, config=config)(cls)
        checked = made.__init__

        @wraps(checked)
        def __init__(self: Any, **values: Any) -> None:
            try:
                checked(self, **values)
            except ValidationError as error:
                raise InputError(sentence(error.errors(include_url=False), _schema(made))) from None

        made.__init__ = __init__
        result: type[T] = made
        return result

    return decorate


def ordered(pair: tuple[float, float]) -> tuple[float, float]:
    """Return a pair of bounds. Raises ValueError where they are reversed."""
    if pair[0] > pair[1]:
        raise ValueError("bounds reversed, the lower one comes first")
    return pair


def pair_within(lo: float, hi: float) -> Any:
    """Return the type of a pair of bounds within `lo` and `hi`, the lower one first."""
    value = Annotated[float, Field(ge=lo, le=hi)]
    return Annotated[tuple[value, value], AfterValidator(ordered)]


def check_spectrum(wavelength_nm: Sequence[float], value: Sequence[float]) -> None:
    """Raise ValueError unless there are as many wavelengths as values, and the wavelengths increase."""
    if len(wavelength_nm) != len(value):
        raise ValueError(f"{len(wavelength_nm)} wavelengths for {len(value)} values: must be as many")
    if any(a >= b for a, b in pairwise(wavelength_nm)):
        raise ValueError(f"wavelength_nm = {list(wavelength_nm)}: must increase")


def each_once(values: tuple[T, ...]) -> tuple[T, ...]:
    """Return values as they are. Raises ValueError if one is given twice."""
    seen: set[T] = set()
    for value in values:
        if value in seen:
            raise ValueError(f"{value!r} is given twice")
        seen.add(value)
    return values


def parse(kind: type[T], plain: Mapping[str, Any], *, source: str, overrides: Sequence[str] = ()) -> T:
    """Return plain data, such as the contents of a TOML file, as a checked object.

    Parameters
    ----------
    kind
        Model of the data: a `Table`, or a class made by `table_class`.
    plain
        The data. Types are not converted, but a whole number is accepted as a float.
    source
        File that the data come from; an error message begins with it.
    overrides
        Dotted keys whose values replaced those of the file; an error message marks them.

    Raises
    ------
    InputError
        The data are wrong. One sentence names the source, the key, the value and what is allowed.
    """
    toml_files.check_plain(plain, source)
    model: Any = kind
    errors: list[Any] = [{"type": "missing", "loc": loc} for loc in _missing(plain, _schema(model), _schema(model))]
    try:
        # JSON mode is strict about types, but accepts arrays as tuples. No key takes a TOML date: a list fails.
        text = json.dumps(plain, default=lambda date: [str(date)])
        checked: T = _adapter(model).validate_json(text, strict=True)
        if not errors:
            return checked
    except ValidationError as error:
        located = [known["loc"] for known in errors]
        errors += [detail for detail in error.errors(include_url=False) if detail["loc"] not in located]
    keys, _ = _locate(errors[0]["loc"], _schema(model))
    wrong = ".".join(map(str, keys))
    replaced = any(wrong.startswith(key) or key.startswith(f"{wrong}.") for key in map(dotted, overrides))
    mark = " (set in place of the file)" if replaced else ""
    raise InputError(f"{source}: {sentence(errors, _schema(model))}{mark}")


def replace(table: dict[str, Any], values: Mapping[str, Any], *, source: str) -> None:
    """Replace values of plain data, given by dotted key. Raises InputError where a key leads through a value.

    An entry of a list is named as in messages, `factor[0].low`, or by a dot, `factor.0.low`. A value may hold
    numbers and arrays of numpy, tuples and paths.
    """
    for key, given in values.items():
        value = _as_plain(given)
        if not isinstance(key, str):
            raise InputError(
                f"{source}: {shown(key)} = {shown(value)}: the key must be a text, such as 'dataset.seed'"
            )
        parts, what = dotted(key).split("."), f"{source}: {key} = {shown(value)}"
        node: Any = table
        for i, part in enumerate(parts):
            place: Any = _entry(node, part, ".".join(parts[:i]), what) if isinstance(node, list) else part
            if i == len(parts) - 1:
                node[place] = value
                break
            node = node[place] if isinstance(node, list) else node.setdefault(place, {})
            if not isinstance(node, dict | list):
                raise InputError(f"{what}: {part} is a value, not a table")


def _as_plain(value: Any) -> Any:
    """Return a value of Python code as a file would hold it: numbers of numpy as numbers, arrays as lists."""
    if isinstance(value, Mapping):
        return {key: _as_plain(part) for key, part in value.items()}
    if isinstance(value, list | tuple):
        return [_as_plain(part) for part in value]
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    as_list = getattr(value, "tolist", None)
    return value if as_list is None else as_list()


def new_name(key: str) -> str:
    """Return the current name of a key: until version 0.2 fractions were called shares, such as `dead_share`."""
    return key.replace("_share", "_fraction")


def with_new_names(
    table: Mapping[str, Any], known: Collection[str], where: str, prefix: str = ""
) -> dict[str, Any]:
    """Return a table whose keys have their current names, and warn of old ones.

    `known` are the current keys; each may stand behind `prefix`. Raises InputError, whose message begins with
    `where`, where a key is given by both names.
    """
    renamed: dict[str, Any] = {}
    for key, value in table.items():
        name = new_name(key)
        if name == key or key.removeprefix(prefix) in known or name.removeprefix(prefix) not in known:
            renamed[key] = value
            continue
        if name in table:
            raise InputError(f"{where}.{key}: is the old name of {name}, which is given, too; leave one out")
        logging.getLogger("vbnfault").warning(f"{where}.{key}: is called {name} now; the old name still works")
        renamed[name] = value
    return renamed


def whole(value: object) -> int | None:
    """Return a whole number of Python or of numpy as an int; None for anything else, such as 2.0 or True."""
    try:
        return None if isinstance(value, bool) else operator.index(value)  # type: ignore[arg-type]
    except TypeError:
        return None


def is_number(text: str) -> bool:
    """Return whether a text is a number, as Python writes one; `nan` and `inf` are."""
    try:
        float(text)
    except ValueError:
        return False
    return True


def flat(table: Mapping[str, Any], above: str = "") -> dict[str, Any]:
    """Return the values of nested tables by dotted key; an empty table is a value."""
    values: dict[str, Any] = {}
    for key, value in table.items():
        below = isinstance(value, Mapping) and value
        values |= flat(value, f"{above}{key}.") if below else {f"{above}{key}": value}
    return values


def dotted(key: str) -> str:
    """Return a key with dots before the numbers of entries of lists: `factor[0].low` as `factor.0.low`."""
    return re.sub(r"\[(\d+)\]", r".\1", key)


def _entry(entries: Sequence[Any], part: str, where: str, what: str) -> int:
    """Return the index of an entry of a list. Raises InputError, which begins with `what`, where it has none."""
    if re.fullmatch(r"\d{1,9}", part) and int(part) < len(entries):
        return int(part)
    known = f"its entries are 0 to {len(entries) - 1}" if entries else "it is empty"
    raise InputError(f"{what}: {where} is a list; {known}")


def check(checks: TypeAdapter[Any], value: Any, where: str, *, whole_value: bool = False) -> Any:
    """Return a value after its check. Raises InputError; its message begins with `where`, the key of the value.

    With `whole_value`, the message shows the whole value, also where one of its parts is wrong.
    """
    try:
        return checks.validate_python(value)
    except ValidationError as error:
        schema = checks.json_schema()
        details = error.errors(include_url=False)
        if not whole_value:
            source, separator, key = where.rpartition(": ")
            raise InputError(f"{source}{separator}{sentence(details, schema, key)}") from None
        reason = next((str(d["ctx"]["error"]) for d in details if d["type"] == "value_error"), "")
        wanted = reason or f"must be {_allowed(schema, schema, details[0]['msg'])}"
        raise InputError(f"{where}{_shown(value)}: {wanted}") from None


def _missing(plain: Any, node: Mapping[str, Any], root: Mapping[str, Any]) -> list[tuple[str, ...]]:
    """Return the locations of all required keys that plain data lack, also within tables that are missing."""
    locations: list[tuple[str, ...]] = []
    node = _resolved(node, root)
    for key, child in node.get("properties", {}).items():
        below = _resolved(child, root)
        if key in plain or (key in node.get("required", ()) and "required" in below):
            value = plain.get(key, {})
            nested = _missing(value, below, root) if isinstance(value, Mapping) else []
            locations += [(key, *loc) for loc in nested]
        elif key in node.get("required", ()):
            locations.append((key,))
    return locations


def json_schema(kind: Any) -> dict[str, Any]:
    """Return the JSON Schema (draft 2020-12) of the files that a model describes."""
    return {"$schema": _SCHEMA, **_schema(kind)}


@lru_cache(maxsize=256)
def _adapter(kind: Any) -> TypeAdapter[Any]:
    """Return pydantic's checks of a type."""
    return TypeAdapter(kind)


@lru_cache(maxsize=256)
def _schema(kind: Any) -> dict[str, Any]:
    """Return the JSON Schema of a type. It is shared: do not modify it."""
    return _adapter(kind).json_schema()


def forget_schemas() -> None:
    """Forget all schemas: a class that registers itself may extend any of them."""
    _schema.cache_clear()


# --- error messages ---------------------------------------------------------------------------------------------


def sentence(details: Sequence[Any], schema: Mapping[str, Any], where: str = "") -> str:
    """Return pydantic's errors as one sentence that names the key, the value and what is allowed.

    All unknown keys and all missing keys are named at once, since one is often a misspelling of the other. Of
    wrong values only one is named: the first of those that lie deepest in the data.

    Parameters
    ----------
    details
        What `ValidationError.errors` returns.
    schema
        JSON Schema of the data.
    where
        Key of the data, if they are the value of one.
    """
    located = [
        (detail, *_locate(detail["loc"][:-1] if detail["type"] in _UNKNOWN else detail["loc"], schema))
        for detail in details
    ]
    unknown = [entry for entry in located if entry[0]["type"] in _UNKNOWN]
    alike: dict[str, list[str]] = {}  # keys by what is known in their place
    for detail, keys, node in unknown[:_MOST_NAMED]:
        known = [key for choice in _choices(node, schema) for key in choice.get("properties", {})]
        hint = did_you_mean(str(detail["loc"][-1]), known)
        alike.setdefault(hint, []).append(_dotted([*keys, detail["loc"][-1]], where))
    clauses = [f"{', '.join(of)}: unknown key{'s' * (len(of) > 1)}{hint}" for hint, of in alike.items()]
    if len(unknown) > _MOST_NAMED:
        clauses.append(f"and {len(unknown) - _MOST_NAMED} more unknown keys")
    missing = [
        _dotted(keys, where)
        for detail, keys, _ in located
        if detail["type"] == "missing" and isinstance(detail["loc"][-1], str)
    ]
    if missing:
        clauses.append(f"{', '.join(missing)}: {'is' if len(missing) == 1 else 'are'} missing")
    if clauses:
        return "; ".join(clauses)
    deepest = max(located, key=lambda entry: (entry[0]["type"] == "value_error", len(entry[1])))
    return _wrong(*deepest, schema, where)


def did_you_mean(word: str, known: Sequence[str]) -> str:
    """Return the known word that is nearest to an unknown one as a suggestion, or the list of all known words."""
    return suggestion(word, known) or f"; known: {', '.join(known)}"


def _wrong(
    detail: Any, keys: list[int | str], node: Mapping[str, Any], schema: Mapping[str, Any], where: str
) -> str:
    """Return the clause for a wrong value."""
    value, message = detail.get("input"), str(detail.get("ctx", {}).get("error", detail["msg"]))
    if detail["type"] == "missing":  # a list that is too short
        keys, node = _locate(detail["loc"][:-1], schema)
    key = _dotted(keys, where)
    if detail["type"] in ("union_tag_invalid", "union_tag_not_found"):  # a table whose tag selects its keys
        tag, tags = (
            detail["ctx"]["discriminator"].strip("'"),
            ", ".join(map(repr, node["discriminator"]["mapping"])),
        )
        given = f" = {shown(detail['ctx']['tag'])}:" if "tag" in detail["ctx"] else ": is missing,"
        return f"{key}.{tag}{given} must be one of {tags}"
    if detail["type"] != "value_error":
        return f"{key}{_shown(value)}: must be {_allowed(node, schema, message)}"
    if not _shown(value) and (not key or _BEGINS_WITH_KEY.match(message)):
        return f"{key}.{message}".removeprefix(".")
    return f"{key}{_shown(value)}: {message}"


def _dotted(keys: Sequence[int | str], where: str = "") -> str:
    """Return keys behind `where` as one dotted key for an error message; the index of a list is in brackets."""
    parts = [f"[{key}]" if isinstance(key, int) else f".{path_checks.shown_path(key)}" for key in keys]
    return f"{where}{''.join(parts)}".removeprefix(".")


def _shown(value: Any) -> str:
    """Return " = value" for an error message, empty for a table."""
    described = isinstance(value, dict | BaseModel) or dataclasses.is_dataclass(value)
    return "" if described or hasattr(value, "kwargs") else f" = {shown(value)}"


def _allowed(node: Mapping[str, Any], root: Mapping[str, Any], message: str) -> str:
    """Return in words which values a key takes, from its JSON Schema, or else from pydantic's message."""
    choices = _choices(node, root)
    if len(choices) == 1:
        words = _kind(choices[0], root) or message.replace("Input should be ", "")
        return "a finite number" if words == "a number" and "finite" in message else words
    kinds = dict.fromkeys(_kind(choice, root) for choice in choices)
    return ", or ".join(kind for kind in kinds if kind) or message


def _kind(schema: Mapping[str, Any], root: Mapping[str, Any]) -> str:
    """Return in words which values a JSON Schema without alternatives allows; empty where it does not say."""
    names = schema.get("enum", [schema["const"]] if "const" in schema else [])
    if names:
        shown_names = [str(name).lower() if isinstance(name, bool) else repr(name) for name in names]
        return " or ".join(filter(None, [", ".join(shown_names[:-1]), shown_names[-1]]))
    if schema.get("pattern", "").startswith("^("):
        options = schema["pattern"].removeprefix("^(").removesuffix(")$").replace("[a-z0-9_]+", "<fault>")
        return f"one of {', '.join(options.split('|'))}"
    if schema.get("type") in ("number", "integer"):
        whole, interval = schema["type"] == "integer", _interval(schema)
        one_sided = bool(interval) and "aximum" not in "".join(schema)
        noun = "a whole number" if whole else "a finite number" if one_sided else "a number"
        return f"{noun} {interval}".strip()
    items = schema.get("prefixItems")
    if items:
        each = _allowed(items[0], root, "a value").removeprefix("a ")
        return f"a list of {_COUNTS.get(len(items), str(len(items)))} values, each a {each}"
    if schema.get("type") == "array":
        count = _interval_of_counts(schema.get("minItems", 0), schema.get("maxItems"))
        kind = _kind(_choices(schema.get("items", {}), root)[0], root)
        plural = {"a table": " of tables", "a string": " of strings"}.get(kind, "")
        return f"a list{count or plural}"
    if schema.get("type") == "string" and schema.get("minLength"):
        return "a string that is not empty"
    return {"string": "a string", "object": "a table", "boolean": "true or false"}.get(schema.get("type", ""), "")


def _interval_of_counts(least: int, most: int | None) -> str:
    """Return how many entries a list may have in words; empty where any number may be."""
    if most is None:
        return f" of at least {least}" if least else ""
    if least == most:
        return f" of {most}"
    return f" of {least} to {most}" if least else f" of at most {most}"


def _interval(schema: Mapping[str, Any]) -> str:
    """Return the limits of a number in words; empty where it has none."""
    lo, hi = schema.get("minimum"), schema.get("maximum")
    above, below = schema.get("exclusiveMinimum"), schema.get("exclusiveMaximum")
    start = f"from {_plain(lo)}" if lo is not None else f"above {_plain(above)}" if above is not None else ""
    if hi is not None:
        end = f"{'to' if lo is not None else 'and at most' if start else 'up to'} {_plain(hi)}"
    elif below is not None:
        end = f"{'and below' if start else 'below'} {_plain(below)}"
    elif lo is not None:
        return f"of at least {_plain(lo)}"
    else:
        end = ""
    return f"{start} {end}".strip()


def _plain(bound: float) -> str:
    """Return a bound as text: up to seven digits before the point in full."""
    return str(int(bound)) if abs(bound) < 1e7 and bound == int(bound) else f"{bound:g}"


# --- the schema at the location of an error ---------------------------------------------------------------------


def _resolved(node: Mapping[str, Any], root: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return a node of a JSON Schema without references."""
    while "$ref" in node or "allOf" in node:
        node = root["$defs"][node["$ref"].rsplit("/", 1)[-1]] if "$ref" in node else node["allOf"][0]
    return node


def _choices(node: Mapping[str, Any], root: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    """Return the alternatives of a node without null; the node itself where it is no union."""
    node = _resolved(node, root)
    parts = node.get("anyOf", node.get("oneOf"))
    if parts is None:
        return [node]
    return [choice for part in parts for choice in _choices(part, root) if choice.get("type") != "null"]


def _locate(loc: Sequence[int | str], root: Mapping[str, Any]) -> tuple[list[int | str], Mapping[str, Any]]:
    """Return the keys of an error's location without pydantic's names of alternatives, and the schema there."""
    keys: list[int | str] = []
    node = _resolved(root, root)
    for part in loc:
        tagged = node.get("discriminator", {}).get("mapping", {})
        if part in tagged:  # pydantic names the alternative that the table's tag selects
            node = _resolved({"$ref": tagged[part]}, root)
            continue
        choices = _choices(node, root)
        tables = [choice for choice in choices if part in choice.get("properties", {})]
        lists = [choice for choice in choices if isinstance(part, int) and choice.get("type") == "array"]
        lists.sort(key=lambda choice: -len(choice.get("prefixItems", ())))  # a longer one has the same first items
        if tables:
            node = tables[0]["properties"][part]
        elif lists and isinstance(part, int):
            items = (choice["prefixItems"][part] for choice in lists if part < len(choice.get("prefixItems", ())))
            node = next(items, lists[0].get("items", {}))
        elif len(choices) > 1 and any(choice.get("title") == part for choice in choices):
            node = next(choice for choice in choices if choice.get("title") == part)
            continue
        elif isinstance(part, str) and _ALTERNATIVE.match(part):
            continue
        else:  # a table with keys of the user's choice, or an unknown key
            other = choices[0].get("additionalProperties") if choices else None
            node = other if isinstance(other, Mapping) else {}
        keys.append(part)
        node = _resolved(node, root)
    return keys, node
