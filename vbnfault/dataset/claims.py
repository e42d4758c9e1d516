"""Lock a store in an object store, where there are no locked files: by objects that say who writes what.

A command writes its claim, lists all claims, and goes on if none of another command overlaps. So of two commands
that begin together, at least one sees the other. The claim is written again every 20 s. A claim counts as that of a
killed command and is removed if it was not written for two minutes, by the clock of the object store, or if its
process ran on this host and has ended.
"""

from __future__ import annotations

import contextlib
import json
import random
import re
import threading
import time
import uuid
from collections.abc import Iterator
from typing import Any, NamedTuple

from ..core.errors import VbnfaultError
from ..store import OWN, Bucket, Url
from .owners import has_ended, overlap, still_writing, this_process

_MOST_BYTES = 65536  # of a claim
_FOLDER = f"{OWN}/claims"
_SECONDS_BETWEEN_BEATS = 20.0
_SECONDS_OF_A_CLAIM = 120.0
_SECONDS_BETWEEN_TRIES = 0.2
_NAME = re.compile(r"(whole|prepare|shards-(\d+)-(\d+))\.([0-9a-f]{32})\.json")
PREPARE = "prepare"


class _Claim(NamedTuple):
    """Hold a claim of another command: its object, what it is for, and its owner."""

    name: str
    kind: str
    shards: range | None
    owner: dict[str, Any]


def kind_of(shards: range | None) -> str:
    """Return the beginning of a claim's name."""
    return "whole" if shards is None else f"shards-{shards.start}-{shards.stop}"


@contextlib.contextmanager
def claimed(url: Url, shards: range | None) -> Iterator[None]:
    """Hold a claim on the store at a URL, or on some of its shards, during a `with` block.

    Raises VbnfaultError if another command writes there, or if the object store refuses.
    """
    bucket = Bucket(url)
    with _written(bucket, kind_of(shards)) as own:
        for other in _others(bucket, own):
            if other.kind != PREPARE and overlap(other.shards, shards):
                raise still_writing(url, other.owner, other.shards, f"{url}/{_FOLDER}/{other.name}")
        yield


@contextlib.contextmanager
def prepared(url: Url, seconds: float) -> Iterator[None]:
    """Let commands pass a `with` block one after the other; wait at most some seconds."""
    bucket, until = Bucket(url), time.monotonic() + seconds
    while True:
        with _written(bucket, PREPARE) as own:
            before = [other for other in _others(bucket, own) if other.kind == PREPARE]
            if not before:
                yield
                return
        if time.monotonic() > until:
            raise still_writing(url, before[0].owner, None, f"{url}/{_FOLDER}/{before[0].name}")
        time.sleep(_SECONDS_BETWEEN_TRIES * (1 + random.random()))  # so that two do not wait in step


def ranges_at_work(url: Url) -> list[range]:
    """Return the ranges of shards that commands write now, this one's too."""
    return [other.shards for other in _others(Bucket(url), "") if other.shards is not None]


@contextlib.contextmanager
def _written(bucket: Bucket, kind: str) -> Iterator[str]:
    """Keep a claim written during a `with` block, and give its name."""
    name = f"{kind}.{uuid.uuid4().hex}.json"
    file, content = f"{_FOLDER}/{name}", json.dumps(this_process()).encode()
    ended = threading.Event()

    def beat() -> None:
        while not ended.wait(_SECONDS_BETWEEN_BEATS):
            with contextlib.suppress(OSError, VbnfaultError):
                bucket.write([(file, content)])

    try:
        bucket.write([(file, content)])
    except OSError as error:
        raise VbnfaultError(
            f"{bucket.path}: cannot be written: {error.strerror}; nothing is lost, and the same command resumes "
            "once that is mended"
        ) from error
    thread = threading.Thread(target=beat, daemon=True)
    thread.start()
    try:
        yield name
    finally:
        ended.set()
        thread.join()
        with contextlib.suppress(OSError, VbnfaultError):  # otherwise the claim ends by itself
            bucket.remove([file])


def _others(bucket: Bucket, own: str) -> list[_Claim]:
    """Return the claims of other commands at work, and remove those of killed ones."""
    written = bucket.modified(_FOLDER)
    now = written.get(own) or max(written.values(), default=None)
    others = []
    for name, moment in sorted(written.items()):
        match = _NAME.fullmatch(name)
        if match is None or name == own:
            continue
        try:
            owner = json.loads(bucket.read(f"{_FOLDER}/{name}", _MOST_BYTES))
        except FileNotFoundError:  # it has just ended
            continue
        except (OSError, ValueError):
            owner = {}
        too_old = now is not None and (now - moment).total_seconds() > _SECONDS_OF_A_CLAIM
        if too_old or has_ended(owner):
            with contextlib.suppress(OSError):
                bucket.remove([f"{_FOLDER}/{name}"])
            continue
        shards = range(int(match[2]), int(match[3])) if match[2] else None
        others.append(_Claim(name, match[1].split("-")[0], shards, owner))
    return others
