"""List what happened in the sequences of a store: which fault was in which frames, since when, and why."""

from __future__ import annotations

import csv
import io
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from typing import Any

from numpy.typing import NDArray

from .. import store as stores
from ..core.errors import InputError
from ..store import Store, Url, event_of
from .statistics import finished_scalars

_READ = ("sequence", "frame", "parameters")


@dataclass(frozen=True, kw_only=True)
class FaultEvent:
    """Describe a fault of a sequence.

    Attributes
    ----------
    sequence
        Name of the sequence.
    fault
        Class of the fault.
    cause
        What brought it; "" for a fault that was there from the start.
    onset_s, end_s
        When it began and ended, in the time of the sequence; None for one that was there from the start, and for
        one that lasts.
    first_frame, last_frame
        The first and the last frame whose pixels it changes.
    frames
        Number of frames whose pixels it changes.
    largest_fraction
        The largest fraction of it that was there in a frame.
    """

    sequence: str
    fault: str
    cause: str
    onset_s: float | None
    end_s: float | None
    first_frame: int
    last_frame: int
    frames: int
    largest_fraction: float

    @property
    def line(self) -> str:
        """Return the event as a line of text."""
        since = "from the start" if self.onset_s is None else f"{self.cause}, from {self.onset_s:.6g} s"
        until = "" if self.end_s is None else f" to {self.end_s:.6g} s"
        much = "" if self.largest_fraction == 1 else f", up to {self.largest_fraction:.0%} of it"
        span = f"{self.frames} frames, {self.first_frame} to {self.last_frame}"
        return f"{self.sequence}: {self.fault}: {since}{until}; in {span}{much}"


def events(path: str | os.PathLike[str] | Url) -> list[FaultEvent]:
    """Return the events of a store's sequences, in the order of sequences, classes and onsets.

    What no finished frame shows is not listed.

    Raises
    ------
    InputError
        The store cannot be opened, or has no sequences.
    VbnfaultError
        Values cannot be read.
    """
    store = stores.open_store(path)
    if not store.spec.sequence_names:
        raise InputError(f"{store.path}: has no sequences, so nothing happens in time")
    seen: dict[tuple[int, int, float, str], list[tuple[int, float, float | None]]] = {}
    for samples, columns in finished_scalars(store, _READ):
        for sequence, frame, k, event in _in_frames(store, samples, columns):
            onset_s, fraction = _number(event, "onset_s"), _number(event, "fraction")
            key = sequence, k, float("-inf") if onset_s is None else onset_s, str(event.get("cause", ""))
            of_frame = frame, 1.0 if fraction is None else fraction, _number(event, "end_s")
            seen.setdefault(key, []).append(of_frame)
    listed = []
    for (sequence, k, onset_s, cause), of_frames in sorted(seen.items(), key=lambda item: item[0]):
        frames, fractions, ends_s = zip(*of_frames, strict=True)
        listed.append(
            FaultEvent(
                sequence=_name(store, sequence),
                fault=store.spec.faults[k],
                cause=cause,
                onset_s=None if onset_s == float("-inf") else onset_s,
                end_s=ends_s[0],
                first_frame=min(frames),
                last_frame=max(frames),
                frames=len(frames),
                largest_fraction=max(fractions),
            )
        )
    return listed


def _number(event: Mapping[str, Any], name: str) -> float | None:
    """Return a number that is stored of an event; None where there is none."""
    value = event.get(name)
    return float(value) if isinstance(value, int | float) else None


def _name(store: Store, sequence: int) -> str:
    """Return the name of a sequence, or its number where a store of another program has no name of it."""
    names = store.spec.sequence_names
    return names[sequence] if 0 <= sequence < len(names) else str(sequence)


def _in_frames(
    store: Store, samples: Sequence[int], columns: Mapping[str, NDArray[Any]]
) -> Iterator[tuple[int, int, int, Mapping[str, Any]]]:
    """Yield sequence, frame and number of every fault of every frame, and what is stored of its event."""
    rows = zip(samples, *(columns[name].tolist() for name in _READ), strict=True)
    for i, sequence, frame, text in rows:
        parameters = store.table(i, "parameters", text)
        for k, fault in enumerate(store.spec.faults):
            if fault in parameters:
                yield sequence, frame, k, event_of(parameters, fault)


def as_csv(listed: Iterable[FaultEvent]) -> str:
    """Return events as the text of a CSV file."""
    out = io.StringIO()
    table = csv.DictWriter(out, [field.name for field in fields(FaultEvent)], lineterminator="\n")
    table.writeheader()
    table.writerows(asdict(event) for event in listed)
    return out.getvalue()
