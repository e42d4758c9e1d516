"""Describe the files that users write by JSON Schema, for editors that check and complete TOML."""

from __future__ import annotations

from typing import Any

from .. import faults
from ..core import tables
from ..core.errors import InputError, shown
from ..detector import Sensor
from ..lens.prescription_file import PrescriptionFile
from ..scene import config
from ..study.spec import StudySpec

KINDS = ("scene", "lens", "sensor", "study")


def file_schema(kind: str) -> dict[str, Any]:
    """Return the JSON Schema (draft 2020-12) of a kind of file; that of the scene includes all registered faults.

    Rules that tie several keys together, such as that every number of a sensor has a source, are no part of it.

    Raises
    ------
    InputError
        The kind is none of `KINDS`.
    """
    if kind not in KINDS:
        raise InputError(f"schema {shown(kind)}: must be one of {', '.join(KINDS)}")
    if kind == "scene":
        return config.json_schema(faults.json_schema())
    return tables.json_schema({"lens": PrescriptionFile, "sensor": Sensor, "study": StudySpec}[kind])
