"""Lock a store where there are no locked files, by files that say who writes what: in an object store, and beside a
store on a file system without locks (`.NAME.claims`).

A command writes its claim, lists all claims, and goes on if none of another command overlaps. So of two commands
that begin together, at least one sees the other. The claim is written again every 20 s. A claim counts as that of a
killed command and is removed if it was not written for two minutes, by the clock of what stores it, or if its
process ran on this host and has ended.
"""

from __future__ import annotations

import contextlib
import json
import os
import platform
import random
import re
import threading
import time
import uuid
from collections.abc import Iterator
from typing import Any, NamedTuple

from ..core.errors import VbnfaultError
from ..core.files.whole_files import kind_of as kind_of_error
from ..core.files.whole_files import own_folder
from ..store import OWN, Files, Location, Url, files_of

_MOST_BYTES = 65536  # of a claim
_SECONDS_BETWEEN_BEATS = 20.0
_SECONDS_OF_A_CLAIM = 120.0
_SECONDS_BETWEEN_TRIES = 0.2
_TRIES = 10  # to write a claim
_NAME = re.compile(r"(whole|prepare|shards-(\d+)-(\d+))\.([0-9a-f]{32})\.json")
PREPARE = "prepare"


class Held(VbnfaultError):
    """Report that another command writes what this one wants to write."""


def still_writing(path: Location, owner: dict[str, Any], shards: range | None = None, file: object = None) -> Held:
    """Return the error for a lock that another command holds.

    `shards`: what it has locked, everything by default. `file`: what may be deleted if the owner has ended.
    """
    by = f" (process {owner['pid']} on {owner['host']})" if {"pid", "host"} <= owner.keys() else ""
    what = "to it" if shards is None else f"shards {shards.start}:{shards.stop} of it"
    sentence = f"{path}: another command is writing {what}{by}; wait until it ends"
    return Held(sentence if file is None else f"{sentence}, or delete {file} if it has ended")


def overlap(a: range | None, b: range | None) -> bool:
    """Return whether two commands write to the same shards; None stands for the whole store."""
    return a is None or b is None or (a.start < b.stop and b.start < a.stop)


def this_process() -> dict[str, Any]:
    """Return host, process number and start time of this process."""
    import psutil

    return {"host": platform.node(), "pid": os.getpid(), "started": psutil.Process().create_time()}


def has_ended(owner: dict[str, Any]) -> bool | None:
    """Return whether the owner of a claim, a process of this host, has ended; None if that is not known.

    The start time is compared, too: another process may have got the number of the owner.
    """
    import psutil

    if owner.get("host") != platform.node() or not isinstance(owner.get("pid"), int):
        return None
    try:
        process = psutil.Process(owner["pid"])
        same = process.create_time() == owner.get("started")
    except psutil.NoSuchProcess:
        return True
    except (psutil.Error, ValueError, OverflowError):  # no number of a process
        return None
    return not same or process.status() == psutil.STATUS_ZOMBIE


class _Claims(NamedTuple):
    """Say where the claims on a store are: files, and the beginning of their names."""

    files: Files
    folder: str

    @classmethod
    def on(cls, path: Location) -> _Claims:
        """Return the place of the claims on a store."""
        if isinstance(path, Url):
            return cls(files_of(path), f"{OWN}/claims/")
        return cls(files_of(path.absolute().with_name(f".{path.name}.claims")), "")


class Claim(NamedTuple):
    """Hold a claim of another command: its file, what it is for, and its owner."""

    file: str
    kind: str
    shards: range | None
    owner: dict[str, Any]


def kind_of(shards: range | None) -> str:
    """Return the beginning of a claim's name."""
    return "whole" if shards is None else f"shards-{shards.start}-{shards.stop}"


@contextlib.contextmanager
def claimed(path: Location, shards: range | None) -> Iterator[None]:
    """Hold a claim on a store, or on some of its shards, during a `with` block.

    Raises Held if another command writes there, VbnfaultError if a claim cannot be written.
    """
    claims = _Claims.on(path)
    with _written(path, claims, kind_of(shards)) as own:
        for other in _others(claims, own):
            if other.kind != PREPARE and overlap(other.shards, shards):
                raise still_writing(path, other.owner, other.shards, other.file)
        yield


@contextlib.contextmanager
def prepared(path: Location, seconds: float) -> Iterator[None]:
    """Let commands pass a `with` block one after the other; wait at most some seconds."""
    claims, until = _Claims.on(path), time.monotonic() + seconds
    while True:
        with _written(path, claims, PREPARE) as own:
            before = [other for other in _others(claims, own) if other.kind == PREPARE]
            if not before:
                yield
                return
        if time.monotonic() > until:
            raise still_writing(path, before[0].owner, None, before[0].file)
        time.sleep(_SECONDS_BETWEEN_TRIES * (1 + random.random()))  # so that two do not wait in step


def at_work(path: Location) -> list[Claim]:
    """Return what commands claim of a store now, this one's claim too."""
    return [claim for claim in _others(_Claims.on(path), "") if claim.kind != PREPARE]


@contextlib.contextmanager
def _written(path: Location, claims: _Claims, kind: str) -> Iterator[str]:
    """Keep a claim on a store written during a `with` block, and give its name."""
    name, files = f"{kind}.{uuid.uuid4().hex}.json", claims.files
    file, content = f"{claims.folder}{name}", json.dumps(this_process()).encode()
    ended = threading.Event()

    def write() -> None:
        for tries_left in range(_TRIES, 0, -1):
            try:
                if not isinstance(files.path, Url):
                    own_folder(files.path)
                files.write([(file, content)])
                return
            except FileNotFoundError:  # another command has removed the folder after its last claim
                if tries_left == 1:
                    raise

    def beat() -> None:
        while not ended.wait(_SECONDS_BETWEEN_BEATS):
            with contextlib.suppress(OSError, VbnfaultError):
                write()

    try:
        write()
    except OSError as error:
        raise (VbnfaultError if isinstance(path, Url) else kind_of_error(error))(
            f"{path}: cannot be written: {error.strerror}; nothing is lost, and the same command resumes once that "
            "is mended"
        ) from error
    thread = threading.Thread(target=beat, daemon=True)
    thread.start()
    try:
        yield name
    finally:
        ended.set()
        thread.join()
        with contextlib.suppress(OSError, VbnfaultError):  # otherwise the claim ends by itself
            files.remove([file])
            if not isinstance(files.path, Url):
                files.path.rmdir()  # the last one


def _others(claims: _Claims, own: str) -> list[Claim]:
    """Return the claims of other commands at work, and remove those of killed ones."""
    written = claims.files.modified(claims.folder)
    now = written.get(own) or max(written.values(), default=None)
    others = []
    for name, moment in sorted(written.items()):
        match = _NAME.fullmatch(name)
        if match is None or name == own:
            continue
        try:
            owner = json.loads(claims.files.read(f"{claims.folder}{name}", _MOST_BYTES))
        except FileNotFoundError:  # it has just ended
            continue
        except (OSError, ValueError, RecursionError):
            owner = {}
        owner = owner if isinstance(owner, dict) else {}
        known = has_ended(owner)  # a process of this host that stands still keeps its claim
        too_old = now is not None and (now - moment).total_seconds() > _SECONDS_OF_A_CLAIM
        if known or (known is None and too_old):
            with contextlib.suppress(OSError):
                claims.files.remove([f"{claims.folder}{name}"])
            continue
        shards = range(int(match[2]), int(match[3])) if match[2] else None
        others.append(Claim(f"{claims.files.path}/{claims.folder}{name}", match[1].split("-")[0], shards, owner))
    return others
