"""Compute what a coma does to the ground: the light of its dust on it, and the sunlight that the dust takes away.

The dust lights the ground from the whole sky, also where the Sun does not shine, and takes away sunlight on its way
to the ground. Both are thousandths of sunlight for 67P at its perihelion, and some percent for a comet like 1P, so
they are approximated:

- The ground is that of a sphere: the sky is free above the horizontal plane of each point, whose vertical points
  away from the body's centre of mass, and the shadow in the dust is that of a sphere through the point. Rocks and
  cliffs do not hide the sky.
- Jets count as dust that is spread like the rest.
- Within 30° of the Sun's direction (phase angles above 150°) the sky is as bright as at 30° from it. What is
  brighter there, three quarters of all light that the dust scatters, counts neither as taken away nor as light of
  the sky: grains diffract it forwards, and it reaches the ground like sunlight.

With the radius R of the ground and lengths in units of R, the irradiance over the Sun's is Afρ / (8 π² R) times a
function of three angles: the Sun's zenith angle, the zenith angle of the facet's normal, and the azimuth between
both. The optical depth towards the Sun is k / R (k as in `coma`) times a function of the first. Both functions are
tabulated, once for each phase function and sunlit fraction.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from ..core.quantities import BODY, Truth
from ..reflectance import BandReflectance, radiance_factor
from ..render.description import View
from ..scene.coma import PhaseFunctionTable
from .coma import Coma, relative_phase

F64 = NDArray[np.float64]
F32 = NDArray[np.float32]

# Phase angle beyond which the rest of the scattered light counts as sunlight.
MOST_PHASE_DEG = 150.0
# Steps of the table: zenith angles of the Sun, and zenith angles and azimuths of normals, all from 0 to 180°.
_SUN_STEPS, _TILT_STEPS, _TURN_STEPS = 37, 19, 13
_FINER = 4  # steps between two of these, by linear interpolation
# Directions of the sky, by the cosine of the zenith angle and the azimuth over half a turn; points of each line.
_SKY_COSINES, _SKY_TURNS, _LINE_POINTS = 12, 24, 24
# Frames wider than this have the light computed at every second pixel along each axis.
_FINE_PX = 512
# Emission angles at which the reflectance is tabulated, and directions of the light over half a sphere.
_EMISSION_STEPS, _LIGHT_COSINES, _LIGHT_TURNS = 46, 12, 24


@dataclass(frozen=True, kw_only=True, eq=False)
class OnGround:
    """Hold what the dust does to the ground in view.

    Attributes
    ----------
    sky
        float32[y, x]: radiance of the ground in the light of the sky at the band `reference`, over the irradiance
        of the Sun at 550 nm, in 1/sr; 0 where there is no ground.
    band_factor
        float64[band]: reflectance of the ground over that at the band `reference`.
    depth_to_sun
        float32[y, x]: optical depth between the ground and the Sun; 0 where there is no ground.
    """

    sky: F32
    band_factor: F64
    depth_to_sun: F32


def on_ground(coma: Coma, view: View, truth: Truth, reflectance: BandReflectance) -> OnGround:
    """Return the light of the dust on the ground in view, and the optical depth from there to the Sun.

    `truth` is on the grid of the view.
    """
    depth_m, normal, semantic = truth.depth_m, truth.normal, truth.semantic
    stride = 1 if max(semantic.shape) <= _FINE_PX else 2
    shape = semantic.shape
    row, column = np.nonzero(semantic[::stride, ::stride] == BODY)
    y, x = stride * row, stride * column
    across, down, along = view.rays_C(np.asarray(x + 0.5), np.asarray(y + 0.5))
    rays = np.stack([across / along, down / along, np.ones(len(x))]).astype(np.float32)
    offset = rays * depth_m[y, x]  # in camera axes, as the normals are
    up = offset + (view.L_from_C.T @ (view.position_L_m - coma.centre_L_m))[:, None].astype(np.float32)
    radius = np.maximum(np.linalg.norm(up, axis=0), np.float32(coma.core_m))
    up /= np.maximum(np.linalg.norm(up, axis=0), np.float32(1e-3))
    facing = normal[y, x].astype(np.float32).T
    sun = (view.L_from_C.T @ coma.outflow.sun).astype(np.float32)[:, None]
    phase_function, sunlit_fraction = coma.table.phase_function, coma.table.sunlit_fraction
    more_dust = 1 + float(coma.outflow.strength.sum())

    cos_sun, cos_tilt = ((up * v).sum(axis=0) for v in (sun, facing))
    side = (facing * sun).sum(axis=0) - cos_tilt * cos_sun
    length = np.sqrt(np.maximum((1 - cos_sun**2) * (1 - cos_tilt**2), 1e-12))
    irradiance = irradiance_of_sky(phase_function, sunlit_fraction, cos_sun, cos_tilt, side / length)
    depth = dust_towards_sun(phase_function, sunlit_fraction, cos_sun) / radius
    reference = reflectance.weights.shape[1] // 2
    factors = diffuse_reflectance(reflectance)
    cos_out = -(facing * rays).sum(axis=0) / np.linalg.norm(rays, axis=0)
    step = np.minimum(_nearest_step(np.maximum(cos_out, 0), 2 * _EMISSION_STEPS - 1), _EMISSION_STEPS - 1)
    reflected = factors[reference].astype(np.float32)[step]
    irradiance *= reflected / radius * np.float32(more_dust * coma.afrho_m / (8 * np.pi**2))
    full = []
    for values in (irradiance, depth * np.float32(more_dust * coma.cross_section_m)):
        nodes = np.zeros((-(-shape[0] // stride), -(-shape[1] // stride)), dtype=np.float32)
        nodes[row, column] = values
        wide = nodes
        if stride > 1:
            size = (nodes.shape[1] * stride, nodes.shape[0] * stride)
            wide = cv2.resize(nodes, size, interpolation=cv2.INTER_NEAREST)[: shape[0], : shape[1]]
        full.append(np.where(semantic == BODY, wide, np.float32(0)))
    middle = factors[:, _EMISSION_STEPS // 2]
    factor = middle / max(float(middle[reference]), 1e-300)
    return OnGround(sky=full[0], band_factor=factor, depth_to_sun=full[1])


def irradiance_of_sky(
    phase_function: str | PhaseFunctionTable, sunlit_fraction: float, cos_sun: F64, cos_tilt: F64, cos_turn: F64
) -> F32:
    """Return the irradiance that the sky's light has on facets of a sphere, float32[n].

    It is in units of the Sun's irradiance times Afρ / (8 π² R). `cos_sun`, `cos_tilt` and `cos_turn` are the
    cosines of the zenith angles of Sun and normal, and of the azimuth between them.
    """
    table = _table(phase_function, sunlit_fraction).irradiance
    index = [
        _nearest_step(cosine, steps)
        for cosine, steps in zip((cos_sun, cos_tilt, cos_turn), table.shape, strict=True)
    ]
    return np.asarray(table.ravel()[(index[0] * table.shape[1] + index[1]) * table.shape[2] + index[2]])


def dust_towards_sun(phase_function: str | PhaseFunctionTable, sunlit_fraction: float, cos_sun: F64) -> F32:
    """Return the integral of G / r² towards the Sun from a sphere of the radius 1, float32[n].

    `cos_sun` is the cosine of the Sun's zenith angle.
    """
    dust = _table(phase_function, sunlit_fraction).dust
    return np.asarray(dust[_nearest_step(cos_sun, len(dust))])


def _nearest_step(cosine: F64 | F32, steps: int) -> NDArray[np.int32]:
    """Return the nearest of equal steps of angles from 0 to 180°, int32[n]."""
    angle = np.arccos(np.clip(cosine, -1, 1))
    return np.asarray(angle * np.float32((steps - 1) / np.pi) + np.float32(0.5), dtype=np.int32)


def diffuse_reflectance(reflectance: BandReflectance) -> F64:
    """Return radiance over irradiance under even light, at emission angles in steps of 2°, float64[band, angle]."""
    emission = np.minimum(np.linspace(0, np.pi / 2, _EMISSION_STEPS), np.radians(89))
    cosine, turn, weight = _half_sphere(_LIGHT_COSINES, _LIGHT_TURNS)
    light = _directions(cosine, turn)
    view = np.stack([np.sin(emission), np.zeros_like(emission), np.cos(emission)], axis=1)
    pairs = np.repeat(view, len(light), axis=0), np.tile(light, (len(view), 1))
    factor = radiance_factor(reflectance, pairs[1], pairs[0]).reshape(-1, len(view), len(light))
    # r = factor / π of each direction, in even light of the irradiance 1, whose radiance is 1 / π
    return np.asarray(factor @ weight / np.pi**2)


# --- table ----------------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True, eq=False)
class _Table:
    """Hold the light of the sky and the dust towards the Sun on a sphere of the radius 1.

    Attributes
    ----------
    irradiance
        float32[sun, tilt, turn]: integral of Φ G / r² over the sky that a facet sees and along its lines, times the
        cosine of incidence.
    dust
        float32[sun]: integral of G / r² along the line to the Sun; of those below the horizon, along the horizon.
    """

    irradiance: F32
    dust: F32


@lru_cache(maxsize=8)
def _table(phase_function: str | PhaseFunctionTable, sunlit_fraction: float) -> _Table:
    """Return the table of a phase function and a sunlit fraction."""
    zenith, tilt, azimuth = (np.linspace(0, np.pi, n) for n in (_SUN_STEPS, _TILT_STEPS, _TURN_STEPS))
    suns = np.stack([np.sin(zenith), np.zeros_like(zenith), np.cos(zenith)], axis=1)
    cosine, turn, weight = _half_sphere(_SKY_COSINES, _SKY_TURNS)
    # both halves of the sky, which are alike
    sky = np.concatenate([_directions(cosine, turn), _directions(cosine, -turn)])
    weight = np.concatenate([weight, weight]) / 2
    light = np.stack([_along(sky, sun, sunlit_fraction)[1] for sun in suns])
    phase_deg = np.degrees(np.arccos(np.clip(-suns @ sky.T, -1, 1)))
    light *= relative_phase(phase_function, np.minimum(phase_deg, MOST_PHASE_DEG))
    normals = _directions(*(v.ravel() for v in np.meshgrid(np.cos(tilt), azimuth, indexing="ij")))
    seen = np.maximum(normals @ sky.T, 0) * weight
    irradiance = (light @ seen.T).reshape(_SUN_STEPS, _TILT_STEPS, _TURN_STEPS)
    to_sun = suns.copy()
    below = to_sun[:, 2] < 0
    to_sun[below] = [1.0, 0.0, 0.0]
    dust = [_along(ray[None], sun, sunlit_fraction)[0] for ray, sun in zip(to_sun, suns, strict=True)]
    # finer steps cost little, and then the nearest one serves every pixel
    sizes = [_FINER * (n - 1) + 1 for n in irradiance.shape]
    finer = np.meshgrid(*(np.arange(n) / _FINER for n in sizes), indexing="ij", sparse=False)
    fine = ndimage.map_coordinates(irradiance, finer, order=1)
    along = np.interp(np.arange(sizes[0]) / _FINER, np.arange(_SUN_STEPS), np.concatenate(dust))
    return _Table(irradiance=fine.astype(np.float32), dust=along.astype(np.float32))


def _along(rays: F64, sun: F64, sunlit_fraction: float) -> tuple[F64, F64]:
    """Return the integrals of G / r² over lines from the top of a unit sphere, and over their lit parts."""
    up = np.array([0.0, 0.0, 1.0])
    sine = np.maximum(np.sqrt(np.maximum(1 - rays[:, 2] ** 2, 0)), 1e-6)
    swept = np.arctan2(sine, rays[:, 2])
    angle = swept[:, None] * (np.arange(_LINE_POINTS) + 0.5) / _LINE_POINTS
    across = rays - rays[:, 2:] * up
    across /= np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-9)
    # the directions of the points from the centre, and their distances by the sine rule
    units = np.cos(angle)[..., None] * up + np.sin(angle)[..., None] * across[:, None]
    height = units @ sun
    radius = sine[:, None] / np.maximum(np.sin(swept[:, None] - angle), 1e-9)
    density = 1 - sunlit_fraction + 0.75 * sunlit_fraction * (1 + height) ** 2
    lit = (height > 0) | (radius**2 * (1 - height**2) > 1)
    step = (swept / sine / _LINE_POINTS)[:, None]
    return (density * step).sum(axis=1), (density * lit * step).sum(axis=1)


def _half_sphere(cosines: int, turns: int) -> tuple[F64, F64, F64]:
    """Return cosines of zenith angles, azimuths over half a turn, and weights whose sum is 2 π."""
    nodes, weights = np.polynomial.legendre.leggauss(cosines)
    turn = np.pi * (np.arange(turns) + 0.5) / turns
    cosine, angle = (v.ravel() for v in np.meshgrid((nodes + 1) / 2, turn, indexing="ij"))
    return cosine, angle, np.repeat(weights / 2, turns) * 2 * np.pi / turns


def _directions(cosine: F64, turn: F64) -> F64:
    """Return unit vectors float64[n, 3] by the cosine of the zenith angle and the azimuth."""
    sine = np.sqrt(np.maximum(1 - cosine**2, 0))
    return np.stack([sine * np.cos(turn), sine * np.sin(turn), cosine], axis=1)
