"""Write the events of an event camera: HDF5 and Parquet for each sequence, and JSON with all parameters.

    event_camera.json     scene, camera and versions; written first
    0_descent.h5          `CD/events` with x, y, p, t, as in the files of Prophesee
    0_descent.parquet     the same events as columns

The files of a sequence get their names when they are complete, the HDF5 file last.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .. import pipeline
from ..core.errors import InputError
from ..core.files.path_checks import check_folder
from ..core.files.whole_files import plain, replacing, write_json, writing
from ..dataset.identity import scene_identity, versions
from ..dataset.progress import Progress
from ..detector.event_camera import EVENT, EventCamera
from ..pipeline.event_camera import EventFlight, sequences
from ..scene.config import Scene
from .export.formats.video import stem_of_sequence

STATE = "event_camera.json"
_AT_ONCE = 1 << 20  # events that are written together
_CHUNK = 1 << 16  # events of a chunk of HDF5


def write_events(
    scene: Scene, out: Path, names: Sequence[str] = (), *, source: str = "scene", progress: bool = True
) -> Iterator[str]:
    """Write the events of sequences of a scene, and yield a line for each; what is there already is kept.

    Parameters
    ----------
    scene
        The scene, with a table of poses that has sequences.
    out
        Folder, to make or to continue.
    names
        Names of the sequences; by default all.
    source
        Name of the scene in messages.
    progress
        Whether to show how many renders are done, and how long the others take.

    Raises
    ------
    InputError
        The scene has no such sequences, h5py is missing, or the folder holds something else.
    """
    h5py = _h5py()
    check_folder(out)
    session = pipeline.Session(scene, source=source)
    chosen = sequences(session, tuple(names))
    session.warn_of_doubts()
    _begin(session, out)
    for name, number in chosen.items():
        path = out / f"{stem_of_sequence(number, list(session.trajectory.sequence_names))}.h5"  # type: ignore[union-attr]
        if path.is_file():
            yield f"{path}: kept"
            continue
        flight = EventFlight(session, number)
        with writing(path), _files(h5py, path, flight) as add:
            counts = _fly(flight, add, name, progress)
        yield (
            f"{path}: {counts.sum()} events, {counts[1]} ON and {counts[0]} OFF, from {len(flight.times_s)} renders"
        )


def _h5py() -> Any:
    """Return h5py. Raises InputError if it is not installed."""
    try:
        import h5py
    except ImportError as error:
        raise InputError("files of events need h5py: pip install 'vbnfault[hdf5]'") from error
    return h5py


def _begin(session: pipeline.Session, out: Path) -> None:
    """Write what the events of a folder come from. Raises InputError if the folder holds something else."""
    camera = session.scene.event_camera or EventCamera()
    state = plain(
        {
            "kind": "vbnfault event-camera",
            "event_camera": camera.model_dump(),
            "scene": scene_identity(session),
            "versions": versions(),
        }
    )
    path = out / STATE
    if path.is_file():
        try:
            before = json.loads(path.read_text(encoding="utf-8"))
        except ValueError:
            before = None
        if before != state:
            raise InputError(f"{path}: is of another scene, event camera or version; choose another --out")
        return
    with writing(out):
        out.mkdir(parents=True, exist_ok=True)
    if any(out.iterdir()):
        raise InputError(f"{out}: holds files, but no {STATE}; choose a new or empty folder as --out")
    with writing(path):
        write_json(path, state)


def _fly(flight: EventFlight, add: Any, name: str, progress: bool) -> NDArray[np.int64]:
    """Give all events of a flight to `add`, many at once; return the number of OFF and of ON events, int64[2]."""
    counts, waiting, held = np.zeros(2, np.int64), [np.zeros(0, EVENT)], 0
    with Progress(len(flight.times_s), shown=progress, noun="renders") as bar:
        bar.say(f"sequence {name}: {len(flight.times_s)} renders")
        for events in flight.events():
            counts += np.bincount(events["p"], minlength=2)
            waiting.append(events)
            held += len(events)
            if held >= _AT_ONCE:
                add(np.concatenate(waiting))
                waiting, held = [np.zeros(0, EVENT)], 0
            bar.advance(True)
    add(np.concatenate(waiting))
    return counts


@contextmanager
def _files(h5py: Any, path: Path, flight: EventFlight) -> Iterator[Any]:
    """Begin the files of a sequence, and yield what adds events, EVENT[n]; equal events give equal bytes."""
    import pyarrow
    import pyarrow.parquet

    rows, columns = flight.shape
    schema = pyarrow.schema([(name, pyarrow.from_numpy_dtype(EVENT[name])) for name in EVENT.names or ()])
    with (
        replacing(path) as hdf5,
        replacing(path.with_suffix(".parquet")) as parquet,
        h5py.File(hdf5, "w") as file,
        pyarrow.parquet.ParquetWriter(parquet, schema) as writer,
    ):
        file.attrs["geometry"] = f"{columns}x{rows}"
        file.attrs["sequence"] = flight.course.name
        file.attrs["begin_us"], file.attrs["end_us"] = np.rint(flight.times_s[[0, -1]] * 1e6).astype(np.int64)
        table = file.create_dataset(
            "CD/events", (0,), EVENT, maxshape=(None,), chunks=(_CHUNK,), compression="gzip", shuffle=True
        )

        def add(events: NDArray[Any]) -> None:
            table.resize(len(table) + len(events), axis=0)
            table[len(table) - len(events) :] = events
            writer.write_table(pyarrow.table({name: events[name] for name in schema.names}, schema))

        yield add
