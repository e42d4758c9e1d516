"""Make one sample in five stages: resolve the view, render, meter the exposure, take the images, label."""

from .session import STAGES, VIEW_STAGES, Session, configure_faults, develop_frame, simulate

__all__ = ["STAGES", "VIEW_STAGES", "Session", "configure_faults", "develop_frame", "simulate"]
