"""Keep all fault models, in the order of the dataset, and read the faults of a scene file.

The definition of a model registers it. The orders of the classes follow from what their default models declare.
"""

from __future__ import annotations

import contextlib
import dataclasses
import inspect
from collections.abc import Callable, Collection, Iterable, Mapping
from functools import lru_cache
from typing import TYPE_CHECKING, Any

from ..core.errors import InputError, VbnfaultError, shown
from ..core.registry import DeclarationError, Registry, chained, is_name
from ..core.registry import undoing_registrations as undoing_all
from ..core.tables import did_you_mean
from .fields import field_schema, parse_field
from .levels import Levels, severity_schema, with_severity

if TYPE_CHECKING:
    from .contract import Fault

_PACKAGE = __package__ or ""


def _forget_orders() -> None:
    """Forget what was computed from the models that were registered so far."""
    _sorted_registry.cache_clear()
    _physical_order.cache_clear()


# "class/model" → type
_REGISTRY: Registry[type[Fault]] = Registry("fault model", _PACKAGE, changed=_forget_orders)


def _models() -> dict[str, dict[str, type[Fault]]]:
    """Return fault class → model → type of the models that are registered so far."""
    classes: dict[str, dict[str, type[Fault]]] = {}
    for cls in _REGISTRY.registered().values():
        classes.setdefault(cls.fault, {})[cls.model] = cls
    return classes


def register(cls: type[Fault]) -> None:
    """Add a model to the registry. Raise DeclarationError if its names or declarations contradict the others'."""
    where = f"fault model {cls.fault}/{cls.model}"
    if not is_name(cls.fault) or not is_name(cls.model):
        text = f"{where}: its names must consist of lower-case letters, digits and underscores"
        raise DeclarationError([cls.fault], text)
    others = {name: other for name, other in _REGISTRY.registered().items() if other.fault == cls.fault}
    replaceable = {name for name in others if _REGISTRY.is_replaceable(name)}
    if cls.default:
        rivals = [m for name, m in others.items() if m.default and m.model != cls.model and name not in replaceable]
        if rivals:
            text = f"{where}: default = True, but {rivals[0].fault}/{rivals[0].model} is the default of the class"
            raise DeclarationError([cls.fault], text)
        if cls.after is None:
            text = f"{where}: the default model must state the class after which its class acts: after = ..."
            raise DeclarationError([cls.fault], text)
        if cls.axis is not None and not is_packaged(cls):
            text = f"{where}: axis = {cls.axis}: only the six classes of the paper have a position"
            raise DeclarationError([cls.fault], text)
    name = f"{cls.fault}/{cls.model}"
    _REGISTRY.add(name, cls, module=cls.__module__, qualname=cls.__qualname__)
    # a plug-in of another scene may have defined the whole class, with a default model of its own
    _REGISTRY.remove(replaceable - {name})


def is_registered(cls: type[Fault]) -> bool:
    """Return whether the names of a model belong to this class; the same class of the same file is put back."""
    name = f"{cls.fault}/{cls.model}"
    if not _REGISTRY.holds(name, cls):
        return False
    if _REGISTRY[name] is not cls:
        register(cls)
    return True


def models_of(condition: Callable[[type[Fault]], bool]) -> tuple[type[Fault], ...]:
    """Return the registered models that meet a condition."""
    return tuple(cls for cls in _REGISTRY.registered().values() if condition(cls))


def undoing_registrations(*, always: bool = False) -> contextlib.AbstractContextManager[None]:
    """Return a context that forgets what its block registers if the block raises an exception, or `always`."""
    _import_all()
    return undoing_all(always=always)


def is_packaged(cls: type[Fault]) -> bool:
    """Return whether a model belongs to vbnfault itself."""
    return _REGISTRY.is_packaged(cls)


def registry() -> dict[str, dict[str, type[Fault]]]:
    """Return fault class → model → type, with the classes in the order of the dataset.

    The first model of each class is its default. The others are sorted by module, those of this package first,
    whatever the order of imports. Models of installed plug-ins are among them. A class from a plug-in of another
    scene is missing if it has no place in the physical order any more.

    Raises
    ------
    DeclarationError
        If what the classes declare does not fit together.
    InputError
        If an installed plug-in is broken.
    """
    _import_all()
    return _sorted_registry()


def check_declarations() -> None:
    """Raise DeclarationError if what the registered classes declare does not fit together."""
    _sorted_registry()


@lru_cache(maxsize=1)
def _import_all() -> None:
    """Import every module of this package and every installed plug-in, so that all models are registered."""
    _REGISTRY.complete()
    from .plugins import load_installed

    load_installed()


@lru_cache(maxsize=1)
def _sorted_registry() -> dict[str, dict[str, type[Fault]]]:
    """Return the registry as it is now; see `registry`."""

    def position(cls: type[Fault]) -> tuple[bool, bool, str]:
        return not cls.default, not is_packaged(cls), cls.__module__

    for cls in _REGISTRY.registered().values():
        _check_fields(cls)
    known = _models()
    return {
        name: {cls.model: cls for cls in sorted(known[name].values(), key=position)}
        for name in _on_axis(_physical_order())
    }


def _check_fields(cls: type[Fault]) -> None:
    """Raise DeclarationError if a model is no frozen, keyword-only dataclass of fields made by the helpers."""
    where = f"fault model {cls.fault}/{cls.model}"
    options = cls.__dict__.get("__dataclass_params__")
    if options is None or not (options.frozen and getattr(options, "kw_only", True)):
        raise DeclarationError(
            [cls.fault], f"{where}: its class must be decorated with @dataclass(frozen=True, kw_only=True)"
        )
    for f in dataclasses.fields(cls):
        if "kind" not in f.metadata:
            raise DeclarationError(
                [cls.fault], f"{where}: {f.name} must be declared with one of the field helpers, such as bounds()"
            )

    _check_severity(cls, where)


def _check_severity(cls: type[Fault], where: str) -> None:
    """Raise DeclarationError if the severity of a model names no number of its, or leaves the number's limits."""
    severity = cls.severity
    if severity is None:
        return
    declared = {f.name: f.metadata for f in dataclasses.fields(cls) if "limits" in f.metadata}
    if severity.key not in declared:
        raise DeclarationError([cls.fault], f"{where}: its severity names {severity.key!r}, no number of it")
    unknown = severity.keys.keys() - {f.name for f in dataclasses.fields(cls)}
    if unknown:
        raise DeclarationError([cls.fault], f"{where}: its severity holds {min(unknown)!r}, no key of it")
    low, high = declared[severity.key]["limits"]
    if not all(max(low, 0) <= value <= high and value > 0 for value in (severity.low, severity.high)):
        raise DeclarationError(
            [cls.fault],
            f"{where}: its severity goes from {severity.low:g} to {severity.high:g}: must be above 0 and within "
            f"the limits [{low:g}, {high:g}] of {severity.key}",
        )


def _defaults() -> dict[str, type[Fault]]:
    """Return the default model of every class. Raise DeclarationError if a class has none."""
    known = _models()
    defaults = {cls.fault: cls for models in known.values() for cls in models.values() if cls.default}
    for name, models in known.items():
        if name not in defaults:
            raise DeclarationError(
                [name], f"fault class {name}: none of its models ({', '.join(models)}) states default = True"
            )
    return defaults


@lru_cache(maxsize=1)
def _physical_order() -> tuple[str, ...]:
    """Return all classes in the order in which their effects act.

    The `after` of the classes form a tree with one root. The classes of this package are one long branch of it; a
    class of a plug-in comes directly behind the class that it names.
    """
    defaults = _defaults()
    packaged = {name for name, cls in defaults.items() if is_packaged(cls)}
    of_others = _REGISTRY.unused()
    unused = {name for name, cls in defaults.items() if f"{name}/{cls.model}" in of_others}
    return chained({name: str(cls.after) for name, cls in defaults.items()}, packaged, "fault class", unused)


def dataset_order(names: Iterable[str]) -> list[str]:
    """Return the names in the order of the dataset's `fault` axis."""
    _import_all()
    return _on_axis(names)


def _on_axis(names: Iterable[str]) -> list[str]:
    """Return the names as `dataset_order` does, from the models that are registered so far."""
    axis = {cls.fault: cls.axis for cls in _defaults().values()}

    def position(name: str) -> tuple[float, str]:
        index = axis.get(name)
        return float("inf") if index is None else index, name

    return sorted(set(names), key=position)


def physical_order(names: Collection[str]) -> list[str]:
    """Return the names in the order in which the effects act. Raises VbnfaultError for an unknown class."""
    _import_all()
    position = {name: k for k, name in enumerate(_physical_order())}
    for name in names:
        if name not in position:
            raise VbnfaultError(f"fault class {name}: its plug-in is not loaded any more; load the scene again")
    return sorted(set(names), key=position.__getitem__)


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

    What is no known model stays as it is. `levels`: default: those of the package for frames of 1024 px. Raises
    InputError where a level is wrong.
    """
    out = dict(faults)
    for fault_class, table in faults.items():
        if isinstance(table, Mapping) and "severity" in table:
            models = registry().get(fault_class, {})
            name = table.get("model", next(iter(models), None))
            if isinstance(name, str) and name in models:
                out[fault_class] = with_severity(models[name], table, f"{source}: faults.{fault_class}", levels)
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
