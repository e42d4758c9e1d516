"""Errors a user can cause or meet. One sentence each; they carry plain strings, so they pickle."""

from __future__ import annotations


class VbnfaultError(Exception):
    """A run that failed for a stated reason. Command-line exit code 1."""

    exit_code = 1


class InputError(VbnfaultError):
    """Bad input: the sentence names the file, the key, the value and the allowed range. Exit code 2."""

    exit_code = 2
