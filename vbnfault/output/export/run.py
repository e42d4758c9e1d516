"""Run an export: check store and folder, write the parts in threads, and finish with index, table and cards."""

from __future__ import annotations

import hashlib
import itertools
import json
import os
import threading
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ... import __version__
from ...core.errors import InputError, VbnfaultError, shown
from ...core.files.path_checks import path_of, real
from ...core.files.whole_files import plain
from ...core.html_page import rendered
from ...core.quantities import Sample
from ...core.tables import did_you_mean
from ...dataset.card import described, to_json
from ...dataset.croissant import columns, croissant, image_records
from ...dataset.lock import locked
from ...dataset.progress import Progress
from ...dataset.statistics import Statistics, statistics
from ...store import EFFECT_RULE, MASK_RULES, SPLITS, STRATA, Store, Url, disk, mask_union, open_store
from .contract import FPS, Closing, ExportPart, Finished, Format, formats, of_distortion
from .folder import Folder

SAMPLES = "samples.jsonl"
MOST_THREADS = 64
_PARSED = ("parameters", "proposal")  # scalars that hold JSON


@dataclass(frozen=True, kw_only=True)
class ExportSummary:
    """Describe an export: its folder, the numbers of samples in all and written now, and warnings."""

    path: Path
    format: str
    samples: int
    written: int
    warnings: tuple[str, ...] = ()

    def lines(self) -> list[str]:
        """Return the summary as lines of text."""
        before = f", {self.samples - self.written} of them written before" if self.written < self.samples else ""
        text = f"{self.path}: {self.samples} samples as {self.format}{before}"
        return [text, *(f"warning: {warning}" for warning in self.warnings)]


def export_store(
    store: str | os.PathLike[str] | Store,
    out: str | os.PathLike[str],
    format: str,
    *,
    masks: str = "footprint",
    min_area_px: int = 1,
    fps: float | None = None,
    workers: int = 1,
    progress: bool = True,
) -> ExportSummary:
    """Write all samples of a finished store in the format of other tools, or resume an interrupted export.

    The files do not depend on the number of workers or on interruptions.

    Parameters
    ----------
    store
        A store or its path.
    out
        Folder of the export; made if missing.
    format
        Name of a format: coco, exr, huggingface, png, video, webdataset, yolo, or one of a plug-in.
    masks
        "footprint" or "effect": which mask the files hold. The formats exr and png hold both, each by its name.
    min_area_px
        Instances of fewer pixels are left out of the formats coco and yolo; 1 keeps all.
    fps
        Frames a second of the films of the format video, 0.1 to 1000; by default by the median step of `time_s`.
    workers
        Number of threads, 1 to 64. Each holds one sample in memory.
    progress
        Whether to show the progress on standard error.

    Raises
    ------
    InputError
        If there is no such store or format, the store is not finished, or the folder holds something else.
    VbnfaultError
        If a sample is damaged or the files cannot be written; the same call resumes.
    """
    known = formats()
    if format not in known:
        raise InputError(f"format {shown(format)}: there is no such format{did_you_mean(str(format), [*known])}")
    if type(workers) is not int or not 1 <= workers <= MOST_THREADS:
        raise InputError(f"--workers {shown(workers)}: must be a whole number from 1 to {MOST_THREADS}")
    store, target = open_store(store), path_of(out, "out")
    _check_place(store, target)
    _check_finished(store)
    kind = known[format]()
    _check_masks(store, kind, masks)
    if type(min_area_px) is not int or min_area_px < 1 or (min_area_px > 1 and not kind.has_instances):
        raise InputError(
            f"--min-area {shown(min_area_px)}: must be a whole number from 1; {format} "
            + ("leaves out smaller instances" if kind.has_instances else "has no instances, so it must be 1")
        )
    _check_sequences(store, kind, fps)
    identity = {
        "format": format,
        "vbnfault": __version__,
        "samples": store.samples,
        "masks": masks,
        "min_area_px": min_area_px,
        "fps": fps,
        "contents_sha256": contents_sha256(store),
    }
    with locked(target), disk.explained(target, "writing the export"):
        folder, parts = Folder(target), _parts(store, kind, min_area_px, fps)
        if folder.begin(identity):
            folder.clear()
            return ExportSummary(path=target, format=format, samples=store.samples, written=0)
        with Progress(store.samples, shown=progress) as bar:
            written = _write_parts(store, kind, parts, folder, bar, workers, masks)
        warnings = _finish(store, kind, parts, folder, masks)
        folder.end(identity, len(parts))
    return ExportSummary(path=target, format=format, samples=store.samples, written=written, warnings=warnings)


# --- before the work ----------------------------------------------------------------------------------------


def _check_place(store: Store, target: Path) -> None:
    """Refuse a folder within the store, or one that holds the store."""
    if isinstance(store.path, Url):
        return
    inside, outside = real(store.path), real(target)
    if inside == outside or inside in outside.parents:
        raise InputError(f"{target}: lies in the store; choose another --out")


def _check_finished(store: Store) -> None:
    """Refuse a store that lacks samples."""
    finished = store.finished()
    if finished < store.samples:
        state = f"{finished} of {store.samples} samples are finished" if finished else store.why_none_is_finished()
        raise InputError(
            f"{store.path}: {state}; run the build command again, and export the store when it is complete"
        )


def _check_masks(store: Store, kind: Format, masks: str) -> None:
    """Refuse a kind of mask that does not exist, that the store lacks, or that the format does not choose."""
    if masks not in MASK_RULES:
        raise InputError(f"--masks {shown(masks)}: must be one of {', '.join(MASK_RULES)}")
    if masks == "footprint":
        return
    layer, read = MASK_RULES[masks], kind.layers(store.spec)
    if layer not in store.spec.pixel_layers:
        raise InputError(
            f"--masks {masks}: {store.path} has no layer {layer}; add it to dataset.layers and build the dataset "
            "again, or export footprints"
        )
    if layer in read or "mask" not in read:
        raise InputError(f"--masks {masks}: {kind.name} writes every mask of the store by its name; leave it out")


def _check_sequences(store: Store, kind: Format, fps: float | None) -> None:
    """Refuse films of a store without sequences, and a frame rate out of range or of another format."""
    if kind.by_sequence and not store.spec.sequence_names:
        raise InputError(
            f"{store.path}: has no sequences, of which {kind.name} makes films: trajectory.file of its scene has "
            "neither a column sequence nor time_s; export single images as png"
        )
    if fps is not None and not kind.by_sequence:
        raise InputError(f"--fps {shown(fps)}: {kind.name} has no films; leave it out")
    if fps is not None and not (isinstance(fps, int | float) and FPS[0] <= fps <= FPS[1]):
        raise InputError(f"--fps {shown(fps)}: must be a number from {FPS[0]:g} to {FPS[1]:g}, in frames a second")


def contents_sha256(store: Store) -> str:
    """Return a digest of the stored checksums of all layers and scalars, and of the layout of the store."""
    total = hashlib.sha256(json.dumps(store.spec.data, sort_keys=True).encode())
    total.update(store.read("crc32c").tobytes())
    return total.hexdigest()


def _parts(store: Store, kind: Format, min_area_px: int, fps: float | None) -> tuple[ExportPart, ...]:
    """Return the parts of an export: of each split, in ascending order, some samples or a sequence."""
    split, sequence = store.read("split").tolist(), store.read("sequence") if kind.by_sequence else ()
    parts: list[ExportPart] = []
    if not {*split} <= {*SPLITS}:  # only a sample that is not built has none: "" would name the root folder
        raise VbnfaultError(f"{store.path}: a split is none of {', '.join(SPLITS)}; the build command repairs it")
    for name in SPLITS:
        samples = [i for i, of_sample in enumerate(split) if of_sample == name]
        if kind.by_sequence:
            sequences = sorted(samples, key=sequence.__getitem__)
            of_parts = [tuple(frames) for _, frames in itertools.groupby(sequences, key=sequence.__getitem__)]
        else:
            size = kind.samples_of_part(store.spec)
            of_parts = [tuple(samples[k : k + size]) for k in range(0, len(samples), size)]
        for k, of_part in enumerate(of_parts):
            parts.append(ExportPart(len(parts), name, of_part, k, len(of_parts), min_area_px, fps))
    return tuple(parts)


# --- the work -----------------------------------------------------------------------------------------------


def _write_parts(
    store: Store,
    kind: Format,
    parts: Sequence[ExportPart],
    folder: Folder,
    bar: Progress,
    workers: int,
    masks: str,
) -> int:
    """Write the parts that are not finished yet, and return how many samples that were."""
    stop = threading.Event()

    def write(part: ExportPart) -> tuple[ExportPart, bool]:
        is_new = not folder.has_part(part.number)
        return (_write_part(store, kind, part, folder, stop, masks) if is_new else part), is_new

    pool, written = ThreadPoolExecutor(workers), 0
    try:
        for part, is_new in pool.map(write, parts):
            written += is_new * len(part.samples)
            for _ in part.samples:
                bar.advance(is_new)
    finally:
        stop.set()
        pool.shutdown(wait=True, cancel_futures=True)
    return written


def _write_part(
    store: Store, kind: Format, part: ExportPart, folder: Folder, stop: threading.Event, masks: str
) -> ExportPart:
    """Write the files of a part, and then its record."""
    own, rows = Folder(folder.path), []
    layers = {*kind.layers(store.spec)} | ({MASK_RULES[masks]} if masks != "footprint" else set())

    def samples() -> Iterator[Sample]:
        for index in part.samples:
            if stop.is_set():
                raise VbnfaultError("the export was stopped")
            sample = store.read_sample(index, layers)
            rows.append(_row(store, sample))
            yield sample if masks == "footprint" else _with_masks(store, sample, MASK_RULES[masks])

    entries = kind.write_part(store, part, samples(), own)
    own.write_part(part.number, {"entries": entries, "rows": rows})
    return part


def _with_masks(store: Store, sample: Sample, layer: str) -> Sample:
    """Return a sample whose masks, and the union of them, are those of another layer of masks."""
    masks = sample.layers[layer]
    of_masks = {"mask": masks, "mask_any": mask_union(store.spec, masks)}
    if "mask_any" in sample.layers:  # what several faults turn into the same value is in no mask and no effect
        of_masks["mask_any"] |= sample.layers["mask_any"] & ~mask_union(store.spec, sample.layers["mask"])
    layers = {name: of_masks.get(name, values) for name, values in sample.layers.items() if name != layer}
    return replace(sample, layers=layers)


def _row(store: Store, sample: Sample) -> dict[str, Any]:
    """Return the scalars of a sample as a row of the table of samples; names replace indices."""
    scalars = {name: value for name, value in sample.scalars.items() if name not in _PARSED}
    row = {name: plain(np.asarray(v).ravel() if np.ndim(v) else v) for name, v in scalars.items()}
    row["injected"] = [f for f, on in zip(store.spec.faults, sample.scalars["injected"], strict=True) if on]
    row["stratum"] = STRATA[int(row["stratum"])]
    parsed = {name: store.table(sample.index, name, sample.scalars[name]) for name in _PARSED}
    return {"sample": sample.index, **row, **of_distortion(store.spec), **plain(parsed)}


# --- at the end ---------------------------------------------------------------------------------------------


def _finish(store: Store, kind: Format, parts: Sequence[ExportPart], folder: Folder, masks: str) -> tuple[str, ...]:
    """Write index, table of samples, card and Croissant description, and return the format's warnings."""
    splits = tuple(dict.fromkeys(part.split for part in parts))
    closing = kind.finish(Finished(store=store, splits=splits, parts=tuple(parts), folder=folder))
    digest = hashlib.sha256()

    def write_rows(path: Path) -> None:
        with path.open("wb") as file:
            for part in parts:
                record = folder.part(part.number)
                for (_, image, _note), row in zip(record["entries"], record["rows"], strict=True):
                    line = json.dumps({"file": image, **row}, allow_nan=False).encode() + b"\n"
                    digest.update(line)
                    file.write(line)

    folder.put_with(SAMPLES, write_rows)
    numbers = statistics(store)
    folder.put(
        [
            ("README.md", _card(store, kind, closing, numbers, masks).encode()),
            ("croissant.json", to_json(_croissant(store, kind, digest.hexdigest(), numbers, masks)).encode()),
        ]
    )
    return tuple(closing.warnings)


def _card(store: Store, kind: Format, closing: Closing, numbers: Statistics, masks: str) -> str:
    """Return the card of an export as Markdown; `masks`: footprint or effect."""
    return rendered(
        "output/export/card.md",
        kind=kind,
        closing=closing,
        lines=[*kind.usage, *closing.lines],
        masks=masks,
        names_masks="mask_effect" not in kind.layers(store.spec),
        effect_rule=EFFECT_RULE,
        **described(store, numbers),
    )


_COLUMNS = {
    "file": ("file that holds the image", ""),
    "sample": ("index of the sample in the store", 0),
    "split": ("split of the dataset", ""),
    "stratum": ("stratum of the sampling", ""),
    "site": ("index of the site", 0),
    "exposure_s": ("exposure time in s", 0.0),
    "sun_elevation_deg": ("Sun elevation in L, up, in deg", 0.0),
    "sun_distance_au": ("distance to the Sun in au", 0.0),
}


def _croissant(store: Store, kind: Format, sha256: str, numbers: Statistics, masks: str) -> dict[str, Any]:
    """Return the Croissant description of an export, whose records are the rows of the table of samples.

    `masks`: footprint or effect.
    """
    files = [
        {
            "@type": "cr:FileObject",
            "@id": SAMPLES,
            "name": SAMPLES,
            "description": "One line of JSON for each sample: file, split, faults and all scalars of the store.",
            "contentUrl": SAMPLES,
            "encodingFormat": "application/jsonlines",
            "sha256": sha256,
        },
        {
            "@type": "cr:FileSet",
            "@id": "files",
            "name": "files",
            "description": kind.summary,
            "encodingFormat": kind.media_type,
            "includes": kind.pattern,
        },
    ]
    records = [columns("samples", f"The {numbers.finished} samples", SAMPLES, _COLUMNS)]
    if kind.croissant_image:
        records.append(image_records("files", kind.croissant_image, kind.croissant_sample))
    rules = [EFFECT_RULE] * len(store.spec.faults) if masks == "effect" else None
    return croissant(store, files, records, rules)
