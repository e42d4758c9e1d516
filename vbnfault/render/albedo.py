"""Look up a map of the albedo at points of the ground."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .runtime import dr, mi

F64 = NDArray[np.float64]

# The wavelengths of R, G and B of a coloured map. Between them factors are linear, beyond them constant.
_RGB_NM = (650.0, 550.0, 450.0)

# Takes unit vectors towards the Sun and the camera, with z along the normal; returns what water adds to the terms
# of the bands.
Mirror = Callable[[Any, Any], list[Any]]


@dataclass(frozen=True, kw_only=True, eq=False)
class GroundPoints:
    """Hold points of the ground and how they are seen.

    Attributes
    ----------
    point_L_m
        Positions in L.
    footprint_m
        Distance between neighbouring rays at the points.
    valid
        Whether there is a point.
    view_L, sun_L
        Unit vectors towards the camera and the Sun.
    """

    point_L_m: Any
    footprint_m: Any
    valid: Any
    view_L: Any
    sun_L: Any


class GroundAlbedo:
    """Hold what albedos of the ground in three colours share.

    Parameters
    ----------
    wavelength_nm
        Bands, float64[band].
    reference_band
        Index of the band of `at_reference`.
    T_from_L, site_T_m
        Rotation float64[3, 3] and position float64[3] in m of the axes L in the body-fixed frame T.
    """

    def __init__(self, *, wavelength_nm: F64, reference_band: int, T_from_L: F64, site_T_m: F64) -> None:
        order = np.argsort(_RGB_NM)
        hats = [np.interp(wavelength_nm, np.array(_RGB_NM)[order], np.eye(3)[k][order]) for k in range(3)]
        self._weights = np.stack(hats, axis=1)
        self._reference = reference_band
        self._axes = [mi.Vector3f(*map(float, row)) for row in T_from_L]
        self._site = [float(x) for x in site_T_m]

    def _in_T(self, ground: GroundPoints) -> list[Any]:
        """Return the coordinates of points in T; those of a ray that hits nothing are finite, too."""
        point = dr.select(ground.valid, mi.Vector3f(ground.point_L_m), 0)
        return [dr.dot(axis, point) + s for axis, s in zip(self._axes, self._site, strict=True)]

    def _in_bands(self, colours: Any) -> list[Any]:
        """Return the sum of the colours in each band."""
        return [self._in_band(k, colours) for k in range(len(self._weights))]

    def _in_band(self, band: int, colours: Any) -> Any:
        """Return the sum of the colours in a band."""
        weights = self._weights[band]
        return sum((v * float(w) for w, v in zip(weights, colours, strict=True) if w), mi.Float(0))


class AlbedoMap(GroundAlbedo):
    """Hold an equirectangular map of factors on the albedo, at several levels of resolution.

    Parameters
    ----------
    levels
        Each float32[row, column, channel], one channel or R, G, B, the finest first. Columns go east, rows from
        north to south; the first and the last row hold the value at the pole.
    left_longitude_deg
        East longitude of the left edge.
    shared
        Parameters of `GroundAlbedo`.
    """

    def __init__(self, levels: Sequence[NDArray[np.float32]], left_longitude_deg: float, **shared: Any) -> None:
        super().__init__(**shared)
        channels = levels[0].shape[2]
        self.coloured = channels > 1
        sizes = np.array([level.shape[0] * level.shape[1] for level in levels])
        self._starts = mi.UInt32((np.cumsum(sizes) - sizes).astype(np.uint32))
        self._rows = mi.UInt32(np.array([level.shape[0] for level in levels], dtype=np.uint32))
        self._columns = mi.UInt32(np.array([level.shape[1] for level in levels], dtype=np.uint32))
        self._count = len(levels)
        self._texel_rad = np.pi / (levels[0].shape[0] - 2)
        self._channels = [
            mi.Float(np.concatenate([level[..., k].ravel() for level in levels])) for k in range(channels)
        ]
        self._left_rad = float(np.radians(left_longitude_deg))
        if not self.coloured:
            self._weights = np.ones((len(self._weights), 1))

    def factors(self, ground: GroundPoints) -> tuple[list[Any], None]:
        """Return the factors on the albedo, for each band or one if the map is grey, and None: no water.

        Details of the map that are finer than the footprint of the points are averaged.
        """
        values = self._sampled(ground)
        return (self._in_bands(values) if self.coloured else values), None

    def at_reference(self, ground: GroundPoints) -> Any:
        """Return the factor in the reference band at the valid points."""
        return self._in_band(self._reference, self._sampled(ground))

    def _sampled(self, ground: GroundPoints) -> list[Any]:
        """Return the value of each channel, bilinear within the level that fits the footprint."""
        # a ray that hits nothing ends at infinity, and an index made of that would lie outside the tables
        footprint_m = dr.select(ground.valid, ground.footprint_m, 1)
        x, y, z = self._in_T(ground)
        across = dr.sqrt(x * x + y * y)
        longitude, latitude = dr.atan2(y, x), dr.atan2(z, across)
        texels = footprint_m / dr.maximum(dr.sqrt(across * across + z * z) * self._texel_rad, 1e-6)
        level = mi.UInt32(dr.clip(dr.log2(dr.maximum(texels, 1e-6)) + 0.5, 0, self._count - 1))
        rows, columns = dr.gather(mi.UInt32, self._rows, level), dr.gather(mi.UInt32, self._columns, level)
        start = dr.gather(mi.UInt32, self._starts, level)
        turns = (longitude - self._left_rad) * (0.5 / np.pi)
        column = (turns - dr.floor(turns)) * columns - 0.5
        # the row of a pole lies half a row beside its neighbour
        south = (0.5 - latitude / np.pi) * (rows - 2)
        row = south + 0.5 - dr.maximum(0.5 - south, 0) + dr.maximum(south - (rows - 2.5), 0)
        row = dr.clip(row, 0, rows - 1)
        left, top = dr.floor(column), dr.minimum(dr.floor(row), rows - 2)
        u, v = column - left, row - top
        last = columns - 1
        first = dr.select(left < 0, last, dr.minimum(mi.UInt32(dr.maximum(left, 0)), last))
        second = dr.select(first == last, 0, first + 1)
        line = start + mi.UInt32(top) * columns
        out = []
        for table in self._channels:
            upper = dr.lerp(dr.gather(mi.Float, table, line + first), dr.gather(mi.Float, table, line + second), u)
            line_below = line + columns
            lower = dr.lerp(
                dr.gather(mi.Float, table, line_below + first), dr.gather(mi.Float, table, line_below + second), u
            )
            out.append(dr.lerp(upper, lower, v))
        return out
