"""Write results as JSON that every parser reads."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ..core.whole_files import write_whole


def plain(value: Any) -> Any:
    """Return a value as JSON can hold it.

    Arrays and tuples become lists. NaN and infinity, which JSON does not have, become None: the value is undefined
    or has no bound.
    """
    if isinstance(value, Mapping):
        return {key: plain(inner) for key, inner in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        return plain(value.tolist())
    if isinstance(value, list | tuple):
        return [plain(inner) for inner in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def write_json(path: Path, value: Any, *, indent: int = 2) -> None:
    """Write a value as JSON, null where a number is not finite; see `plain`."""
    write_whole(path, json.dumps(plain(value), indent=indent, allow_nan=False) + "\n")
