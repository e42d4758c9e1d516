"""Define the effects of a detector with a mosaic, in their order: one class each, which registers itself."""

from .contract import STEPS, Acts, Effect, Effects, Exposure, acts_always, chain_of, is_packaged, order, registry

__all__ = [
    "STEPS",
    "Acts",
    "Effect",
    "Effects",
    "Exposure",
    "acts_always",
    "chain_of",
    "is_packaged",
    "order",
    "registry",
]
