"""Define the fault classes and their models; `base` states the contract that every model follows."""

from .base import (
    FAULT_AXIS,
    MOSAIC_STEPS,
    PHYSICAL_ORDER,
    QUANTITIES,
    STEPS,
    Fault,
    FaultContext,
    Interval,
    Params,
    act,
    dataset_order,
    from_dict,
    json_schema,
    physical_order,
    registry,
)

__all__ = [
    "FAULT_AXIS",
    "MOSAIC_STEPS",
    "PHYSICAL_ORDER",
    "QUANTITIES",
    "STEPS",
    "Fault",
    "FaultContext",
    "Interval",
    "Params",
    "act",
    "dataset_order",
    "from_dict",
    "json_schema",
    "physical_order",
    "registry",
]
