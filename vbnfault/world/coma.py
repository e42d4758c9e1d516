"""Compute the sunlight that optically thin dust around a body scatters along lines of sight.

The dust flows out freely and evenly in time from the body's centre of mass (the density part of Haser 1957). In the
direction u from the centre and at the distance r its density is proportional to G(u) / r². A line that passes the
centre at the distance b, seen from there, sweeps the angle θ, and a piece of it contributes G dθ / b: the angle is
the variable in which all integrals are taken. Afρ (A'Hearn et al. 1984, AJ 89, 579) sets the scale. Its definition,
Afρ = (2 Δ r_h)² F / (ρ F☉), and a column that falls as 1/b make the radiance of a line without ends, with G = 1,

    L = E Afρ Φ(α) / (8 π b),

with the Sun's irradiance E at the comet and the phase function Φ, which is 1 at zero phase. So a piece of the line
that sweeps the angle θ contributes E Afρ Φ θ / (8 π² b). The mean of G over all directions is 1 without jets:

    G = 1 - f + 3 f (1 + u·s)² / 4 + Σ_j w_j max(a_j·s, 0) N_j exp(k_j (u·a_j - 1)),

with the direction s to the Sun, the fraction f of dust that leaves towards the Sun, and jets of strength w_j around
the axes a_j; N_j makes the mean of their shape 1. The square (an assumed form) is 3 below the Sun, 3/4 at the
terminator and 0 at midnight: gas that leaves sunlit ground expands sideways, too. The part of a line that lies in
the body's shadow is taken away.

The dust covers the area k G / r² in each unit of volume. With A four times the grains' geometric albedo p, which is
the A of Afρ, the column of a line without ends covers Afρ / (2 A b) of the sky, so k = Afρ / (2 π A). This is the
optical depth that `coma_ground` uses: light that grains larger than the wavelength diffract stays within a few
degrees of its direction and counts as not scattered. At 2 km and p = 0.04 it is 0.0016 for each metre of Afρ.

Left out: multiple scattering, since the optical depth is small; extinction of the light of dust, stars and the
Sun's disc; the curved trajectories of dust under radiation pressure, thousands of kilometres away; the acceleration
region within some body radii (Gerig et al. 2018, Icarus 311, 1); and the Sun's angular radius in the shadow.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage

from ..body import Body, Site
from ..core import spectra
from ..core.errors import InputError
from ..core.frames import unit
from ..scene.coma import ComaTable, PhaseFunctionTable
from ..scene.keyed_random import rng

F64 = NDArray[np.float64]
F32 = NDArray[np.float32]

REFERENCE_NM = 550.0
# Within this fraction of the radius of a sphere of the body's volume, the density stays as it is there. Only lines
# that pass a body which does not hold its own centre of mass are ever so near.
_CORE = 0.1
# Cells along each side of the map of the shadow, and its half width over the greatest radius of the body.
SHADOW_CELLS = 256
_SHADOW_MARGIN = 1.06
# Steps along the part of a line of sight that the shadow can reach.
_SHADOW_STEPS = 48
# Nodes of Gauss and Legendre across a jet, which cover it down to this logarithm of its density. Compared with
# `scipy.integrate.quad` the error is below 1e-4 of the light of the line.
_JET_NODES, _JET_DEPTH = 11, 10.0
# A jet that is fainter than this, of its density on the axis, is left out.
_FAINTEST = 1e-5
# Lines of sight that pass the centre at less than this, in units of the camera's distance from it, count as passing
# at it; the formulas divide by it.
_LEAST_SINE = 1e-6
# Lines of sight that are computed at once, to bound memory.
_LINES_AT_ONCE = 1 << 13
# Speed of the gas at 1 au, which falls with the root of the Sun's distance (Cochran & Schleicher 1993, Icarus 105,
# 235). Dust is slower. A body with a greater escape speed keeps it, and has no coma of this kind.
_GAS_SPEED_M_S = 850.0
# Greatest optical depth at the limb for which light is taken to be scattered once. Grains of the albedo 0.04
# scatter a sixth of what they take away, so up to some 15 % of the light would be scattered again.
_MOST_DEPTH = 1.0


@dataclass(frozen=True, kw_only=True, eq=False)
class Lines:
    """Hold n lines of sight by the angle that they sweep, seen from the centre.

    A point of a line lies in the direction `nearest` cos θ + `along` sin θ from the centre.

    Attributes
    ----------
    nearest, along
        float64[n, 3]: unit vectors from the centre to the line's nearest point, and along the line.
    distance_m
        float64[n]: distance of this point from the centre.
    start_rad, swept_rad
        float64[n]: θ of the camera, and the angle between the camera and the line's end.
    """

    nearest: F64
    along: F64
    distance_m: F64
    start_rad: F64
    swept_rad: F64

    @classmethod
    def between(cls, camera_m: F64, directions: F64, length_m: F64) -> Lines:
        """Return lines from the camera, float64[3] from the centre, of a length that may be infinite."""
        start = directions @ camera_m
        offset = camera_m - start[:, None] * directions
        distance = np.linalg.norm(offset, axis=1)
        floor = _LEAST_SINE * max(float(np.linalg.norm(camera_m)), 1e-3)
        # any vector at right angles to the line serves where the line meets the centre
        other = np.cross(directions, np.eye(3)[np.argmin(np.abs(directions), axis=1)])
        nearest = np.where((distance > floor)[:, None], offset, other)
        distance = np.maximum(distance, floor)
        endless = np.isinf(length_m)
        length = np.where(endless, 0, length_m)
        ended = np.arctan2(distance * length, distance**2 + start * (start + length))
        angle = np.arctan2(start, distance)
        return cls(
            nearest=nearest / np.linalg.norm(nearest, axis=1, keepdims=True),
            along=directions,
            distance_m=distance,
            start_rad=angle,
            swept_rad=np.where(endless, np.pi / 2 - angle, ended),
        )

    def chosen(self, which: NDArray[np.bool_]) -> Lines:
        """Return some of the lines."""
        return replace(self, **{name: values[which] for name, values in vars(self).items()})


@dataclass(frozen=True, kw_only=True, eq=False)
class Outflow:
    """Describe the density of the dust by direction, in units of its mean without jets: G of the module docstring.

    Attributes
    ----------
    sun
        float64[3]: unit vector towards the Sun.
    sunlit_fraction
        Fraction of the dust that leaves towards the Sun.
    axes, concentration, strength
        float64[jet, 3], float64[jet], float64[jet]: unit vectors along the jets, k_j, and strengths, which include
        the Sun's zenith angle.
    """

    sun: F64
    sunlit_fraction: float
    axes: F64
    concentration: F64
    strength: F64

    def density(self, directions: F64) -> F64:
        """Return the density in unit directions float64[n, 3], float64[n]."""
        f = self.sunlit_fraction
        total = 1 - f + 0.75 * f * (1 + directions @ self.sun) ** 2
        for axis, k, peak in zip(self.axes, self.concentration, self._peaks, strict=True):
            exponent = k * (directions @ axis - 1)
            near = exponent > np.log(_FAINTEST)
            total[near] += peak * np.exp(exponent[near])
        return np.asarray(total)

    def swept(self, lines: Lines) -> F64:
        """Return the integral of the density over the angle that each line sweeps, float64[n]."""
        f = self.sunlit_fraction
        total = (1 - f) * lines.swept_rad
        # u·s = A cos x along a line
        x, y = lines.nearest @ self.sun, lines.along @ self.sun
        amplitude = np.hypot(x, y)
        middle = lines.start_rad + lines.swept_rad / 2 - np.arctan2(y, x)
        first = np.cos(middle) * 2 * np.sin(lines.swept_rad / 2)
        second = np.cos(2 * middle) * np.sin(lines.swept_rad)
        square = (1 + amplitude**2 / 2) * lines.swept_rad + 2 * amplitude * first + amplitude**2 / 2 * second
        total = total + 0.75 * f * square
        for axis, k, peak in zip(self.axes, self.concentration, self._peaks, strict=True):
            total = total + peak * _jet_integral(lines, axis, k)
        return np.asarray(total)

    @property
    def _peaks(self) -> F64:
        """Return the density on the axis of each jet, float64[jet]."""
        k = self.concentration
        return np.asarray(self.strength * 2 * k / -np.expm1(-2 * k))


def _jet_integral(lines: Lines, axis: F64, concentration: float) -> F64:
    """Return the integral of exp(k (u·a - 1)) over the angle that each line sweeps, float64[n]."""
    x, y = lines.nearest @ axis, lines.along @ axis
    amplitude = np.hypot(x, y)
    out = np.zeros(len(amplitude))
    near = np.flatnonzero(concentration * (1 - amplitude) < -np.log(_FAINTEST))
    middle, amplitude = np.arctan2(y, x)[near], amplitude[near]
    start = np.mod(lines.start_rad[near] - middle + np.pi, 2 * np.pi) - np.pi
    reach = np.arccos(np.maximum(1 - _JET_DEPTH / np.maximum(concentration * amplitude, 1e-12), -1))
    for turn in (0.0, 2 * np.pi):  # a line that begins past the jet's back may reach it from the other side
        low = np.clip(start, turn - reach, turn + reach)
        high = np.clip(start + lines.swept_rad[near], turn - reach, turn + reach)
        met = np.flatnonzero(high > low)
        low, half, a = low[met], (high - low)[met] / 2, amplitude[met]
        total = np.zeros(len(met))
        for node, weight in zip(*_gauss_legendre(), strict=True):
            total += weight * np.exp(concentration * (a * np.cos(low + half * (1 + node)) - 1))
        out[near[met]] += half * total
    return out


@lru_cache(maxsize=1)
def _gauss_legendre() -> tuple[F64, F64]:
    """Return nodes in [-1, 1] and weights of the quadrature across a jet."""
    nodes, weights = np.polynomial.legendre.leggauss(_JET_NODES)
    return nodes, weights


# --- shadow -------------------------------------------------------------------------------------------------


def sun_axes(sun: F64) -> F64:
    """Return two unit vectors at right angles to the Sun's direction, and this one, float64[3, 3], as rows."""
    first = unit(np.cross(sun, np.eye(3)[np.argmin(np.abs(sun))]))
    return np.stack([first, np.cross(sun, first), sun])


@dataclass(frozen=True, kw_only=True, eq=False)
class Shadow:
    """Hold where the body keeps sunlight from the dust, for a Sun at infinity.

    A point is lit if it lies nearer to the Sun than the body on the same line to the Sun, or outside its outline.

    Attributes
    ----------
    axes
        float64[3, 3], as of `sun_axes`.
    half_m
        Half the width of the map around the centre.
    maps
        float32[cell, cell, 2]: height of the body towards the Sun, and the distance from its outline, which is
        negative within it. Columns run along the first axis, rows along the second.
    """

    axes: F64
    half_m: float
    maps: F32

    @classmethod
    def of(cls, heights_m: F32, axes: F64, half_m: float) -> Shadow:
        """Return the shadow of a body by its heights towards the Sun, float32[cell, cell]; -inf where it is not."""
        inside = np.isfinite(heights_m)
        cell_m = 2 * half_m / len(heights_m)
        if not inside.any():
            filled, outline = np.zeros_like(heights_m), np.full_like(heights_m, half_m)
            return cls(axes=axes, half_m=half_m, maps=np.stack([filled, outline], axis=-1))
        away, nearest = ndimage.distance_transform_edt(~inside, return_indices=True)
        within = ndimage.distance_transform_edt(inside)
        outline = np.where(inside, 0.5 - within, away - 0.5) * cell_m
        # heights go on beyond the outline, so that interpolation near it does not mix in what is not there
        filled = heights_m[tuple(nearest)]
        return cls(axes=axes, half_m=half_m, maps=np.stack([filled, outline], axis=-1).astype(np.float32))

    def clearance_m(self, across: F32, down: F32, height: F32) -> F32:
        """Return a number that is positive where points are lit, float32[n, k].

        The points are given by their coordinates along the axes, float32[n, k] each. Near the edge of the shadow
        the number is about the distance from it, in m.
        """
        cells = len(self.maps)
        to_cell = np.float32(cells / (2 * self.half_m))
        columns, rows = (v * to_cell + np.float32(cells / 2 - 0.5) for v in (across, down))
        maps = cv2.remap(self.maps, columns, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return np.asarray(np.maximum(height - maps[..., 0], maps[..., 1]), dtype=np.float32)

    def swept(self, lines: Lines, outflow: Outflow) -> F64:
        """Return the integral of the density over the part of the angle that lies in shadow, float64[n]."""
        out = np.zeros(len(lines.distance_m))
        low, high = self._reach(lines)
        met = high > low
        if not met.any():
            return out
        part, low, high = lines.chosen(met), low[met], high[met]
        angles = low[:, None] + (high - low)[:, None] * np.linspace(0, 1, _SHADOW_STEPS + 1)
        limited = np.clip(angles, -np.pi / 2 + 1e-5, np.pi / 2 - 1e-5).astype(np.float32)
        position = np.tan(limited) * part.distance_m.astype(np.float32)[:, None]
        nearest, along = (v @ self.axes.T for v in (part.nearest * part.distance_m[:, None], part.along))
        coordinates = [
            nearest[:, k, None].astype(np.float32) + position * along[:, k, None].astype(np.float32)
            for k in range(3)
        ]
        dark = 1 - _positive_fraction(self.clearance_m(*coordinates))
        line, step = np.nonzero(dark > 0)
        middle = (angles[line, step] + angles[line, step + 1]) / 2
        directions = part.nearest[line] * np.cos(middle)[:, None] + part.along[line] * np.sin(middle)[:, None]
        width = (high - low)[line] / _SHADOW_STEPS
        sums = np.bincount(line, dark[line, step] * width * outflow.density(directions), len(low))
        out[met] = sums
        return out

    def _reach(self, lines: Lines) -> tuple[F64, F64]:
        """Return between which angles each line is where the body's shadow may lie, float64[n] each.

        This is a cylinder around the body, open away from the Sun.
        """
        nearest, along = lines.nearest @ self.axes.T, lines.along @ self.axes.T
        offset = lines.distance_m[:, None] * nearest
        a = np.maximum(along[:, 0] ** 2 + along[:, 1] ** 2, 1e-18)
        b = np.einsum("nk,nk->n", offset[:, :2], along[:, :2])
        c = offset[:, 0] ** 2 + offset[:, 1] ** 2 - self.half_m**2
        root = np.sqrt(np.maximum(b * b - a * c, 0))
        low, high = (-b - root) / a, (-b + root) / a
        rise = np.where(along[:, 2] < 0, -1.0, 1.0) * np.maximum(np.abs(along[:, 2]), 1e-12)
        top = (self.half_m - offset[:, 2]) / rise
        low, high = np.where(rise < 0, np.maximum(low, top), low), np.where(rise > 0, np.minimum(high, top), high)
        high = np.where(b * b > a * c, high, low)
        low, high = (np.arctan2(v, lines.distance_m) for v in (low, high))
        return np.maximum(low, lines.start_rad), np.minimum(high, lines.start_rad + lines.swept_rad)


def _positive_fraction(values: F32) -> F32:
    """Return the fraction of each step in which the line between two values is positive, float32[n, step]."""
    before, after = values[:, :-1], values[:, 1:]
    rest = np.maximum(np.abs(before) + np.abs(after), np.float32(1e-20))
    return np.asarray((np.maximum(before, 0) + np.maximum(after, 0)) / rest, dtype=np.float32)


# --- coma ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True, eq=False)
class Coma:
    """Hold the dust around a body at one time, in L axes.

    Attributes
    ----------
    centre_L_m
        float64[3]: the body's centre of mass.
    reach_m
        Greatest distance of the body's surface from the centre, with a margin.
    core_m
        Distance within which the density stays constant.
    afrho_m
        A(0°)fρ at the Sun's distance.
    outflow
        Density by direction.
    table
        Table of the scene.
    """

    centre_L_m: F64
    reach_m: float
    core_m: float
    afrho_m: float
    outflow: Outflow
    table: ComaTable

    @property
    def cross_section_m(self) -> float:
        """Return the area of grains in each unit of volume times r², where the density is 1, in m: k above."""
        return self.afrho_m / (2 * np.pi * 4 * self.table.grain_albedo)

    def colour(self, wavelength_nm: F64) -> F64:
        """Return the dust's reflectance over that at 550 nm, float64[band]."""
        slope = self.table.reddening_per_100nm * (wavelength_nm - REFERENCE_NM) / 100
        return np.asarray(np.maximum(1 + slope, 0))

    def phase(self, cosine: NDArray[np.floating]) -> F64:
        """Return the phase function where lines of sight make angles of this cosine with the Sun's direction."""
        away = np.maximum(1 + np.asarray(cosine, dtype=np.float64), 0)
        half = np.arctan2(np.sqrt(away), np.sqrt(np.maximum(2 - away, 0)))
        return relative_phase(self.table.phase_function, np.degrees(2 * half))

    def column(self, start_m: F64, distance_m: F64, length_m: F64) -> F64:
        """Return the integral of 1 / max(r, core)² along lines, in 1/m, float64[n].

        `start_m` is the camera's coordinate along the line, counted from the point nearest to the centre.
        """
        half = np.sqrt(np.maximum(self.core_m**2 - distance_m**2, 0))
        end_m = start_m + length_m
        inside = np.clip(end_m, -half, half) - np.clip(start_m, -half, half)
        outside = [
            np.arctan2(high, distance_m) - np.arctan2(low, distance_m)
            for low, high in (
                (np.minimum(start_m, -half), np.minimum(end_m, -half)),
                (np.maximum(start_m, half), np.maximum(end_m, half)),
            )
        ]
        return np.asarray((outside[0] + outside[1]) / distance_m + inside / self.core_m**2)

    def relative(self, camera_m: F64, directions: F64, length_m: F64, shadow: Shadow | None) -> tuple[F64, F64]:
        """Return light and dust of lines over those with G = 1, float64[n] each; the light without phase function.

        Parameters
        ----------
        camera_m
            float64[3]: position of the camera from the centre.
        directions
            float64[n, 3]: unit vectors from the camera.
        length_m
            float64[n]: length of the lines, which may be infinite.
        shadow
            The body's shadow. None: there is none.
        """
        light, dust = np.empty(len(directions)), np.empty(len(directions))
        for first in range(0, len(light), _LINES_AT_ONCE):
            part = slice(first, first + _LINES_AT_ONCE)
            lines = Lines.between(camera_m, directions[part], length_m[part])
            swept = np.maximum(lines.swept_rad, 1e-300)
            lit = all_dust = self.outflow.swept(lines)
            if shadow is not None:
                lit = lit - shadow.swept(lines, self.outflow)
            light[part], dust[part] = np.maximum(lit, 0) / swept, all_dust / swept
        return light, dust


def make_coma(table: ComaTable, body: Body, site: Site, sun_L: F64, sun_distance_au: float, seed: int) -> Coma:
    """Return the coma of a scene's table for a site, a direction to the Sun in L, and a seed of random jets."""
    centre_L = site.T_from_L.T @ (body.centre_of_mass_T_m - site.position_T_m)
    axes_T, width_deg, strength = _jets(table, seed)
    axes_L, sun = axes_T @ site.T_from_L, unit(sun_L)
    lit = strength * np.maximum(axes_L @ sun, 0)
    active = lit > 0
    return Coma(
        centre_L_m=centre_L,
        reach_m=_SHADOW_MARGIN * _greatest_radius_m(body),
        core_m=_CORE * body.mean_radius_m,
        afrho_m=0.01 * table.afrho_cm * (sun_distance_au / table.reference_au) ** -table.distance_exponent,
        outflow=Outflow(
            sun=sun,
            sunlit_fraction=table.sunlit_fraction,
            axes=axes_L[active],
            concentration=np.log(2) / (1 - np.cos(np.radians(width_deg[active]) / 2)),
            strength=lit[active],
        ),
        table=table,
    )


def _greatest_radius_m(body: Body) -> float:
    """Return the greatest distance of the surface from the centre of mass."""
    return float(np.linalg.norm(body.vertices_m - body.centre_of_mass_T_m, axis=1).max())


def _jets(table: ComaTable, seed: int) -> tuple[F64, F64, F64]:
    """Return axes in T, float64[jet, 3], widths in degrees and strengths of the given jets and the random ones."""
    generator = rng(seed, 0, "coma", "jets")
    draws = generator.random((table.random_jets, 4))
    sine = [np.sin(np.radians(jet.latitude_deg)) for jet in table.jets]
    turn = [np.radians(jet.longitude_deg) for jet in table.jets]
    z = np.concatenate([np.array(sine), 2 * draws[:, 0] - 1])
    longitude = np.concatenate([np.array(turn), 2 * np.pi * draws[:, 1]])
    level = np.sqrt(1 - z * z)
    bounds = (table.random_jet_width_deg, table.random_jet_strength)
    drawn = [low + (high - low) * draws[:, 2 + k] for k, (low, high) in enumerate(bounds)]
    return (
        np.stack([level * np.cos(longitude), level * np.sin(longitude), z], axis=1),
        np.concatenate([np.array([jet.width_deg for jet in table.jets]), drawn[0]]),
        np.concatenate([np.array([jet.strength for jet in table.jets]), drawn[1]]),
    )


def check_coma(table: ComaTable, body: Body, sun_distance_au: float) -> None:
    """Raise InputError if the body's gravity holds its dust back, or if the dust is not optically thin."""
    radius_m = body.mean_radius_m
    mass_kg = body.density_kg_m3 * body.volume_m3
    escape_m_s = float(np.sqrt(2 * spectra.GRAVITATION_SI * mass_kg / radius_m))
    gas_m_s = _GAS_SPEED_M_S / np.sqrt(sun_distance_au)
    if escape_m_s > gas_m_s:
        raise InputError(
            f"coma.afrho_cm: {body.name} has an escape speed of {escape_m_s:.0f} m/s, so dust cannot flow out "
            f"freely; must be at most {gas_m_s:.0f} m/s, as the gas at {sun_distance_au:.3g} au; leave [coma] out"
        )
    nearness = (sun_distance_au / table.reference_au) ** -table.distance_exponent
    depth = 0.01 * table.afrho_cm * nearness / (8 * table.grain_albedo * radius_m)
    if depth > _MOST_DEPTH:
        raise InputError(
            f"coma.afrho_cm = {table.afrho_cm:g}: at {sun_distance_au:.3g} au the dust has an optical depth of "
            f"{depth:.3g} at the limb of {body.name}, where light is no longer scattered only once; must be at "
            f"most {table.afrho_cm * _MOST_DEPTH / depth:.3g}"
        )


# --- phase functions of cometary dust: scattered light over that at 0° of phase ------------------------------

# Schleicher's composite dust phase function ("Halley-Marcus", D. Schleicher, Lowell Observatory, May 2010,
# asteroid.lowell.edu/comet/dustphase.html, used by Schleicher & Bair 2011, AJ 141, 177): every degree from 0° to
# 180°. Below some 42° it is the curve of 1P/Halley (Schleicher, Millis & Birch 1998, Icarus 132, 397), above it
# that of Marcus 2007. The published table has these digits, and so has `phase_HalleyMarcus` of the package sbpy.
_HALLEY_MARCUS = """
1.0 .9596 .9217 .8859 .8522 .8205 .7906 .7624 .7358 .7107 .6871 .6647 .6436 .6237 .6049
.5872 .5704 .5546 .5396 .5255 .5122 .4996 .4877 .4765 .4659 .4559 .4465 .4377 .4293 .4215
.4142 .4073 .4009 .3949 .3893 .3840 .3792 .3747 .3706 .3668 .3634 .3603 .3575 .3540 .3509
.3482 .3458 .3438 .3421 .3407 .3397 .3389 .3385 .3383 .3385 .3389 .3396 .3405 .3418 .3432
.3450 .3470 .3493 .3518 .3546 .3576 .3609 .3645 .3683 .3724 .3768 .3815 .3865 .3917 .3973
.4032 .4094 .4159 .4228 .4300 .4376 .4456 .4540 .4627 .4720 .4816 .4918 .5024 .5136 .5253
.5375 .5504 .5638 .5780 .5928 .6084 .6247 .6419 .6599 .6788 .6987 .7196 .7416 .7648 .7892
.8149 .8420 .8706 .9008 .9327 .9664 1.0021 1.0399 1.0799 1.1223 1.1673 1.2151 1.2659 1.3200 1.3776
1.4389 1.5045 1.5744 1.6493 1.7294 1.8153 1.9075 2.0066 2.1132 2.2281 2.3521 2.4861 2.6312 2.7884 2.9592
3.1450 3.3474 3.5685 3.8104 4.0755 4.3669 4.6877 5.0418 5.4336 5.8682 6.3518 6.8912 7.4948 8.1724 8.9355
9.7981 10.777 11.891 13.166 14.631 16.322 18.283 20.570 23.252 26.418 30.177 34.672 40.086 46.659 54.704
64.637 77.015 92.587 112.37 137.75 170.60 213.48 269.73 343.59 439.89 562.92 713.63 884.48 1053.3 1182.2
1231.2
"""

# Compound Henyey-Greenstein function of Marcus 2007 (International Comet Quarterly 29, 39) for dust without gas:
# asymmetries of the forward and the backward lobe, and the forward fraction. The table above confirms them: from
# 46° on it is this function plus the even light of gas of 1/100 at 90° (his 1/δ), within the rounding of its
# digits. A fit of all four numbers to it gives 0.900, -0.600, 0.950 and 0.0100.
_MARCUS_FORWARD, _MARCUS_BACKWARD, _MARCUS_FORWARD_FRACTION = 0.9, -0.6, 0.95


def relative_phase(function: str | PhaseFunctionTable, phase_deg: ArrayLike) -> F64:
    """Return the light that dust scatters at phase angles over that at 0°, float64 of the same shape.

    Parameters
    ----------
    function
        "halley_marcus", "marcus", or a table of values.
    phase_deg
        Angles at the dust between the directions to the Sun and to the camera, 0 to 180.
    """
    angle = np.clip(np.asarray(phase_deg, dtype=np.float64), 0, 180)
    if function == "halley_marcus":
        return np.asarray(np.exp(_halley_marcus()(angle)))
    if function == "marcus":
        return np.asarray(_marcus(angle) / _marcus(np.zeros(1)))
    assert isinstance(function, PhaseFunctionTable)
    logarithm = np.log(function.value)
    return np.asarray(np.exp(np.interp(angle, function.phase_deg, logarithm - logarithm[0])))


@lru_cache(maxsize=1)
def _halley_marcus() -> Any:
    """Return a function that interpolates the logarithm of the composite phase function."""
    from scipy.interpolate import CubicSpline

    values = np.array(_HALLEY_MARCUS.split(), dtype=np.float64)
    return CubicSpline(np.arange(len(values)), np.log(values))


def _marcus(phase_deg: F64) -> F64:
    """Return the function of Marcus 2007, which is 1 at 90°."""
    cosine = -np.cos(np.radians(phase_deg))  # of the scattering angle

    def lobe(g: float) -> F64:
        return np.asarray(((1 + g * g) / (1 + g * g - 2 * g * cosine)) ** 1.5)

    fraction = _MARCUS_FORWARD_FRACTION
    return fraction * lobe(_MARCUS_FORWARD) + (1 - fraction) * lobe(_MARCUS_BACKWARD)
