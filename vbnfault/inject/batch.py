"""Inject faults into the images of files, with several processes, and continue after an interruption.

Each image keeps its name and its kind of file. Beside it lie its masks and a JSON file with the parameters, which
is written last: an image with a whole JSON file of the same scene and input is finished. With labels in a store,
the images are also the samples of a dataset, whose image has 8 bits as in any other. The frames of a film are
images, from which the film is put together again.
"""

from __future__ import annotations

import dataclasses
import glob
import hashlib
import json
import os
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path, PurePosixPath
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from .. import store
from ..core.errors import InputError, VbnfaultError
from ..core.files import user_files
from ..core.files.images import write_png
from ..core.files.whole_files import own, write_json, writing
from ..core.quantities import Sample
from ..dataset import build
from ..dataset.from_scene import with_card
from ..dataset.identity import IMAGES, is_exact, planned, store_spec, with_contents
from ..dataset.progress import Progress, size_text
from ..dataset.work import SingleItems, Tick, attempt
from ..pipeline import Session
from ..pipeline.record import proposal
from ..scene import plan
from ..scene.config import Scene
from ..scene.instrument import ImageTable
from ..scene.sampling import PlanTable
from ..scene.trajectory import place_in_sequence
from ..store import SCALARS
from .files import ENDINGS, MOST_VALUES, ImageFile, read_image, source_files
from .films import ENDINGS as FILMS
from .films import Film, assemble, frame_path, unpack
from .injector import Injected, Injector, of_first_image
from .picture import levels

Labels = Literal["png", "zarr"]

STORE = "dataset.zarr"
_LAYERS = ("clean", "mask_effect")
# Least memory for a pixel of a grey image, and for each number of a colour image. What was measured for a pixel at
# the peak, less the memory of Python: 144 bytes (grey) and 276 bytes (colours) with dust alone, 153 bytes (grey)
# with dust and hot pixels, 600 bytes with the six faults of physical67p.
_GREY_BYTES, _COLOUR_BYTES = 140, 90
_EVERY = (*ENDINGS, *FILMS)
_MUCH_WHITE = 0.1  # fraction of pixels that turn white, from which a person should know


@dataclass(frozen=True, kw_only=True)
class Batch:
    """Describe images and what is injected into them; equal batches give equal files.

    Attributes
    ----------
    scene
        Scene whose `dataset.samples` is the number of images.
    sources, names
        Files of the images, in order, and their paths below the folder that holds all of them. Frames of a film
        lie below its name without the ending.
    out
        Folder of the results.
    sun
        In place of `image.sun` of the scene; None: as there.
    """

    scene: Scene
    sources: tuple[Path, ...]
    names: tuple[str, ...]
    out: Path
    sun: str | tuple[float, ...] | None = None

    @cached_property
    def injector(self) -> Injector:
        """Return what injects the faults."""
        return Injector(self.scene)

    @cached_property
    def plan(self) -> plan.Plan:
        """Return which image is commanded to carry which faults."""
        faults = self.injector.faults
        need_sun = [name for name, fault in faults.items() if fault.needs_sun]
        return plan.make_plan(self.scene, list(faults), (len(self.names),), need_sun=need_sun)

    def state(self, index: int) -> int | None:
        """Return the number of the instrument's state in an image; None for an image by itself."""
        sequence = place_in_sequence(self.scene.frames, index)[0]
        return None if sequence < 0 or self.scene.frames[sequence] == 1 else int(self.plan.state[index])

    @cached_property
    def _scene_with_contents(self) -> str:
        """Return the scene with what is in the files that it names, as text."""
        return json.dumps(with_contents(self.scene, self.injector.faults), sort_keys=True)

    def key(self, index: int) -> str:
        """Return a digest of the input of an image: its file, its number, the scene with its files and the Sun."""
        told = json.dumps([self.content(index), index, self.sun, len(self.names), self._scene_with_contents])
        return user_files.sha256(told.encode())

    def content(self, index: int) -> str:
        """Return a digest of the files of an image."""
        digest = hashlib.sha256()
        for path in source_files(self.sources[index]):
            digest.update(path.read_bytes())
        return digest.hexdigest()

    def report(self) -> list[str]:
        """Return sentences on what was made, from the files of the images: assumptions, each once, and classes."""
        paths = filter(Path.is_file, map(self.label_file, range(len(self.names))))
        labels = (json.loads(path.read_text(encoding="utf-8")) for path in paths)
        told = ("assumptions", "injected", "left_out", "white_fraction")
        made = [{key: label[key] for key in told} for label in labels]  # parameters of many images fill the memory
        lines = list(dict.fromkeys(text for label in made for text in label["assumptions"]))
        for name in self.injector.faults:
            reasons = Counter(label["left_out"][name] for label in made if name in label["left_out"])
            has = sum(name in label["injected"] for label in made)
            why = "".join(f"; {count} without: it {reason}" for reason, count in reasons.items())
            lines.append(f"{name}: in {has} of {len(made)} images{why}")
        before, after = (sum(label["white_fraction"][k] for label in made) / max(len(made), 1) for k in (0, 1))
        if after > before + _MUCH_WHITE:
            lines.append(
                f"{after:.0%} of the pixels are white, and {before:.0%} were before: light of the faults saturates "
                "the camera; see camera.exposure_s, camera.f_number and camera.transmission"
            )
        return lines

    def label_file(self, index: int) -> Path:
        """Return the path of the JSON file of an image."""
        return self.out / "labels" / f"{self.names[index]}.json"

    def is_finished(self, index: int) -> bool:
        """Return whether all files of an image are there, made from the same input."""
        try:
            label = json.loads(self.label_file(index).read_text(encoding="utf-8"))
            return bool(label["input"] == self.key(index)) and all((self.out / f).is_file() for f in label["files"])
        except (OSError, ValueError, KeyError, TypeError):
            return False

    def _files_of_before(self, label: Path) -> list[str]:
        """Return the masks and images that the JSON file of an earlier run lists, as far as they lie in `out`."""
        try:
            files = json.loads(label.read_text(encoding="utf-8"))["files"]
            return [f for f in files if PurePosixPath(f).parts[0] in ("masks", "clean") and ".." not in f]
        except (OSError, ValueError, KeyError, TypeError, IndexError, AttributeError):
            return []

    def injected(self, index: int) -> tuple[ImageFile, Injected]:
        """Return an image and its result. Raises InputError, with the name of the file, if it cannot be used."""
        path = self.sources[index]
        image = read_image(path)
        try:
            _check_memory(image.numbers)
            return image, self.injector(
                image.numbers,
                index,
                state=self.state(index),
                sun=self.sun,
                commanded=self.plan.commanded(index),
                depth_m=image.depth_m,
            )
        except InputError as error:
            raise InputError(f"{path}: {error}") from None

    def write(self, index: int, image: ImageFile, result: Injected) -> None:
        """Write the files of an image; the JSON file comes last."""
        name = self.names[index]
        names = [fault for fault, has in zip(result.faults, result.injected, strict=True) if has]
        files = [str(PurePosixPath(name).with_name(path.name)) for path in source_files(self.sources[index])]
        with writing(self.out, within=True):
            target = own(self.out / name)
            target.parent.mkdir(parents=True, exist_ok=True)
            image.write(target, result.image, "faults by vbnfault: " + (", ".join(names) or "none"))
            if self.scene.image and self.scene.image.noise_free:
                files.append(f"clean/{name}")
                path = own(self.out / files[-1])
                path.parent.mkdir(parents=True, exist_ok=True)
                image.write(path, result.clean, "taken by the camera of vbnfault")
            masks = {fault: result.masks[result.faults.index(fault)] for fault in names}
            for fault, mask in {**masks, "any": result.mask_any}.items():
                files.append(f"masks/{name}_{fault}.png")
                path = own(self.out / files[-1])
                path.parent.mkdir(parents=True, exist_ok=True)
                write_png(path, mask.astype(np.uint8) * 255)
            label = self.label_file(index)
            for old in set(self._files_of_before(label)) - set(files):  # masks of classes that are no longer in it
                own(self.out / old).unlink(missing_ok=True)
            label.parent.mkdir(parents=True, exist_ok=True)
            content = {
                "image": name,
                "number": index,
                "seed": self.scene.dataset.seed,
                "input": self.key(index),
                "injected": names,
                "left_out": result.left_out,
                "sun_xy_px": None if result.sun_xy_px is None else result.sun_xy_px.tolist(),
                "parameters": result.parameters,
                "unrecoverable_fraction": float(result.unrecoverable.mean()),
                "white_fraction": [result.white_fraction(result.clean), result.white_fraction(result.image)],
                "assumptions": list(result.assumptions),
                "files": files,
            }
            write_json(own(label), content)


def _check_memory(numbers: NDArray[Any]) -> None:
    """Raise InputError if less memory is free than an image needs at least; the system would end the process."""
    import psutil

    needed = numbers.size * (_GREY_BYTES if numbers.ndim == 2 else _COLOUR_BYTES)
    free = psutil.virtual_memory().available
    if needed > free:
        height, width = numbers.shape[:2]
        raise InputError(
            f"has {width} x {height} pixels, which need {size_text(needed)} of memory or more, and "
            f"{size_text(free)} are free; cut it into parts"
        )


# --- files alone --------------------------------------------------------------------------------------------------


class _Worker:
    """Inject into images, one a task."""

    def __init__(self, batch: Batch) -> None:
        self._batch = batch

    def do(self, task: int, tick: Tick) -> None:
        """Do a task."""
        if self._batch.is_finished(task):
            tick(task, "kept", "")
            return

        def make(index: int) -> bool:
            self._batch.write(index, *self._batch.injected(index))
            return True

        if attempt(task, make, tick):
            tick(task, "built", "")


class _Images(SingleItems):
    """Hand out the images of a batch; a damaged one is reported, and the others are made."""

    noun, task_noun, item_noun = "batch", "image", "image"


# --- a store beside them ------------------------------------------------------------------------------------------


class _Samples:
    """Make samples of images, and write their files."""

    def __init__(self, batch: Batch) -> None:
        self._batch = batch

    def simulate(self, index: int) -> Sample:
        """Return the sample of an image. Raises InputError if it has another size than the store's images."""
        image, result = self._batch.injected(index)
        (height, width), camera = image.numbers.shape[:2], self._batch.scene.camera
        if (width, height) != (camera.width_px, camera.height_px):
            raise InputError(
                f"{self._batch.sources[index]}: has {width} x {height} pixels, and the store's images have "
                f"{camera.width_px} x {camera.height_px}, as the first; use --labels png"
            )
        self._batch.write(index, image, result)
        return _sample(self._batch, index, image, result)


def _sample(batch: Batch, index: int, image: ImageFile, result: Injected) -> Sample:
    """Return an image with its labels as a sample of a store; what an image does not say is NaN."""
    table, camera = batch.plan, result.camera
    response = result.response
    assert response is not None
    layers: dict[str, NDArray[Any]] = {
        "image": levels(result.image, response),
        "clean": levels(result.clean, response),
        "mask": result.masks,
        "mask_any": result.mask_any,
        "mask_effect": np.asarray(result.mask_effect),
    }
    if "depth_m" in batch.scene.dataset.layers:
        nothing = np.full(result.mask_any.shape, np.nan, np.float32)
        layers["depth_m"] = nothing if image.depth_m is None else image.depth_m
    sizes = {"fault": len(result.faults), "xyz": 3, "quaternion": 4, "axis_row": 3, "axis_col": 3, "xy": 2}
    scalars: dict[str, Any] = {
        name: np.full([sizes[d] for d in row.dims[1:]], row.fill, row.dtype)[()]
        for name, row in SCALARS.items()
        if row.dtype != "str" and set(row.dims[1:]) <= set(sizes)
    }
    sun = result.sun_xy_px
    scalars |= {
        "injected": result.injected,
        "intrinsics": camera.intrinsics,
        "distortion": camera.lens.distortion,
        "exposure_s": camera.exposure_s,
        "sun_distance_au": batch.scene.sun.distance_au or np.nan,
        "sun_xy_px": np.full(2, np.nan) if sun is None else sun,
        "tries": 1,
        "views": 1,
        "resolved": True,
        "stratum": int(table.stratum[index]),
        "site": int(table.site[index]),
        "detector_individual": int(table.individual[index]),
        "split": plan.SPLITS[table.split[index]],
        "parameters": result.parameters,
        "proposal": proposal(batch.scene, table, index, table.view(batch.scene, index, 0)),
    }
    return Sample(index=index, layers=layers, scalars=scalars)


# --- the whole batch ----------------------------------------------------------------------------------------------


def inject_files(
    images: Sequence[str | Path],
    scene: Scene,
    out: Path,
    *,
    labels: Labels = "png",
    sun: str | tuple[float, ...] | None = None,
    sequence: bool = False,
    workers: int = 1,
    progress: bool = True,
) -> Batch:
    """Inject the faults of a scene into the images of files, folders and globs, and write them to a folder.

    With `sequence`, all images share the faults and the state of the instrument, as the frames of a film do.

    Raises
    ------
    InputError
        There is no image, or scene and options do not fit.
    VbnfaultError
        Some images failed; all others are made, and the same call tries the failed ones again.
    """
    sources, names, frames, films = _frames(*_found(images, out), out)
    frames = (len(names),) if sequence else frames if films else ()
    dataset = scene.dataset.model_copy(update={"samples": len(names)})
    scene = scene.model_copy(update={"dataset": dataset, "plan": _plan(scene)})
    if frames:  # each is a site of its own, as a sequence of poses is
        dataset = dataset.model_copy(update={"sites": len(frames)})
        image = (scene.image or ImageTable()).model_copy(update={"frames": frames})
        scene = scene.model_copy(update={"dataset": dataset, "image": image})
    batch = Batch(scene=scene, sources=sources, names=names, out=out, sun=sun)
    if scene.camera.unsized_calibration:
        height, width = _first_image(batch).numbers.shape[:2]
        batch = dataclasses.replace(batch, scene=of_first_image(scene, width, height))
    options = build.BuildOptions(workers=workers, progress=progress)
    batch.injector.require_faults()  # an unusable scene is reported before any image
    _check_kept(batch)
    job = _Images(out, Progress(len(names), shown=progress, noun="images"), dict.fromkeys(range(len(names)), 0))
    if labels == "zarr":
        _build(batch, options)
    else:
        with job.progress:
            build.do_tasks(partial(_Worker, batch), job, options)
    failed = {sources[index].parent for index in job.failures}
    for name, film in films.items():
        if not film.frames or out / "frames" / name in failed:
            continue
        with writing(out, within=True):
            assemble(out / name, own(out / f"{name}.mkv"), film)
    ended = [film.ended for film in films.values() if film.ended]
    job.raise_failures(of=f" of {len(names)}", kept="; ".join(["all other images are kept", *ended]))
    if ended:
        raise VbnfaultError("; ".join(ended))
    return batch


def _check_kept(batch: Batch) -> None:
    """Raise InputError if the results would replace an image that is read."""
    read = {os.path.realpath(file) for path in batch.sources for file in source_files(path)}
    folders = ("", "clean") if batch.scene.image and batch.scene.image.noise_free else ("",)
    written = (batch.out / folder / name for folder in folders for name in batch.names)
    if not read.isdisjoint(map(os.path.realpath, written)):
        raise InputError(f"--out {batch.out}: holds the images, which would be replaced; choose another folder")


def _plan(scene: Scene) -> PlanTable:
    """Return the plan of a scene; one that has none commands every class in every image."""
    return scene.plan if "plan" in scene.model_fields_set else PlanTable(mode="per_class", faulty_fraction=1.0)


def _build(batch: Batch, options: build.BuildOptions) -> None:
    """Make a store of a batch beside its files."""
    first = _first_image(batch)
    height, width = first.numbers.shape[:2]
    camera = batch.scene.camera.of_image(width, height)
    layers = _LAYERS if first.depth_m is None else (*_LAYERS, "depth_m")
    known: dict[str, Any] = {"layers": layers}
    if "licence" not in batch.scene.dataset.model_fields_set:
        known["licence"] = ""  # that of rendered datasets is not that of images of one's own
    dataset = batch.scene.dataset.model_copy(update=known)
    scene = batch.scene.model_copy(update={"camera": camera, "dataset": dataset})
    session = Session(scene)
    spec = store_spec(session, (len(batch.names),))
    digests = {name: batch.content(index) for index, name in enumerate(batch.names)}
    spec = dataclasses.replace(
        spec,
        sample_names=batch.names,
        attributes={**spec.attributes, IMAGES: {"sha256": digests, "sun": batch.sun}},
    )
    made = build.BuildPlan(
        spec=spec,
        site=session.plan.site,
        planned_faults=session.plan.injected,
        expected=planned(spec.attributes, spec.faults),
        exact=is_exact(spec.attributes),
    )
    batch = dataclasses.replace(batch, scene=scene)
    out = store.located(batch.out / STORE)
    batch.out.mkdir(parents=True, exist_ok=True)
    with_card(out, build.build(partial(_Samples, batch), made, out, options))


def _first_image(batch: Batch) -> ImageFile:
    """Return the first image that can be read, which sets the size of a store; InputError if there is none."""
    problems = []
    for path in batch.sources:
        try:
            return read_image(path)
        except InputError as error:
            problems.append(str(error))
    raise InputError(problems[0])


def _frames(
    root: Path, paths: Sequence[Path], out: Path
) -> tuple[tuple[Path, ...], tuple[str, ...], tuple[int, ...], dict[str, Film]]:
    """Return images, with frames for films, their names below the folder `root`, and the films by name.

    Between names and films are the numbers of frames that follow each other: those of a film, and 1 of an image.
    """
    sources: list[Path] = []
    names: list[str] = []
    together: list[int] = []
    films = {}
    for path in paths:
        name = path.relative_to(root).as_posix()
        if path.suffix.lower() not in FILMS:
            together.append(1)
            sources.append(path)
            names.append(name)
            continue
        name = str(PurePosixPath(name).with_suffix(""))
        folder = out / "frames" / name
        with writing(out, within=True):
            try:
                film = unpack(path, folder, MOST_VALUES)
            except InputError as error:  # the other images are made
                film = Film(sha256="", frames=0, rate="1", ended=str(error))
        films[name] = film
        frames = [frame_path(folder, number) for number in range(1, film.frames + 1)]
        together += [len(frames)] if frames else []
        sources += frames
        names += [f"{name}/{frame.name}" for frame in frames]
    twice = next((name for name, count in Counter(names).items() if count > 1), None)
    if twice:
        raise InputError(f"{root / twice}: is named twice")
    if not names:
        raise InputError("; ".join(film.ended for film in films.values()))
    return tuple(sources), tuple(names), tuple(together), films


def _found(images: Sequence[str | Path], out: Path) -> tuple[Path, list[Path]]:
    """Return the folder that holds all images and films, and their paths; those of a folder or glob are sorted."""
    paths: list[Path] = []
    results = out.resolve()
    for given in map(str, images):
        path = Path(given)
        if path.is_dir():
            _check_apart(path, out)
            every = sorted(p for p in path.rglob("*") if p.suffix.lower() in _EVERY and p.is_file())
            inside = [p for p in every if not p.resolve().is_relative_to(results)]  # results of an earlier run
            if not inside:
                raise InputError(f"{path}: holds no image; they end with one of {', '.join(_EVERY)}")
            paths += inside
        elif path.exists() or not glob.has_magic(given):
            paths.append(path)
        else:
            matched = sorted(map(Path, glob.glob(given, recursive=True)))
            if not matched:
                raise InputError(f"{given}: matches no file")
            paths += matched
    paths = [path.parent.resolve() / path.name for path in paths]
    if not paths:
        raise InputError("there is no image; name files, folders or globs")
    root = paths[0].parent
    while not all(path.is_relative_to(root) for path in paths):
        root = root.parent
    _check_apart(root, out)
    return root, paths


def _check_apart(folder: Path, out: Path) -> None:
    """Raise InputError if the results would replace the images of a folder."""
    if folder.resolve() == out.resolve():
        raise InputError(f"--out {out}: holds the images, which would be replaced; choose another folder")
