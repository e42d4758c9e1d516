"""Compute the light of a procedural Earth: oceans, continents, deserts, forests, ice and clouds.

All fields are fractal sums of gradient noise (Perlin 2002, ACM Trans. Graph. 21, 681) on the unit sphere, down to
the footprint of a pixel, so that the ground is sharp from orbit and smooth from afar. Land covers 29 % of the
sphere, as on Earth. The albedos of surfaces are near typical ones (Hartmann 1994,
Global Physical Climatology, chapter 4); their colours, the belts of climate, the fraction of clouds, their height
and their shapes are assumed.

Clouds are a layer above the ground: a camera sees them moved against it, and their shadows lie on the ground away
from the Sun. Open water also mirrors the Sun, on waves whose slopes have the normal distribution of Cox & Munk
(1954, J. Opt. Soc. Am. 44, 838) for a mean wind from any direction, with Fresnel's reflectance and the shadowing of
Smith (1967, IEEE Trans. Antennas Propag. 15, 668). Foam, and light that waves reflect twice, are left out.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .albedo import GroundAlbedo, GroundPoints, Mirror
from .runtime import dr, mi

F64 = NDArray[np.float64]

# Albedo at 650, 550 and 450 nm.
_OCEAN, _SHELF = (0.022, 0.035, 0.060), (0.035, 0.075, 0.095)
_FOREST, _STEPPE = (0.050, 0.072, 0.034), (0.170, 0.150, 0.085)
_DESERT, _ROCK = (0.420, 0.315, 0.200), (0.230, 0.185, 0.140)
_TUNDRA, _ICE = (0.145, 0.140, 0.110), (0.760, 0.790, 0.820)
_CLOUD = 0.72
# Mean albedo of this Earth over the sphere and the three wavelengths, seen from above with the Sun overhead. It has
# the factor 1.
MEAN_ALBEDO = 0.2335

_CLOUD_HEIGHT_M = 5000.0  # assumed: between low clouds and the tops of storms
# Light spreads sideways within clouds, over 200 to 400 m (Marshak et al. 1995, J. Geophys. Res. 100, 26247), so
# their shadows have no finer detail.
_SHADOW_BLUR = 400.0 / 6.371e6
# Least cosine of a zenith angle in the shift of clouds against the ground: it stays below 33 km.
_LEAST_COSINE = 0.15

# Variance of the slopes of waves, both axes together: 0.003 + 0.00512 U (Cox & Munk 1954) for a wind of 7 m/s,
# about the mean over the oceans (assumed).
SLOPE_VARIANCE = 0.003 + 0.00512 * 7.0
_WATER_INDEX = 1.34  # refractive index of sea water in the visible

SEA_LEVEL = 0.19  # with 29 % of the sphere above it
_LACUNARITY = 2.03  # not 2, so that the lattices of octaves do not coincide
_MOST_OCTAVES = 18
_SMALLEST_RAD = 1e-6  # 6 m on the ground: no finer detail
_NO_DETAIL = 1e3  # a footprint above all wavelengths of noise
_NO_ICE = 0.85  # sine of the latitude below which the sea does not freeze
# Storms: axis as longitude and latitude in degrees, radius in rad, turns.
_STORMS = (
    (-35, 47, 0.17, 0.36),
    (20, -52, 0.19, -0.42),
    (150, 43, 0.15, 0.34),
    (-140, 50, 0.17, 0.40),
    (95, -47, 0.16, -0.34),
    (-100, -54, 0.18, -0.38),
    (-60, 22, 0.05, 0.7),
    (130, 17, 0.05, 0.7),
)


class EarthAlbedo(GroundAlbedo):
    """Compute factors on the albedo in the way of `albedo.AlbedoMap`.

    Parameters
    ----------
    radius_m
        Radius of the body.
    air_depth
        Optical depth of the air straight up, float64[band]. Air takes twice as much of a mirrored beam as of the
        light of other ground, for which `atmosphere` assumes that half of what is scattered still arrives.
    shared
        Parameters of `GroundAlbedo`.
    """

    coloured = True

    def __init__(self, radius_m: float, *, air_depth: F64, **shared: Any) -> None:
        super().__init__(**shared)
        self._weights = self._weights / MEAN_ALBEDO
        self._radius_m = radius_m
        self._air_depth = [float(depth) for depth in air_depth]

    def factors(self, ground: GroundPoints) -> tuple[list[Any], Mirror]:
        """Return the factors on the albedo, one for each band, and a function for the light that water mirrors.

        Details finer than the footprint of the points are left out.
        """
        colour, water = self._seen(ground, shadows=True)
        return self._in_bands(colour), partial(self._mirrored, water)

    def _mirrored(self, water: Any, light: Any, view: Any) -> list[Any]:
        """Return the radiance of water in each band over the irradiance on a plane that faces the Sun, in 1/sr.

        `light` and `view` are unit vectors in axes with z straight up.
        """
        value, air = water * glint(light, view), _air_mass(light.z) + _air_mass(view.z)
        return [value * dr.exp(-0.5 * depth * air) for depth in self._air_depth]

    def at_reference(self, ground: GroundPoints) -> Any:
        """Return the factor in the reference band, without the shadows of clouds."""
        return self._in_band(self._reference, self._seen(ground, shadows=False)[0])

    def _seen(self, ground: GroundPoints, *, shadows: bool) -> tuple[Any, Any]:
        """Return the albedo at 650, 550 and 450 nm, and the fraction of open water."""
        up = dr.normalize(mi.Vector3f(*self._in_T(ground)))
        footprint = dr.maximum(ground.footprint_m / self._radius_m, _SMALLEST_RAD)
        footprint = dr.select(ground.valid, footprint, _NO_DETAIL)
        view, sun = (mi.Vector3f(*(dr.dot(axis, d) for axis in self._axes)) for d in (ground.view_L, ground.sun_L))
        height = _CLOUD_HEIGHT_M / self._radius_m
        return seen_at(up, footprint, _shifted(up, view, height), _shifted(up, sun, height) if shadows else None)


def seen_at(up: Any, footprint_rad: Any, cloud: Any, shading: Any | None) -> tuple[Any, Any]:
    """Return the albedo at 650, 550 and 450 nm, and the fraction of water that mirrors the Sun.

    Parameters
    ----------
    up
        Direction of the ground from the body's centre in T.
    footprint_rad
        Distance between neighbouring points.
    cloud, shading
        Directions from the centre of the clouds that lie between the ground and the camera, and between the ground
        and the Sun. Without the latter, clouds have no shadows.
    """
    opacity, albedo = _clouds(cloud, footprint_rad)
    # a wide footprint ends the sums of noise at once, where closed clouds hide the ground
    below = dr.select(opacity < 1, footprint_rad, _NO_DETAIL)
    ground, water = _ground(up, below)
    if shading is not None:
        shade, lost = _clouds(shading, dr.maximum(below, _SHADOW_BLUR))
        # clouds absorb nothing, so what they do not reflect arrives below; only the beam itself makes a glint
        ground = ground * (1 - shade * lost)
        water *= 1 - shade
    return dr.lerp(ground, mi.Color3f(albedo), opacity), water * (1 - opacity)


def glint(light: Any, view: Any) -> Any:
    """Return the radiance of waves over the Sun's irradiance on a plane that faces the Sun, in 1/sr.

    Parameters
    ----------
    light, view
        Unit vectors towards the Sun and the camera in axes with z straight up.
    """
    half = dr.normalize(light + view)
    cos_i, cos_e = dr.maximum(light.z, 1e-4), dr.maximum(view.z, 1e-4)
    cos2 = dr.maximum(dr.square(half.z), 1e-4)
    slopes = dr.exp(-(1 - cos2) / (cos2 * SLOPE_VARIANCE)) / (np.pi * SLOPE_VARIANCE)
    seen = 1 / (1 + _hidden(cos_i) + _hidden(cos_e))
    value = _fresnel(dr.dot(light, half)) * slopes * seen / (4 * cos_e * dr.square(cos2))
    return dr.select(light.z > 0, value, 0)


def _air_mass(cosine: Any) -> Any:
    """Return the air towards a zenith angle in units of the air straight up (Rozenberg 1966, Twilight: a fit)."""
    c = dr.maximum(cosine, 0)
    return 1 / (c + 0.025 * dr.exp(-11 * c))


def _hidden(cosine: Any) -> Any:
    """Return Smith's Λ: the projected area of waves that others hide, over that of those in sight."""
    c = cosine / dr.sqrt(SLOPE_VARIANCE * dr.maximum(1 - cosine * cosine, 1e-8))
    return dr.maximum(0.5 * (dr.exp(-c * c) / (c * np.sqrt(np.pi)) - (1 - dr.erf(c))), 0)


def _fresnel(cosine: Any) -> Any:
    """Return the reflectance of water for unpolarised light at an angle of incidence (Fresnel)."""
    inner = dr.sqrt(1 - (1 - dr.square(cosine)) / _WATER_INDEX**2)
    s = (cosine - _WATER_INDEX * inner) / (cosine + _WATER_INDEX * inner)
    p = (_WATER_INDEX * cosine - inner) / (_WATER_INDEX * cosine + inner)
    return 0.5 * (s * s + p * p)


def _shifted(up: Any, towards: Any, height: Any) -> Any:
    """Return where a line from the ground at `up` passes a layer at a height, in radii, as a direction."""
    cosine = dr.dot(towards, up)
    return dr.normalize(up + (towards - cosine * up) * (height / dr.maximum(cosine, _LEAST_COSINE)))


def height_at(up: Any, footprint: Any) -> Any:
    """Return the height of the ground in units of its own; land is above `SEA_LEVEL`."""
    warp = 0.25 * mi.Vector3f(*(_fractal(1.7 * up + 9.1 * k, footprint * 1.7, 11 + k, 0.5, 4) for k in range(3)))
    return _fractal(1.15 * (up + warp), footprint * 1.15, 3, 0.54, 14)


def _ground(up: Any, footprint: Any) -> tuple[Any, Any]:
    """Return the albedo of land, ice and water, and the fraction of open water."""
    height = height_at(up, footprint)
    unseen = _variance_left_out(footprint * 1.15, 0.54, 14)
    land = _step(height, SEA_LEVEL, 0.004, unseen)
    shelf = _step(height, SEA_LEVEL - 0.02, 0.02, unseen)
    latitude = dr.abs(up.z)
    footprint = dr.select((land > 0) | (latitude > _NO_ICE), footprint, _NO_DETAIL)  # the sea needs no more noise
    rough = _fractal(9.0 * up, footprint * 9.0, 5, 0.63, 13)
    fine = _fractal(70.0 * up, footprint * 70.0, 53, 0.72, 10)
    wet = _fractal(2.6 * up, footprint * 2.6, 7, 0.55, 12)
    mountain = dr.clip((height - SEA_LEVEL - 0.1) * 4 + 1.2 * rough * dr.clip((height - SEA_LEVEL) * 8, 0, 1), 0, 1)
    # belts by sine of the latitude: wet at the equator, dry near 25°, wet near 50°, tundra towards 70°
    dry = dr.exp(-dr.square((latitude - 0.42) / 0.17))
    dryness = dry * 0.9 - 0.25 + 1.5 * wet + 0.25 * rough
    colour = dr.lerp(mi.Color3f(*_FOREST), mi.Color3f(*_STEPPE), _step(dryness, 0.10, 0.14))
    colour = dr.lerp(colour, mi.Color3f(*_DESERT), _step(dryness, 0.38, 0.16))
    colour = dr.lerp(colour, mi.Color3f(*_TUNDRA), _step(latitude + 0.25 * wet, 0.86, 0.05))
    colour = dr.lerp(colour, mi.Color3f(*_ROCK), 0.8 * mountain) * (1 + 0.8 * rough + 0.5 * fine)
    cold = latitude + 0.13 * mountain + 0.10 * wet + 0.06 * rough
    colour = dr.lerp(colour, mi.Color3f(*_ICE), _step(cold, 0.935, 0.025))
    water = dr.lerp(mi.Color3f(*_OCEAN), mi.Color3f(*_SHELF), shelf)
    frozen = 0.9 * _step(latitude + 0.05 * wet + 0.05 * rough, 0.972, 0.008)
    water = dr.lerp(water, mi.Color3f(*_ICE), frozen)
    return dr.lerp(water, colour, land), (1 - land) * (1 - frozen)


def _clouds(up: Any, footprint: Any) -> Any:
    """Return the opacity of the clouds in [0, 1], and their albedo."""
    turned = up
    for longitude_deg, latitude_deg, radius, turns in _STORMS:
        lon, lat = np.radians([longitude_deg, latitude_deg])
        axis = mi.Vector3f(*map(float, (np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat))))
        near = dr.exp(-dr.squared_norm(up - axis) / radius**2)
        angle = 2 * np.pi * turns * near * near
        s, c = dr.sincos(angle)
        turned = turned * c + dr.cross(axis, turned) * s + axis * (dr.dot(axis, turned) * (1 - c))
    flat = turned * mi.Vector3f(1, 1, 1.7)  # drawn out along the parallels
    warp = 0.20 * mi.Vector3f(*(_fractal(2.5 * flat + 5.3 * k, footprint * 2.5, 31 + k, 0.55, 9) for k in range(3)))
    large = _fractal(2.4 * (flat + warp), footprint * 2.4, 41, 0.55, 14)
    small = _fractal(26.0 * (flat + 0.6 * warp), footprint * 26.0, 43, 0.66, 12)
    cells = _fractal(170.0 * (flat + 0.3 * warp), footprint * 170.0, 47, 0.70, 9)
    latitude = dr.abs(up.z)
    belts = 0.10 * dr.exp(-dr.square(up.z / 0.10)) + 0.13 * dr.exp(-dr.square((latitude - 0.80) / 0.16))
    belts -= 0.09 * dr.exp(-dr.square((latitude - 0.40) / 0.14))
    unseen = [
        _variance_left_out(footprint * scale, gain, octaves)
        for scale, gain, octaves in ((2.4, 0.55, 14), (26.0, 0.66, 12), (170.0, 0.70, 9))
    ]
    parts, thin = (0.8, 0.40, 0.16), (0.5, 0.5, 0.2)
    cover, wisp = (sum(w * f for w, f in zip(p, (large, small, cells), strict=True)) + belts for p in (parts, thin))
    thick = _step(cover, 0.24, 0.20, sum(w * w * v for w, v in zip(parts, unseen, strict=True)))
    wisps = 0.4 * _step(wisp, 0.10, 0.14, sum(w * w * v for w, v in zip(thin, unseen, strict=True)))
    albedo = dr.clip(_CLOUD * (0.72 + 0.45 * cover + 0.35 * small + 0.25 * cells), 0.3, 0.85)
    return dr.clip(thick + wisps * (1 - thick), 0, 1), albedo


def _step(value: Any, middle: float, half_width: float, unseen: Any = 0.0) -> Any:
    """Return 0 below, 1 above, and a smooth step within `half_width` of the middle.

    Details of the variance `unseen`, which a wide footprint leaves out of the value, widen the step: it is then
    near the mean of the steps of all points in the footprint. The slope of a step has the variance half_width² / 5.
    """
    half_width = dr.sqrt(half_width**2 + 5 * unseen)
    t = dr.clip((value - (middle - half_width)) / (2 * half_width), 0, 1)
    return t * t * (3 - 2 * t)


def _shown(footprint: Any) -> Any:
    """Return the fraction of an octave of unit wavelength that points at the distance `footprint` show."""
    return dr.clip((1 / footprint - 1) * 0.5, 0, 1)


def _variance_left_out(footprint: Any, gain: float, octaves: int) -> Any:
    """Return the variance of what `_fractal` with the same arguments leaves out, with 0.19² for noise."""
    return sum((0.19 * gain**k) ** 2 * (1 - dr.square(_shown(footprint * _LACUNARITY**k))) for k in range(octaves))


def _fractal(point: Any, footprint: Any, seed: int, gain: float, octaves: int) -> Any:
    """Return a sum of octaves of noise, each `gain` times the one before it, without those below the footprint."""

    def more(octave: Any, _point: Any, footprint: Any, _amplitude: Any, _total: Any) -> Any:
        return (octave < min(octaves, _MOST_OCTAVES)) & (footprint < 1)

    def add(octave: Any, point: Any, footprint: Any, amplitude: Any, total: Any) -> Any:
        total = total + amplitude * _shown(footprint) * _noise(point, mi.UInt32(seed) + 101 * octave)
        # a turn keeps the axes of the lattices apart
        turned = mi.Vector3f(
            0.36 * point.x + 0.48 * point.y - 0.8 * point.z,
            -0.8 * point.x + 0.6 * point.y,
            0.48 * point.x + 0.64 * point.y + 0.6 * point.z,
        )
        return octave + 1, turned * _LACUNARITY + 7.31, footprint * _LACUNARITY, amplitude * gain, total

    state = (mi.UInt32(0), mi.Vector3f(point), mi.Float(footprint), mi.Float(1.0), mi.Float(0.0))
    return dr.while_loop(state, more, add)[-1]


def _noise(point: Any, seed: Any) -> Any:
    """Return gradient noise of unit wavelength; it is 0 on average, with a standard deviation of about 0.2."""
    low = dr.floor(point)
    cell, part = mi.Vector3i(low), point - low
    fade = part * part * part * (part * (part * 6 - 15) + 10)
    value = mi.Float(0)
    for corner in np.ndindex(2, 2, 2):
        offset = mi.Vector3i(*map(int, corner))
        index = mi.Vector3u(cell + offset)
        word = index.x * 0x8DA6B343 + index.y * 0xD8163841 + index.z * 0xCB1AB31F + seed * 0x9E3779B1
        word = (word ^ (word >> 15)) * 0x2C1B3C6D
        word = (word ^ (word >> 12)) * 0x297A2D39
        word = word ^ (word >> 15)
        gradient = mi.Vector3f((word & 0x3FF), (word >> 10) & 0x3FF, (word >> 20) & 0x3FF) * (2 / 1023) - 1
        weight = mi.Float(1)
        for axis, side in zip("xyz", corner, strict=True):
            w = getattr(fade, axis)
            weight *= w if side else 1 - w
        value += weight * dr.dot(gradient, part - mi.Vector3f(offset))
    return value
