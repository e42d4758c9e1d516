"""Read lens files (.zmx) and glass catalogues (.agf) of Zemax OpticStudio.

No library is used. On PyPI, `zemaxglass` and `opticalglass` need Python 3.12, and the latter a whole GUI toolkit;
`rayoptics` and `optiland` bring several hundred megabytes; `zmxtools` is under the AGPL. Both formats are short. A
test compares this reader with optiland's.

**Lens files.** One record a line, of a keyword and values; the records of a surface follow its SURF. Surface 0 is
the object, the last one the image; the image becomes the sensor, which stands at the paraxial focus. These records
are read:

==========  ==========================================================================================
MODE        must be SEQ
NAME, NOTE  name of the lens; notes, which become its `source`
UNIT        MM, CM, IN or METER: the unit of all lengths
ENPD, FNUM  entrance pupil's diameter, and f-number, for rims that are missing
FTYP, XFLN, YFLN  fields, for the same
GCAT        names of catalogues: NAME.agf is read if it lies beside the lens file, and so is the .agf file with the
            name of the lens file
TYPE        STANDARD or EVENASPH
STOP        the surface is the stop; on a refracting surface, the stop is a row of the same shape in front of it
CURV, CONI  curvature at the vertex, and conic constant
PARM        2 to 8 of an EVENASPH: coefficients of r⁴, r⁶, …; PARM 1, of r², must be 0
DISZ        distance to the next surface
DIAM        semi-diameter, which becomes the rim
CLAP, FLAP  circular aperture, whose outer radius is then the rim; its inner radius must be 0
GLAS        glass by name, or by nd and vd
==========  ==========================================================================================

Rims that are missing come from paraxial beams (`_with_rims`), and `source` says so. So does the rim of a stop whose
automatic semi-diameter is wider than the beam that ENPD or FNUM asks for: oblique beams have widened it.

A glass is looked up in the catalogues, then among the registered glasses. If it is in neither, nd and vd of its
GLAS record serve, and `source` names it: they may be those of a glass that stood there before. Older files have 1.5
and 40 there for every glass, which is refused. Surfaces in one medium without stop and aperture only set distances
and are left out.

Records that change the light's path and are not read (COORDBRK and other surface types, mirrors, apertures that are
not circular or not centred) are refused in a sentence. Wavelengths, pick-ups, solves, tolerances, drawing and
coatings are ignored: `camera.lens_coating` coats all surfaces. So is the distance of the object, which `source`
then gives; `camera.focus_distance_m` sets it.

**Glass catalogues.** NM begins a glass: name, number of the dispersion formula, and more. CD has the coefficients,
IT internal transmittances: wavelength in µm, fraction, thickness in mm. A line that begins with a number goes on
with the record before it. All other records are ignored. A glass is refused if its formula gives another index at
the d line than NM prints, by more than 0.001: one of the two is wrong. Indices are relative to air at the
catalogue's reference temperature. The formulas are those of Zemax, OpticStudio user guide, "Using glass catalogs".
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from ..core.errors import InputError, shown
from ..core.files import user_files
from ..core.tables import is_number
from .glass import CLEAR, D_NM, GLASSES, Glass, Transmittance, registered
from .paraxial import gap, refraction

LENS_SUFFIX, CATALOGUE_SUFFIX = ".zmx", ".agf"

_MM = {"MM": 1.0, "CM": 10.0, "IN": 25.4, "METER": 1000.0, "M": 1000.0}
_REFUSED = {
    "SQAP": "a rectangular aperture",
    "SQOB": "a rectangular obscuration",
    "ELAP": "an elliptical aperture",
    "ELOB": "an elliptical obscuration",
    "OBSC": "an obscuration in the middle",
    "SPID": "a spider",
    "USAP": "an aperture of the user's shape",
    "USOB": "an obscuration of the user's shape",
    "OBDC": "an aperture off the axis",
}
_NUMBERS = {"CURV": "curvature", "CONI": "conic", "DIAM": "semi_diameter"}
_OF_BEAMS = ("ENPD", "FNUM", "FTYP", "XFLN", "YFLN")
_FAR_MM = 1e7  # distance of the object from which on it counts as infinite; some files write 1e10 for infinity
_NOT_RECORDED = (1.5, 40.0)  # nd and vd that older files have for every glass of a catalogue

_WITHIN = 0.999

# Makers print four decimals or more, some those of another melt: at most 5e-5 apart in the catalogues of 17 makers.
_SAME_INDEX = 1e-3

_PARAMETERS = range(1, 9)  # of an EVENASPH: coefficients of r², r⁴, …

# Zemax's formula → the registered formula, how many coefficients it has, and whether B₁ C₁ B₂ C₂ … alternate.
_FORMULAS = {
    1: ("polynomial", 6, False),
    2: ("sellmeier", 6, True),
    3: ("herzberger", 6, False),
    4: ("sellmeier_2", 5, False),
    5: ("conrady", 3, False),
    6: ("sellmeier", 8, True),
    7: ("handbook_1", 4, False),
    8: ("handbook_2", 4, False),
    9: ("sellmeier_4", 5, False),
    10: ("polynomial", 8, False),
    11: ("sellmeier", 10, True),
    12: ("polynomial_6", 8, False),
    13: ("polynomial_4", 9, False),
}


def _lines(path: Path, what: str, suffix: str) -> list[list[str]]:
    """Return the words of each line of a file in UTF-16, UTF-8 or Latin-1. Raises InputError."""
    data = user_files.read_input(path, what, types=(suffix,))
    if data.startswith((b"\xff\xfe", b"\xfe\xff")):
        text = data.decode("utf-16", errors="replace")
    elif b"\0" in data[:2]:  # UTF-16 without the mark of its byte order
        text = data.decode("utf-16-be" if data[0] == 0 else "utf-16-le", errors="replace")
    else:
        try:
            text = data.decode("utf-8-sig")
        except UnicodeDecodeError:
            text = data.decode("latin-1")
    return [words for line in text.splitlines() if (words := line.split())]


def _number(words: Sequence[str], place: int, where: str) -> float:
    """Return a finite number of a record. Raises InputError, which names the record."""
    try:
        value = float(words[place])
    except (IndexError, ValueError):
        value = math.nan
    if not math.isfinite(value):
        given = shown(words[place]) if place < len(words) else "missing"
        raise InputError(f"{where}: {words[0]}: value {place} is {given}; must be a number")
    return value


# --- glass catalogues -----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class GlassCatalogue:
    """Hold the records of a glass catalogue; a glass is made from them when it is asked for."""

    path: Path
    records: Mapping[str, Sequence[Sequence[str]]]

    def glass(self, name: str) -> Glass | None:
        """Return a glass by its name, in whatever case, or None where the catalogue has none of that name.

        Raises
        ------
        InputError
            The records of the glass are wrong.
        """
        records = self.records.get(name.upper())
        if records is None:
            return None
        where = f"{self.path}: {records[0][1]}"
        number = _number(records[0], 2, where)
        if number not in _FORMULAS:
            raise InputError(f"{where}: dispersion formula {number:g}: must be from 1 to {len(_FORMULAS)}")
        formula, count, alternate = _FORMULAS[int(number)]
        coefficients = next((words for words in records if words[0] == "CD"), ["CD"])
        c = [_number(coefficients, k, where) if k < len(coefficients) else 0.0 for k in range(1, count + 1)]
        if not any(c):
            raise InputError(f"{where}: CD: the coefficients of the dispersion formula are missing")
        glass = Glass(
            name=records[0][1],
            formula=formula,
            coefficients=tuple(c[::2] + c[1::2] if alternate else c),
            internal_transmittance_10mm=_transmittance(records, where),
        )
        printed = float(records[0][4]) if len(records[0]) > 4 and is_number(records[0][4]) else 1.0
        with np.errstate(all="ignore"):
            apart = abs(glass.nd - printed)
        if printed > 1 and not apart <= _SAME_INDEX:  # of an infrared glass, files print 1 or 0
            raise InputError(
                f"{where}: CD: formula {number:g} has the index {glass.nd:.6g} at {D_NM:.1f} nm with these "
                f"coefficients, but NM says {printed:g}; put them in the order of the formula, or give nd and vd "
                "in the lens file"
            )
        return glass


def _transmittance(records: Sequence[Sequence[str]], where: str) -> Transmittance:
    """Return the internal transmittance of 10 mm from the IT records of a glass; 1 where it has none.

    Makers' catalogues mark unknown values by fractions outside 0 to 1, or by a thickness of 0: these are left out.
    """
    table: dict[float, float] = {}
    for words in records:
        if words[0] == "IT" and len(words) >= 4:
            wavelength_um, fraction, thickness_mm = (_number(words, k, where) for k in (1, 2, 3))
            if wavelength_um > 0 and 0 <= fraction <= 1 and thickness_mm > 0:
                table[1e3 * wavelength_um] = fraction ** (10 / thickness_mm)
    return (tuple(sorted(table)), tuple(table[key] for key in sorted(table))) if table else CLEAR


def read_catalogue(path: str | Path) -> GlassCatalogue:
    """Read a glass catalogue (.agf).

    Raises
    ------
    InputError
        The file is missing, is of another type, or holds no glass.
    """
    records: dict[str, list[list[str]]] = {}
    of_glass: list[list[str]] = []
    for words in _lines(Path(path), "glass catalogue", CATALOGUE_SUFFIX):
        if words[0] == "NM" and len(words) > 1:
            of_glass = records.setdefault(words[1].upper(), [])
            of_glass.clear()  # of two glasses of one name, the last counts
        if of_glass and is_number(words[0]):
            of_glass[-1].extend(words)  # a record that goes on in the next line
        else:
            of_glass.append(words)
    if not records:
        raise InputError(f"{path}: no glass catalogue: it has no NM record")
    return GlassCatalogue(Path(path), records)


# --- lens files -----------------------------------------------------------------------------------------------


@dataclass
class _Surface:
    """Collect the records of one surface; lengths in the file's unit."""

    where: str
    number: int
    kind: str = "STANDARD"
    stop: bool = False
    curvature: float = 0.0
    conic: float = 0.0
    thickness: float = 0.0
    semi_diameter: float = 0.0
    automatic: bool = False
    aperture: float | None = None
    parameters: dict[float, float] = field(default_factory=dict)
    glass: Sequence[str] | None = None

    def take(self, words: Sequence[str]) -> None:
        """Take one record. Raises InputError for one that cannot be read, or that changes the light's path."""
        key = words[0]
        if key in _REFUSED:
            raise InputError(
                f"{self.where}: {key}: {_REFUSED[key]} cannot be read; only round rims on the axis can"
            )
        if key == "TYPE":
            self.kind = " ".join(words[1:])
            if self.kind not in ("STANDARD", "EVENASPH"):
                raise InputError(f"{self.where}: TYPE {self.kind}: must be STANDARD or EVENASPH")
        elif key == "STOP":
            self.stop = True
        elif key in _NUMBERS:
            setattr(self, _NUMBERS[key], _number(words, 1, self.where))
            self.automatic = words[2:3] == ["0"] if key == "DIAM" else self.automatic
        elif key == "DISZ":
            self.thickness = math.inf if words[1:2] == ["INFINITY"] else _number(words, 1, self.where)
        elif key in ("CLAP", "FLAP"):
            if _number(words, 1, self.where) != 0:
                raise InputError(f"{self.where}: {key} {words[1]}: the inner radius of the aperture must be 0")
            self.aperture = _number(words, 2, self.where)
            if self.aperture <= 0:
                raise InputError(f"{self.where}: {key} {words[2]}: the radius of the aperture must be above 0")
        elif key == "PARM":
            self.parameters[_number(words, 1, self.where)] = _number(words, 2, self.where)
        elif key == "GLAS":
            if words[1:2] == ["MIRROR"]:
                raise InputError(f"{self.where}: GLAS MIRROR: lenses with mirrors cannot be read")
            self.glass = words

    @property
    def rim(self) -> float:
        """Return the radius of the rim; 0 where the file gives none."""
        return self.semi_diameter if self.aperture is None else self.aperture

    def row(self, unit_mm: float) -> dict[str, Any]:
        """Return the surface's shape and rim as keys of a row of a prescription. Raises InputError."""
        row: dict[str, Any] = {
            "radius_mm": unit_mm / self.curvature if self.curvature else math.inf,
            "diameter_mm": 2 * unit_mm * self.rim,
        }
        if self.conic:
            row["conic"] = self.conic
        if self.kind == "EVENASPH":
            for number, value in self.parameters.items():
                if value and number not in _PARAMETERS:
                    raise InputError(
                        f"{self.where}: PARM {number:g} {value:g}: the number of the parameter must be from "
                        f"{_PARAMETERS[0]} to {_PARAMETERS[-1]}"
                    )
            if self.parameters.get(1):
                raise InputError(f"{self.where}: PARM 1 {self.parameters[1]:g}: the term of r² must be 0")
            terms = [self.parameters.get(k, 0.0) * unit_mm ** (1 - 2 * k) for k in _PARAMETERS[1:]]
            while terms and not terms[-1]:
                terms.pop()
            if terms:
                row["aspheric_mm"] = terms
        return row


def read_lens(path: Path) -> tuple[dict[str, Any], tuple[GlassCatalogue, ...], tuple[int, ...]]:
    """Read a lens file (.zmx).

    Returns
    -------
    table
        Plain data as `prescription.parse_lens` reads them.
    catalogues
        The glass catalogues that lie beside the file, in which the rows' glasses are found.
    numbers
        Number of the surface in the file (SURF) that each row is made from.

    Raises
    ------
    InputError
        The file is not a lens in sequential mode, or has a record that cannot be read; the message names it.
    """
    name, notes, unit_mm, names = path.stem, list[str](), 1.0, list[str]()
    head: dict[str, list[str]] = {}
    surfaces: list[_Surface] = []
    for words in _lines(path, "lens", LENS_SUFFIX):
        key, *values = words
        if key == "SURF":
            surfaces.append(_Surface(f"{path}: SURF {len(surfaces)}", len(surfaces)))
        elif key == "MODE" and values != ["SEQ"]:
            raise InputError(f"{path}: MODE {' '.join(values)}: must be SEQ, a lens in sequential mode")
        elif key == "NAME" and values:
            name = " ".join(values)
        elif key == "NOTE" and len(values) > 1:
            notes.append(" ".join(values[1:]))
        elif key == "UNIT":
            if values[:1] == [] or values[0] not in _MM:
                raise InputError(f"{path}: UNIT {' '.join(values[:1])}: must be one of {', '.join(_MM)}")
            unit_mm = _MM[values[0]]
        elif key == "GCAT":
            names = values
        elif key in _OF_BEAMS:
            head[key] = words
        elif surfaces:
            surfaces[-1].take(words)
    if len(surfaces) < 3:
        raise InputError(
            f"{path}: not a lens: between the first SURF, the object, and the last, the image, is none"
        )
    if surfaces[-1].curvature:
        raise InputError(f"{surfaces[-1].where}: CURV {surfaces[-1].curvature:g}: the image must be plane")
    stops = [surface.number for surface in surfaces if surface.stop]
    if len(stops) != 1 or not 0 < stops[0] < len(surfaces) - 1:
        where = f"at SURF {', '.join(map(str, stops))}" if stops else "nowhere"
        raise InputError(
            f"{path}: STOP: must stand at exactly one surface from SURF 1 to SURF {len(surfaces) - 2}; it stands "
            f"{where}"
        )
    catalogues = _beside(path, names)
    source = "; ".join(notes) or f"Zemax file {path.name}"
    object_mm = surfaces[0].thickness * unit_mm
    if math.isfinite(object_mm) and object_mm < _FAR_MM:
        source += f"; the file has its object at {object_mm:g} mm; camera.focus_distance_m is used instead"
    source += _with_rims(surfaces[:-1], head, catalogues, f"{path}: SURF {stops[0]}")
    rows, numbers = _rows(surfaces[1:-1], unit_mm, catalogues)
    fixed = {surface.glass[1] for surface in surfaces if surface.glass and surface.glass[2:3] == ["0"]}
    if unlisted := sorted(name for name in fixed if glass_named(name, catalogues) is None):
        source += f"; GLAS {', '.join(unlisted)} by nd and vd of the record, as no catalogue beside the file has it"
    return {"name": name, "source": source, "surface": rows}, catalogues, numbers


def _beside(path: Path, names: Sequence[str]) -> tuple[GlassCatalogue, ...]:
    """Return the catalogues of these names, and that with the lens file's own name, that lie beside the file."""
    files = {p.name.lower(): p for p in sorted(path.parent.iterdir()) if p.suffix.lower() == CATALOGUE_SUFFIX}
    wanted = dict.fromkeys(f"{name}{CATALOGUE_SUFFIX}".lower() for name in [path.stem, *names])
    return tuple(read_catalogue(files[name]) for name in wanted if name in files)


def _with_rims(
    surfaces: Sequence[_Surface],
    head: Mapping[str, Sequence[str]],
    catalogues: Sequence[GlassCatalogue],
    where: str,
) -> str:
    """Give a rim to the surfaces without one, from the paraxial beams of the file; return a note of it.

    `surfaces` begins with the object. A rim lets two beams pass that fill the stop, one on the axis and one from
    the edge of the field: its radius is the height of the marginal ray plus that of the chief ray.

    Raises
    ------
    InputError
        The file does not say how wide the stop is.
    """
    matrix, before, missing, rows = np.eye(2), dict[str, Any](), list[int](), []
    for k, surface in enumerate(surfaces[1:]):
        after = _medium(surface, catalogues)
        if surface.rim <= 0 and (surface.stop or after != before):
            missing.append(k)
        rows.append(matrix[0])
        indices = _index(before, catalogues), _index(after, catalogues)
        matrix = gap(surface.thickness) @ refraction(*indices, surface.curvature) @ matrix
        before = after
    # a ray's height at each surface is `height` · its height at the first one + `slope` · its slope before that
    height, slope = np.array(rows).T
    stop = next(k for k, surface in enumerate(surfaces[1:]) if surface.stop)
    rims, far = np.array([surface.rim for surface in surfaces[1:]]), surfaces[0].thickness
    with np.errstate(divide="ignore", invalid="ignore"):
        efl = abs(1 / matrix[1, 0])
        pupil = slope[stop] / height[stop]  # place of the entrance pupil behind the first vertex
        marginal = height if math.isinf(far) else (height * far + slope) / (far + pupil)  # of a pupil of radius 1
        given = {key: _number(head[key], 1, where) if key in head else 0.0 for key in ("ENPD", "FNUM")}
        asked, cause = (given["ENPD"] / 2, "ENPD") if given["ENPD"] > 0 else (efl / given["FNUM"] / 2, "FNUM")
        own = surfaces[1 + stop]
        if own.automatic and own.aperture is None and 0 < asked * abs(marginal[stop]) < rims[stop]:
            rims[stop], missing = 0, sorted({*missing, stop})
        if not missing:
            return ""
        if rims[stop] > 0:
            radius, cause = rims[stop] / abs(marginal[stop]), "the stop"
        elif 0 < asked < math.inf:
            radius = asked
        else:
            radius, cause = np.min((rims / abs(marginal))[rims > 0], initial=math.inf), "the other rims"
        chief = _field_slope(head, far, efl) * (slope - pupil * height)
    chief[stop] = 0
    for k in missing:
        surface, rim = surfaces[1 + k], abs(radius * marginal[k]) + abs(chief[k])
        if not 0 < rim < math.inf:
            raise InputError(
                f"{surface.where}: DIAM: the semi-diameter is missing, and neither ENPD, FNUM nor other surfaces "
                "give it; write it into the file"
            )
        widest = 1 / max(abs(surface.curvature) * math.sqrt(max(1 + surface.conic, 0)), 1e-99)
        surface.semi_diameter = min(float(rim), _WITHIN * widest)  # paraxial heights may exceed a ball
    names = ", ".join(str(surfaces[1 + k].number) for k in missing)
    return f"; DIAM of SURF {names} from the paraxial beams of {cause}"


def _index(keys: Mapping[str, Any], catalogues: Sequence[GlassCatalogue]) -> float:
    """Return the index at the d line of the medium that keys of a row describe."""
    glass = glass_named(keys["glass"], catalogues) if "glass" in keys else None
    return float(keys.get("nd", 1.0) if glass is None else glass.nd)


def _field_slope(head: Mapping[str, Sequence[str]], far: float, efl: float) -> float:
    """Return the tangent of the largest field angle of a file; 0 where it names no field."""
    numbers = {key: [float(w) for w in words[1:] if is_number(w)] for key, words in head.items()}
    kind, _, count = (int(v) for v in ([*numbers.get("FTYP", []), 0, 0, 12])[:3])
    x, y = (numbers.get(key, [])[:count] for key in ("XFLN", "YFLN"))
    most = max((math.hypot(*field) for field in itertools.zip_longest(x, y, fillvalue=0.0)), default=0.0)
    if kind == 0:
        return math.tan(math.radians(min(most, 89.0)))
    return most / (efl if kind > 1 else far)  # of an image's height, or of the object's


def _rows(
    surfaces: Sequence[_Surface], unit_mm: float, catalogues: Sequence[GlassCatalogue]
) -> tuple[list[dict[str, Any]], tuple[int, ...]]:
    """Return the rows of a prescription, and the number of the surface behind each. Raises InputError."""
    rows: list[dict[str, Any]] = []
    numbers: list[int] = []
    front: dict[str, Any] = {}
    for k, surface in enumerate(surfaces):
        medium = _medium(surface, catalogues)
        if medium != front or surface.stop or surface.aperture is not None:
            shape = surface.row(unit_mm)
            if surface.stop and medium != front:
                rows.append({"stop": True, **shape, **front, "thickness_mm": 0.0})
            rows.append({**shape, **medium, "thickness_mm": 0.0})
            if surface.stop and medium == front:
                rows[-1]["stop"] = True
            numbers += [surface.number] * (len(rows) - len(numbers))
        front = medium
        if not rows or k == len(surfaces) - 1:
            continue  # distances in front of the first row do not matter; the sensor stands at the focus
        rows[-1]["thickness_mm"] += surface.thickness * unit_mm
        ends = surfaces[k + 1].stop or surfaces[k + 1].aperture is not None
        if (ends or _medium(surfaces[k + 1], catalogues) != front) and not 0 <= rows[-1]["thickness_mm"] < 1e6:
            raise InputError(
                f"{surface.where}: DISZ {surface.thickness:g}: the distance to the next surface comes to "
                f"{rows[-1]['thickness_mm']:g} mm; must be from 0 to 1e6 mm"
            )
    return rows, tuple(numbers)


def glass_named(name: str, catalogues: Sequence[GlassCatalogue]) -> Glass | None:
    """Return a glass of the catalogues, the first that has it, or a registered one, or None."""
    return next((glass for catalogue in catalogues if (glass := catalogue.glass(name))), None) or registered(name)


def _medium(surface: _Surface, catalogues: Sequence[GlassCatalogue]) -> dict[str, Any]:
    """Return the keys of a row that describe the medium behind a surface; none for air. Raises InputError."""
    words = surface.glass
    if words is None:
        return {}
    name = words[1] if len(words) > 1 else ""
    nd, vd = (_number(words, k, surface.where) if len(words) > k else 0.0 for k in (4, 5))
    by_index = {"nd": nd} | ({"vd": vd} if vd else {})
    if words[2:3] == ["1"]:  # a model glass
        return by_index
    if glass_named(name, catalogues):
        return {"glass": name}
    if nd > 1 and (nd, vd) != _NOT_RECORDED:
        return by_index
    read = "".join(f"{catalogue.path.name}, " for catalogue in catalogues)
    raise InputError(
        f"{surface.where}: GLAS {name}: unknown; known are the glasses of {read}{', '.join(GLASSES)}; put the .agf "
        "file that has it beside the lens file, named as in GCAT or as the lens file"
    )
