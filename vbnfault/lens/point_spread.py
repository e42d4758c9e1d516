"""Make point spread functions from spot diagrams and diffraction, and apply them to an image in tiles.

A bundle of rays at each field angle is bounded by all rims together. Its area in the plane of the first vertex is
the light that the lens admits; the pattern of its rays on the sensor is the spot diagram. Diffraction blurs that to
the point spread of a position. Neighbouring positions are alike, so an image is divided into overlapping tiles with
one function each, and the results are blended linearly.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from .adapt import axial_beam_diameter_mm
from .mapping import fan_heights_mm, inclined_rays, relative_radii
from .paraxial import paraxial_properties
from .prescription import Prescription

F64 = NDArray[np.float64]

_HEIGHTS = 129  # rays of a narrower meridional fan
_RAYS_OF_BEAM = 4  # the axial beam must hold at least this many of them
_AZIMUTHS = 32  # over half a turn of a bundle
_RADII = 33  # samples along a radius that locate a bundle's rim, and
_FINE_RADII = 9  # samples within the interval that holds it
_RINGS = 10  # of a bundle's rays


@dataclass(frozen=True, kw_only=True, eq=False)
class FieldBundles:
    """Hold, per field angle, the bundle of rays that passes all rims, in the plane of the first vertex.

    `centre_mm` float64[angle] is a point inside the bundle on the x axis. `rim_mm` float64[angle, azimuth] is the
    distance of the bundle's rim from there, for azimuths within half a turn; the other half is its mirror image.
    """

    slope: F64
    centre_mm: F64
    rim_mm: F64

    def select(self, keep: NDArray[np.bool_]) -> FieldBundles:
        """Return the bundles of rays at the field angles where `keep`, bool[angle], is set."""
        return FieldBundles(slope=self.slope[keep], centre_mm=self.centre_mm[keep], rim_mm=self.rim_mm[keep])

    @property
    def azimuth_rad(self) -> F64:
        """Return the azimuths of `rim_mm`, float64[azimuth]."""
        return np.asarray((np.arange(_AZIMUTHS) + 0.5) * np.pi / _AZIMUTHS)

    @property
    def area_mm2(self) -> F64:
        """Return the area of each bundle, float64[angle].

        The midpoint rule converges fast over the whole turn of a smooth rim.
        """
        return np.asarray((self.rim_mm**2).sum(axis=1) * np.pi / _AZIMUTHS)


def field_bundles(lens: Prescription, slope: F64) -> FieldBundles:
    """Return the bundles at the d line; each rim is located between rays that pass and rays that do not."""
    sensor = paraxial_properties(lens).bfd_mm

    def beyond(x: F64, y: F64) -> F64:
        """Return the relative radii of rays through (x, y), whose first axis is the field angle."""
        return relative_radii(lens, slope.reshape(-1, *(1,) * (x.ndim - 1)), x, y, sensor)

    heights = fan_heights_mm(lens, slope)
    outside = beyond(heights, np.zeros(1))
    each = np.arange(len(slope))
    # the beam of a nearly closed stop fits between two rays: trace narrower fans around the ray nearest to passing
    beam_mm = axial_beam_diameter_mm(lens)
    while beam_mm > 0 and (step := float((heights[:, 1] - heights[:, 0]).max())) > beam_mm / _RAYS_OF_BEAM:
        middle = heights[each, np.argmin(outside, axis=1)][:, None]
        heights = middle + 2 * max(step, beam_mm) * np.linspace(-1, 1, _HEIGHTS)
        outside = beyond(heights, np.zeros(1))
    centre = heights[each, np.argmin(outside, axis=1)]
    passing = outside <= 1
    width = passing.sum(axis=1) * (heights[:, 1] - heights[:, 0])
    reach = 1.5 * np.maximum(width, width[0])
    azimuth = (np.arange(_AZIMUTHS) + 0.5) * np.pi / _AZIMUTHS

    def rim(near: F64, far: F64, samples: int) -> tuple[F64, F64, F64]:
        """Return an interval of distances that holds the rim, and the rim by linear interpolation within it."""
        distance = near[..., None] + (far - near)[..., None] * np.linspace(0, 1, samples)
        x = centre[:, None, None] + distance * np.cos(azimuth)[:, None]
        over = beyond(x, distance * np.sin(azimuth)[:, None])
        k = np.maximum(np.argmax(over > 1, axis=2), 1)[..., None]
        (low, high), (a, b) = (
            (np.take_along_axis(v, k - 1, 2)[..., 0], np.take_along_axis(v, k, 2)[..., 0]) for v in (distance, over)
        )
        with np.errstate(invalid="ignore"):
            fraction = np.where(np.isfinite(b), (1 - a) / np.maximum(b - a, 1e-12), 0.0)
        return low, high, low + np.clip(fraction, 0, 1) * (high - low)

    nothing = np.zeros((len(slope), _AZIMUTHS))
    low, high, _ = rim(nothing, nothing + reach[:, None], _RADII)
    _, _, rim_mm = rim(low, high, _FINE_RADII)
    rim_mm[~passing.any(axis=1)] = 0
    return FieldBundles(slope=slope, centre_mm=centre, rim_mm=rim_mm)


@dataclass(frozen=True, kw_only=True, eq=False)
class SpotDiagrams:
    """Hold the rays of each bundle at the sensor, half of them; the other half mirrors them in the x axis.

    `position_mm` and `slope`, float64[angle, ray, 2], have x pointing outwards. `weight_mm2` float64[angle, ray] is
    the area that each ray came through.
    """

    position_mm: F64
    slope: F64
    weight_mm2: F64

    def centred(self, values: F64) -> F64:
        """Return the values without the weighted mean of x; the mean of y is 0 by symmetry."""
        total = np.maximum(self.weight_mm2.sum(axis=1), 1e-300)
        mean = (self.weight_mm2 * values[..., 0]).sum(axis=1) / total
        return np.asarray(values - np.stack([mean, np.zeros_like(mean)], axis=-1)[:, None])

    def mean(self, values: F64) -> F64:
        """Return the weighted mean over the rays, float64[angle]."""
        total = np.maximum(self.weight_mm2.sum(axis=1), 1e-300)
        return np.asarray((self.weight_mm2 * values).sum(axis=1) / total)


def spot_diagrams(
    lens: Prescription, bundles: FieldBundles, wavelength_nm: float, sensor_mm: float
) -> SpotDiagrams:
    """Trace rays on rings of equal area in each bundle, and return them at the sensor."""
    ring = np.sqrt((np.arange(_RINGS) + 0.5) / _RINGS)
    azimuth = bundles.azimuth_rad
    distance = (bundles.rim_mm[:, :, None] * ring).reshape(len(bundles.slope), -1)
    turn = np.repeat(azimuth, _RINGS)
    x, y = bundles.centre_mm[:, None] + distance * np.cos(turn), distance * np.sin(turn)
    path, shape = inclined_rays(lens, bundles.slope[:, None], x, y, wavelength_nm, sensor_mm)
    weight = np.repeat(bundles.rim_mm**2, _RINGS, axis=1)
    lost = ~np.isfinite(path.points_mm[-1, :, 0]).reshape(shape)
    slope = path.directions[:, :2] / path.directions[:, 2:]
    return SpotDiagrams(
        position_mm=np.nan_to_num(path.points_mm[-1, :, :2]).reshape(*shape, 2),
        slope=np.nan_to_num(slope).reshape(*shape, 2),
        weight_mm2=np.where(lost, 0, weight),
    )


# --- images -----------------------------------------------------------------------------------------------------


F32 = NDArray[np.float32]

# The point spread reaches this many pixels from its centre; light beyond is distributed within.
REACH_PX = 7
# A point spread with a smaller root-mean-square radius is not applied.
_SHARP_PX = 0.3

_TILE_PX = 128
_FINE = 5  # cells of a pixel in which rays of a spot are counted
_ROUNDS = 12  # iterations that correct a spot's width
_TRIM = 2e-3  # largest fraction of a point spread in the outermost pixels that are cut off
_AIRY_SIGMA = 0.42  # sigma of the Gaussian closest to an Airy pattern's core, in wavelengths × f-number
_DIRECT_TAPS = 121  # with more taps OpenCV uses Fourier transforms, which spread the Sun's rounding errors


# --- images ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True, eq=False)
class PointSpreads:
    """Hold the point spread functions of overlapping tiles of the image; neighbouring tiles blend linearly.

    `kernels[band][row][column]` is float32[n, n] with sum 1, or None where light stays in its pixel. `rows` and
    `columns` give start, stop and weights of each tile.
    """

    kernels: tuple[tuple[tuple[F32 | None, ...], ...], ...]
    rows: tuple[tuple[int, int, F32], ...]
    columns: tuple[tuple[int, int, F32], ...]

    @classmethod
    def of(
        cls,
        kernels_of_bands: Sequence[F32],
        rows: tuple[tuple[int, int, F32], ...],
        columns: tuple[tuple[int, int, F32], ...],
    ) -> PointSpreads:
        """Return the point spreads of the bands, each of kernels float32[tile, y, x], the tiles row by row."""
        kernels = []
        for stack in kernels_of_bands:
            trimmed = iter([_trimmed(kernel) for kernel in stack])
            kernels.append(tuple(tuple(next(trimmed) for _ in columns) for _ in rows))
        return cls(kernels=tuple(kernels), rows=rows, columns=columns)

    def applied(self, light: F32, band: int) -> F32:
        """Return a band's light, float32[y, x], after each pixel's light is spread by the kernels of its tiles."""
        kernels = self.kernels[band]
        if all(kernel is None for row in kernels for kernel in row):
            return light
        r = REACH_PX
        out = np.zeros((light.shape[0] + 2 * r, light.shape[1] + 2 * r), dtype=np.float32)
        for (top, bottom, down), of_row in zip(self.rows, kernels, strict=True):
            for (left, right, across), kernel in zip(self.columns, of_row, strict=True):
                part = light[top:bottom, left:right]
                if not part.any():
                    continue
                part = part * (down[:, None] * across)
                reach = 0
                if kernel is not None:
                    part, reach = spread(part, kernel), len(kernel) // 2
                window = out[top + r - reach : bottom + r + reach, left + r - reach : right + r + reach]
                cv2.add(window, part, window)
        return out[r:-r, r:-r]


def spread(light: F32, kernel: F32) -> F32:
    """Return the full convolution of light with a square kernel of odd size n, float32[y + n - 1, x + n - 1]."""
    n, half = len(kernel), len(kernel) // 2
    taps = np.ascontiguousarray(kernel[::-1, ::-1])
    rows = n if n * n <= _DIRECT_TAPS else half + 1
    wide = cv2.copyMakeBorder(light, half, half + n - rows, half, half, cv2.BORDER_CONSTANT, value=0)
    out = cv2.filter2D(wide, cv2.CV_32F, taps[:rows], anchor=(half, half), borderType=cv2.BORDER_CONSTANT)
    if rows < n:  # the rows of taps below the middle
        below = cv2.filter2D(wide, cv2.CV_32F, taps[rows:], anchor=(half, 0), borderType=cv2.BORDER_CONSTANT)
        out[:-1] += below[1:]
        out = out[: half - n + 1 or None]
    return np.asarray(out)


def tiles(size: int) -> tuple[F64, tuple[tuple[int, int, F32], ...]]:
    """Return the centres of the tiles along an axis, and start, stop and weights of each; all weights sum to 1."""
    count = max(1, round(size / _TILE_PX))
    edges = np.linspace(0, size, count + 1)
    ramp = size / count / 16
    tiles = []
    for k in range(count):
        low, high = (edges[k] - ramp if k else 0), (edges[k + 1] + ramp if k < count - 1 else size)
        start, stop = max(int(np.floor(low)), 0), min(int(np.ceil(high)), size)
        centre = np.arange(start, stop) + 0.5
        weight = np.ones(len(centre))
        if k:
            weight *= np.clip((centre - low) / (2 * ramp), 0, 1)
        if k < count - 1:
            weight *= np.clip((high - centre) / (2 * ramp), 0, 1)
        tiles.append((start, stop, weight.astype(np.float32)))
    return (edges[:-1] + edges[1:]) / 2, tuple(tiles)


# --- kernels -----------------------------------------------------------------------------------------------------


def kernels_of_spots(
    spots: SpotDiagrams,
    zone_slope: F64,
    slope: F64,
    azimuth_rad: F64,
    *,
    f_number: F64,
    wavelength_nm: float,
    pixel_pitch_um: float,
) -> F32:
    """Return point spread functions, float32[n, y, x], each with sum 1 and its centroid in the middle.

    Parameters
    ----------
    spots
        Spot diagrams at the field angles whose tangents are `zone_slope`, float64[angle], rising.
    slope, azimuth_rad
        float64[n]: tangents of the field angles, and azimuths from +x towards +y, of the positions wanted.
    f_number
        float64[n]: f-number of the beam there, which gives the width of diffraction.
    """
    position = spots.centred(spots.position_mm) * 1e3 / pixel_pitch_um
    # interpolate each ray of the bundle between the two nearest field angles
    k = np.clip(np.searchsorted(zone_slope, slope) - 1, 0, len(zone_slope) - 2)
    part = np.clip((slope - zone_slope[k]) / (zone_slope[k + 1] - zone_slope[k]), 0, 1)[:, None]
    position = position[k] * (1 - part[..., None]) + position[k + 1] * part[..., None]
    weight = spots.weight_mm2[k] * (1 - part) + spots.weight_mm2[k + 1] * part
    x, y = position[..., 0], position[..., 1]
    for _ in range(3):
        near = x * x + y * y <= REACH_PX**2
        weight = np.where(near | ~np.any(near & (weight > 0), axis=1, keepdims=True), weight, 0)
        x = x - ((weight * x).sum(axis=1) / weight.sum(axis=1))[:, None]
    x, y, weight = np.hstack([x, x]), np.hstack([y, -y]), np.hstack([weight, weight])
    sigma = _AIRY_SIGMA * wavelength_nm * 1e-3 * f_number / pixel_pitch_um
    return _rasterised(x, y, weight / weight.sum(axis=1)[:, None], azimuth_rad, sigma)


def _rasterised(x: F64, y: F64, weight: F64, azimuth_rad: F64, sigma: F64) -> F32:
    """Return the kernels of spots, given as rays, float64[n, ray] in pixels along and across the radius.

    Each spot is turned by its azimuth and blurred by a Gaussian of `sigma` pixels. A render's pixel is already a
    mean over its area. Distributing a ray over neighbouring pixels would add once more to the mean squares along
    both axes; the spot is shrunk beforehand by this amount, so that a kernel has the centroid and width of its
    spot.
    """
    cos, sin = np.cos(azimuth_rad)[:, None], np.sin(azimuth_rad)[:, None]
    squares = [np.maximum((weight * v * v).sum(axis=1), 1e-12) for v in (x, y)]
    scale = [np.ones(len(x)), np.ones(len(x))]
    for _ in range(_ROUNDS):
        turned = _turned(x * scale[0][:, None], y * scale[1][:, None], cos, sin)
        parts = [np.abs(v) % 1 for v in turned]
        added = [(weight * part * (1 - part)).sum(axis=1) for part in parts]
        along = cos[:, 0] ** 2
        more = along * added[0] + (1 - along) * added[1], along * added[1] + (1 - along) * added[0]
        scale = [
            (old + np.sqrt(np.maximum(1 - extra / square, 0))) / 2
            for old, extra, square in zip(scale, more, squares, strict=True)
        ]
    wanted = squares[0] + squares[1] + 2 * sigma**2
    x, y = _turned(x * scale[0][:, None], y * scale[1][:, None], cos, sin)
    n, side = len(x), 2 * REACH_PX + 1
    cells = side * _FINE
    total = np.zeros(n * cells * cells)
    u, v = ((p + side / 2) * _FINE - 0.5 for p in (x, y))
    column, row = np.floor(u).astype(np.int64), np.floor(v).astype(np.int64)
    for dy in (0, 1):
        for dx in (0, 1):
            light = weight * np.abs(1 - dx - (u - column)) * np.abs(1 - dy - (v - row))
            cell = (np.arange(n)[:, None] * cells + np.clip(row + dy, 0, cells - 1)) * cells
            cell += np.clip(column + dx, 0, cells - 1)
            total += np.bincount(cell.ravel(), light.ravel(), minlength=len(total))
    edge = np.arange(cells + 1) / _FINE - side / 2
    middle = (edge[1:] + edge[:-1]) / 2
    pixel = np.arange(side) - REACH_PX
    linear = np.maximum(1 - np.abs(middle[None, :] - pixel[:, None]), 0)
    s = np.maximum(sigma, 1e-3)[:, None, None]
    gauss = np.diff(ndtr((edge[None, :, None] - middle[None, None, :]) / s), axis=1)
    gather = np.einsum("ki,nij->nkj", linear, gauss)
    gathered = np.einsum("nyi,nij->nyj", gather, total.reshape(n, cells, cells))
    kernels = np.einsum("nyj,nxj->nyx", gathered, gather)
    kernels /= np.maximum(kernels.sum(axis=(1, 2), keepdims=True), 1e-300)
    # the middle pixel takes light until the remaining excess of width is gone
    square = (kernels * (pixel[None, :] ** 2 + pixel[:, None] ** 2)).sum(axis=(1, 2))
    kernels *= np.minimum(wanted / np.maximum(square, 1e-300), 1)[:, None, None]
    kernels[:, REACH_PX, REACH_PX] += 1 - kernels.sum(axis=(1, 2))
    return np.asarray(kernels, dtype=np.float32)


def _turned(x: F64, y: F64, cos: F64, sin: F64) -> tuple[F64, F64]:
    """Return points turned about the origin."""
    return x * cos - y * sin, x * sin + y * cos


def _trimmed(kernel: F32) -> F32 | None:
    """Return the kernel without its nearly empty border, its sum still 1; None where it hardly blurs."""
    half = len(kernel) // 2
    offset = np.arange(-half, half + 1)
    square = float((kernel * (offset[None, :] ** 2 + offset[:, None] ** 2)).sum())
    if np.sqrt(square) < _SHARP_PX:
        return None
    for reach in range(1, half + 1):
        inner = kernel[half - reach : half + reach + 1, half - reach : half + reach + 1]
        if inner.sum() >= 1 - _TRIM:
            break
    return np.ascontiguousarray(inner / inner.sum(dtype=np.float64), dtype=np.float32)
