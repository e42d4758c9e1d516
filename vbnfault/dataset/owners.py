"""Say who owns a lock, whether the owner still lives, and which locks exclude each other."""

from __future__ import annotations

import os
import platform
from typing import Any

from ..core.errors import VbnfaultError
from ..store import Location


def this_process() -> dict[str, Any]:
    """Return host, process number and start time of this process."""
    import psutil

    return {"host": platform.node(), "pid": os.getpid(), "started": psutil.Process().create_time()}


def has_ended(owner: dict[str, Any]) -> bool:
    """Return whether a lock's owner was a process of this host that has ended.

    The start time is compared, too: another process may have got the number of the owner.
    """
    import psutil

    if owner.get("host") != platform.node() or not isinstance(owner.get("pid"), int):
        return False
    try:
        process = psutil.Process(owner["pid"])
        same = process.create_time() == owner.get("started")
    except psutil.NoSuchProcess:
        return True
    except psutil.Error:
        return False
    return not same or process.status() == psutil.STATUS_ZOMBIE


def overlap(a: range | None, b: range | None) -> bool:
    """Return whether two commands write to the same shards; None stands for the whole store."""
    return a is None or b is None or (a.start < b.stop and b.start < a.stop)


def still_writing(
    path: Location, owner: dict[str, Any], shards: range | None = None, file: object = None, beat: str = ""
) -> VbnfaultError:
    """Return the error for a lock that another command holds.

    `shards`: what it has locked, everything by default. `file`: what may be deleted if the owner has ended. `beat`:
    when the owner was last seen.
    """
    by = f" (process {owner['pid']} on {owner['host']})" if {"pid", "host"} <= owner.keys() else ""
    what = "to it" if shards is None else f"shards {shards.start}:{shards.stop} of it"
    sentence = f"{path}: another command is writing {what}{by}; wait until it ends"
    if file is not None:
        sentence += f", or delete {file} if it has ended"
    return VbnfaultError(sentence + (f": its last heart-beat was at {beat}" if beat else ""))
