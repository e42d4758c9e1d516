"""Build, resume, repair, extend and check a dataset.

`store_spec`, `scene_identity` and `planned` compute from a scene what the store of its dataset must hold.

Each name loads its module when it is first used, so that a process that only builds or checks a store starts
without the modules that simulate samples.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from ..core.lazy_names import load_name

if TYPE_CHECKING:
    from .build import BuildOptions
    from .from_scene import SessionFactory, build_scene, describe_scene
    from .identity import is_exact, missing_plugins, planned, scene_identity, store_spec, verify
    from .merge import merge_stores, migrate_store

# public name → the module that defines it; it is loaded when the name is first used
_HOMES = {
    "BuildOptions": "build",
    "SessionFactory": "from_scene",
    "build_scene": "from_scene",
    "describe_scene": "from_scene",
    "is_exact": "identity",
    "merge_stores": "merge",
    "migrate_store": "merge",
    "missing_plugins": "identity",
    "planned": "identity",
    "scene_identity": "identity",
    "store_spec": "identity",
    "verify": "identity",
}
__all__ = [*_HOMES]


if not TYPE_CHECKING:  # a type checker that saw the function would accept every misspelled name

    def __getattr__(name: str) -> Any:
        """Return a public name from the module that defines it."""
        return load_name(__name__, name, _HOMES)
