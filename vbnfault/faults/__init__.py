"""Define the fault classes and their models; `contract` states what every model follows."""

from .context import FaultContext, FrameBefore, Params
from .contract import MOSAIC_STEPS, QUANTITIES, STEPS, Fault
from .fields import Interval, Severity, bounds, choice, flag, number, path, rows, text
from .levels import LEVELS, Levels, ModelLevels, SeverityTable, read_table
from .models import (
    dataset_order,
    from_dict,
    is_packaged,
    json_schema,
    path_fields,
    physical_order,
    registry,
    without_severity,
)
from .plugins import Plugin, belongs_here, load_plugins, loaded_plugin, plugins_of

__all__ = [
    "LEVELS",
    "MOSAIC_STEPS",
    "QUANTITIES",
    "STEPS",
    "Fault",
    "FaultContext",
    "FrameBefore",
    "Interval",
    "Levels",
    "ModelLevels",
    "Params",
    "Plugin",
    "Severity",
    "SeverityTable",
    "belongs_here",
    "bounds",
    "choice",
    "dataset_order",
    "flag",
    "from_dict",
    "is_packaged",
    "json_schema",
    "load_plugins",
    "loaded_plugin",
    "number",
    "path",
    "path_fields",
    "physical_order",
    "plugins_of",
    "read_table",
    "registry",
    "rows",
    "text",
    "without_severity",
]
