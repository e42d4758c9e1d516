"""Test plug-ins: the contracts that fault models and detector effects keep, and examples to test them with.

from vbnfault.testing import check_effect, check_fault

def test_my_fault():
    check_fault(MyFault)

def test_my_effect():
    check_effect(MyEffect)
"""

from .effects import check_effect
from .examples import draw_context, make_context, random_quantity, with_mosaic
from .faults import check_fault, draw_table

__all__ = [
    "check_effect",
    "check_fault",
    "draw_context",
    "draw_table",
    "make_context",
    "random_quantity",
    "with_mosaic",
]
