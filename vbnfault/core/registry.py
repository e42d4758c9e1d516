"""Keep what registers itself by being defined: fault models, ground reflectances, detector effects, glasses.

One rule holds for every kind: a name has one definition. A module may define its classes again, as after an edit in
a notebook, and so may another module that was loaded from the same file. Any other module may not, unless the first
one is a plug-in's file that the scene in use does not name (`set_aside`).
"""

from __future__ import annotations

import contextlib
import importlib
import os
import pkgutil
import re
import sys
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from typing import Any, NamedTuple, TypeVar

from . import tables

T = TypeVar("T")

_NAME = re.compile("[a-z][a-z0-9_]*")

_registries: list[Registry[Any]] = []
# Modules and packages of plug-ins that the scene in use does not name, and the modules among them whose definitions
# others may replace.
_unused: set[str] = set()
_replaceable: set[str] = set()


class DeclarationError(TypeError):
    """Report that registered classes are declared wrongly, or contradict each other.

    `names` holds the names of the classes concerned.
    """

    def __init__(self, names: Iterable[str], message: str) -> None:
        super().__init__(message)
        self.names = tuple(names)


class _Definition(NamedTuple):
    """Hold a registered entry, the module that defines it, and its name in that module ("": it has none).

    `file` is the path of the module's file, or its name where it has none.
    """

    entry: Any
    module: str
    qualname: str
    file: str

    def may_replace(self, known: _Definition) -> bool:
        """Return whether this is a newer state of a known definition: from the same file, and of the same name."""
        same_file = os.path.realpath(self.file) == os.path.realpath(known.file)
        # a file may be imported and be a scene's plug-in too, which makes two modules of it
        return same_file and (
            self.module != known.module or (self.qualname != "" and self.qualname == known.qualname)
        )


class Registry(Mapping[str, T]):
    """Map names to what was registered of one kind, such as classes; vbnfault's own first, each sorted by name.

    The modules of a package of vbnfault are imported at the first question. Anything else registers when its own
    module is imported.

    Parameters
    ----------
    kind
        What the entries are, for messages.
    package
        Dotted name of the package whose modules define the entries of vbnfault.
    own_modules
        False if that package is imported elsewhere.
    changed
        Called after every change, to forget what was computed from the entries.
    """

    def __init__(
        self, kind: str, package: str, *, own_modules: bool = True, changed: Callable[[], None] = lambda: None
    ) -> None:
        self.kind, self.package = kind, package
        self._changed = changed
        self._definitions: dict[str, _Definition] = {}
        self._by_module: dict[str, dict[str, _Definition]] = {}
        self._complete = not own_modules
        _registries.append(self)

    def add(self, name: str, entry: T, *, module: str, qualname: str = "") -> None:
        """Register an entry that `module` defines, in which it has the name `qualname` if it has one.

        Raises
        ------
        DeclarationError
            Another definition has the name, and its module is not replaceable.
        """
        self._put(name, _Definition(entry, module, qualname, source_file(module)))
        self.forget_results()

    def _put(self, name: str, new: _Definition) -> None:
        """Register a definition; see `add`."""
        known = self._definitions.get(name)
        if known is not None and known.module not in _replaceable:
            replaces = new.may_replace(known)
            if known.entry == new.entry and not replaces:
                return
            if not replaces:
                files = dict.fromkeys([known.file, new.file])
                raise DeclarationError([name], f"{self.kind} {name} is defined twice: in {' and in '.join(files)}")
        self._definitions[name] = new
        self._by_module.setdefault(new.module, {})[name] = new

    def forget_results(self) -> None:
        """Forget what was computed from the entries, such as the schemas of tables that take any of them."""
        tables.forget_schemas()
        self._changed()

    def __getitem__(self, name: str) -> T:
        self.complete()
        entry: T = self._definitions[name].entry
        return entry

    def __iter__(self) -> Iterator[str]:
        self.complete()
        return iter(sorted(self._definitions, key=lambda name: (not self._is_ours(name), name)))

    def __len__(self) -> int:
        self.complete()
        return len(self._definitions)

    def complete(self) -> None:
        """Import the modules of the package, once, so that all of them are registered."""
        if not self._complete:
            for info in pkgutil.iter_modules(importlib.import_module(self.package).__path__):
                importlib.import_module(f"{self.package}.{info.name}")
            self._complete = True

    def registered(self) -> dict[str, T]:
        """Return the entries so far, in the order of their definition, without importing anything."""
        return {name: definition.entry for name, definition in self._definitions.items()}

    def is_replaceable(self, name: str) -> bool:
        """Return whether other modules may define a registered name again."""
        return self._definitions[name].module in _replaceable

    def unused(self) -> set[str]:
        """Return the registered names that belong to plug-ins which the scene in use does not name."""
        return {
            name
            for name, definition in self._definitions.items()
            if definition.module in _unused or definition.module.split(".")[0] in _unused
        }

    def holds(self, name: str, cls: type) -> bool:
        """Return whether a name belongs to a class, or to the same class of the same file, loaded another way."""
        self.complete()
        known = self._definitions.get(name)
        if known is None:
            return False
        asked = _Definition(cls, cls.__module__, cls.__qualname__, source_file(cls.__module__))
        return known.entry is cls or (known.module != asked.module and asked.may_replace(known))

    def remove(self, names: Iterable[str]) -> None:
        """Remove entries until `restore` registers their module again."""
        for name in list(names):
            del self._definitions[name]
        self.forget_results()

    def restore(self, module: str) -> None:
        """Register the entries of a module again, which another scene may have replaced."""
        for name, definition in self._by_module.get(module, {}).items():
            self._put(name, definition)
        self.forget_results()

    def forget(self, module: str) -> None:
        """Remove the entries of a module for good."""
        for name, definition in self._by_module.pop(module, {}).items():
            if self._definitions.get(name) is definition:
                del self._definitions[name]
        self.forget_results()

    def snapshot(self) -> Callable[[], None]:
        """Return a function that undoes all later registrations, except those of vbnfault."""
        definitions = dict(self._definitions)
        by_module = {module: dict(names) for module, names in self._by_module.items()}

        def undo() -> None:
            self._definitions = {n: d for n, d in self._definitions.items() if self._is_ours(n)} | definitions
            self._by_module = by_module
            self.forget_results()

        return undo

    def is_packaged(self, cls: type) -> bool:
        """Return whether a class belongs to vbnfault itself."""
        return cls.__module__.startswith(f"{self.package}.")

    def _is_ours(self, name: str) -> bool:
        """Return whether the entry of a name belongs to vbnfault itself."""
        return f"{self._definitions[name].module}.".startswith(f"{self.package}.")


def source_file(module: str) -> str:
    """Return the file of a module, or its name."""
    return str(getattr(sys.modules.get(module), "__file__", None) or module)


def is_name(name: object) -> bool:
    """Return whether a class may register by a name: lower-case letters, digits and underscores."""
    return isinstance(name, str) and _NAME.fullmatch(name) is not None


def set_aside(unused: Iterable[str], replaceable: Iterable[str]) -> None:
    """Say which modules belong to plug-ins that the scene in use does not name.

    The orders of effects do not depend on them. Others may define again what those in `replaceable` define.
    """
    wanted = set(unused), set(replaceable)
    if wanted == (_unused, _replaceable):
        return
    for names, kept in zip(wanted, (_unused, _replaceable), strict=True):
        kept.clear()
        kept.update(names)
    for registry in _registries:
        registry.forget_results()


def restore(module: str) -> None:
    """Register what a plug-in's module defines again, of every kind."""
    for registry in _registries:
        registry.restore(module)


def forget(module: str) -> None:
    """Remove what a plug-in's module defines, of every kind."""
    for registry in _registries:
        registry.forget(module)


@contextlib.contextmanager
def undoing_registrations(*, always: bool = False) -> Iterator[None]:
    """Forget what a block registers, of every kind, if the block raises an exception, or `always`."""
    known = list(_registries)
    undos = [registry.snapshot() for registry in known]
    before = set(_unused), set(_replaceable)
    undo = True
    try:
        yield
        undo = always
    finally:
        if undo:
            set_aside(*before)
            for put_back in undos:
                put_back()


def chained(
    after: Mapping[str, str], packaged: Collection[str], kind: str, unused: Collection[str] = ()
) -> tuple[str, ...]:
    """Return names in the order that follows from what each comes after.

    The names form a tree with one root, which comes after "". Those in `packaged` are one long branch of it; any
    other comes directly behind the name that it comes after, in alphabetical order. Names in `unused` belong to
    plug-ins that the scene in use does not name: no other name may come after them, and those without a place are
    left out.

    Raises
    ------
    DeclarationError
        A name comes after one that does not exist, or names come after each other in a circle. `kind` says in the
        message what the names are.
    """
    used = {name: after[name] for name in after if name not in unused}
    followers: dict[str, list[str]] = {"": [], **{name: [] for name in after}}
    for name in sorted(after, key=lambda name: (name in packaged, name)):
        if name in used and after[name] not in ("", *used):
            hint = tables.did_you_mean(after[name], list(used))
            text = f"{kind} {name}: after = {after[name]!r}: there is none of this name{hint}"
            raise DeclarationError([name], text)
        followers.get(after[name], []).append(name)
    order: list[str] = []
    pending = followers[""][::-1]
    while pending:
        order.append(pending.pop())
        pending += followers[order[-1]][::-1]
    circle = sorted(set(used) - set(order))
    if circle:
        raise DeclarationError(circle, f"{kind}: what {', '.join(circle)} state by `after` runs in a circle")
    return tuple(order)
