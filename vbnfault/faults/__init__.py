"""Fault classes and their models; see `base` for the contract."""

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
