"""Errors a user can cause or meet. One sentence each; they carry plain strings, so they pickle."""

from __future__ import annotations

# Of a message: enough for any key, value and allowed range; what a user's file adds beyond that is cut out.
_LONGEST_MESSAGE = 2000
_LONGEST_VALUE = 120


class VbnfaultError(Exception):
    """A run that failed for a stated reason. Command-line exit code 1."""

    exit_code = 1

    def __init__(self, message: object = "") -> None:
        text = str(message)
        super().__init__(text if len(text) <= _LONGEST_MESSAGE else _without_middle(text, _LONGEST_MESSAGE))


class InputError(VbnfaultError):
    """Bad input: the sentence names the file, the key, the value and the allowed range. Exit code 2."""

    exit_code = 2


class InputChanged(VbnfaultError):
    """A file that a run reads again no longer holds what it held when the run began."""


def shown(value: object) -> str:
    """Return a value as an error sentence shows it: its `repr`, without the middle where that is long."""
    if isinstance(value, int) and value.bit_length() > 4096:  # Python refuses to write such a number
        return f"a whole number of {int(value.bit_length() * 0.30103)} digits"
    if isinstance(value, str | bytes | list | tuple) and len(value) > 4 * _LONGEST_VALUE:
        # so that the whole is never written out
        half = 2 * _LONGEST_VALUE
        return _without_middle(f"{shown_whole(value[:half])} … {shown_whole(value[-half:])}", _LONGEST_VALUE)
    return _without_middle(shown_whole(value), _LONGEST_VALUE)


def shown_whole(value: object) -> str:
    """Return `repr` of a value, or of its type where Python cannot write it."""
    try:
        return repr(value)
    except (ValueError, RecursionError):  # a whole number of thousands of digits within; lists within lists
        return f"a {type(value).__name__}"


def _without_middle(text: str, length: int) -> str:
    if len(text) <= length:
        return text
    return f"{text[: length * 2 // 3]} … {text[-length // 3 :]} ({len(text)} characters)"
