"""Compute the paraxial optics of a prescription: focal length, focus, pupils and f-number.

A ray is the vector (height, slope) in a plane through the axis; each step through the lens is a 2 × 2 matrix.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache, reduce

import numpy as np
from numpy.typing import NDArray

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
