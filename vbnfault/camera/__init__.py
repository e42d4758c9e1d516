"""Define the camera: lens, detector, sensor architecture, readout direction and exposure, frozen together."""

from .camera import ARCHITECTURES, READOUT_DIRECTIONS, Camera, focal_length_mm

__all__ = ["ARCHITECTURES", "READOUT_DIRECTIONS", "Camera", "focal_length_mm"]
