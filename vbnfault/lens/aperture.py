"""Measure the f-number of a prescription with exact rays, and close its stop to another f-number.

The f-number is the focal length divided by the diameter of the axial beam that passes all rims (ISO 517). That
diameter is measured with exact rays, so that the irradiance on the axis is exactly π T L / (4 N²). The paraxial
f-number of `paraxial_properties` differs from it by the aberration of the pupil, by some percent for fast lenses.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ..core.errors import InputError
from .glass import D_NM
from .paraxial import paraxial_properties
from .prescription import Prescription
from .rays import trace

F64 = NDArray[np.float64]

LARGEST_F_NUMBER = 200.0

_RAYS = 513  # in each fan
_ROUNDS = 5  # each fan divides the interval that holds the rim by 512: 512⁻⁵ of the first surface's radius at last


def axial_beam_diameter_mm(lens: Prescription, wavelength_nm: float = D_NM) -> float:
    """Return the diameter of the axial beam that passes every rim, the stop included.

    A stop with blades is replaced by a round one of the same area.
    """
    lens = lens.with_round_stop()
    low, high = 0.0, lens.surfaces[0].semi_diameter_mm
    for _ in range(_ROUNDS):
        height = np.linspace(low, high, _RAYS)
        lost = ~_passes(lens, height, wavelength_nm)
        if not lost.any():
            return 2 * high
        first = int(np.argmax(lost))
        if first == 0:
            return 2 * low
        low, high = float(height[first - 1]), float(height[first])
    return low + high


def _passes(lens: Prescription, height_mm: F64, wavelength_nm: float) -> NDArray[np.bool_]:
    """Return which rays parallel to the axis, at these heights, pass every rim, bool[ray]."""
    nothing = np.zeros_like(height_mm)
    origins = np.column_stack(
        [height_mm, nothing, nothing - abs(float(lens.surfaces[0].sag_mm(height_mm[-1]))) - 1]
    )
    along = np.tile([0.0, 0.0, 1.0], (len(height_mm), 1))
    return trace(lens, origins, along, wavelength_nm=wavelength_nm).arrives


def open_f_number(lens: Prescription) -> float:
    """Return the focal length divided by the diameter of the axial beam, with the stop as prescribed."""
    return paraxial_properties(lens).efl_mm / axial_beam_diameter_mm(lens)


def stopped_down(lens: Prescription, f_number: float) -> Prescription:
    """Return the lens with its stop closed until the axial beam has the diameter EFL / `f_number`.

    A lens whose beam is already as narrow is returned unchanged.

    The marginal ray of the wanted beam is traced, and its height at the stop becomes the stop's radius. The result
    therefore does not depend on a number of rays. A stop with blades keeps its shape; its area is that of the round
    stop.
    """
    as_round = lens.with_round_stop()
    wanted = paraxial_properties(as_round).efl_mm / f_number
    if wanted >= axial_beam_diameter_mm(as_round):
        return lens
    marginal = trace(as_round, [[wanted / 2, 0.0, -1.0]], [[0.0, 0.0, 1.0]])
    surfaces, stop = list(lens.surfaces), lens.stop
    corner = surfaces[stop].semi_diameter_mm / as_round.surfaces[stop].semi_diameter_mm
    closed_mm = float(abs(marginal.points_mm[1 + stop, 0, 0]))
    surfaces[stop] = replace(surfaces[stop], semi_diameter_mm=corner * closed_mm)
    return replace(lens, surfaces=tuple(surfaces))


def closed_to(lens: Prescription, f_number: float, key: str) -> Prescription:
    """Return the lens stopped down to an f-number that a user asks for; `key` names that setting in errors.

    Raises
    ------
    InputError
        The f-number is below that of the open lens, rounded down to two decimals as users read and write it, or
        above 200.
    """
    least = math.floor(100 * open_f_number(lens)) / 100
    if not least <= f_number <= LARGEST_F_NUMBER:
        raise InputError(
            f"{key} = {f_number:g}: must be from {least:g}, at which {lens.name} is fully open, "
            f"to {LARGEST_F_NUMBER:g}"
        )
    return stopped_down(lens, f_number)
