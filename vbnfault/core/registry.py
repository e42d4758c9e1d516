"""Keep the classes of one kind that register themselves by being defined, such as ground reflectances."""

from __future__ import annotations

import importlib
import pkgutil
from typing import Generic, TypeVar

from . import tables

T = TypeVar("T")


class Registry(Generic[T]):
    """Map names to classes of one kind.

    The classes of vbnfault are the modules of one package, which are imported at the first question. Any other
    class registers when its own module is imported.

    Parameters
    ----------
    kind
        What the classes are, for messages.
    package
        Dotted name of the package whose modules define the classes of vbnfault.
    """

    def __init__(self, kind: str, package: str) -> None:
        self.kind, self.package = kind, package
        self._classes: dict[str, type[T]] = {}
        self._complete = False

    def add(self, name: str, cls: type[T]) -> None:
        """Register a class. Raise TypeError if another class has the name.

        A module that is imported again, as after an edit in a notebook, may define its class again.
        """
        known = self._classes.get(name)
        if known is not None and (known.__module__, known.__qualname__) != (cls.__module__, cls.__qualname__):
            raise TypeError(
                f"{self.kind} {name!r} is defined twice: {known.__module__}.{known.__qualname__} and "
                f"{cls.__module__}.{cls.__qualname__}"
            )
        self._classes[name] = cls
        tables.forget_schemas()  # those of tables that take any class of this kind

    def classes(self) -> dict[str, type[T]]:
        """Return name → class, sorted by name, those of vbnfault first."""
        if not self._complete:
            for info in pkgutil.iter_modules(importlib.import_module(self.package).__path__):
                importlib.import_module(f"{self.package}.{info.name}")
            self._complete = True

        def place(item: tuple[str, type[T]]) -> tuple[bool, str]:
            return not item[1].__module__.startswith(f"{self.package}."), item[0]

        return dict(sorted(self._classes.items(), key=place))
