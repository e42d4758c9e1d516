"""Define how the ground reflects: one class a model, which registers itself (`contract`)."""

from .contract import (
    NUMPY,
    REFERENCE_NM,
    AnyReflectance,
    BandReflectance,
    DiscReflectance,
    Reflectance,
    is_packaged,
    radiance_factor,
    registry,
)

__all__ = [
    "NUMPY",
    "REFERENCE_NM",
    "AnyReflectance",
    "BandReflectance",
    "DiscReflectance",
    "Reflectance",
    "is_packaged",
    "radiance_factor",
    "registry",
]
