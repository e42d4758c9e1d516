"""Compare the ghosts of coated lenses with an integration over single wavelengths, for several numbers of bands.

    python benchmarks/coating_spectrum.py
    python benchmarks/coating_spectrum.py --lens tessar_50_f2p8 --coating bbar --sun-deg 10 --step-nm 4

The camera has a field of 65 degrees and the three-colour detector. The reference traces ghosts at single
wavelengths `--step-nm` apart, joins them by a spline, and integrates them with sunlight and the response of each
channel at every nanometre. The table has one row for each lens and coating: the light of all ghosts on the
unbounded sensor plane, in electrons per second at the first angle of the Sun, as the reference has it and for each
number of bands, and the largest error over all angles, channels and numbers of bands. A part of it is in
`docs/explanation/straylight.md`.
"""

from __future__ import annotations

import argparse

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from vbnfault.camera import Camera
from vbnfault.core import spectra
from vbnfault.core.files.resources import packaged
from vbnfault.core.spectra import Bands
from vbnfault.detector import ThreeColourDetector
from vbnfault.faults import FaultContext, registry
from vbnfault.faults.straylight_lens import channel_bands
from vbnfault.lens import load_lens, scaled_to_field
from vbnfault.lens.coating import NAMES
from vbnfault.lens.imaging import RealLens
from vbnfault.lens.prescription import Prescription
from vbnfault.lens.straylight.bundles import name_of, routes
from vbnfault.lens.straylight.irradiance import FlareModel
from vbnfault.lens.straylight.settings import SensorGrid

F64 = NDArray[np.float64]

SIZE, PITCH_UM, FOV_DEG = 96, 40.0, 65.0
SUN_RAD = spectra.sun_angular_radius_rad(1.0)
DETECTOR = ThreeColourDetector(width_px=SIZE, height_px=SIZE, pixel_pitch_um=PITCH_UM)
AZIMUTH_DEG = 30.0
PIXEL_MM2 = (PITCH_UM * 1e-3) ** 2


def reference(lens: Prescription, suns_deg: list[float], step_nm: float) -> F64:
    """Return the ghosts from single wavelengths, in electrons per second, float64[angle, channel]."""
    sensor = SensorGrid(shape=(SIZE, SIZE), pitch_mm=PITCH_UM * 1e-3)
    some = np.arange(400.0, 700.0 + step_nm / 2, step_nm)
    flux = []
    for nm in some:
        made = FlareModel(lens, Bands.lines(nm), sensor, sun_radius_rad=SUN_RAD)
        flux.append([total(made, sun_deg)[0] for sun_deg in suns_deg])
    nm = np.linspace(400.0, 700.0, 301)
    sensed = DETECTOR.electron_rates(nm) * spectra.solar_irradiance_W_m2_nm(nm)
    return np.asarray(np.trapezoid(sensed * CubicSpline(some, flux)(nm).T[:, None], nm, axis=2)) / PIXEL_MM2


def total(made: FlareModel, sun_deg: float) -> F64:
    """Return the flux of all ghosts over the Sun's irradiance, float64[band] in mm²."""
    # with 48 rays across, the ghosts of a Sun on the axis have errors of 2 %
    names = [name_of(route) for route in routes(made.lens)]
    return np.asarray(sum(made.flux_mm2(sun_deg, AZIMUTH_DEG, names, across=192).values()))


def ghosts(lens: Prescription, sun_deg: float, bands: int) -> F64:
    """Return the ghosts that the fault `straylight` adds to a scene of so many bands, as `reference` does."""
    real = RealLens(prescription=lens, width_px=SIZE, height_px=SIZE, pixel_pitch_um=PITCH_UM)
    camera = Camera(lens=real, detector=DETECTOR, exposure_s=1.0)
    nodes = spectra.band_nodes_nm(400.0, 700.0, bands)
    turn, sine = np.radians(AZIMUTH_DEG), np.sin(np.radians(sun_deg))
    direction = np.array([sine * np.cos(turn), sine * np.sin(turn), np.cos(np.radians(sun_deg))])
    context = FaultContext(
        camera=camera,
        sun_xy_px=camera.project(direction),
        sun_direction_C=direction,
        sun_visible_fraction=1.0,
        wavelength_nm=nodes,
        sun_irradiance_W_m2_nm=spectra.solar_band_irradiance_W_m2_nm(nodes, 1.0),
        sun_angular_radius_rad=SUN_RAD,
    )
    fault = registry()["straylight"]["traced"]()
    source = fault.sun_in_lens(fault.draw_state(context, np.random.default_rng(0)), context)
    rates = channel_bands(context)[1]
    return np.asarray(rates * total(source.of_ghosts.model, sun_deg)) / PIXEL_MM2


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--lens", nargs="+", default=packaged("scenes/lenses"), help="names of packaged lenses")
    parser.add_argument("--coating", nargs="+", default=list(NAMES), help="coatings of every surface")
    parser.add_argument("--sun-deg", nargs="+", type=float, default=[10.0, 0.0, 25.0, 40.0], help="Sun's angles")
    parser.add_argument("--bands", nargs="+", type=int, default=[2, 8, 32], help="numbers of bands")
    parser.add_argument("--step-nm", type=float, default=10.0, help="distance of the reference's wavelengths")
    options = parser.parse_args()
    columns = ["lens", "coating", "reference, e/s", *(f"{n} bands" for n in options.bands), "largest error"]
    print("| " + " | ".join(columns) + " |\n" + "|---" * len(columns) + "|")
    for name in options.lens:
        for coating in options.coating:
            lens = scaled_to_field(load_lens(name), FOV_DEG, SIZE * PITCH_UM * 1e-3).coated(coating)
            worst, row = 0.0, []
            for sun_deg, expected in zip(
                options.sun_deg, reference(lens, options.sun_deg, options.step_nm), strict=True
            ):
                found = [ghosts(lens, sun_deg, n) for n in options.bands]
                worst = max(worst, *(np.abs(one / expected - 1).max() for one in found))
                row = row or [f"{one.sum():.4g}" for one in (expected, *found)]
            print("| " + " | ".join([f"`{name}`", f"`{coating}`", *row, f"{100 * worst:.2f} %"]) + " |", flush=True)


if __name__ == "__main__":
    main()
