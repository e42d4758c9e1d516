"""Lenses, rays and bundles that the tests of image formation share.

The rays are the tests' own: they are traced one by one, without the tables of `RealLens`.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache, partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vbnfault.camera import Camera
from vbnfault.core import spectra
from vbnfault.detector import ThreeColourDetector
from vbnfault.faults import FaultContext
from vbnfault.lens import (
    Prescription,
    RealLens,
    ThinLens,
    load_lens,
    paraxial_properties,
    scaled_to_field,
)
from vbnfault.lens.glass import D_NM
from vbnfault.lens.rays import real_pupil_diameter_mm, trace
from vbnfault.lens.straylight.irradiance import traced_ghosts

F64 = NDArray[np.float64]

# Lens → field angles, degrees, at which it has chief rays that are its own and not those of a lens beyond its field
LENSES = {
    "nikkor_35_f2p8": (5.0, 15.0, 25.0, 35.0, 40.0),
    "nikkor_28_f2p8": (5.0, 15.0, 25.0, 35.0, 40.0),
    "distagon_25_f2p8": (5.0, 15.0, 25.0, 35.0, 40.0),
    "tessar_50_f2p8": (5.0, 12.0, 20.0, 25.0),
    "heliar_100_f3p5": (5.0, 12.0, 20.0, 28.0),
    "biotar_100_f1p4": (5.0, 12.0, 20.0, 25.0),
}
paraxial_ghosts = partial(traced_ghosts, model="paraxial")
PITCH_UM, SIDE_PX = 5.5, 1024


def pixel_mm(lens: Prescription) -> float:
    """Return the pixel pitch of a camera of 1024 px and 65° across."""
    return float(2 * paraxial_properties(lens).efl_mm * np.tan(np.radians(32.5)) / 1024)


@cache
def real(name: str, **changes: Any) -> RealLens:
    """Return a packaged lens scaled to 65° over 1024 pixels of 5.5 µm."""
    prescription = scaled_to_field(load_lens(name), 65.0, SIDE_PX * PITCH_UM * 1e-3)
    given = {"prescription": prescription, "width_px": SIDE_PX, "height_px": SIDE_PX, "pixel_pitch_um": PITCH_UM}
    return RealLens(**(given | changes))


def camera(lens: RealLens | ThinLens, width_px: int = SIDE_PX, height_px: int = SIDE_PX) -> Camera:
    """Return a camera with a lens and a detector of three colours."""
    pitch = lens.pixel_pitch_um if isinstance(lens, RealLens) else PITCH_UM
    return Camera(
        lens=lens, detector=ThreeColourDetector(width_px=width_px, height_px=height_px, pixel_pitch_um=pitch)
    )


def rays(lens: RealLens, slope: Any, x: Any, y: Any, wavelength_nm: float) -> Any:
    """Trace rays through (x, y) mm of the first vertex's plane, with a slope along x."""
    slope, x, y = (v.ravel() for v in np.broadcast_arrays(slope, x, y))
    nothing = np.zeros(len(x))
    return trace(
        lens.prescription,
        np.column_stack([x, y, nothing]),
        np.column_stack([slope, nothing, nothing + 1]),
        wavelength_nm=wavelength_nm,
        sensor_mm=lens.sensor_mm,
    )


def chief_px(lens: RealLens, slope: F64, wavelength_nm: float) -> F64:
    """Return the images' distances from the axis in pixels, by bisection for the ray through the stop's middle."""
    first, row = lens.prescription.surfaces[0], 1 + lens.prescription.stop
    middle, step = -slope * paraxial_properties(lens.prescription).entrance_pupil_mm, 0.02 * first.semi_diameter_mm

    def off(x: F64) -> F64:
        return np.asarray(rays(lens, slope, x, np.zeros(1), wavelength_nm).points_mm[row, :, 0])

    low, high = middle - step, middle + step
    # the farther out a ray enters, the farther out it meets the stop
    while (off(low) > 0).any() or (off(high) < 0).any():
        low, high = np.where(off(low) > 0, low - step, low), np.where(off(high) < 0, high + step, high)
    assert np.isfinite(off(low) + off(high)).all()
    for _ in range(45):
        half = (low + high) / 2
        low, high = np.where(off(half) < 0, half, low), np.where(off(half) < 0, high, half)
    found = rays(lens, slope, half, np.zeros(1), wavelength_nm)
    return np.asarray(found.points_mm[-1, :, 0] * 1e3 / lens.pixel_pitch_um)


def beam(lens: RealLens, slope: F64) -> tuple[F64, float]:
    """Return squares of the first vertex's plane that hold the bundles: middles along x and half width in mm."""
    semi = lens.prescription.surfaces[0].semi_diameter_mm
    fan = np.linspace(-1.5 * semi, 1.5 * semi, 301)
    passing = rays(lens, slope[:, None], fan, np.zeros(1), D_NM).arrives.reshape(len(slope), -1)
    low, high = np.argmax(passing, axis=1), len(fan) - 1 - np.argmax(passing[:, ::-1], axis=1)
    half = 0.55 * max(float(np.ptp(fan[[low, high]], axis=0).max()), real_pupil_diameter_mm(lens.prescription))
    return (fan[low] + fan[high]) / 2, 1.1 * half


def bundle(lens: RealLens, slope: float, wavelength_nm: float, side: int = 121) -> tuple[F64, float]:
    """Return where the rays of a bundle arrive, and the area in mm² that they came through.

    Positions are float64[ray, 2] in pixels from the axis. The rays are those of a square grid that pass the lens.
    """
    (middle,), half = beam(lens, np.array([slope]))
    grid = (np.arange(side) + 0.5) / side * 2 - 1
    x, y = np.meshgrid(middle + half * grid, half * grid)
    found = rays(lens, slope, x, y, wavelength_nm)
    at = found.points_mm[-1, found.arrives, :2] * 1e3 / lens.pixel_pitch_um
    return at, float(found.arrives.sum() * (2 * half / side) ** 2)


def lens_area(d: Any, a: float, b: float) -> F64:
    """Overlap of discs of radii a and b, in the form with Heron's root, complete and empty overlaps included."""
    with np.errstate(invalid="ignore", divide="ignore"):
        one = a * a * np.arccos((d * d + a * a - b * b) / (2 * d * a))
        other = b * b * np.arccos((d * d + b * b - a * a) / (2 * d * b))
        root = np.sqrt((-d + a + b) * (d + a - b) * (d - a + b) * (d + a + b)) / 2
    return np.where(d >= a + b, 0.0, np.where(d <= abs(a - b), np.pi * min(a, b) ** 2, one + other - root))


def sunlit(context: FaultContext, nodes_nm: F64, distance_au: float, **more: Any) -> FaultContext:
    """Return a context with the Sun's light at a distance, in the bands of these nodes."""
    return replace(
        context,
        wavelength_nm=nodes_nm,
        sun_irradiance_W_m2_nm=spectra.solar_band_irradiance_W_m2_nm(nodes_nm, distance_au),
        sun_angular_radius_rad=spectra.sun_angular_radius_rad(distance_au),
        **more,
    )
