"""Map scene radiance to irradiance on the sensor plane, with an ideal lens or a real one."""

from .aperture import closed_to, open_f_number, stopped_down
from .gaussian import FirstOrder, first_order, scaled_to_field, scaled_to_focal_length
from .imaging import RealLens
from .interface import Lens
from .prescription import Prescription, Surface
from .prescription_file import load_lens, parse_lens
from .thin import ThinLens

__all__ = [
    "FirstOrder",
    "Lens",
    "Prescription",
    "RealLens",
    "Surface",
    "ThinLens",
    "closed_to",
    "first_order",
    "load_lens",
    "open_f_number",
    "parse_lens",
    "scaled_to_field",
    "scaled_to_focal_length",
    "stopped_down",
]
