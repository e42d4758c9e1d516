"""Create and open the Zarr group on disk: its root, and the copy of the root's attributes in `spare`."""

from __future__ import annotations

import json
import logging
import os
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from ..core.errors import InputError, VbnfaultError
from ..core.files.path_checks import real
from ..core.files.whole_files import kind_of
from ..core.quantities import Sample
from .bucket import Files, Location, Url, files_of, located
from .codec import Encoded, encode
from .layout import (
    CHECKSUM,
    DOCUMENT,
    SPARE,
    array_documents,
    canonical,
    check_depth,
    coordinate_chunks,
    encode_values,
    group_document,
    is_sealed,
    root_attributes,
    to_bytes,
)
from .opened import Store
from .schema import FORMAT_VERSION, StoreSpec

if TYPE_CHECKING:
    import xarray

# --- create, open, write ----------------------------------------------------------------------------------


def create(path: str | os.PathLike[str] | Url, spec: StoreSpec, samples: int, *, overwrite: bool = False) -> Store:
    """Create a store of `samples` unfinished samples and open it for writing.

    The store appears under its name only after all its files are written. `overwrite` replaces an existing store;
    a folder that holds anything else is never replaced. The caller holds the lock of the store. Raises
    InputError if the path cannot be used.
    """
    target = located(path)
    files = files_of(target)
    if samples < 1:
        raise InputError(f"samples = {samples}: must be at least 1")
    old = is_store(target)
    if old and not overwrite:
        raise InputError(f"{target}: exists already; resume it, or give --overwrite to replace it")
    if not old or (isinstance(target, Path) and target.is_symlink()):
        check_free(target, spec, samples)
    try:
        files.create(group_files(spec, samples), old=old)
    except OSError as error:
        raise kind_of(error)(f"{target}: no store can be created here: {error.strerror or error}") from error
    return open_store(target, "r+")


def check_free(path: str | os.PathLike[str] | Url, spec: StoreSpec, samples: int) -> None:
    """Raise InputError if no store can be created at a path because of what lies there, or around it."""
    target = located(path)
    names = (name for name, _ in group_files(spec, samples))
    if why := files_of(target).why_occupied(names) or _why_within(target):
        raise InputError(f"{target}: {why}")


def _why_within(target: Location) -> str:
    """Return why no store can be created at a path within another one, as a clause; "" if it is not within one."""
    folders = () if isinstance(target, Url) else real(target).parents
    above = [path for path in folders if read_root(files_of(path)) is not None]
    return f"lies in the store {above[0]}, and would be lost with it; choose another --out" if above else ""


def group_files(spec: StoreSpec, samples: int) -> Iterator[tuple[str, bytes]]:
    """Yield the name and content of every file of an empty store, the root last."""
    members, attributes = spec.members(samples), root_attributes(spec, samples)
    arrays = array_documents(members)
    for name, member in members.items():
        yield f"{name}/{DOCUMENT}", to_bytes(arrays[name])
        for chunk, values in coordinate_chunks(member):
            yield f"{name}/{chunk}", encode_values(values)
    yield f"{SPARE}/{DOCUMENT}", to_bytes(group_document(attributes))
    yield DOCUMENT, to_bytes(group_document(attributes, arrays))


# --- the root and its spare --------------------------------------------------------------------------------


class Root(NamedTuple):
    """Hold the root attributes of a store, and one sentence for each problem of the files that hold them.

    `damage` needs a repair. `unfinished` is also what a reader sees while another process changes the attributes.
    """

    attributes: dict[str, Any]
    damage: tuple[str, ...] = ()
    unfinished: tuple[str, ...] = ()

    @property
    def problems(self) -> tuple[str, ...]:
        """Return the sentences of both kinds."""
        return self.damage + self.unfinished


# The root of a store whose million samples have names of ten letters takes 22 MB and a million values. A list or a
# table of JSON takes some 100 bytes of memory, so that values are limited as well.
MOST_DOCUMENT_BYTES = 1 << 27
_MOST_VALUES = 4_000_000


def read_document(files: Files, name: str) -> dict[str, Any] | None:
    """Return the JSON object in a file; None if it is missing, unreadable, too large or not a JSON object."""
    try:
        content = files.read(name, MOST_DOCUMENT_BYTES)
        if sum(map(content.count, b",[{")) > _MOST_VALUES:
            return None
        check_depth(text := content.decode())
        document = json.loads(text)
    except (OSError, ValueError, RecursionError):
        return None
    return document if isinstance(document, dict) else None


def _attributes_in(document: dict[str, Any] | None) -> dict[str, Any] | None:
    """Return the root attributes in a group's document, with or without a valid checksum; None if it has none."""
    attributes = (document or {}).get("attributes")
    return attributes if isinstance(attributes, dict) and attributes.get("format") == "vbnfault" else None


def read_root(files: Files) -> Root | None:
    """Return the root attributes of a store; None if no copy of them is valid.

    If the copy in `spare` is valid, it is used: it is written before the root, so it is never older. Each file is
    read once and the root first, so that a change by another process makes the root look older, never damaged.
    """
    spare = f"{SPARE}/{DOCUMENT}"
    documents = {name: read_document(files, name) for name in (DOCUMENT, spare)}
    attributes = {name: _attributes_in(document) for name, document in documents.items()}
    whole = {name: value for name, value in attributes.items() if value is not None and is_sealed(value)}
    # the checksum is that of the attributes; `metadata_problems` compares the rest of the root's document
    if spare in whole and canonical(documents[spare]) != canonical(group_document(whole[spare])):
        del whole[spare]
    if not whole:
        # a store made before checksums existed
        root = attributes[DOCUMENT]
        if root is None or CHECKSUM in root or files.names(SPARE):
            return None
        return Root(root, damage=(f"{DOCUMENT} has no checksum and no spare copy",))
    damage = tuple(
        f"{name} is {'damaged' if files.exists(name) else 'missing'}; {other} has the same attributes"
        for name, other in ((DOCUMENT, spare), (spare, DOCUMENT))
        if name not in whole
    )
    unfinished: tuple[str, ...] = ()
    if len(whole) == 2 and len({value[CHECKSUM] for value in whole.values()}) == 2:
        unfinished = (f"{DOCUMENT} is older than {spare}: a change of the attributes was interrupted",)
    return Root(whole.get(spare) or whole[DOCUMENT], damage, unfinished)


def is_store(path: str | os.PathLike[str] | Url) -> bool:
    """Return whether there is a vbnfault store at this path or URL."""
    return read_root(files_of(located(path))) is not None


def open_store(path: str | os.PathLike[str] | Url | Store, mode: str = "r") -> Store:
    """Open a store for reading (`r`) or writing (`r+`).

    If its root is damaged, the copy in `spare` is used. Mode `r` warns if either of them is damaged; that the root
    is older than the copy is no damage, since another process may be changing it now. An open `Store` is returned
    as it is.
    Raises InputError if the path holds no store, or a store of another format version.
    """
    if isinstance(path, Store):
        return path
    path = located(path)
    files = files_of(path)
    root = read_root(files)
    if root is None:
        raise InputError(f"{path}: {_why_no_store(files)}")
    _check_format(path, root.attributes.get("format_version"))
    try:
        store = Store(files, root.attributes)
    except InputError as error:
        raise InputError(f"{path}: {_NO_STORE}: {error}") from error
    except (KeyError, TypeError, ValueError, VbnfaultError) as error:
        raise InputError(f"{path}: {_NO_STORE}") from error
    if mode == "r":
        for problem in root.damage:
            logging.getLogger("vbnfault").warning(f"{path}: {problem}; the build command mends it")
    return store


_NO_STORE = "is no vbnfault store: its root attributes are not those of one"


def _check_format(path: Location, version: Any) -> None:
    """Raise InputError if a store has another format version; its sentence says what to do with the store."""
    if type(version) is not int or version < 1:
        raise InputError(f"{path}: {_NO_STORE}")
    if version > FORMAT_VERSION:
        raise InputError(
            f"{path}: format_version = {version}: this vbnfault reads up to {FORMAT_VERSION}; install a newer one"
        )
    if version < FORMAT_VERSION:
        raise InputError(
            f"{path}: format_version = {version}: an earlier vbnfault made it, and this one reads "
            f"{FORMAT_VERSION}; open it with xarray, complete it with vbnfault 0.1, or build it again with another "
            "--out or --overwrite"
        )


def _why_no_store(files: Files) -> str:
    """Return why there is no store, as a clause."""
    if not files.exists(""):
        return "no such store"
    if files.exists(f"{SPARE}/{DOCUMENT}"):
        return (
            f"{DOCUMENT} and its copy {SPARE}/{DOCUMENT} are both damaged; put a copy of either in its place, "
            "or choose another --out"
        )
    return "is no vbnfault store"


def open_dataset(path: str | os.PathLike[str] | Url) -> xarray.Dataset:
    """Return a store as an `xarray.Dataset` with named dimensions, units and coordinates.

    Arrays are read when they are used, a sample of a layer at a time. README and the reference list them.

    Raises
    ------
    InputError
        If there is no store at `path`, one of another format, or one that this user may not read.
    """
    import xarray  # it takes longer to load than all the rest

    store = open_store(path)
    try:
        return xarray.open_zarr(store.files.zarr(), chunks=None, zarr_format=3)
    except Exception as error:
        failure = store.files.failure(error, "")
        if failure is None:
            raise
        raise failure from error


def write_samples(store: str | os.PathLike[str] | Url | Store, samples: Iterable[Sample | Encoded]) -> None:
    """Write samples into their shards; the other samples of those shards stay bit-identical.

    Only one process may write to a shard at a time. Raises ValueError for a sample that does not fit the schema or
    the store, VbnfaultError if the files cannot be written.
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
