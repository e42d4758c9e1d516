"""Download a shape file and check it: its SHA-256, and that it is a shape.

A lock file beside the downloads (`LOCK`, JSON) keeps the checksum, size and address of each file. A file whose
checksum nobody published is trusted at the first download. From then on its recorded checksum holds, here and
wherever the lock file is copied.
"""

from __future__ import annotations

import hashlib
import json
import os
import tempfile
import time
import warnings
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any
from urllib.parse import quote, unquote, urlsplit, urlunsplit

from ..core.errors import InputError, VbnfaultError, shown
from ..core.files import path_checks
from ..core.files.user_files import LIMIT_BYTES, MIB, head_of_input, read_input, sha256_of_input
from ..core.files.whole_files import own, write_whole, writing
from .shape import FILE_TYPES, load_shape

LOCK = "shapes.lock"
_LONGEST_LOCK = 4 * MIB
_READ_BYTES = 1 << 20
_TIMEOUT_S = 60.0
# Slower downloads are given up after `_TIMEOUT_S`: a modem of 56 kbit/s is faster.
_LEAST_BYTES_PER_S = 5000
_DSK_ID = b"DAS/DSK "  # the first bytes of a NAIF digital shape kernel


@dataclass(frozen=True, kw_only=True)
class Pin:
    """Hold what the lock file records of a download."""

    sha256: str
    size_bytes: int
    url: str


@dataclass(frozen=True, kw_only=True)
class Fetched:
    """Describe a downloaded shape file.

    Attributes
    ----------
    path
        Where it lies.
    pin
        Its checksum, size and address.
    is_new
        Whether it was downloaded now.
    was_known
        Whether its checksum was known before: published, or in the lock file.
    """

    path: Path
    pin: Pin
    is_new: bool
    was_known: bool


def fetch_shape(url: str, folder: str | Path, *, sha256: str = "") -> Fetched:
    """Download a shape file into a folder, unless it lies there, check it, and record it in the lock file.

    Parameters
    ----------
    url
        Address, http or https. The last part of its path names the file. Characters beyond ASCII are encoded.
    folder
        Folder of the file and of the lock file; it is made if it is missing.
    sha256
        Published checksum in hex; empty if unknown. Then that of the lock file counts.

    Raises
    ------
    InputError
        The address names no shape file, the lock file is damaged or says otherwise than `sha256`, or a file of this
        name lies there with another checksum, or without a known one and is no shape.
    VbnfaultError
        The download fails, is too large or too slow, has another checksum, or is no shape.
    """
    folder = Path(folder)
    name = _file_name(url)
    path_checks.check_path(str(folder / name), "file to download")
    pins = _read_lock(folder / LOCK)
    pinned = pins.get(name)
    if pinned is not None and sha256 and pinned.sha256 != sha256:
        raise InputError(
            f"{folder / LOCK}: {name}: sha256 = {shown(pinned.sha256)}: the published one is {sha256}; delete the "
            "entry and the file to download it again"
        )
    known = sha256 or (pinned.sha256 if pinned else "")
    path = folder / name
    is_new = not path.exists()
    if is_new:
        pin = _download(url, path, known)
    else:
        pin = Pin(sha256=sha256_of_input(path, "shape"), size_bytes=path.stat().st_size, url=url)
        if known and pin.sha256 != known:
            raise InputError(
                f"{path}: SHA-256 {pin.sha256}: must be {known}; move the file away to download it again"
            )
        reason = "" if known else _why_no_shape(path)
        if reason:
            raise InputError(f"{path}: is not a shape: {reason}; move the file away to download it")
    if pinned != pin:
        _write_lock(folder / LOCK, {**pins, name: pin})
    return Fetched(path=path, pin=pin, is_new=is_new, was_known=bool(known))


def _file_name(url: str) -> str:
    """Return the name of the file at an address. Raises InputError."""
    try:
        parts = urlsplit(_encoded(url))
    except ValueError as error:
        raise InputError(f"url = {shown(url)}: {error}") from None
    if parts.scheme not in ("http", "https") or not parts.hostname:
        raise InputError(f"url = {shown(url)}: must begin with http:// or https:// and a host")
    name = Path(unquote(parts.path)).name
    if Path(name).suffix.lower() not in FILE_TYPES or not name.isprintable():
        raise InputError(f"url = {shown(url)}: must end with the name of a shape file: {', '.join(FILE_TYPES)}")
    return name


def _encoded(url: str) -> str:
    """Return an address in ASCII: its host by IDNA, the rest in per cent. Raises ValueError for a wrong host."""
    parts = urlsplit(url)
    parts.port  # noqa: B018  (it is checked when it is read)
    path, query = (quote(text, safe="/%:@!$&'()*+,;=~?") for text in (parts.path, parts.query))
    return urlunsplit((parts.scheme, parts.netloc.encode("idna").decode(), path, query, ""))


def _download(url: str, path: Path, known: str) -> Pin:
    """Download a file beside its final path, check it, and move it there. Raises VbnfaultError."""
    with writing(path.parent):
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, part = tempfile.mkstemp(dir=path.parent, prefix=".part-", suffix=path.suffix.lower())
    try:
        with writing(path):
            with os.fdopen(handle, "wb") as file:
                pin = _received(url, file)
            if known and pin.sha256 != known:
                raise VbnfaultError(
                    f"{url}: has SHA-256 {pin.sha256} ({pin.size_bytes} bytes): must be {known}; "
                    "the file was not kept"
                )
            if reason := _why_no_shape(Path(part)):
                raise VbnfaultError(f"{url}: is not a shape: {reason}; the file was not kept")
            os.chmod(part, 0o644)  # mkstemp lets nobody else read it
            os.replace(part, path)
    finally:
        Path(part).unlink(missing_ok=True)
    return pin


def _received(url: str, file: Any) -> Pin:
    """Write what an address sends into a file and return its checksum. Raises VbnfaultError."""
    from http.client import HTTPException
    from urllib.error import HTTPError
    from urllib.request import Request, urlopen

    limit, size, digest = LIMIT_BYTES["shape"], 0, hashlib.sha256()
    try:
        started = time.monotonic()
        with urlopen(Request(_encoded(url), headers={"User-Agent": "vbnfault"}), timeout=_TIMEOUT_S) as reply:
            expected = reply.headers.get("Content-Length", "")
            while data := reply.read1(_READ_BYTES):  # what has come, however little
                size += len(data)
                waited_s = time.monotonic() - started
                if waited_s > _TIMEOUT_S and size < waited_s * _LEAST_BYTES_PER_S:
                    raise VbnfaultError(
                        f"{url}: sent {size} bytes in {waited_s:.0f} s, fewer than {_LEAST_BYTES_PER_S} a second; "
                        "try again, or download the file elsewhere and put it into the folder"
                    )
                if size > limit:
                    raise VbnfaultError(f"{url}: has more than {limit / MIB:g} MiB, the most of a shape file")
                digest.update(data)
                file.write(data)
    except HTTPError as error:
        raise VbnfaultError(f"{url}: the server answers {error.code} {' '.join(error.reason.split())}") from None
    except (OSError, HTTPException) as error:
        reason = " ".join(str(getattr(error, "reason", None) or error).split())
        raise VbnfaultError(
            f"{url}: cannot be downloaded: {reason}; check the network, or download the file elsewhere and put it "
            "into the folder"
        ) from None
    if expected.isdigit() and int(expected) != size:
        raise VbnfaultError(f"{url}: {size} of {expected} bytes arrived; try again")
    return Pin(sha256=digest.hexdigest(), size_bytes=size, url=url)


def _why_no_shape(path: Path) -> str:
    """Return as a clause why a file is no shape, or "" if it is one; of a DSK only its first bytes are checked."""
    if path.suffix.lower() == ".bds":
        head = head_of_input(path, "shape", len(_DSK_ID))
        return "" if head == _DSK_ID else f"it begins with {shown(head)}, a DSK with {shown(_DSK_ID)}"
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # whoever uses the shape is warned of what was mended
            load_shape(path)
    except InputError as error:
        return str(error).removeprefix(f"{path}: ").rstrip(".")
    return ""


def _read_lock(path: Path) -> dict[str, Pin]:
    """Return the pins of a lock file by file name; none if there is no file. Raises InputError."""
    if not path.exists():
        return {}
    data = read_input(path, "data", limit_bytes=_LONGEST_LOCK)
    try:
        table = json.loads(data)
        pins = {name: Pin(**entry) for name, entry in table.items()}
    except (ValueError, TypeError, AttributeError, RecursionError) as error:
        raise InputError(f"{path}: is not a lock file of shapes: {error}") from None
    for name, pin in pins.items():
        if not (
            isinstance(pin.sha256, str) and len(pin.sha256) == 64 and set(pin.sha256) <= set("0123456789abcdef")
        ):
            raise InputError(f"{path}: {name}: sha256 = {shown(pin.sha256)}: must be 64 hexadecimal digits")
    return pins


def _write_lock(path: Path, pins: dict[str, Pin]) -> None:
    """Write the lock file, whole or not at all. Raises VbnfaultError."""
    text = json.dumps({name: asdict(pins[name]) for name in sorted(pins)}, indent=2) + "\n"
    with writing(path):
        write_whole(own(path), text)
