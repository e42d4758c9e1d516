"""Rows of tables of poses, whose cameras look at the origin of T."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from vbnfault.scene.trajectory import COLUMNS

Rows = list[dict[str, Any]]


def row(name: str, camera_T_m: Any, sun_T: Any = (0.0, 0.6, 0.8), **values: Any) -> dict[str, Any]:
    """Return one row of a table; the camera looks at the origin of T."""
    camera = np.array(camera_T_m, dtype=float)
    z = -camera / np.linalg.norm(camera)
    x = np.cross([0.3, 0.5, 0.8], z)
    x /= np.linalg.norm(x)
    camera_from_T = Rotation.from_matrix(np.stack([x, np.cross(z, x), z])).as_quat(scalar_first=True)
    numbers = [2457000.5, *camera, *camera_from_T, *sun_T, 2.5]
    return {**dict(zip(COLUMNS, [name, *numbers], strict=True)), **values}


def columns_of(table: Sequence[dict[str, Any]]) -> dict[str, list[Any]]:
    """Return a table as columns."""
    return {name: [values[name] for values in table] for name in COLUMNS}
