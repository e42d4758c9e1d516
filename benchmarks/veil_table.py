"""Print the veiling glare index of every packaged lens and its parts (ISO 9358:1994, black spot, uniform field).

    python benchmarks/veil_table.py [--lens NAME ...] [--coating NAME] [--veil-fraction V] [--cleanliness-level C]

The field is a sky of radiance L over the whole half space. The spot is a black disc of 2° half angle on the axis.
The index is the irradiance at the centre of the spot's image divided by the irradiance of the sky's image beside
it, L A T / f². Each part integrates, over sources at the angle θ, the irradiance of their straylight at that
centre:

- veil: v A T cos θ / (π f²), which integrates to v;
- scatter: `lens.straylight.scatter.veiling_glare`, with roughness and particles;
- ghosts: apart from losses, radiance is constant along a path. So a ghost contributes L T_g Ω, where Ω is the solid
  angle of its beam as seen from the centre of the sensor. The paraxial beam ends at r = ±r_max, where its slope
  is r / M01.

`--coating` sets the coatings: the patents state none, and uncoated glass would add 2 to 11 % of ghosts.
"""

from __future__ import annotations

import argparse

import numpy as np

from vbnfault.core.files import resources
from vbnfault.core.spectra import Bands
from vbnfault.lens import Prescription, load_lens, paraxial_properties
from vbnfault.lens.glass import D_NM
from vbnfault.lens.paraxial import along
from vbnfault.lens.rays import axial_transmittance, ghost, transmittance
from vbnfault.lens.straylight.bundles import name_of, routes
from vbnfault.lens.straylight.scatter import ROUGHNESS_NM, Cleanliness, veiling_glare
from vbnfault.lens.straylight.settings import VEIL_FRACTION

SPOT_DEG = 2.0
ANGLES_DEG = np.concatenate([np.geomspace(SPOT_DEG, 10, 24)[:-1], np.linspace(10, 89.9, 64)])


def index_of(
    lens: Prescription,
    *,
    veil_fraction: float = VEIL_FRACTION,
    roughness_nm: float = ROUGHNESS_NM,
    cleanliness_level: float = 100.0,
    wavelength_nm: float = D_NM,
) -> dict[str, float]:
    """Return the parts of the veiling glare index, `veil`, `scatter` and `ghosts`, as fractions of the field."""
    optics = paraxial_properties(lens)
    passed = float(axial_transmittance(lens, wavelength_nm)[0])
    field = passed * np.pi / 4 * optics.entrance_pupil_diameter_mm**2 / optics.efl_mm**2
    theta = np.radians(ANGLES_DEG)
    rings = 2 * np.pi * np.sin(theta)
    source = np.cos(theta) * field * veil_fraction / np.pi
    cleanliness = Cleanliness(roughness_nm=roughness_nm, level=cleanliness_level)
    of_sources = [
        veiling_glare(lens, Bands.lines(wavelength_nm), sun_deg=angle, cleanliness=cleanliness)
        for angle in ANGLES_DEG
    ]
    # of a source at an angle, the middle of the sensor is this sine away
    scattered = np.array(
        [np.interp(np.sin(a), g.offset, g.irradiance[0]) for a, g in zip(theta, of_sources, strict=True)]
    )
    # the integrals begin at the rim of the spot, which is black
    return {
        "veil": float(np.trapezoid(source * rings, theta) / field),
        "scatter": float(np.trapezoid(scattered * rings, theta) / field),
        "ghosts": _ghosts_sr(lens, wavelength_nm) / field,
    }


def _ghosts_sr(lens: Prescription, wavelength_nm: float) -> float:
    """Return Σ T_g Ω in sr over all ghosts of two reflections, at the centre of the sensor."""
    total = 0.0
    for pair in [name_of(r) for r in routes(lens)]:
        path = ghost(lens, *pair)
        whole, met = along(lens, path, wavelength_nm)
        # rays that arrive at the centre: θ = -r M00 / M01
        height = np.abs(met[:, 0, 0] - met[:, 0, 1] * whole[0, 0] / whole[0, 1])
        # the last row may be the sensor, which reflects and has no rim
        rims = np.array([lens.surfaces[r].semi_diameter_mm if r < len(lens.surfaces) else np.inf for r, _ in path])
        most = float((rims / np.maximum(height, 1e-12)).min())
        total += transmittance(lens, path, wavelength_nm) * np.pi * (most / whole[0, 1]) ** 2
    return total


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--lens", nargs="*")
    parser.add_argument("--coating", default="mgf2")
    parser.add_argument("--veil-fraction", type=float, default=VEIL_FRACTION)
    parser.add_argument("--cleanliness-level", type=float, default=100.0)
    args = parser.parse_args()
    print(f"{'lens':<20}{'veil %':>9}{'scatter %':>11}{'ghosts %':>10}{'total %':>9}")
    for name in args.lens or resources.packaged("scenes/lenses"):
        lens = load_lens(name)
        if args.coating != "as_prescribed":
            lens = lens.coated(args.coating)
        parts = index_of(lens, veil_fraction=args.veil_fraction, cleanliness_level=args.cleanliness_level)
        percent = [100 * v for v in (*parts.values(), sum(parts.values()))]
        print("{:<20}{:9.3f}{:11.3f}{:10.3f}{:9.3f}".format(name, *percent))


if __name__ == "__main__":
    main()
