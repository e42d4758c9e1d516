"""Complete the table of a sensor file, so that a test needs to write only the keys that it is about."""

from __future__ import annotations

from typing import Any

REQUIRED: dict[str, Any] = {
    "architecture": "cmos",
    "pixel_pitch_um": 5.5,
    "readout": {"bits": 12, "full_well_e": 15_000.0},
}


def completed(table: dict[str, Any]) -> dict[str, Any]:
    """Return a table with the keys that every file must have, and with the sources of those that it lacked."""
    whole = REQUIRED | table
    readout = table.get("readout", {})
    sources = {} if "pixel_pitch_um" in table else {"pixel_pitch_um": "assumed"}
    if isinstance(readout, dict):
        whole["readout"] = REQUIRED["readout"] | readout
        sources |= {f"readout.{key}": "assumed" for key in REQUIRED["readout"] if key not in readout}
    return whole | {"sources": sources | table.get("sources", {})}
