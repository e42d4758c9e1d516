"""Define the camera: lens, detector, sensor architecture, readout direction and exposure, frozen together."""

from .camera import Camera, focal_length_mm

__all__ = ["Camera", "focal_length_mm"]
