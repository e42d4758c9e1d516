"""Change single parameters of a prescription, such as a radius within its tolerance, the coating or the stop.

The sensor stands at the paraxial focus of the changed lens: the camera is focused again. The lens is not scaled
again, so its focal length changes with its surfaces.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..core.errors import InputError
from .aperture import stopped_down
from .coating import Layer
from .glass import Glass
from .prescription import Prescription, Surface

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
_OF_THE_LENS = ("sensor_reflectance", "f_number")


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
