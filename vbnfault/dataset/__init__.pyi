"""List the public names of the package, each with the module that defines it."""

from .build import BuildOptions as BuildOptions
from .from_scene import SessionFactory as SessionFactory
from .from_scene import build_scene as build_scene
from .from_scene import describe_scene as describe_scene
from .identity import is_exact as is_exact
from .identity import missing_plugins as missing_plugins
from .identity import planned as planned
from .identity import scene_identity as scene_identity
from .identity import store_spec as store_spec
from .identity import verify as verify
from .merge import merge_stores as merge_stores
from .merge import migrate_store as migrate_store
