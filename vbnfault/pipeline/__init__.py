"""Make one sample in seven stages, from the view to the labels; `stages` lists them."""

from ..scene.config import configure_faults
from .session import Session, simulate
from .stages import simulate_frame

__all__ = ["Session", "configure_faults", "simulate", "simulate_frame"]
