"""List the public names of the package, each with the module that defines it."""

from .body import Body as Body
from .body import ellipsoid as ellipsoid
from .body import load_body as load_body
from .gravity import PolyhedronGravity as PolyhedronGravity
from .patch import Patch as Patch
from .patch import build_patch as build_patch
from .patch import cached_patch as cached_patch
from .shape import check_mesh as check_mesh
from .shape import embedded_nucleus as embedded_nucleus
from .shape import load_shape as load_shape
from .sites import Site as Site
from .sites import Sites as Sites
from .sites import choose_sites as choose_sites
from .sites import local_level as local_level
from .sites import site_at as site_at
from .spec import Fractured as Fractured
from .spec import PatchSpec as PatchSpec
from .spec import Regolith as Regolith
