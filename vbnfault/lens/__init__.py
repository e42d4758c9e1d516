"""Map scene radiance to irradiance on the sensor plane, with an ideal lens or a real one."""

from .adapt import closed_to, open_f_number, stopped_down
from .imaging import Lens, RealLens
from .paraxial import ParaxialProperties, paraxial_properties, scaled_to_field, scaled_to_focal_length
from .prescription import Prescription, Surface
from .prescription_file import load_lens, parse_lens
from .thin import Halo, ThinLens
