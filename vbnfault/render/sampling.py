"""Create rays: strata of each pixel, their jitter, the thin lens, and directions to the Sun's limb-darkened disc.

The samples of a pixel are neighbours in the wavefront. Packets of rays are therefore coherent, and the sum over a
pixel is a block sum. It is bit-identical from run to run, whatever the number of threads.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.calibration import Calibration
from ..core.sundisc import axes
from .description import CameraMotion, Sunlight, View
from .runtime import dr, mi, packets

# Dimensions of a sample's random numbers for the disc of the Sun and for time. The lens uses dimension 1, bounces
# the next ones.
SUN_DIMENSION, TIME_DIMENSION = 0, 1000

_TO_UNIT = 2.0**-32


class Strata:
    """Provide jittered strata of all pixels.

    `pixel` is the number of each sample's pixel and `index` its number within the pixel. The methods give points of
    the pixel's area and of unit discs (the lens, the Sun), stratified over the samples of a pixel. `limb` holds the
    coefficients of the limb darkening by which points of the Sun are chosen; None: evenly.
    """

    def __init__(
        self, pixels: Pixels, samples_per_pixel: int, key: int, limb: tuple[float, ...] | None = None
    ) -> None:
        self.side = round(samples_per_pixel**0.5)
        self.samples = samples_per_pixel
        self._shift = int(samples_per_pixel).bit_length() - 1
        wavefront = dr.arange(mi.UInt32, pixels.count * samples_per_pixel)
        self.pixel = (wavefront >> self._shift) + dr.opaque(mi.UInt32, pixels.first)
        self.index = wavefront & (samples_per_pixel - 1)
        # this number selects random numbers; it may wrap around, so the pixel must not be derived from it
        wavefront = (self.pixel << self._shift) + self.index
        self._key = dr.opaque(mi.UInt32, key & 0xFFFFFFFF)
        self._wavefront, self._number = wavefront, self.pixel
        self.limb = limb

    def square(self, dimension: int = 0) -> tuple[Any, Any]:
        """Return a uniform point of each stratum of the unit square, x and y in [0, 1].

        With dimension 0, the square is the pixel.
        """
        u, v = self.jitter(dimension)
        sx, sy = self.index & (self.side - 1), self.index >> (self.side.bit_length() - 1)
        return (mi.Float(sx) + u) / self.side, (mi.Float(sy) + v) / self.side

    def jitter(self, dimension: int) -> tuple[Any, Any]:
        """Return two uniform numbers in [0, 1] per sample."""
        u, v = mi.sample_tea_32(self._wavefront, self._key ^ (0x9E3779B9 * dimension & 0xFFFFFFFF), 4)
        # 2⁻³² · u may round to 1.0 in float32, which is harmless: it still lies in the closed stratum
        return mi.Float(u) * _TO_UNIT, mi.Float(v) * _TO_UNIT

    def time_s(self) -> Any:
        """Return the time of each sample after the middle of its pixel's exposure; None: at that time."""
        return None

    def checkered(self) -> Any:
        """Return +1 and -1 as on a chessboard: two halves of the samples that each cover the pixel."""
        parity = (self.index ^ (self.index >> (self.side.bit_length() - 1))) & 1
        return 1 - 2 * mi.Float(parity)

    def disc(self, dimension: int) -> Any:
        """Return a point of the unit disc; the samples of a pixel share an even set of points, chosen by a hash.

        `dimension` separates uses: each takes different sets, in different orders. If `limb` is given, points of
        the Sun lie more densely where its disc is brighter.
        """
        h = (self._number ^ self._key) * (0x9E3779B1 + 2 * dimension)
        h ^= h >> 15
        h *= 0x85EBCA77
        h ^= h >> 13
        last = dr.opaque(mi.UInt32, _set_count(self.samples) - 1)
        index = ((h & last) << self._shift) + self.index
        limb = self.limb if dimension == SUN_DIMENSION else None
        return dr.gather(mi.Point2f, _disc_table(self.samples, dimension, limb), index)


@dataclass(frozen=True)
class Pixels:
    """Select `count` pixels of a frame by row-major number, from `first` on."""

    count: int
    first: int = 0

    def parts(self, most: int) -> Iterator[Pixels]:
        """Yield the same pixels in parts of at most `most`."""
        for start in range(0, self.count, most):
            yield Pixels(min(most, self.count - start), self.first + start)


# With few samples a pixel, many different sets are needed, since only together do they cover the disc evenly. With
# many samples, each set does. A table of `_TABLE_POINTS` points stays in the processor's cache.
_MOST_SETS, _FEWEST_SETS = 256, 16
_TABLE_POINTS = 1 << 14


def _set_count(samples: int) -> int:
    """Return the number of sets of `samples` points of the disc, a power of two like `samples`."""
    return min(max(_TABLE_POINTS // samples, _FEWEST_SETS), _MOST_SETS)


# An adaptive render with an aperture and bounces needs two or three tables for each of up to nine sample counts.
# A table takes at most 128 KiB, or 128 bytes for each sample if these are more than 1024.
@lru_cache(maxsize=32)
def _disc_table(samples: int, dimension: int, limb: tuple[float, ...] | None = None) -> Any:
    """Return stratified points of the unit disc in sets of `samples`, each set in its own order, on the device."""
    points = disc_sets(samples, dimension) if limb is None else limb_sets(samples, dimension, limb)
    table = packets(mi.Float, points.astype(np.float32))
    dr.eval(table)
    return table


def limb_sets(samples: int, dimension: int, limb: tuple[float, ...]) -> NDArray[np.float64]:
    """Return points of the unit disc, float64[set, sample, 2], as dense as a limb-darkened disc is bright.

    `limb` holds the coefficients of the powers of μ. The points are those of `disc_sets` with other radii: each
    ring has the same light, and the sets together cover it evenly, so their mean holds for few samples, too.
    """
    points, ring = _ringed_sets(samples, dimension)
    radius = np.linalg.norm(points, axis=-1)
    rng = np.random.Generator(np.random.Philox(np.random.SeedSequence((samples, dimension, 1))))
    sets = len(points)
    offset = rng.permuted(np.tile((np.arange(sets) + 0.5) / sets, (samples, 1)), axis=1).T
    within = (ring + np.take_along_axis(offset, ring, axis=1)) / samples
    # light within the circle on which the cosine is μ: ∫ Σ A_k μ^k d(μ²) from μ to 1
    cosine, power = np.linspace(0, 1, 4097), np.arange(len(limb)) + 2
    light = (np.array(limb) * 2 / power) @ (1 - cosine ** power[:, None])
    wanted = np.sqrt(1 - np.interp(within * light[0], light[::-1], cosine[::-1]) ** 2)
    return np.asarray(points * (wanted / np.maximum(radius, 1e-12))[..., None])


def disc_sets(samples: int, dimension: int) -> NDArray[np.float64]:
    """Return points of the unit disc, float64[set, sample, 2].

    Each set has one point in each ring, one in each sector, and one in each tile of a few rings and sectors
    (Hammersley's points under random digit shifts).

    The point of a ring lies where the cosine to the Sun's vertical has the ring's mean. Limb darkening is a
    polynomial of that cosine and therefore adds no noise where the whole disc is visible. The parity of the sum of
    digits divides rings and sectors evenly between the two halves of a chessboard over the samples.
    """
    return _ringed_sets(samples, dimension)[0]


def _ringed_sets(samples: int, dimension: int) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Return `disc_sets`, and the number of the ring of each point from the middle outwards, int64[set, sample]."""
    rng = np.random.Generator(np.random.Philox(np.random.SeedSequence((samples, dimension))))
    sets = _set_count(samples)
    if samples == 1:
        radius, turn = np.sqrt(rng.random((sets, 1))), 2 * np.pi * rng.random((sets, 1))
        points = radius[..., None] * np.stack([np.cos(turn), np.sin(turn)], axis=-1)
        return points, np.zeros((sets, 1), np.int64)
    bits = samples.bit_length() - 1
    k = np.arange(samples)
    digits = (k[:, None] >> np.arange(bits)) & 1
    mirrored = digits @ (1 << np.arange(bits)[::-1])
    edge = (1 - np.arange(samples + 1) / samples) ** 1.5
    mean_mu = 2 / 3 * samples * (edge[:-1] - edge[1:])
    ring = k ^ rng.integers(samples, size=(sets, 1))
    sector = mirrored ^ rng.integers(samples, size=(sets, 1))
    radius = np.sqrt(1 - mean_mu[ring] ** 2)
    turn = 2 * np.pi * (sector + rng.random(sector.shape)) / samples
    points = radius[..., None] * np.stack([np.cos(turn), np.sin(turn)], axis=-1)
    # decide which points go to the white squares, and which to the black ones
    colour = (k ^ (k >> (bits + 1) // 2)) & 1
    halves = np.stack([np.flatnonzero(digits.sum(axis=1) & 1 == parity) for parity in (0, 1)])
    swap = rng.integers(2, size=sets)
    order = np.empty((sets, samples), np.int64)
    for parity in (0, 1):
        order[:, colour == parity] = rng.permuted(halves[parity ^ swap], axis=1)
    return np.take_along_axis(points, order[..., None], axis=1), np.take_along_axis(ring, order, axis=1)


class _Motion:
    """Hold the motion of a camera as opaque variables."""

    def __init__(self, motion: CameraMotion, width: int, height: int) -> None:
        self.velocity = opaque_vector(mi.Vector3f, motion.velocity_L_m_s)
        self.rolls = bool(motion.line_s.any())
        self._middle = width / 2, height / 2
        self._line = opaque_vector(mi.Vector2f, motion.line_s)
        speed = float(np.linalg.norm(motion.rate_C_rad_s))
        self._speed = dr.opaque(mi.Float, speed)
        self._axis = opaque_vector(mi.Vector3f, motion.rate_C_rad_s / max(speed, 1e-30))

    def time_s(self, x: Any, y: Any, since_middle_s: Any = None) -> Any:
        """Return the time at which a pixel position is exposed; the view has its pose at 0."""
        if not self.rolls:
            return since_middle_s
        line_s = (x - self._middle[0]) * self._line.x + (y - self._middle[1]) * self._line.y
        return line_s if since_middle_s is None else line_s + since_middle_s

    def grid_time_s(self, width: int, height: int) -> Any:
        """Return the time of each pixel of a grid of another size over the same frame, row by row."""
        pixel = dr.arange(mi.UInt32, width * height)
        x, y = mi.Float(pixel % width) + 0.5 - width / 2, mi.Float(pixel // width) + 0.5 - height / 2
        return x * self._line.x + y * self._line.y

    def turned(self, axes: list[Any], time_s: Any) -> list[Any]:
        """Return the camera's axes in L at a time, by Rodrigues' formula for each in C."""
        sine, cosine = dr.sincos(self._speed * time_s)
        k = self._axis
        columns = []
        for unit in np.eye(3).tolist():
            e = mi.Vector3f(*unit)
            in_C = e * cosine + dr.cross(k, e) * sine + k * (dr.dot(k, e) * (1 - cosine))
            columns.append(in_C.x * axes[0] + in_C.y * axes[1] + in_C.z * axes[2])
        return columns


class Optics:
    """Hold the numbers of a view as opaque variables, so that a new view needs no new kernel."""

    def __init__(self, view: View) -> None:
        self.width, self.height = view.width_px, view.height_px
        self.origin = opaque_vector(mi.Point3f, view.position_L_m)
        self.axes = [opaque_vector(mi.Vector3f, view.L_from_C[:, i]) for i in range(3)]
        fx, fy, cx, cy = (float(v) for v in view.intrinsics)
        self.scale = opaque_vector(mi.Vector2f, np.array([1 / fx, 1 / fy]))
        self.centre = opaque_vector(mi.Vector2f, np.array([cx, cy]))
        self._table = None if view.projection is None else _directions(view.projection)
        self.start_m = dr.opaque(mi.Float, view.start_m) if view.start_m else 0.0
        self.motion = None if view.motion is None else _Motion(view.motion, self.width, self.height)
        self.aperture = view.aperture_radius_m
        self._radius = dr.opaque(mi.Float, view.aperture_radius_m)
        self._inverse_focus = dr.opaque(mi.Float, 1.0 / view.focus_distance_m)

    def direction(self, x: Any, y: Any, on_aperture: Any = None, time_s: Any = None) -> tuple[Any, Any]:
        """Return origin and unit direction in L of the ray through image point (x, y) in pixels.

        `on_aperture` is a point of the unit disc on the aperture; without it, the ray meets the lens's centre.
        `time_s` counts from the middle of the pixel's exposure, where the ray is without it.
        """
        cx, cy, cz = self.towards(x, y)
        ax, ay, az = self.axes
        origin = self.origin
        if self.motion is not None and (time_s is not None or self.motion.rolls):
            time_s = self.motion.time_s(x, y, time_s)
            origin = origin + self.motion.velocity * time_s
            ax, ay, az = self.motion.turned(self.axes, time_s)
        if on_aperture is not None:
            lx, ly = on_aperture.x * self._radius, on_aperture.y * self._radius
            origin = origin + lx * ax + ly * ay
            nearness = self._inverse_focus if cz is None else self._inverse_focus * dr.maximum(cz, 0)
            cx, cy = cx - lx * nearness, cy - ly * nearness
        direction = dr.normalize(cx * ax + cy * ay + (az if cz is None else cz * az))
        return (origin if isinstance(self.start_m, float) else origin + self.start_m * direction), direction

    def towards(self, x: Any, y: Any) -> tuple[Any, Any, Any]:
        """Return x, y and z in C of the direction at image point (x, y) in pixels; None stands for z = 1."""
        if self._table is None:
            return (x - self.centre.x) * self.scale.x, (y - self.centre.y) * self.scale.y, None
        nodes, columns, rows, per_px = self._table
        u, v = x * per_px, y * per_px
        column = dr.clip(mi.Int32(dr.floor(u)), 0, columns - 2)
        row = dr.clip(mi.Int32(dr.floor(v)), 0, rows - 2)
        u, v = u - mi.Float(column), v - mi.Float(row)
        corner = [
            dr.gather(mi.Vector4f, nodes, mi.UInt32((row + down) * columns + column + right))
            for down in (0, 1)
            for right in (0, 1)
        ]
        above, below = (dr.lerp(corner[k], corner[k + 1], u) for k in (0, 2))
        d = dr.lerp(above, below, v)
        return d.x, d.y, d.z

    def camera_rays(self, strata: Strata) -> Any:
        """Return one ray per stratum, through the thin lens."""
        u, v = strata.square()
        x = mi.Float(strata.pixel % self.width) + u
        y = mi.Float(strata.pixel // self.width) + v
        on_aperture = strata.disc(1) if self.aperture > 0 else None
        return mi.Ray3f(*self.direction(x, y, on_aperture, strata.time_s()))

    def centre_rays(self, pixel: Any = None) -> Any:
        """Return pinhole rays through the centres of pixels, given by row-major number; default: all pixels."""
        if pixel is None:
            pixel = dr.arange(mi.UInt32, self.width * self.height)
        x = mi.Float(pixel % self.width) + 0.5
        y = mi.Float(pixel // self.width) + 0.5
        return mi.Ray3f(*self.direction(x, y))

    def rays_of(self, directions: NDArray[np.float64]) -> Any:
        """Return one ray from the lens's centre for each vector in C, float64[y, x, 3]."""
        across, down, along = (packets(mi.Float, np.asarray(directions[..., k], np.float32)) for k in range(3))
        origin, (ax, ay, az) = self.origin, self.axes_of(directions.shape[1], directions.shape[0])
        if self.motion is not None and self.motion.rolls:
            origin = origin + self.motion.velocity * self.motion.grid_time_s(
                directions.shape[1], directions.shape[0]
            )
        direction = dr.normalize(across * ax + down * ay + along * az)
        return mi.Ray3f(origin + self.start_m * direction, direction)

    def axes_of(self, width: int, height: int) -> list[Any]:
        """Return the camera's axes in L at the middle of the exposure of each pixel of a grid over the frame."""
        if self.motion is None or not self.motion.rolls:
            return self.axes
        return self.motion.turned(self.axes, self.motion.grid_time_s(width, height))


# Least and greatest number of nodes along the longer side of a table of directions. Between nodes h px apart,
# linear interpolation errs by h²/8 times the second derivative: at 1024 px at most 1e-3 px for the distortion of a
# lens of 120°.
_NODES = (256, 1024)


@lru_cache(maxsize=4)
def _directions(calibration: Calibration) -> tuple[Any, int, int, float]:
    """Return directions in C at the nodes of a grid over a frame, its columns and rows, and its nodes per px."""
    size = calibration.width_px, calibration.height_px
    per_px = float(2.0 ** np.round(np.log2(np.clip(2 * max(size), *_NODES) / max(size))))
    columns, rows = (int(np.ceil(n * per_px)) + 1 for n in size)
    seen = calibration.directions_at(np.arange(columns) / per_px, np.arange(rows) / per_px)
    seen = np.concatenate([seen, np.zeros_like(seen[..., :1])], axis=-1)
    return packets(mi.Float, seen.astype(np.float32)), columns, rows, per_px


def opaque_vector(kind: Any, values: np.ndarray) -> Any:
    """Return a drjit vector whose entries are runtime values, not constants of the kernel."""
    return kind(*(dr.opaque(mi.Float, float(v)) for v in values))


# --- the Sun's disc ---------------------------------------------------------------------------------------------


class SunDisc:
    """Compute directions towards points of the disc.

    Directions are offsets from the direction of the centre. In float32, the cosine of a quarter of a degree would
    keep only a few significant bits of its difference from 1.
    """

    def __init__(self, sun: Sunlight) -> None:
        self._x, self._y, self.direction = (opaque_vector(mi.Vector3f, axis) for axis in axes(sun.direction_L))
        self._tangent = dr.opaque(mi.Float, np.tan(sun.angular_radius_rad))

    def towards(self, p: Any) -> Any:
        """Return the unit direction towards the point of the disc at `p` on the unit disc."""
        return dr.normalize(self.direction + self._tangent * (p.x * self._x + p.y * self._y))


def mu(p: Any) -> Any:
    """Return the cosine of the angle to the Sun's local vertical at a point of the unit disc."""
    return dr.sqrt(dr.maximum(1 - dr.squared_norm(p), 0))


class Limb:
    """Represent limb darkening by few terms: Σ_k weights[k, b] · term_k(μ).

    This sum is the radiance of band b over its mean on the disc. The profiles of neighbouring bands are nearly
    multiples of one another, so a singular value decomposition keeps only the components above 1e-4 of the largest.
    """

    def __init__(self, sun: Sunlight) -> None:
        bands = len(sun.irradiance_W_m2_nm)
        self.coefficients, self.weights = np.ones((1, 1)), np.ones((1, bands))
        self.profiles = sun.limb_darkening
        if sun.limb_darkening is not None:
            grid = np.linspace(0, 1, 256)[None, :] ** np.arange(6)[:, None]
            u, s, _ = np.linalg.svd(sun.limb_darkening @ grid, full_matrices=False)
            kept = max(1, int(np.sum(s > 1e-4 * s[0])))
            self.coefficients, self.weights = u[:, :kept].T @ sun.limb_darkening, u[:, :kept].T

    def terms(self, mu: Any) -> list[Any]:
        """Return the terms at μ."""
        return [polynomial(c, mu) for c in self.coefficients]


def polynomial(coefficients: np.ndarray, x: Any) -> Any:
    """Return Σ c_k xᵏ by Horner's rule; the coefficients are runtime values, not constants of the kernel."""
    total = dr.opaque(mi.Float, float(coefficients[-1]))
    for c in coefficients[-2::-1]:
        total = dr.fma(total, x, dr.opaque(mi.Float, float(c)))
    return total
