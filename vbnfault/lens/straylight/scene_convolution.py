"""Compute glare and diffraction of an extended scene, as convolutions over direction cosines.

The glare of a point is a function of β, the distance between the directions of source and pixel in direction
cosines (`scatter`). So the glare of a scene is a convolution over direction cosines. Its kernel changes slowly with
the field angle of the source, because rims cut off part of the light that reaches the surfaces. `separated` writes
it as a sum of few products of a function of the field angle and a function of β; each product is one convolution by
FFT.

Each part of the scene has the starburst of a small Sun (`starburst`), at distances from `POINT_SPREAD_PX` pixels
on: nearer, the point spread of the lens already holds its light. The light depends on the distance of two
directions in direction cosines alone, so that of a scene is a convolution, with one kernel for each of the few
tables of the starburst. Rims that cut off part of an oblique beam are left out.

A camera whose point spread was measured (`camera.point_spread`) has the wings of its stop in it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ...core.errors import InputError
from ...core.spectra import Bands
from ..paraxial import paraxial_properties
from ..point_spread import REACH_PX
from ..prescription import Prescription
from .settings import SensorGrid
from .starburst import Starburst, StarburstFrame, starburst

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]

_REST = 1e-2  # largest part of a kernel's light per interval of ln β that `separated` may leave out
_MOST_TERMS = 12
_NEAR = 4  # nodes around the kernel's middle in which it is averaged
_INSIDE = 9  # samples along each side of such a cell


@dataclass(frozen=True, kw_only=True, eq=False)
class SeparatedKernel:
    """Hold kernels K(band, field angle, β) ≈ Σ `of_source`[term, band, angle] · `of_offset`[term, β].

    Attributes
    ----------
    slope
        float64[angle], rising: tangents of the field angles.
    offset
        float64[sample], rising: β.
    of_source, of_offset
        float64[term, band, angle] and float64[term, sample].
    """

    slope: F64
    offset: F64
    of_source: F64
    of_offset: F64


def separated(kernels: F64, slope: F64, offset: F64) -> SeparatedKernel:
    """Return kernels float64[band, angle, sample] as a sum of products, by adaptive cross approximation.

    Terms are added until the rest has less than 1 % of the light, at every β, of the brightest kernel. (Bebendorf
    2000, Numer. Math. 86, 565; here with full pivoting, as the matrix is small.)
    """
    bands, angles, samples = kernels.shape
    # the light in a ring of constant width in ln β is β² times the kernel
    rest = (kernels * offset**2).reshape(bands * angles, samples)
    first: list[F64] = []
    second: list[F64] = []
    least = _REST * float(np.abs(rest).max(initial=0))
    while len(first) < _MOST_TERMS:
        row, column = np.unravel_index(int(np.argmax(np.abs(rest))), rest.shape)
        pivot = rest[row, column]
        if abs(pivot) <= least:
            break
        first.append(rest[:, column] / pivot)
        second.append(rest[row].copy())
        rest = rest - first[-1][:, None] * second[-1]
    return SeparatedKernel(
        slope=slope,
        offset=offset,
        of_source=np.array(first).reshape(len(first), bands, angles),
        of_offset=np.array(second).reshape(len(second), samples) / offset**2,
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class DirectionGrid:
    """Describe a square grid of direction cosines, and how sources and pixels lie on it.

    Attributes
    ----------
    step, count
        Distance of neighbouring nodes in direction cosines, and nodes along each side; the axis is in the middle.
    deposit
        Sparse float32[node, source] that puts sources on the four nodes around them.
    column, row
        float32[y, x]: position of each pixel of the sensor on the grid.
    """

    step: float
    count: int
    deposit: Any
    column: F32
    row: F32

    @classmethod
    def of(cls, x: F64, y: F64, step: float, sensor: SensorGrid, efl_mm: float) -> DirectionGrid:
        """Return the grid for sources whose images lie at x, y in focal lengths."""
        from scipy.sparse import csr_matrix

        height, width = sensor.shape
        px = (np.arange(width) + 0.5 - width / 2) * sensor.pitch_mm / efl_mm
        py = ((np.arange(height) + 0.5 - height / 2) * sensor.pitch_mm / efl_mm)[:, None]
        per_length = 1 / np.sqrt(1 + px**2 + py**2)
        shorter = 1 / np.sqrt(1 + x**2 + y**2)
        u, v = x * shorter, y * shorter
        most = max(np.abs(u).max(), np.abs(v).max(), (px * per_length).max(), (py * per_length).max())
        count = 2 * int(np.ceil(most / step)) + 3
        middle = (count - 1) / 2
        u, v = u / step + middle, v / step + middle
        column, row = np.floor(u).astype(np.int64), np.floor(v).astype(np.int64)
        du, dv = u - column, v - row
        weights, nodes = [], []
        for k, down in ((0, 1 - dv), (1, dv)):
            for j, right in ((0, 1 - du), (1, du)):
                weights.append((down * right).astype(np.float32))
                nodes.append((row + k) * count + column + j)
        source = np.tile(np.arange(len(u)), 4)
        deposit = csr_matrix((np.concatenate(weights), (np.concatenate(nodes), source)), shape=(count**2, len(u)))
        return cls(
            step=step,
            count=count,
            deposit=deposit,
            column=(px * per_length / step + middle).astype(np.float32),
            row=(py * per_length / step + middle).astype(np.float32),
        )

    @property
    def padded(self) -> int:
        """Return the size of the Fourier transform, in which no light reaches around the edge."""
        from scipy.fft import next_fast_len

        return int(next_fast_len(2 * self.count - 1, real=True))

    def spectrum(self, offset: F64, kernel: F64) -> F32:
        """Return the Fourier transform of a kernel on the grid; it is real, as the kernel is symmetric."""
        from scipy.fft import rfft2

        quadrant = np.zeros((self.count, self.count))
        node = np.arange(self.count) * self.step
        log = np.log(offset)

        def value(beta: F64) -> F64:
            return np.asarray(np.interp(np.log(np.maximum(beta, offset[0])), log, kernel, right=0.0))

        quadrant[:] = value(np.hypot(node[:, None], node))
        near = node[:_NEAR, None] + ((np.arange(_INSIDE) + 0.5) / _INSIDE - 0.5) * self.step
        square = value(np.hypot(near[:, None, :, None], near[None, :, None, :]))
        quadrant[:_NEAR, :_NEAR] = square.mean(axis=(2, 3))
        size = self.padded
        whole = np.zeros((size, size), dtype=np.float32)
        whole[: self.count, : self.count] = quadrant
        whole[size - self.count + 1 :, : self.count] = quadrant[:0:-1]
        whole[:, size - self.count + 1 :] = whole[:, self.count - 1 : 0 : -1]
        return np.ascontiguousarray(rfft2(whole).real)

    def convolved(self, terms: Sequence[tuple[F32, F32]]) -> F32:
        """Return the sum of convolutions at every pixel, float32[channel, y, x].

        `terms` are light of the sources, float32[channel, source], and the `spectrum` of its kernel.
        """
        from scipy.fft import irfft2, rfft2

        size, count = self.padded, self.count
        total: Any = 0.0
        for light, spectrum in terms:
            nodes = (self.deposit @ light.T).T.reshape(len(light), count, count)
            total = total + rfft2(nodes, s=(size, size), workers=2) * spectrum
        light = irfft2(total, s=(size, size), workers=2)[:, :count, :count]
        return np.stack(
            [cv2.remap(np.ascontiguousarray(v), self.column, self.row, cv2.INTER_LINEAR) for v in light]
        )


# --- diffraction ------------------------------------------------------------------------------------------------


# The wings begin here; over a pixel on either side of it they fade in.
POINT_SPREAD_PX = float(REACH_PX)
_RADIUS_OF_SQUARE = np.pi**-0.5  # of the disc that stands for a source, in widths of the source
_WIDEST_RAD = 0.5  # of the disc
_LEAST_AIRY = 3.0  # smallest radius of a disc that `Starburst` allows, in wavelengths over the entrance pupil
# Sources and pixels lie between the nodes of the grid. Both interpolations together blur the kernel by this
# variance along each axis, in steps squared: a position that is uniform between two nodes adds a sixth.
_BLUR = 1 / 3


def starburst_of_source(lens: Prescription, bands: Bands, width_rad: float) -> Starburst:
    """Return the starburst of a source as wide as a pixel of a render."""
    pupil_mm = paraxial_properties(lens).entrance_pupil_diameter_mm
    radius_rad = max(_RADIUS_OF_SQUARE * width_rad, _LEAST_AIRY * bands.nm[-1] * 1e-6 / pupil_mm)
    if not 0 < radius_rad < _WIDEST_RAD:
        raise InputError(
            f"scene_diffraction: a pixel, or the diffraction of an entrance pupil of {pupil_mm:.2g} mm, spreads "
            f"light over {radius_rad:.2g} rad; must be below {_WIDEST_RAD:g} rad"
        )
    return starburst(lens, sun_radius_rad=radius_rad)


def wing_spectra(
    burst: Starburst, bands: Bands, grid: DirectionGrid, sensor: SensorGrid
) -> tuple[tuple[F32, ...], F64]:
    """Return the Fourier transforms of kernels on a grid of directions, and their weights in each band.

    The kernels are irradiance on the sensor, without cos⁴ of the pixel's field angle, over irradiance of a source
    across the stop, for a lens with a transmission of 1. The transforms are real, as |A(-k)| = |A(k)|. The weights
    are float64[band, kernel].
    """
    from scipy.fft import rfft2

    size, count = grid.padded, grid.count
    offset = (np.arange(size) + size // 2) % size - size // 2
    node = np.where(np.abs(offset) < count, offset, 0)
    frame = StarburstFrame(sun_xy_mm=(0.0, 0.0), bands=bands, sensor=sensor)
    u = (node * grid.step).astype(np.float32)
    layers, mix = burst.layers_at(frame, u[None, :], u[:, None])
    away = np.hypot(node[:, None], node)
    pixel_steps = sensor.pitch_mm / burst.efl_mm / grid.step
    gain = (_faded_in(away / pixel_steps) / burst.efl_mm**2).astype(np.float32)
    gain[np.abs(offset) >= count] = 0
    gain[:, np.abs(offset) >= count] = 0
    return tuple(np.ascontiguousarray(rfft2(_sharpened(layer * gain)).real) for layer in layers), mix


def wing_fraction(burst: Starburst, bands: Bands, sensor: SensorGrid) -> F64:
    """Return the fraction of the light that passes the stop and is in the wings, float64[band]."""
    pitch_mm = sensor.pitch_mm
    frame = StarburstFrame(sun_xy_mm=(0.0, 0.0), bands=bands, sensor=sensor)
    flux_mm2 = burst.flux_by_distance(frame, lambda sine: _faded_in(sine * burst.efl_mm / pitch_mm))
    return flux_mm2 / (np.pi * burst.pupil_radius_mm**2)


def _sharpened(kernel: F32) -> F32:
    """Return a kernel less half of `_BLUR` times its Laplacian, which the interpolations add again."""
    around = sum(np.roll(kernel, shift, axis) for shift in (-1, 1) for axis in (0, 1))
    return np.asarray(kernel - np.float32(_BLUR / 2) * (around - 4 * kernel))


def _faded_in(away_px: F64) -> F64:
    """Return the fraction of the light at a distance from the image of a point that is in the wings."""
    return np.clip((away_px - POINT_SPREAD_PX + 1) / 2, 0, 1)
