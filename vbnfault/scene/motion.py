"""Define `[motion]`, and find how fast a camera moves and turns from the poses of a sequence."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from ..core.tables import Table

F64 = NDArray[np.float64]


class MotionTable(Table):
    """Let the camera move during its exposure, with the velocity and the rate of its pose.

    The Sun's direction over the ground stays that of mid-exposure.
    """

    shutter: Literal["global", "rolling"] = Field(
        "global",
        description="global: all pixels are exposed at once; rolling: one line after the other, the line that is "
        "read first is the first",
    )
    line_time_s: float = Field(
        0.0,
        ge=0,
        le=1.0,
        description="of a rolling shutter: time between two lines; the middle line is exposed at the pose's time",
    )

    @model_validator(mode="after")
    def _line_time(self) -> MotionTable:
        if (self.shutter == "rolling") != (self.line_time_s > 0):
            raise ValueError(
                f'shutter = "{self.shutter}": line_time_s = {self.line_time_s:g}: must be '
                + ("above 0" if self.shutter == "rolling" else 'left out, or shutter = "rolling"')
            )
        return self


def between_frames(camera_T_m: F64, camera_from_T: F64, time_s: F64, frames: Sequence[int]) -> tuple[F64, F64]:
    """Return velocities and rates of poses, from the poses before and after each in its sequence.

    Parameters
    ----------
    camera_T_m, camera_from_T, time_s
        float64[n, 3], quaternions float64[n, 4] with w first, and float64[n], rising through each sequence.
    frames
        Number of poses of each sequence, one after the other; () for poses of no sequence, which stand still.

    Returns
    -------
    velocity_T_m_s
        float64[n, 3]: velocity over the ground, in T.
    rate_C_rad_s
        float64[n, 3]: rate at which the camera turns over the ground, in C.
    """
    from scipy.spatial.transform import Rotation

    velocity, rate = np.zeros((2, len(time_s), 3))
    T_from_C = Rotation.from_quat(camera_from_T, scalar_first=True).inv()
    last = 0
    for count in frames:
        first, last = last, last + count
        if count > 1:
            here = np.arange(first, last)
            before, after = np.maximum(here - 1, first), np.minimum(here + 1, last - 1)
            apart_s = (time_s[after] - time_s[before])[:, None]
            velocity[here] = (camera_T_m[after] - camera_T_m[before]) / apart_s
            rate[here] = (T_from_C[before].inv() * T_from_C[after]).as_rotvec() / apart_s
    return velocity, rate
