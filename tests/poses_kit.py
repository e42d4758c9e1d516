"""Rows of tables of poses, whose cameras look at the origin of T, and what cameras of a store see."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from vbnfault.scene.trajectory import COLUMNS

F64 = NDArray[np.float64]
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


def C_from_T(data: Any, k: int) -> F64:
    """Return the attitude of a stored sample, float64[3, 3]; `data` holds the arrays of its store."""
    return np.asarray(Rotation.from_quat(np.asarray(data["camera_from_T"][k]), scalar_first=True).as_matrix())


def projected(data: Any, k: int, in_C: F64) -> F64:
    """Return the pixels of vectors float64[n, 3] in C, by OpenCV and what is stored."""
    fx, fy, cx, cy = np.asarray(data["intrinsics"][k])
    matrix, nothing = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]), np.zeros(3)
    is_fisheye = data["distortion"].attrs.get("model") == "fisheye"
    project = cv2.fisheye.projectPoints if is_fisheye else cv2.projectPoints
    coefficients = np.asarray(data["distortion"][k])
    return np.asarray(project(in_C[:, None], nothing, nothing, matrix, coefficients)[0][:, 0])
