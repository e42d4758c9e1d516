"""Vary a prescription at random, and write prescriptions to files."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np

from ..core.errors import InputError
from .gaussian import first_order, scaled_to_focal_length
from .glass import CLEAR, GLASSES, Glass
from .prescription import Prescription, Surface, parse_lens
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
    efl_mm = first_order(lens).efl_mm
    why = ""
    for _ in range(_TRIES):
        table = to_table(lens)
        table["name"] = f"{lens.name}, a relative"
        for row in table["surface"]:
            if row.get("sensor"):
                continue
            _vary(row, rng, spread, index_spread)
        try:
            found = scaled_to_focal_length(parse_lens(table, source=lens.name), efl_mm)
            if real_pupil_diameter_mm(found) > 0.5 * real_pupil_diameter_mm(lens):
                return found
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


def to_table(lens: Prescription) -> dict[str, Any]:
    """Return a prescription as the plain data that `parse_lens` reads.

    The lengths are those of the lens as it is now scaled. `Prescription.scale` counts from the file that was read,
    so it is 1 in the lens that `parse_lens` returns.
    """
    rows = [_row(surface) for surface in lens.surfaces]
    if lens.sensor_reflectance:
        rows.append({"sensor": True, "reflectance": lens.sensor_reflectance})
    return {"name": lens.name, "source": lens.source, "surface": rows}


def _row(surface: Surface) -> dict[str, Any]:
    """Return one surface as a row of that table, without keys at their defaults."""
    row: dict[str, Any] = {
        "radius_mm": surface.radius_mm,
        "thickness_mm": surface.thickness_mm,
        "diameter_mm": 2 * surface.semi_diameter_mm,
        **_medium(surface.medium),
    }
    if surface.stop:
        row["stop"] = True
    if surface.coating:
        row["coating"] = [{"n": f.n, "k": f.k, "thickness_nm": f.thickness_nm} for f in surface.coating]
    if surface.aspheric_mm:
        row["aspheric_mm"] = list(surface.aspheric_mm)
    for key, default in (("conic", 0.0), ("blades", 0), ("blade_rounding", 0.0), ("rotation_deg", 0.0)):
        if getattr(surface, key) != default:
            row[key] = getattr(surface, key)
    nodes, values = surface.internal_transmittance_10mm
    registered = GLASSES.get(surface.medium.name) == surface.medium
    of_glass = surface.medium.internal_transmittance_10mm if registered else CLEAR
    if surface.internal_transmittance_10mm != of_glass:
        row["internal_transmittance_10mm"] = {"wavelength_nm": list(nodes), "value": list(values)}
    return row


def _medium(glass: Glass) -> dict[str, Any]:
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
    table = to_table(lens)
    lines = [f"{key} = {_toml(table[key])}" for key in ("name", "source")]
    for row in table["surface"]:
        lines += ["", "[[surface]]", *(f"{key} = {_toml(value)}" for key, value in row.items())]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _toml(value: Any) -> str:
    """Return a value in TOML syntax."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        # JSON's escapes are those of TOML, which also refuses DEL; a lone surrogate, of a path, has no UTF-8
        text = json.dumps(value.encode("utf-8", "replace").decode(), ensure_ascii=False)
        return text.replace("\x7f", "\\u007f")
    if isinstance(value, dict):
        return "{" + ", ".join(f"{k} = {_toml(v)}" for k, v in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(map(_toml, value)) + "]"
    return repr(float(value)) if isinstance(value, float) else str(value)
