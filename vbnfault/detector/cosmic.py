"""Simulate cosmic rays: straight tracks of ionisation through the sensitive layer of a sensor.

x_px and y_px are image coordinates (origin at the top left corner, pixel centres at +0.5). The depth in µm is
measured from the face that collects charge. A track starts at a point in a direction (theta, phi). theta is
measured from the inward normal, phi from +x towards +y. A particle from behind leaves the same track, so all tracks
start at the collecting face.

The drawn tracks are kept as plain numbers. The charge in each pixel follows from these numbers alone: fluctuations
along a track come from a hash of the track's stored seed.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import ndtr, ndtri

from ..core import hashing

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

# Omnidirectional proton flux per cm² of a sphere's cross-section: CREME96 at the Sun-Earth point L2, without
# shielding; behind 11 mm of aluminium it is 4.32.
FLUX_UNSHIELDED_CM2_S = 4.67

PAIR_ENERGY_EV = 3.65  # mean energy per electron-hole pair in silicon at 300 K

# Width parameter of Landau's distribution per length: ξ = ½ K (Z/A) ρ / β² with K = 0.307075 MeV cm² mol⁻¹
# (Particle Data Group, "Passage of particles through matter"), Z/A = 14/28.0855 mol/g and ρ = 2.329 g/cm³
# (silicon), β = 1.
XI_EV_PER_UM = 0.5 * 0.307075e6 * (14 / 28.0855) * 2.329 * 1e-4
XI_E_PER_UM = XI_EV_PER_UM / PAIR_ENERGY_EV  # 4.88

PROTON_MEV, ELECTRON_MEV = 938.27209, 0.51099895  # rest energies, CODATA 2018

# Values of silicon from the Particle Data Group's table of the density effect (Sternheimer, Berger & Seltzer 1984).
_EXCITATION_EV = 173.0
_STERNHEIMER = {"x0": 0.2015, "x1": 2.8716, "c": 4.4355, "a": 0.14921, "k": 3.2546}

MOYAL_MEAN = float(np.euler_gamma) + math.log(2)  # mean of the standard Moyal distribution

_SIGMAS = 4.0  # diffused charge is cut at this many standard deviations
# With diffusion, a track is divided into at least this many steps per pixel, and per thickness of the layer because
# the spread changes with depth.
_STEPS_PER_PIXEL = 4
_STEPS_PER_DEPTH = 8


def stopping_power_MeV_cm2_g(energy_MeV: ArrayLike) -> F64:
    """Return the mean energy that a proton of 1 MeV to 100 GeV leaves in silicon per g/cm², float64.

    This is Bethe's formula with the density effect (Particle Data Group, "Passage of particles through matter").
    `energy_MeV` is the kinetic energy.
    """
    gamma = 1 + np.asarray(energy_MeV, dtype=np.float64) / PROTON_MEV
    square = 1 - gamma**-2  # β²
    p2 = square * gamma**2
    ratio = ELECTRON_MEV / PROTON_MEV
    most_MeV = 2 * ELECTRON_MEV * p2 / (1 + 2 * gamma * ratio + ratio**2)  # largest transfer to one electron
    s, x = _STERNHEIMER, np.log10(p2) / 2
    density = np.where(x < s["x0"], 0.0, 2 * math.log(10) * x - s["c"])
    density += np.where((x >= s["x0"]) & (x < s["x1"]), s["a"] * np.maximum(s["x1"] - x, 0) ** s["k"], 0.0)
    bracket = np.log(2 * ELECTRON_MEV * p2 * most_MeV / (_EXCITATION_EV * 1e-6) ** 2) / 2 - square - density / 2
    return np.asarray(0.307075 * (14 / 28.0855) / square * bracket)


LEAST_MEV_CM2_G = 1.664  # minimum ionisation, at about 2.5 GeV (Particle Data Group)


@dataclass(frozen=True, kw_only=True, eq=False)
class CosmicRays:
    """Hold the tracks of one exposure. Every field is float64[n], except `seed`.

    Attributes
    ----------
    x_px, y_px, depth_um
        Start of the track.
    theta_deg, phi_deg
        Direction, 0 to 180 and 0 to 360 degrees.
    length_um
        Length within the layer.
    electrons
        Electrons set free along this length.
    seed
        Seed of the fluctuations along the track, uint32[n].
    """

    x_px: F64
    y_px: F64
    depth_um: F64
    theta_deg: F64
    phi_deg: F64
    length_um: F64
    electrons: F64
    seed: NDArray[np.uint32]

    def __len__(self) -> int:
        return len(self.x_px)

    @property
    def params(self) -> list[dict[str, float]]:
        """Return one dict of plain numbers per track, for JSON. `from_params` restores every bit."""
        columns = {name: value.tolist() for name, value in vars(self).items()}
        return [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]

    @classmethod
    def from_params(cls, params: Sequence[Mapping[str, Any]]) -> CosmicRays:
        """Return the tracks from a list that `params` gave."""
        columns: dict[str, Any] = {
            name: np.array([row[name] for row in params], dtype=np.uint32 if name == "seed" else np.float64)
            for name in (f.name for f in fields(cls))
        }
        return cls(**columns)


@dataclass(frozen=True, kw_only=True)
class CosmicRayModel:
    """Describe the rate, geometry and ionisation of cosmic rays.

    Attributes
    ----------
    pixel_pitch_um
        Pixel pitch, above 0.
    thickness_um
        Thickness of the sensitive layer, above 0. The default is assumed.
    flux_per_cm2_s
        Omnidirectional flux per cross-section of a sphere. A plane receives half of it, both sides together.
    electrons_per_um
        Mean number of electrons per µm of track, above 0.
    width_e_per_um
        Width of the fluctuation, per µm. A track's total follows Moyal's distribution (Moyal 1955, Phil. Mag. 46,
        263) of this width times the length. This is the usual closed form for Landau's distribution, with a lighter
        tail. Every pixel's part fluctuates likewise before the parts are scaled to the total. Below about 50 µm of
        silicon real distributions are wider.
    diffusion_um
        Gaussian σ of charge from the far face when it is collected. Charge from depth z has √(z/thickness) of this
        (drift in a constant field).
    least_diffusion_um
        σ that charge from all depths has besides. Both 0 switch diffusion off.
    """

    pixel_pitch_um: float
    thickness_um: float = 10.0
    flux_per_cm2_s: float = FLUX_UNSHIELDED_CM2_S
    electrons_per_um: float = 80.0
    width_e_per_um: float = XI_E_PER_UM
    diffusion_um: float = 0.0
    least_diffusion_um: float = 0.0

    def expected_count(self, shape: tuple[int, int], exposure_s: float) -> float:
        """Return the mean number of tracks on a (height, width) sensor: flux/2 × area × time."""
        area_cm2 = shape[0] * shape[1] * (self.pixel_pitch_um * 1e-4) ** 2
        return 0.5 * self.flux_per_cm2_s * area_cm2 * exposure_s

    def draw(self, shape: tuple[int, int], exposure_s: float, rng: np.random.Generator) -> CosmicRays:
        """Draw the tracks of one exposure of `exposure_s` on a (height, width) sensor.

        `exposure_s` may include the readout. The number of tracks is Poisson distributed. The directions through a
        plane have the density ∝ cosθ sinθ. Azimuth and position are uniform. A track is thickness/cosθ long, or
        ends at the sensor's edge. Tracks that enter through the narrow sides are left out.
        """
        count = int(rng.poisson(self.expected_count(shape, exposure_s)))
        x, y, sin2, turn = rng.random((count, 4)).T
        moyal = -np.log(np.maximum(rng.standard_normal(count) ** 2, 1e-15))
        seed = rng.integers(2**32, size=count, dtype=np.uint32)
        x, y = x * shape[1], y * shape[0]
        theta, phi = np.arcsin(np.sqrt(sin2)), 2 * np.pi * turn
        length = self._inside(shape, x, y, np.zeros(count), theta, phi, np.full(count, np.inf))
        return CosmicRays(
            x_px=x,
            y_px=y,
            depth_um=np.zeros(count),
            theta_deg=np.degrees(theta),
            phi_deg=np.degrees(phi),
            length_um=length,
            electrons=length * (self.electrons_per_um + self.width_e_per_um * (moyal - MOYAL_MEAN)),
            seed=seed,
        )

    def deposit(self, rays: CosmicRays, shape: tuple[int, int]) -> tuple[I64, F32]:
        """Return the charge per pixel of the tracks on a (height, width) sensor.

        A track is cut where it crosses pixel borders, so each pixel gets its exact chord. Charge outside the sensor
        is left out. The result depends only on the arguments.

        Returns
        -------
        index
            Flat pixel indices y · width + x, int64[m], in increasing order.
        electrons
            Electrons in these pixels, float32[m].
        """
        height, width = shape
        theta, phi = np.radians(rays.theta_deg), np.radians(rays.phi_deg)
        start = np.stack([rays.x_px, rays.y_px])
        across = rays.length_um * np.sin(theta) / self.pixel_pitch_um
        step = np.stack([across * np.cos(phi), across * np.sin(phi)])
        end = self._inside(shape, rays.x_px, rays.y_px, rays.depth_um, theta, phi, rays.length_um)
        end = np.divide(end, rays.length_um, out=np.zeros_like(end), where=rays.length_um > 0)

        track, a, b = _pieces(start, step, end)
        chord_um = (b - a) * rays.length_um[track]
        weight = chord_um * self._local_e_per_um(rays.seed[track], _rank(track))
        total = np.bincount(track, weight, minlength=len(rays))
        electrons = weight * (rays.electrons * end / np.where(total > 0, total, 1))[track]
        if not (self.diffusion_um or self.least_diffusion_um):
            x, y = start[:, track] + step[:, track] * (a + b) / 2
            # rounding may put the middle of a piece on the far border
            column = np.clip(np.floor(x).astype(np.int64), 0, width - 1)
            row = np.clip(np.floor(y).astype(np.int64), 0, height - 1)
            return _gather(row * width + column, electrons)

        slant = (rays.length_um * np.cos(theta))[track]
        moved = np.hypot(*step[:, track]) * (b - a)
        parts = np.ceil(
            np.maximum(moved * _STEPS_PER_PIXEL, np.abs(slant) * (b - a) / self.thickness_um * _STEPS_PER_DEPTH)
        )
        parts = np.maximum(parts, 1).astype(np.int64)
        piece = np.repeat(np.arange(len(track)), parts)
        middle = (a + (b - a) / parts * 0.5)[piece] + ((b - a) / parts)[piece] * _rank(piece)
        track = track[piece]
        x, y = start[:, track] + step[:, track] * middle
        depth = np.clip(rays.depth_um[track] + slant[piece] * middle, 0, self.thickness_um)
        sigma = np.hypot(self.least_diffusion_um, self.diffusion_um * np.sqrt(depth / self.thickness_um))
        return _spread(x, y, sigma / self.pixel_pitch_um, (electrons / parts)[piece], shape)

    def _inside(
        self, shape: tuple[int, int], x: F64, y: F64, depth: F64, theta: F64, phi: F64, length_um: F64
    ) -> F64:
        """Return the distance in µm that a track runs until it leaves the layer or the sensor, or ends."""
        sine = np.sin(theta) / self.pixel_pitch_um
        end = length_um
        for position, rate, far in (
            (x, sine * np.cos(phi), shape[1]),
            (y, sine * np.sin(phi), shape[0]),
            (depth, np.cos(theta), self.thickness_um),
        ):
            wall = np.where(rate > 0, far - position, -position)
            room = np.divide(wall, rate, out=np.full(len(position), np.inf), where=rate != 0)
            end = np.minimum(end, np.maximum(room, 0))
        return end

    def _local_e_per_um(self, seed: NDArray[np.uint32], number: I64) -> F64:
        """Return the ionisation of the n-th piece of a track in e/µm, before it is scaled to the track's total."""
        u = _hash_uniform((seed.astype(np.uint64) << np.uint64(32)) + number.astype(np.uint64))
        moyal = -2 * np.log(-ndtri(u / 2))  # −ln z², z a standard normal variate
        return self.electrons_per_um + self.width_e_per_um * (moyal - MOYAL_MEAN)


def _rank(group: I64) -> I64:
    """Return the number of each entry within its group. Entries of a group are adjacent."""
    index = np.arange(len(group))
    first = np.ones(len(group), dtype=bool)
    first[1:] = group[1:] != group[:-1]
    return index - np.maximum.accumulate(np.where(first, index, 0))


def _pieces(start: F64, step: F64, end: F64) -> tuple[I64, F64, F64]:
    """Cut tracks into pieces that lie within one pixel each.

    Returns the track of each piece and both its ends, as fractions of the track's length. `start` and `step` are
    float64[2, n] in pixels; `end` float64[n] is the fraction of each track to cut.
    """
    tracks = np.arange(len(end))
    groups, cuts = [tracks, tracks], [np.zeros(len(end)), end]
    for position, rate in zip(start, step, strict=True):
        here, there = np.floor(position).astype(np.int64), np.floor(position + rate * end).astype(np.int64)
        group = np.repeat(tracks, np.abs(there - here))
        # a track towards larger coordinates meets the pixel's upper border first, else its lower border
        rank = _rank(group)
        border = here[group] + np.where(rate[group] > 0, 1 + rank, -rank)
        groups.append(group)
        cuts.append(np.clip((border - position[group]) / rate[group], 0, end[group]))
    track, cut = np.concatenate(groups), np.concatenate(cuts)
    order = np.lexsort((cut, track))
    track, cut = track[order], cut[order]
    kept = (track[1:] == track[:-1]) & (cut[1:] > cut[:-1])
    return track[1:][kept], cut[:-1][kept], cut[1:][kept]


def _hash_uniform(key: NDArray[np.uint64]) -> F64:
    """Return uniform 24 bit numbers in (0, 1) from keys."""
    z = hashing.mixed((key + np.uint64(1)) * hashing.STEP)
    return ((z >> np.uint64(40)).astype(np.float64) + 0.5) * 2.0**-24


def _gather(index: I64, electrons: F64) -> tuple[I64, F32]:
    """Return the unique indices in increasing order, and the sum of the electrons of each."""
    unique, number = np.unique(index, return_inverse=True)
    return unique, np.bincount(number, electrons, minlength=len(unique)).astype(np.float32)


def _spread(x: F64, y: F64, sigma_px: F64, electrons: F64, shape: tuple[int, int]) -> tuple[I64, F32]:
    """Spread points of charge as Gaussians integrated over pixels.

    The Gaussians are cut at `_SIGMAS` and scaled to keep the charge. Returns as `_gather` does.
    """
    reach = math.ceil(_SIGMAS * float(sigma_px.max(initial=0.0)))
    offset = np.arange(-reach, reach + 2)
    parts = []
    for position in (x, y):
        border = np.floor(position)[:, None] + offset - position[:, None]
        fraction = np.diff(ndtr(border / np.maximum(sigma_px, 1e-6)[:, None]), axis=1)
        parts.append(fraction / fraction.sum(axis=1, keepdims=True))
    pixels = [np.floor(position).astype(np.int64)[:, None] + offset[:-1] for position in (x, y)]
    charge = electrons[:, None, None] * parts[1][:, :, None] * parts[0][:, None, :]
    column, row = pixels[0][:, None, :], pixels[1][:, :, None]
    inside = (column >= 0) & (column < shape[1]) & (row >= 0) & (row < shape[0])
    return _gather((row * shape[1] + column)[inside], charge[inside])
