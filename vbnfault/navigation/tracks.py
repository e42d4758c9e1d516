"""Follow points of the ground through the frames of a sequence, by the stored poses and depth."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..core.errors import InputError, shown
from .geometry import CameraView
from .images import F64

_SPACECRAFT = 3  # in `semantic`


@dataclass(frozen=True, kw_only=True, eq=False)
class Tracks:
    """Hold where points of the ground are in the frames of a sequence.

    `xy_px` float64[frame, point, 2] are their pixels, whether or not something hides them; NaN behind the camera,
    where the distortion of the camera does not hold, and for points that are not of the ground. `visible`
    bool[frame, point] says whether a frame shows them.
    """

    xy_px: F64
    visible: NDArray[np.bool_]


def tracks(data: Mapping[str, Any], sequence: str, xy_px: ArrayLike, *, frame: int = 0) -> Tracks:
    """Return where the ground that pixels of one frame show is in all finished frames of its sequence.

    A point is at the depth of its pixel's centre, so tracks are exact for centres. It is visible where it lies in
    the frame and at most the width of a pixel on the ground behind the farthest of the four pixel centres around
    it, so that a limb hides it up to one pixel late.

    Parameters
    ----------
    data
        A dataset with the layer `depth_m` or `point_T_m`, as `vbnfault.open_dataset` returns it.
    sequence
        Name of the sequence.
    xy_px
        float[point, 2]: pixels (x, y) of the frame, centres at +0.5. Those of the sky have no track, nor those of
        the spacecraft, which only a dataset with the layer `semantic` tells from the ground.
    frame
        Number of this frame, from 0.

    Raises
    ------
    InputError
        The dataset has no such sequence, frame or layer, or the pixels have another shape.
    """
    rows = _rows(data, sequence)
    if frame not in rows:
        raise InputError(
            f"frame = {shown(frame)}: must be a finished frame of {sequence}: {', '.join(map(str, rows))}"
        )
    xy = np.asarray(xy_px, np.float64)
    if xy.ndim != 2 or xy.shape[1] != 2:
        raise InputError(f"xy_px: shape {xy.shape}: must be [point, 2]")
    start = _view_of(data, rows[frame])
    points_T_m = np.where(_is_ground(data, rows[frame], start, xy)[:, None], start.points_T_m(xy), np.nan)
    positions, visible = np.empty((len(rows), *xy.shape)), np.zeros((len(rows), len(xy)), bool)
    for k, row in enumerate(rows.values()):
        view = _view_of(data, row)
        positions[k] = view.project(points_T_m)
        depth_m = np.abs((points_T_m - view.camera_position_T_m) @ view.camera_from_T[2])
        visible[k] = depth_m <= _farthest_m(view, positions[k]) * (1 + 1 / view.intrinsics[0])
    return Tracks(xy_px=positions, visible=visible)


def _rows(data: Mapping[str, Any], sequence: str) -> dict[int, int]:
    """Return the finished samples of a sequence, by the numbers of their frames. Raises InputError."""
    if "sequence" not in data:
        raise InputError("data: has no sequences; tracks need a dataset whose samples are frames of such")
    if not {"depth_m", "point_T_m"} & set(data):
        raise InputError(
            "data: has neither the layer depth_m nor point_T_m, and tracks need one; build it with one"
        )
    names = list(data["sequence"].attrs["names"])
    if sequence not in names:
        raise InputError(f"sequence = {shown(sequence)}: must be one of {', '.join(names)}")
    is_of = (data["sequence"].values == names.index(sequence)) & (data["done"].values != 0)
    numbers = data["frame"].values
    return {int(numbers[k]): int(k) for k in np.flatnonzero(is_of)[np.argsort(numbers[is_of], kind="stable")]}


def _view_of(data: Mapping[str, Any], row: int) -> CameraView:
    """Return how the camera saw a sample, with its depth."""
    values = {
        name: data[name][row].values
        for name in ("intrinsics", "distortion", "camera_from_T", "camera_position_T_m")
    }
    view = CameraView(
        **values,
        model=data["distortion"].attrs.get("model", "opencv"),
        valid_to_deg=data["distortion"].attrs.get("valid_to_deg"),
        skew_px=data["intrinsics"].attrs.get("skew_px", 0.0),
    )
    if "depth_m" in data:
        return replace(view, depth_m=data["depth_m"][row].values)
    depth_m = (data["point_T_m"][row].values - view.camera_position_T_m) @ view.camera_from_T[2]
    return replace(view, depth_m=np.where(np.isnan(depth_m), np.inf, depth_m))


def _is_ground(data: Mapping[str, Any], row: int, view: CameraView, xy: F64) -> NDArray[np.bool_]:
    """Return which pixels of a sample show the ground, bool[point]."""
    ground = np.isfinite(np.asarray(view.depth_m))
    if "semantic" in data:
        ground &= data["semantic"][row].values != _SPACECRAFT
    column, line = np.floor(np.clip(xy, 0, np.subtract(ground.shape[::-1], 1))).astype(int).T
    return np.asarray(ground[line, column])


def _farthest_m(view: CameraView, xy: F64) -> F64:
    """Return the greatest depth at the four pixel centres around positions, float64[point]; NaN outside."""
    depth_m = np.abs(np.asarray(view.depth_m, np.float64))
    size = np.array(depth_m.shape[::-1])
    inside = np.asarray(((xy >= 0) & (xy < size)).all(axis=1))
    first = np.floor(np.where(inside[:, None], xy, 0) - 0.5).astype(int)
    out = np.full(len(xy), -np.inf)
    for step in ((0, 0), (0, 1), (1, 0), (1, 1)):
        column, row = np.clip(first + step, 0, size - 1).T
        out = np.maximum(out, depth_m[row, column])
    return np.where(inside, out, np.nan)
