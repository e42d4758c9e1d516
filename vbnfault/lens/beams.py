"""Tabulate the beams of far points that pass all rims of a lens, with exact rays.

The lens has rotational symmetry, so one table over the field angle holds all beams. Positions have the image's
axes: x to the right, y down. Light of a point to the right of the axis travels to +x. Everything holds for the d
line.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import NDArray

from .glass import D_NM
from .mapping import inclined_rays, relative_radii
from .prescription import Prescription
from .rays import Path

F64 = NDArray[np.float64]

_ANGLES = 33
_AZIMUTHS = 65  # of half a rim, both ends included
_HEIGHTS = 97  # rays of a meridional fan
_FANS = 2
_HALVINGS = 10
_NARROWINGS = 8
_RINGS = 6  # of rays within a rim


@dataclass(frozen=True, kw_only=True, eq=False)
class Beams:
    """Tabulate beams of far points over the tangent of the field angle, in the plane of the first vertex.

    Attributes
    ----------
    slope
        float64[angle]: tangents of the field angles.
    centre_mm
        float64[angle]: a point inside each beam, on the x axis.
    rim_mm
        float64[angle, azimuth]: distance of the rim from that point, for azimuths from 0 to π; 0 where no light
        passes.
    """

    lens: Prescription
    sensor_mm: float
    slope: F64
    centre_mm: F64
    rim_mm: F64

    @cached_property
    def bundle(self) -> Path:
        """Return traced rays at the centres, on rings of equal areas and on the rims: [angle × azimuth × ring].

        The azimuths are those of half a rim, and ring 0 is the centre.
        """
        distance = self.rim_mm[..., None] * np.sqrt(np.arange(_RINGS + 1) / _RINGS)
        turn = np.linspace(0, np.pi, _AZIMUTHS)[:, None]
        x = self.centre_mm[:, None, None] + distance * np.cos(turn)
        return inclined_rays(
            self.lens, self.slope[:, None, None], x, distance * np.sin(turn), D_NM, self.sensor_mm
        )[0]


@lru_cache(maxsize=8)
def beams(lens: Prescription, largest_slope: float, sensor_mm: float) -> Beams:
    """Return the beams of a lens up to a tangent of the field angle, or up to where the lens is dark.

    Rims are located by bisection and a final linear interpolation, on the assumption that beams are convex.
    """
    lens = lens.with_round_stop()
    for _ in range(_NARROWINGS):
        slope = np.tan(np.linspace(0, np.arctan(largest_slope), _ANGLES))
        centre, width = _innermost(lens, sensor_mm, slope)
        # use the field angles where there is light: up to the first dark one
        last = int(np.flatnonzero(width).max(initial=0))
        if last >= _ANGLES // 2:
            break
        largest_slope = float(slope[last + 1])
    azimuth = np.linspace(0, np.pi, _AZIMUTHS)
    low = np.zeros((_ANGLES, _AZIMUTHS))
    high = low + (1.5 * np.maximum(width, width[0]))[:, None]
    inside, outside = low, high + np.inf  # relative radius of the rays at both ends
    for _ in range(_HALVINGS):
        half = (low + high) / 2
        x, y = centre[:, None] + half * np.cos(azimuth), half * np.sin(azimuth)
        beyond = relative_radii(lens, slope[:, None], x, y, sensor_mm)
        passes = beyond <= 1
        low, inside = np.where(passes, half, low), np.where(passes, beyond, inside)
        high, outside = np.where(passes, high, half), np.where(passes, outside, beyond)
    fraction = np.where(np.isfinite(outside), (1 - inside) / np.maximum(outside - inside, 1e-12), 0)
    rim = np.where(width[:, None] > 0, low + (high - low) * np.clip(fraction, 0, 1), 0)
    return Beams(lens=lens, sensor_mm=sensor_mm, slope=slope, centre_mm=centre, rim_mm=rim)


def _innermost(lens: Prescription, sensor_mm: float, slope: F64) -> tuple[F64, F64]:
    """Return a point well inside each beam, from a fan of rays on the x axis, and its approximate width there.

    The width is 0 where no light passes.
    """
    reach = lens.surfaces[0].reach_mm(slope)
    middle, width = np.zeros_like(slope), np.zeros_like(slope)
    for _ in range(_FANS):
        heights = middle[:, None] + reach[:, None] * np.linspace(-1, 1, _HEIGHTS)
        outside = relative_radii(lens, slope[:, None], heights, np.zeros(1), sensor_mm)
        middle = heights[np.arange(len(slope)), np.argmin(outside, axis=1)]
        step = heights[:, 1] - heights[:, 0]
        passing = (outside <= 1).sum(axis=1)
        width = np.maximum(width, np.where(passing, (passing + 1) * step, 0))
        reach = 2 * step
    return middle, width
