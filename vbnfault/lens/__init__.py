"""The optics: from scene radiance to irradiance on the sensor plane."""

from .thin import ThinLens

__all__ = ["ThinLens"]
