"""Read lens prescriptions from TOML and Zemax files, check them, and write them.

`PrescriptionFile` has the keys of the file, `parse_lens` what its rows mean together.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Discriminator, Field, Tag, model_validator

from ..core import tables
from ..core.errors import InputError, in_file
from ..core.files import resources, toml_files
from ..core.files.whole_files import write_whole
from ..core.tables import Fraction, Table, check_spectrum
from .coating import Layer, reflect_transmit
from .glass import (
    AIR,
    CLEAR,
    D_NM,
    GLASSES,
    Glass,
    Transmittance,
    check_index,
    from_abbe,
    from_coefficients,
)
from .paraxial import paraxial_properties
from .prescription import Hood, Prescription, Surface, facing_air
from .zemax import LENS_SUFFIX, GlassCatalogue, glass_named, read_catalogue, read_lens

_LEAST_PASSED = 1e-9  # by a coating: a filter for looking at the Sun passes 1e-5
_RIM_POINTS = 65
_SMALLEST_RADIUS_MM = 1e-9  # the squares of larger curvatures could be too large for a number
_OF_THE_STOP = ("blades", "blade_rounding", "rotation_deg")
_AS_THEY_ARE = ("stop", "conic", "aspheric_mm", *_OF_THE_STOP)  # keys of a row that a surface has too


class GlassTable(Table):
    """Give a medium by a dispersion formula and its coefficients."""

    formula: str = Field(description="name of a dispersion formula, λ in µm: cauchy, sellmeier, polynomial, …")
    coefficients: tuple[Annotated[float, Field(ge=-1e12, le=1e12)], ...] = Field(
        min_length=1, max_length=16, description="of the formula, in its order"
    )


class TransmittanceTable(Table):
    """Give the internal transmittance of 10 mm at wavelengths; linear between them, constant outside."""

    wavelength_nm: tuple[Annotated[float, Field(ge=0, le=1e5)], ...] = Field(
        min_length=1, description="increasing wavelengths"
    )
    value: tuple[Fraction, ...] = Field(min_length=1, description="internal transmittance at each wavelength")

    @model_validator(mode="after")
    def _paired(self) -> TransmittanceTable:
        check_spectrum(self.wavelength_nm, self.value)
        return self


class SurfaceRow(Table):
    """Describe one surface of revolution and the medium behind it."""

    radius_mm: Annotated[float, Field(allow_inf_nan=True)] | None = Field(
        None,
        description="radius of curvature, positive where the centre lies behind; inf: a plane, as is a stop",
    )
    thickness_mm: float | None = Field(
        None, ge=0, le=1e6, description="distance to the next vertex; without meaning in the last row"
    )
    diameter_mm: float = Field(ge=1e-6, le=1e6, description="diameter of the rim, outside of which rays are lost")
    nd: float | None = Field(None, ge=1, le=5, description="index of the medium behind at 587.6 nm; default: air")
    vd: float | None = Field(None, ge=5, le=200, description="its Abbe number; default: no dispersion")
    glass: str | GlassTable | None = Field(
        None, description="the medium by name or by a dispersion formula, in place of nd and vd"
    )
    coating: str | tuple[Layer, ...] = Field(
        "none",
        description="none, mgf2, v or bbar, or layers in the order in which light from the front meets them, which "
        f"transmit at least {_LEAST_PASSED:g} of the light",
    )
    internal_transmittance_10mm: Fraction | TransmittanceTable | None = Field(
        None, description="of 10 mm of the medium: a fraction or a table; default: the glass's own, or 1"
    )
    conic: float = Field(0.0, ge=-1e6, le=1e6, description="0: a sphere, -1: a paraboloid")
    aspheric_mm: tuple[Annotated[float, Field(ge=-1e12, le=1e12)], ...] = Field(
        (), max_length=20, description="coefficients of r⁴, r⁶, … of the sag"
    )
    stop: bool = Field(False, description="whether this row is the aperture stop, which one row must be")
    blades: int = Field(0, ge=0, le=64, description="of the stop; 0: a round stop, else from 3")
    blade_rounding: Fraction = Field(0.0, description="of the stop: how far the edges bulge towards the circle")
    rotation_deg: float = Field(0.0, ge=-360, le=360, description="of the stop: direction of its first corner")
    sensor: Literal[False] = Field(False, description="true in a last row that describes the sensor")

    @model_validator(mode="after")
    def _consistent(self) -> SurfaceRow:
        if self.radius_mm is None and not self.stop:
            raise ValueError("radius_mm: is missing")
        if self.radius_mm is not None and not abs(self.radius_mm) >= _SMALLEST_RADIUS_MM:  # nan is not, either
            raise ValueError(
                f"radius_mm = {self.radius_mm:g}: must be from {_SMALLEST_RADIUS_MM:g}, or from -inf to "
                f"-{_SMALLEST_RADIUS_MM:g}; a plane has inf"
            )
        for key in _OF_THE_STOP if not self.stop else ():
            if key in self.model_fields_set:
                raise ValueError(f"{key} = {getattr(self, key):g}: only the stop has it")
        if self.blades in (1, 2):
            raise ValueError(f"blades = {self.blades}: must be 0, for a round stop, or from 3 to 64")
        if self.glass is not None and (self.nd is not None or self.vd is not None):
            raise ValueError("glass: give either glass or nd and vd")
        if self.vd is not None and self.nd is None:
            raise ValueError(f"vd = {self.vd:g}: needs nd")
        return self


class SensorRow(Table):
    """Describe the sensor, in the last row. It is a plane at the focus."""

    sensor: Literal[True] = Field(description="true: the row describes the sensor")
    reflectance: Fraction = Field(description="fraction of the light that it reflects, the same at all angles")


def _kind_of_row(row: Any) -> str:
    """Return which model describes a row."""
    return "SensorRow" if isinstance(row, dict) and row.get("sensor", False) is not False else "SurfaceRow"


Row = Annotated[
    Annotated[SurfaceRow, Tag("SurfaceRow")] | Annotated[SensorRow, Tag("SensorRow")], Discriminator(_kind_of_row)
]


class PrescriptionFile(Table):
    """Describe a lens by its surfaces, front to back, with air in front and behind."""

    name: str = Field("", description="name of the lens; default: that of the file")
    source: str = Field("", description="where the prescription comes from")
    glass_catalogues: tuple[str, ...] = Field(
        (), description="glass catalogues (.agf) whose glasses the rows may name; paths from the file's folder"
    )
    hood: Hood | None = Field(None, description="what stands before the lens; default: nothing")
    surface: tuple[Row, ...] = Field(min_length=1, description="rows of the prescription, counted from 0")

    @model_validator(mode="after")
    def _rows(self) -> PrescriptionFile:
        for k, row in enumerate(self.surface[:-1]):
            if isinstance(row, SensorRow):
                raise ValueError(f"surface[{k}].sensor = True: only the last row can be the sensor")
        rows = self.surfaces
        if not rows:
            raise ValueError("surface: at least one row before the sensor is needed")
        missing = [f"surface[{k}].thickness_mm" for k, row in enumerate(rows[:-1]) if row.thickness_mm is None]
        if missing:
            raise ValueError(f"{', '.join(missing)}: {'is' if len(missing) == 1 else 'are'} missing")
        stops = [k for k, row in enumerate(rows) if row.stop]
        if len(stops) != 1:
            have = "none has" if not stops else f"surfaces {', '.join(map(str, stops))} have"
            raise ValueError(f"stop: exactly one surface must have stop = true; {have}")
        return self

    @property
    def surfaces(self) -> tuple[SurfaceRow, ...]:
        """Return the rows without that of the sensor."""
        return tuple(row for row in self.surface if isinstance(row, SurfaceRow))

    @property
    def sensor_reflectance(self) -> float:
        """Return the reflectance of the sensor; 0 where the file has no row for it."""
        last = self.surface[-1]
        return last.reflectance if isinstance(last, SensorRow) else 0.0


def load_lens(name_or_path: str | Path) -> Prescription:
    """Read a prescription from a TOML or Zemax file (.zmx), or by the name of a packaged lens.

    Raises
    ------
    InputError
        The file is missing or wrong, or its lens has no focus behind it; the message names file, surface and value.
    """
    path = resources.find("scenes/lenses", name_or_path)
    if path.suffix.lower() == LENS_SUFFIX:
        lens = _of_zemax(path)
    else:
        lens = parse_lens(toml_files.read_toml(path, "lens"), source=str(path))
    with in_file(str(path)):
        paraxial_properties(lens)
    return lens


def _of_zemax(path: Path) -> Prescription:
    """Return the prescription of a Zemax file. Raises InputError, which counts surfaces as the file does."""
    table, catalogues, numbers = read_lens(path)
    source = str(path)
    try:
        return _prescription(tables.parse(PrescriptionFile, table, source=source), source, catalogues)
    except InputError as error:
        _, _, text = f"{error}".rpartition(f"{source}: ")
    text = re.sub(r"^surface\[(\d+)\]\.", lambda found: f"SURF {numbers[int(found[1])]}: ", text)
    text = re.sub(
        r"\bsurfaces (\d+) and (\d+)\b",
        lambda found: f"SURF {numbers[int(found[1])]} and SURF {numbers[int(found[2])]}",
        text,
    )
    raise InputError(f"{source}: {text}")


def parse_lens(table: Mapping[str, Any], *, source: str) -> Prescription:
    """Return the prescription that plain data (the contents of a TOML file) describe.

    `source` is the path of the file, beside which its glass catalogues are searched, or another name for messages.

    Raises
    ------
    InputError
        The data are wrong; the message names `source`, surface and value.
    """
    file = tables.parse(PrescriptionFile, table, source=source)
    folder = Path(source).parent
    try:
        catalogues = tuple(read_catalogue(folder / name) for name in file.glass_catalogues)
    except InputError as error:
        raise InputError(f"{source}: glass_catalogues: {error}") from None
    return _prescription(file, source, catalogues)


def _prescription(file: PrescriptionFile, source: str, catalogues: Sequence[GlassCatalogue]) -> Prescription:
    """Return the prescription of a file, whose glasses are those of the catalogues and the registered ones."""
    surfaces: tuple[Surface, ...] = ()
    for k, row in enumerate(file.surfaces):
        front = surfaces[-1].medium if surfaces else AIR
        surfaces += (_surface(row, front, f"{source}: surface[{k}]", catalogues),)
    lens = Prescription(
        name=file.name or Path(source).stem,
        source=file.source,
        surfaces=surfaces,
        sensor_reflectance=file.sensor_reflectance,
        hood=file.hood,
    )
    _check(lens, source)
    return lens


def _surface(row: SurfaceRow, front: Glass, where: str, catalogues: Sequence[GlassCatalogue]) -> Surface:
    """Return the surface that a row describes; `front` is the medium before it."""
    radius = math.inf if row.radius_mm is None else row.radius_mm
    medium = _medium(row, where, catalogues)
    surface = Surface(
        radius_mm=radius,
        thickness_mm=row.thickness_mm or 0.0,
        medium=medium,
        semi_diameter_mm=0.5 * row.diameter_mm,
        coating=_coating(row.coating, front, medium, where),
        internal_transmittance_10mm=_transmittance(row.internal_transmittance_10mm, medium),
        **row.model_dump(include=set(_AS_THEY_ARE)),
    )
    if np.isnan(surface.sag_mm(surface.semi_diameter_mm)):
        most_mm = 2 * abs(radius) / math.sqrt(1 + row.conic)
        shape = f"radius_mm = {radius:g}" + (f" and conic = {row.conic:g}" if row.conic else "")
        raise InputError(
            f"{where}.diameter_mm = {row.diameter_mm:g}: a surface with {shape} ends before that; must be at most "
            f"{most_mm:g}"
        )
    return surface


def _medium(row: SurfaceRow, where: str, catalogues: Sequence[GlassCatalogue]) -> Glass:
    """Return the medium behind a row, air by default, after a check of its index from 400 to 1000 nm."""
    try:
        if isinstance(row.glass, str):
            medium = _named(row.glass, catalogues)
        elif row.glass is not None:
            medium = from_coefficients(row.glass.formula, row.glass.coefficients)
        elif row.nd is not None:
            medium = from_abbe(row.nd, row.vd)
        else:
            return AIR
    except InputError as error:
        raise InputError(f"{where}.{error}") from None
    check_index(medium, f"{where}.glass")
    return medium


def _named(name: str, catalogues: Sequence[GlassCatalogue]) -> Glass:
    """Return a glass of the catalogues, the first that has it, or a registered one. Raises InputError."""
    if (glass := glass_named(name, catalogues)) is not None:
        return glass
    read = "".join(f" {catalogue.path}," for catalogue in catalogues)
    raise InputError(
        f"glass = {name!r}: unknown; known are{read and f' those of{read} and'} {', '.join(GLASSES)}; "
        "glass_catalogues names files that have more"
    )


def _transmittance(given: float | TransmittanceTable | None, medium: Glass) -> Transmittance:
    """Return wavelengths and internal transmittances from one number, from a table, or from the medium."""
    if given is None:
        return medium.internal_transmittance_10mm
    if isinstance(given, TransmittanceTable):
        return given.wavelength_nm, given.value
    return (D_NM,), (given,)


def _coating(given: str | tuple[Layer, ...], front: Glass, back: Glass, where: str) -> tuple[Layer, ...]:
    """Return the layers of a row's coating, in the order in which light from the front meets them."""
    if isinstance(given, tuple):
        return given
    try:
        layers = facing_air(given, front, back)
    except InputError as error:
        raise InputError(f"{where}.{error}") from None
    if layers and 1.0 not in (front.nd, back.nd):
        raise InputError(f"{where}.coating = {given!r}: is made for a surface in air, not between two glasses")
    return layers


def _check(lens: Prescription, source: str) -> None:
    """Raise InputError unless light passes, the stop is in one medium, air follows, and no two surfaces cross.

    A hood stands before the first surface and is at least as wide.
    """
    first = lens.surfaces[0]
    if lens.hood is not None and lens.hood.radius_mm < first.semi_diameter_mm:
        raise InputError(
            f"{source}: hood.radius_mm = {lens.hood.radius_mm:g}: must be at least {first.semi_diameter_mm:g}, the "
            "radius of the first surface's rim"
        )
    bulge = -float(np.min(first.sag_mm(np.linspace(0, first.semi_diameter_mm, _RIM_POINTS))))
    if lens.hood is not None and lens.hood.length_mm < bulge:
        raise InputError(
            f"{source}: hood.length_mm = {lens.hood.length_mm:g}: must be at least {bulge:g}, where the first "
            "surface's rim stands"
        )
    if lens.surfaces[-1].medium.nd != 1.0:
        raise InputError(f"{source}: surface[{len(lens.surfaces) - 1}].nd: behind the last surface there is air")
    media = (AIR, *(s.medium for s in lens.surfaces))
    for k, surface in enumerate(lens.surfaces):
        passed = float(reflect_transmit(surface.coating, media[k].nd, media[k + 1].nd, 1.0, D_NM)[2])
        if passed < _LEAST_PASSED:
            raise InputError(
                f"{source}: surface[{k}].coating: transmits {passed:.3g} of the light at {D_NM:g} nm; must be "
                f"at least {_LEAST_PASSED:g}"
            )
    if not media[lens.stop].same_index(media[lens.stop + 1]):
        raise InputError(f"{source}: surface[{lens.stop}].nd: the stop has the same medium on both sides")
    for k, (front, back) in enumerate(zip(lens.surfaces[:-1], lens.surfaces[1:], strict=True)):
        height = np.linspace(0, min(front.semi_diameter_mm, back.semi_diameter_mm), _RIM_POINTS)
        gap = front.thickness_mm + back.sag_mm(height) - front.sag_mm(height)
        if gap.min() < -1e-6:
            raise InputError(
                f"{source}: surface[{k}].thickness_mm = {front.thickness_mm:g}: surfaces {k} and {k + 1} cross by "
                f"{-gap.min():.3g} mm, {height[int(np.argmin(gap))]:.3g} mm from the axis"
            )


# --- writing ----------------------------------------------------------------------------------------------------


def to_table(lens: Prescription) -> dict[str, Any]:
    """Return a prescription as the plain data that `parse_lens` reads.

    The lengths are those of the lens as it is now scaled. `Prescription.scale` counts from the file that was read,
    so it is 1 in the lens that `parse_lens` returns.
    """
    rows = [_row(surface) for surface in lens.surfaces]
    if lens.sensor_reflectance:
        rows.append({"sensor": True, "reflectance": lens.sensor_reflectance})
    head: dict[str, Any] = {"name": lens.name, "source": lens.source}
    if lens.hood is not None:
        head["hood"] = asdict(lens.hood)
    return {**head, "surface": rows}


def _row(surface: Surface) -> dict[str, Any]:
    """Return one surface as a row of that table, without keys at their defaults."""
    row: dict[str, Any] = {
        "radius_mm": surface.radius_mm,
        "thickness_mm": surface.thickness_mm,
        "diameter_mm": 2 * surface.semi_diameter_mm,
        **_keys_of(surface.medium),
    }
    if surface.coating:
        row["coating"] = [asdict(film) for film in surface.coating]
    row |= {key: value for key in _AS_THEY_ARE if (value := getattr(surface, key))}
    nodes, values = surface.internal_transmittance_10mm
    registered = GLASSES.get(surface.medium.name) == surface.medium
    of_glass = surface.medium.internal_transmittance_10mm if registered else CLEAR
    if surface.internal_transmittance_10mm != of_glass:
        row["internal_transmittance_10mm"] = {"wavelength_nm": list(nodes), "value": list(values)}
    return row


def _keys_of(glass: Glass) -> dict[str, Any]:
    """Return the keys of a row that describe a medium; none for air."""
    if glass.nd == 1.0 and math.isinf(glass.vd):
        return {}
    if GLASSES.get(glass.name) == glass:
        return {"glass": glass.name}
    if glass.formula == "cauchy":
        return {"nd": glass.nd} | ({} if math.isinf(glass.vd) else {"vd": glass.vd})
    return {"glass": {"formula": glass.formula, "coefficients": list(glass.coefficients)}}


def write_lens(lens: Prescription, path: Path) -> None:
    """Write a prescription, as it is now scaled, as a TOML file that `load_lens` reads; see `to_table`."""
    write_whole(path, toml_files.toml_text(to_table(lens)))
