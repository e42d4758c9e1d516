"""Describe a dataset in Croissant 1.0, as JSON-LD: https://docs.mlcommons.org/croissant/docs/croissant-spec.html."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any

from ..store import SPLITS, Store

# The context that the specification prescribes: prefixes, and the terms that are Croissant's own.
_PREFIXES = {
    "@language": "en",
    "@vocab": "https://schema.org/",
    "sc": "https://schema.org/",
    "cr": "http://mlcommons.org/croissant/",
    "rai": "http://mlcommons.org/croissant/RAI/",
    "dct": "http://purl.org/dc/terms/",
    "conformsTo": "dct:conformsTo",
    "data": {"@id": "cr:data", "@type": "@json"},
    "dataType": {"@id": "cr:dataType", "@type": "@vocab"},
    "examples": {"@id": "cr:examples", "@type": "@json"},
}
_TERMS = (
    "citeAs column equivalentProperty extract field fileProperty fileObject fileSet format includes isLiveDataset "
    "jsonPath key md5 parentField path recordSet references regex repeated replace samplingRate separator source "
    "subField transform"
)
_CONTEXT = {**_PREFIXES, **{term: f"cr:{term}" for term in _TERMS.split()}}
_TEXT, _WHOLE, _NUMBER = "sc:Text", "sc:Integer", "sc:Float"


def store_croissant(store: Store) -> dict[str, Any]:
    """Return the Croissant description of a store: its files, fault classes, splits and arrays."""
    spec = store.spec
    files = [
        {
            "@type": "cr:FileSet",
            "@id": "zarr",
            "name": "zarr",
            "description": "The files of one Zarr v3 group; read the folder with zarr or xarray.",
            "encodingFormat": "application/vnd.zarr",
            "includes": "**/c/**",
        }
    ]
    arrays = [
        {"name": n, "dimensions": " ".join(a.dims), "dtype": a.dtype, "units": a.units, "meaning": a.long_name}
        for n, a in spec.arrays.items()
    ]
    return croissant(store, files, [inline("arrays", "Arrays of the Zarr group", arrays)])


def croissant(
    store: Store, files: Sequence[Any], records: Sequence[Any], mask_rules: Sequence[str] | None = None
) -> dict[str, Any]:
    """Return the Croissant description of a store or of one of its exports.

    `files`: the entries of `distribution`. `records`: sets of records besides the fault classes and the splits.
    `mask_rules`: for each class, what its masks in the files hold; default: the store's rules of `mask`.
    """
    attributes, spec = store.attributes, store.spec
    title = str(attributes.get("title") or "untitled")
    rules = spec.mask_rules if mask_rules is None else mask_rules
    classes = [
        {"index": k, "name": fault, "rule": rules[k] if rules else ""} for k, fault in enumerate(spec.faults)
    ]
    shared = [inline("splits", "Splits; no site is in two of them", [{"name": name} for name in SPLITS])]
    if classes:
        shared.append(inline("fault_classes", "Fault classes in the order of the fault axis", classes))
    # Croissant requires a citation, a URL and a version with three numbers. The URL is that of the dataset: the
    # folder of this description, wherever it is copied to.
    return {
        "@context": _CONTEXT,
        "@type": "sc:Dataset",
        "conformsTo": "http://mlcommons.org/croissant/1.0",
        "name": re.sub(r"[^A-Za-z0-9_-]+", "_", title),
        "description": str(attributes.get("description") or f"Fault-injected camera images: {title}"),
        "license": str(attributes.get("licence") or "not stated"),
        "citeAs": str(attributes.get("citation") or f"{title}, made with vbnfault"),
        "url": "./",
        "version": f"{store.root_attributes.get('format_version', 0)}.0.0",
        "keywords": ["camera faults", "vision-based navigation", "comet", "segmentation", *spec.faults],
        "creator": {"@type": "sc:Organization", "name": "vbnfault"},
        "distribution": list(files),
        "recordSet": [*shared, *records],
    }


def inline(name: str, description: str, rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return a Croissant record set whose values the description itself lists."""
    fields = [_field(name, key, key, _type_of(value)) for key, value in rows[0].items()]
    data = [{f"{name}/{key}": value for key, value in row.items()} for row in rows]
    return {**_record_set(name, description, fields), "data": data}


def columns(name: str, description: str, file: str, rows: Mapping[str, tuple[str, Any]]) -> dict[str, Any]:
    """Return a set of records that are the rows of a table in a file.

    `file`: the `@id` of the file object. `rows`: by column, its meaning and an example.
    """
    fields = [
        _field(name, key, meaning, _type_of(example), fileObject={"@id": file}, extract={"column": key})
        for key, (meaning, example) in rows.items()
    ]
    return _record_set(name, description, fields)


def image_records(files: str, image: Mapping[str, Any], sample: Mapping[str, Any]) -> dict[str, Any]:
    """Return a set of records that are the images of a file set, each with the index of its sample.

    `files`: the `@id` of the file set. `image`, `sample`: how a reader finds both in a file (`extract`,
    `transform`).
    """
    of_files = {"fileSet": {"@id": files}}
    fields = [
        _field("images", "sample", "index of the sample in the store", _WHOLE, **of_files, **sample),
        _field("images", "image", "the image", "sc:ImageObject", **of_files, **image),
    ]
    return _record_set("images", "R, G, B of the image of each sample, 8 bits a channel", fields)


def _record_set(name: str, description: str, fields: Sequence[Any]) -> dict[str, Any]:
    """Return a set of records with these fields."""
    return {"@type": "cr:RecordSet", "@id": name, "name": name, "description": description, "field": list(fields)}


def _field(of: str, name: str, description: str, kind: str, **source: Any) -> dict[str, Any]:
    """Return a field of the set of records `of`; `source`: where its values are, unless they are listed."""
    return {
        "@type": "cr:Field",
        "@id": f"{of}/{name}",
        "name": name,
        "description": description,
        "dataType": kind,
        **({"source": source} if source else {}),
    }


def _type_of(value: Any) -> str:
    """Return Croissant's type of a value."""
    return _WHOLE if type(value) is int else _NUMBER if type(value) is float else _TEXT
