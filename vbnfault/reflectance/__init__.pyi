"""List the public names of the package, each with the module that defines it."""

from .contract import NUMPY as NUMPY
from .contract import REFERENCE_NM as REFERENCE_NM
from .contract import AnyReflectance as AnyReflectance
from .contract import BandReflectance as BandReflectance
from .contract import DiscReflectance as DiscReflectance
from .contract import Reflectance as Reflectance
from .contract import is_packaged as is_packaged
from .contract import radiance_factor as radiance_factor
from .contract import registry as registry
