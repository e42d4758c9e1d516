"""Define the tables `[[event]]` of a scene file: causes that bring faults at some time of a sequence.

An event strikes a sequence whose frames carry the first of its faults, and brings all of them together. Its times
are drawn once for a sequence. Faults of no event are there from the first frame to the last.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import AfterValidator, Field, model_validator

from ..core.tables import Table, each_once, pair_within
from . import keyed_random

_LONGEST_S, _SHORTEST_S = 1e9, 1e-6
if TYPE_CHECKING:
    from .config import Scene

    Times = float | tuple[float, float]
    Spans = float | tuple[float, float]
else:
    Times = Annotated[float, Field(ge=-_LONGEST_S, le=_LONGEST_S)] | pair_within(-_LONGEST_S, _LONGEST_S)
    Spans = Annotated[float, Field(ge=_SHORTEST_S, le=_LONGEST_S)] | pair_within(_SHORTEST_S, _LONGEST_S)
REACTIONS = ("isolate", "reset", "wait")  # of a fault monitor
_PROFILES_WITH = {"rise_s": ("growing",), "period_s": ("intermittent", "thermal"), "reset_s": ("until_reset",)}


class EventTable(Table):
    """Name a cause, the faults that it brings, and when. Times count as those of the frames of a sequence."""

    cause: str = Field(min_length=1, max_length=200, description="what happens, such as a dust event")
    faults: Annotated[tuple[str, ...], AfterValidator(each_once)] = Field(
        min_length=1, description="classes of the scene that it brings, all together"
    )
    onset_s: Times = Field(description="time at which it begins, or bounds between which it is drawn")
    duration_s: Spans | None = Field(
        None, description="how long it lasts, or bounds; by default to the end of the sequence"
    )
    profile: Literal["sudden", "growing", "intermittent", "thermal", "until_reset"] = Field(
        "sudden",
        description="sudden: there at once; growing: from nothing to all of it in rise_s, for the models that "
        "grow; intermittent: on for the fraction duty of each period_s; thermal: rises and falls once in each "
        "period_s, and is there for the fraction duty of it; until_reset: there at once, until reset_s",
    )
    rise_s: Spans | None = Field(None, description="time in which a growing fault is whole, or bounds")
    period_s: Spans | None = Field(
        None, description="period of an intermittent or thermal fault, such as that of the orbit, or bounds"
    )
    duty: Annotated[float, Field(gt=0, lt=1)] = Field(
        0.5, description="fraction of its period for which an intermittent or thermal fault is there"
    )
    reset_s: Times | None = Field(
        None, description="time of the reset after which it does not come back, or bounds"
    )

    @model_validator(mode="after")
    def _has_what_its_profile_needs(self) -> EventTable:
        for name, profiles in _PROFILES_WITH.items():
            needed = self.profile in profiles
            if (getattr(self, name) is None) == needed:
                verb = "must be set" if needed else "must not be set"
                raise ValueError(
                    f'profile = "{self.profile}": {name} {verb}; it is for the profile {" or ".join(profiles)}'
                )
        if self.reset_s is not None and np.min(self.reset_s) <= np.max(self.onset_s):
            reset_s, onset_s = float(np.min(self.reset_s)), float(np.max(self.onset_s))
            raise ValueError(f"reset_s = {reset_s:g}: must be later than onset_s, which is up to {onset_s:g}")
        return self

    @property
    def reaction(self) -> str:
        """Return the right reaction: reset what a reset cures, wait for what passes, isolate what stays."""
        if self.profile == "until_reset":
            return "reset"
        passes = self.profile in ("intermittent", "thermal") or self.duration_s is not None
        return "wait" if passes else "isolate"


@dataclass(frozen=True, kw_only=True)
class Event:
    """Hold an event of a sequence, as drawn; `end_s` is infinite for one that lasts."""

    cause: str
    faults: tuple[str, ...]
    onset_s: float
    end_s: float
    profile: str
    rise_s: float
    period_s: float
    duty: float
    phase_rad: float

    def fraction(self, time_s: float) -> float:
        """Return how much of the faults is there at a time, from 0, nothing, to 1."""
        since_s = time_s - self.onset_s
        if since_s < 0 or time_s >= self.end_s:
            return 0.0
        if self.profile == "growing":
            return min(since_s / self.rise_s, 1.0)
        if self.profile == "intermittent":
            return float(since_s % self.period_s < self.duty * self.period_s)
        if self.profile == "thermal":
            warmth = math.cos(2 * math.pi * since_s / self.period_s + self.phase_rad)
            least = math.cos(math.pi * self.duty)
            return max((warmth - least) / (1 - least), 0.0)
        return 1.0


def events_of_sequence(scene: Scene, state: int) -> tuple[Event, ...]:
    """Return the events of the sequence whose first frame is the sample `state`, in the order of the scene."""
    out = []
    for number, table in enumerate(scene.event):
        rng = keyed_random.rng(scene.dataset.seed, state, "plan", f"event/{number}")
        onset_s, duration_s, rise_s, period_s, reset_s = (
            _drawn(getattr(table, name), rng) for name in ("onset_s", "duration_s", "rise_s", "period_s", "reset_s")
        )
        out.append(
            Event(
                cause=table.cause,
                faults=table.faults,
                onset_s=onset_s,
                end_s=min(onset_s + duration_s, reset_s),
                profile=table.profile,
                rise_s=rise_s,
                period_s=period_s,
                duty=table.duty,
                phase_rad=2 * math.pi * float(rng.random()),
            )
        )
    return tuple(out)


def striking(events: Sequence[Event], commanded: Collection[str]) -> tuple[Event, ...]:
    """Return the events that strike a sequence with these commanded faults: their first one is among them."""
    return tuple(event for event in events if event.faults[0] in commanded)


def strongest(events: Sequence[Event], fault: str, time_s: float) -> Event | None:
    """Return the event that brings most of a fault at a time; None if none brings it, or none is of it."""
    mine = [event for event in events if fault in event.faults]
    return max(mine, key=lambda event: event.fraction(time_s), default=None)


def commanded_now(
    scene: Scene, faults: Sequence[str], injected: Sequence[bool], state: int, time_s: float
) -> list[bool]:
    """Return which commanded faults a frame carries at a time; `state` is the first sample of its sequence."""
    commanded = [fault for fault, has in zip(faults, injected, strict=True) if has]
    events = striking(events_of_sequence(scene, state), commanded)
    now = [strongest(events, fault, time_s) for fault in faults]
    return [
        bool(has) and (event is None or event.fraction(time_s) > 0)
        for has, event in zip(injected, now, strict=True)
    ]


def commanded_in_time(
    scene: Scene,
    faults: Sequence[str],
    injected: NDArray[np.bool_],
    state: NDArray[np.int64],
    time_s: Sequence[float],
) -> NDArray[np.bool_]:
    """Return which commanded faults bool[frame, fault] frames carry at their times; without events all of them."""
    if not scene.event:
        return injected
    rows = zip(injected.tolist(), state.tolist(), time_s, strict=True)
    return np.array([commanded_now(scene, faults, row, first, time) for row, first, time in rows])


def right_reaction(tables: Sequence[EventTable], fault: str, cause: str) -> str:
    """Return the right reaction to a fault that events of a cause bring; a fault of no event stays."""
    return next((one.reaction for one in tables if one.cause == cause and fault in one.faults), "isolate")


def first_classes(tables: Sequence[EventTable]) -> Mapping[str, tuple[str, ...]]:
    """Return for each class of an event the first classes of all events that bring it."""
    out: dict[str, tuple[str, ...]] = {}
    for table in tables:
        for fault in table.faults:
            out[fault] = (*out.get(fault, ()), table.faults[0])
    return out


def _drawn(value: float | tuple[float, float] | None, rng: np.random.Generator) -> float:
    """Return a number, or one from between two bounds; infinity where there is none."""
    fraction = float(rng.random())  # always drawn, so that other values do not depend on this one
    if value is None:
        return np.inf
    if isinstance(value, tuple):
        return value[0] + fraction * (value[1] - value[0])
    return float(value)
