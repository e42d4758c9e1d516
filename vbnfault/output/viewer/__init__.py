"""Show a store in a browser: a server on this machine alone, and a page (`vbnfault view`)."""

from .server import Viewer

__all__ = ["Viewer"]
