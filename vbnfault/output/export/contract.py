"""Define what a format of an export provides, and the registry of formats."""

from __future__ import annotations

import inspect
from abc import ABC, abstractmethod
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar, NamedTuple

import numpy as np

from ...core.files.images import png
from ...core.quantities import Sample
from ...core.registry import Registry, is_name
from ...store import Store, StoreSpec
from .folder import Folder

FPS = (0.1, 1000.0)  # frames a second of a film, least and most

_registry: Registry[type[Format]]


class ExportPart(NamedTuple):
    """Name a part of an export, which is written and resumed as a whole: some samples of one split.

    `number` counts the parts of the export. `of_split` and `parts_of_split` count those of the split. Instances of
    fewer than `min_area_px` pixels are left out. `fps`: frames a second of a film, None for those of the sequence.
    """

    number: int
    split: str
    samples: tuple[int, ...]
    of_split: int
    parts_of_split: int
    min_area_px: int = 1
    fps: float | None = None


class Entry(NamedTuple):
    """Describe one exported sample: the file that holds its image, and what `Format.finish` needs to know of it."""

    sample: int
    file: str
    note: Any = None


@dataclass(frozen=True, kw_only=True)
class Finished:
    """Hold what `Format.finish` gets: the store, the splits, and the entries of all parts.

    `entries` reads them again from the disk at each call, a part at a time.
    """

    store: Store
    splits: tuple[str, ...]
    parts: tuple[ExportPart, ...]
    folder: Folder

    def entries(self, split: str) -> Iterator[Entry]:
        """Yield the entries of a split in the order of the samples."""
        for part in self.parts:
            if part.split == split:
                yield from (Entry(*entry) for entry in self.folder.part(part.number)["entries"])


@dataclass(frozen=True, kw_only=True)
class Closing:
    """Hold what a format adds at the end: lines for the card, front matter of the card, and warnings to print."""

    front: Sequence[str] = ()
    lines: Sequence[str] = ()
    warnings: Sequence[str] = field(default=())


class Format(ABC):
    """Write samples of a store in the format of other tools. A class with a `name` registers itself.

    The docstring of the class is what the card says: its first line names the format and what is written, for the
    help, too; the rest, in Markdown, says which files there are and how to read them.

    A format of one file and more for each sample defines `files`; one that joins samples in a file defines
    `write_part`. `finish` writes what follows from all samples, such as an index. An object holds no state: parts
    are written by several threads, in any order.
    """

    name: ClassVar[str] = ""
    summary: ClassVar[str] = ""  # the first line of the docstring
    usage: ClassVar[Sequence[str]] = ()  # its other lines
    media_type: ClassVar[str] = "image/png"  # of the files in which the images are
    pattern: ClassVar[str] = "**/*.png"  # which matches the names of these files
    has_instances: ClassVar[bool] = False  # whether masks become instances, of which small ones may be left out
    # how a reader of Croissant finds the image, and the index of its sample, in these files; none: it cannot
    croissant_image: ClassVar[Mapping[str, Any]] = {"extract": {"fileProperty": "content"}}
    croissant_sample: ClassVar[Mapping[str, Any]] = {
        "extract": {"fileProperty": "filename"},
        "transform": {"regex": r"^0*(\d+)\D"},
    }
    by_sequence: ClassVar[bool] = False  # whether a part is a sequence; stores without sequences are refused
    part_samples: ClassVar[int] = 16
    part_bytes: ClassVar[int | None] = None  # if given, a part has about this size instead

    def __init_subclass__(cls, **keywords: Any) -> None:
        super().__init_subclass__(**keywords)
        if cls.__dict__.get("__doc__") and "summary" not in cls.__dict__:
            first, *rest = inspect.cleandoc(str(cls.__doc__)).splitlines()
            cls.summary, cls.usage = first, rest[1:]
        if cls.name:
            if not is_name(cls.name):
                raise TypeError(f"{cls.__qualname__}: name = {cls.name!r}: must be lower-case letters and digits")
            _registry.add(cls.name, cls, module=cls.__module__, qualname=cls.__qualname__)

    @abstractmethod
    def layers(self, spec: StoreSpec) -> Collection[str]:
        """Return the names of the layers that the format reads; each is a layer of `spec`."""

    def samples_of_part(self, spec: StoreSpec) -> int:
        """Return how many samples a part has at most; it depends on the store's spec only."""
        if self.part_bytes is None:
            return self.part_samples
        return max(1, min(1024, self.part_bytes // spec.estimated_sample_bytes))

    def write_part(self, store: Store, part: ExportPart, samples: Iterable[Sample], folder: Folder) -> list[Entry]:
        """Write the files of a part and return the entries of its samples; `samples` are read one at a time."""
        entries = []
        for sample in samples:
            entry, files = self.files(store, part, sample)
            folder.put(files)
            entries.append(entry)
        return entries

    def files(self, store: Store, part: ExportPart, sample: Sample) -> tuple[Entry, Iterable[tuple[str, bytes]]]:
        """Return the entry of a sample, and the names and contents of its files."""
        raise NotImplementedError

    def finish(self, finished: Finished) -> Closing:
        """Write what follows from all samples, and return what the card shall say."""
        return Closing()


_registry = Registry("export format", "vbnfault.output.export.formats")


def formats() -> dict[str, type[Format]]:
    """Return the registered formats by name."""
    return dict(_registry)


def number_text(index: int, samples: int) -> str:
    """Return a sample's index with leading zeros, so that the names of all samples sort as their indices do."""
    return f"{index:0{max(6, len(str(samples - 1)))}d}"


def of_distortion(spec: StoreSpec) -> dict[str, Any]:
    """Return what the coefficients `distortion` and the `intrinsics` of a sample mean: model and skew in px."""
    return {"distortion_model": spec.distortion_model or "opencv", "skew_px": spec.skew_px}


def png_files(spec: StoreSpec, sample: Sample) -> Iterator[tuple[str, str, bytes]]:
    """Yield name of the layer, part of it and content of a PNG file of each image and mask of a sample.

    The part is `intensity` for the intensity channel of an image, the fault for a mask, otherwise empty. Masks have
    8 bits, 255 where they are True, else 0.
    """
    for name, layer in sample.layers.items():
        if name in ("mask", "mask_effect"):
            for fault, mask in zip(spec.faults, layer, strict=True):
                yield name, fault, png(mask.astype(np.uint8) * 255)
        elif layer.ndim == 3 and layer.dtype == np.uint8:
            yield name, "", png(layer[..., :3])
            yield name, "intensity", png(layer[..., 3])
        elif layer.dtype.kind in "bu":
            yield name, "", png(layer.astype(np.uint8) * 255 if layer.dtype == np.bool_ else layer)
