"""Compute what the stop diffracts of an extended scene: the far wings of every part of it.

Each part of the scene has the starburst of a small Sun (`starburst`), at distances from `POINT_SPREAD_PX` pixels
on: nearer, the point spread of the lens already holds its light. The light depends on the distance of two
directions in direction cosines alone, so that of a scene is a convolution, with one kernel for each of the few
tables of the starburst. Rims that cut off part of an oblique beam are left out.

A camera whose point spread was measured (`camera.point_spread`) has the wings of its stop in it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ...core.spectra import Bands
from ..paraxial import paraxial_properties
from ..point_spread import REACH_PX
from ..prescription import Prescription
from .scene_scatter import DirectionGrid
from .settings import SensorGrid
from .starburst import Starburst, StarburstFrame, starburst

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]

# The wings begin here; over a pixel on either side of it they fade in.
POINT_SPREAD_PX = float(REACH_PX)
_RADIUS_OF_SQUARE = np.pi**-0.5  # of the disc that stands for a source, in widths of the source
_LEAST_AIRY = 3.0  # smallest radius of a disc that `Starburst` allows, in wavelengths over the entrance pupil
# Sources and pixels lie between the nodes of the grid. Both interpolations together blur the kernel by this
# variance along each axis, in steps squared: a position that is uniform between two nodes adds a sixth.
_BLUR = 1 / 3


def starburst_of_source(lens: Prescription, bands: Bands, width_rad: float) -> Starburst:
    """Return the starburst of a source as wide as a pixel of a render."""
    airy_rad = bands.nm[-1] * 1e-6 / paraxial_properties(lens).entrance_pupil_diameter_mm
    return starburst(lens, sun_radius_rad=max(_RADIUS_OF_SQUARE * width_rad, _LEAST_AIRY * airy_rad))


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
