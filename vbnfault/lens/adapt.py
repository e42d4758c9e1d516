"""Adapt a prescription to a camera: vary it, scale it, coat it, and close its stop."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..core.errors import InputError
from .aperture import closed_to
from .paraxial import paraxial_properties, scaled_to_field, scaled_to_focal_length
from .prescription import Prescription
from .prescription_file import load_lens, parse_lens, to_table
from .rays import real_pupil_diameter_mm


@dataclass(frozen=True, kw_only=True)
class LensRequest:
    """Name a lens and what is to be changed in it; None changes nothing.

    The changes are made in the order of the attributes. Raises InputError if two of them contradict each other.

    Attributes
    ----------
    lens
        Path of a prescription, or name of a packaged lens.
    vary_seed, spread
        Replace the lens by a random relative of this seed; see `relative` for `spread`.
    focal_length_mm
        Scale the lens to this focal length.
    fov_deg, sensor_width_mm
        Scale the lens so that this width of the sensor spans this field of view; one alone scales nothing.
    coating
        Put this coating on every surface between glass and air: none, mgf2, v or bbar.
    f_number
        Close the stop to this f-number.
    """

    lens: str | Path
    vary_seed: int | None = None
    spread: float = 0.03
    focal_length_mm: float | None = None
    fov_deg: float | None = None
    sensor_width_mm: float | None = None
    coating: str | None = None
    f_number: float | None = None

    def __post_init__(self) -> None:
        if None not in (self.focal_length_mm, self.fov_deg, self.sensor_width_mm):
            raise InputError(
                f"focal_length_mm = {self.focal_length_mm:g}: contradicts fov_deg = {self.fov_deg:g} and "
                f"sensor_width_mm = {self.sensor_width_mm:g}; leave one out"
            )

    def field_deg(self, lens: Prescription, default_deg: float) -> float:
        """Return the field of view in degrees: as given, or that of the sensor's width, or else the default."""
        if self.fov_deg is not None:
            return self.fov_deg
        if self.sensor_width_mm is None:
            return default_deg
        return float(2 * np.degrees(np.arctan(self.sensor_width_mm / 2 / paraxial_properties(lens).efl_mm)))


def adapted_lens(request: LensRequest) -> Prescription:
    """Read the lens of a request and return it with the changes. Raises InputError."""
    lens = load_lens(request.lens)
    if request.vary_seed is not None:
        lens = relative(lens, np.random.default_rng(request.vary_seed), spread=request.spread)
    if request.focal_length_mm is not None:
        lens = scaled_to_focal_length(lens, request.focal_length_mm)
    if request.fov_deg is not None and request.sensor_width_mm is not None:
        lens = scaled_to_field(lens, request.fov_deg, request.sensor_width_mm)
    if request.coating is not None:
        lens = lens.coated(request.coating)
    if request.f_number is not None:
        lens = closed_to(lens, request.f_number, "f_number")
    return lens


# --- random relatives -------------------------------------------------------------------------------------------


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
