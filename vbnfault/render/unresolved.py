"""Compute the light of a body of few pixels, and of parts of the spacecraft that are narrower than a pixel.

The rays of pixels miss a body that is smaller than a pixel, or hit it by chance, and then count for a large part of
its light. Such a body is rendered in a frame of its own that it fills: a close-up, made of the same rays, light and
truth as any other image. Each pixel of it lies within one pixel of the frame and adds its part of the area to it.
So the light of a body is that of some `_ACROSS`² pixels, whatever its size in the frame.

Float32 resolves 2⁻²³ of the distance of the camera, which may be more than the size of the body. So the close-up is
taken from at most `_FARTHEST` radii, on the same line of sight, and its rays start just before the body. This turns
them by 1e-4 at most.

The rays of pixels also meet a thin boom or a small part of the spacecraft by chance. Rays are therefore aimed at
points of such facets. A ray that meets its facet first adds the facet's radiance, times the area in pixels that the
point stands for. Facets that other parts hide, or that face away behind others, add nothing.
"""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ..core.quantities import FineLight, Radiance
from ..core.sundisc import sunflower
from .description import RenderInput, View
from .light import Cells, CellStrata, Direct
from .runtime import columns, dr, mi, packets
from .surface import TerrainMesh

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]

_ACROSS = 256  # pixels along each side of a close-up
# Least number of pixels of a close-up along each side of a pixel. Wider bodies, from 64 pixels on, have enough rays
# of the frame's own pixels.
_FEWEST = 4
# Least number of samples of each pixel of a close-up. The light of a sphere is then known to 0.03 % at a phase of
# 90°, to 0.2 % at 150° and to 1 % at 170°.
_SAMPLES = 16
_FARTHEST = 1e4  # distance of a close-up in radii of the body
_KEY = 0x7F4A7C15  # separates the random numbers of a close-up from those of the frame
_LENS_STEP = 40503  # golden section of `_ACROSS`², odd: neighbours have distant points of the lens


@dataclass(frozen=True, kw_only=True, eq=False)
class CloseUp:
    """Hold the view of a close-up, and where its pixels lie in the frame.

    Attributes
    ----------
    frame
        The camera's view.
    view
        The view of the close-up.
    ground
        The ground without the spacecraft; `vehicle` is the surface with it.
    per_px
        Number of pixels of the close-up along each side of a pixel of the frame, a power of two.
    first
        int64[2]: column and row of its first pixel, in pixels of the close-up from the corner of the frame.
    size_px
        Greater side of the body's outline in pixels of the frame.
    """

    frame: View
    view: View
    ground: TerrainMesh
    vehicle: TerrainMesh
    per_px: int
    first: NDArray[np.int64]
    size_px: float

    def seen_in(self, scene: RenderInput) -> RenderInput:
        """Return the scene as the renderer's input for the close-up."""
        samples = max(scene.samples_per_pixel, _SAMPLES)
        return replace(scene, view=self.view, samples_per_pixel=samples, key=scene.key ^ _KEY)

    @property
    def nearer_m(self) -> float:
        """Return by how much its camera stands nearer along the boresight."""
        return float((self.view.position_L_m - self.frame.position_L_m) @ self.frame.L_from_C[:, 2])

    @property
    def corners_px(self) -> tuple[F64, F64]:
        """Return x and y of its first and its last corner in the frame, float64[2] each."""
        return self.first / self.per_px, (self.first + _ACROSS) / self.per_px

    @cached_property
    def slopes(self) -> F64:
        """Return the tangents x/z and y/z in C at which the frame's camera sees its pixels, float64[y, x, 2]."""
        x, y = ((start + np.arange(_ACROSS) + 0.5) / self.per_px for start in self.first)
        fx, fy, cx, cy = self.frame.intrinsics
        slopes = np.stack(np.meshgrid((x - cx) / fx, (y - cy) / fy), axis=-1)
        return self.frame.seen_by_lines(slopes.reshape(-1, 2), self._depths_m).reshape(slopes.shape)

    @property
    def _depths_m(self) -> F64:
        """Return the depth of the body's middle for each pixel, float64[pixel]."""
        depth_m = (self.ground.centre_m - self.frame.position_L_m) @ self.frame.L_from_C[:, 2]
        return np.full(_ACROSS**2, float(depth_m))

    @cached_property
    def _lens_m(self) -> F64:
        """Return a point of the aperture for each pixel, float64[pixel, 2] in m."""
        order = (np.arange(_ACROSS**2) * _LENS_STEP) % _ACROSS**2
        return self.frame.aperture_radius_m * sunflower(_ACROSS**2)[order]

    @cached_property
    def unhidden(self) -> NDArray[np.bool_]:
        """Return which pixels the camera's own spacecraft does not hide, bool[y, x]."""
        shape = (_ACROSS, _ACROSS)
        if self.vehicle.vehicle is None:
            return np.ones(shape, dtype=bool)
        (x, y), (across, down) = columns(self._lens_m), columns(self.slopes.reshape(-1, 2))
        rays = mi.Ray3f(mi.Point3f(x, y, 0), dr.normalize(mi.Vector3f(across, down, 1)))
        hidden = self.vehicle.vehicle.occluded(rays, mi.Bool(True))
        return np.asarray(~hidden.numpy().astype(bool).reshape(shape))

    def light(self, radiance: Radiance) -> FineLight:
        """Return the light of the close-up, whose radiance is given, in the frame."""
        frame, slopes, depth_m = self.frame, self.slopes.reshape(-1, 2), self._depths_m
        values = (radiance.array * self.unhidden).reshape(len(radiance.array), -1)
        lit = values.any(axis=0)
        # each pixel of a close-up lies within one pixel of a pinhole that stands still
        within = frame.projection is None and frame.motion is None
        area_px = self.per_px**-2.0 * frame.stretch(slopes, depth_m)
        # defocus shifts the light of each point of the aperture
        slopes = slopes + self._lens_m * (1 / frame.focus_distance_m - 1 / depth_m[:, None])
        return FineLight.of(
            slopes=slopes[lit],
            area_px=area_px[lit],
            radiance=values[:, lit],
            depth_m=depth_m[lit],
            side_px=np.full(np.count_nonzero(lit), 0 if within else 1 / self.per_px),
            intrinsics=frame.intrinsics,
            shape=(frame.height_px, frame.width_px),
            projection=frame.projection,
        )


def close_up(surface: TerrainMesh, view: View, margin_m: float = 0.0) -> CloseUp | None:
    """Return the close-up of a body of few pixels; None if it is wider, beside the frame or behind the camera.

    `margin_m` is the height of what surrounds the body and shall be in the close-up.
    """
    centre, radius = surface.centre_m, surface.radius_m
    towards = (centre - view.position_L_m) @ view.L_from_C
    distance = float(np.linalg.norm(towards))
    widest = _ACROSS / _FEWEST - 1
    fx, fy, cx, cy = view.intrinsics
    if towards[2] < 2 * radius or 2 * radius * fx / distance > 2 * widest:
        return None
    around = surface.vertices_m.astype(np.float64) - centre
    around *= 1 + margin_m / radius
    x, y, z = (around @ view.L_from_C + towards).T
    if z.min() <= 0:
        return None
    image = np.stack([x / z * fx + cx, y / z * fy + cy])
    low, high = image.min(axis=1), image.max(axis=1)
    size = float((high - low).max())
    if size > widest:
        return None
    in_frame = view.pixel_map.pixel_of(np.stack([x, y, z], axis=-1))
    least, most = in_frame.min(axis=0), in_frame.max(axis=0)
    if (most < 0).any() or (least > (view.width_px, view.height_px)).any():
        return None
    per_px = int(2 ** np.floor(np.log2((_ACROSS - 2) / size)))
    first = (
        np.floor(low * per_px).astype(np.int64) - (_ACROSS - np.ceil((high - low) * per_px).astype(np.int64)) // 2
    )
    nearer = min(1.0, _FARTHEST * radius / distance)
    middle = towards[:2] / towards[2] * view.intrinsics[:2] + view.intrinsics[2:]
    focal = view.intrinsics[:2] * per_px * nearer
    ground = copy(surface)
    ground.vehicle = None
    return CloseUp(
        frame=view,
        view=View(
            position_L_m=centre + nearer * (view.position_L_m - centre),
            L_from_C=view.L_from_C,
            intrinsics=np.concatenate([focal, middle * per_px - first - towards[:2] / towards[2] * focal]),
            width_px=_ACROSS,
            height_px=_ACROSS,
            start_m=max(nearer * distance - 2 * radius, 0.0),
        ),
        ground=ground,
        vehicle=surface,
        per_px=per_px,
        first=first,
        size_px=float((most - least).max()),
    )


# --- thin parts of the spacecraft -------------------------------------------------------------------------------

# Points of a pixel's area and of each facet, at least. Their sequence is even over a facet.
_PER_PX, _PER_FACET, _MOST = 64, 16, 1 << 20
_GOLDEN = 1.32471795724474602596 ** -np.arange(1.0, 3.0)  # of two dimensions (Roberts 2018)
_FACET_KEY = 0x3C6EF372


def thin_parts(surface: TerrainMesh, scene: RenderInput) -> FineLight | None:
    """Return the light of the spacecraft's facets that are narrower than a pixel; None without any."""
    vehicle, view = surface.vehicle, scene.view
    facets = np.zeros(0, np.intp) if vehicle is None else np.flatnonzero(vehicle.thin_in(view))
    if vehicle is None or not len(facets):
        return None
    fx, fy = view.intrinsics[:2]
    corners = vehicle.corners_m[facets]
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
    across, down = columns(slopes)
    rays = mi.Ray3f(direct.optics.origin, dr.normalize(across * ax + down * ay + az))
    cells = Cells(pixel=np.arange(len(owner), dtype=np.uint32), cell=np.zeros(len(owner), np.uint32), side=1)
    strata = CellStrata(cells, 1, scene.key ^ _FACET_KEY, None)
    terms = direct.terms(strata, rays, packets(mi.UInt32, facets[owner].astype(np.uint32)))
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
        depth_m=np.full(np.count_nonzero(lit), np.nan),
        side_px=np.zeros(np.count_nonzero(lit)),
        intrinsics=view.intrinsics,
        shape=(view.height_px, view.width_px),
        projection=view.projection,
    )
