"""Define the command line: parse the arguments, call the library, and print the result.

The commands stand in one file per group. They hold no physics and no checks beyond the types and limits of their
options, and they import the library only when they run, so that `vbnfault --help` stays fast.
"""

from . import datasets, detectors, instruments, realism, studies, support  # each registers its commands
from .app import app, main

__all__ = ["app", "datasets", "detectors", "instruments", "main", "realism", "studies", "support"]
