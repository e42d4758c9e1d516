"""Tabulate the beams of far points that pass all rims of a lens, with exact rays, and where they cross surfaces.

The lens has rotational symmetry, so one table over the field angle holds all beams. Positions have the image's
axes: x to the right, y down. Light of a point to the right of the axis travels to +x. Everything holds for the d
line.

The part of a surface that a beam crosses is its footprint on this surface. The middle of a footprint lies in the
plane of the axis and the far point; the table gives the distance of the rim from this middle. `Footprints.covered`
says what a disc there covers of them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import fft

from .glass import D_NM
from .mapping import inclined_rays, relative_radii
from .prescription import Prescription
from .rays import Path

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]

_ANGLES = 33
_AZIMUTHS = 65  # of half a rim, both ends included
_HEIGHTS = 97  # rays of a meridional fan
_FANS = 2
_HALVINGS = 10
_NARROWINGS = 8
_RINGS = 6  # of rays within a rim
_DENSE = 257  # field angles of a footprint's table
_TURNS = 65  # directions of a footprint's table, at equal steps of their cosine
_SHADOW = 64  # cells along each side of a shadow's table


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


# --- footprints -------------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True, eq=False)
class Footprint:
    """Tabulate the footprints on one surface over equal steps of the tangent of the field angle.

    Attributes
    ----------
    slope
        float64[angle]: tangents of the field angles.
    centre_mm
        float64[angle]: position of the middle along the point's azimuth.
    rim_mm
        float64[angle, turn]: distance of the rim from the middle, at equal steps of the cosine of the direction
        from -1 to 1.
    area_mm2
        float64[angle]
    brightness
        float64[angle, 4]: light per area over its mean, as the polynomial c0 + c1 u + c2 u² + c3 v² of the position
        from the middle, u outwards.
    """

    slope: F64
    centre_mm: F64
    rim_mm: F64
    area_mm2: F64
    brightness: F64

    @classmethod
    def on_row(cls, beams: Beams, row: int) -> Footprint:
        """Return the footprints of beams on a surface."""
        return cls._of(beams, beams.bundle.points_mm[1 + row, :, :2])

    @classmethod
    def above_sensor(cls, beams: Beams, height_mm: float) -> Footprint:
        """Return the footprints of beams in a plane in front of the sensor."""
        slope = beams.bundle.directions[:, :2] / beams.bundle.directions[:, 2:]
        return cls._of(beams, beams.bundle.points_mm[-1, :, :2] - height_mm * slope)

    @classmethod
    def _of(cls, beams: Beams, points: F64) -> Footprint:
        """Return the footprints from the points where the bundle crosses, float64[angle × azimuth × ring, 2]."""
        from scipy.interpolate import PchipInterpolator  # not above: the import takes half a second

        shape = (*beams.rim_mm.shape, -1)
        x, y = np.moveaxis(points.reshape(*shape, 2), 3, 0)
        lit = np.isfinite(x + y).all(axis=(1, 2)) & (beams.rim_mm.min(axis=1) > 0)
        x, y, from_slope = x[lit], y[lit], beams.slope[lit]
        # the rim's half above the axis gives the centroid; the other half mirrors it
        a, b = x[..., -1], y[..., -1]
        twice = a[:, :-1] * b[:, 1:] - a[:, 1:] * b[:, :-1]
        middle = ((a[:, :-1] + a[:, 1:]) * twice).sum(axis=1) / (3 * twice.sum(axis=1))
        x = x - middle[:, None, None]
        cells, middle_x, middle_y = _cells(x, y)
        start = beams.bundle.points_mm[0, :, :2].reshape(*shape, 2)[lit]
        light = np.abs(_cells(*np.moveaxis(start, 3, 0))[0])
        brightness = _fitted(middle_x, middle_y, np.abs(cells), light)
        radius, turn = np.hypot(x, y)[..., -1], np.arctan2(np.abs(y), x)[..., -1]
        order = np.argsort(turn, axis=1)
        radius, turn = (np.take_along_axis(v, order, 1) for v in (radius, turn))
        wanted = np.arccos(np.linspace(-1, 1, _TURNS))
        rim = np.stack([np.interp(wanted, t, r) for t, r in zip(turn, radius, strict=True)])
        slope = np.linspace(0, beams.slope[-1], _DENSE)
        known = np.minimum(slope, from_slope[-1])
        dark = slope > known + slope[1]

        def at_slopes(values: F64) -> F64:
            return np.asarray(PchipInterpolator(from_slope, values)(known))

        rim, area = at_slopes(rim), at_slopes(np.trapezoid(radius**2, turn, axis=1))
        rim[dark], area[dark] = 0, 0
        return cls(
            slope=slope, centre_mm=at_slopes(middle), rim_mm=rim, area_mm2=area, brightness=at_slopes(brightness)
        )

    def towards(self, slope_x: NDArray, slope_y: NDArray, *, light: bool = True) -> Footprints:
        """Return the footprints of the directions (slope_x, slope_y), float[y, x] each.

        `light`: whether the brightness within the footprints is included.
        """
        slope = np.hypot(slope_x, slope_y).astype(np.float32)
        row = np.minimum(slope * np.float32(1 / self.slope[1]), np.float32(_DENSE - 1))
        per = 1 / np.maximum(slope, np.float32(1e-12))
        return Footprints(
            cos=np.asarray(slope_x * per, dtype=np.float32),
            sin=np.asarray(slope_y * per, dtype=np.float32),
            centre_mm=_looked_up(self.centre_mm.astype(np.float32)[:, None], row),
            area_mm2=_looked_up(self.area_mm2.astype(np.float32)[:, None], row),
            row=row,
            brightness=tuple(_looked_up(c[:, None], row) for c in self.brightness.astype(np.float32).T)
            if light
            else (),
            table=self,
        )

    @cached_property
    def rims_mm(self) -> F32:
        """Return `rim_mm` in single precision."""
        return self.rim_mm.astype(np.float32)

    def shadow(self, distance_mm: float, radius_mm: float) -> tuple[F32, float]:
        """Return the fraction of one footprint's light that a disc covers, and the table's cells per mm.

        The footprint is the one whose middle lies at `distance_mm` from the axis. The fraction is float32[y, x]
        over the disc's position relative to that middle, which is in the middle of the table.
        """
        nearest = int(np.argmin(np.abs(np.abs(self.centre_mm) - distance_mm)))
        if self.area_mm2[nearest] == 0:
            return np.zeros((_SHADOW, _SHADOW), dtype=np.float32), 1.0
        rim = self.rim_mm[nearest]
        per_mm = (_SHADOW / 2 - 2) / (float(rim.max()) + radius_mm)
        x = np.arange(_SHADOW) - _SHADOW // 2
        distance = np.hypot(x[None, :], x[:, None])
        cosine = x[None, :] / np.maximum(distance, 1e-9)
        rims = np.interp(cosine, np.linspace(-1, 1, _TURNS), rim) * per_mm
        light, disc = (np.clip(edge - distance + 0.5, 0, 1) for edge in (rims, radius_mm * per_mm))
        c, u, v = self.brightness[nearest], x[None, :] / per_mm, x[:, None] / per_mm
        light = light * np.maximum(c[0] + u * (c[1] + u * c[2]) + v * v * c[3], 0)
        light, disc = light / light.sum(), disc * (np.pi * (radius_mm * per_mm) ** 2 / disc.sum())
        both = fft.irfft2(fft.rfft2(light) * fft.rfft2(disc), s=(_SHADOW, _SHADOW))
        return np.clip(fft.fftshift(both), 0, 1).astype(np.float32), per_mm

    def most_covered(self, radius_mm: float) -> F32:
        """Return the fraction of each footprint that a disc at its middle covers, float32[angle]; 0 if dark."""
        steps = -np.diff(np.arccos(np.linspace(-1, 1, _TURNS)))
        weight = (np.append(steps, 0) + np.append(0, steps)) / 2
        inner = np.minimum(self.rim_mm, radius_mm) ** 2 @ weight
        lit = self.area_mm2 > 0
        return np.asarray(np.where(lit, np.minimum(inner / np.where(lit, self.area_mm2, 1), 1), 0), np.float32)


def _cells(x: F64, y: F64) -> tuple[F64, F64, F64]:
    """Return signed area and middle of each cell of a bundle, float64[angle, azimuth, ring] each."""
    corners = [
        (slice(None), slice(a, a - 1 or None), slice(r, r - 1 or None)) for a, r in ((0, 0), (0, 1), (1, 1), (1, 0))
    ]
    (x0, y0), (x1, y1), (x2, y2), (x3, y3) = ((x[c], y[c]) for c in corners)
    area = ((x2 - x0) * (y3 - y1) - (x3 - x1) * (y2 - y0)) / 2
    return area, (x0 + x1 + x2 + x3) / 4, (y0 + y1 + y2 + y3) / 4


def _fitted(x: F64, y: F64, area: F64, light: F64) -> F64:
    """Fit light per area over its mean by c0 + c1 x + c2 x² + c3 y² with least squares; float64[angle, 4]."""
    n = len(x)
    scale = np.sqrt(area.sum(axis=(1, 2)))
    u, v = (w.reshape(n, -1) / scale[:, None] for w in (x, y))
    area, light = (w.reshape(n, -1) / w.sum(axis=(1, 2))[:, None] for w in (area, light))
    terms = np.stack([np.ones_like(u), u, u * u, v * v], axis=1)
    matrix = np.einsum("nik,njk,nk->nij", terms, terms, area)
    coefficients = np.linalg.solve(matrix, np.einsum("nik,nk->ni", terms, light)[..., None])[..., 0]
    return np.asarray(coefficients / scale[:, None] ** np.array([0, 1, 2, 2]))


@dataclass(frozen=True, kw_only=True, eq=False)
class Footprints:
    """Hold the footprints of an array of directions.

    They have an azimuth (cos, sin), a middle along it, an area, and a fractional row in the table `table`.
    """

    cos: F32
    sin: F32
    centre_mm: F32
    area_mm2: F32
    row: F32
    brightness: tuple[F32, ...]
    table: Footprint

    def part(self, where: tuple[slice, slice]) -> Footprints:
        """Return the footprints of some of the directions."""
        names = ("cos", "sin", "centre_mm", "area_mm2", "row")
        parts: dict[str, Any] = {name: np.ascontiguousarray(getattr(self, name)[where]) for name in names}
        return replace(self, **parts, brightness=tuple(np.ascontiguousarray(c[where]) for c in self.brightness))

    def _from_middle(self, x_mm: float, y_mm: float) -> tuple[F32, F32]:
        """Return a position on the surface relative to the footprints' middles, along their azimuths and across."""
        x, y = np.float32(x_mm), np.float32(y_mm)
        return x * self.cos + y * self.sin - self.centre_mm, y * self.cos - x * self.sin

    def covered(self, x_mm: float, y_mm: float, radius_mm: float) -> F32:
        """Return the fraction of each footprint's light that a disc covers, in [0, 1].

        The footprint is replaced by a round one. Its radius is the distance of the true rim from the middle in the
        direction of the disc. The fraction is the product of two factors: the disc's overlap with the round
        footprint over the largest possible overlap, and the largest fraction that the disc can cover of the true
        footprint (`most_covered`). The product is exact for round footprints, and for all others where the disc
        lies wholly inside or hides the footprint. A correction for the brightness at the disc follows.
        """
        a = np.float32(radius_mm)
        along, across = self._from_middle(x_mm, y_mm)
        distance = np.sqrt(along * along + across * across)
        turn = (along / np.maximum(distance, np.float32(1e-12)) + 1) * np.float32((_TURNS - 1) / 2)
        rim = _looked_up(self.table.rims_mm, self.row, turn.astype(np.float32))
        out = (distance < rim).astype(np.float32)
        edge = np.flatnonzero(np.abs(distance - rim) < a)
        far, rim_there = distance.ravel()[edge], rim.ravel()[edge]
        out.ravel()[edge] = disc_overlap(far, rim_there, a) / (np.float32(np.pi) * np.clip(rim_there, 1e-9, a) ** 2)
        most = _looked_up(self.table.most_covered(radius_mm)[:, None], self.row)
        out *= most
        c = self.brightness
        # a small disc covers the brightness at its position, a large one the mean
        brighter = c[0] - 1 + along * (c[1] + along * c[2]) + across * across * c[3]
        out *= 1 + brighter * (1 - most)
        return np.clip(out, 0, 1, out=out)

    def covered_nearby(self, x_mm: float, y_mm: float, radius_mm: float) -> F32:
        """Return the same fraction as `covered`, where all footprints near the disc have nearly the same shape.

        The shape may be any. It is that of the footprint whose middle is as far from the axis as the disc.
        """
        table, per_mm = self.table.shadow(float(np.hypot(x_mm, y_mm)), radius_mm)
        along, across = (v * np.float32(per_mm) + np.float32(_SHADOW // 2) for v in self._from_middle(x_mm, y_mm))
        return np.asarray(cv2.remap(table, along, across, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT))


def _looked_up(table: F32, row: F32, column: F32 | None = None) -> F32:
    """Interpolate linearly between a table's nodes, in steps of 1/32 as OpenCV does."""
    across = np.zeros_like(row) if column is None else column
    return np.asarray(cv2.remap(table, across, row, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE))


def disc_overlap(distance: ArrayLike, radius: ArrayLike, other_radius: ArrayLike) -> NDArray:
    """Return the area that two discs have in common, whose middles are `distance` apart.

    The result has the arguments' common shape and their unit squared.
    """
    d, a, b = np.broadcast_arrays(distance, radius, other_radius)
    least = np.minimum(a, b)
    near, far = np.abs(a - b), a + b
    # the overlap is two circular segments on either side of the chord through the rims' crossings
    inner = np.clip(d, near + 1e-6 * least, np.maximum(far, 1e-12))
    inner = np.maximum(inner, 1e-12)
    safe_a, safe_b = np.maximum(a, 1e-12), np.maximum(b, 1e-12)
    to_a = np.arccos(np.clip((inner * inner + a * a - b * b) / (2 * inner * safe_a), -1, 1))
    to_b = np.arccos(np.clip((inner * inner + b * b - a * a) / (2 * inner * safe_b), -1, 1))
    area = a * a * (to_a - np.sin(2 * to_a) / 2) + b * b * (to_b - np.sin(2 * to_b) / 2)
    return np.asarray(np.where(d <= near, np.pi * least * least, np.where(d >= far, 0, area)))
