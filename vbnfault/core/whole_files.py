"""Replace a file only once its new content is written: a full disk leaves the former one."""

from __future__ import annotations

import contextlib
import os
import uuid
from pathlib import Path


def write_whole(path: Path, content: str | bytes) -> None:
    """Write a file, texts as UTF-8, so that it has its former content, or none, where that fails.

    A device or a pipe is written to as it is; a link stays, and the file that it names is replaced. Characters of a
    file name that are no Unicode become question marks. Raises OSError if the file cannot be written.
    """
    data = content.encode("utf-8", "replace") if isinstance(content, str) else content
    target = path.resolve()
    if target.exists() and not target.is_file():
        path.write_bytes(data)
        return
    partial = target.with_name(f".{uuid.uuid4().hex}.partial")
    try:
        partial.write_bytes(data)
        os.replace(partial, target)
    except BaseException:
        with contextlib.suppress(OSError):
            partial.unlink()
        raise
