"""Export to folders of PNG files: one folder for each split and each layer."""

from __future__ import annotations

from collections.abc import Collection, Iterable

from ....core.quantities import Sample
from ....store import Store, StoreSpec
from ..contract import Entry, ExportPart, Format, number_text, png_files

_MASKS = ("mask", "mask_effect")
_PLAIN = ("mask_any", "semantic", "raw", "defects")


class PngFolders(Format):
    """PNG files of 8 bits, and of 16 bits for the raw mosaic, in a folder for each split and layer.

    A file is `SPLIT/LAYER/NUMBER.png`; the number is the index of the sample in the store.

    - `image`, `clean` and `without_<fault>`: R, G, B of the image, 8 bits a channel, in DN. `image_intensity`
      and the like: its intensity channel, 8 bits.
    - `mask/<fault>`, `mask_effect/<fault>`, `mask_any`: 8 bits, 255 where the mask is set and 0 elsewhere.
    - `semantic`: 8 bits; 0 sky, 1 body, 2 Sun, 3 spacecraft.
    - `raw`: the mosaic of the analogue-to-digital converter, 16 bits, in DN and not scaled.
    - `defects`: 8 bits, a sum of 1 hot, 2 dead, 4 stuck, 8 RTS, 16 RTS with a high level, 32 trap.
    - A layer that the store lacks has no folder. Depth, normals and radiance are floating-point numbers: export
      them as `exr`.
    """

    name = "png"
    pattern = "*/image/*.png"

    def layers(self, spec: StoreSpec) -> Collection[str]:
        """Return the layers of whole numbers and the masks."""
        return [
            name
            for name, row in spec.pixel_layers.items()
            if name in (*_MASKS, *_PLAIN) or (row.dtype == "uint8" and row.dims[-1] == "channel")
        ]

    def files(self, store: Store, part: ExportPart, sample: Sample) -> tuple[Entry, Iterable[tuple[str, bytes]]]:
        """Return the files of one sample."""
        number = number_text(sample.index, store.samples)
        files = (
            (f"{part.split}/{_folder(name, of)}/{number}.png", content)
            for name, of, content in png_files(store.spec, sample)
        )
        return Entry(sample.index, f"{part.split}/image/{number}.png"), files


def _folder(name: str, part: str) -> str:
    """Return the folder of a part of a layer."""
    return f"{name}_{part}" if part == "intensity" else f"{name}/{part}" if part else name
