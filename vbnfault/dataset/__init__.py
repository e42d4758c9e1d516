"""How a dataset is built, resumed, mended and checked against its scene."""

from .checking import verify
from .identity import SessionFactory, build_scene, describe_scene, is_exact, planned, scene_identity, store_spec

__all__ = [
    "SessionFactory",
    "build_scene",
    "describe_scene",
    "is_exact",
    "planned",
    "scene_identity",
    "store_spec",
    "verify",
]
