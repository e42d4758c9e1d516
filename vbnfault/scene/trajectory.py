"""Read a table of poses: each row is a sample with its camera, its Sun, its date and its name.

The frames are those of `core.frames`. T is the body-fixed frame of the shape file. The camera's axes C are x image
right, y image down, z boresight. The quaternion `camera_from_T` (w first) takes the components of a vector from T
to C, so that a point p of the body lies at R(camera_from_T) · (p - camera_T_m) in C.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from ..core import tables
from ..core.errors import InputError, shown, under_key
from ..core.files import column_files, file_contents
from ..core.frames import matrix_of
from ..core.tables import Table
from .flights import AnyFlight, frames_of
from .motion import between_frames

if TYPE_CHECKING:
    from .config import Scene
    from .instrument import CameraTable

F64 = NDArray[np.float64]

# Numeric column → its allowed range. Quaternion and Sun may exceed 1 by rounding; their norms are checked below.
_UNIT, _SUN = (-1.001, 1.001), ("sun_x_T", "sun_y_T", "sun_z_T")
JULIAN_DATES = (1_000_000, 5_000_000)
_NUMBERS: dict[str, tuple[float, float]] = {
    "julian_date": JULIAN_DATES,
    **dict.fromkeys(("camera_x_T_m", "camera_y_T_m", "camera_z_T_m"), (-1e12, 1e12)),
    **dict.fromkeys((f"camera_from_T_{axis}" for axis in "wxyz"), _UNIT),
    **dict.fromkeys(_SUN, _UNIT),
    "sun_distance_au": (0.01, 1000),
}
COLUMNS = ("name", *_NUMBERS)
# Columns that a table may have: the rows of a sequence are frames that the same camera takes one after the other.
SEQUENCE_COLUMNS = ("sequence", "time_s")
_TIME_S = (-1e9, 1e9)
# Columns that a table may have: how fast the camera moves and turns over the ground, in T and in C. By default, the
# rows before and after of a sequence say so.
_VELOCITY = dict.fromkeys((f"velocity_{axis}_T_m_s" for axis in "xyz"), (-1e6, 1e6))
_RATE = dict.fromkeys((f"rate_{axis}_C_rad_s" for axis in "xyz"), (-100.0, 100.0))
_OPTIONAL = {"time_s": _TIME_S, **_VELOCITY, **_RATE}
MOTION_COLUMNS = (*_VELOCITY, *_RATE)
_DAY_S = 86400.0
# Largest deviation of the norm of a quaternion or of the Sun's direction from 1; they are then scaled to 1. Four
# decimals, as in many labels of images, keep it below 2e-4.
NORM_TOLERANCE = 1e-3
_LONGEST_NAME = 200
_MOST_SITES = 100_000  # of `dataset.sites`
_MOST_ROWS = 1_000_000
_IN_PYTHON = "poses"  # stands for the file's name where the table was given in Python
FLIGHTS = "trajectory.flight"  # stands for the file's name where flights make the table


Frames = Annotated[int, Field(ge=1, le=_MOST_ROWS)]


class TrajectoryTable(Table):
    """Name a table of poses, or flights that make one. Every row is a sample, seen from there at its date.

    `dataset.samples` is then the number of rows by default, and `[geometry]` with its bounds does not apply.
    """

    file: Annotated[str, Field(min_length=1)] | None = Field(
        None,
        description="CSV or Parquet file with the columns name, julian_date, camera_x_T_m, camera_y_T_m, "
        "camera_z_T_m, camera_from_T_w, camera_from_T_x, camera_from_T_y, camera_from_T_z, sun_x_T, sun_y_T, "
        "sun_z_T and sun_distance_au; with sequence and time_s for frames that follow each other, and with "
        "velocity_x_T_m_s to velocity_z_T_m_s and rate_x_C_rad_s to rate_z_C_rad_s where they are known",
    )
    frames: tuple[Frames, ...] = Field((), description="Number of rows of each sequence, which vbnfault fills in")
    flight: tuple[AnyFlight, ...] = Field(
        (), max_length=1000, description="flights in place of a file: each makes sequences of frames"
    )

    @model_validator(mode="after")
    def _file_or_flights(self) -> TrajectoryTable:
        if self.file is not None and self.flight:
            raise ValueError(f"file = {shown(self.file)}: flight makes poses, too; leave one out")
        if self.file is None and not self.flight:
            raise ValueError("file: is missing; a trajectory needs a file, or flights")
        frames = sum(flight.frames * flight.sequences for flight in self.flight)
        if frames > _MOST_ROWS:
            raise ValueError(f"flight: has {frames} frames; must have at most {_MOST_ROWS} all together")
        return self


@dataclass(frozen=True, kw_only=True, eq=False)
class FlownPose:
    """Hold one row: camera and Sun in T.

    `T_from_C` float64[3, 3] has the camera's axes as columns. `sun_direction_T` float64[3] is a unit vector towards
    the Sun. `sequence` is -1 for a row of none; `time_s` counts as the table does. `velocity_T_m_s` and
    `rate_C_rad_s`, float64[3] in T and in C, say how the camera moves and turns over the ground.
    """

    name: str
    julian_date: float
    camera_position_T_m: F64
    T_from_C: F64
    sun_direction_T: F64
    sun_distance_au: float
    sequence: int = -1
    frame: int = 0
    time_s: float = np.nan
    velocity_T_m_s: F64 = field(default_factory=lambda: np.zeros(3))
    rate_C_rad_s: F64 = field(default_factory=lambda: np.zeros(3))


@dataclass(frozen=True, kw_only=True, eq=False)
class Trajectory:
    """Hold a table of n poses.

    Attributes
    ----------
    source
        The file, for messages.
    name
        n different texts.
    julian_date
        float64[n], TDB.
    camera_position_T_m
        float64[n, 3].
    camera_from_T
        float64[n, 4], unit quaternions, w first.
    sun_direction_T
        float64[n, 3], unit vectors towards the Sun.
    sun_distance_au
        float64[n].
    sequence_names
        Names of the sequences, in the order of their rows; () if the rows are not frames of such.
    frames
        Number of rows of each sequence.
    time_s
        float64[n], rising through each sequence; nan without sequences.
    velocity_T_m_s, rate_C_rad_s
        float64[n, 3] in T and in C: how the camera moves and turns over the ground; None: as the rows of the
        sequences say.
    """

    source: str
    name: tuple[str, ...]
    julian_date: F64
    camera_position_T_m: F64
    camera_from_T: F64
    sun_direction_T: F64
    sun_distance_au: F64
    time_s: F64
    sequence_names: tuple[str, ...] = ()
    frames: tuple[int, ...] = ()
    velocity_T_m_s: F64 | None = None
    rate_C_rad_s: F64 | None = None

    def __len__(self) -> int:
        return len(self.name)

    def repeated(self, count: int) -> Trajectory:
        """Return the table with each row `count` times, for samples that share a view: NAME/0, NAME/1, ..."""
        if count == 1:
            return self
        names = tuple(f"{name}/{k}" for name in self.name for k in range(count))
        arrays: dict[str, Any] = {
            f.name: np.repeat(getattr(self, f.name), count, axis=0)
            for f in fields(self)
            if isinstance(getattr(self, f.name), np.ndarray)
        }
        return replace(self, name=names, frames=tuple(count * k for k in self.frames), **arrays)

    @cached_property
    def motion(self) -> tuple[F64, F64]:
        """Return velocity and rate of every row, float64[row, 3] in T and in C, as given or from row to row."""
        moves = between_frames(self.camera_position_T_m, self.camera_from_T, self.time_s, self.frames)
        given = self.velocity_T_m_s, self.rate_C_rad_s
        velocity, rate = (found if known is None else known for known, found in zip(given, moves, strict=True))
        return velocity, rate

    @property
    def shortest_step_s(self) -> float:
        """Return the shortest time between two frames of a sequence; infinity without sequences."""
        last = np.cumsum(self.frames, dtype=int)[:-1]
        steps_s = np.delete(np.diff(self.time_s), last - 1) if self.frames else np.zeros(0)
        return float(steps_s[steps_s > 0].min(initial=np.inf))  # rows that are repeated share a time

    @property
    def boresight_T(self) -> F64:
        """Return the camera's boresight in T of every row, float64[row, 3], unit length."""
        w, x, y, z = self.camera_from_T.T
        return np.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], axis=-1)

    def pose(self, index: int) -> FlownPose:
        """Return one row, counted from 0."""
        sequence, frame = place_in_sequence(self.frames, index)
        return FlownPose(
            name=self.name[index],
            julian_date=float(self.julian_date[index]),
            camera_position_T_m=self.camera_position_T_m[index],
            T_from_C=matrix_of(*self.camera_from_T[index]).T,
            sun_direction_T=self.sun_direction_T[index],
            sun_distance_au=float(self.sun_distance_au[index]),
            sequence=sequence,
            frame=frame,
            time_s=float(self.time_s[index]),
            velocity_T_m_s=self.motion[0][index],
            rate_C_rad_s=self.motion[1][index],
        )

    def after(self, index: int) -> FlownPose | None:
        """Return the row after a row, counted from 0, of its sequence; None if there is none."""
        sequence, frame = place_in_sequence(self.frames, index)
        return self.pose(index + 1) if sequence >= 0 and frame + 1 < self.frames[sequence] else None


def place_in_sequence(frames: Sequence[int], index: int) -> tuple[int, int]:
    """Return the sequence of a row and its frame there, from 0; -1 and 0 without sequences.

    `frames` are the numbers of rows of the sequences, one after the other.
    """
    if not frames:
        return -1, 0
    starts = np.cumsum([0, *frames])
    sequence = int(np.searchsorted(starts, index, side="right")) - 1
    return sequence, index - int(starts[sequence])


def with_rows(scene: Scene, trajectory: Trajectory | None = None) -> Scene:
    """Return the scene with the numbers of samples and sites that its table of poses has.

    A sample is a row. A site stands for the frames of a sequence, or without sequences for `dataset.shard_samples`
    consecutive rows; they share a split.

    Parameters
    ----------
    scene
        The scene. Without a trajectory it is returned as it is.
    trajectory
        Table given in Python, which replaces that of the scene: all its rows are samples. Its rows are repeated
        for the samples that share a view already.

    Raises
    ------
    InputError
        The table is wrong, or has fewer rows than the scene has samples.
    """
    if trajectory is not None:
        scene = scene.model_copy(update={"trajectory": TrajectoryTable(file=_IN_PYTHON)})
        rows, frames, source = len(trajectory), trajectory.frames, trajectory.source
        step_s = trajectory.shortest_step_s
    elif scene.trajectory is None:
        return scene
    elif scene.trajectory.file is None:
        frames, source = frames_of(scene.trajectory.flight), FLIGHTS
        rows, step_s = sum(frames), min(flight.period_s for flight in scene.trajectory.flight)
    else:
        with under_key("trajectory.file"):
            table = load_trajectory(scene.trajectory.file).repeated(scene.dataset.variants_per_view)
        rows, frames, source, step_s = len(table), table.frames, table.source, table.shortest_step_s
    samples = rows
    if trajectory is None and "samples" in scene.dataset.model_fields_set:
        samples = scene.dataset.samples
    if samples > rows:
        raise InputError(
            f"dataset.samples = {samples}: {source} has {rows} rows, and each is a "
            f"sample; must be from 1 to {rows}, or be left out"
        )
    sites = len(frames) or -(-rows // scene.dataset.shard_samples)
    if sites > _MOST_SITES:
        raise InputError(
            f"{source}: has {rows} rows; must have at most "
            f"{_MOST_SITES * scene.dataset.shard_samples}, {_MOST_SITES} times dataset.shard_samples"
        )
    assert scene.trajectory is not None
    flown = scene.trajectory.model_copy(update={"frames": frames})
    dataset = scene.dataset.model_copy(update={"samples": samples, "sites": sites})
    camera = _within_step(scene.camera, step_s, source)
    return scene.model_copy(update={"trajectory": flown, "dataset": dataset, "camera": camera})


def _within_step(camera: CameraTable, step_s: float, source: str) -> CameraTable:
    """Return a camera that exposes no longer than the shortest time between two frames. Raises InputError."""
    name, least_s = "exposure_s", camera.exposure_s
    if least_s == "auto":
        name, least_s = "exposure_min_s", camera.exposure_min_s
    if least_s > step_s:
        raise InputError(
            f"camera.{name} = {least_s:g}: must be at most {step_s:g}, the shortest time in s between two frames "
            f"of {source}"
        )
    return camera.model_copy(update={"exposure_max_s": min(camera.exposure_max_s, step_s)})


@file_contents.cached_with_contents(maxsize=4)
def load_trajectory(path: str) -> Trajectory:
    """Return the poses in a CSV or Parquet file. Raises InputError."""
    texts = ("name", SEQUENCE_COLUMNS[0])
    return _checked(column_files.read_columns(path, "trajectory", _check_names, texts), path)


def as_trajectory(poses: Trajectory | str | Path | Mapping[str, Sequence[Any]] | Any) -> Trajectory:
    """Return poses as a `Trajectory`.

    Parameters
    ----------
    poses
        A trajectory, the path of a CSV or Parquet file, or a table in memory: a mapping from the names of the
        columns to their values, such as a pandas data frame.

    Raises
    ------
    InputError
        The poses are no such table, or a value is wrong.
    """
    if isinstance(poses, Trajectory):
        return poses
    if isinstance(poses, str | Path):
        return load_trajectory(str(poses))
    try:
        columns = {str(name): list(poses[name]) for name in poses}
    except (TypeError, KeyError, IndexError, ValueError):
        raise InputError(
            f"poses = {shown(poses)}: must be a path, a data frame, or a mapping from columns to values"
        ) from None
    return _checked(columns, _IN_PYTHON)


def one_pose(
    pose: Mapping[str, Any] | Sequence[Any],
    sun: Any,
    time: float | None,
    default: float | FlownPose,
    distance_au: Callable[[float], float],
) -> Trajectory:
    """Return a table of one pose.

    Parameters
    ----------
    pose
        Position in T in m, float[3], and the quaternion `camera_from_T`, w first, float[4]; or a mapping with the
        columns of a table, such as a row of a data frame, of which only the camera's are needed.
    sun
        Direction from the body to the Sun in T, float[3], of any length; None: the mapping's.
    time
        Julian date, TDB; None: the mapping's.
    default
        Julian date, or the pose with the date and the Sun, of what neither these nor the mapping have.
    distance_au
        Gives the distance from the Sun at a date, where the mapping has none.

    Raises
    ------
    InputError
        Something is missing, or no pose.
    """
    row: dict[str, Any] = {"name": "pose", "julian_date": default}
    if isinstance(default, FlownPose):
        row |= {"julian_date": default.julian_date} | (
            {"sun_distance_au": default.sun_distance_au} if time is None else {}
        )
        row |= dict(zip(_SUN, default.sun_direction_T.tolist(), strict=True))
    camera = [f"camera_{axis}_T_m" for axis in "xyz"] + [f"camera_from_T_{axis}" for axis in "wxyz"]
    if isinstance(pose, Mapping) or hasattr(pose, "keys"):
        row |= dict(pose)
    else:
        try:
            numbers = [*map(float, pose[0]), *map(float, pose[1])]
            row |= dict(zip(camera, numbers, strict=True))
        except (TypeError, ValueError, IndexError):
            raise InputError(
                f"pose = {shown(pose)}: must be a position in m and a quaternion, w first, or a row of a table of "
                "poses"
            ) from None
    if sun is not None:
        try:
            towards = np.array([float(x) for x in sun])
            length = float(np.linalg.norm(towards))
        except (TypeError, ValueError):
            towards, length = np.zeros(0), 0.0
        if towards.shape != (3,) or not 0 < length < np.inf:
            raise InputError(
                f"sun = {shown(sun)}: must be three numbers, the direction from the body to the Sun in T"
            )
        row |= dict(zip(_SUN, (towards / length).tolist(), strict=True))
    if time is not None:
        row["julian_date"] = time
    if "sun_distance_au" not in row:
        row["sun_distance_au"] = distance_au(float(_numbers([row["julian_date"]], "julian_date", "pose")[0]))
    if missing := [name for name in COLUMNS if name not in row]:
        raise InputError(f"pose: {', '.join(missing)} is missing; sun gives the Sun's direction")
    return _checked({name: [value] for name, value in row.items()}, "pose")


def _check_names(names: Sequence[str], source: str) -> None:
    """Raise InputError unless each column of a table of poses is there once, and no other."""
    if names and not any(name in COLUMNS for name in names) and any(tables.is_number(name) for name in names):
        raise InputError(f"{source}: its first line is one of numbers; must name the columns: {', '.join(COLUMNS)}")
    column_files.check_once(names, source)
    missing = [name for name in COLUMNS if name not in names]
    unknown = [name for name in names if name not in COLUMNS + SEQUENCE_COLUMNS + MOTION_COLUMNS]
    for columns in (_VELOCITY, _RATE):
        lacking = [name for name in columns if name not in names]
        if 0 < len(lacking) < len(columns):
            raise InputError(
                f"{source}: columns are missing: {', '.join(lacking)}; must be there together with "
                f"{', '.join(name for name in columns if name in names)}"
            )
    if missing or unknown:
        clauses = [f"columns are missing: {', '.join(missing)}"] if missing else []
        clauses += [f"unknown columns: {', '.join(shown(name) for name in unknown[:5])}"] if unknown else []
        raise InputError(
            f"{source}: {'; '.join(clauses)}; must have exactly the columns {', '.join(COLUMNS)}, and may have "
            f"{', '.join(SEQUENCE_COLUMNS)}, {', '.join(_VELOCITY)} and {', '.join(_RATE)}"
        )


def _checked(columns: Mapping[str, Sequence[Any]], source: str) -> Trajectory:
    """Return columns as a trajectory. Raises InputError for a wrong column or value."""
    _check_names(list(columns), source)
    count = len(columns["name"])
    if not count:
        raise InputError(f"{source}: has no rows; must have at least 1, each a pose")
    for name in columns:
        if len(columns[name]) != count:
            raise InputError(
                f"{source}: column {name} has {len(columns[name])} rows; must have {count}, as name has"
            )
    values = {name: _numbers(columns[name], name, source) for name in _NUMBERS}
    names = _names(columns["name"], source)
    return Trajectory(
        source=source,
        name=names,
        julian_date=values["julian_date"],
        camera_position_T_m=np.stack([values[f"camera_{axis}_T_m"] for axis in "xyz"], axis=1),
        camera_from_T=_units(values, [f"camera_from_T_{axis}" for axis in "wxyz"], source),
        sun_direction_T=_units(values, [f"sun_{axis}_T" for axis in "xyz"], source),
        sun_distance_au=values["sun_distance_au"],
        **_sequences(columns, names, values["julian_date"], source),
        velocity_T_m_s=_vectors(columns, list(_VELOCITY), source),
        rate_C_rad_s=_vectors(columns, list(_RATE), source),
    )


def _sequences(
    columns: Mapping[str, Sequence[Any]], names: Sequence[str], julian_date: F64, source: str
) -> dict[str, Any]:
    """Return times, and names and lengths of the sequences. Raises InputError for frames out of order.

    Without `time_s`, a frame's time counts from the date of its sequence's first row; without `sequence`, all rows
    are one.
    """
    given = [name for name in SEQUENCE_COLUMNS if name in columns]
    if not given:
        return {"time_s": np.full(len(names), np.nan)}
    given_names = columns.get("sequence", ["0"] * len(names))
    column = ["" if value is None or value != value else str(value) for value in given_names]
    for row, name in enumerate(column, 1):
        if not 1 <= len(name) <= _LONGEST_NAME or not name.isprintable():
            raise InputError(
                f"{source}: row {row}: sequence = {shown(name)}: must be a printable text of 1 to {_LONGEST_NAME} "
                "characters"
            )
    starts = [k for k, name in enumerate(column) if not k or name != column[k - 1]]
    frames = np.diff([*starts, len(names)])
    first: dict[str, int] = {}
    for start in starts:
        if (before := first.setdefault(column[start], start)) != start:
            raise InputError(
                f"{source}: row {start + 1}: sequence = {shown(column[start])}: has ended before, and began in row "
                f"{before + 1}; the rows of a sequence must follow each other"
            )
    if "time_s" in columns:
        time_s = _numbers(columns["time_s"], "time_s", source)
    else:
        time_s = (julian_date - np.repeat(julian_date[starts], frames)) * _DAY_S
    late = np.ones(len(names), bool)
    late[1:] = np.diff(time_s) > 0
    late[starts] = True
    if not late.all():
        row = int(np.argmin(late))
        raise InputError(
            f"{source}: row {row + 1}: {names[row]} is at {time_s[row]:.10g} s of its sequence, and the row "
            f"before, {names[row - 1]}, at {time_s[row - 1]:.10g} s; "
            f"{'time_s' if 'time_s' in given else 'julian_date'} must rise through a sequence"
        )
    return {"time_s": time_s, "sequence_names": tuple(first), "frames": tuple(frames.tolist())}


def _names(column: Sequence[Any], source: str) -> tuple[str, ...]:
    """Return the names of the rows. Raises InputError for one that is no text, empty, too long or used before."""
    first: dict[str, int] = {}
    for row, name in enumerate(column, 1):
        if not isinstance(name, str) or not 1 <= len(name) <= _LONGEST_NAME or not name.isprintable():
            raise InputError(
                f"{source}: row {row}: name = {shown(name)}: must be a printable text of 1 to {_LONGEST_NAME} "
                "characters"
            )
        if first.setdefault(name, row) != row:
            raise InputError(
                f"{source}: row {row}: name = {shown(name)}: row {first[name]} has this name; must differ in every "
                "row"
            )
    return tuple(column)


def _numbers(column: Sequence[Any], name: str, source: str) -> F64:
    """Return a column as float64[n]. Raises InputError for a value that is no number, or out of its range."""
    return column_files.numbers(column, name, {**_NUMBERS, **_OPTIONAL}[name], source)


def _vectors(columns: Mapping[str, Sequence[Any]], names: Sequence[str], source: str) -> F64 | None:
    """Return columns as vectors float64[n, k]; None where they are missing. Raises InputError."""
    if names[0] not in columns:
        return None
    return np.stack([_numbers(columns[name], name, source) for name in names], axis=1)


def _units(values: Mapping[str, F64], names: Sequence[str], source: str) -> F64:
    """Return columns as unit vectors float64[n, k]. Raises InputError where a norm is not nearly 1."""
    vectors = np.stack([values[name] for name in names], axis=1)
    norm = np.linalg.norm(vectors, axis=1)
    wrong = np.flatnonzero(np.abs(norm - 1) > NORM_TOLERANCE)
    if len(wrong):
        raise InputError(
            f"{source}: row {wrong[0] + 1}: {', '.join(names)}: their norm is {norm[wrong[0]]:.6g}; must be from "
            f"{1 - NORM_TOLERANCE:g} to {1 + NORM_TOLERANCE:g}"
        )
    return np.asarray(vectors / norm[:, None])
