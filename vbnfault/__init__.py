"""vbnfault: labelled, fault-injected camera images for vision-based navigation near small bodies."""

__version__ = "0.1.0"
