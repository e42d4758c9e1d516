"""Read the levels of severity: values of each model's key that cost navigation the same, in five steps.

The packaged table is `scenes/severity/levels.toml`. `vbnfault severity` writes it, and tables of a user's own.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from pydantic import Field

from ..core import tables
from ..core.errors import InputError, shown
from ..core.files import resources
from ..core.files.toml_files import read_toml
from ..core.tables import Table
from .fields import REFERENCE_WIDTH_PX, Severity

if TYPE_CHECKING:
    from .contract import Fault

LEVELS = 5

# NaN: there is no such level
_Value = Annotated[float, Field(allow_inf_nan=True)]
_FiveValues = Annotated[tuple[_Value, ...], Field(min_length=LEVELS, max_length=LEVELS)]
_Pair = tuple[_Value, _Value]


class ModelLevels(Table):
    """Hold the levels of one model, the mildest first."""

    key: str = Field(description="key of the model that the levels set")
    values: _FiveValues = Field(description="value of the key at each level; nan: the model has no such level")
    errors: _FiveValues = Field(description="error of navigation at each level")
    intervals: Annotated[tuple[_Pair, ...], Field(min_length=LEVELS, max_length=LEVELS)] = Field(
        description="95 % interval of each error, by a bootstrap over the views"
    )
    reach: _Pair = Field(description="error at the mildest and at the most severe value of the key")
    views: int = Field(ge=1, description="number of views")
    detector: str = Field(description="packaged sensor; empty: the scene's")


class SeverityTable(Table):
    """Hold a table of levels, and how it was computed."""

    description: str = Field("", description="what the table is for")
    commands: tuple[str, ...] = Field((), description="commands that made the table")
    metric: str = Field(description="metric of navigation that is the error")
    quantile: float = Field(ge=0, le=1, description="quantile over the views")
    errors: _FiveValues = Field(description="error of each level")
    scene: str = Field(description="scene whose views were used")
    lenses: tuple[str, ...] = Field(description="lenses of the views; empty: a thin lens")
    width_px: int = Field(ge=16, le=16384, description="width of the frames")
    levels: dict[str, dict[str, ModelLevels]] = Field(description="levels by fault class and model")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Levels:
    """Read levels from a table for frames of a width. `path` None: the packaged table."""

    path: Path | None = None
    width_px: int = REFERENCE_WIDTH_PX

    @functools.cached_property
    def table(self) -> SeverityTable:
        """Return the table, read at the first use. Raises InputError if the file is missing or wrong."""
        return read_table(self.path or resources.find("scenes/severity", "levels"))


def read_table(path: Path) -> SeverityTable:
    """Return the table of a file. Raises InputError."""
    return tables.parse(SeverityTable, read_toml(path, "severity table"), source=str(path))


def with_severity(
    model: type[Fault], table: Mapping[str, Any], where: str, levels: Levels | None = None
) -> Mapping[str, Any]:
    """Return the table of a fault with the value that its key `severity` stands for, instead of this key.

    The model's severity may hold further keys at every level; those that the table sets itself stay.

    Parameters
    ----------
    model, table
        The model of the fault, and its table in the scene file.
    where
        Name of the table in messages.
    levels
        Default: the packaged levels, for frames of 1024 px.

    Raises
    ------
    InputError
        The key is no level from 1 to 5, the model has no such level, or the table sets the value, too.
    """
    if "severity" not in table:
        return table
    level, severity, levels = table["severity"], model.severity, levels or Levels()
    if severity is None:
        raise InputError(f"{where}.severity: the model {model.model} has no levels of severity; leave the key out")
    if not isinstance(level, int) or isinstance(level, bool) or not 1 <= level <= LEVELS:
        raise InputError(f"{where}.severity = {shown(level)}: must be a whole number from 1 to {LEVELS}")
    if severity.key in table:
        raise InputError(f"{where}.severity = {level}: sets {severity.key}, which is given, too; leave one out")
    value = _value(levels, model, severity, level, f"{where}.severity = {level}")
    declared = next(f.metadata for f in dataclasses.fields(model) if f.name == severity.key)
    most = declared["limits"][1]
    if not (0 < value <= most and math.isfinite(value)):
        raise InputError(
            f"{where}.severity = {level}: {levels.path or 'the packaged table'} has {severity.key} = {value:g} "
            f"there: must be a number above 0 and at most {most:g}"
        )
    rest = {key: value for key, value in table.items() if key != "severity"}
    return {**severity.keys, **rest, severity.key: severity.setting(value, declared)}


def _value(levels: Levels, model: type[Fault], severity: Severity, level: int, where: str) -> float:
    """Return the value of a level for the width of the frames. Raises InputError, which begins with `where`."""
    table = levels.table
    of_model = table.levels.get(model.fault, {}).get(model.model)
    if of_model is None:
        source = levels.path or "the packaged table"
        raise InputError(
            f"{where}: {source} has no levels of {model.fault}/{model.model}; vbnfault severity computes them"
        )
    if tables.new_name(of_model.key) != tables.new_name(severity.key):
        raise InputError(
            f"{where}: {levels.path or 'the packaged table'} has levels of {of_model.key}, but the model "
            f"{model.model} becomes more severe by {severity.key}; compute the table again with vbnfault severity"
        )
    value = of_model.values[level - 1]
    if math.isnan(value):
        least, most = of_model.reach
        known = [str(k + 1) for k, other in enumerate(of_model.values) if not math.isnan(other)]
        raise InputError(
            f"{where}: needs {table.metric} = {table.errors[level - 1]:g}, but {severity.key} of the model "
            f"{model.model} gives {least:.2g} to {most:.2g}; it has "
            f"{'the levels ' + ', '.join(known) if known else 'no level'}"
        )
    return severity.at_width(value, levels.width_px, given_for_px=table.width_px)


def severity_schema(severity: Severity) -> dict[str, Any]:
    """Return the JSON Schema of the key `severity` of a model."""
    keys = " and ".join([severity.key, *severity.keys])
    return {
        "description": f"level of severity, which sets {keys}; equal levels cost navigation the same",
        "type": "integer",
        "minimum": 1,
        "maximum": LEVELS,
    }
