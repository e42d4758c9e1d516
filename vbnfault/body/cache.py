"""Keep built patches on disk (`core.array_files`): to build one takes many seconds.

The key of a patch is a hash of everything that determines it: the body, the site, all parameters, the sources of
the terrain code, and the versions of the libraries that compute it.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..core import activity
from ..core.array_files import ArrayFiles, code_hash
from .patch import Patch, build_patch
from .sites import Site
from .spec import PatchSpec

if TYPE_CHECKING:
    from . import Body

PATCHES = ArrayFiles(kind="patch", content="terrain")
_GROUND = ("fields", "noise", "octaves", "relief", "fractured", "roughness", "scarps", "sharpen")
_SOURCES = (*_GROUND, "refine", "boulders", "patch", "gravity", "shape")
_ARRAYS = tuple(name for name in Patch.__dataclass_fields__ if name != "site")


def cached_patch(body: Body, site: Site, spec: PatchSpec) -> Patch:
    """Return what `build_patch` returns for the same arguments, from disk if it was built before.

    The patch is the same bit for bit in both cases. Raises what `build_patch` raises, and InputError if
    $VBNFAULT_CACHE_GIB is unusable.
    """

    def build() -> dict[str, Any]:
        activity.begin(f"terrain of site {site.index} (new patch)")
        return arrays_of(build_patch(body, site, spec))

    return Patch(site=site, **PATCHES.kept(patch_key(body, site, spec), build))


def arrays_of(patch: Patch) -> dict[str, Any]:
    """Return the arrays and numbers of a patch that its file holds."""
    return {name: getattr(patch, name) for name in _ARRAYS}


def patch_key(body: Body, site: Site, spec: PatchSpec) -> str:
    """Return the sha256 (hex) of all that determines a patch."""
    content = {
        "code": _code_hash(),
        "body": [body.content_hash, body.density_kg_m3, body.rotation_period_s],
        "site": [site.index, site.position_T_m.tolist(), site.T_from_L.tolist()],
        "spec": dataclasses.asdict(spec),
    }
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


@lru_cache(maxsize=1)
def _code_hash() -> str:
    """Return the sha256 (hex) of the terrain sources, the library versions and the platform."""
    return code_hash([Path(__file__).with_name(f"{name}.py") for name in _SOURCES])
