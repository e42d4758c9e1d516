"""Fly an event camera along a sequence: render its light at times between the frames, and collect its events.

The light has neither faults nor noise. All renders of a sequence have the same pattern of samples in each pixel, so
that the error of sampling stays in place and sends no events.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicHermiteSpline
from scipy.spatial.transform import Rotation, Slerp

from ..core.errors import InputError, shown
from ..detector.event_camera import EventCamera, EventPixels
from ..scene import keyed_random
from ..scene.trajectory import FlownPose, Trajectory
from .rendering import describe, render_view
from .resolve import resolve
from .session import Session
from .spec import SampleSpec

F64 = NDArray[np.float64]

_GREEN = 1  # channel of the electrons; a grey camera has one
_EVERY_PX = 8  # pixels whose motion is computed
_STEP = 1e-3  # of the interval between two frames, over which motion is computed
_STEPS_AT = (0.0, 0.5, 1.0 - _STEP)  # where in the interval


def sequences(session: Session, names: tuple[str, ...] = ()) -> dict[str, int]:
    """Return the number of each sequence by its name: of those that are named, by default of all.

    Raises
    ------
    InputError
        The scene has no sequences, none of such a name, or one of a single frame.
    """
    trajectory = session.trajectory
    if trajectory is None or not trajectory.frames:
        raise InputError(
            f"{session.source}: has no sequences; needs [trajectory] with a table of poses that has "
            "the column time_s or sequence"
        )
    known = {name: k for k, name in enumerate(trajectory.sequence_names)}
    for name in names:
        if name not in known:
            raise InputError(f"--sequence {shown(name)}: must be one of {', '.join(known)} of {trajectory.source}")
    chosen = {name: k for name, k in known.items() if not names or name in names}
    for name, k in chosen.items():
        if trajectory.frames[k] == 1:
            raise InputError(f"{trajectory.source}: sequence {name} has 1 frame; must have at least 2")
    return chosen


@dataclass(frozen=True, kw_only=True, eq=False)
class Course:
    """Hold poses of a sequence as functions of time.

    The position is a cubic through the frames' positions with their velocities, attitude turns evenly from frame to
    frame, and the Sun's direction and distance and the date change linearly.
    """

    name: str
    time_s: F64
    position_T_m: CubicHermiteSpline
    T_from_C: Slerp
    numbers: F64  # [frame, 5]: Sun's direction in T and distance in au, date

    @classmethod
    def of(cls, trajectory: Trajectory, rows: slice, name: str) -> Course:
        """Return the course of some rows of a table."""
        time_s = trajectory.time_s[rows]
        suns, distance_au, date = (
            trajectory.sun_direction_T[rows],
            trajectory.sun_distance_au[rows],
            trajectory.julian_date[rows],
        )
        T_from_C = Rotation.from_quat(trajectory.camera_from_T[rows], scalar_first=True).inv()
        return cls(
            name=name,
            time_s=time_s,
            position_T_m=CubicHermiteSpline(
                time_s, trajectory.camera_position_T_m[rows], trajectory.motion[0][rows]
            ),
            T_from_C=Slerp(time_s, T_from_C),
            numbers=np.column_stack([suns, distance_au, date]),
        )

    def pose(self, time_s: float) -> FlownPose:
        """Return the pose at a time."""
        *sun, distance_au, date = (float(np.interp(time_s, self.time_s, column)) for column in self.numbers.T)
        return FlownPose(
            name=f"{self.name} at {time_s:.10g} s",
            julian_date=date,
            camera_position_T_m=self.position_T_m(time_s),
            T_from_C=self.T_from_C(time_s).as_matrix(),
            sun_direction_T=np.array(sun) / np.linalg.norm(sun),
            sun_distance_au=distance_au,
            time_s=time_s,
        )


class EventFlight:
    """Fly the event camera of a scene along one of its sequences.

    Parameters
    ----------
    session
        The scene.
    number
        Of the sequence.

    Attributes
    ----------
    times_s
        float64[n]: when it renders.
    """

    def __init__(self, session: Session, number: int) -> None:
        trajectory = session.trajectory
        assert trajectory is not None
        first = sum(trajectory.frames[:number])
        rows = slice(first, first + trajectory.frames[number])
        self.course = Course.of(trajectory, rows, trajectory.sequence_names[number])
        self.camera = session.scene.event_camera or EventCamera()
        spec = session.spec(first)
        scene = spec.scene
        render = scene.render.model_copy(update={"noise_fraction": None})
        scene = scene.model_copy(update={"render": render, "motion": None})
        plan = replace(spec.plan, faults=(), injected=spec.plan.injected[:, :0])
        self._spec = replace(spec, scene=scene, faults={}, plan=plan, taken_with=spec.camera)
        self._number, self._device = number, int(spec.plan.individual[first])
        self.times_s = self._planned_times_s()

    @property
    def shape(self) -> tuple[int, int]:
        """Return rows and columns of the camera."""
        return self._spec.camera.height_px, self._spec.camera.width_px

    def events(self) -> Iterator[NDArray[Any]]:
        """Yield the events up to each render, EVENT[n] (`detector.event_camera`), by time."""
        rng = partial(keyed_random.rng, self._spec.seed)
        pixels = EventPixels(
            self.camera,
            self.shape,
            partial(rng, self._device, "event_camera"),
            partial(rng, self._number, "event_camera_noise"),
        )
        for time_s in self.times_s.tolist():
            yield pixels.advance(self._electrons_s(time_s), time_s)

    def _at(self, time_s: float) -> SampleSpec:
        """Return the sample with the pose of a time."""
        flown, scene = self.course.pose(time_s), self._spec.scene
        dated = {"julian_date": flown.julian_date, "distance_au": flown.sun_distance_au}
        sun = scene.sun.model_copy(update=dated)
        return replace(self._spec, scene=scene.model_copy(update={"sun": sun}), flown=flown)

    def _electrons_s(self, time_s: float) -> NDArray[np.float32]:
        """Return expected electrons per second at a time, float32[y, x]."""
        spec = self._at(time_s)
        rendering = render_view(spec, resolve(spec))
        electrons = spec.camera.expose(rendering.light.rendered, 1.0).merged.array
        return electrons[..., min(_GREEN, electrons.shape[-1] - 1)]

    def _planned_times_s(self) -> F64:
        """Return the times of the frames, and between them so many that the ground moves at most `step_px`."""
        frames, out = self.course.time_s, [self.course.time_s[:1]]
        for begin_s, end_s in itertools.pairwise(frames.tolist()):
            length_s = end_s - begin_s
            moved_px = max(self._moved_px(begin_s + k * length_s, _STEP * length_s) for k in _STEPS_AT) / _STEP
            count = max(int(np.ceil(moved_px / self.camera.step_px)), 1)
            out.append(np.linspace(begin_s, end_s, count + 1)[1:])
        return np.concatenate(out)

    def _moved_px(self, time_s: float, step_s: float) -> float:
        """Return how far nearly the fastest ground in view moves after a time, or the sky where there is none."""
        from .. import render

        spec = self._at(time_s)
        scene = describe(spec, resolve(spec))
        every = slice(_EVERY_PX // 2, None, _EVERY_PX)
        towards = spec.camera.seen_directions[every, every]
        depth_m = render.truth(spec.terrain.surface, scene.view, scene.sun, directions=towards).depth_m
        ground = np.isfinite(depth_m)
        # rounding may lead past the last frame, where there is no attitude
        here, later = (self.course.pose(min(t, self.course.time_s[-1])) for t in (time_s, time_s + step_s))
        approach_T_m = later.camera_position_T_m - here.camera_position_T_m
        if ground.any():
            towards = towards[ground]
            points_C = towards * (depth_m[ground] / towards[:, 2])[:, None]
        else:  # as if nothing were near
            points_C, approach_T_m = towards.reshape(-1, 3), np.zeros(3)
        moved_C = (points_C @ here.T_from_C.T - approach_T_m) @ later.T_from_C
        pixel_of = spec.camera.projection.pixel_of
        return float(np.percentile(np.linalg.norm(pixel_of(moved_C) - pixel_of(points_C), axis=-1), 99))
