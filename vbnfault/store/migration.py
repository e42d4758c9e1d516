"""Bring stores of the format before to the current one: in place, or as a copy with the codecs of today.

In place only metadata and coordinates are rewritten, in the order in which `append_samples` does it: the arrays,
then `spare`, then the root. A kill before `spare` is written leaves a store of the old format, a later one a store
of the new format whose root is older than its copy; both open, and the same call completes the change. A copy is
made in a hidden folder beside its final name, shard by shard, each with `done` last; the same call continues it.
Every shard is compared with its checksums before it is copied.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

from ..core.errors import InputError, VbnfaultError
from ..core.path_checks import real
from ..core.whole_files import remove
from . import disk
from .arrays import SCALARS
from .bucket import Url
from .check import check_shard
from .codec import join_shard, threads
from .compressors import compressor
from .files import files_of, located
from .formats import FORMAT_VERSION
from .group import group_files, open_store, read_root
from .layout import root_attributes
from .metadata import bring_to
from .opened import Store
from .schema import StoreSpec

_REPAIR = "the build command repairs it, then migrate again"


def migrate(path: str | os.PathLike[str] | Url) -> Store:
    """Bring a store to the current format, in place, and open it for writing; layers keep their codecs.

    No other process may write to it meanwhile. Raises InputError if the path holds no store that this vbnfault
    reads, VbnfaultError if the files cannot be written.
    """
    store = open_store(path, "r+")
    spec = replace(store.spec, format_version=FORMAT_VERSION)
    with disk.explained(store.path, "migrating the store"):
        store.files.remove_leftovers()
        bring_to(store, {**store.root_attributes, **root_attributes(spec, store.samples)})
    return open_store(path, "r+")


def migrate_copy(
    source: Store, target: str | os.PathLike[str], *, progress: Callable[[int], None] | None = None
) -> Store:
    """Copy a store in the current format, with the codecs that new stores have, and open the copy.

    The samples have the same values and the copy the same digest. Unfinished samples stay unfinished. No other
    process may write to either store meanwhile. `progress` is called with numbers of samples just copied.

    Raises
    ------
    InputError
        If the target exists already, or lies in the source.
    VbnfaultError
        If the source is damaged or the files cannot be written; the same call continues.
    """
    target = check_target(source, target).absolute()
    spec = replace(source.spec, format_version=FORMAT_VERSION, codecs={})
    hidden = target.with_name(f".{target.name}.migrate{disk.PARTIAL}")
    with disk.explained(target, "copying the store"):
        target.parent.mkdir(parents=True, exist_ok=True)
        begun = None if hidden.is_symlink() else read_root(files_of(hidden))
        if begun is None or begun.attributes != root_attributes(spec, source.samples):
            remove(hidden)
            hidden.mkdir()
            disk.write(hidden, group_files(spec, source.samples))
        disk.remove_partials(hidden)
        for number in source.begun():
            _copy_shard(source, spec, number, hidden)
            if progress:
                progress(len(source.shard(number)))
        if target.is_dir():
            target.rmdir()
        disk.rename(hidden, target)
    return open_store(target)


def check_target(source: Store, target: str | os.PathLike[str]) -> Path:
    """Return the path to which a store can be copied. Raises InputError for any other."""
    path = located(target)
    if isinstance(path, Url):
        raise InputError(f"{path}: a copy is made on a disk; give a path, and copy its files to the object store")
    if isinstance(source.path, Path):
        inside, outside = real(source.path), real(path)
        if inside == outside or inside in outside.parents:
            raise InputError(f"{target}: lies in the store that is migrated; choose another --out")
    if path.is_symlink() or (path.exists() and (not path.is_dir() or any(path.iterdir()))):
        raise InputError(f"{target}: exists already, so it is left alone; choose another --out")
    return path


def _copy_shard(source: Store, spec: StoreSpec, number: int, hidden: Path) -> None:
    """Copy one shard into the hidden folder, unless it was copied before."""
    name = source.file_name("done", number)
    try:
        done = source.files.read(name, source.most_bytes("done"))
    except FileNotFoundError:
        return  # no sample of it is finished
    except OSError as error:
        raise _damaged(source, name, error) from error
    try:
        if disk.read(hidden / name, len(done)) == done:
            return
    except OSError:
        pass
    for problem in check_shard(source, number):
        if not problem.unfinished:
            raise VbnfaultError(f"{source.path}: {problem.sentence}; {_REPAIR}")
    disk.write(hidden, _shard_files(source, spec, number))
    disk.write(hidden, [(name, done)])


def _shard_files(source: Store, spec: StoreSpec, number: int) -> Iterator[tuple[str, bytes]]:
    """Yield the name and content of every file of a copied shard except `done`."""
    for name in (*spec.pixel_layers, *SCALARS, "crc32c"):
        if spec.empty(name):
            continue
        file = source.file_name(name, number)
        try:
            is_same = source.spec.codecs.get(name) == spec.codecs.get(name)
            yield (
                file,
                source.files.read(file, source.most_bytes(name))
                if is_same
                else _recoded(source, spec, name, number),
            )
        except (FileNotFoundError, ValueError, disk.Misplaced) as error:
            raise _damaged(source, file, error) from error


def _recoded(source: Store, spec: StoreSpec, name: str, number: int) -> bytes:
    """Return a layer's shard file with the chunks compressed by the codec of `spec`."""
    old, new = compressor(source.spec.codecs[name]), compressor(spec.codecs[name])
    chunks = source.chunk(name, number)
    with ThreadPoolExecutor(threads()) as pool:
        size = spec.layer_bytes(name)
        recoded = pool.map(lambda chunk: new.encode(old.decode(chunk, size)), chunks.values())
        first = source.shard(number).start
        return join_shard({i - first: chunk for i, chunk in zip(chunks, recoded, strict=True)}, spec.shard_samples)


def _damaged(source: Store, file: str, error: Exception) -> VbnfaultError:
    """Return the error for a file of the source that cannot be copied."""
    why = "is missing" if isinstance(error, FileNotFoundError) else f"is damaged ({error})"
    return VbnfaultError(f"{source.path}: {file} {why}; {_REPAIR}")
