"""Compute ghosts of paraxial rays: each path of two reflections is one matrix (Lee & Eisemann 2013, CGF 32, 1).

A ghost's ray leaves the plane of the first vertex at the height r with the Sun's slope θ. It meets surface k of its
path at the height A_k r + B_k θ, and the sensor at M₀₀ r + M₀₁ θ. Slopes are unfolded at reflections, so heights
keep their sign. Each rim passes the rays of one disc in the entrance plane; a ray is lost (clipped) outside this
disc. The ghost is the image of the overlap of these discs, magnified by M₀₀.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import combinations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...core.spectra import Bands, hat_weights
from ..glass import D_NM
from ..paraxial import paraxial_properties
from ..prescription import Prescription
from ..rays import ghost, transmittance

F64 = NDArray[np.float64]

AT_D_LINE = Bands.lines(D_NM)
_GRID = 129  # sample points across the smallest disc


@dataclass(frozen=True, kw_only=True)
class Ghost:
    """Describe one ghost of a far point source.

    Attributes
    ----------
    pair
        The reflecting rows, the one nearer the front first.
    flux_fraction
        Flux on the unbounded sensor plane over (source irradiance × cos(angle) × area of the paraxial entrance
        pupil at the d line).
    centroid_mm, rms_radius_mm
        Position of the centroid on the sensor, from the axis, and flux-weighted rms radius about it.
    peak_irradiance_fraction
        Peak irradiance over the source's irradiance at the entrance.
    """

    pair: tuple[int, int]
    flux_fraction: float
    centroid_mm: tuple[float, float]
    rms_radius_mm: float
    peak_irradiance_fraction: float


def mean_ghost(rows: Sequence[tuple[float, Ghost]]) -> Ghost:
    """Return the mean over wavelengths of one ghost, from (fraction of the entering light, ghost) for each."""
    fraction = np.array([weight for weight, _ in rows])
    flux = fraction * [ghost.flux_fraction for _, ghost in rows]
    centroids = np.array([ghost.centroid_mm for _, ghost in rows])
    centre = flux @ centroids / flux.sum()
    square = [
        g.rms_radius_mm**2 + float(((p - centre) ** 2).sum()) for (_, g), p in zip(rows, centroids, strict=True)
    ]
    return replace(
        rows[0][1],
        flux_fraction=float(flux.sum()),
        centroid_mm=(float(centre[0]), float(centre[1])),
        rms_radius_mm=float(np.sqrt(flux @ square / flux.sum())),
        peak_irradiance_fraction=float(fraction @ [ghost.peak_irradiance_fraction for _, ghost in rows]),
    )


def mirrors(lens: Prescription) -> tuple[int, ...]:
    """Return the rows that reflect: not the stop, nor a surface with the same medium on both sides."""
    index = lens.indices()
    return tuple(k for k in range(len(lens.surfaces)) if index[k] != index[k + 1])


def pairs(lens: Prescription) -> tuple[tuple[int, int], ...]:
    """Return all pairs of reflecting rows, n (n - 1) / 2 of them.

    A sensor that reflects is the row behind the last surface.
    """
    rows = (*mirrors(lens), *((len(lens.surfaces),) if lens.sensor_reflectance else ()))
    return tuple(combinations(rows, 2))


def along(lens: Prescription, path: Sequence[tuple[int, bool]], wavelength_nm: ArrayLike = D_NM) -> tuple[F64, F64]:
    """Return the matrices of a path from the plane of the first vertex.

    Parameters
    ----------
    path
        (row, whether it reflects) of each surface met; the sensor is the row behind the last surface.
    wavelength_nm
        Of any shape, written ... below.

    Returns
    -------
    matrix : float64[..., 2, 2]
        To the sensor.
    met : float64[step, ..., 2, 2]
        To each surface met.
    """
    wavelength = np.asarray(wavelength_nm, dtype=np.float64)
    if wavelength.ndim == 0:
        return _along_at(lens, path, float(wavelength))
    flat, vertex = _media(lens, tuple(wavelength.ravel().tolist()))
    index = flat.reshape(len(flat), *wavelength.shape)
    height, slope = (np.broadcast_to(row, (*wavelength.shape, 2)).copy() for row in np.eye(2))
    met, onward, before = [], True, 0
    for row, mirror in path:
        height = height + abs(vertex[row] - vertex[before]) * slope
        met.append(np.stack([height, slope], axis=-2))
        curvature = lens.surfaces[row].curvature_per_mm if row < len(lens.surfaces) else 0.0
        sense = curvature if onward else -curvature
        if mirror:
            slope, onward = slope + 2 * sense * height, not onward
        else:
            into, out = (index[row], index[row + 1]) if onward else (index[row + 1], index[row])
            slope = ((into - out) * sense / out)[..., None] * height + (into / out)[..., None] * slope
        before = row
    height = height + (vertex[-1] - vertex[before]) * slope
    return np.stack([height, slope], axis=-2), np.stack(met)


def _along_at(lens: Prescription, path: Sequence[tuple[int, bool]], wavelength_nm: float) -> tuple[F64, F64]:
    """Return `along` for one wavelength, with plain numbers: many times faster than arrays of two."""
    index, vertex = (v.tolist() for v in _media(lens, (wavelength_nm,)))
    curvatures = [*(s.curvature_per_mm for s in lens.surfaces), 0.0]
    (h0, h1), (s0, s1) = (1.0, 0.0), (0.0, 1.0)
    met, onward, before = [], True, 0
    for row, mirror in path:
        gap = abs(vertex[row] - vertex[before])
        h0, h1 = h0 + gap * s0, h1 + gap * s1
        met.append(((h0, h1), (s0, s1)))
        sense = curvatures[row] if onward else -curvatures[row]
        if mirror:
            bend = 2 * sense
            s0, s1, onward = s0 + bend * h0, s1 + bend * h1, not onward
        else:
            into, out = (index[row][0], index[row + 1][0]) if onward else (index[row + 1][0], index[row][0])
            power, ratio = (into - out) * sense / out, into / out
            s0, s1 = power * h0 + ratio * s0, power * h1 + ratio * s1
        before = row
    gap = vertex[-1] - vertex[before]
    return np.array(((h0 + gap * s0, h1 + gap * s1), (s0, s1))), np.array(met).reshape(-1, 2, 2)


@lru_cache(maxsize=32)
def _media(lens: Prescription, wavelength_nm: tuple[float, ...]) -> tuple[F64, F64]:
    """Return the indices of all media, float64[row + 1, wavelength], and the vertices with that of the sensor."""
    wavelength = np.array(wavelength_nm)
    index = np.stack([np.ones(wavelength.shape), *(s.medium.index(wavelength) for s in lens.surfaces)])
    vertex = np.append(lens.vertices_mm, lens.vertices_mm[-1] + paraxial_properties(lens).bfd_mm)
    for array in (index, vertex):
        array.setflags(write=False)
    return index, vertex


def paraxial_ghosts(
    lens: Prescription,
    sun_deg: float,
    *,
    azimuth_deg: float = 0.0,
    bands: Bands = AT_D_LINE,
    progress: Callable[[int], None] | None = None,
) -> tuple[Ghost, ...]:
    """Return the ghosts of a far point source at an angle from the axis, towards an azimuth (0: +x).

    They are the mean over the only band of `bands`. `progress` is called with 1 after each wavelength.

    A ray is lost (clipped) outside the round rim of any surface, whose radius is `semi_diameter_mm`; blades of the
    stop are ignored. These rims are separate from those of the tracers, which `steps` lists. Ghosts without
    rays are left out.
    """
    hats = bands.weights[0] * hat_weights(bands.nodes_nm, bands.wavelength_nm)
    light = {pair: hats @ transmittance(lens, ghost(lens, *pair), bands.wavelength_nm) for pair in pairs(lens)}
    by_pair: dict[tuple[int, int], list[tuple[float, Ghost]]] = {}
    for node, nm in enumerate(bands.nodes_nm.tolist()):
        for one in _lossless_ghosts(lens, sun_deg, azimuth_deg, nm):
            by_pair.setdefault(one.pair, []).append((float(light[one.pair][node]), one))
        if progress is not None:
            progress(1)
    return tuple(mean_ghost(of) for _, of in sorted(by_pair.items()))


def _lossless_ghosts(lens: Prescription, sun_deg: float, azimuth_deg: float, wavelength_nm: float) -> list[Ghost]:
    """Return the ghosts of surfaces that reflect and transmit all light, at one wavelength."""
    turn = np.radians(azimuth_deg)
    slope = np.tan(np.radians(sun_deg)) * np.array([np.cos(turn), np.sin(turn)])
    pupil = np.pi / 4 * paraxial_properties(lens).entrance_pupil_diameter_mm ** 2
    side = (np.arange(_GRID) + 0.5) / _GRID * 2 - 1
    square = np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2)
    ghosts = []
    for pair in pairs(lens):
        path = ghost(lens, *pair)
        matrix, met = along(lens, path, wavelength_nm)
        # the sensor has no rim
        radii = [*(s.semi_diameter_mm for s in lens.surfaces), np.inf]
        rims = np.array([radii[row] for row, _ in path])
        with np.errstate(divide="ignore"):
            radius = rims / np.abs(met[:, 0, 0])
        least = int(np.argmin(radius))
        middle = -met[least, 0, 1] / met[least, 0, 0] * slope
        positions = middle + radius[least] * square
        heights = met[:, 0, 0, None, None] * positions + met[:, 0, 1, None, None] * slope
        passing = positions[(np.einsum("knc,knc->kn", heights, heights) <= rims[:, None] ** 2).all(axis=0)]
        if not len(passing):
            continue
        on_sensor = matrix[0, 0] * passing + matrix[0, 1] * slope
        centroid = on_sensor.mean(axis=0)
        ghosts.append(
            Ghost(
                pair=pair,
                flux_fraction=len(passing) * (2 * radius[least] / _GRID) ** 2 / pupil,
                centroid_mm=(float(centroid[0]), float(centroid[1])),
                rms_radius_mm=float(np.sqrt(np.mean(np.sum((on_sensor - centroid) ** 2, axis=1)))),
                peak_irradiance_fraction=float(np.cos(np.radians(sun_deg)) / matrix[0, 0] ** 2),
            )
        )
    return ghosts
