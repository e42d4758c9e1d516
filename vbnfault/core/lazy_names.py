"""Load the public names of a package when they are first used, so that its import loads nothing heavy."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Mapping
from typing import Any


def load_name(package: str, name: str, homes: Mapping[str, str]) -> Any:
    """Return a public name of a package from the module that defines it, and keep it in the package.

    A package calls this function from its `__getattr__` (PEP 562), which Python calls only for names that the
    package does not have yet. For type checkers and readers the package also imports its names under
    `if TYPE_CHECKING` and lists them in `__all__`; `tests/test_api.py` compares the three.

    Parameters
    ----------
    package
        The package's `__name__`.
    name
        The attribute that is asked for.
    homes
        Module that defines each public name, relative to the package. The module may have another name for it, as
        in `"build": "dataset:build_scene"`. An empty name, as in `"study": "study:"`, stands for the module itself.

    Raises
    ------
    AttributeError
        The package has no such public name.
    """
    if name not in homes:
        raise AttributeError(f"module {package!r} has no attribute {name!r}")
    module, renamed, defined = homes[name].partition(":")
    value: Any = importlib.import_module(f".{module}", package)
    if defined or not renamed:
        value = getattr(value, defined or name)
    setattr(sys.modules[package], name, value)
    return value
