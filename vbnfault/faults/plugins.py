"""Load fault models, ground reflectances, detector effects and glasses from outside the package.

A plug-in is a Python module that defines classes of these kinds. It is found in one of two ways:

- An installed distribution names it in the entry-point group `vbnfault.faults`. It is then known to every scene.
- The scene file names it: `plugins = ["my_module", "folder/my_fault.py"]`, as a module that can be imported or as
  a file beside the scene file.

Every process that works on a scene loads its plug-ins by itself, and keeps them. The digest of a plug-in's source
belongs to the identity of a store:

- The source of a plug-in that is one file is this file and all files of its own folder that it imports, directly or
  through each other. `import traps` imports `traps.py` or `traps/__init__.py` of this folder.
- The source of a module within a package is all source files and extensions of the top-level package.

The imports are read from the source, so the digest does not depend on what a process has imported before. Imports
by a computed name are not noticed. Modules from another folder, such as the working folder or one that PYTHONPATH
names, do not count: they may belong to the user's own program, which must not be executed again with the plug-in. A
file in a folder of installed packages has no folder of its own.
"""

from __future__ import annotations

import contextlib
import importlib
import importlib.machinery
import importlib.metadata
import os
import re
import sys
import traceback
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from modulefinder import ModuleFinder
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any

from ..core import registry
from ..core.errors import InputError, VbnfaultError, shown
from ..core.files import user_files
from ..core.files.resources import PACKAGE
from ..core.process import environment
from ..core.process.interrupts import check
from ..detector import effects
from . import models

if TYPE_CHECKING:
    from .contract import Fault

ENTRY_POINTS = "vbnfault.faults"
# The names of modules that are the files of plug-ins begin with this.
_FILE_MODULE = "vbnfault_plugin_"
_MODULE = re.compile(r"[^\W\d]\w*(\.[^\W\d]\w*)*")
_FOLDER = 5  # what `ModuleFinder` calls PKG_DIRECTORY
_SUFFIXES = (*importlib.machinery.SOURCE_SUFFIXES, *importlib.machinery.EXTENSION_SUFFIXES)


@dataclass(frozen=True)
class Plugin:
    """Describe a plug-in that this process has loaded.

    Attributes
    ----------
    name
        The name of its file, or of its module, as stores and messages name it.
    sha256
        The digest of its source when it was loaded.
    file
        The path of the file that a scene names; "" for a module.
    """

    name: str
    sha256: str
    file: str = ""

    def defines(self, cls: type[Fault]) -> bool:
        """Return whether a model is defined in its file, or in the top-level package of its module."""
        if self.file:
            return registry.source_file(cls.__module__) == os.path.realpath(self.file)
        return cls.__module__.split(".")[0] == self.name.split(".")[0]

    @property
    def models(self) -> list[type[Fault]]:
        """Return the registered fault models that this plug-in defines."""
        return [cls for cls in models.registered() if self.defines(cls)]

    @property
    def model_names(self) -> list[str]:
        """Return the names of its models as "class/model", sorted."""
        return sorted(f"{cls.fault}/{cls.model}" for cls in self.models)


# Every plug-in that this process has loaded, by its absolute path or its module name.
loaded: dict[str, Plugin] = {}


def load_plugins(names: Sequence[str]) -> None:
    """Load the plug-ins that a scene names, each once. A file that has changed is loaded again.

    Parameters
    ----------
    names
        Names of modules, and paths that end with ".py".

    Raises
    ------
    InputError
        If a plug-in is missing or broken, or clashes with another fault. Nothing of it stays loaded.
    """
    models.registry()  # first the faults that every scene has
    _load({name: f"plugins = {shown(name)}" for name in names})


def load_installed() -> None:
    """Load the plug-ins of all installed distributions. Raises InputError that names the broken one."""
    _load({module: f"installed plug-in {entry.name} ({entry.value})" for module, entry in _installed().items()})


def _load(wanted: Mapping[str, str]) -> None:
    """Load plug-ins, each with its name in messages, together or not at all."""
    new, modules = dict(loaded), dict(sys.modules)
    try:
        with registry.undoing_registrations():
            for name, where in wanted.items():
                with _errors_named(where):
                    is_path = name.endswith(".py") or "/" in name or os.sep in name
                    new[name] = _load_file(name) if is_path else _load_module(name)
            _check_together({where: new[name] for name, where in wanted.items()})
    except BaseException:  # the next attempt imports them anew
        tops = {name.split(".")[0] for name in wanted}
        for name in sys.modules.keys() - modules:
            if name.split(".")[0] in tops:
                del sys.modules[name]
        for name in modules.keys() - sys.modules:  # helpers of a file that was to be loaded again
            sys.modules[name] = modules[name]
        raise
    loaded.update(new)


def plugins_of(faults: Mapping[str, Fault], named: Sequence[str]) -> tuple[Plugin, ...]:
    """Return the plug-ins that a scene depends on: those that it names, and those that define one of its faults.

    Their sources are read again and compared with what this process has loaded.

    Parameters
    ----------
    faults
        The faults of the scene.
    named
        The scene's key `plugins`.

    Raises
    ------
    InputError
        If a fault comes from a plug-in file that the scene does not name, or if a module has changed since it was
        loaded.
    """
    wanted = {name: loaded[name] for name in named}
    for name, fault in faults.items():
        for key, plugin in loaded.items():
            if plugin.defines(type(fault)) and key not in wanted:
                if key not in _installed():
                    raise InputError(
                        f"faults.{name}.model = {fault.model!r}: comes from the plug-in {plugin.name}, which the "
                        "scene does not name; add it to plugins"
                    )
                wanted[key] = plugin
    for key, plugin in wanted.items():
        if plugin.file:
            _digest_of_file(key)  # notices a change during a build
        elif _digest_of_module(key) != plugin.sha256:
            raise InputError(
                f"the plug-in {plugin.name} has changed since this process loaded it; start Python again, or the "
                "workers of the cluster"
            )
    return tuple(sorted(wanted.values(), key=lambda plugin: plugin.name))


def loaded_plugin(name: str) -> Plugin | None:
    """Return the plug-in of this name that this process has loaded, or None."""
    models.registry()
    return next((plugin for plugin in loaded.values() if plugin.name == name), None)


def belongs_here(fault: Fault) -> bool:
    """Return whether another process can load a model: it belongs to vbnfault or to a plug-in."""
    cls = type(fault)
    return models.is_packaged(cls) or any(plugin.defines(cls) for plugin in loaded.values())


@lru_cache(maxsize=1)
def _installed() -> dict[str, importlib.metadata.EntryPoint]:
    """Return the entry points of installed plug-ins by their modules."""
    entries = importlib.metadata.entry_points(group=ENTRY_POINTS)
    return {entry.module: entry for entry in sorted(entries, key=lambda e: (e.module, e.name))}


# --- files and modules --------------------------------------------------------------------------------------


def _load_file(path: str) -> Plugin:
    """Return the plug-in of a file, executed again if it or what it imports from its folder has changed."""
    data, known = user_files.read_input(path, "plug-in", types=(".py",)), loaded.get(path)
    digest = _digest_of_file(path)
    if known is not None and known.sha256 == digest:
        return known
    registry.forget(path)
    for helper, file in _imported_beside(path).items():  # so that what runs is what the digest covers
        if registry.source_file(helper) == os.path.realpath(file):
            registry.forget(str(file))
            del sys.modules[helper]
    stem = re.sub(r"\W", "_", Path(path).stem)
    name = f"{_FILE_MODULE}{stem}_{user_files.sha256(f'{path} {digest}'.encode())[:16]}"
    sys.modules[name] = module = ModuleType(name)  # a dataclass looks its module up
    module.__file__ = path
    exec(compile(data, path, "exec", dont_inherit=True), module.__dict__)
    return Plugin(Path(path).name, digest, path)


def _load_module(name: str) -> Plugin:
    """Return the plug-in of a module that can be imported, without a search in the working folder."""
    if not _MODULE.fullmatch(name):
        raise InputError("must be the name of a module, or the path of a file that ends with .py")
    if name in loaded:
        return loaded[name]
    path = sys.path.copy()
    sys.path[:] = environment.import_path()  # as in a worker process
    try:
        importlib.import_module(name)
    except ModuleNotFoundError as error:
        if error.name is not None and f"{name}.".startswith(f"{error.name}."):
            raise InputError(
                "no such module; install it or put its folder into PYTHONPATH, or give the path of its file, which "
                "ends with .py"
            ) from None
        raise
    finally:
        sys.path[:] = path
    entry = _installed().get(name)
    if entry is not None and entry.attr and not hasattr(sys.modules[name], entry.attr):
        raise InputError(f"its module has no {entry.attr}")
    return Plugin(name, _digest_of_module(name))


# --- digests ------------------------------------------------------------------------------------------------


def _digest_of_file(path: str) -> str:
    """Return the SHA-256 (hex) of a plug-in's file and of its imports from its own folder. Raises InputError."""
    digest = user_files.sha256(user_files.read_input(path, "plug-in"))
    helpers = _digests(_imported_beside(path).values(), Path(path).parent)
    return user_files.sha256("\n".join([digest, *helpers]).encode()) if helpers else digest


def _digest_of_module(name: str) -> str:
    """Return the SHA-256 (hex) of the sources of a module that has been imported. Raises InputError."""
    top = sys.modules[name.split(".")[0]]
    if not hasattr(top, "__path__"):
        if top.__file__ is None:
            raise InputError("has no source file")
        return _digest_of_file(top.__file__)
    digests = []
    for folder in top.__path__:
        files = (path for path in Path(folder).rglob("*") if path.name.endswith(_SUFFIXES) and path.is_file())
        digests += _digests(files, Path(folder))
    return user_files.sha256("\n".join(digests).encode())


def _digests(files: Iterable[Path], folder: Path) -> list[str]:
    """Return the path from a folder and the SHA-256 (hex) of each file, sorted; empty files are left out."""
    return sorted(
        f"{path.relative_to(folder).as_posix()} {user_files.sha256(user_files.read_input(path, 'plug-in'))}"
        for path in files
        if path.stat().st_size  # an empty __init__.py is usual
    )


class _Finder(ModuleFinder):
    """Find what a file imports, also from folders without an `__init__.py`."""

    def find_module(self, name: str, path: Any, parent: Any = None) -> Any:
        """Return a module as `ModuleFinder` does."""
        try:
            return super().find_module(name, path, parent)
        except (ImportError, AttributeError):
            for folder in path or self.path:
                if os.path.isdir(os.path.join(folder, name)):
                    return None, os.path.join(folder, name), ("", "", _FOLDER)
            raise ImportError(name) from None

    def load_package(self, fqname: str, pathname: str) -> Any:
        """Load a package as `ModuleFinder` does, or else only its folder."""
        with contextlib.suppress(ImportError):
            return super().load_package(fqname, pathname)
        package: Any = self.modules[fqname]
        package.__file__ = None
        return package


def _imported_beside(path: str) -> dict[str, Path]:
    """Return the files that a plug-in's file imports from its own folder, by the names of their modules."""
    folder = os.path.dirname(path)
    if {"site-packages", "dist-packages"} & set(Path(folder).parts):
        return {}
    finder = _Finder(path=[folder], excludes=[PACKAGE.name])
    with contextlib.suppress(SyntaxError, ValueError):  # its execution will report them
        finder.run_script(path)
    files = {name: getattr(module, "__file__", None) for name, module in finder.modules.items()}
    return {name: Path(file) for name, file in files.items() if file and file != path}


# --- errors -------------------------------------------------------------------------------------------------


def _check_together(plugins: Mapping[str, Plugin]) -> None:
    """Raise InputError if the names or the orders of plug-ins contradict; the keys name them in the message."""
    by_name: dict[str, str] = {}
    for where, plugin in plugins.items():
        if by_name.setdefault(plugin.name, plugin.file) != plugin.file:
            raise InputError(f"{where}: another plug-in of the scene has the name {plugin.name}, too; rename one")
    try:
        models.catalogue()
        effects.order()
    except registry.DeclarationError as error:
        guilty = [w for w, p in plugins.items() if any(cls.fault in error.names for cls in p.models)]
        earlier = [p.file or p.name for p in loaded.values() if any(cls.fault in error.names for cls in p.models)]
        hint = "" if guilty or not earlier else f"; an earlier scene has loaded {earlier[0]}: start Python again"
        raise InputError(f"{', '.join(guilty or plugins) or 'plug-ins'}: {error}{hint}") from None


@contextlib.contextmanager
def _errors_named(where: str) -> Iterator[None]:
    """Turn every error of a plug-in's code into an InputError of one sentence that begins with `where`."""
    try:
        yield
    except InputError as error:
        raise InputError(f"{where}: {error}") from None
    except (Exception, SystemExit) as error:
        check()
        if isinstance(error, VbnfaultError):  # such as a file that changed during a build
            raise
        text = (str(error).splitlines() or [""])[0]
        if not isinstance(error, registry.DeclarationError):
            text = f"cannot be loaded: {type(error).__name__}{text and ': '}{text}"
        raise InputError(f"{where}: {text}{_line(error)}") from None


def _line(error: BaseException) -> str:
    """Return the line of a plug-in's code that raised an error, as a clause; empty if it is unknown."""
    if isinstance(error, SyntaxError):
        return ""  # its message has the line
    frames = [
        frame
        for frame in traceback.extract_tb(error.__traceback__)
        if not frame.filename.startswith((str(PACKAGE), "<frozen")) and "importlib" not in frame.filename
    ]
    if not frames:
        return ""
    # the outermost frame is the plug-in's; a library that it calls lies elsewhere
    folder = os.path.dirname(frames[0].filename)
    own = [frame for frame in frames if os.path.dirname(frame.filename).startswith(folder)]
    return f" ({os.path.basename(own[-1].filename)}, line {own[-1].lineno})"
