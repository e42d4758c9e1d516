"""Export to WebDataset: tar files that a trainer reads from front to back."""

from __future__ import annotations

import io
import json
import tarfile
from collections.abc import Collection, Iterable, Iterator
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from ....core.files.whole_files import plain
from ....core.quantities import Sample
from ....store import Store, StoreSpec
from ..contract import Entry, ExportPart, Format, number_text, of_distortion, png_files
from ..folder import Folder

_ARRAYS = ("depth_m", "normal")
_PLAIN = ("mask_any", "semantic", "raw")


class WebDataset(Format):
    """WebDataset: tar files of PNG images and masks, NumPy arrays and JSON, each of one split.

    - `SPLIT-NUMBER.tar`: read them with `webdataset.WebDataset`. The key of a sample is its index in the store.
      Samples are in ascending order, so shuffle when you read.
    - `image.png`, `clean.png`: R, G, B, 8 bits a channel; `intensity.png`: the intensity channel of the image.
    - `mask.<fault>.png` for every class, in each sample, and `mask_any.png`: 8 bits, 255 where the mask is set.
    - `semantic.png`: 8 bits; 0 sky, 1 body, 2 Sun, 3 spacecraft. `raw.png`: the raw mosaic, 16 bits, in DN.
    - `depth_m.npy` and `normal.npy`: NumPy arrays in metres and in the camera's frame, if the store has them.
    - `json`: the names of the injected faults (`injected`, a flag for each class), and all scalars.
    """

    name = "webdataset"
    media_type = "application/x-tar"
    pattern = "*.tar"
    croissant_image: ClassVar = {}  # a reader unpacks no set of archives
    part_bytes = 2**28

    def layers(self, spec: StoreSpec) -> Collection[str]:
        """Return images, masks and truth."""
        wanted = ("image", "clean", "mask", *_PLAIN, *_ARRAYS)
        return [name for name in wanted if name in spec.pixel_layers]

    def write_part(self, store: Store, part: ExportPart, samples: Iterable[Sample], folder: Folder) -> list[Entry]:
        """Write one tar file."""
        name = f"{part.split}-{part.of_split:06d}.tar"
        entries: list[Entry] = []

        def write(path: Path) -> None:
            with tarfile.open(path, "w", format=tarfile.USTAR_FORMAT) as tar:
                for sample in samples:
                    key = number_text(sample.index, store.samples)
                    for ending, content in _members(store, sample):
                        # owner and time are left at 0, so that equal samples make equal files
                        member = tarfile.TarInfo(f"{key}.{ending}")
                        member.size = len(content)
                        tar.addfile(member, io.BytesIO(content))
                    entries.append(Entry(sample.index, name))

        folder.put_with(name, write)
        return entries


def _members(store: Store, sample: Sample) -> Iterator[tuple[str, bytes]]:
    """Yield the ending and the content of each file of a sample."""
    for name, part, content in png_files(store.spec, sample):
        if part != "intensity":
            yield f"{name}.{part}.png" if part else f"{name}.png", content
        elif name == "image":
            yield "intensity.png", content
    for name in _ARRAYS:
        if name in sample.layers:
            file = io.BytesIO()
            np.save(file, sample.layers[name], allow_pickle=False)
            yield f"{name}.npy", file.getvalue()
    yield "json", json.dumps(_scalars(store, sample), allow_nan=False).encode()


def _scalars(store: Store, sample: Sample) -> dict[str, Any]:
    """Return the scalars of a sample, the faults by name."""
    injected = dict(zip(store.spec.faults, sample.scalars["injected"].tolist(), strict=True))
    parsed = {name: store.table(sample.index, name, sample.scalars[name]) for name in ("parameters", "proposal")}
    scalars = {name: value for name, value in sample.scalars.items() if name not in parsed}
    row: dict[str, Any] = plain(
        {"sample": sample.index, **scalars, **of_distortion(store.spec), "injected": injected, **parsed}
    )
    return row
