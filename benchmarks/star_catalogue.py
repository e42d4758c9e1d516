"""Pack the packaged star catalogue from the table of Hipparcos, as `vbnfault/catalogues/SOURCES.md` describes it.

python benchmarks/star_catalogue.py hip_main.dat stars.npz
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]

HIPPARCOS_EPOCH_YEAR = 1991.25
TYPICAL_COLOUR_BV = 0.543  # median of the stars with V ≤ 7


def pack_hipparcos(lines: Iterable[str], faintest_V: float = 7.0) -> dict[str, NDArray[np.generic]]:
    """Return the columns of the packaged table from lines of `hip_main.dat` (CDS I/239), brightest first.

    Positions are moved from J1991.25 to J2000.0. If Hipparcos has no astrometric solution (7 stars of V ≤ 7), the
    sexagesimal position is used, without proper motion. If B−V is missing (13 stars), the median of the others is
    used.
    """
    rows = [line.split("|") for line in lines]
    rows = [row for row in rows if row[5].strip() and float(row[5]) <= faintest_V]

    def number(row: list[str], column: int, otherwise: float) -> float:
        return float(row[column]) if row[column].strip() else otherwise

    def angle(sexagesimal: str) -> float:
        degrees, minutes, seconds = (float(part) for part in sexagesimal.replace("-", " ").split())
        return (-1.0 if "-" in sexagesimal else 1.0) * (degrees + minutes / 60 + seconds / 3600)

    dec = np.array([number(row, 9, angle(row[4])) for row in rows])
    ra = np.array([number(row, 8, 15 * angle(row[3])) for row in rows])
    pm_ra, pm_dec = (np.array([number(row, column, 0.0) for row in rows]) for column in (12, 13))
    magnitude = np.array([float(row[5]) for row in rows])
    colour = np.array([number(row, 37, TYPICAL_COLOUR_BV) for row in rows])
    years = 2000.0 - HIPPARCOS_EPOCH_YEAR
    columns: dict[str, tuple[F64, type]] = {
        "right_ascension_mas": ((ra * 3.6e6 + pm_ra * years / np.cos(np.radians(dec))) % 1.296e9, np.int32),
        "declination_mas": (dec * 3.6e6 + pm_dec * years, np.int32),
        "proper_motion_ra_mas_year": (pm_ra, np.int16),
        "proper_motion_dec_mas_year": (pm_dec, np.int16),
        "magnitude_V_hundredths": (100 * magnitude, np.int16),
        "colour_BV_thousandths": (1000 * colour, np.int16),
    }
    order = np.argsort(magnitude, kind="stable")
    return {name: np.rint(values[order]).astype(dtype) for name, (values, dtype) in columns.items()}


def main() -> None:
    """Write the catalogue."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("table", type=Path, help="hip_main.dat of the CDS, I/239")
    parser.add_argument("out", type=Path, help="NPZ file to write")
    given = parser.parse_args()
    with open(given.table, encoding="ascii") as lines:
        np.savez_compressed(given.out, **pack_hipparcos(lines))


if __name__ == "__main__":
    main()
