"""Keep all fault models, in the order of the dataset, and read the faults of a scene file.

The definition of a model registers it. The orders of the classes follow from what their default models declare.
"""

from __future__ import annotations

import dataclasses
import inspect
from collections.abc import Collection, Iterable, Mapping
from functools import lru_cache
from typing import TYPE_CHECKING, Any

from ..core.errors import InputError, shown
from ..core.registry import DeclarationError, Registry, chained, is_name
from ..core.tables import did_you_mean, with_new_names
from .fields import Severity, field_schema, parse_field
from .levels import Levels, severity_schema, with_severity

if TYPE_CHECKING:
    from .contract import Fault

# "class/model" → type
_REGISTRY: Registry[type[Fault]] = Registry("fault model", __package__ or "")


def register(cls: type[Fault]) -> None:
    """Add a model to the registry. Raise DeclarationError if another class has its names, or they are no names."""
    if not is_name(cls.fault) or not is_name(cls.model):  # it would stay registered
        problem = "its names must consist of lower-case letters, digits and underscores"
        raise DeclarationError([cls.fault], f"fault model {cls.fault}/{cls.model}: {problem}")
    _REGISTRY.add(f"{cls.fault}/{cls.model}", cls, module=cls.__module__, qualname=cls.__qualname__)


def registered() -> list[type[Fault]]:
    """Return all models."""
    return list(_REGISTRY.values())


def is_packaged(cls: type[Fault]) -> bool:
    """Return whether a model belongs to vbnfault itself."""
    return _REGISTRY.is_packaged(cls)


def registry() -> dict[str, dict[str, type[Fault]]]:
    """Return fault class → model → type, with the classes in the order of the dataset.

    The first model of each class is its default. The others are sorted by module, those of this package first,
    whatever the order of imports. Models of installed plug-ins are among them.

    Raises
    ------
    DeclarationError
        If what the classes declare does not fit together.
    InputError
        If an installed plug-in is broken.
    """
    _import_all()
    return catalogue()


@lru_cache(maxsize=1)
def _import_all() -> None:
    """Import every module of this package and every installed plug-in, so that all models are registered."""
    _REGISTRY.complete()
    from .plugins import load_installed

    load_installed()


def catalogue() -> dict[str, dict[str, type[Fault]]]:
    """Return the models that are registered now; see `registry`."""
    return _catalogue(_REGISTRY.version)[0]


@lru_cache(maxsize=1)
def _catalogue(version: int) -> tuple[dict[str, dict[str, type[Fault]]], tuple[str, ...]]:
    """Return the models that are registered now, and their classes in the order in which their effects act.

    The `after` of the classes form a tree with one root. The classes of this package are one long branch of it; a
    class of a plug-in comes directly behind the class that it names.
    """
    known: dict[str, list[type[Fault]]] = {}
    for cls in sorted(_REGISTRY.values(), key=lambda cls: (not cls.default, not is_packaged(cls), cls.__module__)):
        _check(cls)
        known.setdefault(cls.fault, []).append(cls)
    for name, models in known.items():
        defaults = [cls for cls in models if cls.default]
        if not defaults:
            text = f"none of its models ({', '.join(cls.model for cls in models)}) states default = True"
            raise DeclarationError([name], f"fault class {name}: {text}")
        if len(defaults) > 1:
            first, rival = (f"{name}/{cls.model}" for cls in defaults[:2])
            raise DeclarationError(
                [name], f"fault model {rival}: default = True, but {first} is the default of the class"
            )
    packaged = {name for name, models in known.items() if is_packaged(models[0])}
    order = chained({name: str(models[0].after) for name, models in known.items()}, packaged, "fault class")

    def position(name: str) -> tuple[float, str]:
        axis = known[name][0].axis
        return float("inf") if axis is None else axis, name

    return {name: {cls.model: cls for cls in known[name]} for name in sorted(known, key=position)}, order


def _check(cls: type[Fault]) -> None:
    """Raise DeclarationError if a model declares its names, its place or its fields wrongly."""
    problem = ""
    options = cls.__dict__.get("__dataclass_params__")
    if cls.default and cls.after is None:
        problem = "the default model must state the class after which its class acts: after = ..."
    elif cls.default and cls.axis is not None and not is_packaged(cls):
        problem = f"axis = {cls.axis}: only the six classes of the paper have a position"
    elif options is None or not (options.frozen and getattr(options, "kw_only", True)):
        problem = "its class must be decorated with @dataclass(frozen=True, kw_only=True)"
    else:
        wrong = [f.name for f in dataclasses.fields(cls) if "kind" not in f.metadata]
        if wrong:
            problem = f"{wrong[0]} must be declared with one of the field helpers, such as bounds()"
        elif cls.severity is not None:
            problem = _wrong_severity(cls, cls.severity)
    if problem:
        raise DeclarationError([cls.fault], f"fault model {cls.fault}/{cls.model}: {problem}")


def _wrong_severity(cls: type[Fault], severity: Severity) -> str:
    """Return why the severity of a model names no number of its, or leaves the number's limits; "" if it fits."""
    declared = {f.name: f.metadata for f in dataclasses.fields(cls)}
    if "limits" not in declared.get(severity.key, {}):
        return f"its severity names {severity.key!r}, no number of it"
    unknown = severity.keys.keys() - declared.keys()
    if unknown:
        return f"its severity holds {min(unknown)!r}, no key of it"
    low, high = declared[severity.key]["limits"]
    if all(max(low, 0) <= value <= high and value > 0 for value in (severity.low, severity.high)):
        return ""
    return (
        f"its severity goes from {severity.low:g} to {severity.high:g}: must be above 0 and within "
        f"the limits [{low:g}, {high:g}] of {severity.key}"
    )


def dataset_order(names: Iterable[str]) -> list[str]:
    """Return the names in the order of the dataset's `fault` axis."""
    wanted = set(names)
    return [name for name in registry() if name in wanted]


def physical_order(names: Collection[str]) -> list[str]:
    """Return the names of classes in the order in which the effects act."""
    registry()
    return [name for name in _catalogue(_REGISTRY.version)[1] if name in names]


def from_dict(fault_class: str, table: Mapping[str, Any], *, source: str) -> Fault:
    """Build one fault from its table `[faults.<fault_class>]` in the scene file.

    If the table has no key `model`, the default model of the class is used.

    Raises
    ------
    InputError
        Names `source`, the key, its value and the allowed range.
    """
    models = registry().get(fault_class)
    where = f"{source}: faults.{fault_class}"
    if models is None:
        raise InputError(f"{where}: no such fault class{did_you_mean(fault_class, list(registry()))}")
    name = table.get("model", next(iter(models)))
    if not isinstance(name, str) or name not in models:
        raise InputError(f"{where}.model = {shown(name)}: must be one of {', '.join(models)}")
    cls = models[name]
    table = with_severity(cls, table, where)
    fields = {f.name: f for f in dataclasses.fields(cls)}
    values: dict[str, Any] = {}
    for key, value in table.items():
        if key == "model":
            continue
        if key not in fields:
            raise InputError(f"{where}.{key}: unknown key{did_you_mean(key, list(fields))}")
        values[key] = parse_field(value, fields[key], f"{where}.{key}")
    fault = cls(**values)
    try:
        fault.validate()
    except (ValueError, InputError) as error:
        raise InputError(f"{where}: {error}") from None
    return fault


def without_severity(faults: Mapping[str, Any], *, source: str, levels: Levels | None = None) -> dict[str, Any]:
    """Return the tables of a scene's faults with the values that their keys `severity` stand for.

    Keys get their current names. What is no known model stays as it is. `levels`: default: those of the package for
    frames of 1024 px. Raises InputError where a level is wrong.
    """
    out = dict(faults)
    for fault_class, table in faults.items():
        if isinstance(table, Mapping):
            models = registry().get(fault_class, {})
            name = table.get("model", next(iter(models), None))
            if isinstance(name, str) and name in models:
                where = f"{source}: faults.{fault_class}"
                known = {f.name for f in dataclasses.fields(models[name])}
                out[fault_class] = with_severity(models[name], with_new_names(table, known, where), where, levels)
    return out


def path_fields(fault_class: str) -> dict[str, str]:
    """Return the keys of a fault class that hold paths, each with its folder of packaged files or ""."""
    return {
        f.name: f.metadata["packaged"]
        for cls in registry().get(fault_class, {}).values()
        for f in dataclasses.fields(cls)
        if f.metadata["kind"] in ("path", "paths")
    }


def json_schema() -> dict[str, Any]:
    """Return the JSON Schema of the `faults` table, made from the fields of every registered model."""
    classes: dict[str, Any] = {}
    for fault_class, models in registry().items():
        options = []
        for name, cls in models.items():
            properties: dict[str, Any] = {"model": {"const": name}}
            if cls.severity is not None:
                properties["severity"] = severity_schema(cls.severity)
            for f in dataclasses.fields(cls):
                properties[f.name] = field_schema(f)
            option = {
                "type": "object",
                "description": " ".join(inspect.cleandoc(cls.__doc__ or "").split("\n\n")[0].split()),
                "properties": properties,
                "additionalProperties": False,
            }
            options.append(option if cls.default else option | {"required": ["model"]})
        classes[fault_class] = options[0] if len(options) == 1 else {"anyOf": options}
    return {
        "type": "object",
        "description": "the faults of the dataset, one table a class",
        "properties": classes,
        "additionalProperties": False,
    }
