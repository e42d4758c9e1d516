"""Read a finished dataset at a trainer's speed: which samples, in which order, as which arrays.

This package needs numpy alone; `vbnfault.torch` is a thin layer on top of it, and the place where another framework
would stand. A process that reads imports neither zarr nor the renderer.
"""

from .order import Order
from .reader import SampleReader
from .selection import Columns, select
from .targets import TARGETS, Targets

__all__ = ["TARGETS", "Columns", "Order", "SampleReader", "Targets", "select"]
