"""Define the errors that end a build early."""

from __future__ import annotations

from collections.abc import Mapping

from ..core.errors import VbnfaultError
from ..core.interrupts import Interrupted

__all__ = ["BuildFailed", "Interrupted"]


class BuildFailed(VbnfaultError):
    """Report that some samples could not be made.

    `failures`: by sample, one line and the traceback, or a sentence on how its worker ended.
    """

    def __init__(self, sentence: str, failures: Mapping[int, str] | None = None) -> None:
        super().__init__(sentence)
        self.failures = dict(failures or {})
