"""Say which class breaks a contract, how, and with which example."""

from __future__ import annotations

import contextlib
import pickle
from collections.abc import Iterator
from typing import Any


@contextlib.contextmanager
def naming(title: str, example: str) -> Iterator[None]:
    """Turn every error of a block into an AssertionError that names the class and the example that breaks it."""
    try:
        yield
    except Exception as error:
        text = str(error) if isinstance(error, AssertionError) else f"raised {type(error).__name__}: {error}"
        raise AssertionError(f"{title}: {text} ({example})") from error


def pickled(value: Any) -> Any:
    """Return a value as another process gets it. Raises AssertionError if it cannot be pickled."""
    try:
        return pickle.loads(pickle.dumps(value))
    except (pickle.PicklingError, AttributeError) as error:
        raise AssertionError(f"cannot be pickled: {error}; define its class at the top of a module") from None
