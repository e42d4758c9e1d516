"""Write the report of a dataset: one page of HTML that needs no other file (`vbnfault report`)."""

from .page import MOST_READ, MOST_SHOWN, write_report

__all__ = ["MOST_READ", "MOST_SHOWN", "write_report"]
