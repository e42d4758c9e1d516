"""Turn triangles into a Mitsuba scene through which rays can be traced."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from .runtime import mi


def mesh_scene(name: str, vertices_m: NDArray[np.float32], faces: NDArray[np.int32]) -> Any:
    """Return a Mitsuba scene of one triangle mesh: `vertices_m` float32[n, 3], `faces` int32[m, 3]."""
    mesh = mi.Mesh(name, len(vertices_m), len(faces))
    parameters = mi.traverse(mesh)
    # drjit keeps the numpy array that it is given; a copy lets go of the file that a patch is a part of
    parameters["vertex_positions"] = mi.Float(np.array(vertices_m, np.float32).ravel())
    parameters["faces"] = mi.UInt32(np.ascontiguousarray(faces, np.uint32).ravel())
    parameters.update()
    return mi.load_dict({"type": "scene", name: mesh})
