"""Keep the classes of one kind that register themselves by being defined, such as ground reflectances."""

from __future__ import annotations

import importlib
import pkgutil
from collections.abc import Collection, Mapping
from typing import Any, Generic, TypeVar

from . import tables

T = TypeVar("T")

# The names of modules that are the files of plug-ins begin with this.
FILE_MODULE = "vbnfault_plugin_"
_registries: list[Registry[Any]] = []


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
        self._by_module: dict[str, dict[str, type[T]]] = {}
        self._complete = False
        _registries.append(self)

    def add(self, name: str, cls: type[T]) -> None:
        """Register a class. Raise TypeError if another class has the name.

        A module that is imported again, as after an edit in a notebook, may define its class again. The class of a
        plug-in's file gives way to any other: the file may have been edited, or belong to another scene.
        """
        known = self._classes.get(name)
        same = known is None or (known.__module__, known.__qualname__) == (cls.__module__, cls.__qualname__)
        if known is not None and not same and not known.__module__.startswith(FILE_MODULE):
            raise TypeError(
                f"{self.kind} {name!r} is defined twice: {known.__module__}.{known.__qualname__} and "
                f"{cls.__module__}.{cls.__qualname__}"
            )
        self._classes[name] = cls
        self._by_module.setdefault(cls.__module__, {})[name] = cls
        tables.forget_schemas()  # those of tables that take any class of this kind

    def classes(self) -> dict[str, type[T]]:
        """Return name → class, sorted by name, those of vbnfault first."""
        if not self._complete:
            for info in pkgutil.iter_modules(importlib.import_module(self.package).__path__):
                importlib.import_module(f"{self.package}.{info.name}")
            self._complete = True

        return dict(sorted(self._classes.items(), key=lambda item: (not self.is_packaged(item[1]), item[0])))

    def restore(self, module: str) -> None:
        """Register the classes of a module again, which another scene may have replaced."""
        self._classes |= self._by_module.get(module, {})
        tables.forget_schemas()

    def forget(self, module: str) -> None:
        """Remove the classes of a module."""
        for name, cls in self._by_module.pop(module, {}).items():
            if self._classes.get(name) is cls:
                del self._classes[name]
        tables.forget_schemas()

    def is_packaged(self, cls: type[T]) -> bool:
        """Return whether a class belongs to vbnfault itself."""
        return cls.__module__.startswith(f"{self.package}.")


def restore(module: str) -> None:
    """Register the classes of a plug-in's module again, of every kind."""
    for registry in _registries:
        registry.restore(module)


def forget(module: str) -> None:
    """Remove the classes of a plug-in's module, of every kind."""
    for registry in _registries:
        registry.forget(module)


def chained(after: Mapping[str, str], packaged: Collection[str], kind: str) -> tuple[str, ...]:
    """Return names in the order that follows from what each comes after.

    The names form a tree with one root, which comes after "". Those in `packaged` are one long branch of it; any
    other comes directly behind the name that it comes after, in alphabetical order.

    Raises
    ------
    TypeError
        A name comes after one that does not exist, or names come after each other in a circle. `kind` says in the
        message what the names are.
    """
    followers: dict[str, list[str]] = {"": [], **{name: [] for name in after}}
    for name in sorted(after, key=lambda name: (name in packaged, name)):
        if after[name] not in followers:
            hint = tables.did_you_mean(after[name], list(after))
            raise TypeError(f"{kind} {name}: after = {after[name]!r}: there is none of this name{hint}")
        followers[after[name]].append(name)
    order: list[str] = []
    pending = followers[""][::-1]
    while pending:
        order.append(pending.pop())
        pending += followers[order[-1]][::-1]
    circle = sorted(set(after) - set(order))
    if circle:
        raise TypeError(f"{kind}: what {', '.join(circle)} state by `after` runs in a circle")
    return tuple(order)
