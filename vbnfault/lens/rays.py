"""Trace exact rays through a prescription in double precision, straight through or along any path of reflections.

Coordinates of the lens: z runs backwards along the axis from the first vertex, x and y lie across it. This tracer
is the reference by which faster tracers are tested, and it makes the drawings. Beside it stands what coatings and
glass let pass along a path.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .coating import reflect_transmit
from .glass import D_NM
from .paraxial import paraxial_properties
from .prescription import Prescription, Surface

F64 = NDArray[np.float64]

_NEWTON_STEPS = 12


@dataclass(frozen=True, kw_only=True)
class Path:
    """Hold the trajectories of n rays.

    Attributes
    ----------
    points_mm
        float64[step + 2, n, 3]: where each ray started, met each surface of the path, and met the sensor plane; nan
        after a surface that it missed or that totally reflected it.
    directions
        float64[n, 3]: unit vectors at the sensor plane.
    relative_radius
        float64[n]: largest distance from the axis at any surface, in semi-diameters of that surface. Above 1 the
        ray was lost at a rim; it is inf where the ray missed a surface. The blades of a stop are ignored, since the
        stop counts as round here.
    rows
        The surface that each step met.
    """

    points_mm: F64
    directions: F64
    relative_radius: F64
    rows: tuple[int, ...]

    @property
    def arrives(self) -> NDArray[np.bool_]:
        """Return which rays passed all rims and travel towards the sensor at the end, bool[n]."""
        there = np.isfinite(self.points_mm[-1, :, 0]) & (self.directions[:, 2] > 0)
        return np.asarray(there & (self.relative_radius <= 1))


def path_of(lens: Prescription, route: Sequence[int] = ()) -> tuple[tuple[int, bool], ...]:
    """Return the (row, whether it reflects) of each surface met, for a route of reflections.

    `route` lists the reflecting rows in the order met: the first reflects backwards, the second forwards, and so
    on. The sensor is the row behind the last surface.
    """
    out: list[tuple[int, bool]] = []
    at, onward = -1, True
    for row in route:
        between = range(at + 1, row) if onward else range(at - 1, row, -1)
        out += [*((k, False) for k in between), (row, True)]
        at, onward = row, not onward
    return (*out, *((k, False) for k in range(at + 1, len(lens.surfaces))))


def forward(lens: Prescription) -> tuple[tuple[int, bool], ...]:
    """Return the path of the image: every row once, no reflection."""
    return path_of(lens)


def ghost(lens: Prescription, first: int, second: int) -> tuple[tuple[int, bool], ...]:
    """Return the path of a ghost: backwards at row `second`, forwards again at row `first` < `second`."""
    return path_of(lens, (second, first))


def trace(
    lens: Prescription,
    origins_mm: ArrayLike,
    directions: ArrayLike,
    *,
    path: Sequence[tuple[int, bool]] | None = None,
    wavelength_nm: float = D_NM,
    sensor_mm: float | None = None,
) -> Path:
    """Trace rays along a path that gives the order of surfaces.

    Parameters
    ----------
    origins_mm, directions
        float64[n, 3], in front of the lens; directions need not have length 1.
    path
        (row, whether it reflects) of each surface in the order met; default: straight through.
    sensor_mm
        Distance of the sensor plane behind the last vertex; default: the paraxial focus at the d line.
    """
    steps = forward(lens) if path is None else tuple(path)
    vertex, index = lens.vertices_mm, lens.indices(wavelength_nm)
    sensor = paraxial_properties(lens).bfd_mm if sensor_mm is None else sensor_mm
    # vectors are held by component, [3, n]: numpy is slow where it works on groups of three numbers
    p = np.array(np.reshape(origins_mm, (-1, 3)).T, dtype=np.float64, order="C")
    d = np.array(np.reshape(directions, (-1, 3)).T, dtype=np.float64, order="C")
    d /= np.sqrt(_dot(d, d))
    points, radius = [p.copy()], np.zeros(p.shape[1])
    onward = True
    for row, mirror in steps:
        surface = lens.surfaces[row]
        p[2] -= vertex[row]
        p, normal = _meet(surface, p, d)
        beyond = np.hypot(p[0], p[1]) / surface.semi_diameter_mm
        radius = np.maximum(radius, np.where(np.isnan(beyond), np.inf, beyond))
        p[2] += vertex[row]
        points.append(p.copy())
        along = _dot(normal, d)
        normal *= np.where(along > 0, -1.0, 1.0)  # against the ray
        cosine = np.abs(along)
        if mirror:
            d, onward = d + 2 * cosine * normal, not onward
            continue
        eta = index[row] / index[row + 1] if onward else index[row + 1] / index[row]
        with np.errstate(invalid="ignore"):
            d = eta * d + (eta * cosine - np.sqrt(1 - eta * eta * (1 - cosine * cosine))) * normal
    away = (vertex[-1] + sensor - p[2]) / d[2]
    points.append(p + away * d)
    return Path(
        points_mm=np.stack(points).transpose(0, 2, 1),
        directions=d.T,
        relative_radius=radius,
        rows=tuple(row for row, _ in steps),
    )


def _dot(a: F64, b: F64) -> F64:
    """Return the scalar products of vectors float64[3, n], float64[n]."""
    return np.asarray(a[0] * b[0] + a[1] * b[1] + a[2] * b[2])


def _meet(surface: Surface, p: F64, d: F64) -> tuple[F64, F64]:
    """Return where rays meet a surface with its vertex at the origin, and the unit normals; nan for a miss.

    All are float64[3, n].
    """
    c, k = surface.curvature_per_mm, 1 + surface.conic
    x, y = p[:2] - (p[2] / d[2]) * d[:2]  # in the plane of the vertex
    a = c * (d[0] ** 2 + d[1] ** 2 + k * d[2] ** 2)
    b = c * (x * d[0] + y * d[1]) - d[2]
    e = c * (x**2 + y**2)
    with np.errstate(invalid="ignore"):
        t = e / (-b + np.sign(d[2]) * np.sqrt(b * b - a * e))
    hit = t * d
    hit[0] += x
    hit[1] += y
    if surface.aspheric_mm:
        for _ in range(_NEWTON_STEPS):
            off = surface.sag_mm(np.hypot(hit[0], hit[1])) - hit[2]
            hit = hit - (off / _dot(_slope(surface, hit), d)) * d
        normal = _slope(surface, hit)
    else:
        normal = np.stack([c * hit[0], c * hit[1], c * k * hit[2] - 1])
    normal /= np.sqrt(_dot(normal, normal))
    return hit, normal


def _slope(surface: Surface, hit: F64) -> F64:
    """Return the gradient of (sag - z) at points of an asphere, which is normal to it, float64[3, n]."""
    c, k = surface.curvature_per_mm, 1 + surface.conic
    r2 = hit[0] ** 2 + hit[1] ** 2
    with np.errstate(invalid="ignore"):
        per_r = c / np.sqrt(1 - k * c * c * r2)
    for n, coefficient in enumerate(surface.aspheric_mm):
        per_r = per_r + (2 * n + 4) * coefficient * r2 ** (n + 1)
    return np.stack([per_r * hit[0], per_r * hit[1], np.full_like(r2, -1.0)])


def transmittance(lens: Prescription, path: Sequence[tuple[int, bool]], wavelength_nm: ArrayLike = D_NM) -> F64:
    """Return the fraction of the light that takes a path, for normal incidence on every surface.

    The result is float64 like `wavelength_nm`.
    """
    nm = np.asarray(wavelength_nm, dtype=np.float64)
    index = [np.ones(nm.shape), *(surface.medium.index(nm) for surface in lens.surfaces)]
    fraction, turn = np.ones(nm.shape), 1
    for row, mirror in path:
        if row == len(lens.surfaces):
            fraction = fraction * lens.sensor_reflectance
        else:
            # films that absorb reflect otherwise from behind; at normal incidence both polarisations are alike
            films, (front, back) = lens.surfaces[row].coating[::turn], index[row : row + 2][::turn]
            reflected, _, passed, _ = reflect_transmit(films, front, back, 1.0, nm)
            fraction = fraction * (reflected if mirror else passed)
        turn *= -1 if mirror else 1
    return fraction


def axial_transmittance(lens: Prescription, wavelength_nm: ArrayLike) -> F64:
    """Return the fraction of the axial light that coatings and glass transmit, float64[band].

    It multiplies the image of a scene and the direct image of the Sun alike. It excludes reflected light. Ghosts
    are part of that light, so they are not subtracted from the direct image a second time.
    """
    nodes = np.atleast_1d(np.asarray(wavelength_nm, dtype=np.float64))
    return np.array(_axial_transmittance(lens, tuple(nodes.tolist())))


@lru_cache(maxsize=64)
def _axial_transmittance(lens: Prescription, wavelength_nm: tuple[float, ...]) -> tuple[float, ...]:
    """Return `axial_transmittance`, which every exposure and every direct image of the Sun needs."""
    nm = np.array(wavelength_nm)
    depth = sum((s.thickness_mm * s.absorption_per_mm(nm) for s in lens.surfaces[:-1]), np.zeros(len(nm)))
    return tuple((transmittance(lens, forward(lens), nm) * np.exp(-depth)).tolist())


def real_pupil_diameter_mm(lens: Prescription, wavelength_nm: float = D_NM) -> float:
    """Return the diameter of the axial beam that fills the stop, from exact rays instead of the paraxial pupil."""
    most = lens.surfaces[0].semi_diameter_mm
    height = np.linspace(0, most, 513)
    stop = lens.stop
    rays = np.column_stack([height, np.zeros_like(height), np.full_like(height, -1.0)])
    path = trace(lens, rays, np.tile([0.0, 0.0, 1.0], (len(height), 1)), wavelength_nm=wavelength_nm)
    at_stop = np.abs(path.points_mm[1 + stop, :, 0])
    # far outside the beam, rays bend back towards the axis or miss a surface
    outwards = np.concatenate([[True], np.diff(at_stop) > 0])
    usable = len(height) if outwards.all() else int(np.argmin(outwards))
    return float(2 * np.interp(lens.surfaces[stop].semi_diameter_mm, at_stop[:usable], height[:usable]))
