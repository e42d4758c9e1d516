"""Read, write, rename and remove files on a disk; writes are durable and of whole files only.

The functions take paths, for anything that must be durable. `Disk` does the same for the files of one store.

A batch of files is written under temporary names in the same folders (`*.partial`), flushed to the device with
fsync, and renamed; then the folders are flushed. After a loss of power each file is either the old or the new one.
A later batch never reaches the device before an earlier one (Pillai et al. 2014, "All file systems are not created
equal", OSDI).
"""

from __future__ import annotations

import contextlib
import errno
import os
import shutil
import stat
import uuid
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, datetime
from pathlib import Path
from typing import TypeVar

from ..core.errors import InputError, VbnfaultError
from ..core.files.whole_files import flush, flush_folder, kind_of, rename
from ..core.files.whole_files import remove as remove_whole

PARTIAL = ".partial"
# Number of parallel flushes. Measured on ext4, the 42 files and 90 folders of a shard take 45-600 ms one after the
# other, and 15-35 ms eight at a time.
_FLUSHES = 8
_OPEN_AT_ONCE = 32  # files: a process may have few
_MOST_COPIED_BYTES = 1 << 32  # all layers of a shard have less
T = TypeVar("T")


class Misplaced(OSError):
    """Report that the name of a file belongs to something else: a folder, a link, a pipe, a file too large."""


@contextlib.contextmanager
def explained(path: object, doing: str) -> Iterator[None]:
    """Turn an OSError in a `with` block into a VbnfaultError or InputError with one sentence for the user."""
    try:
        yield
    except OSError as error:
        raise kind_of(error)(
            f"{path}: {error.strerror or error} while {doing}; finished samples stay, "
            f"and the same command resumes once that is mended"
        ) from error


def denied(error: PermissionError, path: str | Path) -> InputError:
    """Return the error for a file or folder that this user may not read.

    This is no damage, so it must not lead to a repair: it is no OSError, which callers take for damage.
    """
    return InputError(
        f"{error.filename or path}: {error.strerror}: give this user the right to read it, and repeat the command"
    )


def read(path: str | Path, most_bytes: int) -> bytes:
    """Return the content of a regular file of at most so many bytes.

    Raises
    ------
    Misplaced
        The path is a folder, a link or a pipe, or the file is larger.
    OSError
        The file cannot be read.
    InputError
        This user may not read the file.
    """
    file, size = _opened(path)
    try:
        if size > most_bytes:
            raise Misplaced(errno.EFBIG, f"it has {size} bytes, where at most {most_bytes} are possible", str(path))
        # os.read reserves what it may read; one byte more than the file has tells that nothing follows
        parts = [os.read(file, min(size + 1, 1 << 30))]
        if len(parts[0]) != size:
            while (part := os.read(file, 1 << 20)) and sum(map(len, parts)) <= most_bytes:
                parts.append(part)
    finally:
        os.close(file)
    return parts[0] if len(parts) == 1 else b"".join(parts)


# without O_NONBLOCK, opening a pipe would wait for a writer
_READING = os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK


def _opened(path: str | Path) -> tuple[int, int]:
    """Open a regular file for reading, and return its handle and its size in bytes. Raises what `read` says."""
    try:
        file = os.open(path, _READING)
    except PermissionError as error:
        raise denied(error, path) from error
    except OSError as error:
        if error.errno == errno.ELOOP:
            raise Misplaced(errno.ELOOP, "it is a link, not a file", str(path)) from error
        raise
    try:
        status = os.fstat(file)
        if not stat.S_ISREG(status.st_mode):
            raise Misplaced(errno.EISDIR, "it is not a regular file", str(path))
    except BaseException:
        os.close(file)
        raise
    return file, status.st_size


def names(folder: Path) -> list[str]:
    """Return the names in a folder; an empty list if there is no such folder.

    Raises InputError if this user may not read the folder.
    """
    try:
        return os.listdir(folder)
    except (FileNotFoundError, NotADirectoryError):
        return []
    except PermissionError as error:
        raise denied(error, folder) from error


def write(root: Path, files: Iterable[tuple[str, bytes | Path]]) -> None:
    """Replace files durably, as one batch; each is the old or the complete new one at any moment.

    If something else (a folder, a link, a pipe) has the name of a file or of its folder below `root`, it is
    removed.

    Parameters
    ----------
    root
        An existing folder.
    files
        Name relative to `root`, separated by `/`, and content. They are taken one at a time, so that only one
        content is in memory. A path in place of a content is a file that gets this second name (a hard link), or is
        copied where that is impossible.

    Raises
    ------
    OSError
        A file cannot be written. Each file is then the old or the new one; temporary files are removed.
    """
    written: list[tuple[Path, Path]] = []
    opened: list[int] = []
    changed: dict[Path, None] = {}  # folders, in order
    linked: set[Path] = set()
    try:
        for name, content in files:
            target = root / name
            make_folders(root, target.parent, changed)
            changed[target.parent] = None
            partial = target.with_name(f"{target.name}.{uuid.uuid4().hex}{PARTIAL}")
            written.append((partial, target))
            if isinstance(content, Path):
                try:
                    os.link(content, partial, follow_symlinks=False)
                    linked.add(partial)
                    continue
                except OSError:  # on another device, or a file system without links
                    content = read(content, _MOST_COPIED_BYTES)
            flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL
            opened.append(os.open(partial, flags, 0o666))
            _write_all(opened[-1], content)
            if len(opened) == _OPEN_AT_ONCE:
                _flush_and_close(opened)
        if not written:
            return
        _flush_and_close(opened)
        for partial, target in written:
            _make_way(target)
            os.replace(partial, target)
            if partial in linked:  # two names of one file: replacing one by the other did nothing (POSIX)
                partial.unlink(missing_ok=True)
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
    """Flush files or folders in parallel: a journaling file system commits once for all that wait."""
    with ThreadPoolExecutor(_FLUSHES) as pool:
        for _ in pool.map(flush, items):
            pass


def _flush_and_close(opened: list[int]) -> None:
    """Flush the open files of a list to the device, close them, and empty the list."""
    _at_once(flush, opened)
    while opened:
        os.close(opened.pop())


def _write_all(file: int, content: bytes) -> None:
    """Write all bytes to an open file: one call of os.write may write only a part."""
    rest = memoryview(content)
    while rest:
        count = os.write(file, rest)
        if count == 0:
            raise OSError(errno.EIO, os.strerror(errno.EIO))
        rest = rest[count:]


def make_folders(root: Path, folder: Path, changed: dict[Path, None]) -> None:
    """Make a folder and its missing parents below `root`; add the folders whose entries changed to `changed`.

    A file or a link that has the name of one of them is removed.
    """
    if folder == root or folder in changed:
        return
    make_folders(root, folder.parent, changed)
    try:
        is_folder = stat.S_ISDIR(os.lstat(folder).st_mode)
    except OSError:  # it does not exist
        is_folder = False
    if is_folder:
        return
    try:
        with contextlib.suppress(FileNotFoundError):
            os.unlink(folder)
        os.mkdir(folder)
    except OSError:
        if not folder.is_dir() or folder.is_symlink():  # otherwise another worker has just made it
            raise
    changed[folder.parent] = changed[folder] = None


def _make_way(target: Path) -> None:
    """Remove a folder that has the name of a file."""
    try:
        in_the_way = stat.S_ISDIR(os.lstat(target).st_mode)
    except FileNotFoundError:
        return
    if in_the_way:
        shutil.rmtree(target)


def remove_partials(folder: str | Path) -> None:
    """Remove the temporary files that a killed process left in a folder or below it."""
    folders = [os.fspath(folder)]  # text, because a large store has half a million folders
    while folders:
        with os.scandir(folders.pop()) as entries:
            for entry in entries:
                if entry.is_dir(follow_symlinks=False):
                    folders.append(entry.path)
                elif entry.name.endswith(PARTIAL):
                    with contextlib.suppress(FileNotFoundError):
                        os.unlink(entry.path)


# --- one store ----------------------------------------------------------------------------------------------


class Disk:
    """Read and write the files of a store in a folder; their names are relative to it and separated by `/`."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._folder = str(path)

    def read(self, name: str, most_bytes: int) -> bytes:
        """Return the content of a file of at most so many bytes.

        Raises
        ------
        FileNotFoundError
            There is no such file.
        OSError
            The file is damaged: it cannot be read, is larger, or a link stands in its place or above it.
        InputError
            This user may not read it.
        VbnfaultError
            The object store cannot be reached.
        """
        return read(self._inside(name), most_bytes)

    def read_each(self, files: Sequence[tuple[str, int]]) -> Iterator[bytes | OSError]:
        """Yield the content of each file, given by its name and its most bytes, or the OSError of `read`."""
        for name, most_bytes in files:
            try:
                yield self.read(name, most_bytes)
            except OSError as error:
                yield error

    def _inside(self, name: str) -> str:
        """Return the path of a file or folder as text: a large store has many, and paths take longer.

        Raises Misplaced if a folder above it, within the store, is a link: what it names is no part of the store.
        """
        path = f"{self._folder}/{name}"
        end = path.find("/", len(self._folder) + 1)
        while end > 0:
            try:
                is_link = stat.S_ISLNK(os.lstat(path[:end]).st_mode)
            except PermissionError as error:
                raise denied(error, path) from error
            if is_link:
                raise Misplaced(errno.ELOOP, "a folder above it is a link", path)
            end = path.find("/", end + 1)
        return path

    def read_parts(
        self, name: str, tail: int, choose: Callable[[bytes], Sequence[tuple[int, int]]]
    ) -> list[tuple[int, bytes]]:
        """Return parts of a file, each with its start in the file; a part may be shorter at the file's end.

        Parameters
        ----------
        name
            The file, which is opened once, so that all parts are of one version of it.
        tail
            Number of bytes at the end of the file that `choose` receives.
        choose
            Returns start and length of each part.

        Raises
        ------
        OSError, InputError
            As `read` does.
        """
        file, size = _opened(self._inside(name))
        try:
            ranges = choose(os.pread(file, min(tail, size), max(0, size - tail)))
            # os.pread reserves what it may read, and takes no place beyond 2^63
            within = [(start, min(length, size - start)) for start, length in ranges]
            return [(start, os.pread(file, length, start) if length > 0 else b"") for start, length in within]
        finally:
            os.close(file)

    def names(self, folder: str) -> list[str]:
        """Return the names in a folder; an empty list if there is no such folder."""
        try:
            return names(Path(self._inside(f"{folder}/").rstrip("/")))
        except OSError:
            return []

    def exists(self, name: str) -> bool:
        """Return whether something has this name."""
        return os.path.lexists(self.path / name)

    def modified(self, folder: str) -> dict[str, datetime]:
        """Return by name when each file directly in a folder was written, by the clock of what stores it."""
        written = {}
        for name in self.names(folder):
            with contextlib.suppress(OSError):
                written[name] = datetime.fromtimestamp(os.lstat(self.path / folder / name).st_mtime, UTC)
        return written

    def stamp(self, name: str) -> object:
        """Return what changes if a file is replaced; None if there is no file."""
        try:
            status = os.stat(self.path / name)
        except OSError:
            return None
        return status.st_ino, status.st_mtime_ns

    def zarr(self) -> Path:
        """Return what zarr and xarray open in order to read the store."""
        return self.path

    def failure(self, error: Exception, name: str) -> VbnfaultError | None:
        """Return the error to raise where zarr may not read an array's files; None for other causes."""
        return denied(error, self.path / name) if isinstance(error, PermissionError) else None

    def write(self, files: Iterable[tuple[str, bytes | Path]]) -> None:
        """Replace files durably, as one batch; each is the old or the complete new one at any moment.

        The contents are bytes, or what `copied` returns. Raises OSError if a file cannot be written.
        """
        write(self.path, files)

    def remove(self, files: Iterable[str]) -> None:
        """Remove files durably, as one batch; names that do not exist, or below a link, are left out."""
        folders: dict[Path, None] = {}
        for name in files:
            try:
                path = Path(self._inside(name))
            except OSError:
                continue
            with contextlib.suppress(FileNotFoundError, NotADirectoryError):
                os.unlink(path)
                folders[path.parent] = None
        _at_once(flush_folder, folders)

    def copied(self, name: str, most_bytes: int, *, link: bool) -> bytes | Path:
        """Return a file as `write` of another store takes it. `link`: where possible, no byte is copied."""
        return Path(self._inside(name)) if link else self.read(name, most_bytes)

    def why_occupied(self, own: Iterable[str]) -> str:
        """Return why no store can be created here, as a clause, or an empty text; `own`: names of a new store."""
        if self.path.is_symlink():
            return "is a link, in whose place nothing is created; name another --out, or what the link names"
        if self.path.exists() and (not self.path.is_dir() or any(self.path.iterdir())):
            return "exists and is no vbnfault store, so it is left alone; choose another --out"
        above = next(p for p in self.path.absolute().parents if p.exists())
        return "" if above.is_dir() else f"no store can be created here: {above} is a file, not a folder"

    def create(self, files: Iterable[tuple[str, bytes]], *, old: bool) -> None:
        """Make a store of these files, the root last, in place of an `old` store; it appears when it is whole.

        The caller holds the lock of the store. Raises OSError if that is impossible; an old store stays then.
        """
        target = self.path.absolute()
        target.parent.mkdir(parents=True, exist_ok=True)
        hidden, retired = (target.with_name(f".{target.name}.{kind}{PARTIAL}") for kind in ("new", "old"))
        try:
            for left in (hidden, retired):  # by a killed command
                remove_whole(left)
            hidden.mkdir()
            write(hidden, files)
            try:
                if old:
                    rename(target, retired)
                elif target.is_dir():
                    target.rmdir()
                rename(hidden, target)
            except BaseException:
                if old and retired.exists() and not os.path.lexists(target):
                    os.replace(retired, target)
                raise
        finally:
            for left in (hidden, retired) if os.path.lexists(target) else (hidden,):
                with contextlib.suppress(OSError):
                    remove_whole(left)

    def remove_leftovers(self) -> None:
        """Remove what killed processes have left. No other process may write meanwhile."""
        remove_partials(self.path)

    def free_bytes(self) -> int | None:
        """Return the free space in bytes; None if it is not known or not limited."""
        for folder in (self.path, *self.path.absolute().parents):
            try:
                usage = shutil.disk_usage(folder)
            except (OSError, ValueError):  # it does not exist yet, is not accessible, or is no valid name
                continue
            return usage.free if usage.total else None  # some mounts report a size of 0
        return None
