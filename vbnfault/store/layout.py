"""Make the metadata of a store as JSON documents, and the values of its coordinates as chunk files.

Everything follows from the schema alone, so every key of every `zarr.json` can be checked and repaired. The
documents follow the Zarr v3 specification and equal those that zarr 3.1 writes. This module reads and writes no
file.

The root attributes hold `attributes_sha256`, a checksum over all other attributes. The group `spare` holds a copy
of them, for reading a store whose root is damaged. The consolidated metadata do not list `spare`, because it holds
no data.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from numcodecs import VLenUTF8
from numpy.typing import NDArray

from .arrays import Member
from .attributes import check_names, number_of_samples
from .compressors import ZSTD, compressor
from .schema import FORMAT_VERSION, StoreSpec

DOCUMENT = "zarr.json"
SPARE = "spare"
CHECKSUM = "attributes_sha256"
# root attributes that the store needs for itself; all others are the user's
OWN_ATTRIBUTES = ("store", "samples", "coordinates", CHECKSUM)

_BRACKETS, _DEEPEST = re.compile(r'"[^"\\]*+(?:\\.[^"\\]*+)*+"|[][{}]'), 64
_LITTLE_ENDIAN = {"name": "bytes", "configuration": {"endian": "little"}}


def canonical(value: Any) -> str:
    """Return JSON text without spaces and with sorted keys, to compare values: 1, 1.0 and true differ."""
    return json.dumps(value, sort_keys=True, separators=(",", ":"))


def to_bytes(document: Mapping[str, Any]) -> bytes:
    """Return a document as the bytes of its file."""
    return json.dumps(document, indent=2).encode()


def sealed(attributes: Mapping[str, Any]) -> dict[str, Any]:
    """Return root attributes together with the checksum over them."""
    plain = {key: value for key, value in attributes.items() if key != CHECKSUM}
    return {**plain, CHECKSUM: hashlib.sha256(canonical(plain).encode()).hexdigest()}


def is_sealed(attributes: Mapping[str, Any]) -> bool:
    """Return whether root attributes match the checksum that they hold."""
    return attributes.get(CHECKSUM) == sealed(attributes)[CHECKSUM]


def root_attributes(spec: StoreSpec, samples: int) -> dict[str, Any]:
    """Return the root attributes of a store of `samples` samples, with their checksum. Raises InputError."""
    check_names(spec, number_of_samples({"samples": samples}))
    return sealed(
        {
            **json.loads(json.dumps(spec.attributes)),
            "format": "vbnfault",
            "format_version": FORMAT_VERSION,
            "store": json.loads(json.dumps(spec.plain())),
            "samples": samples,
            "coordinates": spec.extra_coordinates,
        }
    )


def array_documents(members: Mapping[str, Member]) -> dict[str, dict[str, Any]]:
    """Return the content of each array's `zarr.json`, by array name."""
    return {name: _array_document(member) for name, member in members.items()}


def _array_document(member: Member) -> dict[str, Any]:
    """Return the content of one array's `zarr.json`."""
    is_text = member.dtype == "str"
    wide = not is_text and np.dtype(member.dtype).itemsize > 1
    values = (
        {"name": "vlen-utf8", "configuration": {}} if is_text else _LITTLE_ENDIAN if wide else {"name": "bytes"}
    )
    codecs: list[dict[str, Any]] = [values, *compressor(member.codec).documents]
    if member.shards is not None:
        sharding = {
            "chunk_shape": list(member.chunks),
            "codecs": codecs,
            "index_codecs": [_LITTLE_ENDIAN, {"name": "crc32c"}],
            "index_location": "end",
        }
        codecs = [{"name": "sharding_indexed", "configuration": sharding}]
    document = {
        "shape": list(member.shape),
        "data_type": "string" if is_text else member.dtype,
        "chunk_grid": {"name": "regular", "configuration": {"chunk_shape": list(member.shards or member.chunks)}},
        "chunk_key_encoding": {"name": "default", "configuration": {"separator": "/"}},
        "fill_value": _fill_value(member),
        "codecs": codecs,
        "attributes": json.loads(json.dumps(member.attributes)),
        "dimension_names": list(member.dims),
        "zarr_format": 3,
        "node_type": "array",
        "storage_transformers": [],
    }
    return json.loads(json.dumps(document))  # a deep copy: documents must not share parts


def _fill_value(member: Member) -> Any:
    """Return an array's fill value as Zarr writes it in JSON."""
    if member.dtype == "str":
        return str(member.fill)
    plain = np.dtype(member.dtype).type(member.fill).item()
    return "NaN" if plain != plain else plain


def group_document(
    attributes: Mapping[str, Any], arrays: Mapping[str, Mapping[str, Any]] | None = None
) -> dict[str, Any]:
    """Return the content of a group's `zarr.json`.

    `arrays`, given for the root only, become the consolidated metadata, which zarr and xarray read first.
    """
    document: dict[str, Any] = {"attributes": dict(attributes), "zarr_format": 3}
    if arrays is not None:
        metadata = {name: arrays[name] for name in sorted(arrays)}
        document["consolidated_metadata"] = {"kind": "inline", "must_understand": False, "metadata": metadata}
    return {**document, "node_type": "group"}


def check_depth(content: str) -> None:
    """Raise ValueError if JSON is nested deeper than what vbnfault writes, so that no function recurses too far."""
    depth = 0
    for part in _BRACKETS.finditer(content):
        depth += part[0] in "[{"
        depth -= part[0] in "]}"
        if depth > _DEEPEST:
            raise ValueError("it is nested too deep")


def drawn_table(text: object) -> dict[str, Any]:
    """Return the table that the scalar `parameters` or `proposal` of a sample holds as JSON.

    Raises ValueError if it is none, or is nested deeper than what vbnfault writes.
    """
    content = str(text or "{}")
    check_depth(content)
    # no float holds a whole number of more digits, and no array
    table = json.loads(content, parse_int=lambda digits: int(digits) if len(digits) < 25 else float(digits))
    if not isinstance(table, dict):
        raise ValueError("no table in JSON")
    return table


def event_of(drawn: Mapping[str, Any], fault: str) -> Mapping[str, Any]:
    """Return what the parameters of a sample say of the event that brings a fault; {} for nothing."""
    parameters = drawn.get(fault)
    event = parameters.get("event") if isinstance(parameters, Mapping) else None
    return event if isinstance(event, Mapping) else {}


def coordinate_chunks(member: Member) -> Iterator[tuple[str, NDArray[Any]]]:
    """Yield the file name, relative to the array's folder, and the values of each chunk of a coordinate."""
    if member.values is None or not len(member.values):
        return
    (size,) = member.chunks
    is_text = member.dtype == "str"
    for number, start in enumerate(range(0, len(member.values), size)):
        part = member.values[start : start + size]
        values = np.full(size, member.fill, dtype=object if is_text else member.dtype)
        values[: len(part)] = part
        yield f"c/{number}", values


def encode_values(values: NDArray[Any]) -> bytes:
    """Return numbers or texts (dtype object) as the bytes of a chunk file."""
    return compressor(ZSTD).encode(plain_values(values))


def plain_values(values: NDArray[Any]) -> Any:
    """Return what the chunk file of values holds compressed."""
    return VLenUTF8().encode(values) if values.dtype == object else values


def decode_values(data: bytes, dtype: str, most_bytes: int) -> NDArray[Any]:
    """Return the values of a chunk file, of at most so many bytes, as a flat array.

    Raises ValueError if the file is damaged.
    """
    plain = compressor(ZSTD).decode(data, most_bytes)
    if dtype != "str":
        return np.frombuffer(plain, dtype=dtype)
    try:
        return np.asarray(VLenUTF8().decode(plain))
    except Exception as error:  # the codec raises many types for impossible lengths
        raise ValueError(str(error)) from error
