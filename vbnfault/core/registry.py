"""Keep what registers itself by being defined: fault models, ground reflectances, detector effects, glasses.

One rule holds for every kind: a name has one definition. Only the same class of the same file may define it again,
as after an edit in a notebook.
"""

from __future__ import annotations

import contextlib
import importlib
import os
import pkgutil
import re
import sys
from collections.abc import Collection, Iterable, Iterator, Mapping
from typing import Any, NamedTuple, TypeVar

from . import tables

T = TypeVar("T")

_NAME = re.compile("[a-z][a-z0-9_]*")

_registries: list[Registry[Any]] = []


class DeclarationError(TypeError):
    """Report that registered classes are declared wrongly, or contradict each other.

    `names` holds the names of the classes concerned.
    """

    def __init__(self, names: Iterable[str], message: str) -> None:
        super().__init__(message)
        self.names = tuple(names)


class _Definition(NamedTuple):
    """Hold a registered entry and where it is defined: its name in the file ("": it has none), and the file.

    `ours` says whether the entry belongs to vbnfault.
    """

    entry: Any
    qualname: str
    file: str
    ours: bool


class Registry(Mapping[str, T]):
    """Map names to what was registered of one kind, such as classes; vbnfault's own first, each sorted by name.

    The modules of a package of vbnfault are imported at the first question. Anything else registers when its own
    module is imported. `version` rises with every change, so that a cache can have it in its key.

    Parameters
    ----------
    kind
        What the entries are, for messages.
    package
        Dotted name of the package whose modules define the entries of vbnfault.
    own_modules
        False if that package is imported elsewhere.
    """

    def __init__(self, kind: str, package: str, *, own_modules: bool = True) -> None:
        self.kind, self.package = kind, package
        self.version = 0
        self._definitions: dict[str, _Definition] = {}
        self._complete = not own_modules
        _registries.append(self)

    def add(self, name: str, entry: T, *, module: str, qualname: str = "") -> None:
        """Register an entry that `module` defines, in which it has the name `qualname` if it has one.

        Raises
        ------
        DeclarationError
            Another definition has the name.
        """
        file = source_file(module)
        new = _Definition(entry, qualname, file, f"{module}.".startswith(f"{self.package}."))
        known = self._definitions.get(name, new)
        again = qualname != "" and (known.qualname, known.file) == (qualname, file)
        if known.entry != entry and not again:
            files = dict.fromkeys([known.file, file])
            text = f"{self.kind} {name} is defined twice: in {' and in '.join(files)}"
            hint = (
                "; rename one, or start Python again if an earlier scene has loaded the other"
                if len(files) > 1
                else ""
            )
            raise DeclarationError([name], text + hint)
        self._replace(self._definitions | {name: new})

    def _replace(self, definitions: dict[str, _Definition]) -> None:
        """Hold other definitions, and let all that was computed from the former ones be computed anew."""
        self._definitions = definitions
        self.version += 1
        tables.forget_schemas()

    def __getitem__(self, name: str) -> T:
        self.complete()
        entry: T = self._definitions[name].entry
        return entry

    def __iter__(self) -> Iterator[str]:
        self.complete()
        return iter(sorted(self._definitions, key=lambda name: (not self._definitions[name].ours, name)))

    def __len__(self) -> int:
        self.complete()
        return len(self._definitions)

    def complete(self) -> None:
        """Import the modules of the package, once, so that all of them are registered."""
        if not self._complete:
            for info in pkgutil.iter_modules(importlib.import_module(self.package).__path__):
                importlib.import_module(f"{self.package}.{info.name}")
            self._complete = True

    def is_packaged(self, cls: type) -> bool:
        """Return whether a class belongs to vbnfault itself."""
        return cls.__module__.startswith(f"{self.package}.")


def is_name(name: object) -> bool:
    """Return whether a class may register by a name: lower-case letters, digits and underscores."""
    return isinstance(name, str) and _NAME.fullmatch(name) is not None


def source_file(module: str) -> str:
    """Return the real path of a module's file, or the module's name; several modules may be made of one file."""
    file = getattr(sys.modules.get(module), "__file__", None)
    return os.path.realpath(file) if file else module


def forget(file: str) -> None:
    """Remove what a file defines, of every kind, before it is executed again."""
    for registry in _registries:
        kept = {name: d for name, d in registry._definitions.items() if d.file != os.path.realpath(file)}
        if len(kept) < len(registry._definitions):
            registry._replace(kept)


@contextlib.contextmanager
def undoing_registrations(*, always: bool = False) -> Iterator[None]:
    """Forget what a block registers, of every kind, if the block raises an exception, or `always`."""
    before = [(registry, registry._definitions) for registry in _registries]
    undo = True
    try:
        yield
        undo = always
    finally:
        for registry, definitions in before if undo else ():
            # modules of vbnfault are imported once
            ours = {name: d for name, d in registry._definitions.items() if d.ours}
            registry._replace(ours | definitions)


def chained(after: Mapping[str, str], packaged: Collection[str], kind: str) -> tuple[str, ...]:
    """Return names in the order that follows from what each comes after.

    The names form a tree with one root, which comes after "". Those in `packaged` are one long branch of it; any
    other comes directly behind the name that it comes after, in alphabetical order.

    Raises
    ------
    DeclarationError
        A name comes after one that does not exist, or names come after each other in a circle. `kind` says in the
        message what the names are.
    """
    followers: dict[str, list[str]] = {"": [], **{name: [] for name in after}}
    for name in sorted(after, key=lambda name: (name in packaged, name)):
        if after[name] not in followers:
            hint = tables.did_you_mean(after[name], list(after))
            text = f"{kind} {name}: after = {after[name]!r}: there is none of this name{hint}"
            raise DeclarationError([name], text)
        followers[after[name]].append(name)
    order: list[str] = []
    pending = followers[""][::-1]
    while pending:
        order.append(pending.pop())
        pending += followers[order[-1]][::-1]
    circle = sorted(set(after) - set(order))
    if circle:
        raise DeclarationError(circle, f"{kind}: what {', '.join(circle)} state by `after` runs in a circle")
    return tuple(order)
