"""Load fault models, ground reflectances, detector effects and glasses from outside the package.

A plug-in is a Python module that defines classes of these kinds. It is found in one of two ways:

- An installed distribution names it in the entry-point group `vbnfault.faults`. It is then known to every scene.
- The scene file names it: `plugins = ["my_module", "folder/my_fault.py"]`, as a module that can be imported or as
  a file beside the scene file.

Every process that works on a scene loads its plug-ins by itself. The digest of a plug-in's source belongs to the
identity of a store (`plugin_source`).
"""

from __future__ import annotations

import contextlib
import importlib
import importlib.metadata
import os
import re
import sys
import traceback
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING

from ..core import environment, registry, user_files
from ..core.errors import InputError, VbnfaultError, shown
from ..core.interrupts import check
from ..detector import effects
from . import models
from .plugin_source import digest_of_file, digest_of_module, forget_imports, is_beside

if TYPE_CHECKING:
    from .contract import Fault

ENTRY_POINTS = "vbnfault.faults"
# The names of modules that are the files of plug-ins begin with this.
_FILE_MODULE = "vbnfault_plugin_"
_MODULE = re.compile(r"[^\W\d]\w*(\.[^\W\d]\w*)*")


@dataclass(frozen=True)
class Plugin:
    """Describe a plug-in that this process has loaded.

    Attributes
    ----------
    name
        The name of its file, or of its module, as stores and messages name it.
    module
        The name of its module in this process.
    sha256
        The digest of its source when it was loaded.
    models
        The models that it defines.
    """

    name: str
    module: str
    sha256: str
    models: tuple[type[Fault], ...]

    @property
    def is_file(self) -> bool:
        """Return whether the plug-in is a file that a scene names."""
        return self.module.startswith(_FILE_MODULE)

    def defines(self, cls: type[Fault]) -> bool:
        """Return whether a model belongs to this plug-in."""
        return _defines(self.module, cls)

    @property
    def model_names(self) -> list[str]:
        """Return the names of its models as "class/model", sorted."""
        return sorted(f"{cls.fault}/{cls.model}" for cls in self.models)


# Every plug-in that this process has loaded, by its absolute path or its module name.
_loaded: dict[str, Plugin] = {}


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
    paths = {name for name in names if _is_path(name)}
    with _undoing():
        _set_others_aside(names)
        for name in names:
            with _errors_named(f"plugins = {shown(name)}"):
                _loaded[name] = _load_file(name) if name in paths else _load_module(name)
        _check_together({f"plugins = {shown(name)}": _loaded[name] for name in names})


def _set_others_aside(names: Collection[str]) -> None:
    """Tell the registries which of the loaded plug-ins a scene does not name; installed ones count as named."""
    others = [plugin for key, plugin in _loaded.items() if key not in names and key not in _installed()]
    # a plug-in that is a module defines what its top-level package defines
    in_use = {name.split(".")[0] for name in (*names, *_installed())}
    registry.set_aside(
        {plugin.module.split(".")[0] for plugin in others} - in_use,
        {plugin.module for plugin in others if plugin.is_file},
    )


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
    wanted = {name: _loaded[name] for name in named}
    for name, fault in faults.items():
        for key, plugin in _loaded.items():
            if plugin.defines(type(fault)) and key not in wanted:
                if key not in _installed():
                    raise InputError(
                        f"faults.{name}.model = {fault.model!r}: comes from the plug-in {plugin.name}, which the "
                        "scene does not name; add it to plugins"
                    )
                wanted[key] = plugin
    for key, plugin in wanted.items():
        if not plugin.is_file and digest_of_module(plugin.module) != plugin.sha256:
            raise InputError(
                f"the plug-in {plugin.name} has changed since this process loaded it; start Python again, or the "
                "workers of the cluster"
            )
        if plugin.is_file:
            digest_of_file(key)  # notices a change during a build
    return tuple(sorted(wanted.values(), key=lambda plugin: plugin.name))


def loaded_plugin(name: str) -> Plugin | None:
    """Return the plug-in of this name that this process has loaded, or None."""
    models.registry()
    return next((plugin for plugin in _loaded.values() if plugin.name == name), None)


def forget_all() -> None:
    """Forget every plug-in of this process, for tests."""
    for plugin in _loaded.values():
        registry.forget(plugin.module)
    _loaded.clear()


def belongs_here(fault: Fault) -> bool:
    """Return whether another process can load a model: it belongs to vbnfault or to a plug-in."""
    cls = type(fault)
    return models.is_packaged(cls) or any(plugin.defines(cls) for plugin in _loaded.values())


def load_installed() -> None:
    """Load the plug-ins of all installed distributions. Raises InputError that names the broken one."""
    where = {module: f"installed plug-in {entry.name} ({entry.value})" for module, entry in _installed().items()}
    with _undoing():
        for module, entry in _installed().items():
            with _errors_named(where[module]):
                _loaded[module] = _load_module(module)
                if entry.attr and not hasattr(sys.modules[module], entry.attr):
                    raise InputError(f"its module has no {entry.attr}")
        _check_together({where[module]: _loaded[module] for module in where})


@lru_cache(maxsize=1)
def _installed() -> dict[str, importlib.metadata.EntryPoint]:
    """Return the entry points of installed plug-ins by their modules."""
    entries = importlib.metadata.entry_points(group=ENTRY_POINTS)
    return {entry.module: entry for entry in sorted(entries, key=lambda e: (e.module, e.name))}


# --- files and modules --------------------------------------------------------------------------------------


def _is_path(name: str) -> bool:
    """Return whether an entry of `plugins` is a path and not the name of a module."""
    return name.endswith(".py") or "/" in name or os.sep in name


def _load_file(path: str) -> Plugin:
    """Return the plug-in of a file, executed again if it or what it imports from its folder has changed."""
    digest, known = digest_of_file(path), _loaded.get(path)
    if known is not None and known.sha256 == digest:
        return _registered(known)
    if known is not None:
        registry.forget(known.module)
    data = user_files.read_input(path, "plug-in")
    stem = re.sub(r"\W", "_", Path(path).stem)
    name = f"{_FILE_MODULE}{stem}_{user_files.sha256(f'{path} {digest}'.encode())[:16]}"
    former_imports = forget_imports(path)
    module = ModuleType(name)
    module.__file__ = path
    sys.modules[name] = module  # a dataclass looks its module up
    try:
        exec(compile(data, path, "exec", dont_inherit=True), module.__dict__)
    except BaseException:
        del sys.modules[name]
        sys.modules.update(former_imports)
        raise
    return Plugin(Path(path).name, name, digest, models.models_of(lambda cls: _defines(name, cls)))


def _load_module(name: str) -> Plugin:
    """Return the plug-in of a module that can be imported, without a search in the working folder."""
    if not _MODULE.fullmatch(name):
        raise InputError("must be the name of a module, or the path of a file that ends with .py")
    if name in _loaded:
        return _registered(_loaded[name])
    before, path = set(sys.modules), sys.path.copy()
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
    except BaseException:
        for new in set(sys.modules) - before:
            if new.split(".")[0] == name.split(".")[0]:
                del sys.modules[new]
        raise
    finally:
        sys.path[:] = path
    return Plugin(name, name, digest_of_module(name), models.models_of(lambda cls: _defines(name, cls)))


def _registered(plugin: Plugin) -> Plugin:
    """Return a plug-in that was loaded before, with all that it defines: another scene may have replaced that."""
    for cls in plugin.models:
        models.register(cls)
    registry.restore(plugin.module)
    return plugin


def _defines(module: str, cls: type[Fault]) -> bool:
    """Return whether a model is defined in a plug-in's module, or elsewhere in its top-level package."""
    if module.startswith(_FILE_MODULE):
        return cls.__module__ == module
    return cls.__module__.split(".")[0] == module.split(".")[0]


# --- errors -------------------------------------------------------------------------------------------------


@contextlib.contextmanager
def _undoing() -> Iterator[None]:
    """Forget the plug-ins that a block loads, and all that they define, if it raises an exception."""
    before = dict(_loaded)
    try:
        with registry.undoing_registrations():
            yield
    except BaseException:
        for key, plugin in _loaded.items():
            if before.get(key) is not plugin:
                top = plugin.module.split(".")[0]
                for name in [name for name in sys.modules if name.split(".")[0] == top]:
                    del sys.modules[name]
        _loaded.clear()
        _loaded.update(before)
        raise


def _check_together(plugins: Mapping[str, Plugin]) -> None:
    """Raise InputError if the names or the orders of plug-ins contradict; the keys name them in the message."""
    by_name: dict[str, str] = {}
    for where, plugin in plugins.items():
        if by_name.setdefault(plugin.name, plugin.module) != plugin.module:
            raise InputError(f"{where}: another plug-in of the scene has the name {plugin.name}, too; rename one")
    try:
        models.check_declarations()
    except registry.DeclarationError as error:
        guilty = [w for w, p in plugins.items() if any(cls.fault in error.names for cls in p.models)]
        raise InputError(f"{', '.join(guilty) or 'plug-ins'}: {error}") from None
    try:
        effects.order()
    except registry.DeclarationError as error:
        raise InputError(f"{', '.join(plugins) or 'plug-ins'}: {error}") from None


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
    ours = os.path.join(os.path.dirname(os.path.dirname(__file__)), "")
    frames = [
        frame
        for frame in traceback.extract_tb(error.__traceback__)
        if not frame.filename.startswith((ours, "<frozen")) and "importlib" not in frame.filename
    ]
    if not frames:
        return ""
    # the outermost frame is the plug-in's; a library that it calls lies elsewhere
    folder = os.path.dirname(frames[0].filename)
    own = [f for f in frames if f.filename == frames[0].filename or is_beside(f.filename, folder)]
    return f" ({os.path.basename(own[-1].filename)}, line {own[-1].lineno})"
