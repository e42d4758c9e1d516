"""Teach a network to see the faults of a camera, and measure what it sees.

`vbnfault train` makes a detector from a dataset, `vbnfault score` compares a detector, or predicted masks of any
other program, with the labels of a dataset. Importing this package loads no PyTorch.
"""

from .prediction import Detector, Prediction

__all__ = ["Detector", "Prediction"]
