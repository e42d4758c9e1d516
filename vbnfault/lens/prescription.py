"""Read lens prescriptions (tables of surfaces) from TOML files, check them and change their scale or coatings.

Surfaces are counted from 0 at the front; the stop is a row like any other. Light travels towards +z, from the front
to the sensor. A surface's vertex is its point on the axis.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core import resources
from ..core.errors import InputError, shown
from .coating import DESIGN_NM, Layer, design
from .glass import AIR, CLEAR, D_NM, GLASSES, Glass, Transmittance, from_abbe, from_coefficients
from .zemax import LENS_SUFFIX, GlassCatalogue, read_catalogue, read_lens

F64 = NDArray[np.float64]

_SURFACE_KEYS = (
    "radius_mm",
    "thickness_mm",
    "nd",
    "vd",
    "glass",
    "diameter_mm",
    "coating",
    "stop",
    "conic",
    "aspheric_mm",
    "internal_transmittance_10mm",
    "blades",
    "blade_rounding",
    "rotation_deg",
    "sensor",
    "reflectance",
)
_STOP_KEYS = ("blades", "blade_rounding", "rotation_deg")
_LENS_KEYS = ("name", "source", "glass_catalogues", "surface")
_INDEX_RANGE = (1.0, 5.0)
_RIM_POINTS = 65


@dataclass(frozen=True, kw_only=True)
class Surface:
    """Describe one row of a prescription: a surface of revolution and the medium behind it.

    Attributes
    ----------
    radius_mm
        Radius of curvature at the vertex; positive where the centre lies behind the surface, inf for a plane.
    thickness_mm
        Distance from this vertex to the next.
    medium
        Medium behind the surface.
    semi_diameter_mm
        Radius of the rim: a ray that meets the surface farther from the axis is lost.
    coating
        Layers of the coating, in the order in which light from the front meets them.
    stop
        Whether the surface is the aperture stop. The stop only blocks rays; it does not refract.
    conic
        Conic constant: 0 is a sphere, -1 a paraboloid.
    aspheric_mm
        Coefficients of r⁴, r⁶, … of the sag, in mm to the power -3, -5, …
    internal_transmittance_10mm
        Internal transmittance of 10 mm of `medium`: wavelengths in nm, and transmitted fractions. It is
        interpolated linearly and constant outside the table.
    blades, blade_rounding, rotation_deg
        Shape of the stop. 0 blades make it round. Otherwise it is a polygon whose corners lie at
        `semi_diameter_mm`, the first corner at `rotation_deg` from +x. `blade_rounding`, 0 to 1, bulges the edges
        towards the circle.
    """

    radius_mm: float
    thickness_mm: float
    medium: Glass
    semi_diameter_mm: float
    coating: tuple[Layer, ...] = ()
    stop: bool = False
    conic: float = 0.0
    aspheric_mm: tuple[float, ...] = ()
    internal_transmittance_10mm: Transmittance = CLEAR
    blades: int = 0
    blade_rounding: float = 0.0
    rotation_deg: float = 0.0

    @property
    def curvature_per_mm(self) -> float:
        """Return 1 / radius; 0 for a plane."""
        return 0.0 if math.isinf(self.radius_mm) else 1.0 / self.radius_mm

    def sag_mm(self, height_mm: F64 | float) -> F64:
        """Return how far the surface lies behind its vertex at a distance from the axis; nan beyond its edge."""
        r2 = np.asarray(height_mm, dtype=np.float64) ** 2
        c = self.curvature_per_mm
        with np.errstate(invalid="ignore"):
            sag = c * r2 / (1 + np.sqrt(1 - (1 + self.conic) * c * c * r2))
        for k, a in enumerate(self.aspheric_mm):
            sag = sag + a * r2 ** (k + 2)
        return np.asarray(sag)

    def absorption_per_mm(self, wavelength_nm: float) -> float:
        """Return the absorption coefficient of the medium behind the surface, in 1 / mm."""
        share = float(np.interp(wavelength_nm, *self.internal_transmittance_10mm))
        return -math.log(max(share, 1e-30)) / 10

    def rim_mm(self, angle_rad: F64 | float) -> F64:
        """Return the distance of the rim from the axis in directions measured from +x towards +y.

        It is `semi_diameter_mm` in every direction, except for a stop with blades.
        """
        angle = np.asarray(angle_rad, dtype=np.float64)
        if not self.blades:
            return np.full(angle.shape, self.semi_diameter_mm)
        half = np.pi / self.blades
        beside = np.mod(angle - np.radians(self.rotation_deg), 2 * half) - half
        edge = np.cos(half) / np.cos(beside)
        return np.asarray(self.semi_diameter_mm * (edge + (1 - edge) * self.blade_rounding))


@dataclass(frozen=True, kw_only=True)
class Prescription:
    """Describe a lens by its surfaces, front to back, with air in front and behind.

    The sensor stands at the paraxial focus for the d line, wherever the thickness of the last row ends.

    Attributes
    ----------
    sensor_reflectance
        Fraction of the light that the sensor reflects, the same at all angles.
    scale
        Factor by which the lens was scaled since it was read.
    """

    name: str
    source: str
    surfaces: tuple[Surface, ...]
    sensor_reflectance: float = 0.0
    scale: float = 1.0

    @property
    def stop(self) -> int:
        """Return the row of the stop."""
        return next(k for k, s in enumerate(self.surfaces) if s.stop)

    @property
    def vertices_mm(self) -> F64:
        """Return the distance of each vertex behind the first vertex, float64[row]."""
        return np.concatenate([[0.0], np.cumsum([s.thickness_mm for s in self.surfaces[:-1]])])

    def indices(self, wavelength_nm: float = D_NM) -> F64:
        """Return the indices of all media, float64[row + 1]: before the first row, then behind each row."""
        return np.array([1.0, *(float(s.medium.index(wavelength_nm)) for s in self.surfaces)])

    def scaled(self, factor: float) -> Prescription:
        """Return the lens with every length of its drawing multiplied by a factor.

        These lengths are radii, thicknesses (of elements, gaps and plates), rims, stop and aspheric coefficients.

        What a maker or the environment adds to the glass keeps its physical size: layers of coatings in nm, and so
        their reflectance; roughness in nm; grains of dust in µm; the number of particles per area of a cleanliness
        level; the absorption of the glass per mm, so that a larger lens absorbs more. Field angles, f-numbers and
        the paths of ghosts in units of the focal length do not change.
        """
        surfaces = tuple(
            replace(
                s,
                radius_mm=s.radius_mm * factor,
                thickness_mm=s.thickness_mm * factor,
                semi_diameter_mm=s.semi_diameter_mm * factor,
                aspheric_mm=tuple(a * factor ** -(2 * k + 3) for k, a in enumerate(s.aspheric_mm)),
            )
            for s in self.surfaces
        )
        return replace(self, surfaces=surfaces, scale=self.scale * factor)

    def with_round_stop(self) -> Prescription:
        """Return the lens with a round stop of the same area, for models with rotational symmetry."""
        rim = self.surfaces[self.stop]
        if not rim.blades:
            return self
        turn = np.linspace(0, 2 * np.pi, 3600, endpoint=False)
        radius = float(np.sqrt(np.mean(rim.rim_mm(turn) ** 2)))
        surfaces = list(self.surfaces)
        surfaces[self.stop] = replace(rim, semi_diameter_mm=radius, blades=0)
        return replace(self, surfaces=tuple(surfaces))

    def coated(self, name: str) -> Prescription:
        """Return the lens with a named coating on every surface between glass and air. Raises InputError."""
        media = (AIR, *(s.medium for s in self.surfaces))
        surfaces = []
        for front, surface in zip(media, self.surfaces, strict=False):
            bare = front.nd == surface.medium.nd or 1.0 not in (front.nd, surface.medium.nd)
            films = () if bare else _facing_air(name, front, surface.medium)
            surfaces.append(replace(surface, coating=films))
        return replace(self, surfaces=tuple(surfaces))


def load_lens(name_or_path: str | Path) -> Prescription:
    """Read a prescription from a TOML or Zemax file (.zmx), or by the name of a packaged lens.

    Raises
    ------
    InputError
        The file is missing or wrong; the message names file, surface and value.
    """
    path = resources.find("scenes/lenses", name_or_path)
    if path.suffix.lower() == LENS_SUFFIX:
        table, catalogues = read_lens(path)
        return _prescription(table, str(path), catalogues)
    return parse_lens(resources.read_toml(path, "lens"), source=str(path))


def parse_lens(table: Mapping[str, Any], *, source: str) -> Prescription:
    """Return the prescription that plain data (the contents of a TOML file) describe.

    `source` is the path of the file, beside which its glass catalogues are searched, or another name for messages.

    Raises
    ------
    InputError
        The data are wrong; the message names `source`, surface and value.
    """
    names = table.get("glass_catalogues", [])
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise InputError(f"{source}: glass_catalogues = {shown(names)}: must be a list of paths of .agf files")
    folder = Path(source).parent
    try:
        catalogues = tuple(read_catalogue(folder / name) for name in names)
    except InputError as error:
        raise InputError(f"{source}: glass_catalogues: {error}") from None
    return _prescription(table, source, catalogues)


def _prescription(table: Mapping[str, Any], source: str, catalogues: Sequence[GlassCatalogue]) -> Prescription:
    """Return the prescription of plain data, whose glasses are those of the catalogues and the registered ones."""
    for key in table:
        if key not in _LENS_KEYS:
            raise InputError(f"{source}: {key}: unknown key; known: {', '.join(_LENS_KEYS)}")
    rows = table.get("surface")
    if not isinstance(rows, list) or not rows or not all(isinstance(row, dict) for row in rows):
        raise InputError(f"{source}: surface: at least one [[surface]] is needed")
    sensor_reflectance = 0.0
    if rows[-1].get("sensor", False) is not False:
        sensor_reflectance = _sensor(rows[-1], f"{source}: surface {len(rows) - 1}")
        rows = rows[:-1]
        if not rows:
            raise InputError(f"{source}: surface: at least one [[surface]] before the sensor is needed")
    surfaces: tuple[Surface, ...] = ()
    for k, row in enumerate(rows):
        front = surfaces[-1].medium if surfaces else AIR
        surfaces += (_surface(row, front, f"{source}: surface {k}", catalogues, last=k == len(rows) - 1),)
    lens = Prescription(
        name=str(table.get("name", Path(source).stem)),
        source=str(table.get("source", "")),
        surfaces=surfaces,
        sensor_reflectance=sensor_reflectance,
    )
    _check(lens, source)
    return lens


def _known_keys(row: Mapping[str, Any], where: str) -> None:
    """Raise InputError for a key that no row of a prescription has."""
    for key in row:
        if key not in _SURFACE_KEYS:
            raise InputError(f"{where}: {key}: unknown key; known: {', '.join(_SURFACE_KEYS)}")


def _sensor(row: Mapping[str, Any], where: str) -> float:
    """Return the sensor's reflectance from its row, which is the last one."""
    _known_keys(row, where)
    if row["sensor"] is not True:
        raise InputError(f"{where}: sensor = {shown(row['sensor'])}: must be true or false")
    for key in row:
        if key not in ("sensor", "reflectance"):
            raise InputError(f"{where}: {key}: the sensor takes reflectance alone: it is a plane at the focus")
    return _number(row, "reflectance", where, None, low=0.0, high=1.0)


def _surface(
    row: Mapping[str, Any], front: Glass, where: str, catalogues: Sequence[GlassCatalogue], *, last: bool
) -> Surface:
    """Return the surface that a row describes; `front` is the medium before it."""
    _known_keys(row, where)
    if row.get("sensor", False) is not False:
        raise InputError(f"{where}: sensor = {shown(row['sensor'])}: only the last surface can be the sensor")
    if "reflectance" in row:
        raise InputError(f"{where}: reflectance: only the sensor has one; elsewhere coating and glass give it")
    stop = row.get("stop", False)
    if not isinstance(stop, bool):
        raise InputError(f"{where}: stop = {shown(stop)}: must be true or false")
    radius = _number(row, "radius_mm", where, math.inf if stop else None, low=-math.inf, high=math.inf)
    for key in _STOP_KEYS:
        if key in row and not stop:
            raise InputError(f"{where}: {key}: only the stop has it")
    blades = _number(row, "blades", where, 0, low=0, high=64)
    if blades in (1, 2) or not blades.is_integer():
        raise InputError(f"{where}: blades = {shown(row['blades'])}: must be 0, for a round stop, or from 3 to 64")
    if radius == 0:
        raise InputError(f"{where}: radius_mm = 0: must not be 0; a plane has inf")
    coefficients = row.get("aspheric_mm", [])
    if not isinstance(coefficients, list):
        raise InputError(f"{where}: aspheric_mm = {shown(coefficients)}: must be a list of numbers")
    medium = _medium(row, where, catalogues)
    surface = Surface(
        radius_mm=radius,
        thickness_mm=_number(row, "thickness_mm", where, 0.0 if last else None, low=0.0, high=1e6),
        medium=medium,
        semi_diameter_mm=0.5 * _number(row, "diameter_mm", where, None, low=1e-6, high=1e6),
        coating=_coating(row.get("coating", "none"), front, medium, where),
        stop=stop,
        conic=_number(row, "conic", where, 0.0, low=-1e6, high=1e6),
        aspheric_mm=tuple(
            _number({"aspheric_mm": c}, "aspheric_mm", where, None, low=-1e12, high=1e12) for c in coefficients
        ),
        internal_transmittance_10mm=(
            _internal(row["internal_transmittance_10mm"], where)
            if "internal_transmittance_10mm" in row
            else medium.internal_transmittance_10mm
        ),
        blades=int(blades),
        blade_rounding=_number(row, "blade_rounding", where, 0.0, low=0.0, high=1.0),
        rotation_deg=_number(row, "rotation_deg", where, 0.0, low=-360.0, high=360.0),
    )
    if np.isnan(surface.sag_mm(surface.semi_diameter_mm)):
        raise InputError(
            f"{where}: diameter_mm = {2 * surface.semi_diameter_mm:g}: a surface with radius_mm = {radius:g} ends "
            f"before that; at most {2 * abs(radius):g} for a sphere"
        )
    return surface


def _medium(row: Mapping[str, Any], where: str, catalogues: Sequence[GlassCatalogue]) -> Glass:
    """Return the medium behind a row, air by default, after a check of its index from 400 to 1000 nm."""
    glass = row.get("glass")
    if glass is not None and ("nd" in row or "vd" in row):
        raise InputError(f"{where}: glass: give either glass or nd and vd")
    try:
        if isinstance(glass, str):
            medium = _named(glass, catalogues)
        elif isinstance(glass, dict):
            medium = from_coefficients(str(glass.get("formula")), list(glass.get("coefficients", [])))
        elif glass is not None:
            raise InputError(f"glass = {shown(glass)}: must be a name or a table of formula and coefficients")
        elif "nd" in row:
            nd = _number(row, "nd", "", None, low=_INDEX_RANGE[0], high=_INDEX_RANGE[1])
            vd = _number(row, "vd", "", 0.0, low=5.0, high=200.0) if "vd" in row else None
            medium = from_abbe(nd, vd)
        elif "vd" in row:
            raise InputError("vd: needs nd")
        else:
            return AIR
    except InputError as error:
        raise InputError(f"{where}: {str(error).removeprefix(': ')}") from None
    index = medium.index(np.linspace(400, 1000, 61))
    if not (np.isfinite(index).all() and index.min() >= _INDEX_RANGE[0] and index.max() <= _INDEX_RANGE[1]):
        raise InputError(
            f"{where}: glass: its index must be from 1 to 5 between 400 and 1000 nm; got {index.min():g}"
        )
    return medium


def _named(name: str, catalogues: Sequence[GlassCatalogue]) -> Glass:
    """Return a glass of the catalogues, the first that has it, or a registered one. Raises InputError."""
    for catalogue in catalogues:
        if (glass := catalogue.glass(name)) is not None:
            return glass
    if name in GLASSES:
        return GLASSES[name]
    read = "".join(f" {catalogue.path}," for catalogue in catalogues)
    raise InputError(
        f"glass = {name!r}: unknown; known are{read and f' those of{read} and'} {', '.join(GLASSES)}; "
        "glass_catalogues names files that have more"
    )


def _internal(given: object, where: str) -> Transmittance:
    """Return wavelengths and internal transmittances from one number for all wavelengths or from a table."""
    where, key = f"{where}: internal_transmittance_10mm", "value"
    if not isinstance(given, dict):
        return (D_NM,), (_number({key: given}, key, where, None, low=0.0, high=1.0),)
    columns = []
    for name, high in (("wavelength_nm", 1e5), ("value", 1.0)):
        column = given.get(name)
        if not isinstance(column, list) or not column:
            raise InputError(f"{where}.{name}: must be a list of numbers")
        columns.append(tuple(_number({name: v}, name, where, None, low=0.0, high=high) for v in column))
    nodes, values = columns
    if set(given) != {"wavelength_nm", "value"} or len(nodes) != len(values) or list(nodes) != sorted(set(nodes)):
        raise InputError(f"{where}: must be a share, or a table of rising wavelength_nm and as many of value")
    return nodes, values


def _coating(given: object, front: Glass, back: Glass, where: str) -> tuple[Layer, ...]:
    """Return the layers of a row's coating, in the order in which light from the front meets them."""
    if isinstance(given, list):
        return tuple(_layer(film, f"{where}: coating[{k}]") for k, film in enumerate(given))
    try:
        if not isinstance(given, str):
            raise InputError(f"coating = {shown(given)}: must be a name or a list of layers")
        films = _facing_air(given, front, back)
        if films and 1.0 not in (front.nd, back.nd):
            raise InputError(f"coating = {shown(given)}: is made for a surface in air, not between two glasses")
    except InputError as error:
        raise InputError(f"{where}: {error}") from None
    return films


def _facing_air(name: str, front: Glass, back: Glass) -> tuple[Layer, ...]:
    """Return a named coating in the order in which light from the front meets it.

    Its outer layer lies on the side of the air.
    """
    films = design(name, float(max(front.index(DESIGN_NM), back.index(DESIGN_NM))))
    return films if front.nd == 1.0 else films[::-1]


def _layer(film: object, where: str) -> Layer:
    """Return the layer that a table of n, thickness_nm and k describes."""
    if not isinstance(film, dict) or not set(film) <= {"n", "k", "thickness_nm"}:
        raise InputError(f"{where}: must be a table of n, thickness_nm and, if it absorbs, k")
    return Layer(
        n=_number(film, "n", where, None, low=0.01, high=10.0),
        k=_number(film, "k", where, 0.0, low=0.0, high=20.0),
        thickness_nm=_number(film, "thickness_nm", where, None, low=0.0, high=1e5),
    )


def _number(
    table: Mapping[str, Any], key: str, where: str, default: float | None, *, low: float, high: float
) -> float:
    """Return a number of a table as float, or the default; raise InputError where it is missing or out of range."""
    value = table.get(key, default)
    if value is None:
        raise InputError(f"{where}: {key}: missing")
    try:
        number = math.nan if isinstance(value, bool) or not isinstance(value, int | float) else float(value)
    except OverflowError:  # an integer beyond the range of floats
        number = math.nan
    if not low <= number <= high:
        raise InputError(f"{where}: {key} = {shown(value)}: must be a number from {low:g} to {high:g}")
    return number


def _check(lens: Prescription, source: str) -> None:
    """Raise InputError unless the lens has one stop in one medium, ends in air, and no two surfaces cross."""
    stops = [k for k, s in enumerate(lens.surfaces) if s.stop]
    if len(stops) != 1:
        found = "none has" if not stops else f"surfaces {', '.join(map(str, stops))} have"
        raise InputError(f"{source}: stop: exactly one surface must have stop = true; {found}")
    if lens.surfaces[-1].medium.nd != 1.0:
        raise InputError(f"{source}: surface {len(lens.surfaces) - 1}: nd: behind the last surface there is air")
    media = (AIR, *(s.medium for s in lens.surfaces))
    stop = stops[0]
    if not media[stop].same_index(media[stop + 1]):
        raise InputError(f"{source}: surface {stop}: nd: the stop has the same medium on both sides")
    for k, (front, back) in enumerate(zip(lens.surfaces[:-1], lens.surfaces[1:], strict=True)):
        height = np.linspace(0, min(front.semi_diameter_mm, back.semi_diameter_mm), _RIM_POINTS)
        gap = front.thickness_mm + back.sag_mm(height) - front.sag_mm(height)
        if gap.min() < -1e-6:
            raise InputError(
                f"{source}: surface {k}: thickness_mm = {front.thickness_mm:g}: surfaces {k} and {k + 1} cross by "
                f"{-gap.min():.3g} mm, {height[int(np.argmin(gap))]:.3g} mm from the axis"
            )
