"""Test fault models: the contract that every model keeps, and the cameras and images to test it with.

from vbnfault.testing import check_fault

def test_my_fault():
    check_fault(MyFault)
"""

from .examples import draw_context, make_context, random_quantity, with_mosaic
from .faults import check_fault, draw_table

__all__ = ["check_fault", "draw_context", "draw_table", "make_context", "random_quantity", "with_mosaic"]
