"""Export to Parquet files with the features of Hugging Face `datasets`, for local use or for its hub."""

from __future__ import annotations

import json
from collections.abc import Collection, Iterable
from pathlib import Path
from typing import Any, ClassVar

from ....core.quantities import Sample
from ....store import STRATA, Store, StoreSpec
from ..contract import Closing, Entry, ExportPart, Finished, Format, number_text, of_distortion, png_files
from ..folder import Folder

_OF_SUN = ("sun_azimuth_deg", "sun_elevation_deg", "sun_distance_au", "sun_visible_fraction")
_NUMBERS = ("exposure_s", *_OF_SUN, "julian_date")
_OF_SEQUENCES: dict[str, type] = {"sequence": int, "frame": int, "time_s": float}
_VECTORS = ("camera_position_T_m", "camera_from_T", "sun_direction_T", "intrinsics", "distortion")
_ROWS_IN_MEMORY = 8


class HuggingFace(Format):
    """Parquet files for Hugging Face, with images, masks, labels and pose as typed columns.

    - `data/SPLIT-*.parquet`: `datasets.load_dataset("PATH_OF_THIS_FOLDER")` gives all splits; the head of this
      card names the files of each.
    - `image`, `clean`: R, G, B, 8 bits a channel; `intensity`: the intensity channel. `mask_<fault>` for every
      class, and `mask_any`: 8 bits, 255 where the mask is set.
    - `faults`: the classes in the pixels, as labels of a `ClassLabel` in the order of the table below.
      `parameters`: every drawn parameter, as JSON. Pose, Sun, date and exposure are columns of numbers, and in
      a store with sequences also `sequence` (its index), `frame` and `time_s`.
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

        columns = _columns(store.spec)
        info = json.dumps({"info": {"features": {name: feature for name, (_, feature) in columns.items()}}})
        types = [(name, kind) for name, (kind, _) in columns.items()]
        schema = pyarrow.schema(types, metadata={"huggingface": info})
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


def _columns(spec: StoreSpec) -> dict[str, tuple[Any, dict[str, Any]]]:
    """Return of each column the type in Arrow, and the feature as `datasets` writes it."""
    import pyarrow as pa

    def value(kind: Any) -> tuple[Any, dict[str, Any]]:
        return kind, {"dtype": "float64" if kind == pa.float64() else str(kind), "_type": "Value"}

    def sequence(kind: Any, feature: dict[str, Any]) -> tuple[Any, dict[str, Any]]:
        return pa.list_(kind), {"feature": feature, "_type": "Sequence"}

    image = pa.struct([("bytes", pa.binary()), ("path", pa.string())]), {"_type": "Image"}
    return {
        **dict.fromkeys(("image", "intensity", "clean", *(f"mask_{f}" for f in spec.faults), "mask_any"), image),
        "faults": sequence(pa.int64(), {"names": [*spec.faults], "_type": "ClassLabel"}),
        **dict.fromkeys(("sample", "site"), value(pa.int64())),
        "stratum": value(pa.string()),
        **dict.fromkeys(_NUMBERS, value(pa.float64())),
        **{
            name: value(pa.int64() if kind is int else pa.float64())
            for name, kind in _OF_SEQUENCES.items()
            if name in spec.scalars
        },
        **dict.fromkeys(_VECTORS, sequence(*value(pa.float64()))),
        "distortion_model": value(pa.string()),
        "skew_px": value(pa.float64()),
        "parameters": value(pa.string()),
    }


def _row(store: Store, sample: Sample) -> dict[str, Any]:
    """Return the columns of one sample."""
    scalars, number = sample.scalars, number_text(sample.index, store.samples)
    images = {
        part if (name, part) == ("image", "intensity") else f"{name}_{part}" if part else name: content
        for name, part, content in png_files(store.spec, sample)
        if (name, part) != ("clean", "intensity")
    }
    return {
        **{name: {"bytes": data, "path": f"{number}_{name}.png"} for name, data in images.items()},
        "faults": [k for k, on in enumerate(scalars["injected"].tolist()) if on],
        "sample": sample.index,
        "site": int(scalars["site"]),
        "stratum": STRATA[int(scalars["stratum"])],
        **{name: float(scalars[name]) for name in _NUMBERS},
        **{name: kind(scalars[name]) for name, kind in _OF_SEQUENCES.items() if name in scalars},
        **{name: scalars[name].tolist() for name in _VECTORS},
        **of_distortion(store.spec),
        "parameters": scalars["parameters"],
    }
