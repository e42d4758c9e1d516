"""Compute the light that the ground reflects onto itself.

This light is about a hundredth of the direct light, and smooth except near contacts. It is therefore computed on a
grid of half the resolution, with one sample where direct light takes 64, and a filter averages neighbouring pixels.

The directions of the first reflection are strata of the cosine-weighted hemisphere, distributed over tiles of 8 × 8
pixels (interleaved sampling: Keller & Heidrich 2001, EGWR, 269). All pixels at the same position in their tile have
the same stratum, so their rays are coherent, and a tile covers all directions. A filter that does not cross the
edges of surfaces (à trous: Dammertz et al. 2010, HPG, 67) then averages over neighbours.
"""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.quantities import Truth
from .bsdf import has_bands
from .description import RenderInput, View
from .light import WAVEFRONT, Cells, CellStrata, Light
from .runtime import dr, mi, packets
from .sampling import SUN_DIMENSION, Optics, Strata
from .surface import TerrainMesh, facing

Image = NDArray[np.float32]

_TILE = 8
_DIRECT_PER_INDIRECT = 16  # samples of a pixel's direct light per sample of a coarser pixel's indirect light
# Samples of a coarser pixel that sees the spacecraft, whose parts light each other far more than ground does.
_ON_VEHICLE = 16
_FIRST_BOUNCE = 2  # the first free dimension of a sample's random numbers; each bounce uses three
# The filter's weights fall with the angle between normals and with the distance from the pixel's plane.
_SIGMA_NORMAL = 0.3
_SIGMA_PLANE_PX = 3.0
_SPLINE = (3 / 8, 1 / 4, 1 / 16)
_STRIDES = (1, 2, 4)
_COLOUR_PX = 6  # standard deviation, on the coarser grid


def indirect(surface: TerrainMesh, scene: RenderInput, truth: Truth) -> Image:
    """Return the radiance of ground that other ground lights, float32[band, y, x].

    The light was reflected 1 to `scene.bounces` times before it reaches the ground in view. `truth` of the same
    view guides the interpolation between the pixels of the coarser grid.
    """
    coarse = replace(scene, view=_halved(scene.view))
    tracer = _Indirect(surface, coarse)
    if tracer.is_empty:
        return np.zeros((len(scene.wavelength_nm), scene.view.height_px, scene.view.width_px), dtype=np.float32)
    guide, on_vehicle = tracer.guide()
    light = tracer.image()
    if len(on_vehicle):
        light.reshape(len(light), -1)[:, on_vehicle] = tracer.of_pixels(on_vehicle)
    brightness = light.sum(axis=0)
    out = np.zeros((len(light), scene.view.height_px, scene.view.width_px), dtype=np.float32)
    if not brightness.any():
        return out
    smooth = packets(mi.Float, brightness)
    for stride in _STRIDES:
        smooth = guide.filtered(smooth, stride)
        dr.eval(smooth)
    bright = guide.interpolated(smooth, _Guide.of(scene.view, truth)).numpy().reshape(out.shape[1:])
    # colour varies less than brightness, so it is averaged more widely
    colours = np.stack([_averaged(band) for band in light])
    colours /= np.maximum(colours.sum(axis=0), 1e-6 * brightness.max())

    def coloured(band: int) -> None:
        wide = cv2.resize(colours[band], (2 * coarse.view.width_px, 2 * coarse.view.height_px))
        np.multiply(wide[: out.shape[1], : out.shape[2]], bright, out=out[band])

    with ThreadPoolExecutor(dr.thread_count()) as pool:  # numpy and OpenCV use one core here
        list(pool.map(coloured, range(len(out))))
    return out


def _halved(view: View) -> View:
    """Return a view with pixels of twice the size, which covers at least the same field."""
    return replace(
        view,
        intrinsics=view.intrinsics / 2,
        projection=None if view.projection is None else view.projection.scaled_by(0.5, 0.5),
        width_px=-(-view.width_px // 2),
        height_px=-(-view.height_px // 2),
    )


def _averaged(band: Image) -> Image:
    """Return the band averaged over a wide window, on every second pixel in x and y."""
    height, width = band.shape
    small = cv2.resize(band, (-(-width // 2), -(-height // 2)), interpolation=cv2.INTER_AREA)
    return np.asarray(cv2.GaussianBlur(small, (0, 0), _COLOUR_PX / 2))


class _Indirect(Light):
    """Trace the light between surfaces of one scene, seen along the rays through the pixels' centres.

    These rays are traced once: the filter's guide and all samples share their hits.
    """

    def __init__(self, surface: TerrainMesh, scene: RenderInput) -> None:
        super().__init__(surface, scene, banded=scene.bounces > 1 or has_bands(surface, scene))
        self.samples_per_pixel = max(1, scene.samples_per_pixel // _DIRECT_PER_INDIRECT)
        sun, model = scene.sun, scene.reflectance
        if self.banded:
            self.weights = np.diag(sun.irradiance_W_m2_nm)
        else:
            self.weights = (model.weights[0] ** 2 * sun.irradiance_W_m2_nm)[None, :]
        self._first = self.world.trace(self.optics.centre_rays())
        dr.eval(*self._first)

    def guide(self) -> tuple[_Guide, NDArray[np.uint32]]:
        """Return the guide of the view, and the pixels that see the spacecraft."""
        rays = self.optics.centre_rays()
        hit = self.seen(self.world.hit(rays, self._first))
        normal, (x, y, z) = facing(hit.normal, -rays.d), self.optics.axes
        in_camera = (dr.dot(normal, x), dr.dot(normal, y), dr.dot(normal, z), hit.range_m * dr.dot(rays.d, z))
        record = dr.ravel(mi.Vector4f(*(dr.select(hit.valid, value, 0) for value in in_camera)))
        on_vehicle = mi.Bool(False) if hit.on_vehicle is None else hit.on_vehicle
        dr.eval(record, on_vehicle)
        return _Guide(self.scene.view, record), np.flatnonzero(on_vehicle.numpy()).astype(np.uint32)

    def image(self) -> Image:
        """Return the unfiltered radiance, float32[band, y, x]."""
        view, spp = self.scene.view, self.samples_per_pixel
        weights = (self.weights / spp).astype(np.float32)
        out = np.zeros((weights.shape[1], view.height_px, view.width_px), dtype=np.float32)
        key = self.scene.key ^ 0x5BD1E995
        for tiles in _Tiles.cover(view.width_px, view.height_px, len(weights)):
            rows = slice(tiles.first_row, tiles.first_row + tiles.rows)
            for round_ in range(spp):
                terms = self.terms(TileStrata(tiles, spp, round_, key + round_))
                dr.eval(*terms)
                ordered = [tiles.in_rows(term) for term in terms]
                dr.eval(*ordered)
                for row, values in zip(weights, ordered, strict=True):
                    values = values.numpy().reshape(tiles.rows, tiles.width)
                    for band in np.flatnonzero(row):
                        out[band, rows] += values * row[band]
        return out

    def of_pixels(self, pixels: NDArray[np.uint32]) -> Image:
        """Return the unfiltered radiance of listed pixels, float32[band, pixel], from more samples."""
        listed = Cells(pixel=pixels, cell=np.zeros_like(pixels), side=1)
        weights = (self.weights / _ON_VEHICLE).astype(np.float32)
        parts = []
        for part in listed.parts(WAVEFRONT // (_ON_VEHICLE * len(weights))):
            strata = _PixelStrata(part, _ON_VEHICLE, self.scene.key ^ 0x27D4EB2F, None)
            terms = self.terms(strata)
            dr.eval(*terms)
            sums = [dr.block_sum(term, _ON_VEHICLE) for term in terms]
            parts.append(weights.T @ np.stack([of.numpy() for of in sums]))
        return np.concatenate(parts, axis=1)

    def terms(self, strata: TileStrata | _PixelStrata) -> list[Any]:
        """Return the light of each sample, an array for each row of `weights`."""
        rays = self.optics.centre_rays(strata.pixel)
        first = dr.gather(type(self._first), self._first, strata.pixel, strata.inside)
        hit = self.world.hit(rays, first)
        hit.valid &= strata.inside
        hit = self.seen(hit)
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
        self.pixel = y * tiles.width + x + dr.opaque(mi.UInt32, tiles.first_row * tiles.width)
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


class _PixelStrata(CellStrata):
    """Provide samples of listed pixels, with strata of directions."""

    inside = True

    def directions(self) -> tuple[Any, Any]:
        """Return a uniform point of each stratum of the unit square; a hash of the pixel chooses their order."""
        u, v = self.jitter(_FIRST_BOUNCE)
        order = self.index ^ (((self.pixel ^ self._key) * 0x9E3779B1) >> 16)
        side = round(_ON_VEHICLE**0.5)
        x, y = order & (side - 1), (order >> (side.bit_length() - 1)) & (side - 1)
        return (mi.Float(x) + u) / side, (mi.Float(y) + v) / side


def _reversed(three_bits: Any) -> Any:
    """Return three bits in reverse order, so that neighbouring pixels of a tile get distant strata."""
    return ((three_bits & 1) << 2) | (three_bits & 2) | (three_bits >> 2)


class _Guide:
    """Hold the normals and depths of a view's pixels, which show which neighbours lie on the same surface.

    `record` holds, for each pixel, the normal in camera axes and the depth; the depth is 0 on the sky.
    """

    def __init__(self, view: View, record: Any) -> None:
        self.optics = Optics(view)
        self.width, self.height = view.width_px, view.height_px
        self._record = record
        self._pixel_size = dr.opaque(mi.Float, 1 / float(view.intrinsics[0]))

    @classmethod
    def of(cls, view: View, truth: Truth) -> _Guide:
        """Return the guide of a view's truth."""
        record = np.concatenate([truth.normal.astype(np.float32), truth.depth_m[..., None]], axis=2)
        record[~np.isfinite(truth.depth_m)] = 0
        return cls(view, packets(mi.Float, record))

    def _geometry_at(self, x: Any, y: Any) -> tuple[Any, Any, Any]:
        """Return the normal, the position in camera axes and the depth (0 on the sky) at pixels."""
        record = dr.gather(mi.Vector4f, self._record, mi.UInt32(y * self.width + x))
        depth = record.w
        across, down, along = self.optics.towards(mi.Float(x) + 0.5, mi.Float(y) + 0.5)
        length = depth if along is None else depth / along
        return record.xyz, mi.Vector3f(across * length, down * length, depth), depth

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

    def interpolated(self, values: Any, finer: _Guide) -> Any:
        """Return the values at pixels of half the size, from neighbours on the same surface."""
        pixel = dr.arange(mi.Int32, finer.width * finer.height)
        x, y = pixel % finer.width, pixel // finer.width
        normal, point, depth = finer._geometry_at(x, y)
        per_plane = 1 / (_SIGMA_PLANE_PX * self._pixel_size * dr.maximum(depth, 1e-6))
        total, weights, plain, count = mi.Float(0), mi.Float(0), mi.Float(0), mi.Float(0)
        # the nearest pixel of the coarser grid has 3/4 of the weight along each axis, that on the other side 1/4
        for down in (0, 1):
            for right in (0, 1):
                qx = dr.clip((x >> 1) + right * (2 * (x & 1) - 1), 0, self.width - 1)
                qy = dr.clip((y >> 1) + down * (2 * (y & 1) - 1), 0, self.height - 1)
                other, other_point, far = self._geometry_at(qx, qy)
                off = dr.dot(normal, other_point - point) * per_plane
                turn = dr.squared_norm(other - normal) * (1 / _SIGMA_NORMAL**2)
                near = dr.select(far > 0, (3 - 2 * right) * (3 - 2 * down), 0.0)
                value = dr.gather(mi.Float, values, mi.UInt32(qy * self.width + qx))
                weight = near * dr.exp(-0.5 * (off * off + turn))
                total, weights = total + weight * value, weights + weight
                plain, count = plain + near * value, count + near
        # a pixel whose surface no neighbour shares takes their mean
        alike = weights > 1e-4
        mean = dr.select(alike, total, plain) / dr.maximum(dr.select(alike, weights, count), 1e-20)
        return dr.select(depth > 0, mean, 0)
