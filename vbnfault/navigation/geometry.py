"""Relate pixels of two views by depth, pose and the camera model that a dataset stores.

Pixel coordinates are (x, y) from the image's top left corner; pixel centres lie at +0.5. The camera model is
OpenCV's: intrinsics fx, fy, cx, cy and the coefficients of a `core.calibration`.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.calibration import Calibration
from ..core.errors import InputError, under_key

F64 = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True, eq=False)
class CameraView:
    """Describe how a camera saw one image: its model, its true pose, and the depth that it saw.

    The names are those of the arrays of a dataset.

    Attributes
    ----------
    intrinsics
        float64[4]: fx, fy, cx, cy in px.
    camera_from_T
        Attitude: the unit quaternion w, x, y, z, float64[4], or the rotation matrix, float64[3, 3], that takes
        vectors of the target's frame T to the camera's frame C (x right, y down, z along the boresight).
    camera_position_T_m
        float64[3]: position of the camera in T, in m. Any frame that is fixed in the ground serves as T.
    distortion
        OpenCV's k1, k2, p1, p2, k3, k4, k5, k6, float64[8], the first 4 or 5 of them, or 12 or 14 with thin prism
        and tilt; k1 to k4 of a fisheye.
    model
        "opencv", "fisheye" or "undistorting" (`Calibration`): the attribute `model` of the array `distortion` of a
        calibrated camera.
    valid_to_deg
        Angle from the boresight up to which `distortion` holds, the attribute `valid_to_deg` of the array
        `distortion`. None: up to where the model first folds, which is computed. Farther directions have no pixel.
    skew_px
        By how much a step of one focal length down moves to the right, the attribute `skew_px` of the array
        `intrinsics`.
    depth_m
        float[y, x]: true depth along the boresight at the pixel centres in m, inf on the sky; None where it is not
        needed.

    Raises
    ------
    InputError
        A field has another shape.
    """

    intrinsics: F64
    camera_from_T: F64
    camera_position_T_m: F64
    distortion: F64 = field(default_factory=lambda: np.zeros(8))
    model: str = "opencv"
    valid_to_deg: float | None = None
    skew_px: float = 0.0
    depth_m: NDArray[Any] | None = None

    def __post_init__(self) -> None:
        for name, shapes in _SHAPES.items():
            value = np.asarray(getattr(self, name), dtype=np.float64)
            if value.shape not in shapes or not np.isfinite(value).all():
                allowed = " or ".join(str(shape) for shape in shapes)
                raise InputError(f"view.{name}: shape {value.shape}: must be finite numbers of shape {allowed}")
            object.__setattr__(self, name, value)
        if self.depth_m is not None and np.ndim(self.depth_m) != 2:
            raise InputError(f"view.depth_m: shape {np.shape(self.depth_m)}: must be [y, x]")
        attitude = self.camera_from_T
        matrix = attitude if attitude.shape == (3, 3) else _matrix(attitude)
        if np.abs(matrix @ matrix.T - np.eye(3)).max() > 1e-6:
            raise InputError("view.camera_from_T: is no rotation; give a rotation matrix or a unit quaternion")
        object.__setattr__(self, "camera_from_T", matrix)
        if self.valid_to_deg is not None and not 0 < self.valid_to_deg <= 180:
            raise InputError(f"view.valid_to_deg = {self.valid_to_deg}: must be above 0 and at most 180")
        with under_key("view"):
            _ = self.calibration

    @property
    def matrix(self) -> F64:
        """Return OpenCV's camera matrix, float64[3, 3]."""
        fx, fy, cx, cy = self.intrinsics
        return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])

    def slopes(self, xy: F64) -> F64:
        """Return the tangents x/z and y/z in C that the pixels `xy` float64[n, 2] see, float64[n, 2].

        NaN for pixels so far outside the frame that no direction up to `valid_to_deg` reaches them.
        """
        directions = self.calibration.directions_of(xy)
        slopes = directions[:, :2] / directions[:, 2:]
        return np.where(self._is_valid(directions), slopes, np.nan)

    @property
    def calibration(self) -> Calibration:
        """Return the camera model as a calibration; the size of its image is unknown."""
        fx, fy, cx, cy = self.intrinsics.tolist()
        coefficients = tuple(self.distortion.tolist())
        return Calibration(
            model=self.model,
            width_px=1,
            height_px=1,
            fx=fx,
            fy=fy,
            cx=cx,
            cy=cy,
            coefficients=coefficients,
            skew=self.skew_px,
        )

    def _is_valid(self, directions: F64) -> NDArray[np.bool_]:
        """Return whether the distortion holds for directions float64[n, 3], bool[n, 1]."""
        limit_deg = self.calibration.valid_to_deg if self.valid_to_deg is None else self.valid_to_deg
        across = np.hypot(directions[:, :1], directions[:, 1:2])
        return np.asarray(np.degrees(np.arctan2(across, directions[:, 2:])) <= limit_deg)

    def points_T_m(self, xy: F64) -> F64:
        """Return the points of the ground that pixels see, float64[n, 3] in T; NaN where they see the sky.

        A pixel of the sky next to the ground counts as the nearest ground of its eight neighbours, since features
        at the limb may lie just outside.

        Raises
        ------
        InputError
            The view has no depth.
        """
        depth = self.depth_at(xy)
        slopes = self.slopes(xy)
        seen_C = np.column_stack([slopes * depth[:, None], depth])
        return np.asarray(seen_C @ self.camera_from_T + self.camera_position_T_m)

    def depth_at(self, xy: F64) -> F64:
        """Return the depth of pixels, float64[n] in m; NaN on the sky and outside the frame."""
        if self.depth_m is None:
            raise InputError("view.depth_m: is None, and true positions need the depth at the pixel centres")
        depth = np.asarray(self.depth_m)
        height, width = depth.shape
        column, row = np.floor(np.asarray(xy, dtype=np.float64)).astype(np.int64).T
        inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
        column, row = np.clip(column, 0, width - 1), np.clip(row, 0, height - 1)
        own = depth[row, column].astype(np.float64)
        around = np.full(len(own), np.inf)
        for dy in (-1, 0, 1):
            for dx in (-1, 0, 1):
                near = depth[np.clip(row + dy, 0, height - 1), np.clip(column + dx, 0, width - 1)]
                around = np.fmin(around, near)
        own = np.where(np.isfinite(own), own, around)
        return np.where(inside & np.isfinite(own), own, np.nan)

    def project(self, points_T_m: F64) -> F64:
        """Return the pixels of points float64[n, 3] in T, float64[n, 2].

        NaN where they lie behind the camera (a fisheye sees there, too), or farther off its boresight than
        `valid_to_deg`: there the distortion may fold back into the frame.
        """
        in_C = (np.asarray(points_T_m, dtype=np.float64) - self.camera_position_T_m) @ self.camera_from_T.T
        return np.where(self._is_valid(in_C), self.calibration.pixel_of(in_C), np.nan)


_SHAPES: dict[str, tuple[tuple[int, ...], ...]] = {
    "intrinsics": ((4,),),
    "camera_from_T": ((4,), (3, 3)),
    "camera_position_T_m": ((3,),),
    "distortion": ((8,), (4,), (5,), (12,), (14,)),
}


def reprojected(xy: F64, from_view: CameraView, to_view: CameraView) -> F64:
    """Return where the ground that pixels of one view see lies in another view.

    Parameters
    ----------
    xy
        float64[n, 2]: pixels of `from_view`, whose `depth_m` is needed.

    Returns
    -------
    float64[n, 2]
        Pixels of `to_view`, whether or not something hides the ground there; NaN where `from_view` sees the sky,
        and where the ground lies behind `to_view` or farther off its boresight than `valid_to_deg`.

    Raises
    ------
    InputError
        `from_view` has no depth.
    """
    return to_view.project(from_view.points_T_m(xy))


def relative_motion(first: CameraView, second: CameraView) -> tuple[F64, F64]:
    """Return the true motion between two views: second_from_first float64[3, 3], and its translation in m.

    The translation is float64[3]. A point x of the first camera's frame lies at R x + t in the second camera's
    frame.
    """
    rotation = second.camera_from_T @ first.camera_from_T.T
    return rotation, second.camera_from_T @ (first.camera_position_T_m - second.camera_position_T_m)


def rotation_angle_deg(rotation: F64) -> float:
    """Return the angle of a rotation matrix in degrees, accurate to rounding also near 0."""
    return float(np.degrees(np.linalg.norm(cv2.Rodrigues(np.ascontiguousarray(rotation))[0])))


def _matrix(quaternion: F64) -> F64:
    """Return the rotation matrix of a quaternion w, x, y, z."""
    w, x, y, z = quaternion
    return np.array(
        [
            [w * w + x * x - y * y - z * z, 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), w * w - x * x + y * y - z * z, 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z],
        ]
    )
