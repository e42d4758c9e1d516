"""Write the report of a dataset: one page of HTML that needs no other file (`vbnfault report`)."""

from .page import Limits, write_report

__all__ = ["Limits", "write_report"]
