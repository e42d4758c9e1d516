"""Read a finished dataset at a trainer's speed: which samples, in which order, as which arrays.

The names below need numpy alone; `datasets`, `loader` and `slots` give them to PyTorch as `vbnfault.torch`.
Another framework would stand beside them. A process that reads imports neither zarr nor the renderer.
"""

from .order import Order
from .reader import SampleReader
from .selection import Columns, select
from .targets import TARGETS, Targets

__all__ = ["TARGETS", "Columns", "Order", "SampleReader", "Targets", "select"]
