"""Export to Parquet files with the features of Hugging Face `datasets`, for local use or for its hub."""

from __future__ import annotations

import json
from collections.abc import Collection, Iterable
from pathlib import Path
from typing import Any, ClassVar

from ....core.quantities import Sample
from ....store import STRATA, Store, StoreSpec
from ..contract import Closing, Entry, ExportPart, Finished, Format, mask_png, number_text, png
from ..folder import Folder

_IMAGE = {"_type": "Image"}
_TEXT = {"dtype": "string", "_type": "Value"}
_NUMBER = {"dtype": "float64", "_type": "Value"}
_NUMBERS = ("exposure_s", "sun_azimuth_deg", "sun_elevation_deg", "sun_distance_au", "sun_visible_fraction")
_VECTORS = ("camera_position_T_m", "camera_from_T", "sun_direction_T", "intrinsics")
_ROWS_IN_MEMORY = 8


class HuggingFace(Format):
    """Hugging Face: Parquet files with images, masks, labels and pose as typed columns.

    - `data/SPLIT-*.parquet`: `datasets.load_dataset("PATH_OF_THIS_FOLDER")` gives all splits; the head of this
      card names the files of each.
    - `image`, `clean`: R, G, B, 8 bits a channel; `intensity`: the intensity channel. `mask_<fault>` for every
      class, and `mask_any`: 8 bits, 255 where the mask is set.
    - `faults`: the classes in the pixels, as labels of a `ClassLabel` in the order of the table below.
      `parameters`: every drawn parameter, as JSON. Pose, Sun and exposure are columns of numbers.
    """

    name = "huggingface"
    media_type = "application/x-parquet"
    pattern = "data/*.parquet"
    croissant_image: ClassVar = {"extract": {"column": "image"}, "transform": {"jsonPath": "bytes"}}
    croissant_sample: ClassVar = {"extract": {"column": "sample"}}
    part_bytes = 2**28

    def layers(self, spec: StoreSpec) -> Collection[str]:
        """Return images and masks."""
        return ("image", "clean", "mask", "mask_any")

    def write_part(self, store: Store, part: ExportPart, samples: Iterable[Sample], folder: Folder) -> list[Entry]:
        """Write one Parquet file, a few rows at a time."""
        import pyarrow
        import pyarrow.parquet

        features = _features(store.spec)
        info = json.dumps({"info": {"features": features}})
        schema = pyarrow.schema(
            [(name, _arrow_type(feature)) for name, feature in features.items()], metadata={"huggingface": info}
        )
        name = f"data/{part.split}-{part.of_split:05d}-of-{part.parts_of_split:05d}.parquet"
        entries: list[Entry] = []

        def write(path: Path) -> None:
            with pyarrow.parquet.ParquetWriter(path, schema, compression="none") as writer:  # PNGs do not shrink
                rows: list[dict[str, Any]] = []
                for sample in samples:
                    rows.append(_row(store, sample))
                    entries.append(Entry(sample.index, name))
                    if len(rows) == _ROWS_IN_MEMORY:
                        writer.write_table(pyarrow.Table.from_pylist(rows, schema=schema))
                        rows = []
                if rows:
                    writer.write_table(pyarrow.Table.from_pylist(rows, schema=schema))

        folder.put_with(name, write)
        return entries

    def finish(self, finished: Finished) -> Closing:
        """Return the head of the card, which the hub and `load_dataset` read."""
        licence = str(finished.store.attributes.get("licence") or "unknown").lower()
        files = [
            line
            for split in finished.splits
            for line in (f"  - split: {split}", f"    path: data/{split}-*.parquet")
        ]
        return Closing(
            front=[
                f"license: {json.dumps(licence)}",
                f"pretty_name: {json.dumps(str(finished.store.attributes.get('title') or 'untitled'))}",
                "task_categories:",
                "- image-segmentation",
                "- image-classification",
                "tags:",
                "- synthetic",
                "- camera-faults",
                "- space",
                "configs:",
                "- config_name: default",
                "  data_files:",
                *files,
            ]
        )


def _features(spec: StoreSpec) -> dict[str, Any]:
    """Return the features of the columns as `datasets` writes them."""
    labels = {"names": [*spec.faults], "_type": "ClassLabel"}
    return {
        "image": _IMAGE,
        "intensity": _IMAGE,
        "clean": _IMAGE,
        **{f"mask_{fault}": _IMAGE for fault in spec.faults},
        "mask_any": _IMAGE,
        "faults": {"feature": labels, "_type": "Sequence"},
        "sample": {"dtype": "int64", "_type": "Value"},
        "site": {"dtype": "int64", "_type": "Value"},
        "stratum": _TEXT,
        **dict.fromkeys(_NUMBERS, _NUMBER),
        **{name: {"feature": _NUMBER, "_type": "Sequence"} for name in _VECTORS},
        "parameters": _TEXT,
    }


def _arrow_type(feature: dict[str, Any]) -> Any:
    """Return the Arrow type of a feature."""
    import pyarrow

    kind = feature["_type"]
    if kind == "Image":
        return pyarrow.struct([("bytes", pyarrow.binary()), ("path", pyarrow.string())])
    if kind == "Sequence":
        return pyarrow.list_(_arrow_type(feature["feature"]))
    types = {"string": pyarrow.string(), "float64": pyarrow.float64(), "int64": pyarrow.int64()}
    return types[feature.get("dtype", "int64")]  # a ClassLabel is an int64


def _row(store: Store, sample: Sample) -> dict[str, Any]:
    """Return the columns of one sample."""
    layers, scalars = sample.layers, sample.scalars
    number = number_text(sample.index, store.samples)
    images = {
        "image": png(layers["image"][..., :3]),
        "intensity": png(layers["image"][..., 3]),
        "clean": png(layers["clean"][..., :3]),
        **{f"mask_{f}": mask_png(m) for f, m in zip(store.spec.faults, layers["mask"], strict=True)},
        "mask_any": mask_png(layers["mask_any"]),
    }
    return {
        **{name: {"bytes": data, "path": f"{number}_{name}.png"} for name, data in images.items()},
        "faults": [k for k, on in enumerate(scalars["injected"].tolist()) if on],
        "sample": sample.index,
        "site": int(scalars["site"]),
        "stratum": STRATA[int(scalars["stratum"])],
        **{name: float(scalars[name]) for name in _NUMBERS},
        **{name: scalars[name].tolist() for name in _VECTORS},
        "parameters": scalars["parameters"],
    }
