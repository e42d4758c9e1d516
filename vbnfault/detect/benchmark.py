"""Make the datasets of a benchmark: what to train on, and tests that differ from it in one thing each.

A benchmark is a TOML file, packaged in `scenes/benchmarks` or a user's own. Its parts name a scene, a set of
faults, a number of samples and the keys that replace those of the scene. One call builds all parts, resumes what
was begun, and writes `benchmark.json` with the size and the digest of each. A part can also have its faults in
images of the user's own, which are injected in place of being rendered.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

from pydantic import Field

from .. import __version__, dataset
from ..core import tables
from ..core.errors import InputError, in_file, suggestion
from ..core.files import resources, toml_files, user_files
from ..core.files.whole_files import write_json, writing
from ..core.tables import Table
from ..scene.config import Scene, load_scene
from ..store import digest as digest_of
from ..store import open_store

MANIFEST = "benchmark.json"


class Part(Table):
    """Describe one dataset of a benchmark."""

    scene: str = Field(description="name or path of the scene, from the file's folder")
    faults: str = Field(description="set of faults, a table of [faults], in place of the scene's")
    samples: int | None = Field(None, ge=1, le=10_000_000, description="number of samples; of frames, all")
    frames: bool = Field(False, description="put the faults into images of the user's folder, bench --frames")
    purpose: Literal["train", "test"] = Field("test", description="train: for training; test: a detector is scored")
    description: str = Field("", description="what the part has that others have not")
    set: dict[str, Any] = Field({}, description="dotted keys of the scene and their values")


class Benchmark(Table):
    """Describe the datasets of a benchmark."""

    title: str = Field(description="name of the benchmark")
    description: str = Field("", description="what it asks")
    common: dict[str, Any] = Field({}, description="dotted keys of all scenes and their values")
    faults: dict[str, dict[str, dict[str, Any]]] = Field(description="sets of faults: tables as a scene's [faults]")
    parts: dict[str, Part] = Field(min_length=1, description="the datasets by name")


@dataclass(frozen=True, kw_only=True)
class BuiltPart:
    """Describe a finished part: its store, the number of its samples, its size and its digest."""

    store: str
    purpose: str
    description: str
    samples: int
    size_bytes: int
    digest: str | None


def load_benchmark(name_or_path: str | Path) -> tuple[Benchmark, Path]:
    """Return a benchmark by its path or packaged name, and its file. Raises InputError."""
    path = resources.find("scenes/benchmarks", name_or_path)
    found = tables.parse(Benchmark, toml_files.read_toml(path, "benchmark"), source=str(path))
    for name, part in found.parts.items():
        if part.faults not in found.faults:
            known = ", ".join(found.faults)
            raise InputError(
                f"{path}: parts.{name}.faults = {part.faults!r}: no such table of [faults]"
                f"{suggestion(part.faults, found.faults)}; {known}"
            )
        if (part.samples is None) != part.frames:
            raise InputError(
                f"{path}: parts.{name}.samples: must be a whole number of at least 1, and be left out with "
                "frames = true, whose samples are the images of a folder"
            )
    return found, path


def scene_of(benchmark: Benchmark, name: str, path: Path) -> Scene:
    """Return the scene of a part. Raises InputError."""
    part = benchmark.parts[name]
    values = {**benchmark.common, "faults": benchmark.faults[part.faults], **part.set}
    if part.samples is not None:
        values["dataset.samples"] = part.samples
    values = {key: _beside(value, path) if isinstance(value, str) else value for key, value in values.items()}
    with in_file(f"{path}: parts.{name}"):
        return load_scene(_beside(part.scene, path), values)


def _beside(name: str, path: Path) -> str:
    """Return the path of a file that lies beside the benchmark's file, or the name as it is if there is none."""
    beside = path.absolute().parent / name
    return str(beside) if Path(name).suffix and beside.is_file() else name


def make_benchmark(
    name_or_path: str | Path,
    out: Path,
    options: dataset.BuildOptions | None = None,
    *,
    fraction: float = 1.0,
    only: Sequence[str] = (),
    frames: str = "",
) -> Iterator[tuple[str, BuiltPart, list[str]]]:
    """Build the parts of a benchmark, or those of the names `only`, and yield the name, the result and lines
    that say what was done, or is to be done, of each.

    A `fraction` of the samples of each part is made, for a trial. The same call, with the same fraction, continues
    what was begun. Parts of frames have all images of the folder `frames`, and are left out without one. With
    `options.dry_run`, nothing is written.

    Raises
    ------
    InputError
        The benchmark cannot be used, or a store holds another scene.
    BuildFailed
        Samples failed.
    """
    benchmark, path = load_benchmark(name_or_path)
    for name in only:
        if name not in benchmark.parts:
            known = ", ".join(benchmark.parts)
            raise InputError(f"{path}: has no part {name!r}{suggestion(name, benchmark.parts)}; {known}")
    made = [name for name in only or benchmark.parts if frames or not benchmark.parts[name].frames]
    if without := [name for name in only if name not in made]:
        raise InputError(f"{path}: parts.{without[0]}.frames = true: needs a folder of images (--frames)")
    scenes = {name: scene_of(benchmark, name, path) for name in made}
    options = options or dataset.BuildOptions()
    if not options.dry_run:
        with writing(out):
            out.mkdir(parents=True, exist_ok=True)
    for name, scene in scenes.items():
        part = benchmark.parts[name]
        if part.frames:
            store, samples, digest, lines = _injected(scene, frames, out / name, options)
        else:
            store, variants = out / f"{name}.zarr", scene.dataset.variants_per_view
            summary = dataset.build_scene(
                scene,
                store,
                options,
                samples=max(1, round(fraction * scene.dataset.samples / variants)) * variants,
                source=f"{path}: parts.{name}",
            )
            samples, digest, lines = summary.samples, summary.digest, summary.lines()
        built = BuiltPart(
            store=store.relative_to(out).as_posix(),
            purpose=part.purpose,
            description=part.description,
            samples=samples,
            size_bytes=sum(file.stat().st_size for file in store.rglob("*") if file.is_file()),
            digest=digest,
        )
        if not options.dry_run:
            with writing(out / MANIFEST):
                write_json(out / MANIFEST, _manifest(benchmark, out, {name: built}))
        yield name, built, lines


def _injected(
    scene: Scene, frames: str, folder: Path, options: dataset.BuildOptions
) -> tuple[Path, int, str | None, list[str]]:
    """Put a scene's faults into a folder's images; return the store, their number, the digest, and a report."""
    from ..inject.batch import inject_files

    store = folder / "dataset.zarr"
    if options.dry_run:
        return store, 0, None, [f"faults in the images of {frames}, which are not counted before they are made"]
    batch = inject_files([frames], scene, folder, labels="zarr", workers=options.workers, progress=options.progress)
    return store, len(batch.names), digest_of(open_store(store)), batch.report()


def _manifest(benchmark: Benchmark, out: Path, built: Mapping[str, BuiltPart]) -> dict[str, Any]:
    """Return the contents of the manifest with further parts, in the order of the benchmark."""
    parts = read_manifest(out)["parts"] if (out / MANIFEST).exists() else {}
    parts |= {name: asdict(part) for name, part in built.items()}
    order = [name for name in (*benchmark.parts, *parts) if name in parts]
    return {
        "title": benchmark.title,
        "description": benchmark.description,
        "version": __version__,
        "parts": {name: parts[name] for name in order},
    }


def read_manifest(folder: Path) -> dict[str, Any]:
    """Return the manifest of a folder that `make_benchmark` wrote. Raises InputError."""
    return read_record(
        folder / MANIFEST,
        lambda manifest: all(isinstance(part["store"], str) for part in manifest["parts"].values()),
        "is no list of a benchmark's datasets; make it with vbnfault bench",
    )


def read_record(path: Path, is_sound: Callable[[Any], bool], otherwise: str) -> dict[str, Any]:
    """Return a JSON file of a benchmark's folder. Raises InputError, with this sentence if it is not sound."""
    try:
        record = json.loads(user_files.read_input(path, "benchmark"))
        if is_sound(record):
            return dict(record)
    except (ValueError, TypeError, KeyError, AttributeError):
        pass
    raise InputError(f"{path}: {otherwise}")
