"""Name what a plan and a store number: the strata of the sampling and the splits of a dataset.

This module imports nothing, so that a process that only reads a store starts quickly.
"""

from __future__ import annotations

STRATA = ("sun-facing", "sun-averted")
SUN_FACING, SUN_AVERTED = 0, 1
SPLITS = ("train", "val", "test")
