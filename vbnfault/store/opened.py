"""Read samples of an open store, and write its shards.

Only whole files are written, and `done` is written last.
"""

from __future__ import annotations

import json
import math
from collections.abc import Collection, Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.errors import InputError, VbnfaultError
from ..core.quantities import Sample
from . import disk
from .attributes import check_attributes, check_names, number_of_samples
from .bucket import Files
from .codec import (
    Encoded,
    chunk_ranges,
    crc32c,
    crc_of_scalars,
    index_size,
    join_shard,
    split_shard,
    threads,
)
from .compressors import compressor, most_compressed
from .layout import (
    DOCUMENT,
    OWN_ATTRIBUTES,
    SPARE,
    array_documents,
    decode_values,
    drawn_table,
    encode_values,
    group_document,
    sealed,
    to_bytes,
)
from .schema import SPLITS, spec_from_plain

# errors that mean a damaged or missing file; any other OSError may be temporary
_DAMAGE = (ValueError, FileNotFoundError, NotADirectoryError, disk.Misplaced)
# a sample counts as damaged after so many reads that fail or do not match, although nothing was rewritten
_READS = 3


class Store:
    """Hold an open store, as `open_store` returns it.

    The files are read directly, and no more of them than the schema allows: the store may be that of a stranger.
    """

    def __init__(self, files: Files, attributes: dict[str, Any]) -> None:
        self.files, self.path = files, files.path
        self.root_attributes = attributes
        self.attributes = {k: v for k, v in attributes.items() if k not in OWN_ATTRIBUTES}
        check_attributes(self.attributes)
        self.samples = number_of_samples(attributes)
        self.spec = spec_from_plain(attributes["store"], self.attributes)
        check_names(self.spec, self.samples)
        self._shapes: dict[str, tuple[int, ...]] = {}

    @property
    def shards(self) -> int:
        """Return the number of shards along the sample axis."""
        return -(-self.samples // self.spec.shard_samples)

    def shard(self, number: int) -> range:
        """Return the samples of a shard."""
        size = self.spec.shard_samples
        return range(number * size, min((number + 1) * size, self.samples))

    def update_attributes(self, values: Mapping[str, Any]) -> None:
        """Change root attributes on disk, in `spare` first. A store must be opened again to show them."""
        self.root_attributes = sealed({**self.root_attributes, **json.loads(json.dumps(values))})
        arrays = array_documents(self.spec.members(self.samples))
        self.files.write([(f"{SPARE}/{DOCUMENT}", to_bytes(group_document(self.root_attributes)))])
        self.files.write([(DOCUMENT, to_bytes(group_document(self.root_attributes, arrays)))])

    def read(self, name: str, start: int = 0, stop: int | None = None) -> NDArray[Any]:
        """Return samples `start` to `stop` - 1 of an array; samples that are not built yet have the fill value.

        Raises VbnfaultError if the samples cannot be decoded, or if the file of a finished one is missing.
        """
        stop = self.samples if stop is None else stop
        row = self.spec.arrays[name]
        dtype = object if row.is_text else row.dtype
        values = np.full((max(0, stop - start), *self._shape(name)), row.fill, dtype=dtype)
        for number in range(start // self.spec.shard_samples, -(-stop // self.spec.shard_samples)):
            wanted = [i for i in self.shard(number) if start <= i < stop]
            why = ""
            try:
                for i, value in self._values(name, number, wanted).items():
                    values[i - start] = value
            except FileNotFoundError:
                lost = [i for i in wanted if name != "done" and self.done(number)[i]]
                if lost:
                    wanted, why = lost, f": the file {self.file_name(name, number)} is missing"
            except (OSError, ValueError) as error:
                why = f" ({error})"
            if why:
                raise VbnfaultError(
                    f"{self.path}: {name} of {_samples(wanted[0], wanted[-1] + 1)} cannot be read{why}; the build "
                    "command repairs it"
                )
        return values

    def _values(self, name: str, number: int, samples: Collection[int]) -> dict[int, Any]:
        """Return the values of samples of a shard. Raises OSError or ValueError if they cannot be read."""
        if name not in self.spec.pixel_layers:
            column, first = self.column(name, number), self.shard(number).start
            return {i: column[i - first] for i in samples}
        return {i: self.decoded(name, chunk) for i, chunk in self.chunk(name, number, samples).items()}

    def decoded(self, name: str, chunk: bytes) -> NDArray[Any]:
        """Return a layer of a sample from its chunk. Raises ValueError if that is damaged."""
        layer = np.empty(self._shape(name), dtype=self.spec.pixel_layers[name].dtype)
        if layer.size:
            compressor(self.spec.codecs[name]).decode_into(chunk, layer)
        return layer

    def read_sample(self, index: int, layers: Collection[str] | None = None) -> Sample:
        """Return one sample, compared with its checksums; with `layers`, only these of its layers.

        If the sample is being rewritten, the result is the old or the new version, never a mixture. Raises
        InputError if the sample does not exist or is not finished, VbnfaultError if it is damaged.
        """
        if not 0 <= index < self.samples:
            raise InputError(f"{self.path}: sample {index} does not exist; the range is 0 to {self.samples - 1}")
        chosen = [name for name in self.spec.pixel_layers if layers is None or name in layers]
        compared = [k for k, name in enumerate(self.spec.checked) if name in chosen or name not in self.spec.arrays]
        file = self.file_name("done", index // self.spec.shard_samples)
        problem: VbnfaultError | None = None
        wrong: list[str] = []
        mismatches = 0
        while mismatches < _READS:
            stamp = self.files.stamp(file)
            if not self.read("done", index, index + 1)[0]:
                raise InputError(f"{self.path}: sample {index} is not finished yet; the build command resumes")
            problem = None
            try:
                crcs = self.read("crc32c", index, index + 1)[0].tolist()
                arrays = {name: self.read(name, index, index + 1)[0] for name in chosen}
                scalars = self._scalars(index)
            except VbnfaultError as error:  # as if damaged, where a file was replaced between two reads of it
                problem = error
            else:
                crcs_of_layers = [crc32c(layer) if layer.size else 0 for layer in arrays.values()]
                stored = [crcs[k] for k in compared]
                found = dict(zip((*chosen, "scalars"), [*crcs_of_layers, crc_of_scalars(scalars)], strict=True))
                wrong = [name for (name, crc), other in zip(found.items(), stored, strict=True) if crc != other]
                if not wrong:
                    return Sample(index=index, layers=arrays, scalars=scalars)
            # a process that rewrites the sample replaces the file of `done` first
            mismatches += self.files.stamp(file) == stamp
        raise problem or VbnfaultError(
            f"{self.path}: sample {index} does not match the stored crc32c of {' and '.join(wrong)}; the build "
            "command repairs it"
        )

    def _scalars(self, index: int) -> dict[str, Any]:
        """Return the scalars of a sample. Raises VbnfaultError if they cannot be decoded.

        Their small files are read directly: through zarr, the 45 of them would take longer than an image.
        """
        number = index // self.spec.shard_samples
        scalars: dict[str, Any] = {}
        rows = self.spec.scalars
        for (name, row), column in zip(rows.items(), self.columns(rows, number), strict=True):
            if isinstance(column, Exception):
                raise VbnfaultError(
                    f"{self.path}: {name} of sample {index} cannot be read ({column}); the build command repairs it"
                ) from column
            value = column[index - self.shard(number).start]
            scalars[name] = str(value) if row.is_text else value
        return scalars

    def columns(self, names: Iterable[str], number: int) -> Iterator[NDArray[Any] | OSError | ValueError]:
        """Yield several scalars for all samples of a shard, or why one cannot be read, in the order of `names`."""
        wanted = list(names)
        stored = [name for name in wanted if 0 not in self._shape(name)]
        files = [(self.file_name(n, number), self.most_bytes(n)) for n in stored]
        contents = dict(zip(stored, self.files.read_each(files), strict=True))
        for name in wanted:
            content = contents.get(name, b"")
            if isinstance(content, OSError):
                yield content
                continue
            try:
                yield self._column(name, number, content)
            except ValueError as error:
                yield error

    def column(self, name: str, number: int) -> NDArray[Any]:
        """Return a scalar for all samples of a shard. Raises OSError or ValueError if its chunk is damaged."""
        content = b"" if 0 in self._shape(name) else self._content(name, number)
        return self._column(name, number, content)

    def _column(self, name: str, number: int, content: bytes) -> NDArray[Any]:
        """Return a scalar for all samples of a shard from its chunk file. Raises ValueError if that is damaged."""
        row, shape = self.spec.arrays[name], self._shape(name)
        samples = len(self.shard(number))
        if 0 in shape:
            return np.zeros((samples, *shape), dtype=row.dtype)
        values = decode_values(content, row.dtype, self._column_size(name))
        if name == "split" and not {"", *SPLITS} >= {*values.tolist()}:  # they become names of folders and files
            raise ValueError(f"a split is none of {', '.join(SPLITS)}")
        return values.reshape(self.spec.shard_samples, *shape)[:samples]

    def _shape(self, name: str) -> tuple[int, ...]:
        """Return the shape of one sample of an array; a large store asks for it a hundred thousand times."""
        if name not in self._shapes:
            self._shapes[name] = self.spec.shape(self.spec.arrays[name])
        return self._shapes[name]

    def _column_bytes(self, name: str, number: int, values: Mapping[int, Any]) -> bytes:
        """Return the chunk file of a scalar of a shard; samples without a value get the fill value."""
        row, first = self.spec.arrays[name], self.shard(number).start
        dtype = object if row.is_text else row.dtype
        column = np.full((self.spec.shard_samples, *self.spec.shape(row)), row.fill, dtype=dtype)
        for i, value in values.items():
            column[i - first] = value
        return encode_values(column)

    def done(self, number: int) -> dict[int, bool]:
        """Return by sample whether it is finished; False for all of the shard if that cannot be read."""
        samples = self.shard(number)
        try:
            return dict(zip(samples, self.column("done", number).astype(bool).tolist(), strict=True))
        except (OSError, ValueError):
            return dict.fromkeys(samples, False)

    def begun(self) -> list[int]:
        """Return the shards that have files, in ascending order; no sample of any other shard is built yet."""
        listed = {*self.files.names("done/c"), *self.files.names("image/c")}
        numbers = {int(name) for name in listed if name.isascii() and name.isdecimal()}
        return sorted(n for n in numbers if n < self.shards)

    def finished(self) -> int:
        """Return how many samples are marked as finished in `done`."""
        return sum(count for _, count in self._counts())

    def why_none_is_finished(self) -> str:
        """Return a clause that says why no sample is finished: none is yet, or nothing marks those that are."""
        if self.lacks_done():
            return "the array done, which marks the finished samples, is missing"
        return "no sample is finished yet"

    def lacks_done(self) -> bool:
        """Return whether the array that marks the finished samples is missing."""
        return not self.files.exists(f"done/{DOCUMENT}")

    def whole_shards(self) -> set[int]:
        """Return the shards whose samples are all marked as finished in `done`."""
        return {number for number, count in self._counts() if count == len(self.shard(number))}

    def _counts(self) -> Iterator[tuple[int, int]]:
        """Yield each shard that has files, and how many of its samples are marked as finished in `done`."""
        full = self.samples // self.spec.shard_samples
        counts: dict[bytes, int] = {}  # most files have the same content, so each content is decoded once
        for number in self.begun():
            try:
                data = self._content("done", number)
                if data not in counts or number >= full:
                    counts[data] = sum(self.done(number).values())
            except OSError:
                continue
            yield number, counts[data]

    def file_name(self, name: str, number: int) -> str:
        """Return the name, relative to the store, of the file that holds an array's values for one shard."""
        return f"{name}/c/{number}{'/0' * len(self._shape(name))}"

    def table(self, index: int, name: str, text: object) -> dict[str, Any]:
        """Return the table in the scalar `parameters` or `proposal` of a sample. Raises VbnfaultError."""
        try:
            return drawn_table(text)
        except ValueError:
            raise VbnfaultError(
                f"{self.path}: sample {index}: its {name} are damaged, they are no table in JSON; "
                "the build command repairs them"
            ) from None

    def drawn(self, samples: Iterable[int] | NDArray[np.int64]) -> Iterator[dict[str, Any]]:
        """Yield the drawn parameters of each sample, by fault. Raises VbnfaultError, as `read` and `table` do."""
        texts = self.read("parameters")
        return (self.table(int(i), "parameters", texts[i]) for i in samples)

    def most_bytes(self, name: str) -> int:
        """Return the most bytes that the file of an array for one shard may have."""
        if name in self.spec.pixel_layers:
            size = self.spec.shard_samples
            return size * most_compressed(self.spec.layer_bytes(name)) + index_size(size)
        return most_compressed(self._column_size(name))

    def _column_size(self, name: str) -> int:
        """Return the most bytes that a scalar of a shard may have, before it is compressed."""
        row, samples = self.spec.arrays[name], self.spec.shard_samples
        if row.is_text:  # behind the number of texts, the length of each in front of it
            return 4 + samples * (4 + row.most_bytes)
        return samples * math.prod(self._shape(name)) * np.dtype(row.dtype).itemsize

    def _content(self, name: str, number: int) -> bytes:
        """Return the file of an array for one shard."""
        return self.files.read(self.file_name(name, number), self.most_bytes(name))

    def file(self, name: str, number: int) -> Any:
        """Return the path or the URL of the file that holds an array's values for one shard."""
        return self.path / self.file_name(name, number)

    def chunk(self, name: str, number: int, samples: Collection[int] | None = None) -> dict[int, bytes]:
        """Return the compressed chunks of a layer's shard by sample; with `samples`, read only those of the file.

        Raises ValueError or OSError if the file is damaged or missing.
        """
        size, first = self.spec.shard_samples, number * self.spec.shard_samples
        if self.spec.empty(name):
            return dict.fromkeys(self.shard(number) if samples is None else samples, b"")
        if samples is None:
            chunks = split_shard(self._content(name, number), size)
            return {first + i: chunk for i, chunk in chunks.items()}
        wanted: dict[int, tuple[int, int]] = {}

        def choose(tail: bytes) -> list[tuple[int, int]]:
            ranges, most_bytes = chunk_ranges(tail, size), most_compressed(self.spec.layer_bytes(name))
            wanted.update({i: ranges[i - first] for i in samples if i - first in ranges})
            if any(length > most_bytes for _, length in wanted.values()):
                raise ValueError(f"its index names a chunk of more than {most_bytes} bytes")
            return _joined(wanted.values())

        parts = self.files.read_parts(self.file_name(name, number), index_size(size), choose)
        return {
            i: data[start - begin : start - begin + length]
            for i, (start, length) in wanted.items()
            for begin, data in parts
            if begin <= start and start + length <= begin + len(data)
        }

    def write_shard(self, number: int, given: Mapping[int, Encoded], damaged: Collection[int] = ()) -> set[int]:
        """Write a shard: the `given` samples, and unchanged those that were finished before.

        `damaged` samples are not kept. `done` is written last.

        Returns
        -------
        set of int
            Samples that were marked as finished, but could not be kept because their files are damaged.

        Raises
        ------
        VbnfaultError
            The files cannot be written.
        """
        samples = self.shard(number)
        others = {i for i in samples if i not in given and i not in damaged}
        with disk.explained(self.path, f"writing samples {samples.start}-{samples.stop - 1}"):
            finished = self._finished(number, strict=bool(others))
            wished = finished & others
            if finished - wished:
                self._write_done(number, wished)
            kept, chunks, columns = self._kept(number, wished)
            self.files.write(self._shard_files(number, given, kept, chunks, columns))
            self._write_done(number, {*given, *kept})
        return wished - kept

    def copy_shard(self, number: int, source: Store, finished: Collection[int], *, link: bool = False) -> None:
        """Copy the files of a shard from another store of the same schema; `done` is written last.

        Parameters
        ----------
        finished
            The samples that are finished then: those that were so in `source` before this call.
        link
            Give the files a second name here, where the file system can, so that no byte is copied.

        Raises
        ------
        VbnfaultError
            The files cannot be read or written.
        """
        samples = self.shard(number)
        with disk.explained(self.path, f"copying samples {samples.start}-{samples.stop - 1} from {source.path}"):
            if any(self.done(number).values()):
                self._write_done(number, set())
            names = [name for name in self.spec.arrays if name != "done" and not self.spec.empty(name)]
            files = [self.file_name(name, number) for name in names]
            self.files.write(
                (file, source.files.copied(file, source.most_bytes(name), link=link))
                for name, file in zip(names, files, strict=True)
            )
            self._write_done(number, set(finished))

    def remove_shard(self, number: int) -> None:
        """Remove the files of a shard, `done` first, so that its samples are not finished any more."""
        samples = self.shard(number)
        with disk.explained(self.path, f"removing samples {samples.start}-{samples.stop - 1}"):
            self.files.remove([self.file_name("done", number)])
            self.files.remove([self.file_name(name, number) for name in self.spec.arrays])

    def encoded(self, number: int, samples: Collection[int], codecs: Mapping[str, str]) -> dict[int, Encoded]:
        """Return some samples of a shard for `write_shard` of another store with these codecs; no digest is set.

        Raises OSError or ValueError if their files are damaged.
        """
        first = self.shard(number).start
        chunks = {name: self._recoded(name, number, samples, codecs[name]) for name in self.spec.pixel_layers}
        columns = {name: self.column(name, number) for name in (*self.spec.scalars, "crc32c")}
        return {
            i: Encoded(
                index=i,
                chunks={name: chunks[name][i] for name in chunks},
                scalars={name: columns[name][i - first] for name in self.spec.scalars},
                crc32c=columns["crc32c"][i - first],
                digest=b"",
            )
            for i in samples
        }

    def _recoded(self, name: str, number: int, samples: Collection[int], codec: str) -> dict[int, bytes]:
        """Return the chunks of a layer of samples, compressed again if the codec is another one."""
        chunks = self.chunk(name, number, samples)
        if codec == self.spec.codecs[name] or self.spec.empty(name):
            return chunks
        with ThreadPoolExecutor(threads()) as pool:
            recoded = pool.map(lambda chunk: compressor(codec).encode(self.decoded(name, chunk)), chunks.values())
            return dict(zip(chunks, recoded, strict=True))

    def _finished(self, number: int, *, strict: bool) -> set[int]:
        """Return the samples of a shard that are marked as finished in `done`.

        If that file is missing, there are none. If it is damaged: none if `strict`, otherwise all. If the system
        does not let us read it just now: OSError if `strict`, because finished samples could get lost; otherwise
        all.
        """
        samples = self.shard(number)
        try:
            column = self.column("done", number).astype(bool)
        except FileNotFoundError:
            return set()
        except _DAMAGE:
            return set() if strict else set(samples)
        except OSError:
            if strict:
                raise
            return set(samples)
        return {i for i, done in zip(samples, column.tolist(), strict=True) if done}

    def _write_done(self, number: int, finished: set[int]) -> None:
        """Mark exactly the `finished` samples of a shard as finished."""
        data = self._column_bytes("done", number, {i: i in finished for i in self.shard(number)})
        self.files.write([(self.file_name("done", number), data)])

    def _kept(
        self, number: int, wished: set[int]
    ) -> tuple[set[int], dict[str, dict[int, bytes]], dict[str, NDArray[Any]]]:
        """Return which of the `wished` samples can be kept, their chunks by layer, and the shard's scalars."""
        chunks: dict[str, dict[int, bytes]] = {}
        columns: dict[str, NDArray[Any]] = {}
        try:
            for name in (*self.spec.scalars, "crc32c") if wished else ():
                columns[name] = self.column(name, number)
            for name in self.spec.pixel_layers if wished else ():
                chunks[name] = self.chunk(name, number)
                wished = wished & set(chunks[name])
        except _DAMAGE:
            return set(), {}, {}
        return wished, chunks, columns

    def _shard_files(
        self,
        number: int,
        given: Mapping[int, Encoded],
        kept: set[int],
        chunks: Mapping[str, Mapping[int, bytes]],
        columns: Mapping[str, NDArray[Any]],
    ) -> Iterator[tuple[str, bytes]]:
        """Yield the name and content of every file of a shard except `done`."""
        first = self.shard(number).start
        for name in self.spec.pixel_layers:
            if not self.spec.empty(name):
                held = {i: e.chunks[name] for i, e in given.items()} | {i: chunks[name][i] for i in kept}
                shard = join_shard({i - first: chunk for i, chunk in held.items()}, self.spec.shard_samples)
                yield self.file_name(name, number), shard
        for name in (*self.spec.scalars, "crc32c"):
            if not self.spec.empty(name):
                values = {i: e.crc32c if name == "crc32c" else e.scalars[name] for i, e in given.items()}
                values |= {i: columns[name][i - first] for i in kept}
                yield self.file_name(name, number), self._column_bytes(name, number, values)


def _joined(ranges: Iterable[tuple[int, int]]) -> list[tuple[int, int]]:
    """Return start and length of ranges of bytes, in ascending order; ranges that touch become one."""
    joined: list[tuple[int, int]] = []
    for start, length in sorted(set(ranges)):
        if joined and sum(joined[-1]) == start:
            joined[-1] = joined[-1][0], joined[-1][1] + length
        else:
            joined.append((start, length))
    return joined


def _samples(start: int, stop: int) -> str:
    """Return how a message names the samples from `start` to `stop` - 1: "sample 3" or "samples 3-5"."""
    return f"sample {start}" if stop == start + 1 else f"samples {start}-{stop - 1}"
