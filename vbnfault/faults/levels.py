"""Read the levels of severity: values of each model's key that cost navigation the same, in five steps.

The table is the packaged file `scenes/severity/levels.toml`, which `study.severity` writes.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import lru_cache
from typing import TYPE_CHECKING, Any

from ..core import resources
from ..core.errors import InputError, shown
from ..core.toml_files import read_toml
from .fields import Severity

if TYPE_CHECKING:
    from .contract import Fault

LEVELS = 5


def with_severity(model: type[Fault], table: Mapping[str, Any], where: str) -> Mapping[str, Any]:
    """Return the table of a fault with the value that its key `severity` stands for, instead of this key.

    Raises
    ------
    InputError
        The key is no level from 1 to 5, the model has no such level, or the table sets the value, too.
    """
    if "severity" not in table:
        return table
    level, severity = table["severity"], model.severity
    if severity is None:
        raise InputError(f"{where}.severity: the model {model.model} has no levels of severity; leave the key out")
    if not isinstance(level, int) or isinstance(level, bool) or not 1 <= level <= LEVELS:
        raise InputError(f"{where}.severity = {shown(level)}: must be a whole number from 1 to {LEVELS}")
    if severity.key in table:
        raise InputError(f"{where}.severity = {level}: sets {severity.key}, which is given, too; leave one out")
    values = _packaged().get(model.fault, {}).get(model.model, {}).get("values", [])
    if len(values) < level or math.isnan(values[level - 1]):
        known = [str(k + 1) for k, value in enumerate(values) if not math.isnan(value)]
        raise InputError(
            f"{where}.severity = {level}: no value of {severity.key} of the model {model.model} costs navigation "
            f"as much as that level; it has {'the levels ' + ', '.join(known) if known else 'no level'}"
        )
    return {key: value for key, value in table.items() if key != "severity"} | {severity.key: values[level - 1]}


def severity_schema(severity: Severity) -> dict[str, Any]:
    """Return the JSON Schema of the key `severity` of a model."""
    return {
        "description": f"level of severity, which sets {severity.key}; equal levels cost navigation the same",
        "type": "integer",
        "minimum": 1,
        "maximum": LEVELS,
    }


@lru_cache(maxsize=1)
def _packaged() -> Mapping[str, Mapping[str, Mapping[str, Any]]]:
    """Return the packaged levels by class and model."""
    table = read_toml(resources.find("scenes/severity", "levels"), "severity table")
    levels: Mapping[str, Mapping[str, Mapping[str, Any]]] = table["levels"]
    return levels
