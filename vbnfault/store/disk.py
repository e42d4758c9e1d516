"""Whole files, durably: every operation of a store on the file system goes through here.

A batch of files is written beside the final names (`*.partial`), flushed to the device with fsync, renamed, and
the folders are flushed: after a loss of power each file is either the old or the new one, and what is written after
a batch is never on the device before it (Pillai et al. 2014, "All file systems are not created equal", OSDI).
"""

from __future__ import annotations

import contextlib
import errno
import os
import stat
import uuid
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TypeVar

from ..core.errors import VbnfaultError

PARTIAL = ".partial"
# at once: of the 42 files and 90 folders of a shard, on ext4, one after the other take 45-600 ms, eight 15-35 ms
_FLUSHES = 8
T = TypeVar("T")
_UNSUPPORTED = (errno.EINVAL, errno.ENOTSUP)  # what file systems answer that cannot flush a folder


class Misplaced(OSError):
    """Something else has the name of a file: a folder, a link, a pipe."""


@contextlib.contextmanager
def explained(path: Path, doing: str) -> Iterator[None]:
    """Turn what the operating system refuses into one sentence; what was finished stays as it is."""
    try:
        yield
    except OSError as error:
        raise VbnfaultError(
            f"{path}: {error.strerror or error} while {doing}; finished samples stay, "
            f"and the same command resumes once that is mended"
        ) from error


def read(path: Path) -> bytes:
    """Return the content of a regular file.

    Raises
    ------
    Misplaced
        Something else has its name.
    OSError
        The system refuses.
    """
    # O_NONBLOCK: opening a pipe would wait for a writer
    flags = os.O_RDONLY | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0)
    try:
        file = os.open(path, flags)
    except OSError as error:
        if error.errno == errno.ELOOP:
            raise Misplaced(errno.ELOOP, "it is a link, not a file", str(path)) from error
        raise
    try:
        status = os.fstat(file)
        if not stat.S_ISREG(status.st_mode):
            raise Misplaced(errno.EISDIR, "it is not a regular file", str(path))
        parts = []
        while part := os.read(file, 1 << 30):
            parts.append(part)
    finally:
        os.close(file)
    return parts[0] if len(parts) == 1 else b"".join(parts)


def names(folder: Path) -> list[str]:
    """Return the names in a folder, none where there is no such folder."""
    try:
        return os.listdir(folder)
    except (FileNotFoundError, NotADirectoryError):
        return []


def write(root: Path, files: Iterable[tuple[str, bytes]]) -> None:
    """Replace files durably, as one batch; each is the old or the whole new one at any moment.

    Whatever else has the name of a file or of its folder below `root` makes way: a folder, a link, a pipe.

    Parameters
    ----------
    root
        An existing folder.
    files
        Name relative to `root`, with `/`, and content. Taken one at a time: only one content is held.

    Raises
    ------
    OSError
        The system refuses. Each file is then the old or the new one; unfinished ones are removed.
    """
    written: list[tuple[Path, Path]] = []
    opened: list[int] = []
    changed: dict[Path, None] = {}  # folders, in order
    try:
        for name, content in files:
            target = root / name
            _make_folders(root, target.parent, changed)
            changed[target.parent] = None
            partial = target.with_name(f"{target.name}.{uuid.uuid4().hex}{PARTIAL}")
            written.append((partial, target))
            flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | getattr(os, "O_BINARY", 0)
            opened.append(os.open(partial, flags, 0o666))
            _write_all(opened[-1], content)
        if not written:
            return
        _at_once(_flush, opened)
        while opened:
            os.close(opened.pop())
        for partial, target in written:
            _make_way(target)
            os.replace(partial, target)
        _at_once(flush_folder, changed)
    except BaseException:
        for file in opened:
            with contextlib.suppress(OSError):
                os.close(file)
        for partial, _ in written:
            with contextlib.suppress(OSError):
                os.unlink(partial)
        raise


def _at_once(flush: Callable[[T], None], items: Iterable[T]) -> None:
    """Flush many files or folders in parallel: file systems with a journal commit it once for those that wait."""
    with ThreadPoolExecutor(_FLUSHES) as pool:
        for _ in pool.map(flush, items):
            pass


def _write_all(file: int, content: bytes) -> None:
    rest = memoryview(content)
    while rest:
        count = os.write(file, rest)
        if count == 0:
            raise OSError(errno.EIO, os.strerror(errno.EIO))
        rest = rest[count:]


def _make_folders(root: Path, folder: Path, changed: dict[Path, None]) -> None:
    """Make a folder and those above it, up to `root`; note whose entries changed."""
    if folder == root or folder in changed:
        return
    try:
        is_folder = stat.S_ISDIR(os.stat(folder).st_mode)  # of a link: where it leads
    except OSError:  # there is none, or a file among those above
        is_folder = False
    if is_folder:
        return
    _make_folders(root, folder.parent, changed)
    try:
        with contextlib.suppress(FileNotFoundError):
            os.unlink(folder)
        os.mkdir(folder)
    except OSError:
        if not folder.is_dir():  # else another worker has just made it
            raise
    changed[folder.parent] = changed[folder] = None


def _make_way(target: Path) -> None:
    """Remove a folder that has the name of a file."""
    try:
        in_the_way = stat.S_ISDIR(os.lstat(target).st_mode)
    except FileNotFoundError:
        return
    if in_the_way:
        remove_tree(target)


def _flush(file: int) -> None:
    try:
        os.fsync(file)
    except OSError as error:
        if error.errno not in _UNSUPPORTED:
            raise


def flush_folder(folder: Path) -> None:
    """Make what was made, renamed or removed in a folder durable."""
    if os.name == "nt":  # folders cannot be opened there
        return
    file = os.open(folder, os.O_RDONLY)
    try:
        _flush(file)
    finally:
        os.close(file)


def rename(source: Path, target: Path) -> None:
    """Rename a file or folder within one parent folder, durably."""
    os.replace(source, target)
    flush_folder(target.parent)


def remove_tree(folder: Path) -> None:
    """Remove a folder with all it holds, links in it but not what they lead to."""
    with os.scandir(folder) as entries:
        inside = [(entry.path, entry.is_dir(follow_symlinks=False)) for entry in entries]
    for path, is_folder in inside:
        if is_folder:
            remove_tree(Path(path))
        else:
            os.unlink(path)
    os.rmdir(folder)


def remove_partials(folder: Path) -> None:
    """Remove the unfinished files that a killed process left in a folder and below it."""
    with os.scandir(folder) as entries:
        inside = [(entry.path, entry.name, entry.is_dir(follow_symlinks=False)) for entry in entries]
    for path, name, is_folder in inside:
        if is_folder:
            remove_partials(Path(path))
        elif name.endswith(PARTIAL):
            with contextlib.suppress(FileNotFoundError):
                os.unlink(path)
