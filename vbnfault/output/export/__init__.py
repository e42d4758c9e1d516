"""Export a store to the formats of other tools: one file in `formats` for each, found by its name.

`run.export_store` does the work. `contract.Format` says what a format provides, `regions` finds connected regions
of masks and encodes them, `folder` writes the files and keeps what an interrupted export has finished.
"""

from .contract import Entry, ExportPart, Format, formats
from .run import ExportSummary, export_store

__all__ = ["Entry", "ExportPart", "ExportSummary", "Format", "export_store", "formats"]
