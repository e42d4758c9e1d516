"""Adapt a prescription to a camera: change single parameters, vary it, scale it, coat it, and close its stop.

The f-number is the focal length divided by the diameter of the axial beam that passes all rims (ISO 517). That
diameter is measured with exact rays, so that the irradiance on the axis is exactly π T L / (4 N²). The paraxial
f-number of `paraxial_properties` differs from it by the aberration of the pupil, by some percent for fast lenses.

The sensor stands at the paraxial focus of a changed lens: the camera is focused again. The lens is not scaled
again, so its focal length changes with its surfaces.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..core.errors import InputError
from .coating import Layer
from .glass import D_NM, Glass
from .paraxial import paraxial_properties, scaled_to_field, scaled_to_focal_length
from .prescription import Prescription, Surface
from .prescription_file import load_lens, parse_lens, to_table
from .rays import real_pupil_diameter_mm, trace

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


# --- changes of single parameters ---------------------------------------------------------------------------------


Quantity = Literal[
    "radius",
    "thickness",
    "index",
    "semi_diameter",
    "coating_thickness",
    "coating_index",
    "blades",
    "blade_rounding",
    "rotation_deg",
    "sensor_reflectance",
    "f_number",
]
OF_COATINGS = ("coating_thickness", "coating_index")


@dataclass(frozen=True, kw_only=True)
class Change:
    """Describe one change of a prescription.

    Attributes
    ----------
    quantity
        What changes. Lengths and indices change by an error, all other quantities take the value.
    value
        The error, or the new value.
    relative
        Whether the error of a length is a fraction of it, else it is in mm (layers of coatings: nm).
    row
        Row of the prescription; None: the stop, or all coated surfaces.
    layer
        Layer of the coating, counted from the front; None: all of them.
    """

    quantity: Quantity
    value: float
    relative: bool = False
    row: int | None = None
    layer: int | None = None


@dataclass(frozen=True, kw_only=True)
class OffsetGlass(Glass):
    """Describe a medium whose index differs from that of a glass by the same amount at every wavelength."""

    index_error: float = 0.0

    def index(self, wavelength_nm: ArrayLike) -> NDArray[np.float64]:
        """Return the index relative to air, float64 like `wavelength_nm`."""
        return np.asarray(super().index(wavelength_nm) + self.index_error)

    def same_index(self, other: Glass) -> bool:
        """Return whether both media have the same index at all wavelengths."""
        error = other.index_error if isinstance(other, OffsetGlass) else 0.0
        return super().same_index(other) and error == self.index_error


def changed(lens: Prescription, changes: Sequence[Change]) -> Prescription:
    """Return a lens with changes, which are made in their order, the f-number last.

    Raises
    ------
    InputError
        A change leaves no lens: a length of 0 or less, an index below 1.
    """
    surfaces = list(lens.surfaces)
    f_number = None
    for change in changes:
        if change.quantity == "f_number":
            f_number = change.value
        elif change.quantity == "sensor_reflectance":
            lens = replace(lens, sensor_reflectance=change.value)
        elif change.quantity in OF_COATINGS:
            for row, surface in enumerate(surfaces):
                if change.row in (None, row):
                    surfaces[row] = replace(surface, coating=_recoated(surface.coating, change))
        else:
            row = lens.stop if change.row is None else change.row
            surfaces[row] = _reshaped(surfaces[row], change, f"{lens.name}: surface {row}")
    lens = replace(lens, surfaces=tuple(surfaces))
    return lens if f_number is None else stopped_down(lens, f_number)


def _reshaped(surface: Surface, change: Change, where: str) -> Surface:
    """Return a surface with a change that is not one of its coating."""
    name, value = change.quantity, change.value
    if name == "index":
        made = OffsetGlass(**{**vars(surface.medium), "index_error": value})
        if made.nd < 1:
            raise InputError(f"{where}: index error {value:g}: leaves an index of {made.nd:.4g}, below 1")
        return replace(surface, medium=made)
    if name == "blades":
        return replace(surface, blades=round(value))
    if name == "blade_rounding":
        return replace(surface, blade_rounding=value)
    if name == "rotation_deg":
        return replace(surface, rotation_deg=value)
    key = f"{name}_mm"
    before = float(getattr(surface, key))
    after = before * (1 + value) if change.relative else before + value
    if (after <= 0 and name != "radius") or after * before < 0:
        raise InputError(f"{where}: {key} = {before:g} with an error of {value:g}: must not change its sign")
    shape: dict[str, Any] = {key: after}
    return replace(surface, **shape)


def _recoated(films: tuple[Layer, ...], change: Change) -> tuple[Layer, ...]:
    """Return a coating with a change of its layers."""

    def altered(layer: Layer) -> Layer:
        if change.quantity == "coating_index":
            return replace(
                layer, n=max(layer.n * (1 + change.value) if change.relative else layer.n + change.value, 0.01)
            )
        error_nm = layer.thickness_nm * change.value if change.relative else change.value
        return replace(layer, thickness_nm=max(layer.thickness_nm + error_nm, 0.0))

    return tuple(altered(film) if change.layer in (None, k) else film for k, film in enumerate(films))


# --- requests -----------------------------------------------------------------------------------------------------


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
