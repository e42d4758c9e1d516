"""Vary a prescription at random."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from ..core.errors import InputError
from .paraxial import paraxial_properties, scaled_to_focal_length
from .prescription import Prescription
from .prescription_file import parse_lens, to_table
from .rays import real_pupil_diameter_mm

_TRIES = 200


def relative(
    lens: Prescription,
    rng: np.random.Generator,
    *,
    spread: float = 0.03,
    index_spread: float = 0.005,
) -> Prescription:
    """Return a random, valid lens of the same family, scaled to the focal length of the original.

    Every curvature, thickness and rim except the stop's is multiplied by a log-normal random factor. The same is
    done to (index - 1) of every medium that is given by nd. A draw whose surfaces cross, which does not focus or
    which lets hardly any light pass is repeated.

    Parameters
    ----------
    rng
        Source of random numbers.
    spread
        Standard deviation of the logarithm of the factors of curvatures, thicknesses and diameters, 0 to 0.3.
    index_spread
        The same for (index - 1).

    Raises
    ------
    InputError
        A spread is out of range, or no draw gave a valid lens.
    """
    for key, value in (("spread", spread), ("index_spread", index_spread)):
        if not 0 <= value <= 0.3:
            raise InputError(f"{key} = {value:g}: must be from 0 to 0.3")
    efl_mm = paraxial_properties(lens).efl_mm
    why = ""
    for _ in range(_TRIES):
        table = to_table(lens)
        table["name"] = f"{lens.name}, a relative"
        for row in table["surface"]:
            if row.get("sensor"):
                continue
            _vary(row, rng, spread, index_spread)
        try:
            varied = scaled_to_focal_length(parse_lens(table, source=lens.name), efl_mm)
            if real_pupil_diameter_mm(varied) > 0.5 * real_pupil_diameter_mm(lens):
                return varied
            why = "hardly any light passes"
        except InputError as error:
            why = str(error)
    raise InputError(f"spread = {spread:g}: no valid relative of {lens.name} in {_TRIES} draws; the last: {why}")


def _vary(row: dict[str, Any], rng: np.random.Generator, spread: float, index_spread: float) -> None:
    """Vary the numbers of one row in place; the count of random numbers is the same for every row."""
    curve, gap, rim, index = np.exp(rng.normal(size=4) * [spread, spread, spread, index_spread])
    if math.isfinite(row.get("radius_mm", math.inf)):
        row["radius_mm"] /= curve
    row["thickness_mm"] *= gap
    if not row.get("stop"):
        row["diameter_mm"] *= rim
    if "nd" in row:
        row["nd"] = 1 + (row["nd"] - 1) * index
