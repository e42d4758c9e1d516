"""Model detectors: convert irradiance to electrons, raw digital numbers (DN) and 8 bit images."""

from .mosaic_detector import MosaicDetector
from .sensor import Sensor, load_sensor
from .three_colour import EXACT_POISSON_BELOW_E, Detector, Noise, poisson_quantile

__all__ = [
    "EXACT_POISSON_BELOW_E",
    "Detector",
    "MosaicDetector",
    "Noise",
    "Sensor",
    "load_sensor",
    "poisson_quantile",
]
