"""Export to OpenEXR: radiance by wavelength or the image, with depth, normals and masks as further channels."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from ....core.files.images import write_exr
from ....core.quantities import CHANNELS, Sample
from ....store import Store, StoreSpec
from ..contract import Entry, ExportPart, Format, number_text
from ..folder import Folder

_SKIPPED = ("clean", "mask_any")


class Exr(Format):
    """OpenEXR: one file of named channels for each sample, with image, radiance, depth, normals and masks.

    A file is `SPLIT/NUMBER.exr`; the number is the index of the sample in the store. Its channels, in
    scan-lines from the top, compressed without loss:

    - `R`, `G`, `B`, `I`: the image with faults, linear, DN / 255, half floats; times 255 and rounded they are
      the stored 8 bit values.
    - `radiance.<wavelength>nm`: radiance at the camera without faults and noise, in W m-2 sr-1 nm-1, if the
      store has the layer `radiance`.
    - `depth.Z`: depth along the boresight in m, infinite on the sky. `normal.X`, `normal.Y`, `normal.Z`: in the
      camera's frame (x right, y down, z boresight), 0 on the sky. `semantic`: 0 sky, 1 body, 2 Sun, 3 spacecraft.
    - `flow.X`, `flow.Y`: motion in px to the next frame.
    - `mask.<fault>`: 1 where the mask is set. Any other layer of one number a pixel has its name in the store.
    - `SPLIT/NUMBER_scene_radiance.exr`: the layer `scene_radiance`, if the store has it, in channels
      `radiance.<wavelength>nm`. It may be larger than the image, which lies in its middle.
    - `point_T_m.X`, `.Y`, `.Z` are rounded to 32 bits. `clean`, `mask_any` and `without_<fault>` are left out: the
      format `png` has them.
    """

    name = "exr"
    media_type = "image/x-exr"
    croissant_image: ClassVar = {}  # a reader decodes no OpenEXR
    pattern = "*/*.exr"

    def layers(self, spec: StoreSpec) -> Collection[str]:
        """Return the image, the masks and every layer of numbers."""
        return [
            name
            for name, row in spec.pixel_layers.items()
            if name not in _SKIPPED
            and not name.startswith("without_")
            and row.dims[-1] in ("x", "x_rendered", "xyz", "xy", "channel")
        ]

    def write_part(self, store: Store, part: ExportPart, samples: Iterable[Sample], folder: Folder) -> list[Entry]:
        """Write a file for each sample, and another for its render, which may be larger than the image."""
        entries = []
        for sample in samples:
            stem, layers = f"{part.split}/{number_text(sample.index, store.samples)}", dict(sample.layers)
            rendered = {name: layers.pop(name) for name in ("scene_radiance",) if name in layers}
            for name, of_file in ((stem, layers), (f"{stem}_scene_radiance", rendered)):
                if of_file:
                    folder.put_with(f"{name}.exr", partial(_write, store.spec, of_file))
            entries.append(Entry(sample.index, f"{stem}.exr"))
        return entries


def _write(spec: StoreSpec, layers: Mapping[str, NDArray[Any]], path: Path) -> None:
    """Write a file of layers."""
    channels: dict[str, NDArray[Any]] = {}
    for name, layer in layers.items():
        channels |= _channels(spec, name, layer)
    write_exr(path, channels)


def _channels(spec: StoreSpec, name: str, layer: NDArray[Any]) -> dict[str, NDArray[Any]]:
    """Return the channels of one layer by name, as float16, float32 or uint32."""
    if name == "image":
        scaled = (layer / np.float32(255)).astype(np.float16)
        return {channel: np.ascontiguousarray(scaled[..., k]) for k, channel in enumerate(CHANNELS)}
    if name in ("radiance", "scene_radiance"):
        return {f"radiance.{w:.1f}nm": band for w, band in zip(spec.wavelength_nm, layer, strict=True)}
    if name in ("mask", "mask_effect"):
        return {f"{name}.{f}": mask.astype(np.float16) for f, mask in zip(spec.faults, layer, strict=True)}
    if layer.ndim == 3:
        kind = np.float16 if layer.dtype == np.float16 else np.float32
        return {
            f"{name}.{axis}": np.ascontiguousarray(layer[..., k], kind)
            for k, axis in enumerate("XYZ"[: layer.shape[2]])
        }
    if layer.dtype.kind == "u":
        return {name: layer.astype(np.uint32)}
    number = layer.astype(np.float32) if layer.dtype.itemsize > 4 else layer
    return {"depth.Z" if name == "depth_m" else name: np.ascontiguousarray(number)}
