"""Determine the files that hold the code of a plug-in, and their digest.

- The code of a plug-in that is one file is this file and all files of its own folder that it imports, directly or
  through each other. `import traps` imports `traps.py` or `traps/__init__.py` of this folder.
- The code of a module within a package is all source files and extensions of the top-level package.

The imports are read from the source, so the digest does not depend on what a process has imported before. Imports
by a computed name are not noticed. Modules from another folder, such as the working folder or one that PYTHONPATH
names, do not count: they may belong to the user's own program, which must not be executed again with the plug-in. A
file in a folder of installed packages has no folder of its own.
"""

from __future__ import annotations

import ast
import importlib.machinery
import os
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

from ..core import registry, user_files
from ..core.errors import InputError
from ..core.resources import PACKAGE

_INSTALLED = ("site-packages", "dist-packages")
_SUFFIXES = (*importlib.machinery.SOURCE_SUFFIXES, *importlib.machinery.EXTENSION_SUFFIXES)


def is_beside(file: str, folder: str) -> bool:
    """Return whether a file belongs to the code of a plug-in whose own folder is given."""
    below = file.removeprefix(os.path.join(folder, "")).split(os.sep)
    return file.startswith(os.path.join(folder, "")) and not {os.path.basename(folder), *below} & set(_INSTALLED)


def digest_of_file(path: str) -> str:
    """Return the SHA-256 (hex) of a plug-in's file and of its imports from its own folder. Raises InputError."""
    data = user_files.read_input(path, "plug-in", types=(".py",))
    digest = user_files.sha256(data)
    helpers = _imported_beside(path, data)
    if not helpers:
        return digest
    return user_files.sha256("\n".join([digest, *(f"{name} {helpers[name]}" for name in sorted(helpers))]).encode())


def digest_of_module(name: str) -> str:
    """Return the SHA-256 (hex) of the sources of a module that has been imported. Raises InputError."""
    top = sys.modules[name.split(".")[0]]
    if not hasattr(top, "__path__"):
        if top.__file__ is None:
            raise InputError("has no source file")
        return digest_of_file(top.__file__) if top.__file__.endswith(".py") else _digest(Path(top.__file__))
    digests = []
    for folder in top.__path__:
        files = [path for path in Path(folder).rglob("*") if path.name.endswith(_SUFFIXES) and path.is_file()]
        for path in sorted(files, key=lambda path: path.relative_to(folder).as_posix()):
            if path.stat().st_size:  # an empty __init__.py is usual
                digests.append(f"{path.relative_to(folder).as_posix()} {_digest(path)}")
    return user_files.sha256("\n".join(digests).encode())


def forget_imports(path: str) -> dict[str, ModuleType]:
    """Remove the modules that a plug-in's file imports from its own folder from `sys.modules`, and return them.

    The next import of the plug-in then reads their files again. The result has the modules by their names.
    """
    helpers = _imported_beside(path, user_files.read_input(path, "plug-in"))
    tops, folder = {name.split("/")[0].split(".")[0] for name in helpers}, os.path.dirname(path)
    old = {}
    for name, module in list(sys.modules.items()):
        file = getattr(module, "__file__", None) or next(iter(getattr(module, "__path__", [])), "")
        if name.split(".")[0] in tops and is_beside(os.path.realpath(file), os.path.realpath(folder)):
            registry.forget(name)
            old[name] = sys.modules.pop(name)
    return old


def _digest(path: Path) -> str:
    """Return the SHA-256 (hex) of one file of a plug-in."""
    return user_files.sha256(user_files.read_input(path, "plug-in"))


def _imported_beside(path: str, data: bytes) -> dict[str, str]:
    """Return the digest of each file that a plug-in's file imports from its folder, by its path from there."""
    folder = Path(path).parent
    if not is_beside(path, str(folder)):
        return {}
    digests: dict[str, str] = {}
    pending = [(data, "")]
    while pending:
        source, package = pending.pop()
        for imported in _imported_names(source, package):
            for file, its_package in _files_of(folder, imported):
                name = file.relative_to(folder).as_posix()
                if name in digests or file == Path(path) or not file.stat().st_size:
                    continue
                contents = user_files.read_input(file, "plug-in")
                digests[name] = user_files.sha256(contents)
                if file.suffix == ".py":
                    pending.append((contents, its_package))
    return digests


def _imported_names(source: bytes, package: str) -> Iterator[str]:
    """Yield the dotted names that a source file imports: modules, and classes or functions within modules."""
    try:
        tree = ast.parse(source)
    except (SyntaxError, ValueError):
        return  # the import of the module will report the error
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            parents = package.split(".")[: len(package.split(".")) - node.level + 1] if node.level else []
            module = ".".join([*parents, *([node.module] if node.module else [])])
            yield from (f"{module}.{alias.name}".lstrip(".") for alias in node.names)


def _files_of(folder: Path, dotted: str) -> Iterator[tuple[Path, str]]:
    """Yield each file below a folder that the import of a dotted name executes, and the package of the file."""
    parts = dotted.split(".")
    if parts[0] == PACKAGE.name:
        return
    for k in range(len(parts)):
        here = folder.joinpath(*parts[: k + 1])
        for suffix in _SUFFIXES:
            own, module = here / f"__init__{suffix}", here.with_name(here.name + suffix)
            if own.is_file():
                yield own, ".".join(parts[: k + 1])
            elif module.is_file():
                yield module, ".".join(parts[:k])
