"""Score the log of a fault monitor: when it says that a fault is there, and how it reacts.

A row of the log says that from a time of a sequence the monitor holds a class present, or holds it no longer.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..core import tables
from ..core.errors import InputError, shown
from ..core.files import column_files
from ..core.files.user_files import sha256_of_input
from ..scene.events import REACTIONS, EventTable, right_reaction
from ..store import Store, event_of
from ..train import Columns, select
from .scored_samples import ALL, ScoreOptions
from .scores import Bootstrap
from .time_scores import ANY, Frames, time_figures

_NONE = "none"
_TEXTS = ("sequence", "class", "reaction")
_TIMES = {"time_s": (-1e9, 1e9), "frame": (0.0, 1e9)}
_MOST_EARLY = 0.01  # of the time between two frames, by which a time that was rounded in print may be late


class Log(NamedTuple):
    """Hold what a log says of each finished sample of a store; the last column is for rows of the class "any".

    Attributes
    ----------
    held
        bool[n, class + 1]: it is held present.
    reaction
        int64[n, class + 1]: the first reaction that is given for this frame, in `REACTIONS`; -1 for none.
    """

    held: NDArray[np.bool_]
    reaction: NDArray[np.int64]


def is_log(model: Any) -> bool:
    """Return whether a model is the path of a log, and no folder or detector."""
    return isinstance(model, str | Path) and Path(model).suffix.lower() in column_files.TYPES


def log_result(path: str, store: Store, options: ScoreOptions) -> dict[str, Any]:
    """Return the figures of a log. Raises InputError if log, store or options do not fit."""
    if options.masks or options.calibrate:
        raise InputError(f"{path}: a log has no masks; leave out masks and calibrate")
    if not store.spec.sequence_names:
        raise InputError(f"{store.path}: has no sequences, so a log cannot be scored in time")
    columns, classes = Columns(store), store.spec.faults
    log = read_log(path, store, columns)
    indices = select(store, None if options.split == ALL else options.split)
    place = np.searchsorted(columns.samples, indices)
    sequence, time_s = columns["sequence"][place], columns["time_s"][place]
    injected = columns["injected"][place].astype(bool)
    drawn, held = list(store.drawn(indices)), log.held[place]
    frames = Frames.of(sequence.astype(np.int64), time_s, injected, held[:, :-1], drawn, classes, held[:, -1])
    known = [(*classes, ANY)[c] for c in np.flatnonzero(np.any(log.held, axis=0))]
    return {
        "model": {"name": Path(path).name, "sha256": sha256_of_input(path, "data"), "classes": known},
        "options": {"split": options.split, "seed": options.seed},
        "samples": len(indices),
        "time": {
            **time_figures(frames, classes, options.seed),
            "reactions": _reactions(frames, log.reaction[place], drawn, store, options.seed),
        },
    }


def read_log(path: str, store: Store, columns: Columns) -> Log:
    """Return what a log says of the finished samples of a store. Raises InputError."""
    table = column_files.read_columns(path, "data", _check_names, _TEXTS)
    names, count = (*store.spec.faults, ANY), len(table["sequence"])
    shape = len(columns.samples), len(names)
    log = Log(np.zeros(shape, bool), np.full(shape, -1))
    time = next(name for name in _TIMES if name in table)
    at = column_files.numbers(table[time], time, _TIMES[time], path)
    present = column_files.numbers(table.get("present", [1] * count), "present", (0, 1), path) > 0
    sequences = _numbered(table["sequence"], "sequence", store.spec.sequence_names, path)
    classes = _numbered(table["class"], "class", names, path, ANY)
    reactions = _numbered(table.get("reaction", [""] * count), "reaction", (*REACTIONS, _NONE), path, _NONE)
    frames = {k: _frames_of(columns, k, time) for k in set(sequences)}
    for row in np.argsort(at, kind="stable").tolist():
        samples, times = frames[sequences[row]]
        if not len(times) or not times[0] <= at[row] <= times[-1]:
            span = f"from {times[0]:.10g} to {times[-1]:.10g}" if len(times) else "of a frame, and none is finished"
            raise InputError(
                f"{path}: row {row + 1}: {time} = {at[row]:.10g}: must be {span} in the sequence "
                f"{store.spec.sequence_names[sequences[row]]}"
            )
        early = _MOST_EARLY * float(np.diff(times).min(initial=1.0))
        later = samples[np.searchsorted(times, at[row] - early) :]
        log.held[later, classes[row]] = present[row]
        if present[row] and reactions[row] < len(REACTIONS) and log.reaction[later[0], classes[row]] < 0:
            log.reaction[later[0], classes[row]] = reactions[row]
    return log


def _frames_of(columns: Columns, sequence: int, time: str) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return the indices of the finished frames of a sequence, and their times or numbers, in order of time."""
    mine = np.flatnonzero(columns["sequence"] == sequence)
    times = columns[time][mine].astype(np.float64)
    order = np.argsort(times, kind="stable")
    return mine[order], times[order]


def _check_names(names: Sequence[str], source: str) -> None:
    """Raise InputError unless the columns are those of a log, each once."""
    column_files.check_once(names, source)
    missing = [name for name in ("sequence", "class") if name not in names]
    if sum(name in names for name in _TIMES) != 1:
        missing.append("time_s or frame (one of them)")
    unknown = [shown(name) for name in names if name not in (*_TEXTS, *_TIMES, "present")]
    if missing or unknown:
        clauses = [f"columns are missing: {', '.join(missing)}"] if missing else []
        clauses += [f"unknown columns: {', '.join(unknown[:5])}"] if unknown else []
        raise InputError(
            f"{source}: {'; '.join(clauses)}; a log has the columns sequence, class, and time_s or frame, and may "
            "have reaction and present"
        )


def _numbered(column: Sequence[Any], name: str, allowed: Sequence[str], source: str, empty: str = "") -> list[int]:
    """Return the number of each value among the allowed ones; `empty` stands for nothing. Raises InputError."""
    number = {value: k for k, value in enumerate(allowed)}
    out = []
    for row, value in enumerate(column, 1):
        text = str(value) if value is not None and str(value) else empty
        if text not in number:
            raise InputError(f"{source}: row {row}: {name} = {shown(value)}: must be one of {', '.join(allowed)}")
        out.append(number[text])
    return out


# --- reactions ----------------------------------------------------------------------------------------------------


def _reactions(
    frames: Frames, given: NDArray[np.int64], drawn: Sequence[Mapping[str, Any]], store: Store, seed: int
) -> dict[str, Any]:
    """Return how often the first reaction within an event is the right one, and a table of both.

    `given` are the reactions int64[n, class + 1], and `drawn` the parameters, in the order of the samples.
    """
    events = [
        tables.parse(EventTable, plain, source=f"{store.path}: event[{k}]")
        for k, plain in enumerate(store.attributes["scene"].get("event", []))
    ]
    counts = {right: dict.fromkeys((*REACTIONS, _NONE), 0) for right in REACTIONS}
    of_frame = np.zeros((2, len(frames.sequence)))  # right ones, and all, at the first frame of their event
    for c, name in enumerate(store.spec.faults):
        for first, last in frames.events(c):
            cause = str(event_of(drawn[frames.order[first]], name).get("cause", ""))
            right = right_reaction(events, name, cause)
            said = given[frames.order[first : last + 1]][:, [c, -1]].ravel()
            reaction = next((REACTIONS[k] for k in said if k >= 0), _NONE)
            counts[right][reaction] += 1
            of_frame[:, first] += reaction == right, 1
    return {"right_fraction": Bootstrap(frames.sequence, seed).fraction(*of_frame).plain(), "given": counts}
