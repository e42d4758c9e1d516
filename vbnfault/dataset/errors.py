"""Define the errors that end a build early."""

from __future__ import annotations

from collections.abc import Mapping

from ..core.errors import VbnfaultError


class Interrupted(VbnfaultError):
    """Report that the user or the system stopped the build; the same command resumes it.

    `exit_code`: 128 + the signal's number.
    """

    def __init__(self, sentence: str, exit_code: int = 130) -> None:
        super().__init__(sentence)
        self.exit_code = exit_code


class BuildFailed(VbnfaultError):
    """Report that some samples could not be made.

    `failures`: by sample, one line and the traceback, or a sentence on how its worker ended.
    """

    def __init__(self, sentence: str, failures: Mapping[int, str] | None = None) -> None:
        super().__init__(sentence)
        self.failures = dict(failures or {})
