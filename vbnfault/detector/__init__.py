"""Model detectors: convert irradiance to electrons, raw digital numbers (DN) and 8 bit images."""

from .interface import Detector
from .mosaic_detector import MosaicDetector
from .noise import EXACT_POISSON_BELOW_E, poisson_quantile
from .operation import amplified, binned
from .sensor import Sensor, load_sensor
from .three_colour import GreyDetector, Noise, ThreeColourDetector
