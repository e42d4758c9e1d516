"""Export to COCO: PNG images and a JSON file of instances with run-length masks for each split."""

from __future__ import annotations

import json
from collections.abc import Collection, Iterable, Iterator
from functools import partial
from pathlib import Path
from typing import Any, TextIO

from .... import __version__
from ....core.files.images import png
from ....core.quantities import Sample
from ....store import Store, StoreSpec
from ..contract import Closing, Entry, ExportPart, Finished, Format, number_text
from ..regions import Region, coco_text, instances, whole

# regions of one class in one image from which they are written as one crowd region: COCO's own limit of detections
# that are compared is 100, and a reader holds all of them in memory
MOST_INSTANCES = 1000


class Coco(Format):
    """COCO: 8 bit PNG images, and a JSON file of instances with run-length masks for each split.

    - `images/SPLIT/NUMBER.png`: R, G, B of the image, 8 bits a channel. The number is the index of the sample
      in the store, and the image's `id`.
    - `annotations/instances_SPLIT.json`: read it with `pycocotools.coco.COCO`. `categories` are all classes in
      the order of the table below; `id` is the index there plus 1.
    - The instances are the connected regions (8 neighbours) of `mask`: grains, defects, lines. Grains that
      touch are one region. Where the parameters list flares, each flare and the glare is one instance, in one
      piece or in several. A class that is not localised, such as vignetting, has one instance of its whole mask.
      `area` counts pixels; `bbox` is left, top, width, height in pixels.
    - A class with more than 1000 regions in one image has one annotation of its whole mask there, with
      `iscrowd` 1; all others have `iscrowd` 0. No pixel of a mask is left out, except in instances that are
      smaller than `--min-area`.
    """

    name = "coco"
    pattern = "images/*/*.png"
    has_instances = True

    def layers(self, spec: StoreSpec) -> Collection[str]:
        """Return image and mask."""
        return ("image", "mask")

    def files(self, store: Store, part: ExportPart, sample: Sample) -> tuple[Entry, Iterable[tuple[str, bytes]]]:
        """Return the image of one sample; its annotations are the note of the entry."""
        name = f"images/{part.split}/{number_text(sample.index, store.samples)}.png"
        note = list(annotations_of(store.spec, sample, part.min_area_px))
        return Entry(sample.index, name, note), [(name, png(sample.layers["image"][..., :3]))]

    def finish(self, finished: Finished) -> Closing:
        """Write the JSON file of each split, an entry at a time."""
        counts = {"instances": 0, "crowds": 0}

        def write(split: str, path: Path) -> None:
            with path.open("w", encoding="utf-8") as file:
                _write_split(file, finished, split, counts)

        for split in finished.splits:
            finished.folder.put_with(f"annotations/instances_{split}.json", partial(write, split))
        lines = [f"- {counts['instances']} instances and {counts['crowds']} crowd regions in all.", ""]
        if not counts["crowds"]:
            return Closing(lines=lines)
        many = "1 mask is" if counts["crowds"] == 1 else f"{counts['crowds']} masks are"
        return Closing(
            lines=lines,
            warnings=[f"{many} in more than {MOST_INSTANCES} pieces, and became one crowd region each (iscrowd 1)"],
        )


def annotations_of(spec: StoreSpec, sample: Sample, min_area_px: int = 1) -> Iterator[dict[str, Any]]:
    """Yield the annotations of one sample, without `id` and `image_id`."""
    for k, found in enumerate(instances(spec, sample, min_area_px, whole_frame=True)):
        is_crowd = len(found) > MOST_INSTANCES
        for region in [whole(sample.layers["mask"][k])] if is_crowd else found:
            yield _annotation(region, (spec.height, spec.width), k + 1, is_crowd)


def _annotation(region: Region, shape: tuple[int, ...], category: int, is_crowd: bool) -> dict[str, Any]:
    """Return a region as an annotation of COCO."""
    return {
        "category_id": category,
        "segmentation": {"size": [int(n) for n in shape], "counts": coco_text(region.counts)},
        "area": region.area,
        "bbox": list(region.box),
        "iscrowd": int(is_crowd),
    }


def _write_split(file: TextIO, finished: Finished, split: str, counts: dict[str, int]) -> None:
    """Write the JSON of one split; `counts` are increased by its instances and crowd regions."""
    store, spec = finished.store, finished.store.spec
    attributes = store.attributes
    licence = {"id": 1, "name": str(attributes.get("licence") or "not stated"), "url": ""}
    head = {
        "info": {
            "description": str(attributes.get("description") or attributes.get("title") or ""),
            "version": str(attributes.get("scene_hash", "")),
            "contributor": f"vbnfault {__version__}",
        },
        "licenses": [licence],
        "categories": [{"id": k + 1, "name": f, "supercategory": "fault"} for k, f in enumerate(spec.faults)],
    }
    file.write(json.dumps(head)[:-1] + ', "images": [')
    for k, entry in enumerate(finished.entries(split)):
        image = {
            "id": entry.sample,
            "file_name": Path(entry.file).name,
            "width": spec.width,
            "height": spec.height,
            "license": 1,
        }
        file.write((",\n" if k else "\n") + json.dumps(image))
    file.write('\n], "annotations": [')
    number = 0
    for entry in finished.entries(split):
        for note in entry.note:
            number += 1
            counts["crowds" if note["iscrowd"] else "instances"] += 1
            text = json.dumps({"id": number, "image_id": entry.sample, **note})
            file.write((",\n" if number > 1 else "\n") + text)
    file.write("\n]}\n")
