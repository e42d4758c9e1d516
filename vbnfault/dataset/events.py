"""List what happened in the sequences of a store: which fault was in which frames, since when, and why."""

from __future__ import annotations

import csv
import io
import json
import os
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, fields
from typing import Any

from .. import store as stores
from ..core.errors import InputError
from ..store import Url
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
    seen: dict[tuple[int, int, str, float], dict[str, Any]] = {}
    for _, columns in finished_scalars(store, _READ):
        rows = zip(*(columns[name].tolist() for name in _READ), strict=True)
        for sequence, frame, k, fault, event in _in_frames(rows, store.spec.faults):
            onset_s = event.get("onset_s")
            key = sequence, k, event.get("cause", ""), float("-inf") if onset_s is None else onset_s
            known = seen.setdefault(
                key,
                {
                    "sequence": store.spec.sequence_names[sequence],
                    "fault": fault,
                    "cause": event.get("cause", ""),
                    "onset_s": onset_s,
                    "end_s": event.get("end_s"),
                    "first_frame": frame,
                    "last_frame": frame,
                    "frames": 0,
                    "largest_fraction": 0.0,
                },
            )
            known["frames"] += 1
            known["first_frame"], known["last_frame"] = (
                min(known["first_frame"], frame),
                max(known["last_frame"], frame),
            )
            known["largest_fraction"] = max(known["largest_fraction"], event.get("fraction", 1.0))
    order = sorted(seen, key=lambda key: (key[0], key[1], key[3], key[2]))
    return [FaultEvent(**seen[key]) for key in order]


def _in_frames(
    rows: Iterable[tuple[int, int, str]], faults: Sequence[str]
) -> Iterator[tuple[int, int, int, str, dict[str, Any]]]:
    """Yield sequence, frame, number and name of every fault of every frame, and what is stored of its event."""
    for sequence, frame, text in rows:
        parameters = json.loads(text)
        for k, fault in enumerate(faults):
            if fault in parameters:
                yield sequence, frame, k, fault, parameters[fault].get("event", {})


def as_csv(listed: Iterable[FaultEvent]) -> str:
    """Return events as the text of a CSV file."""
    out = io.StringIO()
    table = csv.DictWriter(out, [field.name for field in fields(FaultEvent)], lineterminator="\n")
    table.writeheader()
    table.writerows(asdict(event) for event in listed)
    return out.getvalue()
