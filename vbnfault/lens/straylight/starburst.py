"""Compute the starburst of the Sun: Fraunhofer diffraction at the stop, averaged over the Sun's disc.

A far point source at the direction cosines u_sun has the irradiance E_sun at the entrance and the wave number
k₀ = 2π/λ. At the direction cosines u, its light has the irradiance E on the sensor:

    E / E_sun = cos θ_sun · cos⁴θ / f² · |A(k₀ (u - u_sun))|² / λ²,      A(k) = ∫ exp(-i k·x) dx.

The integral covers the entrance pupil (Goodman, Introduction to Fourier Optics, chapter 4). |A|² / (λ² area) is the
point spread function per unit of u. The factor cos⁴θ / f² = |d²u / d²x| holds for an image without distortion. Near
the axis, u - u_sun is (x - x_sun) / f.

The average over a disc of angular radius σ multiplies the pupil's autocorrelation at the shift ξ by the disc's
coherence 2 J₁(y) / y, y = σ k₀ ξ (van Cittert and Zernike; Born & Wolf, Principles of Optics, 10.4). The coherence
leaves only shifts up to some λ / σ, which is 0.1 mm at 1 au. If this shift is small compared with the stop, the
autocorrelation is needed only to the second power of ξ:

- ξ¹ describes the rim. A piece of the rim of length ds sends 2π ds / k² along its normal, in both directions. A
  straight edge gives a line spike. A bent edge gives a fan, 2πρ / k³ for the radius of curvature ρ. A circle of
  radius a gives 4πa / k³, which is the mean of Airy's rings. The average over the disc is

      |A|² = 4 √(σ² - t²) / (σ² k₀³ (θ² - σ²)) · ds

  at the distance θ = |u - u_sun|, whose component across the normal is t. The code describes a rim by its length
  per angle of the normal, and convolves this function with the average above.
- ξ² describes the corners. The two edges at a corner end at the same point, so their amplitudes add:
  |A|² = (cot ψ₁ - cot ψ₂)² / k⁴, where ψ₁ and ψ₂ are the angles from the normals of the two edges. The integral of
  cot² across a normal is Hadamard's finite part. It subtracts from the spike the light that the wings of the spike
  contain. At the end of a bent edge, Fresnel's integral replaces the cotangent and joins light and dark.

The light of different corners and edges adds as power, because the interference fringes between them are finer than
the disc: the period of the fringes is λ over the distance between the corners or edges.

Approximations: The disc is uniform. The disc is also a circle in u, although projection shortens the real disc by
cos θ_sun along the line to the axis. Off the axis, some spikes are therefore too wide by up to 1 / cos θ_sun. These
spikes are also too faint, so their flux is right.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ...core.spectra import Bands
from ..paraxial import paraxial_properties
from ..prescription import Prescription, Surface
from ..thin import beyond_frame
from .settings import SensorGrid

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]

_EDGE_POINTS = 2049  # points along the edge of one blade, or around a round rim
_FARTHEST = 2.0  # largest distance between two directions, in direction cosines
_MIX_ERROR = 3e-3  # largest error of a mix of fewer tables, relative to the mean of the bands
_STRIP = 64  # rows of the frame that are computed at a time
_NARROW = 1 / 8  # ratio of the disc's radius to the distance below which sin φ = φ across a spike
_WING_SUNS = 12.0  # distance from an edge's normal, in radii of the disc, beyond which cot² is not averaged
_WING_STEP, _WING_POINTS, _WING_COLUMNS = 0.05, 1200, 241
_STRAIGHT_PER_MM = 1e-9
_LEAST_CORNER_RAD = 1e-3
_OUTER_STEPS = 16  # angles of the table that are averaged into one for the flux outside the frame


# --- the Sun's disc ---------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class StarburstFrame:
    """Describe where and in which bands a starburst is computed.

    Attributes
    ----------
    sun_xy_mm
        Position of the image of the Sun's centre, from the middle of the frame. As in the lens, x points to the
        right and y points down. The position may lie outside the frame.
    bands
        Bands of the light that passes the stop.
    sensor
        Size of the frame and pitch of its pixels.
    """

    sun_xy_mm: tuple[float, float]
    bands: Bands
    sensor: SensorGrid


@dataclass(frozen=True, kw_only=True)
class Starburst:
    """Compute the light that diffraction at a stop spreads over the sensor, averaged over the Sun's disc.

    The result is valid at distances of an Airy radius or more from the limb, if σ is at least 3 λ / diameter of the
    entrance pupil. It differs from the transform of the sampled pupil by 1 % in means and by 2 % in spikes. The
    first image for given wavelengths and a given pitch computes tables, which takes some tenths of a second. Later
    images with the same wavelengths and pitch use the same tables.

    Attributes
    ----------
    efl_mm, pupil_radius_mm
        Focal length, and radius of the paraxial entrance pupil.
    sun_radius_rad
        Angular radius of the disc.
    stop
        Surface of the stop, which has the outline.
    radii, angles
        Numbers of rows and columns of the polar table. The rows are logarithmic in the distance |u - u_sun|, up to
        2. The columns cover half a turn, because |A(-k)| = |A(k)|.
    """

    efl_mm: float
    pupil_radius_mm: float
    sun_radius_rad: float
    stop: Surface
    radii: int
    angles: int

    def image(self, frame: StarburstFrame) -> F32:
        """Return the irradiance on the sensor over the Sun's irradiance at the entrance, float32[band, y, x].

        The result holds for a lens with a transmission of 1. Inside the image of the Sun's disc, the result has the
        value from just outside the disc; the direct image, which other code draws, is brighter.
        """
        tables, mix = self._tables(frame)
        plain = len(tables) == len(mix)  # a table for each band
        (height, width), pitch_mm = frame.sensor.shape, frame.sensor.pitch_mm
        f, sigma, nearest = self.efl_mm, self.sun_radius_rad, self._sines(pitch_mm)[0]
        sun = np.asarray(frame.sun_xy_mm, dtype=np.float64) / f
        sun_cos = float(1 / np.sqrt(1 + sun @ sun))
        sun_u, sun_v = (np.float32(s * sun_cos) for s in sun)
        per_log = np.float32(0.5 * (self.radii - 1) / np.log(_FARTHEST / nearest))
        x = ((np.arange(width) - (width - 1) / 2) * pitch_mm / f).astype(np.float32)[None, :]
        out = np.empty((len(mix), height, width), dtype=np.float32)
        part = np.empty((len(tables), min(_STRIP, height), width), dtype=np.float32)
        for top in range(0, height, _STRIP):  # the arrays of a strip stay in the cache
            strip = out[:, top : top + _STRIP]
            rows = np.arange(top, top + strip.shape[1])
            y = ((rows - (height - 1) / 2) * pitch_mm / f).astype(np.float32)[:, None]
            cosine = 1 / np.sqrt((1 + x * x) + y * y)
            du, dv = x * cosine - sun_u, y * cosine - sun_v
            apart = du * du + dv * dv
            # the real disc is foreshortened, so a u beside it can lie inside the circle that the table assumes
            apart = np.maximum(apart, np.float32(nearest**2))
            cosine *= cosine
            gain = cosine * cosine * np.float32(sun_cos / f**2) / (apart - np.float32(sigma**2))
            angle = np.arctan2(np.abs(dv), np.copysign(du, du * dv)) * np.float32(self.angles / np.pi)
            row = (np.log(apart) - np.float32(2 * np.log(nearest))) * per_log
            layers = strip if plain else part[:, : strip.shape[1]]
            for layer, table in zip(layers, tables, strict=True):
                cv2.remap(table, angle, row, cv2.INTER_LINEAR, dst=layer, borderMode=cv2.BORDER_REPLICATE)
                layer *= gain
            if not plain:
                _mixed(layers, mix, strip)
        return out

    def layers_at(self, frame: StarburstFrame, u: F32, v: F32) -> tuple[F32, F64]:
        """Return layers of |A|² / λ² in mm² at the distances (u, v) in direction cosines, and their weights.

        `u` and `v` are float32 that broadcast to [y, x]. Inside the disc the value is that just outside. The
        weights are float64[band, layer].
        """
        tables, mix = self._tables(frame)
        nearest = self._sines(frame.sensor.pitch_mm)[0]
        per_log = np.float32(0.5 * (self.radii - 1) / np.log(_FARTHEST / nearest))
        u, v = np.broadcast_arrays(u, v)
        apart = np.maximum(u * u + v * v, np.float32(nearest**2))
        angle = np.arctan2(np.abs(v), np.copysign(u, u * v)) * np.float32(self.angles / np.pi)
        row = (np.log(apart) - np.float32(2 * np.log(nearest))) * per_log
        apart -= np.float32(self.sun_radius_rad**2)
        layers = [
            cv2.remap(t, angle, row, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE) / apart for t in tables
        ]
        return np.stack(layers), mix.astype(np.float64)

    def flux_by_distance(self, frame: StarburstFrame, weight: Callable[[F64], F64]) -> F64:
        """Return the integral of |A|² / λ² over directions, weighted by distance, float64[band] in mm²."""
        tables, mix = self._tables(frame)
        sine = self._sines(frame.sensor.pitch_mm)
        mean = tables[..., :-1].mean(axis=-1, dtype=np.float64) / (sine**2 - self.sun_radius_rad**2)
        return np.asarray(mix @ np.trapezoid(2 * np.pi * mean * weight(sine) * sine**2, x=np.log(sine), axis=1))

    def beyond_mm2(self, frame: StarburstFrame) -> F64:
        """Return the flux on the sensor plane outside the frame, float64[band] in mm².

        The flux is divided by the Sun's irradiance at the entrance and holds for a lens with a transmission of 1.
        """
        tables, mix = self._tables(frame)
        (height, width), pitch_mm = frame.sensor.shape, frame.sensor.pitch_mm
        sine = self._sines(pitch_mm)
        slope = np.asarray(frame.sun_xy_mm, dtype=np.float64) / self.efl_mm
        half = self.angles // math.gcd(self.angles, _OUTER_STEPS)
        # average over steps of several angles: a spike is narrower than a step, but the frame is much wider
        means = tables[..., :-1].reshape(len(tables), len(sine), half, -1).mean(axis=-1, dtype=np.float64)
        angle = (np.arange(2 * half) + 0.5) * np.pi / half
        half_slope = (width / 2 * pitch_mm / self.efl_mm, height / 2 * pitch_mm / self.efl_mm)
        missing = beyond_frame(slope, sine, angle, half_slope)
        missing_half = (missing[:, :half].astype(np.float64) + missing[:, half:]) * (np.pi / half)
        per_radius = np.einsum("tra,ra->tr", means, missing_half) / (sine**2 - self.sun_radius_rad**2)
        flux = np.trapezoid(per_radius * sine**2, x=np.log(sine), axis=1)
        # inside the nearest radius of the table, the image is constant
        flux += per_radius[:, 0] * sine[0] ** 2 / 2
        return np.asarray(mix @ flux / np.sqrt(1 + slope @ slope))

    def _sines(self, pitch_mm: float) -> F64:
        """Return the distance |u - u_sun| of each row of the table, float64[radius]."""
        nearest = self.sun_radius_rad + 0.9 * pitch_mm / self.efl_mm
        return np.asarray(np.geomspace(nearest, _FARTHEST, self.radii))

    def _tables(self, frame: StarburstFrame) -> tuple[F32, F32]:
        """Return tables of (θ² - σ²) |A|² / λ² in mm², and the weight of each table in each band.

        The tables are float32[table, radius, angle + 1], where the last angle repeats the first; the weights are
        float32[band, table].
        """
        return _tables_of(self, frame.bands, frame.sensor.pitch_mm)


@lru_cache(maxsize=4)
def _tables_of(burst: Starburst, bands: Bands, pitch_mm: float) -> tuple[F32, F32]:
    """Return `Starburst._tables`, which samples of a view share."""
    weights = [(bands.wavelength_nm, weight) for weight in bands.weights]
    pixel_rad = pitch_mm / burst.efl_mm / np.sqrt(12)
    return _fewest(_polar(burst, burst._sines(pitch_mm), weights, pixel_rad))


def _mixed(layers: F32, mix: F32, out: F32) -> None:
    """Write to `out` each band's sum of layers, float32[table, y, x], weighted by `mix`, float32[band, table]."""
    for band, (first, *rest) in zip(out, mix, strict=True):
        np.multiply(layers[0], first, out=band)
        for layer, weight in zip(layers[1:], rest, strict=True):
            cv2.scaleAdd(layer, float(weight), band, dst=band)


def starburst(lens: Prescription, *, sun_radius_rad: float, table: tuple[int, int] = (224, 4096)) -> Starburst:
    """Return the starburst of a lens.

    The tables of the starburst have `table` radii, 16 or more, and angles, an even number from 64 on. The defaults
    are fine enough for frames up to 1500 pixels wide.
    """
    radii, angles = table
    optics = paraxial_properties(lens)
    return Starburst(
        efl_mm=optics.efl_mm,
        pupil_radius_mm=optics.entrance_pupil_diameter_mm / 2,
        sun_radius_rad=sun_radius_rad,
        stop=lens.surfaces[lens.stop],
        radii=radii,
        angles=angles,
    )


@dataclass(frozen=True, kw_only=True)
class _Edge:
    """Describe one blade's edge in the entrance pupil, or the whole of a round rim, in short pieces.

    `count` is the number of such edges. `length_mm` is the length of each piece, and `normal_rad` is the direction
    of the normal of each piece. The normal in the middle of the edge has the direction 0. `end_rad` is the
    direction of the normal at the end of the edge, and `end_curvature_per_mm` is the curvature at this end.
    """

    count: int
    length_mm: F64
    normal_rad: F64
    end_rad: float
    end_curvature_per_mm: float


def _edge(stop: Surface, pupil_radius_mm: float) -> _Edge:
    """Return the edge of a stop, scaled to the entrance pupil."""
    count = max(stop.blades, 1)
    half = np.pi / count
    angle = np.linspace(-half, half, _EDGE_POINTS)
    radius = stop.rim_mm(angle + np.radians(stop.rotation_deg) + half) * pupil_radius_mm / stop.semi_diameter_mm
    dx, dy = np.diff(radius * np.cos(angle)), np.diff(radius * np.sin(angle))
    length, normal = np.hypot(dx, dy), np.unwrap(np.arctan2(-dx, dy))
    turn = (normal[-1] - normal[-2]) / length[-1]
    return _Edge(
        count=count,
        length_mm=length,
        normal_rad=normal,
        end_rad=float(normal[-1] + turn * length[-1] / 2),
        end_curvature_per_mm=float(turn),
    )


def _polar(burst: Starburst, sine: F64, bands: Sequence[tuple[F64, F64]], pixel_rad: float) -> F32:
    """Return (θ² - σ²) |A|² / λ², float32[band, radius, angle + 1]; `pixel_rad` is the rms width of a pixel."""
    edge = _edge(burst.stop, burst.pupil_radius_mm)
    order = 2 * np.arange(burst.angles // 2 + 1)  # odd orders cancel: light takes both directions of a normal
    excess = sine**2 - burst.sun_radius_rad**2
    chord = _chord(sine, burst.sun_radius_rad, pixel_rad, burst.angles)
    mm = np.array([nm @ weight for nm, weight in bands]) * 1e-6
    square = np.array([nm**2 @ weight for nm, weight in bands]) * 1e-12

    first_corner = np.radians(burst.stop.rotation_deg)
    repeats = order % edge.count == 0 if burst.stop.blades else order == 0
    turn = edge.normal_rad + first_corner + np.pi / edge.count
    rim = edge.count / np.pi * np.exp(-1j * order[repeats, None] * turn) @ edge.length_mm
    nodes, corners = mm[:1], np.zeros((1, len(sine), int(repeats.sum())), dtype=np.complex128)
    opening = np.pi / edge.count - edge.end_rad
    if burst.stop.blades and opening > _LEAST_CORNER_RAD:
        # apart from k⁴, the wavelength changes only the width of Fresnel's integral, so three nodes are enough
        if edge.end_curvature_per_mm > _STRAIGHT_PER_MM:
            alike = np.ptp(mm) < 1e-6 * mm.max()
            nodes = mm[:1] if alike else np.linspace(mm.min(), mm.max(), min(len(mm), 3))
        powers = _corner(burst, sine, opening, edge.end_curvature_per_mm, nodes, pixel_rad)
        turn = np.exp(-1j * order[repeats] * first_corner) * _blur(burst.angles)[repeats]
        corners = np.fft.rfft(powers, norm="forward")[:, :, repeats] * edge.count * turn
        corners /= 16 * np.pi**4 * excess[:, None]  # the mean of 1/θ⁴ over the disc is 1 / (θ² - σ²)²

    out = np.empty((len(bands), len(sine), burst.angles + 1), dtype=np.float32)
    for k in range(len(bands)):
        total = np.zeros((len(sine), len(order)), dtype=np.complex128)
        total[:, repeats] = mm[k] / (4 * np.pi**2) * chord[:, repeats] * rim
        for node, corner in zip(nodes, corners, strict=True):  # Lagrange's polynomials
            others = nodes[nodes != node]
            total[:, repeats] += square[k] * np.prod((mm[k] - others) / (node - others)) * corner
        out[k, :, :-1] = np.fft.irfft(total, n=burst.angles, norm="forward")
    out[..., -1] = out[..., 0]
    return np.asarray(np.maximum(out, 0, out=out))


def _fewest(tables: F32) -> tuple[F32, F32]:
    """Return the smallest number of tables that represents all bands, and the weight of each table in each band.

    The light of a rim grows with λ, and the light of corners grows with λ². Two tables are therefore nearly enough.
    """
    sample = tables[:, ::2, ::5].reshape(len(tables), -1).astype(np.float64)
    sample /= np.maximum(sample.mean(axis=0), 1e-30)
    _, mix = np.linalg.eigh(sample @ sample.T)
    mix = mix[:, ::-1]
    for count in range(1, len(tables) // 2):  # a mix of more tables would save nothing
        kept = mix[:, :count]
        if np.abs(sample - kept @ (kept.T @ sample)).max() < _MIX_ERROR:
            return np.tensordot(kept.T.astype(np.float32), tables, 1), kept.astype(np.float32)
    return tables, np.eye(len(tables), dtype=np.float32)


def _chord(sine: F64, sun_rad: float, pixel_rad: float, angles: int) -> F64:
    """Return the Fourier coefficients, over the angle, of the profile across a spike, float64[radius, order].

    Only even orders are returned. At the angle φ from the spike, the profile is (2 / π σ²) √(σ² - θ² sin²φ). It is
    blurred by a pixel and by a step of the table.
    """
    from scipy.special import j1

    step = np.pi / angles
    order = 2.0 * np.arange(angles // 2 + 1)
    z = order * sun_rad / sine[:, None]
    with np.errstate(invalid="ignore"):
        out = np.where(z > 0, 2 * j1(z) / z, 1.0) / sine[:, None]
    near = sine * _NARROW < sun_rad
    across = sine[near, None] * np.sin(step * np.arange(angles))
    profile = 2 / (np.pi * sun_rad**2) * np.sqrt(np.maximum(sun_rad**2 - across**2, 0))
    out[near] = np.fft.rfft(profile).real * step
    return np.asarray(out * np.exp(-((order * pixel_rad / sine[:, None]) ** 2) / 2) * _blur(angles))


def _blur(angles: int) -> F64:
    """Return the Fourier coefficients of the blur (1, 2, 1) / 4, float64[order]; it prevents ringing."""
    return np.asarray(np.cos(np.arange(angles // 2 + 1) * np.pi / angles) ** 2)


def _corner(
    burst: Starburst, sine: F64, opening: float, curvature_per_mm: float, wavelength_mm: F64, pixel_rad: float
) -> F64:
    """Return k⁴ |A|² of one corner without the light along its edges' normals, float64[wavelength, radius, angle].

    The angle counts from the direction of the corner. The normals of the two edges have the angles -`opening` and
    +`opening`. Near a normal, `_wing_means` replaces 1/q and 1/q², where q = θ sin ψ / σ'.
    """
    radius = float(np.hypot(burst.sun_radius_rad, 2 * pixel_rad))
    per_radius = sine[:, None] / radius
    means = _wing_means(burst, sine, opening, curvature_per_mm, wavelength_mm, pixel_rad)
    angle = np.arange(burst.angles // 2 + 1) * np.pi / burst.angles  # the other half mirrors this half
    total = np.full((len(wavelength_mm), len(sine), len(angle)), 2.0)
    for psi in (opening - angle, opening + angle):
        psi = np.mod(psi + np.pi / 2, np.pi) - np.pi / 2
        q = per_radius * np.sin(psi)
        near = np.nonzero(np.abs(q) < _WING_SUNS)
        column = (q[near] + _WING_SUNS) * ((_WING_COLUMNS - 1) / _WING_SUNS)
        below = np.minimum(column.astype(np.intp), 2 * _WING_COLUMNS - 3)
        part = column - below
        with np.errstate(divide="ignore"):
            inverse = 1 / q
        cot_scale = np.cos(psi) * per_radius
        scales = 2 / np.tan(2 * opening) * cot_scale, cot_scale**2
        for power, scale, tables in zip((1, 2), scales, means, strict=True):
            for out, table in zip(total, tables, strict=True):
                mean = inverse**power
                mean[near] = table[near[0], below] * (1 - part) + table[near[0], below + 1] * part
                out += scale * mean
    return np.concatenate([total, total[..., -2:0:-1]], axis=-1)


def _wing_means(
    burst: Starburst, sine: F64, opening: float, curvature_per_mm: float, wavelength_mm: F64, pixel_rad: float
) -> list[F64]:
    """Return 1/q and 1/q² averaged over the disc and a pixel, each float64[wavelength, radius, q].

    The values of q = θ sin ψ / σ' rise evenly from -`_WING_SUNS` to +`_WING_SUNS`. The averages are integrals over
    the coherence μ(y). Disc and pixel together have the radius σ'. Bent edges add the terms of Fresnel's integral,
    with τ = θ / (2 ρ σ'² k₀) and δ = q₁ + q₂, the sum for the two edges:

        1/q → ∫ μ(y) sin(qy + τy²) / (1 + 2τy/δ) dy,     1/q² → -∫ μ(y) [sin(qy + τy²) - sin(qy)] / (τy) dy.

    If both edges have the same normal (δ → 0), there is no corner, and the first integral cancels the second.
    """
    from scipy.special import j1

    radius = float(np.hypot(burst.sun_radius_rad, 2 * pixel_rad))
    per_radius = sine[:, None] / radius
    y = (np.arange(_WING_POINTS) + 0.5) * _WING_STEP
    q = np.linspace(0, _WING_SUNS, _WING_COLUMNS)
    s = y * burst.sun_radius_rad / radius
    # the term 0.05 y blurs by a twentieth of the radius; without this blur the limb would leave a cusp
    coherence = 2 * j1(s) / s * np.exp(-((y * pixel_rad / radius) ** 2 + (0.05 * y) ** 2) / 2) * _WING_STEP
    sines, cosines = np.sin(y[:, None] * q), np.cos(y[:, None] * q)

    def integral(of: NDArray[Any]) -> F64:
        """Return Im ∫ μ(y) of(y) exp(iqy) dy for the function `of`, at all values of -q and q."""
        odd, even = (coherence * of.real) @ sines, (coherence * of.imag) @ cosines
        return np.concatenate([(even - odd)[..., :0:-1], even + odd], axis=-1)

    if curvature_per_mm > _STRAIGHT_PER_MM:
        tau = (curvature_per_mm * sine * wavelength_mm[:, None] / (4 * np.pi * radius**2))[..., None]
        chirp = np.exp(1j * tau * y**2)
        square = -integral((chirp - 1) / (tau * y))
        single = integral(chirp / (1 + tau * y / (per_radius * np.sin(opening))))
    else:
        square, single = -integral(1j * y[None, None]), integral(np.ones((1, 1, len(y)), dtype=np.complex128))
    shape = (len(wavelength_mm), len(sine), 2 * len(q) - 1)
    return [np.ascontiguousarray(np.broadcast_to(mean, shape)) for mean in (single, square)]
