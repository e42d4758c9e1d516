"""Where the beams of a lens cross its surfaces and other planes, from exact rays.

A far point's light that passes all rims is a beam; where it crosses a surface is its footprint there. By
rotational symmetry one table over the field angle holds all of them: a footprint's middle lies in the plane of
the axis and the point, and its rim is known by its distance from there.

Places are those of the picture: x to the right, y down, and light of a point to the right of the axis travels
towards +x. All at the d line.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import fft
from scipy.interpolate import PchipInterpolator

from ..core import resources
from .aperture import stopped_down
from .gaussian import scaled_to_focal_length
from .imaging import RealLens
from .prescription import Prescription, load_lens
from .rays import Path, trace
from .thin import ThinLens

F64 = NDArray[np.float64]
F32 = NDArray[np.float32]

DEFAULT_LENS = "nikkor_35_f2p8"

_MARGIN = 1.1  # of a frame's corner, as a tangent: how far its beams are known
_ANGLES = 33
_AZIMUTHS = 65  # of half a rim, both ends included
_HEIGHTS = 97  # of a meridional fan
_FANS = 2
_HALVINGS = 10
_NARROWINGS = 8
_RINGS = 6  # of rays within a rim
_DENSE = 257  # field angles of a footprint's table
_TURNS = 65  # its directions, equal steps of their cosine
_SHADOW = 64  # cells across a disc's shadow


# --- a camera's lens and frame ---------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class ImageFrame:
    """A camera as far as beams know of it: its lens, and its picture about the axis."""

    lens: ThinLens | RealLens
    width_px: int
    height_px: int
    pixel_pitch_um: float

    def slopes(self, x_px: NDArray, y_px: NDArray) -> tuple[F32, F32]:
        """Tangents of the field angles to the right and down, float32[y, x] each, at columns float64[x] and rows
        float64[y] of the picture."""
        per_px = self.pixel_pitch_um * 1e-3 / self.lens.focal_length_mm
        x, y = np.broadcast_arrays(
            ((x_px - self.width_px / 2) * per_px).astype(np.float32)[None, :],
            ((y_px - self.height_px / 2) * per_px).astype(np.float32)[:, None],
        )
        if not isinstance(self.lens, RealLens):
            return x, y
        distance = np.maximum(np.hypot(x, y), np.float32(1e-6))
        stretch = (self.lens.undistorted(distance) / distance).astype(np.float32)
        return x * stretch, y * stretch

    def real_lens(self, name: str) -> RealLens:
        """Return the camera's own lens, if it is real and none is named; else the named one, `DEFAULT_LENS` by
        default, scaled to the camera's focal length, its stop closed to the camera's f-number where that is larger
        than its own."""
        own = self.lens
        if isinstance(own, RealLens) and not name:
            return own
        return _scaled(name or DEFAULT_LENS, own.focal_length_mm, own.f_number, self)

    def prescription(self, name: str, coating: str) -> Prescription:
        """That lens, every surface between glass and air with the named coating, or all `as_prescribed`."""
        lens = self.real_lens(name).prescription
        return lens if coating == "as_prescribed" else _coated(lens, coating)

    def beams(self, name: str) -> Beams:
        """The beams of that lens, to a little beyond the frame's corners."""
        slope = np.hypot(*self.slopes(np.array([self.width_px]), np.array([self.height_px])))
        lens = self.real_lens(name)
        return beams(lens.prescription, _MARGIN * float(slope[0, 0]), lens.sensor_mm)


@resources.cached_with_contents(maxsize=8)
def _scaled(name: str, focal_length_mm: float, f_number: float, frame: ImageFrame) -> RealLens:
    lens = scaled_to_focal_length(load_lens(name), focal_length_mm)
    return RealLens(
        prescription=stopped_down(lens, f_number),
        width_px=frame.width_px,
        height_px=frame.height_px,
        pixel_pitch_um=frame.pixel_pitch_um,
    )


@lru_cache(maxsize=8)
def _coated(lens: Prescription, coating: str) -> Prescription:
    return lens.coated(coating)


# --- beams -----------------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True, eq=False)
class Beams:
    """Beams of far points over the tangent of the field angle, `slope` float64[angle], in the plane of the first
    vertex: a point within, `centre_mm` float64[angle] on the x axis, and distances of the rim from there,
    `rim_mm` float64[angle, azimuth], for azimuths from 0 to π; 0 where nothing passes."""

    lens: Prescription
    sensor_mm: float
    slope: F64
    centre_mm: F64
    rim_mm: F64

    @cached_property
    def bundle(self) -> Path:
        """Rays at the centres, on rings of equal areas and on the rims: [angle × azimuth × ring]."""
        distance = self.rim_mm[..., None] * np.sqrt(np.arange(_RINGS + 1) / _RINGS)
        turn = np.linspace(0, np.pi, _AZIMUTHS)[:, None]
        x = self.centre_mm[:, None, None] + distance * np.cos(turn)
        return _rays(self.lens, self.sensor_mm, self.slope[:, None, None], x, distance * np.sin(turn))[0]

    def on_row(self, row: int) -> Footprint:
        """Footprints on a surface."""
        return self._footprint(self.bundle.points_mm[1 + row, :, :2])

    def above_sensor(self, height_mm: float) -> Footprint:
        """Footprints in a plane before the sensor."""
        slope = self.bundle.directions[:, :2] / self.bundle.directions[:, 2:]
        return self._footprint(self.bundle.points_mm[-1, :, :2] - height_mm * slope)

    def _footprint(self, points: F64) -> Footprint:
        """`points` float64[angle × azimuth × ring, 2]: where the bundle crosses the surface."""
        shape = (len(self.slope), _AZIMUTHS, _RINGS + 1)
        x, y = np.moveaxis(points.reshape(*shape, 2), 3, 0)
        lit = np.isfinite(x + y).all(axis=(1, 2)) & (self.rim_mm.min(axis=1) > 0)
        x, y, from_slope = x[lit], y[lit], self.slope[lit]
        # the half of the rim above the axis; the other mirrors it
        a, b = x[..., -1], y[..., -1]
        twice = a[:, :-1] * b[:, 1:] - a[:, 1:] * b[:, :-1]
        middle = ((a[:, :-1] + a[:, 1:]) * twice).sum(axis=1) / (3 * twice.sum(axis=1))
        x = x - middle[:, None, None]
        cells, middle_x, middle_y = _cells(x, y)
        start = self.bundle.points_mm[0, :, :2].reshape(*shape, 2)[lit]
        light = np.abs(_cells(*np.moveaxis(start, 3, 0))[0])
        brightness = _fitted(middle_x, middle_y, np.abs(cells), light)
        radius, turn = np.hypot(x, y)[..., -1], np.arctan2(np.abs(y), x)[..., -1]
        order = np.argsort(turn, axis=1)
        radius, turn = (np.take_along_axis(v, order, 1) for v in (radius, turn))
        wanted = np.arccos(np.linspace(-1, 1, _TURNS))
        rim = np.stack([np.interp(wanted, t, r) for t, r in zip(turn, radius, strict=True)])
        slope = np.linspace(0, self.slope[-1], _DENSE)
        known = np.minimum(slope, from_slope[-1])
        dark = slope > known + slope[1]

        def at(values: F64) -> F64:
            return np.asarray(PchipInterpolator(from_slope, values)(known))

        rim, area = at(rim), at(np.trapezoid(radius**2, turn, axis=1))
        rim[dark], area[dark] = 0, 0
        return Footprint(slope=slope, centre_mm=at(middle), rim_mm=rim, area_mm2=area, brightness=at(brightness))


def _cells(x: F64, y: F64) -> tuple[F64, F64, F64]:
    """Of a bundle's cells, float64[angle, azimuth, ring] each: signed area and middle."""
    corners = [
        (slice(None), slice(a, a - 1 or None), slice(r, r - 1 or None)) for a, r in ((0, 0), (0, 1), (1, 1), (1, 0))
    ]
    (x0, y0), (x1, y1), (x2, y2), (x3, y3) = ((x[c], y[c]) for c in corners)
    area = ((x2 - x0) * (y3 - y1) - (x3 - x1) * (y2 - y0)) / 2
    return area, (x0 + x1 + x2 + x3) / 4, (y0 + y1 + y2 + y3) / 4


def _fitted(x: F64, y: F64, area: F64, light: F64) -> F64:
    """Light per area over its mean, c0 + c1 x + c2 x² + c3 y² by least squares, float64[angle, 4]."""
    n = len(x)
    scale = np.sqrt(area.sum(axis=(1, 2)))
    u, v = (w.reshape(n, -1) / scale[:, None] for w in (x, y))
    area, light = (w.reshape(n, -1) / w.sum(axis=(1, 2))[:, None] for w in (area, light))
    terms = np.stack([np.ones_like(u), u, u * u, v * v], axis=1)
    matrix = np.einsum("nik,njk,nk->nij", terms, terms, area)
    found = np.linalg.solve(matrix, np.einsum("nik,nk->ni", terms, light)[..., None])[..., 0]
    return np.asarray(found / scale[:, None] ** np.array([0, 1, 2, 2]))


def _rays(lens: Prescription, sensor_mm: float, slope: F64, x: F64, y: F64) -> tuple[Path, tuple[int, ...]]:
    """Rays that cross the plane of the first vertex at (x, y) with the slope dx/dz, and the common shape."""
    slope, x, y = np.broadcast_arrays(slope, x, y)
    nothing = np.zeros(x.size)
    found = trace(
        lens,
        np.column_stack([x.ravel(), y.ravel(), nothing]),
        np.column_stack([slope.ravel(), nothing, nothing + 1]),
        sensor_mm=sensor_mm,
    )
    return found, x.shape


def _beyond(lens: Prescription, sensor_mm: float, slope: F64, x: F64, y: F64) -> F64:
    """The largest distance from the axis on the way, in semi-diameters; inf for a ray that goes nowhere."""
    found, shape = _rays(lens, sensor_mm, slope, x, y)
    lost = ~np.isfinite(found.points_mm[-1, :, 0])
    return np.where(lost, np.inf, found.relative_radius).reshape(shape)


@lru_cache(maxsize=8)
def beams(lens: Prescription, largest_slope: float, sensor_mm: float) -> Beams:
    """Beams up to a field angle's tangent, or to where the lens is dark. Their rims are found by bisection and, at
    last, linear interpolation: beams are taken as convex."""
    lens = lens.with_round_stop()
    for _ in range(_NARROWINGS):
        slope = np.tan(np.linspace(0, np.arctan(largest_slope), _ANGLES))
        centre, width = _innermost(lens, sensor_mm, slope)
        # angles are for where there is light, and one beyond
        last = int(np.flatnonzero(width).max(initial=0))
        if last >= _ANGLES // 2:
            break
        largest_slope = float(slope[last + 1])
    azimuth = np.linspace(0, np.pi, _AZIMUTHS)
    low = np.zeros((_ANGLES, _AZIMUTHS))
    high = low + (1.5 * np.maximum(width, width[0]))[:, None]
    inside, outside = low, high + np.inf  # how far out of the way's rims a ray is at both ends
    for _ in range(_HALVINGS):
        half = (low + high) / 2
        x, y = centre[:, None] + half * np.cos(azimuth), half * np.sin(azimuth)
        there = _beyond(lens, sensor_mm, slope[:, None], x, y)
        passes = there <= 1
        low, inside = np.where(passes, half, low), np.where(passes, there, inside)
        high, outside = np.where(passes, high, half), np.where(passes, outside, there)
    share = np.where(np.isfinite(outside), (1 - inside) / np.maximum(outside - inside, 1e-12), 0)
    rim = np.where(width[:, None] > 0, low + (high - low) * np.clip(share, 0, 1), 0)
    return Beams(lens=lens, sensor_mm=sensor_mm, slope=slope, centre_mm=centre, rim_mm=rim)


def _innermost(lens: Prescription, sensor_mm: float, slope: F64) -> tuple[F64, F64]:
    """Of each beam a place well within, in a fan of rays on the x axis, and about how wide it is there; 0 where
    nothing passes."""
    first = lens.surfaces[0]
    reach = first.semi_diameter_mm + np.abs(first.sag_mm(first.semi_diameter_mm)) * slope
    middle, width = np.zeros_like(slope), np.zeros_like(slope)
    for _ in range(_FANS):
        heights = middle[:, None] + reach[:, None] * np.linspace(-1, 1, _HEIGHTS)
        outside = _beyond(lens, sensor_mm, slope[:, None], heights, np.zeros(1))
        middle = heights[np.arange(len(slope)), np.argmin(outside, axis=1)]
        step = heights[:, 1] - heights[:, 0]
        passing = (outside <= 1).sum(axis=1)
        width = np.maximum(width, np.where(passing, (passing + 1) * step, 0))
        reach = 2 * step
    return middle, width


# --- footprints ------------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True, eq=False)
class Footprint:
    """Footprints over equal steps of the field angle's tangent, `slope` float64[angle]: the middle `centre_mm`
    float64[angle] along the point's azimuth, the area, the rim's distance from the middle, float64[angle, turn],
    at equal steps of the cosine of the direction, -1 to 1; and the light per area over its mean, a polynomial c0
    + c1 u + c2 u² + c3 v² of the place from the middle, u outwards, `brightness` float64[angle, 4]."""

    slope: F64
    centre_mm: F64
    rim_mm: F64
    area_mm2: F64
    brightness: F64

    def places(self, slope_x: NDArray, slope_y: NDArray, *, light: bool = True) -> Places:
        """Of the directions (slope_x, slope_y), float[y, x] each: their footprints, with the brightness in them."""
        slope = np.hypot(slope_x, slope_y).astype(np.float32)
        row = np.minimum(slope * np.float32(1 / self.slope[1]), np.float32(_DENSE - 1))
        per = 1 / np.maximum(slope, np.float32(1e-12))
        return Places(
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

    @property
    def largest_mm(self) -> float:
        """The largest distance of a rim from its middle."""
        return float(self.rim_mm.max())

    @cached_property
    def rims_mm(self) -> F32:
        """`rim_mm` in single precision."""
        return self.rim_mm.astype(np.float32)

    def shadow(self, distance_mm: float, radius_mm: float) -> tuple[F32, float]:
        """Share that a disc covers of the footprint whose middle lies at a distance from the axis, float32[y, x]
        over the disc's place from that middle, which is at the table's; and table cells per mm."""
        at = int(np.argmin(np.abs(np.abs(self.centre_mm) - distance_mm)))
        if self.area_mm2[at] == 0:
            return np.zeros((_SHADOW, _SHADOW), dtype=np.float32), 1.0
        rim = self.rim_mm[at]
        per_mm = (_SHADOW / 2 - 2) / (float(rim.max()) + radius_mm)
        x = np.arange(_SHADOW) - _SHADOW // 2
        distance = np.hypot(x[None, :], x[:, None])
        cosine = x[None, :] / np.maximum(distance, 1e-9)
        rims = np.interp(cosine, np.linspace(-1, 1, _TURNS), rim) * per_mm
        light, disc = (np.clip(edge - distance + 0.5, 0, 1) for edge in (rims, radius_mm * per_mm))
        c, u, v = self.brightness[at], x[None, :] / per_mm, x[:, None] / per_mm
        light = light * np.maximum(c[0] + u * (c[1] + u * c[2]) + v * v * c[3], 0)
        light, disc = light / light.sum(), disc * (np.pi * (radius_mm * per_mm) ** 2 / disc.sum())
        both = fft.irfft2(fft.rfft2(light) * fft.rfft2(disc), s=(_SHADOW, _SHADOW))
        return np.clip(fft.fftshift(both), 0, 1).astype(np.float32), per_mm

    def most_covered(self, radius_mm: float) -> F32:
        """Share of each footprint that a disc about its middle covers, float32[angle]; 0 where there is no
        light."""
        steps = -np.diff(np.arccos(np.linspace(-1, 1, _TURNS)))
        weight = (np.append(steps, 0) + np.append(0, steps)) / 2
        inner = np.minimum(self.rim_mm, radius_mm) ** 2 @ weight
        lit = self.area_mm2 > 0
        return np.asarray(np.where(lit, np.minimum(inner / np.where(lit, self.area_mm2, 1), 1), 0), np.float32)


@dataclass(frozen=True, kw_only=True, eq=False)
class Places:
    """Footprints of an array of directions: azimuth, middle along it, area, and the row of the rim's table."""

    cos: F32
    sin: F32
    centre_mm: F32
    area_mm2: F32
    row: F32
    brightness: tuple[F32, ...]
    table: Footprint

    def part(self, where: tuple[slice, slice]) -> Places:
        """Some of them."""
        names = ("cos", "sin", "centre_mm", "area_mm2", "row")
        parts: dict[str, F32] = {name: np.ascontiguousarray(getattr(self, name)[where]) for name in names}
        brightness = tuple(np.ascontiguousarray(c[where]) for c in self.brightness)
        return Places(**parts, brightness=brightness, table=self.table)

    def _from_middle(self, x_mm: float, y_mm: float) -> tuple[F32, F32]:
        """A place on the surface as seen from the footprints' middles, along their azimuths and across."""
        x, y = np.float32(x_mm), np.float32(y_mm)
        return x * self.cos + y * self.sin - self.centre_mm, y * self.cos - x * self.sin

    def covered(self, x_mm: float, y_mm: float, radius_mm: float) -> F32:
        """Share of each footprint's light that a disc covers, in [0, 1].

        The largest share that the disc can cover, times the share of that which it does where the footprint is
        round, its rim as far from the middle as the true one is in the disc's direction: exact for round
        footprints, and for all others where the disc lies within or hides them.
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
        # of a small disc, that of its place; a large one meets the mean
        brighter = c[0] - 1 + along * (c[1] + along * c[2]) + across * across * c[3]
        out *= 1 + brighter * (1 - most)
        return np.clip(out, 0, 1, out=out)

    def covered_nearby(self, x_mm: float, y_mm: float, radius_mm: float) -> F32:
        """As `covered`, for any shape of footprint, but for footprints that are alike wherever the disc touches
        one: that of the direction in which the disc lies in the middle of it."""
        table, per_mm = self.table.shadow(float(np.hypot(x_mm, y_mm)), radius_mm)
        along, across = (v * np.float32(per_mm) + np.float32(_SHADOW // 2) for v in self._from_middle(x_mm, y_mm))
        return np.asarray(cv2.remap(table, along, across, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT))


def _looked_up(table: F32, row: F32, column: F32 | None = None) -> F32:
    """Between a table's nodes, linear in steps of a 32nd."""
    across = np.zeros_like(row) if column is None else column
    return np.asarray(cv2.remap(table, across, row, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE))


def disc_overlap(distance: ArrayLike, one: ArrayLike, other: ArrayLike) -> NDArray:
    """Area that two discs of the radii `one` and `other` share, their middles `distance` apart; of the arguments'
    common shape and unit squared."""
    d, a, b = np.broadcast_arrays(distance, one, other)
    least = np.minimum(a, b)
    near, far = np.abs(a - b), a + b
    # two circular segments, on either side of the chord through both rims' crossings
    inner = np.clip(d, near + 1e-6 * least, np.maximum(far, 1e-12))
    inner = np.maximum(inner, 1e-12)
    safe_a, safe_b = np.maximum(a, 1e-12), np.maximum(b, 1e-12)
    to_a = np.arccos(np.clip((inner * inner + a * a - b * b) / (2 * inner * safe_a), -1, 1))
    to_b = np.arccos(np.clip((inner * inner + b * b - a * a) / (2 * inner * safe_b), -1, 1))
    area = a * a * (to_a - np.sin(2 * to_a) / 2) + b * b * (to_b - np.sin(2 * to_b) / 2)
    return np.asarray(np.where(d <= near, np.pi * least * least, np.where(d >= far, 0, area)))
