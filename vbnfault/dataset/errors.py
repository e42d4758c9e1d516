"""How a build ends early."""

from __future__ import annotations

from collections.abc import Mapping

from ..core.errors import VbnfaultError


class Interrupted(VbnfaultError):
    """Stopped by the user or the system; the same command resumes. `exit_code`: 128 + the signal's number."""

    def __init__(self, sentence: str, exit_code: int = 130) -> None:
        super().__init__(sentence)
        self.exit_code = exit_code


class BuildFailed(VbnfaultError):
    """Some samples could not be made. `failures`: sample → traceback, or what happened to its worker."""

    def __init__(self, sentence: str, failures: Mapping[int, str] | None = None) -> None:
        super().__init__(sentence)
        self.failures = dict(failures or {})
