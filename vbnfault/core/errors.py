"""Define the errors that a user can cause or meet.

Each message is one sentence. The errors hold plain strings only, so that they can be pickled.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Iterator
from contextlib import contextmanager

# The most characters of a message and of a value. Any key, value and allowed range are shorter. A longer text, such
# as a value in a user's file, loses its middle.
_LONGEST_MESSAGE = 2000
_LONGEST_VALUE = 120


class VbnfaultError(Exception):
    """Report that a run failed, for the reason in the message. The command line exits with code 1."""

    exit_code = 1

    def __init__(self, message: object = "") -> None:
        text = str(message)
        super().__init__(text if len(text) <= _LONGEST_MESSAGE else without_middle(text, _LONGEST_MESSAGE))


class InputError(VbnfaultError):
    """Report bad input; the message names file, key, value and allowed range. Exit code 2."""

    exit_code = 2


class InputChanged(VbnfaultError):
    """Report that a file has changed since the run that reads it began."""


@contextmanager
def in_file(source: str) -> Iterator[None]:
    """Let every InputError of the block begin with the name of the file that is read."""
    try:
        yield
    except InputError as error:
        if f"{error}".startswith(f"{source}: "):
            raise
        raise type(error)(f"{source}: {error}") from None


@contextmanager
def under_key(key: str) -> Iterator[None]:
    """Let every InputError of the block begin with a key such as `body.shape`, or with another of its table."""
    try:
        yield
    except InputError as error:
        if f"{error}".startswith(f"{key.partition('.')[0]}."):
            raise
        raise InputError(f"{key}: {error}") from None


def shown(value: object) -> str:
    """Return the `repr` of a value for an error message, without its middle where it is long."""
    if isinstance(value, int) and value.bit_length() > 4096:  # by default Python writes at most 4300 digits
        return f"a whole number of {int(value.bit_length() * 0.30103)} digits"
    if isinstance(value, str | bytes | list | tuple) and len(value) > 4 * _LONGEST_VALUE:
        # `repr` of the whole could take long and fill the memory
        half = 2 * _LONGEST_VALUE
        return without_middle(f"{shown_whole(value[:half])} … {shown_whole(value[-half:])}", _LONGEST_VALUE)
    return without_middle(shown_whole(value), _LONGEST_VALUE)


def shown_whole(value: object) -> str:
    """Return the `repr` of a value, or "a" and its type where Python cannot write it."""
    try:
        return repr(value)
    except (ValueError, RecursionError):  # it holds too long a number, or is nested too deep
        return f"a {type(value).__name__}"


def suggestion(word: str, known: Iterable[str]) -> str:
    """Return the known word that is nearest to an unknown one as " (did you mean ...?)", or "" if none is near."""
    near = difflib.get_close_matches(word, list(known), n=1)
    return f" (did you mean {near[0]}?)" if near else ""


def without_middle(text: str, length: int = _LONGEST_VALUE) -> str:
    """Return a text. If it is longer than `length`, a note of its length replaces its middle."""
    if len(text) <= length:
        return text
    return f"{text[: length * 2 // 3]} … {text[-length // 3 :]} ({len(text)} characters)"
