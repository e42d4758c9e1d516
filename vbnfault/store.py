"""The dataset: one Zarr v3 group. Its schema, and how it is created, written, opened, verified.

The only importer of zarr. How a store survives what happens to it:

- Chunk files are encoded here, not by zarr, which would drop a chunk of zeros (an absent one reads as zeros
  too) and recompress the neighbours of a sample that is built again. Reads go through zarr, as a user's do.
- Every file is written beside its place and renamed into it, so it is either the old or the new one.
  `create` builds the whole group that way. A kill leaves `*.partial` files, which `recover` removes.
- A per-pixel layer is sharded: a chunk is one sample, a file holds `shard_samples` of them. One task owns a
  shard. Whoever rewrites it copies the compressed chunks of the samples it does not rebuild, untouched.
- `crc32c` holds a checksum of every layer and of all scalars of a sample, over decoded bytes; a chunk carries
  Zstd's own checksum besides. `done` is written last. So a lost power supply or a bad disk is found, and
  exactly the samples concerned are rebuilt.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import shutil
import struct
import uuid
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import google_crc32c
import numpy as np
import zarr
from numcodecs import VLenUTF8, Zstd
from numpy.typing import NDArray
from zarr.codecs import ZstdCodec

from .errors import InputError, VbnfaultError
from .quantities import CHANNELS, Sample

FORMAT_VERSION = 1
SPLITS = ("train", "val", "test")
STRATA = ("sun-facing", "sun-averted")
SEMANTIC = ("sky", "body", "sun", "spacecraft")

# Root attributes that say when or how a store was written, not what it holds: no part of the digest.
VOLATILE_ATTRIBUTES = ("created", "modified", "command")

MAX_SHARD_SAMPLES = 16
MAX_SHARD_BYTES = 2**30
MAX_HELD_BYTES = 2**31  # all layers of a shard, uncompressed: what a task may have to hold

# Level 1: 16 ms for a noisy 1024 px RGBI image; level 3 takes three times as long and saves a sixth.
_ZSTD_LEVEL = 1
_SCALARS = "scalars"  # the entry of the `layer` axis that stands for all scalars of a sample
_ABSENT = 2**64 - 1  # how a shard's index says that it has no such chunk


@dataclass(frozen=True)
class Array:
    """One row of the schema. `ratio`: a typical compressed size over the uncompressed one."""

    dimensions: str
    dtype: str
    units: str
    long_name: str
    names: tuple[str, ...] = ()  # CF flag meanings
    ratio: float = 1.0

    @property
    def dims(self) -> tuple[str, ...]:
        return tuple(self.dimensions.split())

    @property
    def is_text(self) -> bool:
        return self.dtype == "str"

    @property
    def fill(self) -> Any:
        """What an unwritten sample reads as."""
        return "" if self.is_text else float("nan") if self.dtype == "float64" else 0


_IMAGE = "sample y x channel"

# The schema. Per-pixel layers: one chunk a sample, sharded.
LAYERS: dict[str, Array] = {
    "image": Array(_IMAGE, "uint8", "DN", "image with faults", ratio=0.45),
    "mask": Array("sample fault y x", "bool", "1", "footprint of each fault", ratio=0.005),
    "mask_any": Array("sample y x", "bool", "1", "union over the faults named here", ratio=0.005),
    "clean": Array(_IMAGE, "uint8", "DN", "same camera, exposure and noise, no fault", ratio=0.45),
    # optional from here on; `without_<fault>` follows the pattern of the straylight one
    "mask_effect": Array("sample fault y x", "bool", "1", "noise-free change of 1 DN or more", ratio=0.02),
    "raw": Array("sample y x", "uint16", "DN", "raw mosaic of the analogue-to-digital converter", ratio=0.6),
    "depth_m": Array("sample y x", "float32", "m", "depth along the boresight, inf on the sky", ratio=0.5),
    "normal": Array("sample y x xyz", "float16", "1", "surface normal in C, 0 on the sky", ratio=0.55),
    "semantic": Array("sample y x", "uint8", "1", "what a pixel shows", SEMANTIC, ratio=0.01),
    "radiance": Array("sample band y x", "float16", "W m-2 sr-1 nm-1", "radiance at the camera", ratio=0.7),
}
REQUIRED_LAYERS = ("image", "mask", "mask_any", "clean")

# Scalars and small vectors: a chunk is a shard, so that a task writes whole chunks.
SCALARS: dict[str, Array] = {
    "injected": Array("sample fault", "bool", "1", "faults that are in the pixels"),
    "camera_position_T_m": Array("sample xyz", "float64", "m", "camera position in T"),
    "position_L_m": Array("sample xyz", "float64", "m", "camera position in L, from the site"),
    "camera_from_T": Array("sample quaternion", "float64", "1", "attitude, unit quaternion"),
    "T_from_L": Array("sample axis_row axis_col", "float64", "1", "rotation from the local level frame to T"),
    "T_from_J": Array("sample axis_row axis_col", "float64", "1", "rotation from the inertial frame J to T"),
    "site_T_m": Array("sample xyz", "float64", "m", "site, the origin of L, in T"),
    "sun_direction_T": Array("sample xyz", "float64", "1", "unit vector towards the Sun in T"),
    "sun_distance_au": Array("sample", "float64", "au", "distance to the Sun"),
    "julian_date": Array("sample", "float64", "d", "Julian date (TDB)"),
    "intrinsics": Array("sample intrinsic", "float64", "px", "pinhole camera, pixel centres at +0.5"),
    "sun_azimuth_deg": Array("sample", "float64", "deg", "Sun azimuth in L, from north towards east"),
    "sun_elevation_deg": Array("sample", "float64", "deg", "Sun elevation in L, up"),
    "roll_deg": Array("sample", "float64", "deg", "tilt of the boresight from the Sun about x"),
    "pitch_deg": Array("sample", "float64", "deg", "tilt of the boresight from the Sun about y"),
    "yaw_deg": Array("sample", "float64", "deg", "turn about the boresight"),
    "sun_xy_px": Array("sample xy", "float64", "px", "Sun centre in the image, NaN behind the camera"),
    "sun_visible_fraction": Array("sample", "float64", "1", "part of the solar disc that is not occluded"),
    "exposure_s": Array("sample", "float64", "s", "exposure time"),
    "tries": Array("sample", "int32", "1", "proposals drawn until one could be used"),
    "stratum": Array("sample", "uint8", "1", "stratum of the sampling", STRATA),
    "site": Array("sample", "int32", "1", "index of the site"),
    "lens": Array("sample", "int32", "1", "index of the lens"),
    "detector_individual": Array("sample", "int32", "1", "index of the individual detector"),
    "split": Array("sample", "uint8", "1", "split of the dataset, constant per site", SPLITS),
    "parameters": Array("sample", "str", "1", "drawn parameters of every injected fault, JSON"),
    "proposal": Array("sample", "str", "1", "proposed variables before redraws, JSON"),
}

_LABELS = {  # coordinates of the short axes
    "channel": CHANNELS,
    "xyz": ("x", "y", "z"),
    "axis_row": ("x", "y", "z"),
    "axis_col": ("x", "y", "z"),
    "xy": ("x", "y"),
    "quaternion": ("w", "x", "y", "z"),
    "intrinsic": ("fx", "fy", "cx", "cy"),
}


class Member(NamedTuple):
    """One array of the group as it must be: `create`, `verify` and `recover` go by it.

    `values`: of a coordinate; None for what tasks write. `chunks`, `shards`: of zarr, 1 at least in every axis.
    """

    shape: tuple[int, ...]
    chunks: tuple[int, ...]
    shards: tuple[int, ...] | None
    dtype: str
    fill: Any
    dims: tuple[str, ...]
    attributes: dict[str, Any]
    values: NDArray[Any] | tuple[str, ...] | None = None


def _coordinate(dim: str, values: NDArray[Any] | tuple[str, ...], **attributes: str) -> Member:
    """A row of `StoreSpec.members` for a coordinate of one axis."""
    dtype, fill = (values.dtype.name, 0) if isinstance(values, np.ndarray) else ("str", "")
    chunks = (65536 if dim == "sample" else max(1, len(values)),)
    return Member((len(values),), chunks, None, dtype, fill, (dim,), attributes, values)


@dataclass(frozen=True, kw_only=True)
class StoreSpec:
    """What a store holds, as plain data.

    `faults`: the fault axis in dataset order. `mask_any_faults`: the union that `mask_any` is.
    `localised_faults`: those whose mask is not empty where they are injected (default: `mask_any_faults`).
    `layers`: the optional layers, of `LAYERS` or `without_<fault>`. `shard_samples` 0 chooses the most, up to
    16, that keeps the largest array of a shard within 1 GiB and all of them within 2 GiB; a larger one is
    lowered. `attributes`: JSON-able root attributes. Raises InputError for names that do not exist.
    """

    height: int
    width: int
    faults: tuple[str, ...]
    mask_any_faults: tuple[str, ...]
    wavelength_nm: tuple[float, ...] = ()
    layers: tuple[str, ...] = ()
    localised_faults: tuple[str, ...] | None = None
    site_names: tuple[str, ...] = ()
    lens_names: tuple[str, ...] = ()
    detector_names: tuple[str, ...] = ()
    radiance_dtype: str = "float16"
    shard_samples: int = 0
    attributes: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        allowed = {*LAYERS, *(f"without_{f}" for f in self.faults)}
        for name in self.layers:
            if name not in allowed:
                raise InputError(f"layers: {name!r} is no layer; known: {', '.join(sorted(allowed))}")
        for name in (*self.mask_any_faults, *(self.localised_faults or ())):
            if name not in self.faults:
                known = ", ".join(self.faults) or "no faults"
                raise InputError(f"mask_any_faults: {name!r} is not one of {known}")
        if self.localised_faults is None:
            object.__setattr__(self, "localised_faults", self.mask_any_faults)
        sizes = [self.layer_bytes(name) for name in self.pixel_layers]
        most = max(1, min(MAX_SHARD_SAMPLES, MAX_SHARD_BYTES // max(sizes), MAX_HELD_BYTES // sum(sizes)))
        object.__setattr__(self, "shard_samples", min(self.shard_samples, most) if self.shard_samples > 0 else most)

    @cached_property
    def pixel_layers(self) -> dict[str, Array]:
        """Name → schema row of every per-pixel layer, in the order of the `layer` axis."""
        rows = {name: LAYERS[name] for name in REQUIRED_LAYERS}
        for name in self.layers:
            if name == "radiance":
                rows[name] = replace(LAYERS[name], dtype=self.radiance_dtype)
            elif name in LAYERS:
                rows[name] = LAYERS[name]
            else:
                without = name.removeprefix("without_")
                rows[name] = Array(_IMAGE, "uint8", "DN", f"the image without {without}", ratio=0.45)
        return rows

    @cached_property
    def arrays(self) -> dict[str, Array]:
        """Name → schema row of every array that tasks write."""
        crc32c = Array("sample layer", "uint32", "1", "CRC-32C of the decoded bytes")
        done = Array("sample", "uint8", "1", "1 where a sample is whole; written last")
        return {**self.pixel_layers, **SCALARS, "crc32c": crc32c, "done": done}

    @property
    def checked(self) -> tuple[str, ...]:
        """The `layer` axis of `crc32c`."""
        return (*self.pixel_layers, _SCALARS)

    def shape(self, row: Array) -> tuple[int, ...]:
        """Shape of one sample of an array: its dims without `sample`."""
        sizes = {
            "y": self.height,
            "x": self.width,
            "fault": len(self.faults),
            "band": len(self.wavelength_nm),
            "layer": len(self.checked),
            **{name: len(labels) for name, labels in _LABELS.items()},
        }
        return tuple(sizes[d] for d in row.dims if d != "sample")

    def empty(self, name: str) -> bool:
        """Has an array an axis of no length, as `mask` without fault classes? It has no data files then."""
        return 0 in self.shape(self.arrays[name])

    def members(self, samples: int) -> dict[str, Member]:
        """Name → what it must be, for every array of a group of `samples` samples, coordinates last."""
        extra: dict[str, dict[str, Any]] = {
            "mask_any": {"faults": list(self.mask_any_faults)},
            "site": {"names": list(self.site_names)},
            "lens": {"names": list(self.lens_names)},
            "detector_individual": {"names": list(self.detector_names)},
            "split": {"names": list(SPLITS)},
            "radiance": {"coordinates": "wavelength_nm"},
        }
        size = self.shard_samples
        members = {}
        for name, row in self.arrays.items():
            shape = self.shape(row)
            chunk = tuple(max(1, n) for n in shape)
            sharded = name in self.pixel_layers
            attributes: dict[str, Any] = {"long_name": row.long_name, "units": row.units}
            if row.names:
                attributes["flag_values"] = list(range(len(row.names)))
                attributes["flag_meanings"] = " ".join(row.names)
            members[name] = Member(
                shape=(samples, *shape),
                chunks=(1 if sharded else size, *chunk),
                shards=(size, *chunk) if sharded else None,
                dtype=row.dtype,
                fill=row.fill,
                dims=row.dims,
                attributes={**attributes, **extra.get(name, {})},
            )
        return {**members, **self.coordinates(samples)}

    def coordinates(self, samples: int) -> dict[str, Member]:
        """Name → what it must be, for every coordinate of a group of `samples` samples."""
        y, x = np.arange(self.height) + 0.5, np.arange(self.width) + 0.5
        nodes = np.array(self.wavelength_nm, dtype=np.float64)
        bands = {"wavelength_nm": _coordinate("band", nodes, units="nm", long_name="wavelength of the band")}
        return {
            "y": _coordinate("y", y, units="px", long_name="row, pixel centres at +0.5"),
            "x": _coordinate("x", x, units="px", long_name="column, pixel centres at +0.5"),
            "fault": _coordinate("fault", self.faults, long_name="fault class"),
            "layer": _coordinate("layer", self.checked, long_name="what a checksum covers"),
            **{name: _coordinate(name, tuple(labels), long_name=name) for name, labels in _LABELS.items()},
            **(bands if self.wavelength_nm else {}),
            "sample": _coordinate("sample", np.arange(samples, dtype=np.int64), long_name="sample"),
        }

    def layer_bytes(self, name: str) -> int:
        """Uncompressed bytes of one sample of a per-pixel layer."""
        row = self.pixel_layers[name]
        return int(np.prod(self.shape(row), dtype=np.int64)) * np.dtype(row.dtype).itemsize

    @property
    def estimated_sample_bytes(self) -> int:
        """About what a sample takes on disk."""
        pixels = sum(self.layer_bytes(name) * row.ratio for name, row in self.pixel_layers.items())
        return int(pixels) + 4096

    def plain(self) -> dict[str, Any]:
        """JSON-able fields without the root attributes; `_spec` reads them back."""
        # not asdict: it would copy the whole scene to leave it out
        return {f.name: getattr(self, f.name) for f in fields(self) if f.name != "attributes"}


def _spec(plain: Mapping[str, Any], attributes: Mapping[str, Any]) -> StoreSpec:
    known = {f.name for f in fields(StoreSpec)}
    values: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in plain.items() if k in known}
    return StoreSpec(**values, attributes=attributes)


@contextlib.contextmanager
def _disk(path: Path, doing: str) -> Iterator[None]:
    """Turn what the operating system refuses into one sentence; what was finished stays as it is."""
    try:
        yield
    except OSError as error:
        raise VbnfaultError(
            f"{path}: {error.strerror or error} while {doing}; finished samples stay, "
            f"and the same command resumes once that is mended"
        ) from error


def _put(path: Path, data: bytes) -> None:
    """Write a file that is either the old or the whole new one at any moment."""
    partial = path.with_name(f"{path.name}.{uuid.uuid4().hex}.partial")
    path.parent.mkdir(parents=True, exist_ok=True)
    try:
        partial.write_bytes(data)
        os.replace(partial, path)
    except BaseException:
        partial.unlink(missing_ok=True)
        raise


def _threads() -> int:
    return max(1, min(4, int(os.environ.get("VBNFAULT_THREADS", "0")) or os.cpu_count() or 1))


def _crc32c(array: NDArray[Any]) -> int:
    frozen = np.ascontiguousarray(array).view()
    frozen.flags.writeable = False  # the C function takes read-only buffers alone
    return int(google_crc32c.value(frozen))


def _compress(data: Any) -> bytes:
    return bytes(Zstd(level=_ZSTD_LEVEL, checksum=True).encode(data))


def _decompress(data: bytes) -> bytes:
    """Raises ValueError where the frame or its checksum is broken."""
    try:
        return bytes(Zstd().decode(data))
    except (RuntimeError, MemoryError) as error:  # a damaged header may ask for any size
        raise ValueError(str(error)) from error


# --- shard files: the `sharding_indexed` layout of the Zarr v3 specification, index at the end -------------


def _join_shard(chunks: Mapping[int, bytes], count: int) -> bytes:
    """A shard file of `count` chunks; those missing from `chunks` are marked absent."""
    index = np.full((count, 2), _ABSENT, dtype="<u8")
    position = 0
    for i in sorted(chunks):
        index[i] = position, len(chunks[i])
        position += len(chunks[i])
    table = index.tobytes()
    parts = [chunks[i] for i in sorted(chunks)]
    return b"".join([*parts, table, struct.pack("<I", google_crc32c.value(table))])


def _split_shard(data: bytes, count: int) -> dict[int, bytes]:
    """Chunk number → compressed bytes. Raises ValueError where the file is no whole shard."""
    size = 16 * count
    table, crc = data[-size - 4 : -4], data[-4:]
    if len(table) != size or struct.pack("<I", google_crc32c.value(table)) != crc:
        raise ValueError("truncated or overwritten: its index does not match its checksum")
    chunks = {}
    for i, (start, length) in enumerate(np.frombuffer(table, dtype="<u8").reshape(count, 2).tolist()):
        if start != _ABSENT:
            chunks[i] = data[start : start + length]
    return chunks


# --- one sample, ready to be written ----------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True, eq=False)
class Encoded:
    """A sample with its layers compressed: what a task keeps until its shard is complete."""

    index: int
    chunks: Mapping[str, bytes]
    scalars: Mapping[str, Any]
    crc32c: NDArray[np.uint32]


def encode(spec: StoreSpec, sample: Sample) -> Encoded:
    """Check a sample against the schema, compress its layers, compute its checksums.

    `mask_any` is made here where the sample has none. Raises ValueError that names the sample and the array
    where one is missing, unknown, or of another shape or dtype.
    """
    layers = dict(sample.layers)
    if "mask" in layers and "mask_any" not in layers:
        layers["mask_any"] = mask_union(spec, layers["mask"])
    _same_names(sample.index, "layer", layers, spec.pixel_layers)
    _same_names(sample.index, "scalar", sample.scalars, SCALARS)

    def pack(name: str) -> tuple[bytes, int]:
        row, array = spec.pixel_layers[name], np.ascontiguousarray(layers[name])
        if array.shape != spec.shape(row) or array.dtype != np.dtype(row.dtype):
            raise ValueError(
                f"sample {sample.index}: {name} is {array.dtype}{list(array.shape)}, "
                f"not {row.dtype}{list(spec.shape(row))}"
            )
        return (_compress(array), _crc32c(array)) if array.size else (b"", 0)

    with ThreadPoolExecutor(_threads()) as pool:
        packed = dict(zip(spec.pixel_layers, pool.map(pack, spec.pixel_layers), strict=True))
    scalars = {name: _scalar(spec, sample.index, name, sample.scalars[name]) for name in SCALARS}
    crcs = [crc for _, crc in packed.values()]
    return Encoded(
        index=sample.index,
        chunks={name: chunk for name, (chunk, _) in packed.items()},
        scalars=scalars,
        crc32c=np.array([*crcs, _crc_of_scalars(scalars)], dtype=np.uint32),
    )


def mask_union(spec: StoreSpec, mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """bool[y, x] from bool[fault, y, x]: what `mask_any` must be."""
    chosen = np.array([f in spec.mask_any_faults for f in spec.faults], dtype=bool)
    return np.logical_or.reduce(mask[chosen], axis=0)


def _same_names(index: int, kind: str, got: Iterable[str], expected: Iterable[str]) -> None:
    for name in set(expected) - set(got):
        raise ValueError(f"sample {index}: the {kind} {name} is missing")
    for name in set(got) - set(expected):
        raise ValueError(f"sample {index}: the store holds no {kind} {name}")


def _scalar(spec: StoreSpec, index: int, name: str, value: Any) -> Any:
    row = SCALARS[name]
    if row.is_text:
        return value if isinstance(value, str) else json.dumps(value, sort_keys=True)
    array = np.asarray(value)
    shape = spec.shape(row)
    if array.shape != shape:
        raise ValueError(f"sample {index}: {name} has shape {list(array.shape)}, not {list(shape)}")
    typed = array.astype(row.dtype)
    if row.dtype != "float64" and not np.array_equal(typed, array):
        raise ValueError(f"sample {index}: {name} = {value!r} does not fit {row.dtype}")
    return typed


def _crc_of_scalars(scalars: Mapping[str, Any]) -> int:
    """One checksum over all scalars of a sample, in the order of the schema."""
    parts = []
    for name, row in SCALARS.items():
        data = scalars[name].encode() if row.is_text else np.asarray(scalars[name]).astype(row.dtype).tobytes()
        parts.append(struct.pack("<Q", len(data)) + data)
    return int(google_crc32c.value(b"".join(parts)))


# --- an open store ----------------------------------------------------------------------------------------


class Problem(NamedTuple):
    """What is wrong with some samples, in one sentence."""

    samples: tuple[int, ...]
    sentence: str


class Store:
    """An open store. `open_store` makes one; reads go through zarr, as a user's do."""

    def __init__(self, path: Path, group: zarr.Group, attributes: dict[str, Any]) -> None:
        self.path = path
        self.attributes = {k: v for k, v in attributes.items() if k not in ("store", "samples", "coordinates")}
        self.samples = int(attributes["samples"])
        self.spec = _spec(attributes["store"], self.attributes)
        self._group = group
        self._arrays: dict[str, zarr.Array[Any]] = {}

    @property
    def shards(self) -> int:
        """Number of shards along the sample axis."""
        return -(-self.samples // self.spec.shard_samples)

    def shard(self, number: int) -> range:
        """The samples of a shard."""
        size = self.spec.shard_samples
        return range(number * size, min((number + 1) * size, self.samples))

    def array(self, name: str) -> zarr.Array[Any]:
        """The zarr array. Raises VbnfaultError where it is missing or its metadata cannot be read."""
        if name not in self._arrays:
            try:
                array = self._group[name]
            except Exception:  # zarr raises many kinds for metadata that it cannot parse
                array = None
            if not isinstance(array, zarr.Array):
                raise VbnfaultError(f"{self.path}: {self._why_closed(name)}; the build command re-creates it")
            self._arrays[name] = array
        return self._arrays[name]

    def _why_closed(self, name: str) -> str:
        if not (self.path / name / "zarr.json").is_file():
            return f"array {name} is missing"
        return f"array {name} cannot be opened, {name}/zarr.json is damaged"

    def read(self, name: str, start: int = 0, stop: int | None = None) -> NDArray[Any]:
        """Samples `start` … `stop` of an array. Raises VbnfaultError where they cannot be decoded."""
        stop = self.samples if stop is None else stop
        try:
            values = self.array(name)[start:stop]
        except VbnfaultError:
            raise
        except Exception as error:
            raise VbnfaultError(
                f"{self.path}: {name} of samples {start}-{stop - 1} cannot be read ({error}); "
                f"the build command repairs it"
            ) from error
        return np.asarray(values)

    def read_sample(self, index: int) -> Sample:
        """One sample as it was written. Raises InputError where it does not exist or is not finished."""
        if not 0 <= index < self.samples:
            raise InputError(f"{self.path}: sample {index} does not exist; the range is 0 to {self.samples - 1}")
        if not self.read("done", index, index + 1)[0]:
            raise InputError(f"{self.path}: sample {index} is not finished yet; the build command resumes")
        one = {name: self.read(name, index, index + 1)[0] for name in (*self.spec.pixel_layers, *SCALARS)}
        return Sample(
            index=index,
            layers={name: one[name] for name in self.spec.pixel_layers},
            scalars={name: str(one[name]) if row.is_text else one[name] for name, row in SCALARS.items()},
        )

    def column(self, name: str, number: int) -> NDArray[Any]:
        """A scalar for all samples of a shard. Raises OSError or ValueError where its chunk is damaged."""
        row, size = self.spec.arrays[name], self.spec.shard_samples
        if self.spec.empty(name):
            return np.zeros((len(self.shard(number)), *self.spec.shape(row)), dtype=row.dtype)
        data = _decompress(self.file(name, number).read_bytes())
        values = VLenUTF8().decode(data) if row.is_text else np.frombuffer(data, dtype=row.dtype)
        return values.reshape(size, *self.spec.shape(row))[: len(self.shard(number))]

    def _put_column(self, name: str, number: int, values: Mapping[int, Any]) -> None:
        if self.spec.empty(name):
            return
        row, first = self.spec.arrays[name], self.shard(number).start
        dtype = object if row.is_text else row.dtype
        column = np.full((self.spec.shard_samples, *self.spec.shape(row)), row.fill, dtype=dtype)
        for i, value in values.items():
            column[i - first] = value
        _put(self.file(name, number), _compress(VLenUTF8().encode(column) if row.is_text else column))

    def done(self, number: int) -> dict[int, bool]:
        """Sample → is it finished; none of the shard is where that cannot be read."""
        samples = self.shard(number)
        try:
            return dict(zip(samples, self.column("done", number).astype(bool).tolist(), strict=True))
        except (OSError, ValueError):
            return dict.fromkeys(samples, False)

    def finished(self) -> int:
        """How many samples say that they are finished."""
        return sum(sum(self.done(n).values()) for n in range(self.shards))

    def file(self, name: str, number: int) -> Path:
        """The file of a shard: of a layer its chunks, of a scalar its one chunk."""
        row = self.spec.arrays[name]
        return self.path.joinpath(name, "c", str(number), *("0" for _ in row.dims[1:]))

    def chunk(self, name: str, number: int) -> dict[int, bytes]:
        """Sample → compressed bytes of a layer's shard. Raises ValueError or OSError where it is damaged."""
        if self.spec.empty(name):
            return dict.fromkeys(self.shard(number), b"")
        size = self.spec.shard_samples
        chunks = _split_shard(self.file(name, number).read_bytes(), size)
        return {number * size + i: chunk for i, chunk in chunks.items()}

    def write_shard(self, number: int, given: Mapping[int, Encoded]) -> None:
        """Write a shard: the `given` samples, and those that were finished before, unchanged.

        `done` comes last. Raises VbnfaultError where the disk refuses.
        """
        samples, size = self.shard(number), self.spec.shard_samples
        first, last = samples.start, samples.stop - 1
        with _disk(self.path, f"writing samples {first}-{last}"):
            done = self.done(number)
            if any(done[i] for i in given):
                self._put_column("done", number, {i: done[i] and i not in given for i in samples})
            kept = {i for i in samples if done[i] and i not in given}
            for name in self.spec.pixel_layers:
                if self.spec.empty(name):
                    continue
                old: dict[int, bytes] = {}
                if kept:
                    with contextlib.suppress(ValueError, FileNotFoundError):
                        old = self.chunk(name, number)
                kept &= set(old)
                chunks = {i: given[i].chunks[name] if i in given else old[i] for i in {*given, *kept}}
                shard = _join_shard({i - first: chunk for i, chunk in chunks.items()}, size)
                _put(self.file(name, number), shard)
            for name in (*SCALARS, "crc32c"):
                values = {i: e.crc32c if name == "crc32c" else e.scalars[name] for i, e in given.items()}
                if kept:
                    try:
                        column = self.column(name, number)
                    except (OSError, ValueError):
                        kept = set()
                    values |= {i: column[i - first] for i in kept}
                self._put_column(name, number, values)
            self._put_column("done", number, {i: i in given or i in kept for i in samples})


# --- create, open, grow -----------------------------------------------------------------------------------


def create(path: str | os.PathLike[str], spec: StoreSpec, samples: int, *, overwrite: bool = False) -> Store:
    """Create an empty store of `samples` samples and open it for writing.

    It appears under its name only once it is whole. With `overwrite` an existing store is replaced; a folder
    that holds anything else never is. Raises InputError where the path cannot be used.
    """
    target = Path(path)
    if samples < 1:
        raise InputError(f"samples = {samples}: must be at least 1")
    old = is_store(target)
    if old and not overwrite:
        raise InputError(f"{target}: exists already; resume it, or give --overwrite to replace it")
    if not old and target.exists() and (not target.is_dir() or any(target.iterdir())):
        raise InputError(f"{target}: exists and is no vbnfault store, so it is left alone; choose another --out")
    above = next(p for p in target.absolute().parents if p.exists())
    if not above.is_dir():
        raise InputError(f"{target}: no store can be created here: {above} is a file, not a folder")
    hidden = target.absolute().parent / f".{target.name}.{uuid.uuid4().hex}.partial"
    try:
        hidden.parent.mkdir(parents=True, exist_ok=True)
        for leftover in hidden.parent.glob(f".{target.name}.*.partial"):
            shutil.rmtree(leftover, ignore_errors=True)
        _create_group(hidden, spec, samples)
        if old:
            retired = hidden.with_name(f".{target.name}.{uuid.uuid4().hex}.partial")
            os.replace(target, retired)
            os.replace(hidden, target)
            shutil.rmtree(retired, ignore_errors=True)
        else:
            if target.is_dir():
                target.rmdir()
            os.replace(hidden, target)
    except OSError as error:
        shutil.rmtree(hidden, ignore_errors=True)
        raise InputError(f"{target}: no store can be created here: {error.strerror or error}") from error
    return open_store(target, "r+")


def _create_group(path: Path, spec: StoreSpec, samples: int) -> None:
    attributes = {
        **json.loads(json.dumps(spec.attributes)),
        "format": "vbnfault",
        "format_version": FORMAT_VERSION,
        "store": json.loads(json.dumps(spec.plain())),
        "samples": samples,
        "coordinates": "wavelength_nm",  # makes xarray show it as a coordinate of `band`
    }
    group = zarr.open_group(path, mode="w-", zarr_format=3, attributes=attributes)
    for name, member in spec.members(samples).items():
        _create_array(group, name, member)
    _consolidate(path)


def _create_array(group: zarr.Group, name: str, member: Member) -> None:
    """Write the metadata of an array, and the values of a coordinate; data files that exist stay."""
    array = group.create_array(
        name,
        shape=member.shape,
        chunks=member.chunks,
        shards=member.shards,
        dtype=str if member.dtype == "str" else member.dtype,
        fill_value=member.fill,
        compressors=ZstdCodec(level=_ZSTD_LEVEL, checksum=True),
        dimension_names=member.dims,
        attributes=dict(member.attributes),
    )
    if member.values is not None and len(member.values):
        array[:] = member.values if isinstance(member.values, np.ndarray) else list(member.values)


def _misshapen(array: zarr.Array[Any], member: Member) -> Iterator[str]:
    """What of an array's layout is not as it must be, the number of samples left out."""
    is_text = array.dtype.kind in "OTU"
    layout: dict[str, tuple[Any, Any]] = {
        "dims": (tuple(getattr(array.metadata, "dimension_names", None) or ()), member.dims),
        "dtype": ("str" if is_text else array.dtype.name, member.dtype),
    }
    if member.values is None:
        layout["shape of a sample"] = array.shape[1:], member.shape[1:]
        layout["chunks"] = array.chunks, member.chunks
        layout["shards"] = array.shards, member.shards
    for what, (stored, wanted) in layout.items():
        if stored != wanted:
            yield f"its {what} = {_short(stored)}, not {_short(wanted)}"


def _misnamed(array: zarr.Array[Any], member: Member) -> Iterator[str]:
    """Which attributes that carry meaning are not as they must be."""
    for key, wanted in member.attributes.items():
        stored = array.attrs.get(key)
        if key != "long_name" and stored != wanted:
            yield f"its attribute {key} = {_short(stored)}, not {_short(wanted)}"


def _misvalued(array: zarr.Array[Any], member: Member) -> Iterator[str]:
    """What of a coordinate's values is not as it must be."""
    if member.values is None:
        return
    try:
        stored = np.asarray(array[:])
    except Exception:  # zarr raises many kinds for chunks that it cannot decode
        yield "its values cannot be decoded"
        return
    if stored.shape != member.shape:
        yield f"it has the shape {list(stored.shape)}, not {list(member.shape)}"
    elif not np.array_equal(stored, np.asarray(member.values, dtype=stored.dtype)):
        first = next(i for i, (a, b) in enumerate(zip(stored, member.values, strict=True)) if a != b)
        yield f"its value {first} is {_short(stored[first])}, not {_short(member.values[first])}"


def _mend(store: Store, name: str, member: Member) -> None:
    """Bring the metadata of an array, and the values of a coordinate, to what they must be."""
    folder = store.path / name
    try:
        array: zarr.Array[Any] | None = store.array(name)
    except VbnfaultError:
        array = None
    if array is not None:
        sound = not any(_misshapen(array, member)) and not any(_misvalued(array, member))
        if sound and any(_misnamed(array, member)):
            array.update_attributes(member.attributes)
        if sound and array.shape != member.shape:
            array.resize(member.shape)
        if sound:
            return
    if not folder.is_dir():
        folder.unlink(missing_ok=True)
    elif member.values is not None:
        shutil.rmtree(folder)
    else:
        (folder / "zarr.json").unlink(missing_ok=True)
    store._arrays.pop(name, None)
    _create_array(store._group, name, member)


def _consolidate(path: Path) -> None:
    """Gather all metadata in the root, where xarray looks first (it warns where there is none)."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Consolidated metadata", category=UserWarning)
        zarr.consolidate_metadata(path, zarr_format=3)


def _root(path: Path) -> dict[str, Any] | None:
    """Root attributes of a vbnfault store, None where there is none."""
    try:
        meta = json.loads((path / "zarr.json").read_text())
        attributes = meta["attributes"]
    except (OSError, ValueError, KeyError, TypeError):
        return None
    return attributes if isinstance(attributes, dict) and attributes.get("format") == "vbnfault" else None


def is_store(path: str | os.PathLike[str]) -> bool:
    """Is there a vbnfault store at this path?"""
    return _root(Path(path)) is not None


def open_store(path: str | os.PathLike[str] | Store, mode: str = "r") -> Store:
    """Open a store, `r` or `r+`. Raises InputError where the path holds none, or one of a newer format."""
    if isinstance(path, Store):
        return path
    path = Path(path)
    attributes = _root(path)
    if attributes is None:
        what = "is no vbnfault store" if path.exists() else "no such store"
        raise InputError(f"{path}: {what}")
    if attributes["format_version"] > FORMAT_VERSION:
        raise InputError(
            f"{path}: format_version = {attributes['format_version']}: "
            f"this vbnfault reads up to {FORMAT_VERSION}; install a newer one"
        )
    group = zarr.open_group(path, mode="r+" if mode == "r+" else "r", zarr_format=3, use_consolidated=False)
    return Store(path, group, attributes)


def append_samples(
    store: str | os.PathLike[str] | Store, count: int, attributes: Mapping[str, Any] | None = None
) -> Store:
    """Grow a store by `count` unfinished samples, with further root attributes, and open it again.

    Earlier samples keep their bits. A kill half-way is mended by `recover`.
    """
    store = open_store(store, "r+")
    if count < 1:
        raise InputError(f"append = {count}: must be at least 1")
    with _disk(store.path, f"adding {count} samples"):
        store._group.update_attributes({**(attributes or {}), "samples": store.samples + count})
    return recover(store.path)


def recover(path: str | os.PathLike[str]) -> Store:
    """Open a store for writing after whatever happened to it; only while nothing else writes to it.

    Removes the `*.partial` files of a killed process and brings every array to the length that the root says,
    its layout and attributes and all coordinates to what the root's spec says. Arrays that are missing are made
    again, unwritten.
    """
    store = open_store(path, "r+")
    with _disk(store.path, "recovering the store"):
        for folder, _, files in os.walk(store.path):
            for name in files:
                if name.endswith(".partial"):
                    Path(folder, name).unlink(missing_ok=True)
        for name, member in store.spec.members(store.samples).items():
            _mend(store, name, member)
        _consolidate(store.path)
    return open_store(store.path, "r+")


def write_samples(store: str | os.PathLike[str] | Store, samples: Iterable[Sample | Encoded]) -> None:
    """Write samples into their shards, whole files only; the other samples of those shards keep their bits.

    Only one process may write to a shard at a time. Raises ValueError for a sample that does not fit the
    schema or the store, VbnfaultError where the disk refuses.
    """
    store = open_store(store, "r+")
    by_shard: dict[int, dict[int, Encoded]] = {}
    for sample in samples:
        if not 0 <= sample.index < store.samples:
            raise ValueError(f"sample {sample.index}: the store holds 0 to {store.samples - 1}")
        encoded = sample if isinstance(sample, Encoded) else encode(store.spec, sample)
        by_shard.setdefault(sample.index // store.spec.shard_samples, {})[sample.index] = encoded
    for number, given in sorted(by_shard.items()):
        store.write_shard(number, given)


# --- check ------------------------------------------------------------------------------------------------


def check_shard(store: Store, number: int) -> list[Problem]:
    """What is unfinished, missing or damaged in one shard; every finished layer is decoded and compared."""
    samples = store.shard(number)
    columns: dict[str, NDArray[Any]] = {}
    unreadable = {}
    for name in ("done", "crc32c", *SCALARS):
        where = store.file(name, number).relative_to(store.path)
        try:
            columns[name] = store.column(name, number)
        except FileNotFoundError:
            unreadable[name] = f"the chunk file {where} is missing"
        except (OSError, ValueError):
            unreadable[name] = f"cannot be decoded, {where} is damaged"
        if name == "done" and unreadable and store.file("image", number).exists():
            return [Problem(tuple(samples), f"done of samples {_spans(samples)}: {unreadable[name]}")]
        if name == "done" and unreadable:
            break
    finished = [i for i in samples if "done" in columns and columns["done"][i - samples.start]]
    missing = tuple(i for i in samples if i not in finished)
    problems = [Problem(missing, f"samples {_spans(missing)}: not finished")] if missing else []
    if not finished:
        return problems
    many = f"of samples {_spans(finished)}"
    problems += [Problem(tuple(finished), f"{name} {many}: {why}") for name, why in unreadable.items()]
    if "crc32c" not in columns:
        return problems
    if not unreadable:
        for i in finished:
            k = i - samples.start
            if _crc_of_scalars({n: columns[n][k] for n in SCALARS}) != columns["crc32c"][k, -1]:
                problems.append(Problem((i,), f"sample {i}: its scalars do not match their crc32c"))

    crcs = {i: columns["crc32c"][i - samples.start] for i in finished}
    with ThreadPoolExecutor(_threads()) as pool:
        for found in pool.map(lambda name: _check_layer(store, name, number, crcs), store.spec.pixel_layers):
            problems += found
    return problems


def _check_layer(store: Store, name: str, number: int, crcs: Mapping[int, NDArray[np.uint32]]) -> list[Problem]:
    if store.spec.empty(name):
        return []
    file, column = store.file(name, number), store.spec.checked.index(name)
    where, many = file.relative_to(store.path), f"{name} of samples {_spans(crcs)}"
    try:
        chunks = store.chunk(name, number)
    except FileNotFoundError:
        return [Problem(tuple(crcs), f"{many}: the shard file {where} is missing")]
    except (OSError, ValueError) as error:
        return [Problem(tuple(crcs), f"{many}: the shard file {where} is damaged: {error}")]
    problems = []
    for i, stored in crcs.items():
        wrong = ""
        if i not in chunks:
            wrong = f"has no chunk in {where}"
        else:
            try:
                if google_crc32c.value(_decompress(chunks[i])) != stored[column]:
                    wrong = f"in {where} does not match its stored crc32c"
            except ValueError:
                wrong = f"cannot be decoded, its chunk in {where} is damaged"
        if wrong:
            problems.append(Problem((i,), f"sample {i}: {name} {wrong}"))
    return problems


def _spans(indices: Iterable[int]) -> str:
    """`3-7, 9` for 3, 4, 5, 6, 7, 9."""
    runs: list[list[int]] = []
    for i in sorted(indices):
        if runs and i == runs[-1][1] + 1:
            runs[-1][1] = i
        else:
            runs.append([i, i])
    return ", ".join(str(a) if a == b else f"{a}-{b}" for a, b in runs)


def problem_samples(store: str | os.PathLike[str] | Store) -> list[int]:
    """Samples that have to be built, or built again: unfinished, missing or damaged ones."""
    store = open_store(store)
    return sorted({i for n in range(store.shards) for p in check_shard(store, n) for i in p.samples})


def verify(
    path: str | os.PathLike[str] | Store,
    *,
    expected: Callable[[int], Mapping[str, Any]] | None = None,
    progress: Callable[[int], None] | None = None,
) -> list[str]:
    """Every problem of a store, one sentence each that names the array, the sample and the file.

    Checks that every array is there with its layout, attributes and coordinates; where an array of samples is
    not, samples are not looked at. Checks that each sample is whole (`check_shard`) and labelled: masks,
    `injected` and `parameters` agree, a site lies in one split. `expected(sample)` gives the scalars as planned,
    compared exactly. `progress` is called with the number of samples just checked. Raises InputError where there
    is no store.
    """
    store = open_store(path)
    problems, hopeless = [], False
    for name, member in store.spec.members(store.samples).items():
        try:
            array = store.array(name)
        except VbnfaultError:
            problems.append(store._why_closed(name))
            hopeless |= member.values is None
            continue
        misshapen = list(_misshapen(array, member))
        if member.values is None and not misshapen and array.shape != member.shape:
            problems.append(
                f"{name} holds {array.shape[0]} samples, not {store.samples}: appending was interrupted, "
                f"the build command resumes it"
            )
            hopeless = True
        hopeless |= member.values is None and bool(misshapen)
        found = misshapen + [*_misnamed(array, member)] + ([] if misshapen else [*_misvalued(array, member)])
        problems += [f"array {name}: {what}" for what in found]
    if hopeless:
        return problems
    split_of: dict[int, tuple[int, int]] = {}
    for number in range(store.shards):
        damage = check_shard(store, number)
        problems += [p.sentence for p in damage]
        broken = {i for p in damage for i in p.samples}
        sound = [i for i in store.shard(number) if i not in broken]
        if sound:
            start = store.shard(number).start
            columns = {name: store.column(name, number) for name in SCALARS}
            masks = {name: store.chunk(name, number) for name in ("mask", "mask_any")}
            for i in sound:
                scalars = {name: column[i - start] for name, column in columns.items()}
                layers = {name: _decode(store.spec, name, chunks[i]) for name, chunks in masks.items()}
                problems += _check_labels(store.spec, i, scalars, layers)
                problems += _check_split(store, i, scalars, split_of)
                problems += _check_plan(i, scalars, expected(i) if expected else {})
        if progress:
            progress(len(store.shard(number)))
    return problems


def _decode(spec: StoreSpec, name: str, chunk: bytes) -> NDArray[Any]:
    row = spec.pixel_layers[name]
    if spec.empty(name):
        return np.zeros(spec.shape(row), dtype=row.dtype)
    return np.frombuffer(_decompress(chunk), dtype=row.dtype).reshape(spec.shape(row))


def _check_labels(
    spec: StoreSpec, i: int, scalars: Mapping[str, Any], layers: Mapping[str, NDArray[Any]]
) -> Iterator[str]:
    injected, mask = scalars["injected"], layers["mask"]
    parameters = json.loads(str(scalars["parameters"]) or "{}")
    for fault, is_in in zip(spec.faults, injected.tolist(), strict=True):
        drawn = parameters.get(fault)
        listed = drawn is not None and not (isinstance(drawn, dict) and drawn.get("injected") is False)
        if listed != is_in:
            says = "has no parameters, although" if is_in else "has parameters, although not"
            yield f"sample {i}: {fault} {says} marked in injected"
    for k, fault in enumerate(spec.faults):
        if not injected[k] and mask[k].any():
            yield f"sample {i}: mask of {fault} is not empty, although it is not injected"
        if injected[k] and fault in (spec.localised_faults or ()) and not mask[k].any():
            yield f"sample {i}: mask of {fault} is empty, although it is injected"
    if not np.array_equal(layers["mask_any"], mask_union(spec, mask)):
        yield f"sample {i}: mask_any is not the union of the masks of {', '.join(spec.mask_any_faults)}"


def _check_split(
    store: Store, i: int, scalars: Mapping[str, Any], split_of: dict[int, tuple[int, int]]
) -> Iterator[str]:
    site, split = int(scalars["site"]), int(scalars["split"])
    first, before = split_of.setdefault(site, (i, split))
    if split != before:
        names = store.spec.site_names
        named = names[site] if 0 <= site < len(names) else str(site)
        yield f"sample {i}: split = {split}, but sample {first} of the same site {named} has {before}"


def _check_plan(i: int, scalars: Mapping[str, Any], expected: Mapping[str, Any]) -> Iterator[str]:
    for name, planned in expected.items():
        stored = scalars[name]
        if SCALARS[name].is_text:
            planned = json.loads(planned) if isinstance(planned, str) else json.loads(json.dumps(planned))
            same = json.loads(str(stored)) == planned
        else:
            values = np.asarray(planned).astype(SCALARS[name].dtype)
            same = np.array_equal(values, stored, equal_nan=SCALARS[name].dtype == "float64")
        if not same:
            yield f"sample {i}: {name} = {_short(stored)} is not as planned ({_short(planned)})"


def _short(value: Any) -> str:
    text = str(value.tolist() if isinstance(value, np.ndarray | np.generic) else value)
    return text if len(text) <= 80 else text[:77] + "..."


def digest(path: str | os.PathLike[str] | Store) -> str:
    """sha256 (hex) of what a store holds: root attributes, and decoded arrays with dims and dtypes.

    Time of creation, sharding and compression are no part of it. Raises VbnfaultError for damaged chunks.
    """
    store = open_store(path)
    total = hashlib.sha256()
    attributes = {k: v for k, v in store.attributes.items() if k not in VOLATILE_ATTRIBUTES}
    plain = {k: v for k, v in store.spec.plain().items() if k != "shard_samples"}
    total.update(json.dumps([attributes, plain, store.samples], sort_keys=True).encode())
    for name, row in sorted(store.spec.arrays.items()):
        total.update(json.dumps([name, row.dims, row.dtype]).encode())
        step = max(1, 2**26 // max(1, store.spec.layer_bytes(name))) if name in store.spec.pixel_layers else 4096
        for start in range(0, store.samples, step):
            values = store.read(name, start, min(start + step, store.samples))
            if row.is_text:
                for text in values.tolist():
                    total.update(json.dumps(text).encode())
            else:
                total.update(np.ascontiguousarray(values).data)
    return total.hexdigest()
