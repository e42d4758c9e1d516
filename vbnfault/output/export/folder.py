"""Write the files of an export durably, and keep a record of the parts that are finished.

    export.json             what is exported, in which format; written first and, when all is done, last
    SHA256SUMS              checksum and name of each file, as `sha256sum --check` reads them
    .parts/00012.json       the record of a finished part: its files with their checksums, its entries, and a
                            checksum of all that

A part's record is written after its files, so a part with a record needs no work when an export is resumed and the
files have their checksums still. The folder `.parts` is removed at the end; then `SHA256SUMS` tells a later command
whether the export is whole. If not, all its files are written again.
"""

from __future__ import annotations

import hashlib
import itertools
import json
import re
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from ...core.errors import InputError
from ...core.files.path_checks import check_folder
from ...core.files.whole_files import remove, replacing
from ...store import disk, is_sealed, sealed

STATE = "export.json"
SUMS = "SHA256SUMS"
_PARTS = ".parts"
_MOST_BYTES = 1 << 30  # of a record: the parameters of the samples of a part
_OWN = re.compile(rf"{re.escape(STATE)}\.[0-9a-f]{{32}}{re.escape(disk.PARTIAL)}")
_UNSAID = {"masks": "footprint", "min_area_px": 1}  # what holds where `export.json` does not name a key
_FILES_AT_ONCE = 8  # files that are open and in memory at once, in each thread


class Folder:
    """Write files of one export; `checksums` has the sha256 (hex) of each file written by this object."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.checksums: dict[str, str] = {}

    def put(self, files: Iterable[tuple[str, bytes]]) -> None:
        """Write files; a file is whole or absent, also after a kill."""
        rest = iter(files)
        while batch := list(itertools.islice(rest, _FILES_AT_ONCE)):
            disk.write(self.path, batch)
            self.checksums |= {name: hashlib.sha256(content).hexdigest() for name, content in batch}

    def put_with(self, name: str, make: Callable[[Path], object]) -> None:
        """Write one file by a function that gets a temporary path; it is complete or not there."""
        target = self.path / name
        disk.make_folders(self.path, target.parent, {})
        with replacing(target) as temporary:
            make(temporary)
        self.checksums[name] = _sha256(target)

    # --- what an earlier command has done -------------------------------------------------------------------

    def begin(self, identity: dict[str, Any]) -> bool:
        """Begin or resume the export that `identity` describes; return whether it is complete already.

        Raises
        ------
        InputError
            The folder holds something else, or another export.
        """
        check_folder(self.path)
        names = disk.names(self.path)
        if all(_OWN.fullmatch(name) for name in names):  # also what a killed process left of its first file
            for name in names:
                (self.path / name).unlink(missing_ok=True)
            self.path.mkdir(parents=True, exist_ok=True)
            self._write_state(identity, complete=False)
            return False
        state = _document(self.path / STATE)
        if state is None or state.get("kind") != "vbnfault export":
            raise InputError(
                f"{self.path}: holds something else than an export of vbnfault, so it is left alone; choose "
                "another --out"
            )
        differing = [key for key in identity if state.get(key, _UNSAID.get(key)) != identity[key]]
        if differing:
            key = differing[0]
            raise InputError(
                f"{self.path}: holds another export: {key} is {state.get(key)!r} there and {identity[key]!r} now; "
                "choose another --out, or delete the folder"
            )
        disk.remove_partials(self.path)
        return bool(state.get("complete")) and self._is_whole()

    def end(self, identity: dict[str, Any], parts: int) -> None:
        """Mark an export of `parts` parts as complete and remove what only its resumption needs."""
        own = dict(self.checksums)

        def write_sums(path: Path) -> None:
            with path.open("w", encoding="utf-8") as file:
                for files in (*(self.part(number)["files"] for number in range(parts)), own):
                    file.writelines(f"{checksum}  {name}\n" for name, checksum in files.items())

        self.put_with(SUMS, write_sums)
        self._write_state(identity, complete=True)
        self.clear()

    def clear(self) -> None:
        """Remove the records of parts."""
        remove(self.path / _PARTS)

    def _is_whole(self) -> bool:
        """Return whether all files of a complete export have their checksums still."""
        try:
            lines = disk.read(self.path / SUMS, _MOST_BYTES).decode().splitlines()
        except (OSError, ValueError):
            return False
        return all(self._has(name, checksum) for checksum, _, name in (line.partition("  ") for line in lines))

    def _has(self, name: str, checksum: str) -> bool:
        """Return whether a file has a checksum."""
        try:
            return _sha256(self.path / name) == checksum
        except OSError:
            return False

    def _write_state(self, identity: dict[str, Any], *, complete: bool) -> None:
        """Write what is exported, and whether all of it is there."""
        state = {"kind": "vbnfault export", **identity, "complete": complete}
        disk.write(self.path, [(STATE, json.dumps(state, indent=2).encode())])

    def part(self, number: int) -> dict[str, Any]:
        """Return the record of a finished part."""
        record = self._record(number)
        if record is None:
            raise InputError(
                f"{self.path}: {_PARTS}/{_part_name(number)} is missing or damaged; run the same command again"
            )
        return record

    def write_part(self, number: int, record: dict[str, Any]) -> None:
        """Write the record of a part whose files are written; the files of this object are added to it."""
        text = json.dumps(sealed({**record, "files": self.checksums}), allow_nan=False)
        disk.write(self.path, [(f"{_PARTS}/{_part_name(number)}", text.encode())])

    def has_part(self, number: int) -> bool:
        """Return whether a part is finished and its files have their checksums still."""
        record = self._record(number)
        return record is not None and all(self._has(*file) for file in record["files"].items())

    def _record(self, number: int) -> dict[str, Any] | None:
        """Return the record of a part; None if there is none, or a damaged one."""
        record = _document(self.path / _PARTS / _part_name(number))
        return record if record is not None and is_sealed(record) else None


def _part_name(number: int) -> str:
    """Return the file name of a part's record."""
    return f"{number:06d}.json"


def _sha256(path: Path) -> str:
    """Return the sha256 of a file (hex)."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _document(path: Path) -> dict[str, Any] | None:
    """Return the JSON object in a file; None if there is none."""
    try:
        document = json.loads(disk.read(path, _MOST_BYTES))
    except (OSError, ValueError, RecursionError):
        return None
    return document if isinstance(document, dict) else None
