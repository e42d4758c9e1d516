"""Let a package be called as its function of the same name."""

from types import ModuleType
from typing import Any


class CallablePackage(ModuleType):
    """Call the function that has the package's own name.

    The attribute of `vbnfault` with this name cannot be the function: the import of any module of the package sets
    it to the package.
    """

    def __call__(self, *arguments: Any, **keywords: Any) -> Any:
        """Call the function; see its own documentation."""
        return getattr(self, self.__name__.rpartition(".")[2])(*arguments, **keywords)
