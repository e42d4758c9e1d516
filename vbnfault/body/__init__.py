"""Describe the target body: its shape, gravity, sites and terrain.

Frame T is fixed to the body. It has the origin and the axes of the shape file, and the body rotates about +z.
"""

from .body import Body, ellipsoid, load_body
from .gravity import PolyhedronGravity
from .patch import Patch, build_patch, cached_patch
from .shape import check_mesh, embedded_nucleus, load_shape
from .sites import Site, Sites, choose_sites, local_level, site_at
from .spec import Fractured, PatchSpec

__all__ = [
    "Body",
    "Fractured",
    "Patch",
    "PatchSpec",
    "PolyhedronGravity",
    "Site",
    "Sites",
    "build_patch",
    "cached_patch",
    "check_mesh",
    "choose_sites",
    "ellipsoid",
    "embedded_nucleus",
    "load_body",
    "load_shape",
    "local_level",
    "site_at",
]
