"""Build, resume, repair, extend and check a dataset.

`store_spec`, `scene_identity` and `planned` compute from a scene what the store of its dataset must hold.
"""

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
