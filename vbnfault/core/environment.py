"""Read environment variables, and choose the import path of processes that this one starts."""

from __future__ import annotations

import os
import sys

from .errors import InputError, shown
from .resources import PACKAGE

# The most threads that an environment variable or option may ask for: more than any machine has.
MOST_THREADS = 4096


def whole_number(name: str, high: int) -> int:
    """Return the whole number in an environment variable, 0 where it is unset or empty.

    Raises InputError unless it is a whole number from 0 to `high`.
    """
    text = os.environ.get(name, "").strip() or "0"
    if not (text.isascii() and text.isdigit() and len(text) < 20 and int(text) <= high):
        raise InputError(f"{name} = {shown(text)}: must be a whole number from 0 to {high}")
    return int(text)


def import_path() -> list[str]:
    """Return the import path for a process that this one starts: this one's path without the working folder.

    Under `python -m` and at the prompt, Python puts the working folder first, so that it would run a file
    `random.py` among a user's data. The working folder stays in the path where PYTHONPATH names it, or where it
    follows the standard library, as an editable installation from this folder has it. Where it holds vbnfault
    itself, it moves to the end.
    """
    here, package = os.path.realpath(os.getcwd()), os.path.realpath(PACKAGE.parent)
    wanted = {os.path.realpath(p) for p in os.environ.get("PYTHONPATH", "").split(os.pathsep) if p}
    library, after_library, path = os.path.realpath(os.path.dirname(os.__file__)), False, []
    for entry in (p for p in sys.path if isinstance(p, str)):
        where = os.path.realpath(entry or here)
        after_library |= where == library
        if where != here or here in wanted or after_library:
            path.append(entry)
    return [*path, package] if here == package and here not in wanted else path
