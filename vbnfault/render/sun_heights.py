"""Measure how far the terrain reaches towards the Sun, seen from the Sun: the map of its shadow."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .runtime import dr, mi
from .sampling import opaque_vector
from .surface import TerrainMesh

# Height at which the rays start, in units of half the width.
_ABOVE = 1.5


def heights_towards_sun(
    surface: TerrainMesh, centre_L_m: NDArray[np.float64], axes: NDArray[np.float64], half_m: float, cells: int
) -> NDArray[np.float32]:
    """Return the height of the terrain above the plane through a centre at right angles to the Sun, in m.

    Parameters
    ----------
    surface
        The terrain; its spacecraft is ignored.
    centre_L_m
        float64[3]: the centre.
    axes
        float64[3, 3]: two unit vectors in the plane, and the one towards the Sun, as rows.
    half_m
        Half the width of the square around the centre. All of the terrain lies within this distance of it.
    cells
        Number of cells along each side of the square.

    Returns
    -------
    float32[cells, cells]
        The greatest height in the middle of each cell; columns run along the first axis, rows along the second.
        -inf where the cell shows no terrain.
    """
    index = dr.arange(mi.UInt32, cells * cells)
    # opaque numbers: a new Sun needs no new kernel
    first, second, sun = (opaque_vector(mi.Vector3f, axis) for axis in axes)
    corner = opaque_vector(mi.Point3f, centre_L_m + half_m * (_ABOVE * axes[2] - axes[0] - axes[1]))
    step, above = dr.opaque(mi.Float, 2 * half_m / cells), dr.opaque(mi.Float, _ABOVE * half_m)
    across, down = (mi.Float(index % cells) + 0.5) * step, (mi.Float(index // cells) + 0.5) * step
    hit = surface.trace(mi.Ray3f(corner + across * first + down * second, -sun))[0]
    height = dr.select(hit.is_valid(), above - hit.t, -dr.inf)
    return np.asarray(height.numpy(), dtype=np.float32).reshape(cells, cells)
