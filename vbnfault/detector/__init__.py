"""Detectors: from irradiance to digital numbers and pictures."""

from .three_colour import EXACT_POISSON_BELOW_E, Detector, Noise, poisson_quantile

__all__ = ["EXACT_POISSON_BELOW_E", "Detector", "Noise", "poisson_quantile"]
