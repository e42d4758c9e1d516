"""Compute the light that the ground reflects onto itself.

This light is about a hundredth of the direct light, and smooth except near contacts. It therefore takes one sample
where direct light takes sixteen, and a filter averages neighbouring pixels.

The directions of the first reflection are strata of the cosine-weighted hemisphere, distributed over tiles of 8 × 8
pixels (interleaved sampling: Keller & Heidrich 2001, EGWR, 269). All pixels at the same position in their tile have
the same stratum, so their rays are coherent, and a tile covers all directions. A filter that does not cross the
edges of surfaces (à trous: Dammertz et al. 2010, HPG, 67) then averages over neighbours.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.quantities import Truth
from .bsdf import has_bands
from .description import RenderInput
from .light import WAVEFRONT, Light
from .runtime import dr, mi
from .sampling import SUN_DIMENSION, Optics, Pixels, Strata
from .surface import TerrainMesh

Image = NDArray[np.float32]

_TILE = 8
_DIRECT_PER_INDIRECT = 16  # samples of direct light per sample of indirect light
_FIRST_BOUNCE = 2  # the first free dimension of a sample's random numbers; each bounce uses three
# The filter's weights fall with the angle between normals and with the distance from the pixel's plane.
_SIGMA_NORMAL = 0.3
_SIGMA_PLANE_PX = 3.0
_SPLINE = (3 / 8, 1 / 4, 1 / 16)
_STRIDES = (1, 2, 4)
_COLOUR_PX = 12  # standard deviation; colour varies less than brightness, so it is averaged more widely


def indirect(surface: TerrainMesh, scene: RenderInput, truth: Truth, *, smooth: bool = True) -> Image:
    """Return the radiance of ground that other ground lights, float32[band, y, x].

    The light was reflected 1 to `scene.bounces` times before it reaches the ground in view. `truth` of the same
    view guides the filter that averages neighbouring pixels; `smooth` = False switches the filter off.
    """
    light = _Indirect(surface, scene).image()
    return _smoothed(light, scene, truth) if smooth else light


class _Indirect(Light):
    """Trace the light between surfaces of one scene."""

    def __init__(self, surface: TerrainMesh, scene: RenderInput) -> None:
        super().__init__(surface, scene, banded=scene.bounces > 1 or has_bands(surface, scene))
        self.samples_per_pixel = max(1, scene.samples_per_pixel // _DIRECT_PER_INDIRECT)
        sun, model = scene.sun, scene.reflectance
        if self.banded:
            self.weights = np.diag(sun.irradiance_W_m2_nm)
        else:
            self.weights = (model.weights[0] ** 2 * sun.irradiance_W_m2_nm)[None, :]

    def image(self) -> Image:
        """Return the unfiltered radiance, float32[band, y, x]."""
        view, spp = self.scene.view, self.samples_per_pixel
        weights = (self.weights / spp).astype(np.float32)
        out = np.zeros((weights.shape[1], view.height_px, view.width_px), dtype=np.float32)
        key = self.scene.key ^ 0x5BD1E995
        for tiles in _Tiles.cover(view.width_px, view.height_px, len(weights)):
            # camera rays are traced in rows, where neighbours are coherent; later rays have another order
            pixels = Pixels(view.width_px * tiles.rows, first=view.width_px * tiles.first_row)
            rows = slice(tiles.first_row, tiles.first_row + tiles.rows)
            for round_ in range(spp):
                first = self.world.trace(self.optics.camera_rays(Strata(pixels, 1, key + round_)))
                dr.eval(*first)
                strata = TileStrata(tiles, spp, round_, key + round_)
                terms = self.terms(strata, dr.gather(type(first), first, strata.in_rows, strata.inside))
                dr.eval(*terms)
                ordered = [tiles.in_rows(term) for term in terms]
                dr.eval(*ordered)
                for row, values in zip(weights, ordered, strict=True):
                    values = values.numpy().reshape(tiles.rows, tiles.width)
                    for band in np.flatnonzero(row):
                        out[band, rows] += values * row[band]
        return out

    def terms(self, strata: TileStrata, first: tuple[Any, ...]) -> list[Any]:
        """Return the light of each sample, an array for each row of `weights`.

        `first` holds the hits of the rays from the camera.
        """
        rays = self.optics.camera_rays(strata)
        hit = self.world.hit(rays, first)
        hit.valid &= strata.inside
        total, carried = None, None
        for bounce in range(self.scene.bounces):
            dimension = _FIRST_BOUNCE + 3 * bounce
            u, v = strata.directions() if bounce == 0 else strata.jitter(dimension)
            direction, factor = self.reflection(hit, rays).scattered(u, v)
            carried = factor if carried is None else _product(carried, factor)
            rays = hit.shadow_rays(direction)
            on_vehicle = hit.on_vehicle
            hit = self.world.intersect(rays, hit.valid, coherent=False)
            # a facet seen from behind reflects no light
            hit.valid &= dr.dot(hit.normal, rays.d) < 0
            if on_vehicle is not None:
                # A vehicle some metres wide, tens of metres away, adds far less than 1e-3 of the light. Only one
                # ray in thousands hits it, and then makes a bright speck, so these hits are dropped.
                hit.valid &= on_vehicle | ~hit.on_vehicle
            towards, lit = self.lit(hit, strata.disc(SUN_DIMENSION + dimension + 2), coherent=False)
            sent = _product(carried, self.reflection(hit, rays).terms(towards))
            added = [dr.select(lit, t, 0) for t in sent]
            total = added if total is None else [a + b for a, b in zip(total, added, strict=True)]
        assert total is not None
        return total


def _product(a: list[Any], b: list[Any]) -> list[Any]:
    """Return the products of two lists, entry by entry."""
    return [x * y for x, y in zip(a, b, strict=True)]


class _Tiles:
    """Order the samples of some rows of tiles: all samples of one position in their tile follow each other.

    Each pixel has one sample. Neighbours in the wavefront have the same position in neighbouring tiles.
    """

    def __init__(self, width: int, first_row: int, rows: int) -> None:
        self.width, self.first_row, self.rows = width, first_row, rows
        self.across = -(-width // _TILE)
        self.count = self.across * -(-rows // _TILE)

    @classmethod
    def cover(cls, width: int, height: int, values_per_pixel: int) -> Iterator[_Tiles]:
        """Yield rows of tiles that cover the frame, each small enough for the wavefront."""
        rows = max(1, WAVEFRONT // (width * values_per_pixel * _TILE)) * _TILE
        for first in range(0, height, rows):
            yield cls(width, first, min(rows, height - first))

    def in_rows(self, values: Any) -> Any:
        """Return the pixels' values row after row."""
        pixel = dr.arange(mi.UInt32, self.width * self.rows)
        x, y = pixel % self.width, pixel // self.width
        position = (y % _TILE) * _TILE + x % _TILE
        return dr.gather(mi.Float, values, position * self.count + (y // _TILE) * self.across + x // _TILE)


class TileStrata(Strata):
    """Provide one sample of every pixel of tiles, with its strata of directions.

    A tile distributes the strata of directions over its pixels and over `rounds` rounds; `round_` is the number of
    this round.
    """

    def __init__(self, tiles: _Tiles, rounds: int, round_: int, key: int) -> None:
        wavefront = dr.arange(mi.UInt32, tiles.count * _TILE * _TILE)
        tile, self._position = wavefront % tiles.count, wavefront // tiles.count
        x = (tile % tiles.across) * _TILE + self._position % _TILE
        y = (tile // tiles.across) * _TILE + self._position // _TILE
        self.inside = (x < tiles.width) & (y < tiles.rows)
        self.in_rows = y * tiles.width + x
        self.pixel = self.in_rows + dr.opaque(mi.UInt32, tiles.first_row * tiles.width)
        self.index = mi.UInt32(0)
        self.side, self.samples, self._shift = 1, 1, 0
        self._key = dr.opaque(mi.UInt32, key & 0xFFFFFFFF)
        self._wavefront = self._number = self.pixel
        self.limb = None
        self._rounds_side = round(rounds**0.5)
        self._round = [dr.opaque(mi.UInt32, k) for k in divmod(round_, self._rounds_side)]

    def directions(self) -> tuple[Any, Any]:
        """Return a uniform point of the unit square within the sample's own stratum."""
        u, v = self.jitter(_FIRST_BOUNCE)
        cells = _TILE * self._rounds_side
        a = self._round[0] * _TILE + _reversed(self._position % _TILE)
        b = self._round[1] * _TILE + _reversed(self._position // _TILE)
        return (mi.Float(a) + u) / cells, (mi.Float(b) + v) / cells


def _reversed(three_bits: Any) -> Any:
    """Return three bits in reverse order, so that neighbouring pixels of a tile get distant strata."""
    return ((three_bits & 1) << 2) | (three_bits & 2) | (three_bits >> 2)


def _smoothed(image: Image, scene: RenderInput, truth: Truth) -> Image:
    """Return the radiance with brightness filtered along surfaces and colour averaged over a wider window."""
    brightness = image.sum(axis=0)
    if not brightness.any():
        return image
    guide = _Guide(scene, truth)
    smooth = mi.Float(brightness.ravel())
    for stride in _STRIDES:
        smooth = guide.filtered(smooth, stride)
        dr.eval(smooth)
    bands = np.stack([_coarse(band) for band in image])
    colour = bands / np.maximum(bands.sum(axis=0), 1e-6 * brightness.max())
    shape, bright = brightness.shape[::-1], smooth.numpy().reshape(brightness.shape)
    return np.stack([cv2.resize(c, shape, interpolation=cv2.INTER_LINEAR) * bright for c in colour])


def _coarse(band: Image) -> Image:
    """Return the band averaged over a wide window, on every fourth pixel in x and y."""
    small = cv2.resize(band, None, fx=1 / 4, fy=1 / 4, interpolation=cv2.INTER_AREA)
    return np.asarray(cv2.GaussianBlur(small, (0, 0), _COLOUR_PX / 4))


class _Guide:
    """Hold the normals and depths that show which neighbours lie on the same surface."""

    def __init__(self, scene: RenderInput, truth: Truth) -> None:
        self.optics = Optics(scene.view)
        self.width, self.height = scene.view.width_px, scene.view.height_px
        record = np.concatenate([truth.normal.astype(np.float32), truth.depth_m[..., None]], axis=2)
        record[~np.isfinite(truth.depth_m)] = 0
        self._record = mi.Float(np.ascontiguousarray(record).ravel())
        self._pixel_size = dr.opaque(mi.Float, 1 / float(scene.view.intrinsics[0]))

    def _geometry_at(self, x: Any, y: Any) -> tuple[Any, Any, Any]:
        """Return the normal, the position in camera axes and the depth (0 on the sky) at pixels."""
        record = dr.gather(mi.Vector4f, self._record, mi.UInt32(y * self.width + x))
        depth = record.w
        across = (mi.Float(x) + 0.5 - self.optics.centre.x) * self.optics.scale.x
        down = (mi.Float(y) + 0.5 - self.optics.centre.y) * self.optics.scale.y
        return record.xyz, mi.Vector3f(across * depth, down * depth, depth), depth

    def filtered(self, values: Any, stride: int) -> Any:
        """Return the values averaged over 5 × 5 pixels that are `stride` apart and lie on the same surface."""
        pixel = dr.arange(mi.Int32, self.width * self.height)
        x, y = pixel % self.width, pixel // self.width
        normal, point, depth = self._geometry_at(x, y)
        per_plane = 1 / (_SIGMA_PLANE_PX * stride * self._pixel_size * dr.maximum(depth, 1e-6))
        total, weights = mi.Float(0), mi.Float(0)
        for j in range(-2, 3):
            for i in range(-2, 3):
                qx = dr.clip(x + i * stride, 0, self.width - 1)
                qy = dr.clip(y + j * stride, 0, self.height - 1)
                other, other_point, far = self._geometry_at(qx, qy)
                off = dr.dot(normal, other_point - point) * per_plane
                turn = dr.squared_norm(other - normal) * (1 / _SIGMA_NORMAL**2)
                weight = _SPLINE[abs(i)] * _SPLINE[abs(j)] * dr.exp(-0.5 * (off * off + turn))
                weight = dr.select(far > 0, weight, 0)
                total += weight * dr.gather(mi.Float, values, mi.UInt32(qy * self.width + qx))
                weights += weight
        return dr.select((depth > 0) & (weights > 0), total / dr.maximum(weights, 1e-20), values)
