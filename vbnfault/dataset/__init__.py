"""Build, resume, repair and extend a dataset, and derive what its store must hold from its scene."""

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
