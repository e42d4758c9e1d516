"""Make one sample in seven stages, from the view to the labels; `stages` lists them."""

from .session import Session, configure_faults, simulate
from .stages import simulate_frame

__all__ = ["Session", "configure_faults", "simulate", "simulate_frame"]
