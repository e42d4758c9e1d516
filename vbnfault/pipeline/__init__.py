"""What happens to one sample, in order: resolve, render, meter, photograph, label."""

from .session import STAGES, VIEW_STAGES, Session, configure_faults, develop_frame, simulate

__all__ = ["STAGES", "VIEW_STAGES", "Session", "configure_faults", "develop_frame", "simulate"]
