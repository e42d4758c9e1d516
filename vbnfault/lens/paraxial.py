"""Compute the paraxial optics of a prescription: focal length, focus, pupils and f-number.

A ray is the vector (height, slope) in a plane through the axis; each step through the lens is a 2 × 2 matrix.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache, reduce
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..core.errors import InputError
from .glass import D_NM
from .prescription import Prescription

F64 = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class ParaxialProperties:
    """Hold the paraxial properties of a lens, lengths in mm.

    Attributes
    ----------
    efl_mm, bfd_mm
        Effective focal length, and back focal distance: from the last vertex to the focus of a far object.
    entrance_pupil_mm, entrance_pupil_diameter_mm
        Position behind the first vertex, and diameter, of the stop's image seen from the front.
    exit_pupil_mm, exit_pupil_diameter_mm
        Position behind the last vertex (negative: in front of it), and diameter, of the stop's image seen from
        behind.
    f_number
        `efl_mm` divided by the diameter of the entrance pupil.
    """

    efl_mm: float
    bfd_mm: float
    entrance_pupil_mm: float
    entrance_pupil_diameter_mm: float
    exit_pupil_mm: float
    exit_pupil_diameter_mm: float
    f_number: float


def gap(length_mm: float) -> F64:
    """Return the matrix of a distance in one medium."""
    return np.array([[1.0, length_mm], [0.0, 1.0]])


def refraction(before: float, after: float, curvature_per_mm: float) -> F64:
    """Return the matrix of a refracting surface between two indices."""
    return np.array([[1.0, 0.0], [(before - after) * curvature_per_mm / after, before / after]])


def system(lens: Prescription, first: int, last: int, wavelength_nm: float = D_NM) -> F64:
    """Return the matrix from just before row `first` to just behind row `last`; the identity where first > last."""
    index = lens.indices(wavelength_nm)
    steps: list[F64] = []
    for k in range(first, last + 1):
        if steps:
            steps.append(gap(lens.surfaces[k - 1].thickness_mm))
        steps.append(refraction(index[k], index[k + 1], lens.surfaces[k].curvature_per_mm))
    return np.asarray(reduce(lambda total, step: step @ total, steps, np.eye(2)))


@lru_cache(maxsize=256)
def paraxial_properties(lens: Prescription, wavelength_nm: float = D_NM) -> ParaxialProperties:
    """Return the paraxial properties of a lens at a wavelength.

    Raises
    ------
    InputError
        The lens has no focus behind it.
    """
    last, stop = len(lens.surfaces) - 1, lens.stop
    whole = system(lens, 0, last, wavelength_nm)
    if abs(whole[1, 0]) < 1e-12:
        raise InputError(f"{lens.name}: surface 0 to {last}: the lens has no focal length (it is afocal)")
    efl, bfd = float(-1 / whole[1, 0]), float(-whole[0, 0] / whole[1, 0])
    if efl <= 0 or bfd <= 0:
        raise InputError(
            f"{lens.name}: surface {last}: no ray reaches the sensor: EFL {efl:.4g} mm, back focal distance "
            f"{bfd:.4g} mm; both must be above 0"
        )
    radius = lens.surfaces[stop].semi_diameter_mm
    front = system(lens, 0, stop - 1, wavelength_nm)
    if stop:
        front = gap(lens.surfaces[stop - 1].thickness_mm) @ front
    back = system(lens, stop, last, wavelength_nm)
    entrance_diameter = float(2 * abs(radius / front[0, 0]))
    return ParaxialProperties(
        efl_mm=efl,
        bfd_mm=bfd,
        entrance_pupil_mm=float(front[0, 1] / front[0, 0]),
        entrance_pupil_diameter_mm=entrance_diameter,
        exit_pupil_mm=float(-back[0, 1] / back[1, 1]) + 0.0,  # a stop in the last row: 0, not -0
        exit_pupil_diameter_mm=float(2 * abs(radius * np.linalg.det(back) / back[1, 1])),
        f_number=efl / entrance_diameter,
    )


def scaled_to_focal_length(lens: Prescription, efl_mm: float) -> Prescription:
    """Return the lens scaled to a focal length at the d line.

    `Prescription.scaled` lists what keeps its size.
    """
    return lens.scaled(efl_mm / paraxial_properties(lens).efl_mm)


def scaled_to_field(lens: Prescription, fov_deg: float, sensor_mm: float) -> Prescription:
    """Return the lens scaled so that a sensor of this width sees the full field `fov_deg`.

    Distortion is not taken into account. `Prescription.scaled` lists what keeps its size.
    """
    return scaled_to_focal_length(lens, sensor_mm / 2 / float(np.tan(np.radians(fov_deg / 2))))


# --- paths with reflections ---------------------------------------------------------------------------------------


def mirrors(lens: Prescription) -> tuple[int, ...]:
    """Return the rows that reflect: not the stop, nor a surface with the same medium on both sides."""
    index = lens.indices()
    return tuple(k for k in range(len(lens.surfaces)) if index[k] != index[k + 1])


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
    index, vertex = _media(lens, tuple(wavelength.ravel().tolist()))
    # plain numbers for one wavelength: many times faster than arrays of one
    index = index[:, 0].tolist() if wavelength.ndim == 0 else index.reshape(len(index), *wavelength.shape)
    curvatures = [*(s.curvature_per_mm for s in lens.surfaces), 0.0]
    # a height or slope is this pair of factors times height and slope in the plane of the first vertex
    (h0, h1), (s0, s1) = (1.0, 0.0), (0.0, 1.0)
    met, onward, before = [], True, 0
    for row, mirror in path:
        gap = abs(vertex[row] - vertex[before])
        h0, h1 = h0 + gap * s0, h1 + gap * s1
        met.append(_matrix(wavelength, h0, h1, s0, s1))
        sense = curvatures[row] if onward else -curvatures[row]
        if mirror:
            bend = 2 * sense
            s0, s1, onward = s0 + bend * h0, s1 + bend * h1, not onward
        else:
            into, out = (index[row], index[row + 1]) if onward else (index[row + 1], index[row])
            power, ratio = (into - out) * sense / out, into / out
            s0, s1 = power * h0 + ratio * s0, power * h1 + ratio * s1
        before = row
    gap = vertex[-1] - vertex[before]
    return _matrix(wavelength, h0 + gap * s0, h1 + gap * s1, s0, s1), np.array(met)


def _matrix(wavelength: F64, h0: Any, h1: Any, s0: Any, s1: Any) -> Any:
    """Return matrices of the rows (h0, h1) and (s0, s1), float64[..., 2, 2]."""
    if wavelength.ndim == 0:
        return np.array(((h0, h1), (s0, s1)))
    parts = np.broadcast_arrays(h0, h1, s0, s1, wavelength)[:4]
    return np.stack(parts, axis=-1).reshape(*wavelength.shape, 2, 2)


@lru_cache(maxsize=32)
def _media(lens: Prescription, wavelength_nm: tuple[float, ...]) -> tuple[F64, F64]:
    """Return the indices of all media, float64[row + 1, wavelength], and the vertices with that of the sensor."""
    wavelength = np.array(wavelength_nm)
    index = np.stack([np.ones(wavelength.shape), *(s.medium.index(wavelength) for s in lens.surfaces)])
    vertex = np.append(lens.vertices_mm, lens.vertices_mm[-1] + paraxial_properties(lens).bfd_mm)
    for array in (index, vertex):
        array.setflags(write=False)
    return index, vertex
