"""Define the fault classes and their models; `contract` states what every model follows."""

from .context import FaultContext, Params
from .contract import MOSAIC_STEPS, QUANTITIES, STEPS, Fault, act
from .fields import Interval, bounds, choice, flag, number, path, rows, text
from .models import dataset_order, from_dict, json_schema, physical_order, registry

__all__ = [
    "MOSAIC_STEPS",
    "QUANTITIES",
    "STEPS",
    "Fault",
    "FaultContext",
    "Interval",
    "Params",
    "act",
    "bounds",
    "choice",
    "dataset_order",
    "flag",
    "from_dict",
    "json_schema",
    "number",
    "path",
    "physical_order",
    "registry",
    "rows",
    "text",
]
