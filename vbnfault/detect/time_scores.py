"""Compute how soon a detector says what happens in a sequence, what it misses, and how steadily it says it.

An event is a fault of one onset in one sequence. It begins with the first frame whose pixels it changes, and ends
with the last such frame; an intermittent fault is one event. It is detected in the first frame from then to its end
in which the class is told present.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..store import event_of
from .scores import Bootstrap, Estimate

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]
Flags = NDArray[np.bool_]

_HOUR_S = 3600.0
ANY = "any"  # stands for a fault whose class is not said


class Frames(NamedTuple):
    """Hold the frames of sequences in the order of sequence and time.

    Attributes
    ----------
    sequence
        int64[n].
    time_s
        float64[n], in the time of each sequence.
    injected, said
        bool[n, class]: the class changes the pixels; it is told present.
    onset_s
        float64[n, class]: of the event that brings the class; -inf for none.
    unnamed
        bool[n]: a fault is told present, but not of which class.
    order
        int64[n]: numbers of the frames in the order in which they were given.
    """

    sequence: I64
    time_s: F64
    injected: Flags
    said: Flags
    onset_s: F64
    unnamed: Flags
    order: I64

    @classmethod
    def of(
        cls,
        sequence: I64,
        time_s: F64,
        injected: Flags,
        said: Flags,
        drawn: Sequence[Mapping[str, Any]],
        classes: tuple[str, ...],
        unnamed: Flags | None = None,
    ) -> Frames:
        """Return frames that are given in any order, with their drawn parameters, in their order."""
        onset_s = np.full(injected.shape, -np.inf)
        for i, faults in enumerate(drawn):
            for c, name in enumerate(classes):
                onset = event_of(faults, name).get("onset_s")
                onset_s[i, c] = onset if isinstance(onset, int | float) else -np.inf
        unnamed = np.zeros(len(sequence), bool) if unnamed is None else unnamed
        order = np.lexsort((time_s, sequence))
        columns: list[Any] = [sequence, time_s, injected, said, onset_s, unnamed, np.arange(len(sequence))]
        return cls(*(column[order] for column in columns))

    def events(self, c: int) -> list[tuple[int, int]]:
        """Return the first and the last frame of each event of a class."""
        there = np.flatnonzero(self.injected[:, c])
        keys = np.column_stack([self.sequence[there].astype(np.float64), self.onset_s[there, c]])
        spans = (there[(keys == key).all(axis=1)] for key in np.unique(keys, axis=0))
        return [(int(mine[0]), int(mine[-1])) for mine in spans]


def time_figures(frames: Frames, classes: tuple[str, ...], seed: int) -> dict[str, Any]:
    """Return the figures by class, and of all classes together, each with an interval over sequences."""
    bootstrap = Bootstrap(frames.sequence, seed)
    counts = {name: _counts(frames, c) for c, name in enumerate(classes)}
    if frames.unnamed.any():
        counts[ANY] = _unnamed_counts(frames)
    together = _Counts(
        *(np.concatenate([getattr(one, name) for one in counts.values()], axis=1) for name in _Counts._fields)
    )
    hours = _hours(frames)
    figures = {name: _figures(one, hours, bootstrap) for name, one in counts.items()}
    unnamed = {ANY: figures.pop(ANY)} if ANY in figures else {}
    return {
        "sequences": bootstrap.views,
        "hours": float(hours.sum()),
        "classes": figures,
        **unnamed,
        "all": _figures(together, hours, bootstrap),
    }


class _Counts(NamedTuple):
    """Hold what is counted at each frame, [n, class] each; events count at their first frame.

    `delay_s` is nan but where an event begins that is detected; `alarms` begin where a class is told present
    outside of its events; `pairs` are frames whose class is as in the frame before, and `flips` those of them in
    which what is said changes.
    """

    events: Flags
    missed: Flags
    delay_s: F64
    alarms: Flags
    pairs: Flags
    flips: Flags


def _counts(frames: Frames, c: int) -> _Counts:
    """Return the counts of a class, whose events are also seen where a fault is told without its class."""
    events, missed, during = (np.zeros(len(frames.sequence), bool) for _ in range(3))
    delay_s = np.full(len(frames.sequence), np.nan)
    seen = frames.said[:, c] | frames.unnamed
    for first, last in frames.events(c):
        events[first] = True
        during[first : last + 1] = True
        told = np.flatnonzero(seen[first : last + 1])
        missed[first] = not len(told)
        if len(told):
            delay_s[first] = frames.time_s[first + told[0]] - frames.time_s[first]
    steady = _steadiness(frames.sequence, frames.injected[:, c], frames.said[:, c], during)
    columns: list[Any] = [events, missed, delay_s, *steady]
    return _Counts(*(column[:, None] for column in columns))


def _unnamed_counts(frames: Frames) -> _Counts:
    """Return the counts of what is told without a class: false outside of all events, which count elsewhere."""
    none, during = np.zeros(len(frames.sequence), bool), np.zeros(len(frames.sequence), bool)
    for c in range(frames.injected.shape[1]):
        for first, last in frames.events(c):
            during[first : last + 1] = True
    steady = _steadiness(frames.sequence, np.any(frames.injected, axis=1), frames.unnamed, during)
    columns: list[Any] = [none, none, np.full(len(none), np.nan), *steady]
    return _Counts(*(column[:, None] for column in columns))


def _steadiness(sequence: I64, injected: Any, said: Flags, during: Flags) -> tuple[Flags, Flags, Flags]:
    """Return where false alarms begin, frames like the one before, and those of them in which `said` changes."""
    follows = np.diff(sequence, prepend=-1) == 0
    before = np.concatenate([[False], said[:-1]]) & follows
    false = said & ~during
    pairs = follows & (injected == np.concatenate([[False], injected[:-1]]))
    return false & ~before, pairs, pairs & (said != before)


def _hours(frames: Frames) -> F64:
    """Return for each frame the hours that it stands for, float64[n]: to the next one, of the last as before it."""
    out = np.zeros(len(frames.time_s))
    for sequence in np.unique(frames.sequence):
        mine = np.flatnonzero(frames.sequence == sequence)
        steps = np.diff(frames.time_s[mine])
        out[mine[:-1]], out[mine[-1]] = steps, steps[-1] if len(steps) else 0.0
    return out / _HOUR_S


def _figures(counts: _Counts, hours: F64, bootstrap: Bootstrap) -> dict[str, Any]:
    """Return figures of counts for JSON."""

    def fraction(above: Any, below: Any) -> Estimate:
        return bootstrap.fraction(above.sum(axis=1), below.sum(axis=1) if below.ndim == 2 else below)

    known = counts.delay_s[counts.events & ~counts.missed]
    return {
        "events": int(counts.events.sum()),
        "missed_fraction": fraction(counts.missed, counts.events).plain(),
        "delay_s_median": bootstrap.median(counts.delay_s).plain(),
        "delay_s_largest": float(known.max()) if len(known) else None,
        "false_alarms_per_hour": fraction(counts.alarms, hours).plain(),
        "flicker": fraction(counts.flips, counts.pairs).plain(),
    }
