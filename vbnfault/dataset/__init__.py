"""Build, resume, repair and extend a dataset, and derive what its store must hold from its scene."""

from .build import BuildOptions
from .checking import missing_plugins, verify
from .from_scene import SessionFactory, build_scene, describe_scene
from .identity import is_exact, planned, scene_identity, store_spec

__all__ = [
    "BuildOptions",
    "SessionFactory",
    "build_scene",
    "describe_scene",
    "is_exact",
    "missing_plugins",
    "planned",
    "scene_identity",
    "store_spec",
    "verify",
]
