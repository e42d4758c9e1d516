"""Load PyAV, the library of films, which is installed with the extra `video`."""

from __future__ import annotations

from typing import Any

from ..errors import InputError


def pyav() -> Any:
    """Return PyAV. Raises InputError if it is not installed."""
    try:
        import av  # takes a quarter of a second to import
    except ImportError as error:
        raise InputError("a film needs PyAV: pip install 'vbnfault[video]'") from error
    return av
