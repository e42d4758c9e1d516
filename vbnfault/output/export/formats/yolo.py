"""Export to YOLO: PNG images, outlines and boxes as text, and `data.yaml`."""

from __future__ import annotations

from collections.abc import Collection, Iterable

import numpy as np

from ....core.files.images import png
from ....core.quantities import Sample
from ....store import SPLITS, Store, StoreSpec
from ..contract import Closing, Entry, ExportPart, Finished, Format, number_text
from ..regions import Region, instances, polygon


class Yolo(Format):
    """YOLO: 8 bit PNG images, outlines and boxes of the instances as text, and data.yaml.

    - `data.yaml`: the splits and the names of all classes, in the order of the table below.
    - `images/SPLIT/NUMBER.png`: R, G, B of the image, 8 bits a channel. The number is the index of the sample.
    - `labels/SPLIT/NUMBER.txt`: one outline a line, `class x1 y1 x2 y2 ...`, as fractions of width and height.
      Ultralytics trains segmentation with them, and detection with the boxes around them.
    - `boxes/SPLIT/NUMBER.txt`: the same instances as exact boxes, `class x_centre y_centre width height`, for
      programs that read boxes only; rename the folder to `labels` for them.
    - The instances are the connected regions (8 neighbours) of `mask` of the localised classes; where the
      parameters list flares, each flare and the glare is one. An outline runs through the centres of the pixels
      at the edge, along a line to each hole and further piece, round it and back (100 edges at most). A class that
      is not localised, such as vignetting, has no instances here; `samples.jsonl` says which samples have it.
    """

    name = "yolo"
    pattern = "images/*/*.png"

    has_instances = True

    def layers(self, spec: StoreSpec) -> Collection[str]:
        """Return image and mask."""
        return ("image", "mask")

    def files(self, store: Store, part: ExportPart, sample: Sample) -> tuple[Entry, Iterable[tuple[str, bytes]]]:
        """Return image, outlines and boxes of one sample."""
        spec, name = store.spec, f"{part.split}/{number_text(sample.index, store.samples)}"
        found = [(k, r) for k, of_class in enumerate(instances(spec, sample, part.min_area_px)) for r in of_class]
        outlines = "".join(_outline_line(k, region, spec) for k, region in found)
        boxes = "".join(_box_line(k, region, spec) for k, region in found)
        image = f"images/{name}.png"
        return Entry(sample.index, image), [
            (image, png(sample.layers["image"][..., :3])),
            (f"labels/{name}.txt", outlines.encode()),
            (f"boxes/{name}.txt", boxes.encode()),
        ]

    def finish(self, finished: Finished) -> Closing:
        """Write `data.yaml`."""
        used = [name for name in SPLITS if name in finished.splits]
        # Ultralytics asks for both; a small store may lack one of them
        paths = {"train": "train", "val": "val", **{name: name for name in used}}
        fallback = used[0] if used else "train"
        # without a key `path`, paths start from the folder of this file
        lines = [f"{key}: images/{name if name in used else fallback}" for key, name in paths.items()]
        lines += ["names:", *(f"  {k}: {name}" for k, name in enumerate(finished.store.spec.faults))]
        finished.folder.put([("data.yaml", ("\n".join(lines) + "\n").encode())])
        lacking = [name for name in paths if name not in used]
        return Closing(
            warnings=[
                f"the store has no samples in the split {name}; in data.yaml, {name} names those of {fallback}"
                for name in lacking
            ]
        )


def _outline_line(category: int, region: Region, spec: StoreSpec) -> str:
    """Return the line of a region's outline."""
    points = polygon(region) / (spec.width, spec.height)
    # nine digits, so that a whole number of pixels read back as float32 lies in the same pixel
    return f"{category} {' '.join(f'{v:.9f}' for v in np.ravel(points))}\n"


def _box_line(category: int, region: Region, spec: StoreSpec) -> str:
    """Return the line of a region's box."""
    x, y, width, height = region.box
    box = ((x + width / 2) / spec.width, (y + height / 2) / spec.height, width / spec.width, height / spec.height)
    return f"{category} {' '.join(f'{v:.6f}' for v in box)}\n"
