"""Sample the facets of the spacecraft that are narrower than a pixel by themselves.

The rays of pixels meet a thin boom or a small part by chance. Rays are therefore aimed at points of such facets. A
ray that meets its facet first adds the facet's radiance, times the area in pixels that the point stands for. Facets
that other parts hide, or that face away behind others, add nothing.
"""

from __future__ import annotations

import numpy as np

from ..core.fine_light import FineLight
from .cells import Cells, CellStrata
from .description import RenderInput
from .light import Direct
from .runtime import dr, mi
from .surface import TerrainMesh

# Points of a pixel's area and of each facet, at least. Their sequence is even over a facet.
_PER_PX, _PER_FACET, _MOST = 64, 16, 1 << 20
_GOLDEN = 1.32471795724474602596 ** -np.arange(1.0, 3.0)  # of two dimensions (Roberts 2018)
_KEY = 0x3C6EF372


def thin_parts(surface: TerrainMesh, scene: RenderInput) -> FineLight | None:
    """Return the light of the spacecraft's facets that are narrower than a pixel; None without any."""
    vehicle, view = surface.vehicle, scene.view
    facets = np.zeros(0, np.intp) if vehicle is None else np.flatnonzero(vehicle.thin_in(view))
    if vehicle is None or not len(facets):
        return None
    fx, fy = view.intrinsics[:2]
    corners = vehicle.corners_of(facets)
    first, second = (corners[:, k] - corners[:, 0] for k in (1, 2))
    normal = np.cross(first, second) / 2
    middle = corners.mean(axis=1)
    area_px = fx * fy * np.abs((normal * middle).sum(axis=1)) / middle[:, 2] ** 3
    count = np.maximum(np.ceil(_PER_PX * area_px), _PER_FACET)
    count = np.maximum(count * min(1.0, _MOST / count.sum()), 1).astype(int)
    owner = np.repeat(np.arange(len(facets)), count)
    number = np.arange(len(owner)) - np.repeat(np.cumsum(count) - count, count)
    u, v = ((0.5 + (number + 0.5) * step) % 1 for step in _GOLDEN)  # the first point of 0.5 + 0 lies on an edge
    u, v = np.where(u + v > 1, 1 - u, u), np.where(u + v > 1, 1 - v, v)
    points = corners[owner, 0] + u[:, None] * first[owner] + v[:, None] * second[owner]
    slopes = points[:, :2] / points[:, 2:]
    # dω = |n · p| dA / |p|³, and a pixel's area is fx fy dω / cos³θ
    area_px = fx * fy * np.abs((normal[owner] * points).sum(axis=1)) / points[:, 2] ** 3 / count[owner]
    direct = Direct(surface, scene)
    ax, ay, az = direct.optics.axes
    across, down = (mi.Float(np.ascontiguousarray(column, np.float32)) for column in slopes.T)
    rays = mi.Ray3f(direct.optics.origin, dr.normalize(across * ax + down * ay + az))
    cells = Cells(pixel=np.arange(len(owner), dtype=np.uint32), cell=np.zeros(len(owner), np.uint32), side=1)
    strata = CellStrata(cells, 1, scene.key ^ _KEY, None)
    terms = direct.terms(strata, rays, mi.UInt32(facets[owner].astype(np.uint32)))
    dr.eval(*terms)
    radiance = direct.weights.T.astype(np.float32) @ np.stack([term.numpy() for term in terms])
    # defocus shifts the light of each point of the aperture
    radius, turn = np.sqrt((0.5 + number * _GOLDEN[1]) % 1), 2 * np.pi * ((0.25 + number * _GOLDEN[0]) % 1)
    lens_m = view.aperture_radius_m * radius[:, None] * np.column_stack([np.cos(turn), np.sin(turn)])
    lit = radiance.any(axis=0)
    return FineLight.of(
        slopes=(slopes + lens_m * (1 / view.focus_distance_m - 1 / points[:, 2:]))[lit],
        area_px=area_px[lit],
        radiance=radiance[:, lit],
        intrinsics=view.intrinsics,
        shape=(view.height_px, view.width_px),
    )
