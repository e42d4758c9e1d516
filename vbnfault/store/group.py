"""The Zarr group on disk: create, open, read, and write its shards. Whole files only, `done` last."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import uuid
import warnings
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import zarr
from numcodecs import VLenUTF8
from numpy.typing import NDArray
from zarr.codecs import ZstdCodec

from ..errors import InputError, VbnfaultError
from ..quantities import Sample
from .codec import ZSTD_LEVEL, Encoded, compress, decompress, encode, join_shard, split_shard
from .schema import FORMAT_VERSION, SCALARS, Member, StoreSpec, spec_from_plain


@contextlib.contextmanager
def disk(path: Path, doing: str) -> Iterator[None]:
    """Turn what the operating system refuses into one sentence; what was finished stays as it is."""
    try:
        yield
    except OSError as error:
        raise VbnfaultError(
            f"{path}: {error.strerror or error} while {doing}; finished samples stay, "
            f"and the same command resumes once that is mended"
        ) from error


def put(path: Path, data: bytes) -> None:
    """Write a file that is either the old or the whole new one at any moment."""
    partial = path.with_name(f"{path.name}.{uuid.uuid4().hex}.partial")
    path.parent.mkdir(parents=True, exist_ok=True)
    try:
        partial.write_bytes(data)
        os.replace(partial, path)
    except BaseException:
        partial.unlink(missing_ok=True)
        raise


class Store:
    """An open store. `open_store` makes one; reads go through zarr, as a user's do."""

    def __init__(self, path: Path, group: zarr.Group, attributes: dict[str, Any]) -> None:
        self.path = path
        self.attributes = {k: v for k, v in attributes.items() if k not in ("store", "samples", "coordinates")}
        self.samples = int(attributes["samples"])
        self.spec = spec_from_plain(attributes["store"], self.attributes)
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
                raise VbnfaultError(f"{self.path}: {self.why_closed(name)}; the build command re-creates it")
            self._arrays[name] = array
        return self._arrays[name]

    def make_array(self, name: str, member: Member) -> None:
        """Make an array whose metadata is not there; data files that exist stay."""
        self._arrays.pop(name, None)
        _create_array(self._group, name, member)

    def update_attributes(self, values: Mapping[str, Any]) -> None:
        """Change root attributes on disk; who opens the store again sees them."""
        self._group.update_attributes(dict(values))

    def why_closed(self, name: str) -> str:
        """What is wrong with an array that `array` cannot open."""
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
        data = decompress(self.file(name, number).read_bytes())
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
        put(self.file(name, number), compress(VLenUTF8().encode(column) if row.is_text else column))

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
        chunks = split_shard(self.file(name, number).read_bytes(), size)
        return {number * size + i: chunk for i, chunk in chunks.items()}

    def write_shard(self, number: int, given: Mapping[int, Encoded]) -> None:
        """Write a shard: the `given` samples, and those that were finished before, unchanged.

        `done` comes last. Raises VbnfaultError where the disk refuses.
        """
        samples, size = self.shard(number), self.spec.shard_samples
        first, last = samples.start, samples.stop - 1
        with disk(self.path, f"writing samples {first}-{last}"):
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
                shard = join_shard({i - first: chunk for i, chunk in chunks.items()}, size)
                put(self.file(name, number), shard)
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


# --- create, open, write ----------------------------------------------------------------------------------


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
    consolidate(path)


def _create_array(group: zarr.Group, name: str, member: Member) -> None:
    """Write the metadata of an array, and the values of a coordinate; data files that exist stay."""
    array = group.create_array(
        name,
        shape=member.shape,
        chunks=member.chunks,
        shards=member.shards,
        dtype=str if member.dtype == "str" else member.dtype,
        fill_value=member.fill,
        compressors=ZstdCodec(level=ZSTD_LEVEL, checksum=True),
        dimension_names=member.dims,
        attributes=dict(member.attributes),
    )
    if member.values is not None and len(member.values):
        array[:] = member.values if isinstance(member.values, np.ndarray) else list(member.values)


def consolidate(path: Path) -> None:
    """Gather all metadata in the root, where xarray looks first (it warns where there is none)."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Consolidated metadata", category=UserWarning)
        zarr.consolidate_metadata(path, zarr_format=3)


def consolidated_metadata(path: Path) -> dict[str, Any] | None:
    """Array name → what the root says its metadata are; None where the root does not say, or says nonsense."""
    try:
        entries = json.loads((path / "zarr.json").read_text())["consolidated_metadata"]["metadata"]
    except (OSError, ValueError, KeyError, TypeError):
        return None
    return entries if isinstance(entries, dict) else None


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
